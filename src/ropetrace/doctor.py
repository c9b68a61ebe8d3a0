"""Why does it fail on my data, and which setting would help? Checks of a recording against its settings, in words."""

from __future__ import annotations

import dataclasses
from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass, field
from enum import StrEnum

import numpy as np
from PIL import Image

from ropetrace.config import RopeConfig, format_color, parse_color
from ropetrace.errors import FrameError
from ropetrace.picture import captioned, depth_image, sheet
from ropetrace.recordings import RecordingInfo, StreamInfo
from ropetrace.recordings.base import NO_COLOR
from ropetrace.segmentation import lab_from_rgb
from ropetrace.trackers.slicing import SlicingTracker
from ropetrace.types import (
    BadFrame,
    FloatArray,
    Frame,
    Intrinsics,
    RgbdFrame,
    Status,
    colors_of,
    lacks_color,
)


class Grade(StrEnum):
    """How much a finding matters."""

    GOOD = "good"
    WARNING = "warning"
    BAD = "bad"


@dataclass(frozen=True, slots=True)
class Finding:
    """One thing found, and what to do about it."""

    grade: Grade
    text: str
    advice: str = ""


@dataclass(slots=True)
class Diagnosis:
    """All that was found, and a picture of what the gate keeps."""

    findings: list[Finding] = field(default_factory=list)
    picture: Image.Image | None = None

    def add(self, grade: Grade, text: str, advice: str = "") -> None:
        """Add a finding."""
        self.findings.append(Finding(grade, text, advice))

    @property
    def healthy(self) -> bool:
        """Whether nothing is bad."""
        return all(finding.grade is not Grade.BAD for finding in self.findings)

    def lines(self) -> list[str]:
        """The findings for people, worst first."""
        marks = {Grade.BAD: "BAD ", Grade.WARNING: "warn", Grade.GOOD: "ok  "}
        order = [Grade.BAD, Grade.WARNING, Grade.GOOD]
        lines = []
        for finding in sorted(self.findings, key=lambda finding: order.index(finding.grade)):
            lines.append(f"{marks[finding.grade]}  {finding.text}")
            if finding.advice:
                lines.append(f"      -> {finding.advice}")
        return lines


_PLAUSIBLE_RANGE = (0.1, 12.0)
"""Distances at which a depth camera sees, metres."""

_PICTURES = 4


def diagnose(
    frames: Iterable[tuple[int, Frame | BadFrame]], config: RopeConfig, info: RecordingInfo | None = None
) -> Diagnosis:
    """Check some frames of a recording.

    Parameters
    ----------
    frames : iterable of (index, frame)
        A few dozen frames, spread over the recording, are enough.
    config : RopeConfig
        The settings that will be used.
    info : RecordingInfo, optional
        Of the whole recording, for its stamps and its damage.

    Returns
    -------
    Diagnosis
    """
    diagnosis = Diagnosis()
    good: list[tuple[int, Frame]] = []
    bad: Counter[str] = Counter()
    for index, event in frames:
        if isinstance(event, BadFrame):
            bad[event.reason] += 1
        else:
            good.append((index, event))
    if info is not None:
        for problem in info.problems:
            diagnosis.add(Grade.BAD, problem, "copy the recording again, or record it again")
        if info.streams:
            _check_stamps(diagnosis, info.streams[0])
    for reason, count in bad.most_common(3):
        diagnosis.add(Grade.WARNING, f"{count} of {len(good) + sum(bad.values())} frames are bad: {reason}")
    if not good:
        diagnosis.add(Grade.BAD, "there is no frame to look at", "check what the recording holds: ropetrace info")
        return diagnosis
    first = good[0][1]
    if isinstance(first, RgbdFrame):
        if not _check_depth(diagnosis, [frame for _, frame in good if isinstance(frame, RgbdFrame)]):
            return diagnosis
        _check_intrinsics(diagnosis, first.intrinsics)
    if config.asks_for_color and lacks_color(first):
        diagnosis.add(
            Grade.BAD,
            NO_COLOR,
            "without a colour all points count as rope: mask or box them",
        )
        return diagnosis
    diagnosis.picture = _gate_picture(good, config)
    only_frames = [frame for _, frame in good]
    _check_gates(diagnosis, only_frames, config)
    _check_tracking(diagnosis, only_frames, config)
    return diagnosis


def _check_stamps(diagnosis: Diagnosis, stream: StreamInfo) -> None:
    trouble = []
    if stream.not_rising:
        trouble.append(f"{stream.not_rising} of {stream.count} repeat the one before or run back")
    if stream.rate_hz and stream.largest_gap and stream.largest_gap > 3 / stream.rate_hz:
        trouble.append(
            f"the longest gap between frames is {stream.largest_gap:.3f} s, at {stream.rate_hz:.1f} frames per second"
        )
    if trouble:
        diagnosis.add(
            Grade.WARNING,
            "stamps: " + "; ".join(trouble),
            "shapes are not affected, but velocities are: record the camera's own stamps, and all frames",
        )
    elif stream.rate_hz:
        diagnosis.add(Grade.GOOD, f"stamps rise evenly, {stream.rate_hz:.1f} frames per second")


def _check_depth(diagnosis: Diagnosis, frames: list[RgbdFrame]) -> bool:
    """The depth's unit and how much of it there is; False if there is nothing to go on with."""
    shares = []
    medians = []
    for frame in frames:
        depth = frame.depth.astype(float) * frame.depth_unit_m
        seen = np.isfinite(depth) & (depth > 0)
        shares.append(seen.mean())
        if seen.any():
            medians.append(np.median(depth[seen]))
    if not medians:
        diagnosis.add(Grade.BAD, "no pixel of any frame has depth", "check the depth stream of the camera")
        return False
    distance = float(np.median(medians))
    low, high = _PLAUSIBLE_RANGE
    if not low <= distance <= high:
        factor = next((f for f in (1e-3, 1e3, 1e-4, 1e4, 0.1, 10.0) if low <= distance * f <= high), None)
        unit = frames[0].depth_unit_m
        advice = (
            "check depth_unit_m"
            if factor is None
            else f"with depth_unit_m = {unit * factor:g}, not {unit:g}, they would be at {distance * factor:.2f} m"
        )
        diagnosis.add(Grade.BAD, f"the depth's unit looks wrong: typical points are {distance:.4g} m away", advice)
        return False
    share = float(np.mean(shares))
    diagnosis.add(Grade.GOOD, f"depth in {share:.1%} of the pixels, typically {distance:.2f} m away")
    return True


def _check_intrinsics(diagnosis: Diagnosis, camera: Intrinsics) -> None:
    trouble = []
    for name, centre, size in (("cx", camera.cx, camera.width), ("cy", camera.cy, camera.height)):
        if abs(centre / size - 0.5) > 0.15:
            trouble.append(f"{name} = {centre:.1f} is far from the middle of {size} pixels")
    if not 0.8 < camera.fx / camera.fy < 1.25:
        trouble.append(f"fx = {camera.fx:.1f} and fy = {camera.fy:.1f} differ")
    view = 2 * np.degrees(np.arctan(camera.width / 2 / camera.fx))
    if not 20 <= view <= 130:
        trouble.append(f"the field of view would be {view:.0f} degrees")
    if trouble:
        diagnosis.add(
            Grade.WARNING,
            "the intrinsics may belong to another resolution: " + "; ".join(trouble),
            f"give those of the {camera.width}x{camera.height} depth images",
        )
    else:
        diagnosis.add(Grade.GOOD, f"intrinsics fit {camera.width}x{camera.height}, {view:.0f} degrees wide")


def _without_color(config: RopeConfig) -> RopeConfig:
    segmentation = dataclasses.replace(config.segmentation, lab_min=None, lab_max=None, color_pixel=None)
    return dataclasses.replace(config, color=None, segmentation=segmentation)


def _without_box(config: RopeConfig) -> RopeConfig:
    segmentation = dataclasses.replace(config.segmentation, box_min=None, box_max=None, box_frame="camera")
    return dataclasses.replace(config, segmentation=segmentation)


def _counts(frames: list[Frame], config: RopeConfig) -> FloatArray:
    """How many points of each frame pass."""
    tracker = SlicingTracker(config)
    return np.array([float(tracker.rope_points(frame)[1]) for frame in frames])


def _check_gates(diagnosis: Diagnosis, frames: list[Frame], config: RopeConfig) -> None:
    everything = _counts(frames, _without_box(_without_color(config)))
    boxed = _counts(frames, _without_color(config))
    kept = _counts(frames, config)
    total, in_box, passed = (float(np.median(counts)) for counts in (everything, boxed, kept))
    has_box = config.segmentation.box_min is not None
    if has_box:
        text = f"{in_box:.0f} of {total:.0f} points lie in the position box"
        if in_box < 50:
            diagnosis.add(Grade.BAD, text, _box_advice(frames))
        else:
            diagnosis.add(Grade.GOOD, text)
    if config.asks_for_color:
        text = f"{passed:.0f} of {in_box:.0f} points{' in the box' if has_box else ''} pass the colour gate"
        if passed < 50:
            diagnosis.add(Grade.BAD, text, _color_advice(frames, config))
        elif passed > 0.5 * in_box and in_box > 5000:
            diagnosis.add(
                Grade.WARNING,
                text,
                "most of the scene passes: lower segmentation.color_tolerance, or give a position box",
            )
        else:
            diagnosis.add(Grade.GOOD, text)
    elif not has_box and total > 60000:
        diagnosis.add(
            Grade.BAD,
            f"neither a colour nor a position box is given, and each frame has {total:.0f} points",
            "give --color '#rrggbb', or segmentation.box_min and box_max in the config",
        )


def _box_advice(frames: list[Frame]) -> str:
    points = np.concatenate([SlicingTracker(RopeConfig(0.01)).rope_points(frame)[0].T for frame in frames[:3]])
    if not len(points):
        return "there are no points at all"
    low, high = np.percentile(points, [2, 98], axis=0)
    spans = ", ".join(f"{axis} {a:.2f} to {b:.2f}" for axis, a, b in zip("xyz", low, high, strict=True))
    return f"the scene spans {spans} m in the camera's frame"


def _color_advice(frames: list[Frame], config: RopeConfig) -> str:
    """The tolerance that would let a rope's worth of points pass, or that the colour is not there."""
    for tolerance in (25.0, 30.0, 40.0, 50.0, 60.0):
        if tolerance <= config.segmentation.color_tolerance or config.segmentation.lab_min is not None:
            continue
        wider = dataclasses.replace(
            config, segmentation=dataclasses.replace(config.segmentation, color_tolerance=tolerance)
        )
        passed = float(np.median(_counts(frames, wider)))
        if passed >= 200:
            return (
                f"with segmentation.color_tolerance = {tolerance:g}, {passed:.0f} would pass; better, read the "
                f"rope's colour off the picture{_nearest_color(frames, config)}"
            )
    return "the colour does not occur where there is depth: read the rope's colour off the picture" + _nearest_color(
        frames, config
    )


def _nearest_color(frames: list[Frame], config: RopeConfig) -> str:
    """The scene's own colour of the given hue, as a hint."""
    frame = frames[0]
    colors = colors_of(frame)
    if colors is None or config.color is None:
        return ""
    colors = colors.reshape(-1, 3)[:: max(colors.size // 3 // 50000, 1)]
    wanted = lab_from_rgb(np.array(parse_color(config.color), np.uint8))
    # Hue and chroma tell a rope from its surroundings; brightness is the light's.
    distance = np.linalg.norm((lab_from_rgb(colors) - wanted) * [0.3, 1, 1], axis=1)
    closest = colors[np.argsort(distance)[: max(len(colors) // 500, 5)]]
    bright = closest[np.argmax(closest.sum(axis=1))]
    return f" (the closest in the first frame is '{format_color(bright)}')"


def _gate_picture(frames: list[tuple[int, Frame]], config: RopeConfig) -> Image.Image | None:
    """Some frames, with the pixels that pass the gates as they are and the rest in dim grey."""
    images = [(index, frame) for index, frame in frames if isinstance(frame, RgbdFrame)]
    if not images:
        return None
    tracker = SlicingTracker(config)
    chosen = np.unique(np.linspace(0, len(images) - 1, min(_PICTURES, len(images))).round().astype(int))
    pictures = []
    for index, frame in (images[k] for k in chosen):
        points, count, _ = tracker.rope_points(frame)
        camera = frame.intrinsics
        columns = np.round(points[0] / points[2] * camera.fx + camera.cx).astype(int)
        rows = np.round(points[1] / points[2] * camera.fy + camera.cy).astype(int)
        base = frame.color if frame.color is not None else depth_image(frame)
        shown = np.repeat((base.mean(axis=2) * 0.35)[..., None], 3, axis=2).astype(np.uint8)
        shown[rows, columns] = base[rows, columns] if frame.color is not None else (255, 120, 0)
        pictures.append(captioned(Image.fromarray(shown), f"frame {index}: {count} points pass"))
    return sheet(pictures)


def _check_tracking(diagnosis: Diagnosis, frames: list[Frame], config: RopeConfig) -> None:
    tracker = SlicingTracker(config)
    statuses: Counter[Status] = Counter()
    reasons: Counter[str] = Counter()
    widths: list[float] = []
    pixels: list[float] = []
    lengths: list[float] = []
    for frame in frames:
        try:
            estimate = tracker.update(frame)
        except FrameError as error:
            reasons[str(error)] += 1
            continue
        statuses[estimate.status] += 1
        reasons.update(estimate.reasons)
        if estimate.status is Status.LOST:
            continue
        lengths.append(estimate.waypoints.length)
        widths.append(tracker.seen_diameter)
        if isinstance(frame, RgbdFrame):
            pixels.append(config.diameter * frame.intrinsics.fx / float(np.median(estimate.nodes[:, 2])))
    text = f"tracked: {statuses[Status.OK]} ok, {statuses[Status.DEGRADED]} degraded, {statuses[Status.LOST]} lost"
    if statuses[Status.OK] == len(frames):
        diagnosis.add(Grade.GOOD, f"{text}; length {np.median(lengths):.3f} m")
    else:
        grade = Grade.BAD if statuses[Status.LOST] > len(frames) / 2 else Grade.WARNING
        diagnosis.add(grade, text, "; ".join(reason for reason, _ in reasons.most_common(2)))
    if pixels and np.median(pixels) < 3:
        diagnosis.add(
            Grade.WARNING,
            f"the rope is {np.median(pixels):.1f} pixels wide",
            "move the camera closer or raise its resolution: below 3 pixels the accuracy falls",
        )
    if not widths:
        return
    width = float(np.median(widths))
    text = f"the points are as wide as a tube of {width * 1e3:.1f} mm; {config.diameter * 1e3:.1f} mm are given"
    if width > 1.6 * config.diameter:
        diagnosis.add(Grade.WARNING, text, "give the real diameter; or background beside the rope passes the gate")
    elif width < 0.5 * config.diameter:
        diagnosis.add(
            Grade.WARNING,
            text,
            "give the real diameter; or the gate loses the rope's shaded edges: raise color_tolerance",
        )
    else:
        diagnosis.add(Grade.GOOD, text)
