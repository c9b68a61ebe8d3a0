"""A moving picture of case study 2: the arm traces the rope that sways at its resonance.

    python benchmarks/tracing_picture.py --out docs/figures/tracing.gif

On the left what the camera sees, with the centreline as it was predicted for that moment from the frame before, and the
tool; on the right the same from the side. Ten pictures a second, at the pace of simulated time.
"""

from __future__ import annotations

import argparse
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from ropetrace.evaluation.case1 import CONDITIONS, RESONANCE
from ropetrace.evaluation.case2 import PLACEMENTS, Case2Settings, ClosedLoop, trace
from ropetrace.motion import make_motion
from ropetrace.sim.raycaster import RayCaster
from ropetrace.sim.scene import Boxes, Capsules, Plane, Scene, inverse_pose, looking_at
from ropetrace.tracking import ahead_of_time, with_motion
from ropetrace.types import Estimate, FloatArray, Intrinsics, RgbdFrame, moved

PICTURES_A_SECOND = 10
COLORS = 96
"""Of the surfaces in the GIF: they make its size."""

SIZE = (480, 360)
LINE, TRAIL, TEXT = (255, 205, 40), (90, 220, 255), (235, 235, 235)
AXES = ((255, 90, 80), (110, 220, 110), (110, 150, 255))
BACKGROUND, FLOOR, DARK, HAND = (38, 42, 50), (84, 88, 98), (112, 118, 130), (130, 136, 148)
FLOOR_HEIGHT = 0.12
CLEARER = 2
"""Pictures are drawn this much larger, then made small: no jagged lines."""

ASIDE = looking_at((1.45, -0.85, 1.25), (-0.08, 0.16, 0.78))


def pinhole(fov_degrees: float) -> Intrinsics:
    """A camera of the picture's size."""
    width, height = SIZE[0] * CLEARER, SIZE[1] * CLEARER
    focal = width / 2 / math.tan(math.radians(fov_degrees) / 2)
    return Intrinsics(width, height, focal, focal, (width - 1) / 2, (height - 1) / 2)


class Pictures:
    """Is told of each frame of a loop, and keeps some as pictures."""

    def __init__(self, loop: ClosedLoop) -> None:
        self.loop = loop
        self.every = round(loop.simulated.camera.rate / PICTURES_A_SECOND)
        self.pictures: list[Image.Image] = []
        self.begun = False
        self._motion = make_motion(loop.config.motion.method, loop.config.diameter)
        self._before: Estimate | None = None
        self._caster = RayCaster(pinhole(40))
        self._trail: list[FloatArray] = []
        self._count = 0

    def __call__(self, frame: RgbdFrame, estimate: Estimate) -> None:
        assert self._motion is not None
        predicted = None
        if self._before is not None:
            ahead = (frame.stamp_ns - self._before.stamp_ns) * 1e-9
            predicted = ahead_of_time(self._before, self._motion, ahead).waypoints.positions
        self._before = with_motion(estimate, self._motion)
        if not self.begun:
            return
        tool = self.loop.moving.world_from_tool()
        self._trail.append(tool[:3, 3])
        if self._count % self.every == 0:
            self.pictures.append(self._picture(frame, predicted, tool))
        self._count += 1

    def _picture(self, frame: RgbdFrame, predicted: FloatArray | None, tool: FloatArray) -> Image.Image:
        loop = self.loop
        camera = loop.simulated.world_from_camera
        assert frame.color is not None
        image = np.where((frame.depth > 0)[..., None], frame.color, np.uint8(1) * np.array(BACKGROUND, np.uint8))
        left = Image.fromarray(image).resize((SIZE[0] * CLEARER, SIZE[1] * CLEARER), Image.Resampling.BICUBIC)
        lens = frame.intrinsics
        zoom = left.width / lens.width
        near = replace(
            lens,
            width=left.width,
            height=left.height,
            fx=lens.fx * zoom,
            fy=lens.fy * zoom,
            cx=(lens.cx + 0.5) * zoom - 0.5,
            cy=(lens.cy + 0.5) * zoom - 0.5,
        )
        world = None if predicted is None else moved(predicted, camera)
        linear, *_ = loop.tool_errors()
        self._draw(left, near, camera, world, tool, f"camera, {frame.stamp_ns * 1e-9 - loop.begin:.1f} s")
        right = Image.fromarray(self._from_aside(camera))
        self._draw(right, self._caster.intrinsics, ASIDE, world, tool, f"tool to rope: {linear * 1e3:.1f} mm")
        both = Image.new("RGB", (left.width * 2, left.height))
        both.paste(left, (0, 0))
        both.paste(right, (left.width, 0))
        return both.resize((SIZE[0] * 2, SIZE[1]), Image.Resampling.LANCZOS)

    def _from_aside(self, camera: FloatArray) -> np.ndarray:
        """The scene with what the tracker's camera must not see: the floor, the arm's pedestal, the camera itself."""
        loop = self.loop
        scene = loop.simulated.scene()
        # Palm and fingers, the last three, stand out.
        scene.capsules.colors[-3:] = HAND
        x, y, top = loop.moving.world_from_base[:3, 3]
        extra = Boxes.one((x, y, (top + FLOOR_HEIGHT) / 2), (0.16, 0.16, top - FLOOR_HEIGHT), DARK, 3)
        at = camera[:3, 3]
        extra += Boxes.one((at[0], at[1] - 0.03, at[2]), (0.12, 0.05, 0.04), (40, 44, 52), 3)
        extra += Boxes.one((0.0, 0.0, 0.975), (0.05, 0.05, 0.04), DARK, 3)
        stand = Capsules.along(np.array([[at[0], at[1] - 0.03, FLOOR_HEIGHT], at - [0, 0.03, 0.02]]), 0.012, DARK, 3)
        floor = Plane((0.0, 0.0, 1.0), FLOOR_HEIGHT, FLOOR, 3)
        seen = self._caster.render(Scene(scene.capsules + stand, (floor,), extra), ASIDE)
        far = (seen.depth == 0) | (seen.depth > 4)
        return np.where(far[..., None], np.array(BACKGROUND, np.uint8), seen.color)

    def _draw(
        self,
        image: Image.Image,
        lens: Intrinsics,
        pose: FloatArray,
        line: FloatArray | None,
        tool: FloatArray,
        text: str,
    ) -> None:
        """The trail, the predicted centreline, the tool's axes and some words."""
        draw = ImageDraw.Draw(image)

        def pixels(points: FloatArray) -> list[tuple[float, float]]:
            seen = moved(points, inverse_pose(pose))
            return [(lens.fx * x / z + lens.cx, lens.fy * y / z + lens.cy) for x, y, z in seen.tolist()]

        if len(self._trail) > 1:
            draw.line(pixels(np.array(self._trail[-24:])), fill=TRAIL, width=2 * CLEARER, joint="curve")
        if line is not None and len(line) > 1:
            draw.line(pixels(line), fill=LINE, width=2 * CLEARER, joint="curve")
        origin = tool[:3, 3]
        for axis, color in enumerate(AXES):
            draw.line(pixels(np.array([origin, origin + 0.06 * tool[:3, axis]])), fill=color, width=2 * CLEARER)
        x, y = pixels(origin[None])[0]
        size = 3 * CLEARER
        draw.ellipse((x - size, y - size, x + size, y + size), fill=TEXT)
        draw.text((8 * CLEARER, 6 * CLEARER), text, fill=TEXT, font=ImageFont.load_default(14 * CLEARER))


def palette_of(pictures: list[Image.Image]) -> Image.Image:
    """The colours of the first, the middle and the last, and those of thin lines, which are too few pixels to count."""
    some = np.concatenate([np.asarray(pictures[k]) for k in (0, len(pictures) // 2, -1)])
    own = Image.fromarray(some).quantize(COLORS).getpalette() or []
    lines = [
        round(share * value + (1 - share) * under)
        for line in (LINE, TRAIL, *AXES)
        for share in (1.0, 0.7, 0.4)
        for value, under in zip(line, BACKGROUND, strict=True)
    ]
    palette = Image.new("P", (1, 1))
    palette.putpalette(own[: 3 * COLORS] + lines)
    return palette


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--out", type=Path, default=Path("tracing.gif"))
    parser.add_argument("--frames", type=Path, help="also keep every tenth picture as a PNG in this folder")
    parser.add_argument("--wind", type=float, default=RESONANCE, help="Hz")
    parser.add_argument("--placement", choices=[*PLACEMENTS], default="behind")
    options = parser.parse_args()
    loop = ClosedLoop(CONDITIONS[0], options.wind, Case2Settings.at(options.placement, longest=8.0), 0.001)
    pictures = Pictures(loop)
    loop.on_frame = pictures
    while loop.time < loop.begin:
        loop.see()
    pictures.begun = True
    result = trace(loop)
    print(f"{result.outcome}: {result.linear.mean() * 1e3:.2f} mm, {len(pictures.pictures)} pictures")
    palette = palette_of(pictures.pictures)
    frames = [picture.quantize(palette=palette, dither=Image.Dither.NONE) for picture in pictures.pictures]
    frames[0].save(options.out, save_all=True, append_images=frames[1:], duration=1000 // PICTURES_A_SECOND, loop=0)
    print(f"{options.out}: {options.out.stat().st_size / 1e6:.2f} MB")
    if options.frames is not None:
        options.frames.mkdir(parents=True, exist_ok=True)
        for index, frame in enumerate(frames):
            if index % 10 == 0:
                frame.convert("RGB").save(options.frames / f"{index:03d}.png")


if __name__ == "__main__":
    main()
