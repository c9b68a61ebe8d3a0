"""Rerun: every picture of a run in one place. A sink: nothing here feeds back into the tracking."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any

import numpy as np

from ropetrace.errors import import_extra
from ropetrace.results import NO_METADATA
from ropetrace.results.base import rope_name
from ropetrace.types import Cloud, CloudFrame, Estimate, FloatArray, Frame, RgbdFrame, Status
from ropetrace.viewer_shapes import (
    NODE_COLORS,
    ROPE_COLORS,
    STATUS_COLORS,
    ArmView,
    arm_pictures,
    axes_picture,
    centerline_pictures,
    rope_color,
    velocity_picture,
)

__all__ = ["ArmView", "RerunLog", "default_blueprint", "new_recording", "rope_entity"]

rr: Any = import_extra("rerun", "viewer")
rrb: Any = import_extra("rerun.blueprint", "viewer")

IMAGE_WIDTH = 640
"""Wider images are thinned to at most this many columns: they are looked at, not measured."""

SCENE_POINTS = 50_000
"""About how many points of a whole cloud are drawn."""

CLOUD_POINTS = 3_000
"""About how many points of the rope are drawn: few enough to see the centreline among them."""

STATUS_LEVELS = {Status.OK: "INFO", Status.DEGRADED: "WARN", Status.LOST: "ERROR"}

NO_NODE_COLOR = (110, 110, 110)

LIVE_PICTURES = 15.0
"""A live log has at most this many pictures a second, by the stamps; each costs a browser memory and time."""

LIVE_DEPTHS = 2.0
"""Depth images and whole clouds: they are not compressed, and ten times as large as a colour image."""

LIVE_STATUS_SECONDS = 5.0
"""A live log repeats the status after so long, for those who come later."""


def new_recording(flush_seconds: float | None = None) -> Any:
    """A `rerun.RecordingStream` of its own, whose only clocks are the frame's index and its stamp.

    What is logged in `flush_seconds`, if given, is sent on together.
    """
    batches = None if flush_seconds is None else rr.ChunkBatcherConfig(flush_tick=flush_seconds)
    recording = rr.RecordingStream("ropetrace", batcher_config=batches)
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
                row_shares=[4, 1.4, 1],
            ),
            column_shares=[1, 1],
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
    live : bool
        Log for people who look on, who come late, and must not be flooded: every estimate that is logged is in the
        plots, but there are at most `LIVE_PICTURES` a second, and whoever missed the beginning misses nothing that
        matters.
    """

    def __init__(
        self,
        recording: Any,
        *,
        frame_name: str = "camera",
        frame_from_camera: FloatArray | None = None,
        metadata: Mapping[str, str] = NO_METADATA,
        live: bool = False,
    ) -> None:
        self._recording = recording
        self._live = live
        self._shown_ns: dict[str, int] = {}
        self._asked_ns: dict[str, int] = {}
        self._pictured = True
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
            self._pictured = self._is_due("picture", estimate.stamp_ns, 1 / LIVE_PICTURES)
            if self._pictured:
                self._log_images(frame)
                self._log_scene(frame)
                for rope in {0, *self._reported}:
                    self._recording.log(rope_entity(rope), rr.Clear(recursive=True))
                self._log_cloud(cloud)
        if self._pictured:
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
        if frame.color is not None:
            self._recording.log("camera/image", rr.Image(frame.color[::step, ::step]).compress(jpeg_quality=80))
        if self._is_due("depth", frame.stamp_ns, 1 / LIVE_DEPTHS):
            depth = rr.DepthImage(frame.depth[::step, ::step], meter=1 / frame.depth_unit_m, colormap="Viridis")
            self._recording.log("camera/image" if frame.color is None else "camera/depth", depth)

    def _is_due(self, what: str, stamp_ns: int, seconds: float) -> bool:
        """Whether something may be shown again; in a live log, so long after the last time, if the stamps rise."""
        if not self._live:
            return True
        before = self._asked_ns.get(what)
        self._asked_ns[what] = stamp_ns
        # A tenth is left to jitter: every second frame of 30 Hz makes 15.
        if before is not None and before < stamp_ns < self._shown_ns[what] + 0.9e9 * seconds:
            return False
        self._shown_ns[what] = stamp_ns
        return True

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
            # What is static is never dropped. In a file, the frames before a change keep their camera.
            static=self._live,
        )

    def _log_scene(self, frame: Frame | None) -> None:
        if not isinstance(frame, CloudFrame) or not self._is_due("depth", frame.stamp_ns, 1 / LIVE_DEPTHS):
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
        for name, picture in centerline_pictures(estimate).items():
            self._recording.log(f"{entity}/{name}", picture)
        self._recording.log(f"{entity}/axes", axes_picture(estimate.waypoints))
        if estimate.motion is not None:
            self._recording.log(f"{entity}/velocity", velocity_picture(estimate.waypoints, estimate.motion))

    def _log_arm(self, arm: ArmView) -> None:
        for name, picture in arm_pictures(arm).items():
            self._recording.log(f"arm/{name}", picture)
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
        told = (estimate.status, estimate.reasons)
        if self._live:
            # How much is hidden, and for how long, changes from frame to frame: that is no news.
            told = (estimate.status, tuple(re.sub(r"[\d.]+", "#", reason) for reason in estimate.reasons))
        repeated = self._live and self._is_due(f"status {rope}", estimate.stamp_ns, LIVE_STATUS_SECONDS)
        if self._reported.get(rope) == told and not repeated:
            return
        self._reported[rope] = told
        name = f"rope {rope}" if rope else ""
        text = ": ".join(filter(None, (name, str(estimate.status), "; ".join(estimate.reasons))))
        self._recording.log(
            _with_rope("status", rope),
            rr.TextLog(text, level=STATUS_LEVELS[estimate.status], color=STATUS_COLORS[estimate.status]),
        )


def _with_rope(entity: str, rope: int) -> str:
    """Where a rope's part of what all ropes have is: the first one's is the entity itself."""
    return entity if rope == 0 else f"{entity}/{rope_name(rope)}"


def _speed(estimate: Estimate) -> Any:
    """The speed of the fastest waypoint; a gap in the plot where it is not known."""
    if estimate.motion is None or not len(estimate.motion):
        return rr.Clear(recursive=False)
    return rr.Scalars(np.linalg.norm(estimate.motion.velocities, axis=1).max())
