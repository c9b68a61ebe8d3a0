"""What a rope and an arm look like in the Rerun viewer: estimates in, pictures out."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from ropetrace.errors import import_extra
from ropetrace.types import Estimate, FloatArray, Motion, Status, Waypoints

rr: Any = import_extra("rerun", "viewer")

AXES = 12
"""About how many waypoint frames, and velocities, are drawn; more would hide the rope."""

VELOCITY_SECONDS = 0.1
"""An arrow of a velocity is as long as the way of its waypoint in this time: 1 m/s is 0.1 m."""

VELOCITY_COLOR = (255, 70, 255)

STATUS_COLORS = {Status.OK: (60, 220, 90), Status.DEGRADED: (255, 170, 30), Status.LOST: (240, 70, 60)}

NODE_COLORS = np.array(
    [
        (240, 96, 96),
        (80, 170, 255),
        (250, 200, 60),
        (170, 110, 250),
        (80, 220, 190),
        (250, 120, 210),
        (160, 210, 70),
    ],
    np.uint8,
)
"""Given in turn along the chain, so that the cuts between slices show."""

ROPE_COLORS = NODE_COLORS[[4, 1, 2, 5, 3, 6, 0]]
"""Of the centrelines of the first rope, the second, ..., in turn."""

HIDDEN_PALER = 0.75
"""How far the light dashes of a hidden part are moved from the colour of the rope towards white."""

HIDDEN_DARK = (25, 25, 25)
"""Of the dashes between them, so that the part shows on any background."""

RING_CORNERS = 24

ARM_COLOR = (200, 205, 210)
TOOL_AXES = 0.08
"""Length of the arrows that show the tool's frame, metres."""

AXIS_COLORS = np.array([(255, 60, 60), (60, 200, 60), (70, 110, 255)], np.uint8)


@dataclass(frozen=True, slots=True, eq=False)
class ArmView:
    """An arm at a moment, in the frame of the estimates.

    Parameters
    ----------
    starts, ends : (K, 3) float array
        Ends of the axes of the capsules that its links look like, metres.
    radii : (K,) float array
        Metres.
    tool : (4, 4) float array
        The tool's pose.
    distance : float
        From the tool to the rope, metres: plotted.
    """

    starts: FloatArray
    ends: FloatArray
    radii: FloatArray
    tool: FloatArray
    distance: float


def arm_pictures(arm: ArmView) -> dict[str, Any]:
    """The arm's pictures by name: its links, and its tool as three arrows."""
    along = arm.ends - arm.starts
    lengths = np.linalg.norm(along, axis=1)
    # Rerun's capsules stand on z; the shortest turn from there has half the angle in this unnormalised quaternion.
    x, y, z = (along / np.maximum(lengths, 1e-9)[:, None]).T
    turns = np.stack([-y, x, np.zeros(len(x)), 1 + z], axis=1)
    turns[1 + z < 1e-6] = (1.0, 0.0, 0.0, 0.0)
    return {
        "links": rr.Capsules3D(
            lengths=lengths,
            radii=arm.radii,
            translations=arm.starts,
            quaternions=turns / np.linalg.norm(turns, axis=1, keepdims=True),
            colors=ARM_COLOR,
            fill_mode="solid",
        ),
        "tool": rr.Arrows3D(
            origins=np.tile(arm.tool[:3, 3], (3, 1)),
            vectors=TOOL_AXES * arm.tool[:3, :3].T,
            colors=AXIS_COLORS,
            radii=rr.Radius.ui_points(2.0),
        ),
    }


def rope_color(rope: int) -> NDArray[np.uint8]:
    """The colour of a rope's centreline."""
    return np.asarray(ROPE_COLORS[rope % len(ROPE_COLORS)])


def centerline_pictures(estimate: Estimate) -> dict[str, Any]:
    """The centreline's pictures by name: its seen and hidden parts, the rings, and its name where it starts."""
    waypoints = estimate.waypoints
    points, color = waypoints.positions, rope_color(estimate.rope)
    pale = (color + HIDDEN_PALER * (255 - color)).astype(np.uint8)
    seen = np.ones(len(points), bool) if estimate.seen is None else estimate.seen
    seen_steps = seen[:-1] & seen[1:]
    name = f"rope {estimate.rope}"
    pictures = {
        "name": rr.Points3D(
            points[:1],
            labels=[name if estimate.status is Status.OK else f"{name}: {estimate.status}"],
            colors=STATUS_COLORS[estimate.status],
            radii=rr.Radius.ui_points(3.0),
            show_labels=True,
        )
    }
    width = rr.Radius.ui_points(1.75)
    if seen_steps.any():
        pictures["centerline"] = rr.LineStrips3D(_strips(points, seen_steps), colors=color, radii=width)
    if not seen_steps.all():
        places = np.flatnonzero(~seen_steps)
        pictures["hidden"] = rr.LineStrips3D(
            np.stack([points[places], points[places + 1]], axis=1),
            colors=np.where(places[:, None] % 2, pale, np.array(HIDDEN_DARK, np.uint8)),
            radii=rr.Radius.ui_points(2.25),
        )
    ringed = seen if estimate.seen is None else ~seen
    if estimate.position_sigma is not None and ringed.any():
        rings = _rings(waypoints, estimate.position_sigma, ringed)
        pictures["sigma"] = rr.LineStrips3D(rings, colors=pale, radii=rr.Radius.ui_points(0.5))
    return pictures


def _strips(points: FloatArray, chosen: NDArray[np.bool_]) -> list[FloatArray]:
    """The parts of a line of W points whose segments, (W - 1,), are chosen."""
    bounds = np.flatnonzero(np.diff(chosen, prepend=False, append=False))
    return [points[start : end + 1] for start, end in bounds.reshape(-1, 2)]


def _rings(waypoints: Waypoints, radii: FloatArray, chosen: NDArray[np.bool_]) -> FloatArray:
    """Closed circles of the radii round the rope at the K chosen of W waypoints, (K, corners, 3)."""
    angle = np.linspace(0, 2 * np.pi, RING_CORNERS + 1)
    circle = np.column_stack((np.zeros_like(angle), np.cos(angle), np.sin(angle)))
    turns = Rotation.from_quat(waypoints.quaternions[chosen]).as_matrix()
    return waypoints.positions[chosen, None] + radii[chosen, None, None] * (circle @ turns.transpose(0, 2, 1))


def _step(waypoints: Waypoints) -> int:
    """Which waypoints get arrows: every so many."""
    return -(-len(waypoints) // AXES)


def axes_picture(waypoints: Waypoints) -> Any:
    """Arrows for the frames of about `AXES` waypoints: X (along the rope) red, Y green, Z blue."""
    step = _step(waypoints)
    positions = waypoints.positions[::step]
    size = max(0.6 * waypoints.length / AXES, 0.002)
    # The columns of a rotation matrix are the frame's axes.
    axes = size * Rotation.from_quat(waypoints.quaternions[::step]).as_matrix().transpose(0, 2, 1)
    return rr.Arrows3D(
        origins=np.repeat(positions, 3, axis=0),
        vectors=axes.reshape(-1, 3),
        colors=np.tile(AXIS_COLORS, (len(positions), 1)),
        radii=rr.Radius.ui_points(1.5),
    )


def velocity_picture(waypoints: Waypoints, motion: Motion) -> Any:
    """Arrows for the velocities of about `AXES` waypoints."""
    step = _step(waypoints)
    return rr.Arrows3D(
        origins=waypoints.positions[::step],
        vectors=VELOCITY_SECONDS * motion.velocities[::step],
        colors=VELOCITY_COLOR,
        radii=rr.Radius.ui_points(2.0),
    )
