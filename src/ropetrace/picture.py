"""Pictures of a run without a viewer: the centreline drawn over the images, some frames on a sheet."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from ropetrace.errors import OutputError
from ropetrace.types import Cloud, CloudFrame, Estimate, FloatArray, Frame, Intrinsics, RgbdFrame, Status

TILE_WIDTH = 640
"""Width of one frame on a sheet, pixels."""

_LINES = ((255, 200, 0), (90, 190, 255), (255, 120, 220), (170, 240, 90))
"""Colours of the centrelines of the first rope, the second, ..., in turn."""

_NEAREST = 1e-6
"""What is not this far before the camera is not drawn, metres."""

_NODE = (60, 220, 90)
_START = (80, 160, 255)
_STATUS_COLORS = {Status.OK: (150, 230, 160), Status.DEGRADED: (255, 190, 90), Status.LOST: (255, 110, 110)}


def depth_image(frame: RgbdFrame) -> NDArray[np.uint8]:
    """Depth as grey levels, near bright, far dark, none black; (H, W, 3)."""
    depth = frame.depth.astype(float)
    seen = np.isfinite(depth) & (depth > 0)
    grey = np.zeros(depth.shape)
    if seen.any():
        near, far = np.percentile(depth[seen], [1, 99])
        grey[seen] = 170 - 110 * np.clip((depth[seen] - near) / max(far - near, 1e-9), 0, 1)
    return np.repeat(grey[..., None], 3, axis=2).astype(np.uint8)


def overlay(frame: Frame, estimate: Estimate, cloud: Cloud | None = None, title: str = "") -> Image.Image:
    """The frame's image, the centreline and the nodes drawn over it; positions in the camera's frame.

    Depth is shown where the frame has no colour. A point cloud is shown as its camera would see it.
    """
    picture, camera = backdrop(frame, cloud)
    said = f"{estimate.status}  {estimate.waypoints.length:.3f} m  {len(estimate.nodes)} nodes"
    if estimate.reasons:
        said += f"\n{estimate.reasons[0][:90]}"
    picture = captioned(picture, title, said, _STATUS_COLORS[estimate.status])
    _draw_rope(picture, camera, estimate)
    return picture


def _draw_rope(picture: Image.Image, camera: Intrinsics, estimate: Estimate) -> None:
    """The centreline, thin where it is hidden, and the nodes; the camera is that of the picture at its own size."""
    zoom = picture.width / camera.width
    draw = ImageDraw.Draw(picture)
    color = _LINES[estimate.rope % len(_LINES)]
    ahead = estimate.waypoints.positions[:, 2] > _NEAREST
    seen = np.ones(len(ahead), bool) if estimate.seen is None else estimate.seen
    line = pixels_of(estimate.waypoints.positions, camera) * zoom
    if len(line) < 2:
        return
    steps = seen[ahead][:-1] & seen[ahead][1:]
    for start, end, whole in zip(line[:-1].tolist(), line[1:].tolist(), steps, strict=True):
        draw.line([tuple(start), tuple(end)], fill=color, width=2 if whole else 1)
    for u, v in pixels_of(estimate.nodes, camera) * zoom:
        draw.ellipse((u - 2, v - 2, u + 2, v + 2), fill=_NODE)
    u, v = line[0]
    draw.ellipse((u - 6, v - 6, u + 6, v + 6), outline=_START, width=2)


def backdrop(frame: Frame, cloud: Cloud | None = None) -> tuple[Image.Image, Intrinsics]:
    """The frame's image to draw on, and the camera that sees it: for a point cloud, one that looks at the rope."""
    if isinstance(frame, RgbdFrame):
        # Colour is dimmed so that the drawing stands out of it.
        base = depth_image(frame) if frame.color is None else (frame.color * 0.7).astype(np.uint8)
        return Image.fromarray(base), frame.intrinsics
    camera = _camera_around(frame, cloud)
    return Image.fromarray(_splat(frame, camera)), camera


def captioned(
    picture: Image.Image, title: str, text: str = "", color: tuple[int, int, int] = (255, 255, 255)
) -> Image.Image:
    """The picture at the width of a tile, with a title and a text in its upper left corner."""
    height = round(picture.height * TILE_WIDTH / picture.width)
    picture = picture.resize((TILE_WIDTH, height), Image.Resampling.BILINEAR)
    draw = ImageDraw.Draw(picture)
    font = ImageFont.load_default(15)
    draw.text((8, 6), title, fill=(255, 255, 255), font=font, stroke_width=1, stroke_fill=(0, 0, 0))
    draw.text((8, 26), text, fill=color, font=font, stroke_width=1, stroke_fill=(0, 0, 0))
    return picture


def sheet(pictures: list[Image.Image], columns: int = 2) -> Image.Image:
    """Pictures of one size side by side."""
    columns = min(columns, len(pictures))
    width, height = pictures[0].size
    rows = -(-len(pictures) // columns)
    canvas = Image.new("RGB", (columns * (width + 4) - 4, rows * (height + 4) - 4), (30, 30, 30))
    for index, picture in enumerate(pictures):
        canvas.paste(picture, (index % columns * (width + 4), index // columns * (height + 4)))
    return canvas


def save_picture(picture: Image.Image, path: Path) -> None:
    """Write a picture; its ending chooses the format.

    Raises
    ------
    OutputError
        If it cannot be written.
    """
    try:
        picture.save(path)
    except ValueError:
        raise OutputError(f"{path}: cannot tell the picture's format from its ending: use .png or .jpg") from None
    except OSError as error:
        raise OutputError(f"{path}: cannot be written: {error.strerror or error}") from None


@dataclass(slots=True)
class ContactSheet:
    """A sink that keeps pictures of frames spread evenly over a run of unknown length."""

    path: Path
    most: int = 6
    _kept: list[Image.Image] = field(default_factory=list)
    _every: int = 1
    _seen: int = 0
    _index: int | None = None
    _latest: Image.Image | None = None

    def write(self, index: int, estimate: Estimate, frame: Frame | None, cloud: Cloud | None) -> None:
        """Take one rope of a frame; bad frames are not shown."""
        if frame is None:
            return
        if index == self._index:
            if self._latest is not None:
                _draw_rope(self._latest, backdrop(frame, cloud)[1], estimate)
            return
        self._index, self._latest = index, None
        if self._seen % self._every == 0:
            if len(self._kept) == 2 * self.most:
                # Twice as many as needed: every second goes, and from now on half as many are taken.
                self._kept = self._kept[::2]
                self._every *= 2
            if self._seen % self._every == 0:
                self._latest = overlay(frame, estimate, cloud, f"frame {index}")
                self._kept.append(self._latest)
        self._seen += 1

    def save(self) -> bool:
        """Write the sheet; False if there was nothing to show."""
        if not self._kept:
            return False
        chosen = np.unique(np.linspace(0, len(self._kept) - 1, min(self.most, len(self._kept))).round().astype(int))
        save_picture(sheet([self._kept[k] for k in chosen]), self.path)
        return True


def pixels_of(points: FloatArray, camera: Intrinsics) -> FloatArray:
    """Projections of (N, 3) points: columns and rows, (N, 2). Points behind the camera are left out."""
    points = points[points[:, 2] > _NEAREST]
    return np.stack(
        [
            points[:, 0] / points[:, 2] * camera.fx + camera.cx,
            points[:, 1] / points[:, 2] * camera.fy + camera.cy,
        ],
        axis=1,
    )


def _camera_around(frame: CloudFrame, cloud: Cloud | None) -> Intrinsics:
    """A camera at the origin that sees the rope's points, or, without any, the whole cloud."""
    points = cloud.points if cloud is not None and len(cloud.points) else frame.points
    points = points[np.isfinite(points).all(axis=1) & (points[:, 2] > _NEAREST)]
    if not len(points):
        return Intrinsics(640, 480, 500, 500, 319.5, 239.5)
    directions = points[:, :2] / points[:, 2:]
    low, high = directions.min(axis=0), directions.max(axis=0)
    middle = (low + high) / 2
    focal = min(600 / max(high[0] - low[0], 1e-6), 400 / max(high[1] - low[1], 1e-6))
    centre = np.clip([320 - middle[0] * focal, 240 - middle[1] * focal], [-639, -479], [1279, 959])
    return Intrinsics(640, 480, float(focal), float(focal), float(centre[0]), float(centre[1]))


def _splat(frame: CloudFrame, camera: Intrinsics) -> NDArray[np.uint8]:
    """The cloud's points as pixels."""
    image = np.full((camera.height, camera.width, 3), 15, np.uint8)
    finite = np.isfinite(frame.points).all(axis=1) & (frame.points[:, 2] > _NEAREST)
    points = frame.points[finite].astype(float)
    columns, rows = np.round(pixels_of(points, camera)).astype(int).T
    inside = (columns >= 0) & (columns < camera.width) & (rows >= 0) & (rows < camera.height)
    image[rows[inside], columns[inside]] = 120 if frame.colors is None else frame.colors[finite][inside]
    return image
