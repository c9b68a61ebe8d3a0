"""A run over a recording: every event gets its row, sinks see them in order, and the user may interrupt."""

from __future__ import annotations

import signal
from collections.abc import Iterator

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from helpers import RED_TEXT, SHAPES, SMALL, random_rotation, seen
from ropetrace import tracking
from ropetrace.config import RopeConfig
from ropetrace.errors import FrameError, OutputError
from ropetrace.motion.arc_length import ArcLengthMotion
from ropetrace.trackers import SlicingTracker
from ropetrace.trackers.base import Lap, no_lap
from ropetrace.tracking import Summary, ahead_of_time, in_world, track_recording, with_motion
from ropetrace.types import BadFrame, Cloud, Estimate, Event, FloatArray, Frame, Motion, RgbdFrame, Status, Waypoints

HANGING = SHAPES["hanging"]
CONFIG = RopeConfig(diameter=0.012, color=RED_TEXT)


class Keeper:
    """A sink that keeps what it is given, and may be told to fail."""

    def __init__(
        self, log: list[str] | None = None, name: str = "", fail_at: int = -1, error: BaseException | None = None
    ):
        self.rows: list[tuple[int, Estimate, Frame | None, Cloud | None]] = []
        self._log, self._name, self._fail_at, self._error = log, name, fail_at, error

    def write(self, index: int, estimate: Estimate, frame: Frame | None, cloud: Cloud | None) -> None:
        if index == self._fail_at and self._error is not None:
            raise self._error
        self.rows.append((index, estimate, frame, cloud))
        if self._log is not None:
            self._log.append(f"{self._name}{index}")


def good(stamp_ns: int) -> RgbdFrame:
    return seen(HANGING, stamp_ns=stamp_ns)


def colorless(stamp_ns: int) -> RgbdFrame:
    return RgbdFrame(stamp_ns, good(0).depth, 1.0, SMALL)


def run(events: list[Event], *sinks: Keeper, **options: object) -> Summary:
    return track_recording(events, SlicingTracker(CONFIG), sinks, **options)  # type: ignore[arg-type]


def test_every_event_has_its_row_in_order() -> None:
    keeper = Keeper()
    events: list[Event] = [good(10), BadFrame(20, "depth image 1 is damaged"), colorless(30), good(40)]
    summary = run(events, keeper, first_index=7)
    assert [index for index, *_ in keeper.rows] == [7, 8, 9, 10]
    assert [estimate.stamp_ns for _, estimate, *_ in keeper.rows] == [10, 20, 30, 40]
    assert [estimate.status.value for _, estimate, *_ in keeper.rows] == ["ok", "lost", "lost", "ok"]
    assert keeper.rows[1][1].reasons == ("depth image 1 is damaged",)
    assert "frame has none" in keeper.rows[2][1].reasons[0]
    assert [frame for _, _, frame, _ in keeper.rows] == [events[0], None, events[2], events[3]]
    assert (summary.frames, summary.found, summary.interrupted) == (4, 2, False)
    assert summary.ropes[0].statuses == {Status.OK: 2, Status.LOST: 2}


def test_each_frame_goes_to_all_sinks_before_the_next() -> None:
    log: list[str] = []
    run([good(1), good(2)], Keeper(log, "a"), Keeper(log, "b"))
    assert log == ["a0", "b0", "a1", "b1"]


def test_progress_is_told_of_each_frame() -> None:
    told: list[Estimate] = []
    run([good(1), BadFrame(2, "x")], on_frame=told.append)
    assert [estimate.stamp_ns for estimate in told] == [1, 2]


def test_an_empty_recording() -> None:
    summary = run([], Keeper())
    assert (summary.frames, summary.found) == (0, 0)
    assert summary.lines() == ["frames    0 (0 ok, 0 degraded, 0 lost)"]


def test_clouds_are_those_of_their_frame_and_only_on_request() -> None:
    keeper = Keeper()
    run([good(1), BadFrame(2, "x"), colorless(3)], keeper, wants_cloud=True)
    clouds = [cloud for *_, cloud in keeper.rows]
    assert clouds[0] is not None
    assert len(clouds[0].points) == keeper.rows[0][1].point_count > 1000
    assert clouds[1] is None
    assert clouds[2] is None or len(clouds[2].points) == 0, "the points of another frame"
    keeper = Keeper()
    run([good(1)], keeper)
    assert keeper.rows[0][3] is None


# --- interruptions and failures ---


def test_an_interrupted_source_ends_the_run_and_is_told() -> None:
    def source() -> Iterator[Event]:
        yield good(1)
        yield good(2)
        raise KeyboardInterrupt

    keeper = Keeper()
    summary = track_recording(source(), SlicingTracker(CONFIG), [keeper])
    assert summary.interrupted
    assert summary.frames == len(keeper.rows) == 2


@pytest.mark.parametrize("fail_at", [0, 1])
def test_an_interrupted_sink_ends_the_run_and_is_told(fail_at: int) -> None:
    before, after = Keeper(), Keeper()
    summary = run([good(1), good(2), good(3)], before, Keeper(fail_at=fail_at, error=KeyboardInterrupt()), after)
    assert summary.interrupted
    assert summary.frames == len(after.rows) == fail_at
    assert len(before.rows) == fail_at + 1


def test_ctrl_c_while_a_frame_is_written_waits_for_its_other_sinks() -> None:
    class Interrupter(Keeper):
        def write(self, index: int, estimate: Estimate, frame: Frame | None, cloud: Cloud | None) -> None:
            super().write(index, estimate, frame, cloud)
            if index == 1:
                signal.raise_signal(signal.SIGINT)

    first, last = Interrupter(), Keeper()
    summary = run([good(1), good(2), good(3)], first, last)
    assert summary.interrupted
    assert summary.frames == len(first.rows) == len(last.rows) == 2


def test_a_sink_that_cannot_write_ends_the_run_with_its_error() -> None:
    with pytest.raises(OutputError, match="disk full"):
        run([good(1), good(2)], Keeper(fail_at=1, error=OutputError("disk full")))


def test_an_error_of_the_tracker_itself_is_not_hidden() -> None:
    def broken(frame: Frame) -> object:
        raise ZeroDivisionError("a bug")

    with pytest.raises(ZeroDivisionError, match="a bug"):
        track_recording([good(1)], SlicingTracker(CONFIG, broken))  # type: ignore[arg-type]


# --- the world's frame ---


def test_everything_is_handed_on_in_the_worlds_frame() -> None:
    rng = np.random.default_rng(0)
    transform = np.eye(4)
    transform[:3, :3], transform[:3, 3] = random_rotation(rng), [1.0, -2.0, 0.5]
    plain, placed = Keeper(), Keeper()
    events: list[Event] = [good(1), BadFrame(2, "x")]
    run(events, plain, wants_cloud=True)
    run(events, placed, wants_cloud=True, world_from_camera=transform)
    (_, camera, _, camera_cloud), (_, world, _, world_cloud) = plain.rows[0], placed.rows[0]
    assert camera_cloud is not None
    assert world_cloud is not None

    def moved(points: np.ndarray) -> np.ndarray:
        return np.asarray((np.column_stack([points, np.ones(len(points))]) @ transform.T)[:, :3])

    np.testing.assert_allclose(world.nodes, moved(camera.nodes), atol=1e-12)
    np.testing.assert_allclose(world.waypoints.positions, moved(camera.waypoints.positions), atol=1e-12)
    np.testing.assert_allclose(world_cloud.points, moved(camera_cloud.points), atol=1e-12)
    np.testing.assert_array_equal(world_cloud.node, camera_cloud.node)
    np.testing.assert_allclose(
        Rotation.from_quat(world.waypoints.quaternions).as_matrix(),
        transform[:3, :3] @ Rotation.from_quat(camera.waypoints.quaternions).as_matrix(),
        atol=1e-9,
    )
    assert (world.status, world.stamp_ns, world.point_count) == (camera.status, camera.stamp_ns, camera.point_count)
    assert len(placed.rows[1][1].nodes) == 0


def test_the_motion_turns_with_the_rope() -> None:
    quarter = np.array([[0.0, -1, 0, 5], [1, 0, 0, 6], [0, 0, 1, 7], [0, 0, 0, 1]])
    vectors, sigmas = np.array([[1.0, 2.0, 3.0], [-4.0, 5.0, 6.0]]), np.array([[0.1, 0.2, 0.3], [0.4, 0.5, 0.6]])
    waypoints = Waypoints(vectors, np.tile([0.0, 0, 0, 1], (2, 1)), np.array([0.0, 1.0]))
    motion = Motion(vectors, 10 * vectors, sigmas, 2 * sigmas, 3 * sigmas)
    world = in_world(Estimate(3, Status.OK, waypoints=waypoints, motion=motion, ahead_ns=25), quarter)
    turned, swapped = np.array([[-2.0, 1, 3], [-5, -4, 6]]), np.array([[0.2, 0.1, 0.3], [0.5, 0.4, 0.6]])
    assert world.motion is not None
    np.testing.assert_array_equal(world.waypoints.positions, turned + [5, 6, 7])
    np.testing.assert_array_equal(world.motion.velocities, turned)
    np.testing.assert_array_equal(world.motion.accelerations, 10 * turned)
    np.testing.assert_allclose(world.motion.position_sigma, swapped, rtol=1e-15)
    np.testing.assert_allclose(world.motion.velocity_sigma, 2 * swapped, rtol=1e-15)
    np.testing.assert_allclose(world.motion.acceleration_sigma, 3 * swapped, rtol=1e-15)
    assert world.ahead_ns == 25


def test_a_motion_that_is_not_known_stays_so_in_the_world() -> None:
    waypoints = Waypoints(np.zeros((2, 3)), np.tile([0.0, 0, 0, 1], (2, 1)), np.array([0.0, 1.0]))
    assert in_world(Estimate(3, Status.OK, waypoints=waypoints), np.eye(4)).motion is None


def test_a_lost_estimate_stays_lost_in_the_world() -> None:
    lost = in_world(Estimate.lost(3, "why", 5), np.eye(4))
    assert (lost.status, lost.reasons, lost.nodes.shape, lost.point_count) == (Status.LOST, ("why",), (0, 3), 5)


def test_what_the_tracker_tells_of_the_waypoints_passes_all_steps() -> None:
    waypoints = Waypoints(np.eye(3), np.tile([0.0, 0, 0, 1], (3, 1)), np.arange(3.0))
    seen, sigma, motion = np.array([True, False, True]), np.array([0.001, 0.02, 0.0]), Recorder()
    estimate = Estimate(1, Status.OK, waypoints=waypoints, seen=seen, position_sigma=sigma, rope=4)
    estimate = with_motion(with_motion(estimate, motion), motion)
    estimate = in_world(ahead_of_time(estimate, motion, 0.1), np.diag([-1.0, -1, 1, 1]))
    assert (estimate.ahead_ns, estimate.rope) == (100_000_000, 4)
    np.testing.assert_array_equal(estimate.waypoints.positions[0], [-1.1, 0, 0])
    assert estimate.seen is seen
    assert estimate.position_sigma is sigma


# --- several ropes ---


class Pair:
    """A tracker of two ropes, the second as far down as its stamp in metres; it finds no second rope at first."""

    def update(self, frame: Frame | BadFrame, lap: Lap = no_lap) -> Estimate:
        return self.update_all(frame, lap)[0]

    def update_all(self, frame: Frame | BadFrame, lap: Lap = no_lap) -> tuple[Estimate, ...]:
        if isinstance(frame, BadFrame):
            raise FrameError(frame.reason)
        stamp = frame.stamp_ns
        first = Estimate(stamp, Status.OK, waypoints=self._straight(0), point_count=7)
        if stamp == 1:
            return (first,)
        return first, Estimate(stamp, Status.DEGRADED, ("a part is hidden",), waypoints=self._straight(stamp), rope=1)

    def cloud(self) -> Cloud:
        return Cloud(np.ones((5, 3)), np.zeros(5, np.int32))

    def reset(self) -> None:
        raise NotImplementedError

    def _straight(self, down: float) -> Waypoints:
        places = np.array([[0.0, down, 1], [0.5, down, 1]])
        return Waypoints(places, np.tile([0.0, 0, 0, 1], (2, 1)), np.array([0.0, 0.5]))


def test_each_rope_is_handed_on_with_a_motion_of_its_own() -> None:
    log: list[str] = []
    first, second = Keeper(log, "a"), Keeper(log, "b")
    motions = [Recorder(), Recorder()]
    made = iter(motions)
    told: list[Estimate] = []
    summary = track_recording(
        [good(1), good(2), good(3)],
        Pair(),
        [first, second],
        motion=lambda: next(made),
        predict=0.5,
        wants_cloud=True,
        on_frame=told.append,
    )
    assert log == ["a0", "b0", "a1", "a1", "b1", "b1", "a2", "a2", "b2", "b2"]
    assert [(estimate.stamp_ns, estimate.rope) for _, estimate, *_ in first.rows] == [
        (1, 0),
        (2, 0),
        (2, 1),
        (3, 0),
        (3, 1),
    ]
    assert [motion.told for motion in motions] == [[1, 2, 3], [2, 3]]
    assert [estimate.motion is not None for _, estimate, *_ in first.rows] == [False, True, False, True, True]
    np.testing.assert_array_equal(first.rows[4][1].waypoints.positions, [[0.5, 3, 1], [1.0, 3, 1]])
    assert first.rows[3][3] is first.rows[4][3]
    assert [estimate.rope for estimate in told] == [0, 0, 0]
    assert (summary.frames, summary.found) == (3, 5)
    lines = summary.lines()
    assert lines[:5] == [
        "frames    3",
        "rope 0    3 ok, 0 degraded, 0 lost",
        "points    7 a frame (median)",
        "nodes     0 a frame (median)",
        "length    0.500 m (median), 0.500 to 0.500 m",
    ]
    assert lines[5:7] == ["rope 1    0 ok, 2 degraded, 0 lost", "          2 x a part is hidden"]


def test_a_frame_that_cannot_be_used_is_lost_for_every_rope() -> None:
    keeper = Keeper()
    track_recording([BadFrame(1, "x"), good(2), BadFrame(3, "y")], Pair(), [keeper])
    assert [(estimate.rope, str(estimate.status), estimate.reasons) for _, estimate, *_ in keeper.rows] == [
        (0, "lost", ("x",)),
        (0, "ok", ()),
        (1, "degraded", ("a part is hidden",)),
        (0, "lost", ("y",)),
        (1, "lost", ("y",)),
    ]


def test_one_estimator_of_motion_does_not_serve_two_ropes() -> None:
    with pytest.raises(ValueError, match="rope 1 needs an estimator of motion of its own"):
        track_recording([good(2)], Pair(), motion=Recorder())


def test_ropes_may_have_no_motion() -> None:
    keeper = Keeper()
    track_recording([good(2)], Pair(), [keeper], motion=lambda: None, predict=0.5)
    assert [(estimate.motion, estimate.ahead_ns) for _, estimate, *_ in keeper.rows] == [(None, 0), (None, 0)]


# --- motion ---


class Recorder:
    """An estimator of motion that keeps what it is told and moves everything by 1 m/s along x."""

    def __init__(self) -> None:
        self.told: list[int] = []
        self.ahead: list[float] = []

    stamp_ns: int | None = None

    def update(self, stamp_ns: int, waypoints: Waypoints) -> Motion | None:
        self.told.append(stamp_ns)
        self._places = waypoints.positions
        return self._motion() if len(self.told) > 1 else None

    def predict(self, ahead: float) -> tuple[FloatArray, Motion] | None:
        self.ahead.append(ahead)
        return self._places + [ahead, 0, 0], self._motion()

    def reset(self) -> None:
        raise NotImplementedError

    def _motion(self) -> Motion:
        ones = np.ones_like(self._places)
        return Motion(ones * [1.0, 0, 0], 0 * ones, ones, ones, ones)


def moving(stamps: list[int]) -> list[Event]:
    return [BadFrame(stamp, "x") if stamp < 0 else good(stamp) for stamp in stamps]


def test_motion_is_added_to_frames_that_have_a_rope_and_nothing_else_changes() -> None:
    plain, known, motion = Keeper(), Keeper(), Recorder()
    stamps = [10, -20, 30, 40]
    run(moving(stamps), plain)
    summary = run(moving(stamps), known, motion=motion)
    assert motion.told == [10, 30, 40]
    assert motion.ahead == []
    assert [estimate.motion is not None for _, estimate, *_ in known.rows] == [False, False, True, True]
    for (_, before, *_), (_, after, *_) in zip(plain.rows, known.rows, strict=True):
        np.testing.assert_array_equal(before.waypoints.positions, after.waypoints.positions)
        assert (after.ahead_ns, after.status) == (0, before.status)
    assert len(summary.stage_seconds["motion"]) == 4


def test_a_prediction_moves_the_waypoints_but_not_the_nodes_or_the_stamp() -> None:
    now, later = Keeper(), Keeper()
    run(moving([10, 20]), now, motion=Recorder())
    run(moving([10, 20]), later, motion=Recorder(), predict=0.05)
    (_, first, *_), (_, second, *_) = later.rows
    assert (first.ahead_ns, first.motion) == (0, None), "the first frame has no motion and is handed on as it is"
    np.testing.assert_array_equal(first.waypoints.positions, now.rows[0][1].waypoints.positions)
    before = now.rows[1][1]
    assert (second.ahead_ns, second.stamp_ns) == (50_000_000, 20)
    np.testing.assert_allclose(second.waypoints.positions, before.waypoints.positions + [0.05, 0, 0])
    np.testing.assert_array_equal(second.nodes, before.nodes)
    turned = Rotation.from_quat(second.waypoints.quaternions) * Rotation.from_quat(before.waypoints.quaternions).inv()
    assert np.degrees(turned.magnitude().max()) < 3


def test_a_prediction_for_now_reaches_as_far_as_the_frame_took() -> None:
    keeper, motion = Keeper(), Recorder()
    run(moving([10, 20, 30]), keeper, motion=motion, predict="now")
    assert len(motion.ahead) == 2
    assert all(1e-5 < ahead < 5 for ahead in motion.ahead)
    assert [row[1].ahead_ns for row in keeper.rows] == [0, *(round(ahead * 1e9) for ahead in motion.ahead)]


def test_a_lost_estimate_has_no_motion_and_is_not_told() -> None:
    motion, lost = Recorder(), Estimate.lost(3, "why")
    assert with_motion(lost, motion) is lost
    assert ahead_of_time(lost, motion, 0.1) is lost
    assert (motion.told, motion.ahead) == ([], [])


def test_an_estimator_that_knows_nothing_of_later_leaves_the_estimate_as_it_is() -> None:
    class Silent(Recorder):
        def predict(self, ahead: float) -> tuple[FloatArray, Motion] | None:
            return None

    waypoints = Waypoints(np.eye(3)[:2], np.tile([0.0, 0, 0, 1], (2, 1)), np.array([0.0, 1.0]))
    motion = Silent()
    estimate = with_motion(with_motion(Estimate(1, Status.OK, waypoints=waypoints), motion), motion)
    assert estimate.motion is not None
    assert ahead_of_time(estimate, motion, 0.1) is estimate


def test_the_motion_and_the_prediction_of_a_rope_that_is_carried_along() -> None:
    """Through the tracker: 0.3 m/s along x at 30 frames a second."""
    keeper = Keeper()
    carried: list[Event] = [seen(HANGING + [0.01 * k, 0, 0], stamp_ns=k * 33_333_333) for k in range(12)]
    run(carried, keeper, motion=ArcLengthMotion(CONFIG.diameter), predict=0.04)
    last = keeper.rows[-1][1]
    assert last.motion is not None
    np.testing.assert_allclose(last.motion.velocities.mean(axis=0), [0.3, 0, 0], atol=0.03)
    still = Keeper()
    run([seen(HANGING + [0.01 * 11 + 0.3 * 0.04, 0, 0])], still)
    truth = still.rows[0][1].waypoints.positions
    middles = last.waypoints.positions.mean(axis=0), truth.mean(axis=0)
    np.testing.assert_allclose(*middles, atol=0.002)


# --- the summary ---


def test_stages_are_timed_for_the_frames_that_reached_them() -> None:
    summary = run([good(1), BadFrame(2, "x"), colorless(3), good(4)], Keeper())
    counts = {stage: len(seconds) for stage, seconds in summary.stage_seconds.items()}
    assert counts == {"read": 4, "segmentation": 2, "slicing": 2, "ordering": 2, "centerline": 2, "write": 4}
    assert all(second >= 0 for seconds in summary.stage_seconds.values() for second in seconds)
    assert "write" not in run([good(1)]).stage_seconds


def test_the_summary_counts_like_reasons_together() -> None:
    summary = Summary()
    for index in range(3):
        summary.add(Estimate.lost(index, f"too few points ({index})"))
    summary.add(Estimate.lost(9, "something else"))
    assert summary.ropes[0].reasons.most_common(1) == [("too few points #", 3)]
    lines = summary.lines()
    assert lines[0] == "frames    4 (0 ok, 0 degraded, 4 lost)"
    assert lines[1].endswith("3 x too few points #")


def test_the_summary_tells_lengths_and_times() -> None:
    text = "\n".join(run([good(1), good(2)], Keeper()).lines())
    for word in ("2 ok", "points    ", "nodes     ", "length    0.6", "segmentation", "p99 ms", "write"):
        assert word in text


def test_a_run_without_an_end_keeps_the_figures_of_its_last_frames(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tracking, "MOST_KEPT", 3)
    summary = run([good(stamp) for stamp in range(1, 6)])
    assert summary.frames == summary.found == summary.ropes[0].statuses[Status.OK] == 5
    kept = [*summary.stage_seconds.values(), summary.ropes[0].lengths, summary.ropes[0].nodes]
    assert {len(figures) for figures in kept} == {3}
    text = "\n".join(summary.lines())
    assert "are of the last 3 frames" in text
    assert "first two frames" not in text
