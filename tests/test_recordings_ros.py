"""ROS recordings: messages, topics, and every kind of file that holds them."""

from __future__ import annotations

import io
import sqlite3
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.writer import CompressionType
from PIL import Image

from recordings_samples import (
    CAMERA_8X6,
    COLOR,
    DEPTH,
    INFO,
    STEP_NS,
    Messages,
    Sample,
    contents,
    make_frames,
    reasons,
    rgbd_messages,
    write_bag,
    write_mcap,
    write_rosbag2,
)
from ropetrace.errors import OutputError, RecordingError
from ropetrace.recordings import images, open_recording
from ropetrace.recordings.mcap_file import McapFrameWriter
from ropetrace.recordings.ros_messages import CAMERA, CLOUD, COMPRESSED, IMAGE
from ropetrace.types import BadFrame, CloudFrame, Intrinsics, RgbdFrame

ROS2 = Messages("cdr")


def write_any(kind: str, folder: Path, rows_of: Any) -> Path:
    """A recording of a kind such as ``mcap-lz4``; `rows_of` makes the messages of a ROS version."""
    name, _, compression = kind.partition("-")
    ros1, ros2 = Messages("ros1"), ROS2
    if name == "mcap":
        return write_mcap(
            folder / "a.mcap",
            rows_of(ros2),
            chunk_size=1000,
            compression=CompressionType[compression.upper()],
        )
    if name == "mcap_ros1":
        return write_mcap(folder / "a.mcap", rows_of(ros1), "ros1")
    if name == "mcap_unchunked":
        return write_mcap(folder / "a.mcap", rows_of(ros2), use_chunking=False)
    if name == "bag":
        return write_bag(folder / "a.bag", rows_of(ros1), compression)
    path = write_rosbag2(folder / "bag", rows_of(ros2), "MCAP" if compression == "mcap" else "SQLITE3")
    return next(path.glob("*.db3")) if name == "db3" else path


KINDS = [
    "mcap-zstd",
    "mcap-lz4",
    "mcap-none",
    "mcap_ros1",
    "mcap_unchunked",
    "bag-none",
    "bag-bz2",
    "bag-lz4",
    "db3",
    "rosbag2-db3",
    "rosbag2-mcap",
]


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("depth", [np.uint16, np.float32])
def test_every_kind_gives_the_same_frames(tmp_path: Path, kind: str, depth: type) -> None:
    frames = make_frames(6, depth)
    recording = open_recording(write_any(kind, tmp_path, lambda make: rgbd_messages(make, frames)))
    assert recording.frame_count == 6
    assert recording.intrinsics == CAMERA_8X6
    assert contents(recording.frames()) == contents(frames)
    assert contents(recording.frames(2, 3)) == contents(frames[2:5])
    assert recording.problems == []
    info = recording.info()
    assert [(row.name, row.count) for row in info.streams] == [(DEPTH, 6), (COLOR, 6), (INFO, 6)]
    assert info.streams[0].rate_hz == pytest.approx(1e9 / STEP_NS)
    assert (info.streams[0].width, info.streams[0].height) == (8, 6)
    assert info.problems == ()


@pytest.mark.parametrize("kind", ["mcap-zstd", "bag-none", "db3"])
def test_kinds_are_recognised_without_their_suffix(tmp_path: Path, kind: str) -> None:
    path = write_any(kind, tmp_path, lambda make: rgbd_messages(make, make_frames(2)))
    assert open_recording(path.rename(tmp_path / "recording")).frame_count == 2


def test_rate_is_refused(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match="stamps of its own"):
        open_recording(write_mcap(tmp_path / "a.mcap", rgbd_messages(ROS2, make_frames(1))), rate=30)


# Writing


@pytest.mark.parametrize("kind", [np.uint16, np.float32])
@pytest.mark.parametrize("color", [True, False])
def test_mcap_writer_roundtrip_is_exact(tmp_path: Path, kind: type, color: bool) -> None:
    frames = make_frames(5, kind, color)
    path = tmp_path / "a.mcap"
    with McapFrameWriter(path, CAMERA_8X6, frames[0].depth_unit_m) as writer:
        for frame in frames:
            writer.write(frame)
    recording = open_recording(path)
    assert contents(recording.frames()) == contents(frames)
    assert recording.info().checksums == "a CRC over each chunk, and one over the file"
    assert recording.problems == []
    with path.open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True)
        found = {(schema.name, channel.topic) for schema, channel, _ in reader.iter_messages() if schema}
        summary = reader.get_summary()
    assert (IMAGE, "/camera/aligned_depth_to_color/image_raw") in found
    assert (CAMERA, "/camera/aligned_depth_to_color/camera_info") in found
    assert summary is not None
    assert all(b"MSG: std_msgs/Header" in schema.data for schema in summary.schemas.values())


def test_what_the_mcap_writer_wrote_survives_a_kill(tmp_path: Path) -> None:
    camera = Intrinsics(160, 120, 100, 100, 80, 60)
    random = np.random.default_rng(0)
    frames = [RgbdFrame(i, random.integers(0, 65536, (120, 160)).astype(np.uint16), 0.001, camera) for i in range(12)]
    with McapFrameWriter(tmp_path / "a.mcap", camera, 0.001) as writer:
        for frame in frames:
            writer.write(frame)
        (tmp_path / "killed.mcap").write_bytes((tmp_path / "a.mcap").read_bytes())
    recording = open_recording(tmp_path / "killed.mcap")
    found = contents(recording.frames())
    assert found == contents(frames)[: len(found)]
    assert len(found) >= len(frames) - 2
    assert recording.problems


def test_mcap_writer_refuses(tmp_path: Path) -> None:
    (tmp_path / "old.mcap").touch()
    with pytest.raises(OutputError, match="exists"):
        McapFrameWriter(tmp_path / "old.mcap", CAMERA_8X6, 0.001)
    with pytest.raises(OutputError, match="millimetres"):
        McapFrameWriter(tmp_path / "a.mcap", CAMERA_8X6, 0.002)
    with pytest.raises(OutputError, match="does not exist"):
        McapFrameWriter(tmp_path / "none" / "a.mcap", CAMERA_8X6, 0.001)
    frame = make_frames(1)[0]
    with McapFrameWriter(tmp_path / "b.mcap", CAMERA_8X6, 0.001) as writer:
        with pytest.raises(OutputError, match="stamp"):
            writer.write(RgbdFrame(-1, frame.depth, 0.001, CAMERA_8X6))
        with pytest.raises(OutputError, match="float32"):
            writer.write(RgbdFrame(0, frame.depth.astype(np.float32), 0.001, CAMERA_8X6))
        with pytest.raises(OutputError, match="camera"):
            writer.write(RgbdFrame(0, frame.depth, 0.001, Intrinsics(8, 6, 1, 1, 4, 3)))


# Messages


def read(tmp_path: Path, rows: list[Sample], **topics: Any) -> list[Any]:
    (tmp_path / "a.mcap").unlink(missing_ok=True)
    return list(open_recording(write_mcap(tmp_path / "a.mcap", rows), **topics).frames())


def with_camera(*rows: Sample) -> list[Sample]:
    return [(INFO, CAMERA, 0, ROS2.camera(0)), *rows]


@pytest.mark.parametrize("encoding", ["16UC1", "mono16", "32FC1"])
@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize("padding", [0, 6])
def test_depth_encodings(tmp_path: Path, encoding: str, order: str, padding: int) -> None:
    kind = "f4" if encoding == "32FC1" else "u2"
    pixels = np.arange(48).reshape(6, 8).astype(kind) * 3
    message = ROS2.image(0, pixels.astype(order + kind), encoding, padding, is_bigendian=int(order == ">"))
    (frame,) = read(tmp_path, with_camera((DEPTH, IMAGE, 0, message)))
    assert np.array_equal(frame.depth, pixels)
    assert frame.depth.dtype == np.dtype(kind)
    assert frame.depth.flags.writeable
    assert frame.depth_unit_m == (1.0 if kind == "f4" else 0.001)


@pytest.mark.parametrize("encoding", ["rgb8", "bgr8", "rgba8", "bgra8"])
def test_colour_encodings(tmp_path: Path, encoding: str) -> None:
    color = np.random.default_rng(0).integers(0, 256, (6, 8, 3)).astype(np.uint8)
    stored = color[:, :, ::-1] if encoding.startswith("bgr") else color
    if "a" in encoding:
        stored = np.dstack([stored, np.full((6, 8), 7, np.uint8)])
    rows = with_camera(
        (COLOR, IMAGE, 0, ROS2.image(0, stored, encoding, padding=5)),
        (DEPTH, IMAGE, 0, ROS2.image(0, np.ones((6, 8), np.uint16), "16UC1")),
    )
    (frame,) = read(tmp_path, rows)
    assert frame.color.tobytes() == color.tobytes()


def test_compressed_images(tmp_path: Path) -> None:
    frame = make_frames(1)[0]
    assert frame.color is not None
    depth, color = images.encode_png(frame.depth), images.encode_png(frame.color)
    header = struct.pack("<iff", 0, 0.0, 0.0)
    for data, declared in (
        (header + depth, "16UC1; compressedDepth png"),
        (header + depth, "16UC1; compressedDepth"),
        (depth, "16UC1; png compressed "),
    ):
        rows = with_camera(
            (
                "/camera/color/image_raw/compressed",
                COMPRESSED,
                0,
                ROS2.compressed(5, color, "rgb8; png compressed rgb8"),
            ),
            (DEPTH + "/compressedDepth", COMPRESSED, 0, ROS2.compressed(5, data, declared)),
        )
        (found,) = read(tmp_path, rows)
        assert np.array_equal(found.depth, frame.depth)
        assert np.array_equal(found.color, frame.color)


def test_compressed_depth_of_floats_is_metres(tmp_path: Path) -> None:
    metres = np.linspace(0.5, 4, 48, dtype=np.float32).reshape(6, 8)
    a, b = 100.0 * 101, 1 - 100.0 * 101 / 10
    stored = np.round(a / metres + b).astype(np.uint16)
    stored[0, 0] = 0
    data = struct.pack("<iff", 0, a, b) + images.encode_png(stored)
    message = ROS2.compressed(0, data, "32FC1; compressedDepth png")
    (frame,) = read(tmp_path, with_camera((DEPTH + "/compressedDepth", COMPRESSED, 0, message)))
    assert np.isnan(frame.depth[0, 0])
    assert np.allclose(frame.depth.reshape(-1)[1:], metres.reshape(-1)[1:], rtol=1e-3)
    assert frame.depth_unit_m == 1.0


def test_bad_messages_are_bad_frames(tmp_path: Path) -> None:
    good = ROS2.image(0, np.ones((6, 8), np.uint16), "16UC1")
    pixels = np.ones((6, 8), np.uint16)
    data = ROS2.serialized(good)
    changes: list[tuple[Any, str]] = [
        (ROS2.image(1, pixels, "16UC1", step=15), "do not fit"),
        (ROS2.image(1, pixels, "16UC1", step=17), "do not fit"),
        (ROS2.image(1, pixels, "16UC1", width=9), "do not fit"),
        (ROS2.image(1, pixels, "16UC1", height=2**31, step=0), "declares"),
        (ROS2.image(1, pixels, "16UC1", width=0), "declares"),
        (ROS2.image(1, np.ones((7, 8), np.uint16), "16UC1"), "8x7"),
        (ROS2.image(1, pixels, "yuv422"), "not depth"),
        (data[:-5], "cannot be decoded"),
        (data[:10], "cannot be decoded"),
        (b"", "cannot be decoded"),
        (b"\x00\x09" + data[2:], "cannot be decoded"),
    ]
    for message, words in changes:
        events = read(tmp_path, with_camera(*((DEPTH, IMAGE, 0, row) for row in (good, message, good))))
        assert isinstance(events[1], BadFrame), words
        assert words in events[1].reason
        assert "\n" not in events[1].reason
        assert isinstance(events[2], RgbdFrame)


def test_compressed_depth_that_is_none(tmp_path: Path) -> None:
    stream = io.BytesIO()
    Image.new("L", (8, 6)).save(stream, "JPEG")
    topic = DEPTH + "/compressedDepth"
    good = ROS2.compressed(0, bytes(12) + images.encode_png(np.ones((6, 8), np.uint16)), "16UC1; compressedDepth png")
    for data, declared, words in (
        (bytes(12) + b"\x01\x02" * 40, "16UC1; compressedDepth rvl", "not PNG"),
        (stream.getvalue(), "16UC1; jpeg compressed", "JPEG, which destroys depth"),
        (images.encode_png(np.ones((6, 8), np.uint16)), "32FC1; png", "no compressedDepth header"),
        (
            struct.pack("<iff", 0, np.nan, 0) + images.encode_png(np.ones((6, 8), np.uint16)),
            "32FC1; c",
            "impossible",
        ),
    ):
        rows = with_camera(*((topic, COMPRESSED, 0, row) for row in (good, ROS2.compressed(1, data, declared))))
        assert words in read(tmp_path, rows, depth_topic=topic)[1].reason


# Cameras


@pytest.mark.parametrize(
    ("camera", "words"),
    [
        (ROS2.camera(0, fx=0.0), "focal lengths"),
        (ROS2.camera(0, fx=np.nan), "not a finite number"),
        (ROS2.camera(0, width=16, height=12), "is for 16x12"),
        (None, "no CameraInfo"),
    ],
)
def test_impossible_camera_is_refused_at_the_start(tmp_path: Path, camera: Any, words: str) -> None:
    rows: list[Sample] = [(DEPTH, IMAGE, 0, ROS2.image(0, np.ones((6, 8), np.uint16), "16UC1"))]
    if camera is not None:
        rows.append((INFO, CAMERA, 0, camera))
    with pytest.raises(RecordingError, match=words):
        read(tmp_path, rows)


def test_camera_that_changes_makes_bad_frames(tmp_path: Path) -> None:
    image = ROS2.image(0, np.ones((6, 8), np.uint16), "16UC1")
    rows = with_camera(
        (DEPTH, IMAGE, 0, image),
        (INFO, CAMERA, 0, ROS2.camera(0, fx=11.0)),
        (DEPTH, IMAGE, 0, image),
        (INFO, CAMERA, 0, ROS2.camera(0)),
        (DEPTH, IMAGE, 0, image),
    )
    first, second, third = read(tmp_path, rows)
    assert isinstance(first, RgbdFrame)
    assert "camera_info changed" in second.reason
    assert isinstance(third, RgbdFrame)


# Topics


def test_aligned_depth_comes_first_and_colour_of_its_camera(tmp_path: Path) -> None:
    aligned = "/camera/aligned_depth_to_color"
    rows: list[Sample] = []
    for number, topic in enumerate(("/camera/depth/image_rect_raw", aligned + "/image_raw", "/other/depth/image_raw")):
        rows.append((topic, IMAGE, 0, ROS2.image(0, np.full((6, 8), number, np.uint16), "16UC1")))
        rows.append((topic.rsplit("/", 1)[0] + "/camera_info", CAMERA, 0, ROS2.camera(0, fx=10.0 + number)))
    for topic, value in (("/web/image_raw", 1), (COLOR, 2)):
        rows.append((topic, IMAGE, 0, ROS2.image(0, np.full((6, 8, 3), value, np.uint8), "rgb8")))
    rows.append(("/camera/infra1/image_rect_raw", IMAGE, 0, ROS2.image(0, np.ones((6, 8), np.uint8), "mono8")))
    (frame,) = read(tmp_path, rows)
    assert (frame.depth[0, 0], frame.intrinsics.fx, frame.color[0, 0, 0]) == (1, 11.0, 2)
    (frame,) = read(tmp_path, rows, depth_topic="/other/depth/image_raw", color_topic="/web/image_raw")
    assert (frame.depth[0, 0], frame.intrinsics.fx, frame.color[0, 0, 0]) == (2, 12.0, 1)
    (frame,) = read(tmp_path, rows, color_topic="")
    assert frame.color is None


def test_topics_that_cannot_be_chosen(tmp_path: Path) -> None:
    image = ROS2.image(0, np.ones((6, 8), np.uint16), "16UC1")
    two = with_camera(("/a/depth", IMAGE, 0, image), ("/b/depth", IMAGE, 0, image))
    with pytest.raises(RecordingError, match=r"several topics may be the depth: /a/depth, /b/depth.*--depth-topic"):
        read(tmp_path, two)
    with pytest.raises(RecordingError, match=r"no topic '/c'; it holds .*/a/depth \(sensor_msgs/msg/Image\)"):
        read(tmp_path, two, depth_topic="/c")
    with pytest.raises(RecordingError, match="is sensor_msgs/msg/CameraInfo, expected"):
        read(tmp_path, two, depth_topic=INFO)
    with pytest.raises(RecordingError, match="expected sensor_msgs/msg/PointCloud2"):
        read(tmp_path, two, cloud_topic="/a/depth")
    with pytest.raises(RecordingError, match="no depth images"):
        read(tmp_path, with_camera())
    with pytest.raises(RecordingError, match="without any readable message"):
        read(tmp_path, [])


def test_unknown_types_are_ignored(tmp_path: Path) -> None:
    rows = with_camera(
        ("/custom", "my_package/msg/Thing", 0, b"\0\1\0\0garbage"),
        (DEPTH, IMAGE, 0, ROS2.image(0, np.ones((6, 8), np.uint16), "16UC1")),
    )
    assert len(read(tmp_path, rows)) == 1
    info = open_recording(tmp_path / "a.mcap").info()
    assert info.streams[-1].name == "/custom"


def test_depth_without_its_colour_is_a_bad_frame(tmp_path: Path) -> None:
    frames = make_frames(4)
    rows = [row for row in rgbd_messages(ROS2, frames) if not (row[0] == COLOR and row[2] == frames[2].stamp_ns)]
    path = write_mcap(tmp_path / "a.mcap", rows)
    assert reasons(open_recording(path)) == [
        f"{DEPTH}: no colour image within 20 ms of this depth image (the nearest is 33.3333 ms away)"
    ]
    assert reasons(open_recording(path, max_pair_gap=0.04)) == []


def test_colour_that_is_not_registered_is_a_problem(tmp_path: Path) -> None:
    color = ROS2.image(0, np.ones((6, 8, 3), np.uint8), "rgb8", header=ROS2.header(0, "other"))
    rows = with_camera((COLOR, IMAGE, 0, color), (DEPTH, IMAGE, 0, ROS2.image(0, np.ones((6, 8), np.uint16), "16UC1")))
    read(tmp_path, rows)
    assert "not registered" in open_recording(tmp_path / "a.mcap").problems[0]


# Clouds


@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize("kind", ["f4", "f8"])
@pytest.mark.parametrize("height", [1, 4])
def test_clouds(tmp_path: Path, order: str, kind: str, height: int) -> None:
    random = np.random.default_rng(0)
    points = random.normal(size=(12, 3)).astype(kind)
    points[3] = np.nan
    colors = random.integers(0, 256, (12, 3))
    names = ("ring", "z", "x", "y", "rgb")
    table = np.zeros(12, np.dtype([(n, order + k) for n, k in zip(names, ("u2", kind, kind, kind, "u4"), strict=True)]))
    for axis, name in enumerate("xyz"):
        table[name] = points[:, axis]
    table["rgb"] = colors @ [65536, 256, 1]
    (frame,) = read(tmp_path, [("/points", CLOUD, 9, ROS2.cloud(7, table, height, padding=height - 1))])
    assert isinstance(frame, CloudFrame)
    assert frame.stamp_ns == 7
    assert frame.points.dtype == np.dtype(kind)
    assert np.array_equal(frame.points, points, equal_nan=True)
    assert frame.colors is not None
    assert np.array_equal(frame.colors, colors)
    assert open_recording(tmp_path / "a.mcap").intrinsics is None


def test_bad_clouds_are_bad_frames(tmp_path: Path) -> None:
    table = np.zeros(4, np.dtype([("x", "f4"), ("y", "f4"), ("z", "f4")]))
    flat = np.zeros(4, np.dtype([("x", "f4"), ("y", "f4"), ("w", "f4")]))
    whole = np.zeros(4, np.dtype([("x", "i4"), ("y", "f4"), ("z", "f4")]))
    messages = [
        (ROS2.cloud(1, table, width=2**32 - 1), "declares"),
        (ROS2.cloud(1, table, point_step=200), "do not fit"),
        (ROS2.cloud(1, table, row_step=47), "do not fit"),
        (ROS2.cloud(1, table, point_step=8), "within a point"),
        (ROS2.cloud(1, table, point_step=0, row_step=48), "within a point"),
        (ROS2.cloud(1, flat), "'w'"),
        (ROS2.cloud(1, whole), "float32 or float64"),
    ]
    for message, words in messages:
        (event,) = read(tmp_path, [("/points", CLOUD, 0, message)])
        assert words in event.reason
    (event,) = read(tmp_path, [("/points", CLOUD, 0, ROS2.cloud(1, table[:0]))])
    assert event.points.shape == (0, 3)


def test_depth_is_preferred_to_clouds_unless_asked(tmp_path: Path) -> None:
    table = np.zeros(4, np.dtype([("x", "f4"), ("y", "f4"), ("z", "f4")]))
    rows = with_camera(
        ("/points", CLOUD, 0, ROS2.cloud(0, table)),
        (DEPTH, IMAGE, 0, ROS2.image(0, np.ones((6, 8), np.uint16), "16UC1")),
    )
    assert isinstance(read(tmp_path, rows)[0], RgbdFrame)
    assert isinstance(read(tmp_path, rows, cloud_topic="/points")[0], CloudFrame)
    with pytest.raises(RecordingError, match="not both"):
        read(tmp_path, rows, cloud_topic="/points", depth_topic=DEPTH)


# rosbag2


@pytest.mark.parametrize("plugin", ["SQLITE3", "MCAP"])
def test_rosbag2_without_metadata(tmp_path: Path, plugin: str) -> None:
    frames = make_frames(3)
    path = write_rosbag2(tmp_path / "bag", rgbd_messages(ROS2, frames), plugin)
    (path / "metadata.yaml").unlink()
    assert contents(open_recording(path).frames()) == contents(frames)


def test_split_rosbag2_in_natural_order(tmp_path: Path) -> None:
    frames = make_frames(12)
    (tmp_path / "bag").mkdir()
    for number, frame in enumerate(frames):
        write_mcap(tmp_path / "bag" / f"bag_{number}.mcap", rgbd_messages(ROS2, [frame]))
    (tmp_path / "bag" / "metadata.yaml").write_text("rosbag2_bagfile_information:\n  message_count: 40\n")
    (tmp_path / "bag" / "bag_12.mcap").write_bytes(b"")
    recording = open_recording(tmp_path / "bag")
    assert recording.frame_count == 12
    assert contents(recording.frames()) == contents(frames)
    assert "bag_12.mcap is lost" in recording.problems[0]
    assert "36 of the 40 messages" in recording.info().problems[-1]


def test_sqlite_rows_come_in_the_order_of_time(tmp_path: Path) -> None:
    frames = make_frames(4)
    rows = rgbd_messages(ROS2, frames)
    path = next(write_rosbag2(tmp_path / "bag", rows[6:] + rows[:6]).glob("*.db3"))
    assert contents(open_recording(path).frames()) == contents(frames)


def test_unmerged_sqlite_journal_is_a_problem(tmp_path: Path) -> None:
    path = next(write_rosbag2(tmp_path / "bag", rgbd_messages(ROS2, make_frames(2))).glob("*.db3"))
    Path(f"{path}-wal").write_bytes(b"x" * 100)
    before = sorted(path.parent.iterdir())
    recording = open_recording(path)
    assert "not merged" in recording.problems[0]
    list(recording.frames())
    assert sorted(path.parent.iterdir()) == before


def test_databases_that_are_no_bags(tmp_path: Path) -> None:
    for name, script, words in (
        ("a.db3", "CREATE TABLE other (x)", "no table 'topics'.*other"),
        ("b.db3", "CREATE TABLE topics (id, name, type, serialization_format)", "no table 'messages'"),
        (
            "c.db3",
            "CREATE TABLE topics (id, name, type, serialization_format);"
            "CREATE VIEW messages AS "
            "WITH RECURSIVE n(i) AS (SELECT 1 UNION ALL SELECT i FROM n) SELECT * FROM n",
            "no table 'messages'",
        ),
        ("d.db3", "CREATE TABLE topics (id); CREATE TABLE messages (id)", "not a readable"),
    ):
        database = sqlite3.connect(tmp_path / name)
        database.executescript(script)
        database.close()
        with pytest.raises(RecordingError, match=words):
            open_recording(tmp_path / name)
    (tmp_path / "e.db3").write_bytes(b"SQLite format 3\0" + bytes(100))
    with pytest.raises(RecordingError, match="not a readable"):
        open_recording(tmp_path / "e.db3")


def test_messages_compressed_one_by_one_are_refused_with_a_remedy(tmp_path: Path) -> None:
    rows = rgbd_messages(ROS2, make_frames(2))
    path = next(write_rosbag2(tmp_path / "bag", rows).glob("*.db3"))
    database = sqlite3.connect(path)
    with database:
        database.execute("UPDATE messages SET data = X'28B52FFD00'")
    database.close()
    with pytest.raises(RecordingError, match="ros2 bag convert"):
        open_recording(path)


def test_old_and_encrypted_bags(tmp_path: Path) -> None:
    (tmp_path / "a.bag").write_bytes(b"#ROSBAG V1.2\n" + bytes(50))
    with pytest.raises(RecordingError, match=r"version .*1\.2"):
        open_recording(tmp_path / "a.bag")
    data = write_bag(tmp_path / "b.bag", rgbd_messages(Messages("ros1"), make_frames(1))).read_bytes()
    field = b"encryptor=x"
    length = int.from_bytes(data[13:17], "little")
    changed = data[:13] + struct.pack("<I", length + 4 + len(field)) + data[17 : 17 + length]
    changed += struct.pack("<I", len(field)) + field + data[17 + length :]
    (tmp_path / "b.bag").write_bytes(changed)
    with pytest.raises(RecordingError, match="encrypted"):
        open_recording(tmp_path / "b.bag")
