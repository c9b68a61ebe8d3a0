"""Rerun: every picture of a run in one place. A sink: nothing here feeds back into the tracking."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from ropetrace.errors import import_extra
from ropetrace.results.base import rope_name
from ropetrace.types import Cloud, CloudFrame, Estimate, FloatArray, Frame, Motion, RgbdFrame, Status, Waypoints

rr: Any = import_extra("rerun", "viewer")
rrb: Any = import_extra("rerun.blueprint", "viewer")

IMAGE_WIDTH = 640
"""Wider images are thinned to at most this many columns: they are looked at, not measured."""

AXES = 12
"""About how many waypoint frames, and velocities, are drawn; more would hide the rope."""

VELOCITY_SECONDS = 0.1
"""An arrow of a velocity is as long as the way of its waypoint in this time: 1 m/s is 0.1 m."""

VELOCITY_COLOR = (255, 70, 255)

SCENE_POINTS = 50_000
"""About how many points of a whole cloud are drawn."""

CLOUD_POINTS = 3_000
"""About how many points of the rope are drawn: few enough to see the centreline among them."""

STATUS_COLORS = {Status.OK: (60, 220, 90), Status.DEGRADED: (255, 170, 30), Status.LOST: (240, 70, 60)}
STATUS_LEVELS = {Status.OK: "INFO", Status.DEGRADED: "WARN", Status.LOST: "ERROR"}

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

HIDDEN_PALER = 0.45
"""How far the colour of a hidden part is moved towards white."""

RING_CORNERS = 24

ARM_COLOR = (200, 205, 210)
TOOL_AXES = 0.08
"""Length of the arrows that show the tool's frame, metres."""

AXIS_COLORS = np.array([(255, 60, 60), (60, 200, 60), (70, 110, 255)], np.uint8)

NO_NODE_COLOR = (110, 110, 110)

NO_METADATA: Mapping[str, str] = MappingProxyType({})


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


def new_recording() -> Any:
    """A `rerun.RecordingStream` of its own, whose only clocks are the frame's index and its stamp."""
    recording = rr.RecordingStream("ropetrace")
    recording.set_log_time_enabled(False)
    return recording


def default_blueprint(arm: bool = False) -> Any:
    """How the viewer shows a run: the rope in 3-D, the image with the centreline in it, plots, the status.

    With an arm, the distance of its tool from the rope takes the place of the count of points.
    """
    lines = [f"+ /{rope_entity(rope)}/{part}" for rope in range(len(ROPE_COLORS)) for part in ("centerline", "hidden")]
    last = ("Tool to rope (m)", "/plots/tool_distance") if arm else ("Points", "/plots/point_count")
    return rrb.Blueprint(
        rrb.Horizontal(
            rrb.Spatial3DView(name="Rope", origin="/", contents=["+ /**", "- /camera/**"], line_grid=False),
            rrb.Vertical(
                rrb.Tabs(
                    *(
                        rrb.Spatial2DView(
                            name=name.capitalize(),
                            origin="/camera",
                            contents=["+ /camera", f"+ /camera/{name}", *lines],
                        )
                        for name in ("image", "depth")
                    ),
                    active_tab=0,
                ),
                rrb.Horizontal(
                    rrb.TimeSeriesView(name="Length (m)", origin="/plots/length"),
                    rrb.TimeSeriesView(name="Speed (m/s)", origin="/plots/speed"),
                    rrb.TimeSeriesView(name=last[0], origin=last[1]),
                ),
                rrb.TextLogView(name="Status", origin="/status"),
                row_shares=[3, 1.5, 1],
            ),
            column_shares=[3, 2],
        ),
        rrb.TimePanel(state="collapsed", timeline="frame"),
        collapse_panels=True,
    )


def rope_entity(rope: int) -> str:
    """The entity of a rope."""
    return "rope" if rope == 0 else rope_name(rope)


class RerunLog:
    """Logs a run to a Rerun recording, on the timelines ``frame`` (its index) and ``time`` (its stamp).

    The entities are ``/camera`` with ``image`` (the colour; the depth, if that is all) and ``depth``;
    ``/scene``, a frame's whole cloud; ``/rope`` with ``cloud``, ``nodes``, ``centerline`` (what the camera sees of
    it), ``hidden`` (what it does not), ``sigma`` (rings round that, as wide as the tracker's standard deviation),
    ``name``, ``axes`` and ``velocity``; ``/status``; ``/plots`` with ``length``, ``speed`` (of the fastest waypoint)
    and ``point_count``. Further ropes are ``/rope_1`` ..., ``/status/rope_1`` and ``/plots/length/rope_1``.

    Parameters
    ----------
    recording : rerun.RecordingStream
        Where to log; whether it leads to a file, a viewer or a server is the caller's affair.
    frame_name : str
        The frame of the estimates.
    frame_from_camera : (4, 4) float array, optional
        The camera's pose in that frame; not needed if that is ``camera``. If it is not known, the images are
        shown but not placed in space.
    metadata : mapping of str to str
        Shown as texts under ``/metadata``.
    """

    def __init__(
        self,
        recording: Any,
        *,
        frame_name: str = "camera",
        frame_from_camera: FloatArray | None = None,
        metadata: Mapping[str, str] = NO_METADATA,
    ) -> None:
        self._recording = recording
        self._pose = np.eye(4) if frame_name == "camera" else frame_from_camera
        self._camera: Any = None
        self._index: int | None = None
        self._reported: dict[int, tuple[Status, tuple[str, ...]]] = {}
        axes = rr.ViewCoordinates.RDF if frame_name == "camera" else rr.ViewCoordinates.RIGHT_HAND_Z_UP
        recording.log("/", axes, static=True)
        if self._pose is not None:
            pose = rr.Transform3D(translation=self._pose[:3, 3], mat3x3=self._pose[:3, :3])
            recording.log("camera", pose, static=True)
            recording.log("scene", pose, static=True)
        for name, text in {**metadata, "frame_name": frame_name}.items():
            recording.log(f"metadata/{name}", rr.TextDocument(text), static=True)

    def log(
        self,
        index: int,
        estimate: Estimate,
        frame: Frame | None = None,
        cloud: Cloud | None = None,
        arm: ArmView | None = None,
    ) -> None:
        """Log one rope in one frame; what the frame lacks is cleared, so that no picture outlives its frame.

        Parameters
        ----------
        index : int
            The frame's place in its recording.
        estimate : Estimate
            What the tracker says.
        frame : RgbdFrame or CloudFrame, optional
            What the tracker saw; logged once, with the first rope of the frame.
        cloud : Cloud, optional
            The points that it took for the rope; logged once, too.
        arm : ArmView, optional
            An arm that works on the rope; the last one stays in the picture.
        """
        self._recording.set_time("frame", sequence=index)
        self._recording.set_time("time", timestamp=np.datetime64(estimate.stamp_ns, "ns"))
        if index != self._index:
            self._index = index
            self._log_images(frame)
            self._log_scene(frame)
            for rope in {0, *self._reported}:
                self._recording.log(rope_entity(rope), rr.Clear(recursive=True))
            self._log_cloud(cloud)
        self._log_rope(estimate)
        self._log_plots(estimate)
        self._log_status(estimate)
        if arm is not None:
            self._log_arm(arm)

    def _log_images(self, frame: Frame | None) -> None:
        if not isinstance(frame, RgbdFrame):
            if self._camera is not None:
                self._recording.log("camera/image", rr.Clear(recursive=False))
                self._recording.log("camera/depth", rr.Clear(recursive=False))
            return
        step = -(-frame.intrinsics.width // IMAGE_WIDTH)
        self._log_camera(frame, step)
        depth = rr.DepthImage(frame.depth[::step, ::step], meter=1 / frame.depth_unit_m, colormap="Viridis")
        if frame.color is None:
            self._recording.log("camera/image", depth)
        else:
            self._recording.log("camera/image", rr.Image(frame.color[::step, ::step]).compress(jpeg_quality=80))
            self._recording.log("camera/depth", depth)

    def _log_camera(self, frame: RgbdFrame, step: int) -> None:
        camera = frame.intrinsics
        if camera == self._camera:
            return
        self._camera = camera
        if self._pose is None:
            return
        self._recording.log(
            "camera",
            rr.Pinhole(
                width=-(-camera.width // step),
                height=-(-camera.height // step),
                focal_length=(camera.fx / step, camera.fy / step),
                # Rerun's pixel centres lie at halves, ours at whole numbers.
                principal_point=(camera.cx / step + 0.5, camera.cy / step + 0.5),
                camera_xyz=rr.ViewCoordinates.RDF,
                image_plane_distance=0.1,
            ),
        )

    def _log_scene(self, frame: Frame | None) -> None:
        if not isinstance(frame, CloudFrame):
            return
        step = -(-len(frame.points) // SCENE_POINTS) or 1
        colors = NO_NODE_COLOR if frame.colors is None else frame.colors[::step]
        self._recording.log("scene", rr.Points3D(frame.points[::step], colors=colors, radii=rr.Radius.ui_points(1.0)))

    def _log_cloud(self, cloud: Cloud | None) -> None:
        if cloud is None:
            return
        step = -(-len(cloud.points) // CLOUD_POINTS) or 1
        node = cloud.node[::step]
        colors = np.where(node[:, None] >= 0, NODE_COLORS[node % len(NODE_COLORS)], np.array(NO_NODE_COLOR, np.uint8))
        self._recording.log(
            "rope/cloud", rr.Points3D(cloud.points[::step], colors=colors, radii=rr.Radius.ui_points(1.0))
        )

    def _log_rope(self, estimate: Estimate) -> None:
        entity = rope_entity(estimate.rope)
        if len(estimate.nodes):
            colors = NODE_COLORS[np.arange(len(estimate.nodes)) % len(NODE_COLORS)]
            self._recording.log(
                f"{entity}/nodes", rr.Points3D(estimate.nodes, colors=colors, radii=rr.Radius.ui_points(5.0))
            )
        if not len(estimate.waypoints):
            return
        for name, picture in _centerline(estimate).items():
            self._recording.log(f"{entity}/{name}", picture)
        self._recording.log(f"{entity}/axes", _axes(estimate.waypoints))
        if estimate.motion is not None:
            self._recording.log(f"{entity}/velocity", _velocity(estimate.waypoints, estimate.motion))

    def _log_arm(self, arm: ArmView) -> None:
        along = arm.ends - arm.starts
        lengths = np.linalg.norm(along, axis=1)
        # Rerun's capsules stand on z; the shortest turn from there has half the angle in this unnormalised quaternion.
        x, y, z = (along / np.maximum(lengths, 1e-9)[:, None]).T
        turns = np.stack([-y, x, np.zeros(len(x)), 1 + z], axis=1)
        turns[1 + z < 1e-6] = (1.0, 0.0, 0.0, 0.0)
        self._recording.log(
            "arm/links",
            rr.Capsules3D(
                lengths=lengths,
                radii=arm.radii,
                translations=arm.starts,
                quaternions=turns / np.linalg.norm(turns, axis=1, keepdims=True),
                colors=ARM_COLOR,
                fill_mode="solid",
            ),
        )
        self._recording.log(
            "arm/tool",
            rr.Arrows3D(
                origins=np.tile(arm.tool[:3, 3], (3, 1)),
                vectors=TOOL_AXES * arm.tool[:3, :3].T,
                colors=AXIS_COLORS,
                radii=rr.Radius.ui_points(2.0),
            ),
        )
        self._recording.log("plots/tool_distance", rr.Scalars(arm.distance))

    def _log_plots(self, estimate: Estimate) -> None:
        rope = estimate.rope
        if rope not in self._reported and rope != 0:
            for number in (0, rope):
                style = rr.SeriesLines(colors=rope_color(number), names=f"rope {number}")
                for name in ("length", "point_count", "speed"):
                    self._recording.log(_with_rope(f"plots/{name}", number), style, static=True)
        self._recording.log(_with_rope("plots/length", rope), rr.Scalars(estimate.waypoints.length))
        self._recording.log(_with_rope("plots/point_count", rope), rr.Scalars(estimate.point_count))
        self._recording.log(_with_rope("plots/speed", rope), _speed(estimate))

    def _log_status(self, estimate: Estimate) -> None:
        rope = estimate.rope
        if self._reported.get(rope) == (estimate.status, estimate.reasons):
            return
        self._reported[rope] = (estimate.status, estimate.reasons)
        name = f"rope {rope}" if rope else ""
        text = ": ".join(filter(None, (name, str(estimate.status), "; ".join(estimate.reasons))))
        self._recording.log(
            _with_rope("status", rope),
            rr.TextLog(text, level=STATUS_LEVELS[estimate.status], color=STATUS_COLORS[estimate.status]),
        )


def _with_rope(entity: str, rope: int) -> str:
    """Where a rope's part of what all ropes have is: the first one's is the entity itself."""
    return entity if rope == 0 else f"{entity}/{rope_name(rope)}"


def rope_color(rope: int) -> NDArray[np.uint8]:
    """The colour of a rope's centreline."""
    return np.asarray(ROPE_COLORS[rope % len(ROPE_COLORS)])


def _centerline(estimate: Estimate) -> dict[str, Any]:
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
    for part, steps, shade, width in (("centerline", seen_steps, color, 1.75), ("hidden", ~seen_steps, pale, 1.0)):
        if steps.any():
            pictures[part] = rr.LineStrips3D(_strips(points, steps), colors=shade, radii=rr.Radius.ui_points(width))
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


def _axes(waypoints: Waypoints) -> Any:
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


def _velocity(waypoints: Waypoints, motion: Motion) -> Any:
    """Arrows for the velocities of about `AXES` waypoints."""
    step = _step(waypoints)
    return rr.Arrows3D(
        origins=waypoints.positions[::step],
        vectors=VELOCITY_SECONDS * motion.velocities[::step],
        colors=VELOCITY_COLOR,
        radii=rr.Radius.ui_points(2.0),
    )


def _speed(estimate: Estimate) -> Any:
    """The speed of the fastest waypoint; a gap in the plot where it is not known."""
    if estimate.motion is None or not len(estimate.motion):
        return rr.Clear(recursive=False)
    return rr.Scalars(np.linalg.norm(estimate.motion.velocities, axis=1).max())
