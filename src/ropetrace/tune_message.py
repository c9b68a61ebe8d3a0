"""What the page of `ropetrace tune` shows of a frame, ready for JSON."""

from __future__ import annotations

import base64
import io
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from ropetrace.config import RopeConfig, default_variance_threshold
from ropetrace.picture import backdrop, pixels_of
from ropetrace.tune_advice import advice, remedy_of
from ropetrace.tune_look import TUNED, Look, box_corners
from ropetrace.types import BadFrame, Cloud, Estimate, FloatArray, Frame, Intrinsics, RgbdFrame

_MOST_POINTS = 4000
"""Points that are shown in space."""


def message_of(look: Look, is_live: bool) -> dict[str, Any]:
    """All that the page shows of a frame, ready for JSON; lengths in metres, places in the image in pixels."""
    corners = box_corners(look.config)
    next_thing = advice(look, is_live)
    return {
        "index": look.index,
        "bad": look.event.reason if isinstance(look.event, BadFrame) else "",
        "picture": None if isinstance(look.event, BadFrame) else _picture(look.event, look.cloud),
        "has_color": look.has_color,
        "gated": look.is_gated,
        "looked": bool(look.estimates),
        "passed": look.estimates[0].point_count if look.estimates else 0,
        "points": _rounded(look.cloud.points[:: len(look.cloud.points) // _MOST_POINTS + 1]),
        "slices": _rounded(look.slices),
        "box": None if corners is None else _rounded(corners),
        "ropes": [_rope(estimate) for estimate in look.estimates],
        "advice": {"kind": next_thing.kind, "text": next_thing.text},
        "settings": {name: _setting(look.config, name) for name in TUNED},
        "knows_diameter": look.knows_diameter,
        "variance_threshold": default_variance_threshold(look.config.diameter),
        "age": look.age,
    }


def _picture(frame: Frame, cloud: Cloud) -> dict[str, Any]:
    """The image, what passes of it, and the camera that sees both."""
    if isinstance(frame, RgbdFrame) and frame.color is not None:
        image, camera = Image.fromarray(frame.color), frame.intrinsics
    else:
        image, camera = backdrop(frame)
    return {
        "width": camera.width,
        "height": camera.height,
        "camera": [camera.fx, camera.fy, camera.cx, camera.cy],
        "image": _data_url(image, "JPEG"),
        "passing": _data_url(_passing(cloud, camera), "PNG"),
    }


def _passing(cloud: Cloud, camera: Intrinsics) -> Image.Image:
    """The pixels that pass, on nothing."""
    columns, rows = np.round(pixels_of(cloud.points, camera)).astype(int).T
    inside = (columns >= 0) & (columns < camera.width) & (rows >= 0) & (rows < camera.height)
    passing: NDArray[np.uint8] = np.zeros((camera.height, camera.width, 4), np.uint8)
    passing[rows[inside], columns[inside]] = (0, 255, 210, 150)
    return Image.fromarray(passing)


def _data_url(picture: Image.Image, kind: str) -> str:
    stream = io.BytesIO()
    picture.save(stream, kind)
    return f"data:image/{kind.lower()};base64,{base64.b64encode(stream.getvalue()).decode()}"


def _rope(estimate: Estimate) -> dict[str, Any]:
    count = len(estimate.waypoints)
    return {
        "status": str(estimate.status),
        "reasons": [{"reason": reason, "remedy": remedy_of(reason)} for reason in estimate.reasons],
        "length": estimate.waypoints.length,
        "nodes": _rounded(estimate.nodes),
        "line": _rounded(estimate.waypoints.positions),
        "seen": [True] * count if estimate.seen is None else estimate.seen.tolist(),
    }


def _rounded(points: FloatArray) -> list[list[float]]:
    """To a hundredth of a millimetre, which is less to send."""
    return np.round(points, 5).tolist()


def _setting(config: RopeConfig, name: str) -> Any:
    section, _, key = name.rpartition(".")
    return getattr(getattr(config, section) if section else config, key)
