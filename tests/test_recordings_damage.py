"""Recordings that were cut off, altered, or made to do harm."""

from __future__ import annotations

import resource
import struct
import subprocess
import sys
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import lz4.frame  # type: ignore[import-untyped]
import numpy as np
import pytest
import zstandard
from mcap.writer import CompressionType

from recordings_samples import (
    CAMERA_8X6,
    INFO,
    Messages,
    contents,
    make_frames,
    mutated,
    reasons,
    rgbd_messages,
    write_bag,
    write_camera,
    write_mcap,
    write_rosbag2,
)
from ropetrace.errors import RecordingError, RopetraceError
from ropetrace.recordings import images, open_recording
from ropetrace.recordings.base import note
from ropetrace.recordings.decompress import DamageError, decompress
from ropetrace.recordings.rgbd_folder import RgbdFolderWriter
from test_recordings_clouds import COLORS, POINTS, npy, npz, pcd, ply

ROS1, ROS2 = Messages("ros1"), Messages("cdr")
FRAMES = make_frames(4)
GOOD = contents(FRAMES)


def small_mcap(path: Path, **options: Any) -> bytes:
    """Four frames, a chunk a message."""
    return write_mcap(path, rgbd_messages(ROS2, FRAMES), **{"chunk_size": 1, **options}).read_bytes()


def read(path: Path) -> tuple[list[Any], list[str]] | None:
    """All frames and problems, or None for a recording that is refused; checks what must always hold."""
    try:
        recording = open_recording(path)
        found = contents(recording.frames())
        info = recording.info()
    except RopetraceError as refused:
        message = str(refused)
    else:
        assert all("\n" not in problem for problem in recording.problems)
        assert list(info.problems) == recording.problems
        return found, recording.problems
    assert "\n" not in message
    return None


def check_nothing_is_altered(path: Path, everything: list[Any] = GOOD) -> int:
    """Every frame is one of the recording, in its order, and the missing is stated; counts the good ones."""
    outcome = read(path)
    if outcome is None:
        return 0
    found, problems = outcome
    kept = [row for row in found if not isinstance(row, str)]
    if any("images of /camera/color" in problem for problem in problems):
        everything = [(*row[:4], None, *row[5:]) for row in everything]
    rest = iter(everything)
    assert all(row in rest for row in kept)
    assert found == everything or problems or len(found) == len(everything)
    return len(kept)


# Truncation


@pytest.mark.parametrize("options", [{}, {"compression": CompressionType.NONE}, {"use_chunking": False}])
def test_truncated_mcap_gives_all_whole_frames_before(tmp_path: Path, options: dict[str, Any]) -> None:
    data = small_mcap(tmp_path / "whole.mcap", **options)
    path = tmp_path / "cut.mcap"
    recovered = []
    for length in [*range(8, len(data), 37), len(data) - 1]:
        path.write_bytes(data[:length])
        outcome = read(path)
        found = outcome[0] if outcome else []
        recovered.append(len(found))
        assert found == GOOD[: len(found)]
        assert outcome is None or outcome[1]
    assert recovered == sorted(recovered)
    assert recovered[-1] == 4
    assert set(recovered) == {0, 1, 2, 3, 4}


def test_truncated_mcap_states_the_loss(tmp_path: Path) -> None:
    data = small_mcap(tmp_path / "whole.mcap")
    (tmp_path / "cut.mcap").write_bytes(data[: len(data) // 3])
    recording = open_recording(tmp_path / "cut.mcap")
    found = list(recording.frames())
    assert recording.frame_count == len(found)
    assert recording.problems[0] == "the end of the file is missing or damaged: it was not closed, or was cut off"
    assert "beyond the end): the rest is lost" in recording.problems[1]
    assert "whole messages were recovered; how many there were is not known" in recording.problems[2]


@pytest.mark.parametrize("compression", ["none", "bz2", "lz4"])
def test_truncated_bag_gives_all_whole_frames_before(tmp_path: Path, compression: str) -> None:
    data = write_bag(tmp_path / "whole.bag", rgbd_messages(ROS1, FRAMES), compression, 300).read_bytes()
    recovered = []
    for length in [*range(14, len(data), 97), len(data) - 1]:
        (tmp_path / "cut.bag").write_bytes(data[:length])
        outcome = read(tmp_path / "cut.bag")
        found = outcome[0] if outcome else []
        assert found == GOOD[: len(found)]
        assert outcome is None or outcome[1]
        recovered.append(len(found))
    assert recovered == sorted(recovered)
    assert recovered[-1] == 4
    assert len(set(recovered)) >= 3


def test_bag_that_was_never_closed(tmp_path: Path) -> None:
    data = bytearray(write_bag(tmp_path / "a.bag", rgbd_messages(ROS1, FRAMES)).read_bytes())
    at = data.index(b"index_pos=") + len(b"index_pos=")
    data[at : at + 8] = bytes(8)
    (tmp_path / "a.bag").write_bytes(data)
    recording = open_recording(tmp_path / "a.bag")
    assert contents(recording.frames()) == GOOD
    assert "did not close the bag" in recording.problems[0]


def test_truncated_database_gives_the_rows_before(tmp_path: Path) -> None:
    frames = make_frames(60)
    everything = contents(frames)
    path = next(write_rosbag2(tmp_path / "bag", rgbd_messages(ROS2, frames)).glob("*.db3"))
    data = path.read_bytes()
    recovered = []
    for length in range(4096, len(data), 4096):
        path.write_bytes(data[:length])
        outcome = read(path)
        if outcome is not None:
            kept = [row for row in outcome[0] if not isinstance(row, str)]
            assert all(row in everything for row in kept)
            assert outcome[1]
            recovered.append(len(kept))
    assert recovered
    assert max(recovered) > 30


# Flipped bits


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"compression": CompressionType.NONE},
        {"compression": CompressionType.LZ4},
        {"use_chunking": False},
    ],
)
def test_no_flipped_bit_of_an_mcap_goes_unnoticed(tmp_path: Path, options: dict[str, Any]) -> None:
    data = small_mcap(tmp_path / "whole.mcap", **options)
    path = tmp_path / "flipped.mcap"
    random = np.random.default_rng(5)
    chunked = options.get("use_chunking", True)
    for bit in random.choice(8 * len(data), 500, replace=False):
        changed = bytearray(data)
        changed[bit // 8] ^= 1 << int(bit % 8)
        path.write_bytes(changed)
        if chunked:
            kept = check_nothing_is_altered(path)
            # One flip costs one chunk: the camera's, the colour's or the depth's message.
            assert kept >= 2
        else:
            # Without chunks there is one checksum, at the end: what was altered is known only then.
            outcome = read(path)
            assert outcome is None or outcome[0] == GOOD or outcome[1]


def test_damaged_chunk_is_named_and_the_others_are_read(tmp_path: Path) -> None:
    data = bytearray(small_mcap(tmp_path / "a.mcap", compression=CompressionType.NONE))
    at = data.index(np.ascontiguousarray(FRAMES[1].depth).tobytes())
    data[at] ^= 1
    (tmp_path / "a.mcap").write_bytes(data)
    recording = open_recording(tmp_path / "a.mcap")
    assert contents(recording.frames()) == [GOOD[0], *GOOD[2:]]
    assert recording.problems[0].startswith("the chunk at byte ")
    assert "wrong checksum" in recording.problems[0]
    assert recording.problems[1] == "11 of the 12 messages of the file were recovered"


def test_flipped_bits_of_compressed_bags_are_noticed(tmp_path: Path) -> None:
    """bz2 has checksums; of the rest of a bag only what is not pixels can be checked."""
    data = write_bag(tmp_path / "whole.bag", rgbd_messages(ROS1, FRAMES), "bz2", 300).read_bytes()
    path = tmp_path / "flipped.bag"
    for byte in np.random.default_rng(6).choice(np.arange(4200, len(data)), 300, replace=False):
        changed = bytearray(data)
        changed[byte] ^= 1 << int(byte % 8)
        path.write_bytes(changed)
        outcome = read(path)
        if outcome is not None:
            assert all(isinstance(row, str) or row[1:] in [good[1:] for good in GOOD] for row in outcome[0])


# Bombs


def test_decompression_stops_at_the_bound() -> None:
    zeros = bytes(2**20)
    for method, pack in (
        ("zstd", zstandard.ZstdCompressor().compress),
        ("lz4", lz4.frame.compress),
        ("bz2", __import__("bz2").compress),
        ("", bytes),
    ):
        packed = pack(zeros)
        assert bytes(decompress(method, packed, 2**20, 2**20)) == zeros
        for size, limit in ((2**20, 2**19), (1000, 2**20), (2**20 + 1, 2**21)):
            with pytest.raises(DamageError):
                decompress(method, packed, size, limit)
        if method:
            with pytest.raises(DamageError):
                decompress(method, packed[:-1], 2**20, 2**20)
    with pytest.raises(DamageError, match="unknown compression"):
        decompress("gzip", b"", 0, 1)


def chunk_bomb(declared: int) -> bytes:
    """A small MCAP whose only chunk unpacks to 3 GB of zeros."""
    packed = zstandard.ZstdCompressor(level=1)
    stream = packed.compressobj()
    body = b"".join([*(stream.compress(bytes(2**24)) for _ in range(192)), stream.flush()])
    chunk = struct.pack("<QQQII", 0, 1, declared, 0, 4) + b"zstd" + struct.pack("<Q", len(body)) + body
    header = struct.pack("<II", 0, 0)
    records = b"".join(struct.pack("<BQ", code, len(data)) + data for code, data in ((1, header), (6, chunk)))
    return b"\x89MCAP0\r\n" + records


@pytest.mark.parametrize("declared", [3 * 2**30, 2**63, 1000])
def test_mcap_bomb_is_refused_within_a_bound_of_memory(tmp_path: Path, declared: int) -> None:
    (tmp_path / "bomb.mcap").write_bytes(chunk_bomb(declared))
    code = (
        "import sys; from ropetrace.recordings import open_recording\n"
        "try: open_recording(sys.argv[1])\n"
        "except Exception as error: print(type(error).__name__, error)"
    )

    def bounded() -> None:
        resource.setrlimit(resource.RLIMIT_AS, (2 * 2**30, 2 * 2**30))

    result = subprocess.run(
        [sys.executable, "-c", code, str(tmp_path / "bomb.mcap")],
        capture_output=True,
        text=True,
        check=False,
        preexec_fn=bounded,
        timeout=300,
        env={"OPENBLAS_NUM_THREADS": "1", "PATH": ""},
    )
    assert result.stdout.startswith("RecordingError"), result.stderr
    assert "declares" in result.stdout


def test_records_of_absurd_length_are_damage(tmp_path: Path) -> None:
    for length in (2**63, 2**64 - 1, 2**40):
        record = struct.pack("<BQ", 5, length) + bytes(100)
        (tmp_path / "a.mcap").write_bytes(b"\x89MCAP0\r\n" + record)
        with pytest.raises(RecordingError, match="beyond the end"):
            open_recording(tmp_path / "a.mcap")
    (tmp_path / "a.bag").write_bytes(b"#ROSBAG V2.0\n" + struct.pack("<I", 2**32 - 1) + bytes(100))
    with pytest.raises(RecordingError, match="beyond the end"):
        open_recording(tmp_path / "a.bag")


def test_camera_that_was_altered_in_a_bag_is_noticed(tmp_path: Path) -> None:
    data = bytearray(write_bag(tmp_path / "a.bag", rgbd_messages(ROS1, FRAMES)).read_bytes())
    fx = struct.pack("<d", CAMERA_8X6.fx)
    data[data.index(fx, data.index(fx) + 1) + 6] ^= 4
    (tmp_path / "a.bag").write_bytes(data)
    found = reasons(open_recording(tmp_path / "a.bag"))
    assert len(found) == 1
    assert "camera_info changed" in found[0]


# Random damage


def make_sample(kind: str, folder: Path) -> Path:
    """A sound recording of a kind; what is mutated is the file that is returned."""
    if kind.startswith("mcap"):
        compression = CompressionType[kind.partition("-")[2].upper()]
        return write_mcap(folder / "a.mcap", rgbd_messages(ROS2, FRAMES), chunk_size=500, compression=compression)
    if kind.startswith("bag"):
        return write_bag(folder / "a.bag", rgbd_messages(ROS1, FRAMES), kind.partition("-")[2], 500)
    if kind == "db3":
        return next(write_rosbag2(folder / "bag", rgbd_messages(ROS2, FRAMES)).glob("*.db3"))
    clouds: dict[str, Callable[[], bytes]] = {
        "npy": lambda: npy(POINTS),
        "npz": lambda: npz(points=POINTS, colors=COLORS),
        "ply": ply,
        "ply-ascii": lambda: ply("ascii"),
        "pcd": pcd,
        "pcd-ascii": lambda: pcd("ascii"),
        "pcd-lzf": lambda: pcd("binary_compressed"),
    }
    if kind in clouds:
        path = folder / f"a.{kind.partition('-')[0]}"
        path.write_bytes(clouds[kind]())
        return path
    with RgbdFolderWriter(folder / "rgbd", CAMERA_8X6, 0.001) as writer:
        for frame in FRAMES:
            writer.write(frame)
    if kind == "png":
        return sorted((folder / "rgbd" / "depth").iterdir())[1]
    return folder / "rgbd" / {"camera": "camera.json", "list": "depth.txt"}[kind]


@pytest.mark.parametrize(
    "kind",
    [
        "mcap-zstd",
        "mcap-lz4",
        "mcap-none",
        "bag-none",
        "bag-bz2",
        "bag-lz4",
        "db3",
        "npy",
        "npz",
        "ply",
        "ply-ascii",
        "pcd",
        "pcd-ascii",
        "pcd-lzf",
        "png",
        "camera",
        "list",
    ],
)
def test_random_damage_never_raises_anything_else(tmp_path: Path, kind: str) -> None:
    path = make_sample(kind, tmp_path)
    opened = path
    if kind in ("png", "camera", "list"):
        opened = tmp_path / "rgbd"
    data = path.read_bytes()
    random = np.random.default_rng(zlib.crc32(kind.encode()))
    for _ in range(200):
        path.write_bytes(mutated(data, random))
        if kind.startswith("mcap"):
            check_nothing_is_altered(opened)
        else:
            read(opened)


@pytest.mark.parametrize("encoding", ["cdr", "ros1"])
def test_random_damage_within_messages(tmp_path: Path, encoding: str) -> None:
    """Whole containers around altered messages: only the messages' own checks stand in the way."""
    make = Messages(encoding)
    table = np.zeros(6, np.dtype([("x", "f4"), ("y", "f4"), ("z", "f4"), ("rgb", "u4")]))
    png = images.encode_png(FRAMES[0].depth)
    random = np.random.default_rng(9)
    rows = rgbd_messages(make, FRAMES[:2])
    packed = make.compressed(0, bytes(12) + png, "16UC1; compressedDepth png")
    for topic, message in (
        ("/camera/depth/image_raw", rows[2][3]),
        ("/camera/color/image_raw", rows[1][3]),
        (INFO, rows[0][3]),
        ("/camera/depth/image_raw/compressedDepth", packed),
        ("/points", make.cloud(0, table)),
    ):
        data = make.serialized(message)
        for _ in range(60):
            damaged = [(topic, message.__msgtype__, 0, mutated(data, random)) for _ in range(3)]
            whole = [row for row in rows if row[0] != topic] if topic != "/points" else []
            read(write_mcap(tmp_path / "a.mcap", [*damaged, *whole], encoding))


def test_write_camera_is_sound(tmp_path: Path) -> None:
    """The other tests rely on it."""
    write_camera(tmp_path / "intrinsics.json")
    (tmp_path / "depth_0.png").write_bytes(images.encode_png(FRAMES[0].depth))
    assert len(list(open_recording(tmp_path, rate=1).frames())) == 1


def test_of_very_much_damage_the_middle_is_left_out() -> None:
    problems: list[str] = []
    for _ in range(2):  # as in a second pass
        for index in range(20_000):
            note(problems, f"frame {index} is lost")
        note(problems, "20000 frames are lost")
    assert problems[:2] == ["frame 0 is lost", "frame 1 is lost"]
    assert problems[-1] == "20000 frames are lost"
    assert "is not listed" in " ".join(problems)
    assert len(problems) == 100
