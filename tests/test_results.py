from __future__ import annotations

import csv
import dataclasses
import json
import os
import resource
import signal
import subprocess
import sys
import threading
import time
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import pyarrow.parquet
import pytest
from mcap.exceptions import McapError
from mcap.reader import make_reader
from mcap.records import Channel, DataEnd, Message
from mcap.stream_reader import StreamReader
from rerun.chunk import RrdReader
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore

from result_examples import FIRST_STAMP, REASONS, cloud, estimate, estimates, frame, helix, motion, told
from ropetrace import terminal
from ropetrace.errors import MissingExtraError, OutputError
from ropetrace.results import FORMATS, checkpoint, open_writer
from ropetrace.results.base import (
    COLUMNS,
    FLOAT_COLUMNS,
    MOTION_ARRAYS,
    TRACKER_COLUMNS,
    float_rows,
    motion_rows,
    uninterrupted,
)
from ropetrace.types import Estimate, Motion, Status

ENDINGS = list(FORMATS)
METADATA = {"config": 'diameter = 0.012\ncolor = "#c8281e"\n', "note": "naïve ≈ длина"}
STORE = get_typestore(Stores.ROS2_JAZZY)


@pytest.fixture
def eager(monkeypatch: pytest.MonkeyPatch) -> None:
    """Write at once what would wait for a second."""
    monkeypatch.setattr(checkpoint, "SHORTEST_INTERVAL", 0.0)
    monkeypatch.setattr(checkpoint, "REST", 0)


def record(path: Path, items: list[Estimate], **options: Any) -> None:
    with open_writer(path, **options) as writer:
        for index, item in enumerate(items):
            writer.write(10 + index, item)


def two_ropes() -> list[Estimate]:
    """A lost one among them, and for one in three the tracker tells nothing of the waypoints."""
    return [dataclasses.replace(estimate(k), rope=k % 2) if k % 3 == 2 else told(k, k % 2) for k in range(10)]


def expected_rows(items: list[Estimate]) -> list[tuple[Any, ...]]:
    rows: list[tuple[Any, ...]] = []
    for index, item in enumerate(items):
        waypoints, moving = item.waypoints, item.motion
        start, status = (10 + index, item.stamp_ns, item.ahead_ns), str(item.status)
        if not len(waypoints):
            rows.append((*start, None, status, *[None] * len(FLOAT_COLUMNS), item.rope, None, None))
        for number in range(len(waypoints)):
            row: list[Any] = [
                waypoints.arc_length[number],
                *waypoints.positions[number],
                *waypoints.quaternions[number],
            ]
            if moving is None:
                row += [None] * 15
            else:
                row += [*moving.velocities[number], *moving.accelerations[number]]
                row += [*moving.position_sigma[number], *moving.velocity_sigma[number]]
                row += [*moving.acceleration_sigma[number]]
            seen = None if item.seen is None else item.seen[number]
            sigma = None if item.position_sigma is None else item.position_sigma[number]
            rows.append((*start, number, status, *row, item.rope, seen, sigma))
    return rows


def read_csv(path: Path) -> list[dict[str, str]]:
    return list(csv.DictReader(path.read_text().splitlines()))


def nanoseconds(time: Any) -> int:
    """A ROS time or duration as one number."""
    return int(time.sec * 10**9 + time.nanosec)


def rrd_frames(path: Path) -> set[int]:
    """The frames whose length is logged in a Rerun recording, whether it was finished or not."""
    frames: set[int] = set()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        for chunk in RrdReader(path).stream():
            if chunk.entity_path == "/plots/length":
                frames |= set(chunk.to_record_batch().column("frame").to_pylist())
    return frames


def mcap_messages(path: Path, finished: bool) -> Iterator[tuple[int, Any]]:
    """The frames' numbers and paths; of a file without an end, all that is whole."""
    with path.open("rb") as file:
        if finished:
            for schema, _, message in make_reader(file, validate_crcs=True).iter_messages():
                assert schema is not None
                if schema.name == "nav_msgs/msg/Path":
                    yield message.sequence, STORE.deserialize_cdr(message.data, schema.name)
            return
        try:
            for item in StreamReader(file, validate_crcs=True).records:
                if isinstance(item, Message) and item.channel_id == 1:
                    yield item.sequence, STORE.deserialize_cdr(item.data, "nav_msgs/msg/Path")
        except McapError:
            return


def frames_in(path: Path, finished: bool = True) -> list[int]:
    """The numbers of the frames that can be read from a file of any format."""
    if path.suffix == ".csv":
        assert path.read_text().endswith("\n")
        return sorted({int(row["frame"]) for row in read_csv(path)})
    if path.suffix == ".parquet":
        return sorted(set(pyarrow.parquet.read_table(path)["frame"].to_pylist()))
    if path.suffix == ".npz":
        with np.load(path, allow_pickle=False) as arrays:
            return [int(number) for number in arrays["frame"]]
    if path.suffix == ".mcap":
        return sorted(number for number, _ in mcap_messages(path, finished))
    return sorted(rrd_frames(path))


@pytest.mark.parametrize("items", [estimates(10), two_ropes()], ids=["one rope", "two ropes"])
def test_csv_is_exact(tmp_path: Path, items: list[Estimate]) -> None:
    record(tmp_path / "run.csv", items, metadata=METADATA)
    text = (tmp_path / "run.csv").read_bytes().decode()
    assert "\r" not in text
    header, *rows = csv.reader(text.splitlines())
    assert ",".join(header) == (
        "frame,stamp_ns,ahead_ns,waypoint,status,arc_length,x,y,z,qx,qy,qz,qw,vx,vy,vz,ax,ay,az,"
        "sigma_x,sigma_y,sigma_z,sigma_vx,sigma_vy,sigma_vz,sigma_ax,sigma_ay,sigma_az,"
        "rope,seen,tracker_sigma"
    )
    kinds = (int, int, int, int, str, *[float] * 23, int, int, float)
    read = [tuple(kind(cell) if cell else None for kind, cell in zip(kinds, row, strict=True)) for row in rows]
    assert read == expected_rows(items)


@pytest.mark.parametrize("items", [estimates(10), two_ropes()], ids=["one rope", "two ropes"])
def test_parquet_is_exact(tmp_path: Path, items: list[Estimate]) -> None:
    record(tmp_path / "run.parquet", items, frame_name="world", metadata=METADATA)
    table = pyarrow.parquet.read_table(tmp_path / "run.parquet")
    assert tuple(table.column_names) == COLUMNS
    assert [str(table.schema.field(name).type) for name in TRACKER_COLUMNS] == ["int32", "bool", "double"]
    assert [tuple(row.values()) for row in table.to_pylist()] == expected_rows(items)
    kept = {key.decode(): value.decode() for key, value in table.schema.metadata.items()}
    assert kept == {**METADATA, "frame_name": "world"}


@pytest.mark.parametrize("ending", [".csv", ".parquet"])
def test_a_number_that_is_not_known_is_empty(tmp_path: Path, ending: str) -> None:
    """Also where a part of the motion is known."""
    known = motion(1, 3)
    accelerations = known.accelerations.copy()
    accelerations[1] = np.nan
    moving = dataclasses.replace(known, accelerations=accelerations)
    path = tmp_path / f"run{ending}"
    record(path, [Estimate(1, Status.OK, waypoints=helix(1, 3), motion=moving)])
    rows: list[dict[str, Any]]
    if ending == ".csv":
        assert "nan" not in path.read_text()
        rows = [{k: float(v) if v else None for k, v in row.items() if k != "status"} for row in read_csv(path)]
    else:
        rows = pyarrow.parquet.read_table(path).to_pylist()
    assert [row["ax"] for row in rows] == [known.accelerations[0, 0], None, known.accelerations[2, 0]]
    assert [row["az"] for row in rows] == [known.accelerations[0, 2], None, known.accelerations[2, 2]]
    assert [row["sigma_az"] for row in rows] == known.acceleration_sigma[:, 2].tolist()


def test_the_motion_is_one_block_for_all_formats() -> None:
    assert tuple(item.name for item in dataclasses.fields(Motion)) == MOTION_ARRAYS
    known, unknown, lost = estimate(1), estimate(0), estimate(4)
    assert known.motion is not None
    block = motion_rows(known)
    for index, name in enumerate(MOTION_ARRAYS):
        assert np.array_equal(block[:, 3 * index : 3 * index + 3], getattr(known.motion, name))
    assert np.isnan(motion_rows(unknown)).all()
    assert (motion_rows(unknown).shape, motion_rows(lost).shape) == ((50, 15), (0, 15))
    assert (float_rows(known).shape, float_rows(lost).shape) == ((50, 23), (0, 23))


@pytest.mark.parametrize("items", [estimates(10), two_ropes()], ids=["one rope", "two ropes"])
def test_npz_is_exact(tmp_path: Path, items: list[Estimate]) -> None:
    record(tmp_path / "run.npz", items, metadata=METADATA)
    with np.load(tmp_path / "run.npz", allow_pickle=False) as arrays:
        read = dict(arrays)
    assert read["frame"].tolist() == list(range(10, 20))
    assert read["stamp_ns"].tolist() == [item.stamp_ns for item in items]
    assert read["ahead_ns"].tolist() == [item.ahead_ns for item in items]
    assert read["status"].tolist() == [str(item.status) for item in items]
    assert read["reasons"].tolist() == ["\n".join(item.reasons) for item in items]
    assert read["point_count"].tolist() == [item.point_count for item in items]
    nodes, waypoints = read["node_offset"], read["waypoint_offset"]
    for index, item in enumerate(items):
        part = slice(waypoints[index], waypoints[index + 1])
        assert np.array_equal(read["nodes"][nodes[index] : nodes[index + 1]], item.nodes)
        assert np.array_equal(read["positions"][part], item.waypoints.positions)
        assert np.array_equal(read["quaternions"][part], item.waypoints.quaternions)
        assert np.array_equal(read["arc_length"][part], item.waypoints.arc_length)
        for name in MOTION_ARRAYS:
            expected = np.full((len(item.waypoints), 3), np.nan) if item.motion is None else getattr(item.motion, name)
            assert np.array_equal(read[name][part], expected, equal_nan=True)
        unknown = np.full(len(item.waypoints), np.nan)
        for name, values in (("seen", item.seen), ("tracker_sigma", item.position_sigma)):
            assert np.array_equal(read[name][part], unknown if values is None else values, equal_nan=True)
    assert read["rope"].tolist() == [item.rope for item in items]
    assert {len(read[name]) for name in ("positions", *MOTION_ARRAYS, "seen", "tracker_sigma")} == {waypoints[-1]}
    assert json.loads(str(read["metadata"])) == {**METADATA, "frame_name": "camera"}


@pytest.mark.parametrize(("frame_name", "frame_id"), [("camera", "camera_color_optical_frame"), ("world", "world")])
def test_mcap_is_read_by_rosbags(tmp_path: Path, frame_name: str, frame_id: str) -> None:
    items = estimates(10)
    record(tmp_path / "run.mcap", items, frame_name=frame_name)
    read: dict[str, list[Any]] = {"centerline": [], "motion": [], "status": []}
    with AnyReader([tmp_path / "run.mcap"]) as reader:
        for connection, time_ns, data in reader.messages():
            message: Any = reader.deserialize(data, connection.msgtype)
            assert message.header.frame_id == frame_id
            read[connection.topic.removeprefix("/ropetrace/")].append(message)
            assert time_ns == items[len(read["centerline"]) - 1].stamp_ns
    for item, path, moving, array in zip(items, *read.values(), strict=True):
        assert nanoseconds(array.header.stamp) == item.stamp_ns
        assert nanoseconds(path.header.stamp) == nanoseconds(moving.header.stamp) == item.stamp_ns + item.ahead_ns
        poses = [pose.pose for pose in path.poses]
        positions = [(pose.position.x, pose.position.y, pose.position.z) for pose in poses]
        turns = [(p.orientation.x, p.orientation.y, p.orientation.z, p.orientation.w) for p in poses]
        assert np.array_equal(np.reshape(positions, (-1, 3)), item.waypoints.positions)
        assert np.array_equal(np.reshape(turns, (-1, 4)), item.waypoints.quaternions)
        (status,) = array.status
        assert status.level == {"ok": 0, "degraded": 1, "lost": 2}[item.status]
        assert status.message == ("; ".join(item.reasons) or "ok")
        values = {pair.key: pair.value for pair in status.values}
        assert (values["point_count"], values["nodes"]) == (str(item.point_count), str(len(item.nodes)))
        assert float(values["length"]) == item.waypoints.length
        assert float(values["ahead"]) == item.ahead_ns / 1e9
        assert (status.name, values["rope"]) == ("ropetrace", "0")
    assert read["status"][3].status[0].message == "; ".join(REASONS)


def test_mcap_has_the_motion_of_every_waypoint(tmp_path: Path) -> None:
    items = estimates(5)
    record(tmp_path / "run.mcap", items)
    with AnyReader([tmp_path / "run.mcap"]) as reader:
        connections = [c for c in reader.connections if c.topic == "/ropetrace/motion"]
        assert [c.msgtype for c in connections] == ["trajectory_msgs/msg/MultiDOFJointTrajectory"]
        messages: list[Any] = [reader.deserialize(data, c.msgtype) for c, _, data in reader.messages(connections)]

    def rows(vectors: list[Any]) -> list[list[float]]:
        return [[vector.x, vector.y, vector.z] for vector in vectors]

    for item, message in zip(items, messages, strict=True):
        if item.motion is None:
            assert (message.points, message.joint_names) == ([], [])
            continue
        assert message.joint_names == [f"waypoint_{number}" for number in range(50)]
        (point,) = message.points
        assert nanoseconds(point.time_from_start) == 0
        assert rows([pose.translation for pose in point.transforms]) == item.waypoints.positions.tolist()
        turns = [[turn.x, turn.y, turn.z, turn.w] for turn in (pose.rotation for pose in point.transforms)]
        assert turns == item.waypoints.quaternions.tolist()
        assert rows([twist.linear for twist in point.velocities]) == item.motion.velocities.tolist()
        assert rows([twist.linear for twist in point.accelerations]) == item.motion.accelerations.tolist()
        assert not np.any(rows([twist.angular for twist in point.velocities + point.accelerations]))
    assert [item.motion is None for item in items] == [True, False, False, False, True]


def test_mcap_has_what_the_tracker_tells_of_each_waypoint(tmp_path: Path) -> None:
    """From the first time that it tells something on, so that no picture of it outlives its frame."""
    items = [estimate(0), told(1), dataclasses.replace(told(2), seen=None), told(4), estimate(5)]
    record(tmp_path / "run.mcap", items)
    with AnyReader([tmp_path / "run.mcap"]) as reader:
        connections = [c for c in reader.connections if c.topic == "/ropetrace/waypoints"]
        clouds: list[Any] = [reader.deserialize(data, c.msgtype) for c, _, data in reader.messages(connections)]
    kinds = {2: "u1", 7: "<f4", 8: "<f8"}
    for item, message in zip(items[1:], clouds, strict=True):
        assert nanoseconds(message.header.stamp) == item.stamp_ns + item.ahead_ns
        columns = {field.name: (kinds[field.datatype], field.offset) for field in message.fields}
        layout: Any = {
            "names": list(columns),
            "formats": [kind for kind, _ in columns.values()],
            "offsets": [offset for _, offset in columns.values()],
            "itemsize": message.point_step,
        }
        rows: Any = np.frombuffer(message.data.tobytes(), np.dtype(layout))
        assert (message.height, message.width, message.row_step) == (1, len(rows), message.data.size)
        places = np.column_stack([rows[axis] for axis in "xyz"])
        assert np.array_equal(places, item.waypoints.positions.astype(np.float32))
        for name, values in (("seen", item.seen), ("tracker_sigma", item.position_sigma)):
            assert (name in columns) == (values is not None)
            assert values is None or np.array_equal(rows[name], values)


def test_each_rope_has_topics_of_its_own_in_an_mcap(tmp_path: Path) -> None:
    items = two_ropes()
    with open_writer(tmp_path / "run.mcap") as writer:
        for number, item in enumerate(items):
            writer.write(number // 2, item)
    with (tmp_path / "run.mcap").open("rb") as file:
        messages = [
            (channel.topic.removeprefix("/ropetrace/"), message.sequence, message.log_time)
            for _, channel, message in make_reader(file, validate_crcs=True).iter_messages(log_time_order=False)
        ]
    for rope, start in ((0, ""), (1, "rope_1/")):
        stamps = [(number, item.stamp_ns) for number, item in enumerate(items[rope::2])]
        for topic in ("centerline", "motion", "status", "waypoints"):
            assert [rest for name, *rest in messages if name == start + topic] == [[*pair] for pair in stamps]
    with AnyReader([tmp_path / "run.mcap"]) as reader:
        connections = [c for c in reader.connections if c.topic == "/ropetrace/rope_1/status"]
        states: list[Any] = [
            reader.deserialize(data, c.msgtype).status[0] for c, _, data in reader.messages(connections)
        ]
    assert {state.name for state in states} == {"ropetrace: rope_1"}
    assert {pair.value for state in states for pair in state.values if pair.key == "rope"} == {"1"}


def test_mcap_has_checksums_schemas_and_metadata(tmp_path: Path) -> None:
    record(tmp_path / "run.mcap", estimates(10), metadata=METADATA)
    with (tmp_path / "run.mcap").open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        summary = reader.get_summary()
        assert summary is not None
        assert summary.statistics is not None
        assert summary.statistics.message_count == 30
        assert reader.get_header().profile == "ros2"
        assert {schema.encoding for schema in summary.schemas.values()} == {"ros2msg"}
        texts = {schema.name: schema.data.decode() for schema in summary.schemas.values()}
        assert "MSG: geometry_msgs/PoseStamped" in texts["nav_msgs/msg/Path"]
        assert (
            "MSG: trajectory_msgs/MultiDOFJointTrajectoryPoint" in texts["trajectory_msgs/msg/MultiDOFJointTrajectory"]
        )
        assert "MSG: diagnostic_msgs/KeyValue" in texts["diagnostic_msgs/msg/DiagnosticArray"]
        assert {channel.message_encoding for channel in summary.channels.values()} == {"cdr"}
        (metadata,) = reader.iter_metadata()
        assert (metadata.name, metadata.metadata) == ("ropetrace", {**METADATA, "frame_name": "camera"})
    assert frames_in(tmp_path / "run.mcap") == list(range(10))


def test_no_flipped_bit_of_an_mcap_changes_data(tmp_path: Path) -> None:
    """Read from its start to the end of the data: no reader of the package `mcap` checks the index behind them."""
    path, broken = tmp_path / "run.mcap", tmp_path / "broken.mcap"
    record(path, estimates(5))

    def read(path: Path) -> list[tuple[str, int, int, bytes]]:
        topics: dict[int, str] = {}
        messages = []
        with path.open("rb") as file:
            for item in StreamReader(file, validate_crcs=True).records:
                if isinstance(item, DataEnd):
                    break
                if isinstance(item, Channel):
                    topics[item.id] = item.topic
                if isinstance(item, Message):
                    messages.append((topics[item.channel_id], item.sequence, item.log_time, item.data))
        return messages

    sound, data = read(path), path.read_bytes()
    random = np.random.default_rng(0)
    refused = 0
    for _ in range(150):
        changed = bytearray(data)
        changed[random.integers(len(data))] ^= 1 << int(random.integers(8))
        broken.write_bytes(changed)
        try:
            assert read(broken) == sound
        except AssertionError:
            raise
        except Exception:
            refused += 1
    assert refused > 50


@pytest.mark.parametrize("stamp_ns", [-1, 2**31 * 10**9])
def test_mcap_refuses_a_stamp_that_ros_cannot_hold(tmp_path: Path, stamp_ns: int) -> None:
    with open_writer(tmp_path / "run.mcap") as writer:
        with pytest.raises(OutputError, match="frame 7: the stamp does not fit a ROS time"):
            writer.write(7, Estimate.lost(stamp_ns, "nothing"))
        writer.write(8, Estimate.lost(0, "nothing"))
    assert len(frames_in(tmp_path / "run.mcap")) == 1


def test_mcap_refuses_a_prediction_that_ros_cannot_hold(tmp_path: Path) -> None:
    late = dataclasses.replace(estimate(1), stamp_ns=2**31 * 10**9 - 1, ahead_ns=1)
    with open_writer(tmp_path / "run.mcap") as writer:
        with pytest.raises(OutputError, match="frame 7: the predicted time does not fit a ROS time"):
            writer.write(7, late)
        writer.write(8, dataclasses.replace(late, ahead_ns=0))
    assert len(frames_in(tmp_path / "run.mcap")) == 1


@pytest.mark.parametrize("ending", ENDINGS)
def test_a_run_without_frames_is_readable(tmp_path: Path, ending: str) -> None:
    record(tmp_path / f"run{ending}", [])
    assert frames_in(tmp_path / f"run{ending}") == []


@pytest.mark.parametrize("ending", ENDINGS)
def test_an_existing_file_needs_overwrite(tmp_path: Path, ending: str) -> None:
    path = tmp_path / f"run{ending}"
    path.write_text("precious")
    with pytest.raises(OutputError, match=r"exists already.*--overwrite"):
        open_writer(path)
    assert path.read_text() == "precious"
    record(path, estimates(3), overwrite=True)
    assert len(frames_in(path)) == 3


@pytest.mark.parametrize("ending", ENDINGS)
def test_impossible_places_are_refused_in_one_line(tmp_path: Path, ending: str) -> None:
    (tmp_path / f"folder{ending}").mkdir()
    (tmp_path / "file").touch()
    (tmp_path / f"dangling{ending}").symlink_to(tmp_path / "missing" / "run")
    places = {
        f"folder{ending}": "is a folder",
        f"missing/run{ending}": "the folder .*missing does not exist",
        f"file/run{ending}": "the folder .*file does not exist",
        f"{'n' * 300}{ending}": "cannot be written: File name too long",
    }
    for name, message in places.items():
        for overwrite in (False, True):
            with pytest.raises(OutputError, match=message) as raised:
                open_writer(tmp_path / name, overwrite=overwrite)
            assert "\n" not in str(raised.value)
    with pytest.raises(OutputError, match="exists already"):
        open_writer(tmp_path / f"dangling{ending}")
    assert sorted(os.listdir(tmp_path)) == sorted([f"folder{ending}", "file", f"dangling{ending}"])


@pytest.mark.skipif(os.geteuid() != 0, reason="gives up the rights of root")
@pytest.mark.parametrize("ending", ENDINGS)
def test_a_folder_without_permission_is_refused(tmp_path: Path, ending: str) -> None:
    for folder in (tmp_path, *list(tmp_path.parents)[:2]):
        folder.chmod(0o755)
    open_writer(tmp_path / f"first{ending}").close()
    os.seteuid(65534)
    try:
        with pytest.raises(OutputError, match="Permission denied"):
            open_writer(tmp_path / f"run{ending}")
    finally:
        os.seteuid(0)


@pytest.mark.parametrize("name", ["run", "run.txt", "run.csv.gz", ".csv", "/dev/full"])
def test_an_unknown_ending_lists_the_known(tmp_path: Path, name: str) -> None:
    with pytest.raises(OutputError, match=r"use \.csv, \.parquet, \.npz, \.mcap, \.rrd"):
        open_writer(tmp_path / name)


def test_the_case_of_the_ending_does_not_matter(tmp_path: Path) -> None:
    record(tmp_path / "RUN.CSV", estimates(1))
    assert (tmp_path / "RUN.CSV").read_text().startswith("frame,")


@pytest.mark.parametrize(("ending", "module"), [(".parquet", "pyarrow"), (".rrd", "rerun")])
def test_a_missing_extra_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, ending: str, module: str) -> None:
    for name in ("ropetrace.results.parquet", "ropetrace.results.rrd", "ropetrace.viewer"):
        monkeypatch.delitem(sys.modules, name, raising=False)
    monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(MissingExtraError, match=r"pip install 'ropetrace\["):
        open_writer(tmp_path / f"run{ending}")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("error", [KeyboardInterrupt, ValueError])
@pytest.mark.parametrize("ending", ENDINGS)
def test_an_exception_in_the_block_leaves_a_whole_file(tmp_path: Path, ending: str, error: type[BaseException]) -> None:
    path = tmp_path / f"run{ending}"

    def stopped() -> None:
        with open_writer(path) as writer:
            for index in range(7):
                writer.write(index, estimate(index), frame(index), cloud(index))
            raise error

    with pytest.raises(error):
        stopped()
    assert frames_in(path) == list(range(7))
    assert [item.name for item in tmp_path.iterdir()] == [path.name]


@pytest.mark.usefixtures("eager")
@pytest.mark.parametrize("ending", [".csv", ".parquet", ".npz", ".mcap"])
def test_ctrl_c_at_any_moment_leaves_a_whole_file(tmp_path: Path, ending: str) -> None:
    items = estimates(10)
    for attempt in range(4):
        path, written = tmp_path / f"{attempt}{ending}", 0
        timer = threading.Timer(0.01 + 0.013 * attempt, os.kill, (os.getpid(), signal.SIGINT))
        timer.start()
        try:
            with open_writer(path) as writer:
                while True:
                    writer.write(written, items[written % 10])
                    written += 1
        except KeyboardInterrupt:
            pass
        timer.join()
        # The frame that was being written when it came is there or not; those before it are.
        assert frames_in(path) in (list(range(written)), list(range(written + 1)))
    assert len(list(tmp_path.iterdir())) == 4


@pytest.mark.parametrize("number", terminal.ENDINGS)
def test_a_held_signal_comes_after_the_block(number: signal.Signals) -> None:
    steps = []

    def end(*_: Any) -> None:
        steps.append("ended")

    before = signal.signal(number, end)
    try:
        with uninterrupted():
            signal.raise_signal(number)
            steps.append("done")
        assert steps == ["done", "ended"]
        assert signal.getsignal(number) is end
    finally:
        signal.signal(number, before)
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    assert signal.getsignal(signal.SIGTERM) is signal.SIG_DFL


@pytest.mark.usefixtures("eager")
@pytest.mark.parametrize("ending", ENDINGS)
def test_a_full_disk_is_one_line(tmp_path: Path, ending: str) -> None:
    path, written = tmp_path / f"run{ending}", 0
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    writer = open_writer(path)

    def fill() -> None:
        nonlocal written
        with writer:
            while written < 3000:
                writer.write(written, estimate(written), frame(written), cloud(written))
                written += 1

    resource.setrlimit(resource.RLIMIT_FSIZE, (60_000, hard))
    try:
        with pytest.raises(OutputError, match="cannot be written") as raised:
            fill()
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    writer.close()
    assert "\n" not in str(raised.value)
    assert str(path) in str(raised.value)
    read = frames_in(path, finished=False)
    assert read == list(range(len(read)))
    if ending != ".rrd":
        assert written - len(read) <= 1
    assert [item.name for item in tmp_path.iterdir()] == [path.name]


@pytest.mark.parametrize("ending", [".csv", ".mcap"])
def test_a_device_that_is_full_is_one_line(tmp_path: Path, ending: str) -> None:
    path = tmp_path / f"run{ending}"
    path.symlink_to("/dev/full")
    with pytest.raises(OutputError, match="cannot be written: No space left on device"):
        open_writer(path, overwrite=True)


KILLED = """
import sys
from result_examples import cloud, estimate, frame
from ropetrace.results import checkpoint, open_writer
checkpoint.SHORTEST_INTERVAL = 0.05
writer = open_writer(sys.argv[1])
index = 0
while True:
    writer.write(index, estimate(index), frame(index), cloud(index))
    print(index, flush=True)
    index += 1
"""


@pytest.mark.parametrize("ending", ENDINGS)
def test_kill_minus_nine_leaves_what_was_written(tmp_path: Path, ending: str) -> None:
    path = tmp_path / f"run{ending}"
    process = subprocess.Popen(
        [sys.executable, "-c", KILLED, path],
        stdout=subprocess.PIPE,
        text=True,
        env={**os.environ, "PYTHONPATH": str(Path(__file__).parent)},
    )
    assert process.stdout is not None
    with process:
        acknowledged = int(process.stdout.readline())
        started = time.monotonic()
        while time.monotonic() < started + 0.7:
            acknowledged = int(process.stdout.readline())
        process.kill()
        rest = process.stdout.read().split()
    acknowledged = max([acknowledged, *map(int, rest)])
    read = frames_in(path, finished=False)
    assert read == list(range(len(read)))
    lost = acknowledged + 1 - len(read)
    print(f"{ending}: {acknowledged + 1} acknowledged, {lost} lost")
    if ending in (".csv", ".mcap"):
        assert lost <= 0
    else:
        # How much the last checkpoint holds depends on the machine; that there is one does not.
        assert len(read) > 0


def test_checkpoints_take_little_time(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(checkpoint, "SHORTEST_INTERVAL", 0.01)
    spent = []

    def save(file: BinaryIO) -> None:
        time.sleep(0.01)
        spent.append(0.01)

    started = time.monotonic()
    point = checkpoint.Checkpoint(tmp_path / "file", overwrite=False, save=save)
    while time.monotonic() < started + 0.6:
        point.write_if_due()
        time.sleep(0.0005)
    assert len(spent) >= 2
    assert sum(spent) < 0.15 * 0.6


def test_the_stamps_are_nanoseconds(tmp_path: Path) -> None:
    record(tmp_path / "run.csv", estimates(1))
    assert (tmp_path / "run.csv").read_text().splitlines()[1].startswith(f"10,{FIRST_STAMP},0,0,ok,0.0,")
    record(tmp_path / "ahead.csv", [estimate(1)])
    assert read_csv(tmp_path / "ahead.csv")[0]["ahead_ns"] == "25000000"
