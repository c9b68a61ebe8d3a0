from __future__ import annotations

import dataclasses
import queue
import subprocess
import sys
import threading
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow
import pytest
from rerun.chunk import RrdReader
from scipy.spatial.transform import Rotation

from result_examples import FIRST_STAMP, REASONS, cloud, estimate, frame, helix, motion, told
from ropetrace.errors import OutputError
from ropetrace.results import feed, live, open_writer
from ropetrace.results.feed import Feed, RerunProcess, stop_rerun
from ropetrace.results.live import LiveViewer
from ropetrace.results.rrd import RrdWriter
from ropetrace.types import Cloud, CloudFrame, Estimate, Frame, Status, Waypoints
from ropetrace.viewer import CLOUD_POINTS, IMAGE_WIDTH, NO_NODE_COLOR, ArmView, RerunLog, new_recording
from ropetrace.viewer_shapes import AXES, NODE_COLORS, VELOCITY_COLOR, VELOCITY_SECONDS, rope_color

PATIENCE = 60.0

Rows = dict[str, dict[int | None, dict[str, Any]]]


def logged(path: Path, *steps: tuple[Estimate, Frame | None, Cloud | None], **options: Any) -> Rows:
    """Write a recording and read it back: by entity, then by frame (None: static), the components."""
    with open_writer(path, **options) as writer:
        for index, (item, seen, points) in enumerate(steps):
            writer.write(index, item, seen, points)
    return read_back(path)


def read_back(path: Path) -> Rows:
    rows: Rows = {}
    for chunk in RrdReader(path).stream():
        batch = chunk.to_record_batch()
        if "time" in batch.schema.names:
            column = batch.schema.get_field_index("time")
            batch = batch.set_column(column, "time", batch.column(column).cast(pyarrow.int64()))
        for row in batch.to_pylist():
            row.pop("rerun.controls.RowId")
            # An entity may be logged twice a frame, a Clear among them.
            rows.setdefault(chunk.entity_path, {}).setdefault(row.get("frame"), {}).update(row)
    return rows


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "run.rrd"


def rgb(values: list[int]) -> list[tuple[int, ...]]:
    """Rerun's 0xRRGGBBAA as triples."""
    return [(value >> 24, value >> 16 & 255, value >> 8 & 255) for value in values]


def test_every_picture_of_a_frame_is_there(path: Path) -> None:
    item = estimate(1)
    rows = logged(path, (item, frame(1), cloud(1)), metadata={"config": "diameter = 0.012"})
    assert {
        "/",
        "/camera",
        "/camera/image",
        "/camera/depth",
        "/rope",
        "/rope/cloud",
        "/rope/nodes",
        "/rope/centerline",
        "/rope/axes",
        "/rope/velocity",
        "/status",
        "/plots/length",
        "/plots/speed",
        "/plots/point_count",
        "/metadata/config",
    } <= set(rows)
    (strip,) = rows["/rope/centerline"][0]["LineStrips3D:strips"]
    assert np.allclose(strip, item.waypoints.positions, atol=1e-6)
    assert np.allclose(rows["/rope/nodes"][0]["Points3D:positions"], item.nodes, atol=1e-6)
    assert rows["/plots/length"][0]["Scalars:scalars"] == [item.waypoints.length]
    assert rows["/plots/point_count"][0]["Scalars:scalars"] == [item.point_count]
    assert rows["/metadata/config"][None]["TextDocument:text"] == ["diameter = 0.012"]
    assert rows["/camera/image"][0]["EncodedImage:media_type"] == ["image/jpeg"]
    assert rows["/camera/depth"][0]["DepthImage:meter"] == [1000.0]


def test_the_timelines_are_the_index_and_the_stamp(path: Path) -> None:
    rows = logged(path, *((estimate(index), None, None) for index in range(3)))
    for index, row in rows["/plots/length"].items():
        assert set(row) == {"frame", "time", "Scalars:scalars"}
        assert index is not None
        assert row["time"] == FIRST_STAMP + index * 33_333_333


def test_a_lost_frame_clears_the_rope(path: Path) -> None:
    rows = logged(path, *((estimate(index), frame(index), cloud(index)) for index in range(6)))
    assert estimate(4).waypoints.positions.size == 0
    assert rows["/rope"][4]["Clear:is_recursive"] == [True]
    for name in ("centerline", "nodes", "axes"):
        assert set(rows[f"/rope/{name}"]) == {0, 1, 2, 3, 5}
    # What was segmented is what one wants to see then.
    assert 4 in rows["/rope/cloud"]
    assert rows["/plots/length"][4]["Scalars:scalars"] == [0.0]


def test_seen_and_hidden_parts_are_apart(path: Path) -> None:
    """Hidden: the waypoints 18 to 31 of 50, with a step to the seen one at either side."""
    item = told(1)
    rows = logged(path, (item, None, None))
    strips = [np.array(strip) for strip in rows["/rope/centerline"][0]["LineStrips3D:strips"]]
    places = item.waypoints.positions
    assert item.seen is not None
    assert np.flatnonzero(~item.seen).tolist() == list(range(18, 32))
    for strip, expected in zip(strips, (places[:18], places[32:]), strict=True):
        np.testing.assert_allclose(strip, expected, atol=1e-6)
    # Dashes from end to end, dark and light in turn.
    dashes = np.array(rows["/rope/hidden"][0]["LineStrips3D:strips"])
    np.testing.assert_allclose(dashes, np.stack([places[17:32], places[18:33]], axis=1), atol=1e-6)
    shades = rgb(rows["/rope/hidden"][0]["LineStrips3D:colors"])
    assert all(max(shade) < 50 for shade in shades[1::2])
    assert all(min(shade) > 150 for shade in shades[::2])
    assert rgb(rows["/rope/centerline"][0]["LineStrips3D:colors"]) == [tuple(rope_color(0))]


def test_a_live_log_spares_its_viewers_and_tells_those_who_come_late(path: Path) -> None:
    """Six seconds of 30 Hz: all in the plots, every second one shown, two depth images a second, the status twice."""
    recording = new_recording()
    recording.save(path)
    log = RerunLog(recording, live=True)
    for index in range(180):
        reasons = (f"{index} % of the rope is hidden",)
        item = dataclasses.replace(estimate(3), stamp_ns=FIRST_STAMP + index * 33_333_333, reasons=reasons)
        log.log(index, item, frame(index), cloud(index))
    recording.disconnect()
    rows = read_back(path)
    assert set(rows["/plots/length"]) == set(range(180))
    for name in ("camera/image", "rope/cloud", "rope/centerline", "rope"):
        assert set(rows[f"/{name}"]) == set(range(0, 180, 2)), name
    assert set(rows["/camera/depth"]) == set(range(0, 180, 14))
    assert set(rows["/status"]) == {0, 136}
    # What is static is not dropped with the oldest.
    assert set(rows["/camera"]) == {None}
    assert "Pinhole:resolution" in rows["/camera"][None]


@pytest.mark.parametrize("step_ns", [0, -33_333_333])
def test_stamps_that_do_not_rise_do_not_freeze_a_live_log(path: Path, step_ns: int) -> None:
    """The last of the four that rise is too early to be shown again."""
    recording = new_recording()
    recording.save(path)
    log = RerunLog(recording, live=True)
    stamps = [0, 33_333_333, 66_666_667, 100_000_000, *(100_000_000 + step_ns * index for index in range(1, 6))]
    for index, stamp in enumerate(stamps):
        item = dataclasses.replace(estimate(3), stamp_ns=FIRST_STAMP + stamp)
        log.log(index, item, dataclasses.replace(frame(index), stamp_ns=FIRST_STAMP + stamp), cloud(index))
    recording.disconnect()
    rows = read_back(path)
    assert set(rows["/rope/centerline"]) == {0, 2, 4, 5, 6, 7, 8}
    assert {0, 5, 6, 7, 8} <= set(rows["/camera/depth"])


def test_rings_are_as_wide_as_the_trackers_sigma_across_the_hidden_part(path: Path) -> None:
    item = told(1)
    rows = logged(path, (item, None, None))
    rings = np.array(rows["/rope/sigma"][0]["LineStrips3D:strips"])
    assert item.seen is not None
    assert item.position_sigma is not None
    spokes = rings - item.waypoints.positions[~item.seen, None]
    radii = np.linalg.norm(spokes, axis=2)
    np.testing.assert_allclose(radii, np.tile(item.position_sigma[~item.seen, None], radii.shape[1]), atol=1e-6)
    along = Rotation.from_quat(item.waypoints.quaternions[~item.seen]).apply([1, 0, 0])
    np.testing.assert_allclose(np.einsum("kcd,kd->kc", spokes, along), 0, atol=1e-6)
    np.testing.assert_allclose(rings[:, 0], rings[:, -1], atol=1e-6)


def test_where_the_tracker_does_not_tell_all_is_the_centreline(path: Path) -> None:
    seen = np.ones(50, bool)
    silent, whole = estimate(1), dataclasses.replace(told(2), seen=seen)
    hidden, unsure = dataclasses.replace(told(3), seen=~seen), dataclasses.replace(told(5), seen=None)
    rows = logged(path, *((item, None, None) for item in (silent, whole, hidden, unsure)))
    assert set(rows["/rope/centerline"]) == {0, 1, 3}
    assert set(rows["/rope/hidden"]) == {2}
    assert {index: len(row["LineStrips3D:strips"]) for index, row in rows["/rope/sigma"].items()} == {2: 50, 3: 50}


def test_each_rope_has_its_own_entities_name_and_colour(path: Path) -> None:
    ropes = [(0, told(0)), (0, told(3, 1)), (1, told(1)), (2, told(2)), (2, told(2, 1))]
    with open_writer(path) as writer:
        for index, item in ropes:
            writer.write(index, item, frame(index), cloud(index))
    rows = read_back(path)
    assert set(rows["/rope/centerline"]) == {0, 1, 2}
    assert set(rows["/rope_1/centerline"]) == set(rows["/rope_1/hidden"]) == {0, 2}
    # The second rope is not in frame 1: what there was of it goes.
    assert rows["/rope_1"][1]["Clear:is_recursive"] == [True]
    assert rows["/rope/name"][0]["Points3D:labels"] == ["rope 0"]
    assert rows["/rope_1/name"][0]["Points3D:labels"] == ["rope 1: degraded"]
    assert rows["/rope_1/name"][2]["Points3D:labels"] == ["rope 1"]
    assert rgb(rows["/rope_1/centerline"][0]["LineStrips3D:colors"]) == [tuple(rope_color(1))]
    assert tuple(rope_color(0)) != tuple(rope_color(1))
    assert rows["/plots/length/rope_1"][2]["Scalars:scalars"] == [told(2).waypoints.length]
    assert rows["/plots/length/rope_1"][None]["SeriesLines:names"] == ["rope 1"]
    assert rows["/plots/length"][None]["SeriesLines:names"] == ["rope 0"]
    assert rows["/status/rope_1"][0]["TextLog:text"] == [f"rope 1: degraded: {'; '.join(REASONS)}"]
    assert rows["/status/rope_1"][2]["TextLog:text"] == ["rope 1: ok"]


def test_the_images_of_a_frame_are_logged_once(path: Path) -> None:
    with open_writer(path) as writer:
        for rope in range(3):
            writer.write(0, told(0, rope), frame(0), cloud(0))
    chunks = [chunk.to_record_batch() for chunk in RrdReader(path).stream() if chunk.entity_path == "/camera/image"]
    assert sum(chunk.num_rows for chunk in chunks) == 1
    assert {"/rope/cloud", "/rope/centerline", "/rope_1/centerline", "/rope_2/centerline"} <= set(read_back(path))


def test_arrows_point_where_the_rope_moves(path: Path) -> None:
    item = Estimate(FIRST_STAMP, Status.OK, waypoints=helix(1, 100), motion=motion(1, 100))
    rows = logged(path, (item, None, None))
    row = rows["/rope/velocity"][0]
    assert item.motion is not None
    step = 9
    assert 100 / step <= AXES
    assert np.allclose(row["Arrows3D:origins"], item.waypoints.positions[::step], atol=1e-6)
    assert np.allclose(row["Arrows3D:vectors"], VELOCITY_SECONDS * item.motion.velocities[::step], atol=1e-6)
    assert rgb(row["Arrows3D:colors"]) == [VELOCITY_COLOR]
    # Each at a waypoint that has its axes.
    assert np.array_equal(rows["/rope/axes"][0]["Arrows3D:origins"][::3], row["Arrows3D:origins"])


def test_the_speed_is_that_of_the_fastest_waypoint(path: Path) -> None:
    velocities = np.zeros((50, 3))
    velocities[7], velocities[20] = [0.0, -3.0, 4.0], [4.5, 0.0, 0.0]
    item = dataclasses.replace(estimate(1), motion=dataclasses.replace(motion(1), velocities=velocities))
    rows = logged(path, (item, None, None))
    assert rows["/plots/speed"][0]["Scalars:scalars"] == [5.0]


def test_an_arm_stands_where_it_is(path: Path) -> None:
    starts = np.array([[0.0, 0.0, 0.0], [1.0, 2.0, 3.0], [0.0, 0.0, 1.0], [2.0, 2.0, 2.0]])
    ends = starts + np.array([[0.3, -0.1, 0.2], [0.0, 0.0, -0.5], [0.0, 0.0, 0.4], [0.0, 0.0, 0.0]])
    arm = ArmView(starts, ends, np.array([0.01, 0.02, 0.03, 0.04]), np.eye(4), 0.002)
    with RrdWriter(path, overwrite=False, frame_name="world", metadata={}, arm=True) as writer:
        writer.write(0, estimate(0), None, None, arm)
    rows = read_back(path)
    links = rows["/arm/links"][0]
    turns = Rotation.from_quat(np.array(links["Capsules3D:quaternions"]))
    reach = turns.apply([0, 0, 1]) * np.array(links["Capsules3D:lengths"])[:, None]
    np.testing.assert_allclose(np.array(links["Capsules3D:translations"]) + reach, ends, atol=1e-6)
    np.testing.assert_allclose(links["Capsules3D:radii"], arm.radii, rtol=1e-6)
    assert rows["/plots/tool_distance"][0]["Scalars:scalars"] == [0.002]


def test_a_motion_that_is_not_known_is_not_drawn(path: Path) -> None:
    nothing = Estimate(FIRST_STAMP, Status.LOST, waypoints=Waypoints.none(), motion=motion(0, 0))
    rows = logged(path, *((estimate(index), None, None) for index in range(6)), (nothing, None, None))
    assert set(rows["/rope/velocity"]) == {1, 2, 3}
    speeds = rows["/plots/speed"]
    assert {index for index, row in speeds.items() if row.get("Scalars:scalars")} == {1, 2, 3}
    assert {index for index, row in speeds.items() if row.get("Clear:is_recursive") == [False]} == {0, 4, 5, 6}


def test_a_frame_without_an_image_clears_the_image(path: Path) -> None:
    rows = logged(path, (estimate(0), frame(0), None), (estimate(1), None, None))
    for name in ("image", "depth"):
        assert rows[f"/camera/{name}"][1]["Clear:is_recursive"] == [False]


def test_the_status_is_told_when_it_changes(path: Path) -> None:
    rows = logged(path, *((estimate(index), None, None) for index in range(6)))
    status = {index: (row["TextLog:level"], row["TextLog:text"]) for index, row in rows["/status"].items()}
    assert status == {
        0: (["INFO"], ["ok"]),
        3: (["WARN"], [f"degraded: {'; '.join(REASONS)}"]),
        4: (["ERROR"], ["lost: too few points (3 < 25)"]),
        5: (["INFO"], ["ok"]),
    }


def test_depth_alone_takes_the_place_of_the_colour(path: Path) -> None:
    rows = logged(path, (estimate(0), frame(0, color=False), None))
    assert rows["/camera/image"][0]["DepthImage:meter"] == [1000.0]
    assert "/camera/depth" not in rows


@pytest.mark.parametrize("width", [IMAGE_WIDTH, IMAGE_WIDTH + 1, 1280])
def test_the_projection_fits_the_thinned_image(path: Path, width: int) -> None:
    seen = frame(0, width=width, height=90)
    camera = seen.intrinsics
    rows = logged(path, (estimate(0), seen, None))
    shown = rows["/camera/depth"][0]["DepthImage:format"][0]
    pinhole = rows["/camera"][0]
    assert pinhole["Pinhole:resolution"] == [[shown["width"], shown["height"]]]
    assert shown["width"] <= IMAGE_WIDTH
    matrix = np.reshape(pinhole["Pinhole:image_from_camera"], (3, 3)).T
    # The pixel (column, row) of the thinned image is the pixel (step * column, step * row) of the camera.
    step = -(-width // IMAGE_WIDTH)
    point = np.array([0.11, -0.05, 0.9])
    column = camera.fx * point[0] / point[2] + camera.cx
    row = camera.fy * point[1] / point[2] + camera.cy
    projected = (matrix @ point)[:2] / point[2]
    assert np.allclose(projected, [column / step + 0.5, row / step + 0.5], atol=1e-3)


def test_the_camera_is_logged_once(path: Path) -> None:
    rows = logged(path, *((estimate(index), frame(index), None) for index in range(3)))
    assert set(rows["/camera"]) == {None, 0}


def test_points_have_the_colour_of_their_node(path: Path) -> None:
    points = cloud(0)
    rows = logged(path, (estimate(0), None, points))
    shown = rgb(rows["/rope/cloud"][0]["Points3D:colors"])
    assert shown[0] == NO_NODE_COLOR
    for color, node in zip(shown, points.node, strict=True):
        assert color == (tuple(NODE_COLORS[node]) if node >= 0 else NO_NODE_COLOR)
    assert rgb(rows["/rope/nodes"][0]["Points3D:colors"])[:2] == [tuple(color) for color in NODE_COLORS[:2]]


def test_pictures_stay_small(path: Path) -> None:
    many = Cloud(np.zeros((10 * CLOUD_POINTS + 1, 3)), np.zeros(10 * CLOUD_POINTS + 1, np.int32))
    scene = CloudFrame(FIRST_STAMP, np.zeros((200_001, 3), np.float32), np.zeros((200_001, 3), np.uint8))
    rows = logged(
        path, (estimate(0), scene, many), (estimate(1), scene, Cloud(np.empty((0, 3)), np.empty(0, np.int32)))
    )
    assert len(rows["/rope/cloud"][0]["Points3D:positions"]) <= CLOUD_POINTS
    assert len(rows["/rope/cloud"][0]["Points3D:colors"]) == len(rows["/rope/cloud"][0]["Points3D:positions"])
    assert len(rows["/scene"][0]["Points3D:positions"]) <= 50_000
    assert len(rows["/rope/axes"][0]["Arrows3D:vectors"]) <= 3 * AXES


def test_in_another_frame_the_camera_has_its_pose(path: Path) -> None:
    pose = np.array([[0.0, 0, 1, 1], [-1, 0, 0, 2], [0, -1, 0, 3], [0, 0, 0, 1]])
    rows = logged(path, (estimate(0), frame(0), None), frame_name="world", frame_from_camera=pose)
    assert rows["/camera"][None]["Transform3D:translation"] == [[1.0, 2.0, 3.0]]
    assert np.array_equal(np.reshape(rows["/camera"][None]["Transform3D:mat3x3"], (3, 3)).T, pose[:3, :3])


def test_without_the_pose_the_image_is_not_placed(path: Path) -> None:
    rows = logged(path, (estimate(0), frame(0), None), frame_name="world")
    assert "/camera" not in rows
    assert "/camera/image" in rows


def test_rerun_finds_nothing_wrong_with_the_file(path: Path) -> None:
    logged(path, *((estimate(index), frame(index), cloud(index)) for index in range(10)))
    done = subprocess.run(
        [sys.executable, "-m", "rerun_cli", "rrd", "verify", path], capture_output=True, text=True, check=False
    )
    assert "verified without error" in done.stdout + done.stderr


def test_without_a_screen_there_is_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("DISPLAY", "WAYLAND_DISPLAY", "WAYLAND_SOCKET"):
        monkeypatch.delenv(name, raising=False)
    with pytest.raises(OutputError, match=r"no screen for the viewer: .*--out run\.rrd"):
        LiveViewer()


def test_a_screen_that_is_not_there_is_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("DISPLAY", ":987")
    with pytest.raises(OutputError, match=r"did not start \(.*: write the pictures to a file") as raised:
        LiveViewer()
    assert "\n" not in str(raised.value)


@pytest.fixture
def viewer() -> Iterator[LiveViewer]:
    try:
        viewer = LiveViewer(arguments=("--headless",))
    except OutputError as error:
        pytest.skip(f"no software renderer here: {error}")
    yield viewer
    viewer.close(keep_window=False)


def listening(port: int) -> set[str]:
    """The local addresses, as the kernel writes them, on which something listens at a port."""
    found = set()
    for table in ("/proc/net/tcp", "/proc/net/tcp6"):
        for line in Path(table).read_text().splitlines()[1:]:
            _, local, _, state, *_ = line.split()
            address, local_port = local.split(":")
            if state == "0A" and int(local_port, 16) == port:
                found.add(address)
    return found


class Slow:
    """Takes pictures, and holds the first one until `release`."""

    def __init__(self) -> None:
        self.shown: list[tuple[int, int]] = []
        self.entered, self.release = threading.Event(), threading.Event()

    def log(self, index: int, item: Estimate, *_: Any) -> None:
        self.entered.set()
        assert self.release.wait(PATIENCE), "the caller waits for the picture"
        self.shown.append((index, item.rope))


def test_a_feed_never_makes_its_caller_wait() -> None:
    slow = Slow()
    fed = Feed("viewer", new_recording(), slow.log, lambda: True)
    fed.write(0, estimate(0))
    assert slow.entered.wait(PATIENCE)
    for index in range(1, 50):
        fed.write(index, estimate(index))
    assert fed.running
    slow.release.set()
    fed.stop(PATIENCE)
    fed.stop(PATIENCE)
    assert slow.shown == [(0, 0), (49, 0)]
    assert fed.skipped == 48
    assert not fed.running


def test_the_ropes_of_a_frame_are_shown_together() -> None:
    slow = Slow()
    fed = Feed("viewer", new_recording(), slow.log, lambda: True)
    fed.write(0, told(0, 0))
    assert slow.entered.wait(PATIENCE)
    for index in range(1, 10):
        for rope in range(2):
            fed.write(index, told(index, rope))
    slow.release.set()
    fed.stop(PATIENCE)
    assert slow.shown == [(0, 0), (9, 0), (9, 1)]
    assert fed.skipped == 8


def test_frames_after_the_end_of_rerun_are_not_skipped_to_keep_up() -> None:
    ended = threading.Event()

    def end(*_: Any) -> None:
        ended.set()
        raise ValueError("nobody takes it")

    fed = Feed("viewer", new_recording(), end, lambda: not ended.is_set())
    fed.write(0, estimate(0))
    assert ended.wait(PATIENCE)
    for index in range(1, 20):
        fed.write(index, estimate(index))
    fed.stop(PATIENCE)
    fed.write(20, estimate(20))
    fed.write(21, estimate(21))
    assert fed.skipped == 0


def test_of_the_words_of_rerun_the_last_are_kept() -> None:
    program = r"""
for number in range(5000):
    print("INFO", number)
print("\x1b[31m ERROR\x1b[0m out of memory")
print("  1: main")
"""
    process = RerunProcess([sys.executable, "-c", program])
    assert process.wait(PATIENCE) == 0
    assert process.trouble == "ERROR out of memory"
    assert process.last_words == "1: main"
    assert 2 <= len(process._lines) < 200


def test_a_picture_that_fails_is_told_once(monkeypatch: pytest.MonkeyPatch) -> None:
    told = []
    monkeypatch.setattr(warnings, "warn", lambda message, *_, **__: told.append(message))
    tried: queue.Queue[int] = queue.Queue()

    def fail(index: int, *_: Any) -> None:
        tried.put(index)
        raise ValueError("no picture")

    fed = Feed("viewer", new_recording(), fail, lambda: True)
    for index in range(5):
        fed.write(index, estimate(index))
        assert tried.get(timeout=PATIENCE) == index
    fed.stop(PATIENCE)
    assert told == ["the viewer misses frames: no picture"]
    assert fed.skipped == 5


def test_the_viewer_is_fed_and_ends(viewer: LiveViewer) -> None:
    viewer.write(0, estimate(0), frame(0), cloud(0))
    assert viewer.running
    viewer.close(keep_window=False)
    viewer.close(keep_window=False)
    assert not viewer.running
    assert viewer.skipped == 0


def test_an_app_that_hangs_does_not_outlive_a_second_ctrl_c(
    viewer: LiveViewer, monkeypatch: pytest.MonkeyPatch
) -> None:
    slow = Slow()
    monkeypatch.setattr(viewer._feed, "_log", slow.log)
    viewer.write(0, estimate(0))
    assert slow.entered.wait(PATIENCE)
    stop = viewer._feed.stop

    def interrupted(timeout: float | None = None) -> None:
        if timeout is not None:
            raise KeyboardInterrupt
        slow.release.set()
        stop()

    monkeypatch.setattr(viewer._feed, "stop", interrupted)
    with pytest.raises(KeyboardInterrupt):
        viewer.close()
    assert not viewer.running
    monkeypatch.undo()


def test_the_viewer_listens_to_this_machine_only(viewer: LiveViewer) -> None:
    assert listening(viewer.port) == {"0100007F"}


def test_closing_the_window_does_not_stop_the_run(viewer: LiveViewer) -> None:
    viewer.write(0, estimate(0), frame(0), cloud(0))
    stop_rerun(viewer._app)
    assert not viewer.running
    skipped = viewer.skipped
    for index in range(1, 20):
        viewer.write(index, estimate(index), frame(index), cloud(index))
    viewer.close()
    viewer.write(20, estimate(20))
    assert viewer.skipped == skipped


def test_a_viewer_that_cannot_be_fed_leaves_no_window(monkeypatch: pytest.MonkeyPatch) -> None:
    apps = []

    def started(*arguments: Any, **options: Any) -> Any:
        apps.append(feed.start_rerun(*arguments, **options))
        return apps[-1]

    def fail(*_: Any, **__: Any) -> None:
        raise ValueError("no log")

    monkeypatch.setattr(live, "start_rerun", started)
    monkeypatch.setattr(live, "RerunLog", fail)
    try:
        with pytest.raises(ValueError, match="no log"):
            LiveViewer(arguments=("--headless",))
    except OutputError as error:
        pytest.skip(f"no software renderer here: {error}")
    assert apps[0].poll() is not None
