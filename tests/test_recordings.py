"""The door, folders of images, images, and pairing."""

from __future__ import annotations

import io
import os
import socket
import struct
import subprocess
import sys
import zlib
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image

from recordings_samples import CAMERA_8X6, STEP_NS, contents, make_frames, reasons, write_camera
from ropetrace.errors import FrameError, OutputError, RecordingError
from ropetrace.recordings import images, open_recording
from ropetrace.recordings.pairing import BUFFERED, Pairing
from ropetrace.recordings.rgbd_folder import RgbdFolderWriter, format_stamp, parse_stamp
from ropetrace.types import RgbdFrame

DATA = Path(os.environ.get("ROPETRACE_DATA", Path(__file__).parents[2] / "shared" / "data"))


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    path = tmp_path / "recording"
    with RgbdFolderWriter(path, CAMERA_8X6, 0.001) as writer:
        for frame in make_frames(5):
            writer.write(frame)
    return path


# The door


@pytest.mark.parametrize("path", ["nowhere", "bad\0name"])
def test_missing_path(path: str) -> None:
    with pytest.raises(RecordingError, match=r"cannot be read|not a path"):
        open_recording(path)


def test_what_is_no_recording_is_refused_in_one_line(tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    (tmp_path / "zero.mcap").touch()
    (tmp_path / "zero.bin").touch()
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "notes.txt").write_text("x")
    (tmp_path / "text.txt").write_text("hello")
    os.mkfifo(tmp_path / "fifo.mcap")
    (tmp_path / "loop").symlink_to(tmp_path / "loop")
    (tmp_path / "packed").mkdir()
    (tmp_path / "packed" / "a_0.db3.zstd").write_bytes(b"x")
    (tmp_path / "both").mkdir()
    (tmp_path / "both" / "a.db3").write_bytes(b"x")
    (tmp_path / "both" / "a.mcap").write_bytes(b"x")
    listener = socket.socket(socket.AF_UNIX)
    listener.bind(str(tmp_path / "socket"))
    listener.close()
    expected = {
        "empty": "folder is empty",
        "zero.mcap": "0 bytes",
        "zero.bin": "0 bytes",
        "other": "'notes.txt'",
        "text.txt": "b'hello'",
        "fifo.mcap": "FIFO",
        "loop": "cannot be read",
        "packed": "zstd -d",
        "both": "both .mcap and .db3",
        "socket": "FIFO or socket",
    }
    for name, words in expected.items():
        with pytest.raises(RecordingError) as caught:
            open_recording(tmp_path / name)
        assert words in str(caught.value), name
        assert "\n" not in str(caught.value)
    with pytest.raises(RecordingError, match="device"):
        open_recording("/dev/zero")


@pytest.mark.skipif(os.geteuid() == 0, reason="root may read everything")
def test_no_permission(folder: Path) -> None:
    folder.chmod(0)
    with pytest.raises(RecordingError, match="Permission denied"):
        open_recording(folder)
    folder.chmod(0o700)


@pytest.mark.parametrize("rate", [0.0, -1.0, float("nan"), float("inf")])
def test_impossible_rate(folder: Path, rate: float) -> None:
    with pytest.raises(RecordingError, match="rate"):
        open_recording(folder, rate=rate)


def test_settings_that_mean_nothing_are_refused(folder: Path) -> None:
    with pytest.raises(RecordingError, match="stamps of its own"):
        open_recording(folder, rate=30)
    with pytest.raises(RecordingError, match="has no topics"):
        open_recording(folder, depth_topic="/depth")
    with pytest.raises(RecordingError, match="pairing bound"):
        open_recording(folder, max_pair_gap=float("nan"))


def test_import_is_light() -> None:
    code = (
        "import sys, ropetrace.recordings; "
        "sys.exit(','.join({'PIL', 'mcap', 'rosbags', 'scipy', 'trimesh'} & set(sys.modules)) or 0)"
    )
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stderr


# RGB-D folders


@pytest.mark.parametrize("color", [True, False])
def test_rgbd_folder_roundtrip_is_exact(tmp_path: Path, color: bool) -> None:
    frames = make_frames(4, color=color)
    with RgbdFolderWriter(tmp_path / "new", CAMERA_8X6, 0.00025) as writer:
        frames = [RgbdFrame(f.stamp_ns, f.depth, 0.00025, CAMERA_8X6, f.color) for f in frames]
        for frame in frames:
            writer.write(frame)
            # Readable at any time: a writer that is killed loses nothing that it has written.
            assert contents(open_recording(tmp_path / "new").frames())[-1:] == contents([frame])
    recording = open_recording(tmp_path / "new")
    assert recording.frame_count == 4
    assert recording.intrinsics == CAMERA_8X6
    assert contents(recording.frames()) == contents(frames)
    assert contents(recording.frames()) == contents(frames)  # again
    assert contents(recording.frames(1, 2)) == contents(frames[1:3])
    assert recording.problems == []


def test_info_of_a_folder(folder: Path) -> None:
    info = open_recording(folder).info()
    depth, color = info.streams
    assert (depth.count, depth.width, depth.height, depth.not_rising) == (5, 8, 6, 0)
    assert depth.rate_hz == pytest.approx(1e9 / STEP_NS)
    assert depth.largest_gap == pytest.approx(STEP_NS / 1e9)
    assert color.name == "rgb"
    assert info.duration == pytest.approx(4 * STEP_NS / 1e9)
    assert info.problems == ()


def test_repeated_and_backward_stamps_are_passed_on_and_counted(folder: Path) -> None:
    lines = (folder / "depth.txt").read_text().splitlines()
    (folder / "depth.txt").write_text("\n".join([*lines, lines[2], lines[2]]))
    recording = open_recording(folder)
    stamps = [event.stamp_ns for event in recording.frames()]
    assert stamps[-2:] == [stamps[1], stamps[1]]
    assert recording.info().streams[0].not_rising == 2


@given(st.integers(-(10**18), 10**18))
def test_stamps_are_exact(stamp_ns: int) -> None:
    assert parse_stamp(format_stamp(stamp_ns)) == stamp_ns


@pytest.mark.parametrize("text", ["", "nan", "inf", "1e5", "1.2.3", "0x10", "-", "1" * 99, "1,5", "\u0661"])
def test_what_is_no_stamp(text: str) -> None:
    assert parse_stamp(text) is None


def test_one_bad_frame_does_not_end_the_stream(folder: Path) -> None:
    good = contents(make_frames(5))
    files = sorted((folder / "depth").iterdir())
    data = files[1].read_bytes()

    def becomes(change: bytes | None, words: str) -> None:
        files[1].unlink(missing_ok=True)
        if change is not None:
            files[1].write_bytes(change)
        events = contents(open_recording(folder).frames())
        assert events[:1] + events[2:] == good[:1] + good[2:]
        assert words in events[1]

    becomes(None, "No such file")
    becomes(b"", "empty")
    becomes(data[:-20], "truncated")
    becomes(data[:60] + bytes([data[60] ^ 1]) + data[61:], "checksum")
    becomes(images.encode_png(np.zeros((7, 8), np.uint16)), "8x7")
    becomes(images.encode_png(np.zeros((6, 8, 3), np.uint8)), "16-bit")
    eight = io.BytesIO()
    Image.new("L", (8, 6)).save(eight, "PNG")
    becomes(eight.getvalue(), "8-bit; depth needs 16-bit PNG")
    problems = open_recording(folder).info().problems
    assert problems == ()  # a sound PNG of the wrong kind is for frames() to refuse
    files[1].write_bytes(data[:-20])
    assert "1 of 5 depth images are unreadable" in open_recording(folder).info().problems[0]
    files[1].unlink()
    os.mkfifo(files[1])
    assert "not a regular file" in reasons(open_recording(folder))[0]


def test_colour_that_does_not_fit_makes_a_bad_frame(folder: Path) -> None:
    color = sorted((folder / "rgb").iterdir())
    color[0].write_bytes(images.encode_png(np.zeros((12, 16, 3), np.uint8)))
    color[1].write_bytes(b"\x89PNG broken")
    lines = (folder / "rgb.txt").read_text().splitlines()
    (folder / "rgb.txt").write_text("\n".join(lines[:-1]))
    found = reasons(open_recording(folder))
    assert "16x12 but depth is 8x6" in found[0]
    assert "colour image" in found[1]
    assert "no colour image within 20 ms" in found[2]
    assert len(found) == 3
    assert len(reasons(open_recording(folder, max_pair_gap=0.05))) == 2


def test_jpeg_colour(folder: Path) -> None:
    stream = io.BytesIO()
    Image.new("RGB", (8, 6), (250, 10, 20)).save(stream, "JPEG")
    for file in (folder / "rgb").iterdir():
        file.write_bytes(stream.getvalue())
    frame = next(open_recording(folder).frames())
    assert isinstance(frame, RgbdFrame)
    assert frame.color is not None
    assert np.abs(frame.color.astype(int) - [250, 10, 20]).max() < 6


@pytest.mark.parametrize("path", ["../secret.png", "/etc/passwd", "depth/../../x.png", "link/x.png", "depth/out.png"])
def test_paths_must_not_leave_the_folder(folder: Path, path: str) -> None:
    (folder / "link").symlink_to(folder.parent)
    (folder / "depth" / "out.png").symlink_to("/etc/passwd")
    with (folder / "depth.txt").open("a") as stream:
        stream.write(f"1.5 {path}\n")
    with pytest.raises(RecordingError, match=r"line 7: .* leaves the folder"):
        open_recording(folder)


def test_links_within_the_folder_are_fine(folder: Path) -> None:
    (folder / "depth").rename(folder / "images")
    (folder / "depth").symlink_to("images")
    assert contents(open_recording(folder).frames()) == contents(make_frames(5))


def test_unreadable_lines_are_a_problem(folder: Path) -> None:
    with (folder / "depth.txt").open("ab") as stream:
        stream.write(b"nonsense here\n\xff\xfe 1\n12.5")
    recording = open_recording(folder)
    assert recording.problems == ["depth.txt: 3 lines are not 'seconds path' and are left out, the first is line 7"]
    assert contents(recording.frames()) == contents(make_frames(5))


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "empty"),
        ("{", "not JSON"),
        ("[1]", "list"),
        ("[" * 100_000, "not JSON"),
        ('{"width": 1' + "0" * 5000 + "}", "not JSON"),
        ("\xff", "not JSON"),
    ],
)
def test_camera_that_is_no_camera(folder: Path, text: str, words: str) -> None:
    (folder / "camera.json").write_bytes(text.encode("latin1"))
    with pytest.raises(RecordingError, match=words):
        open_recording(folder)


@pytest.mark.parametrize(
    "change",
    [
        {"fx": 0},
        {"fx": float("nan")},
        {"width": 1e300},
        {"width": 8.5},
        {"fy": "9"},
        {"cx": True},
        {"cy": None},
        {"depth_unit_m": 0},
        {"depth_unit_m": 1000},
        {"cx": 10**400},
        {"height": -6},
    ],
)
def test_camera_with_an_impossible_value(folder: Path, change: dict[str, object]) -> None:
    write_camera(folder / "camera.json", **change)
    with pytest.raises(RecordingError, match=next(iter(change)) + "|image size"):
        open_recording(folder)


def test_missing_camera_names_the_keys(folder: Path) -> None:
    (folder / "camera.json").unlink()
    with pytest.raises(RecordingError, match="width, height, fx, fy, cx, cy, depth_unit_m"):
        open_recording(folder)


def test_writer_refuses(tmp_path: Path, folder: Path) -> None:
    with pytest.raises(OutputError, match="not empty"):
        RgbdFolderWriter(folder, CAMERA_8X6, 0.001)
    with pytest.raises(OutputError, match="cannot be written"):
        RgbdFolderWriter(folder / "camera.json" / "x", CAMERA_8X6, 0.001)
    with RgbdFolderWriter(tmp_path / "new", CAMERA_8X6, 0.001) as writer:
        with pytest.raises(OutputError, match="float32"):
            writer.write(make_frames(1, np.float32)[0])
        frame = make_frames(1)[0]
        with pytest.raises(OutputError, match="depth unit"):
            writer.write(RgbdFrame(0, frame.depth, 0.002, CAMERA_8X6))


# Plain folders


def test_plain_folder(tmp_path: Path) -> None:
    write_camera(tmp_path / "intrinsics.json", note="extra")
    for i in (10, 9, 2):
        (tmp_path / f"depth_{i}.png").write_bytes(images.encode_png(np.full((6, 8), i, np.uint16)))
    (tmp_path / "depth_11.png").write_bytes(b"nothing")
    with pytest.raises(RecordingError, match="--rate"):
        open_recording(tmp_path)
    recording = open_recording(tmp_path, rate=10)
    events = list(recording.frames())
    assert [event.stamp_ns for event in events] == [0, 10**8, 2 * 10**8, 3 * 10**8]
    assert [int(event.depth[0, 0]) for event in events if isinstance(event, RgbdFrame)] == [2, 9, 10]
    assert recording.frame_count == 4
    assert "depth_11.png" in recording.info().problems[0]
    (tmp_path / "intrinsics.json").unlink()
    with pytest.raises(RecordingError, match=r"intrinsics\.json.*depth_unit_m"):
        open_recording(tmp_path, rate=10)


@pytest.mark.skipif(not (DATA / "bcpd_rope_d435").is_dir(), reason=f"no recorded data in {DATA}")
def test_real_depth_folder() -> None:
    recording = open_recording(DATA / "bcpd_rope_d435", rate=30)
    frames = [event for event in recording.frames() if isinstance(event, RgbdFrame)]
    assert [int((frame.depth > 0).sum()) for frame in frames] == [21586, 21454, 22239, 22179, 22955, 22387]
    assert recording.info().problems == ()
    assert frames[0].intrinsics.fx == 918.359130859375


# Images


@settings(max_examples=30, deadline=None)
@given(st.integers(1, 40), st.integers(1, 40), st.integers(0, 2**32 - 1))
def test_png_is_exact(width: int, height: int, seed: int) -> None:
    random = np.random.default_rng(seed)
    depth = random.integers(0, 65536, (height, width)).astype(np.uint16)
    color = random.integers(0, 256, (height, width, 3)).astype(np.uint8)
    assert np.array_equal(images.decode_depth(images.encode_png(depth)), depth)
    assert np.array_equal(images.decode_color(images.encode_png(color)), color)


def test_no_flipped_bit_of_a_png_goes_unnoticed() -> None:
    depth = np.random.default_rng(0).integers(0, 65536, (6, 8)).astype(np.uint16)
    data = images.encode_png(depth)
    for bit in range(8 * len(data)):
        changed = bytearray(data)
        changed[bit // 8] ^= 1 << bit % 8
        with pytest.raises(FrameError):
            images.decode_depth(bytes(changed))


def test_no_truncated_png_goes_unnoticed() -> None:
    data = images.encode_png(np.arange(48, dtype=np.uint16).reshape(6, 8))
    for length in range(len(data)):
        with pytest.raises(FrameError):
            images.check_png(data[:length])


def png_chunk(name: bytes, payload: bytes) -> bytes:
    return struct.pack(">I", len(payload)) + name + payload + struct.pack(">I", zlib.crc32(name + payload))


@pytest.mark.parametrize("size", [(60000, 60000), (2**31 - 1, 2**31 - 1), (0, 5), (64_000_001, 1)])
def test_png_bombs_are_refused_by_their_header(size: tuple[int, int]) -> None:
    header = png_chunk(b"IHDR", struct.pack(">IIBBBBB", *size, 16, 0, 0, 0, 0))
    data = images.PNG_SIGNATURE + header + png_chunk(b"IDAT", zlib.compress(b"")) + png_chunk(b"IEND", b"")
    with pytest.raises(FrameError, match="declares"):
        images.decode_depth(data)


def test_png_with_too_few_pixels_and_right_checksums_is_refused() -> None:
    header = png_chunk(b"IHDR", struct.pack(">IIBBBBB", 64, 64, 16, 0, 0, 0, 0))
    few = png_chunk(b"IDAT", zlib.compress(bytes(129 * 10)))
    with pytest.raises(FrameError, match="damaged"):
        images.decode_depth(images.PNG_SIGNATURE + header + few + png_chunk(b"IEND", b""))


def test_jpeg_bomb_is_refused() -> None:
    stream = io.BytesIO()
    Image.new("RGB", (8, 8)).save(stream, "JPEG")
    data = stream.getvalue()
    at = data.index(b"\xff\xc0")
    for size in (60000, 12000):
        bomb = data[: at + 5] + struct.pack(">HH", size, size) + data[at + 9 :]
        with pytest.raises(FrameError):
            images.decode_color(bomb)


# Pairing


def paired(rows: list[tuple[str, int]], gap: int) -> dict[int, int | str]:
    """Runs (stream, stamp) rows through a Pairing; each image is its own stamp."""
    pairing = Pairing[int, int](gap)
    out: list[tuple[int, int, int | str]] = []
    for stream, stamp in rows:
        add = pairing.add_depth if stream == "depth" else pairing.add_color
        out.extend(add(stamp, stamp, 1))
    out.extend(pairing.finish())
    assert [row[1] for row in out] == [stamp for stream, stamp in rows if stream == "depth"]
    return {depth: color for _, depth, color in out}


def test_pairing_takes_the_nearest_whatever_comes_first() -> None:
    rows = [("color", 0), ("depth", 9), ("depth", 21), ("color", 10), ("color", 20), ("color", 30)]
    assert paired(rows, 5) == {9: 10, 21: 20}


def test_pairing_keeps_its_bound() -> None:
    assert paired([("depth", 100), ("color", 110)], 10) == {100: 110}
    unpaired = paired([("depth", 100), ("color", 111)], 10)[100]
    assert isinstance(unpaired, str)
    assert "the nearest is 1.1e-05 ms away" in unpaired
    assert "there is none" in str(paired([("depth", 100)], 10)[100])


def test_pairing_does_not_take_the_colour_of_the_frame_beside() -> None:
    step = 17
    rows = [(stream, number * step) for number in range(20) for stream in ("color", "depth")]
    found = paired([row for row in rows if row != ("color", 15 * step)], 20)
    assert isinstance(found.pop(15 * step), str)
    assert all(depth == color for depth, color in found.items())
    # Stamps of arrival may come in pairs.
    pairs = [(stream, stamp + late) for stamp in range(0, 1200, 66) for late in (0, 4) for stream in ("color",)]
    depths = [("depth", stamp + 19) for stamp in range(0, 1200, 66)]
    assert not any(isinstance(one, str) for one in paired(sorted(pairs + depths, key=lambda row: row[1]), 20).values())
    # Depth that is faster than colour has none nearer.
    slow = [(stream, stamp) for stamp in range(0, 500, 10) for stream in ("color", "depth")]
    assert not any(
        isinstance(one, str) for one in paired([r for r in slow if r[0] == "depth" or r[1] % 30 == 0], 20).values()
    )


def test_pairing_never_waits_for_ever() -> None:
    pairing = Pairing[int, int](1)
    left = [row for stamp in range(1000) for row in pairing.add_depth(stamp, stamp, 1)]
    assert len(left) == 1000 - BUFFERED
    big = Pairing[int, int](1)
    assert sum(1 for stamp in range(10) for _ in big.add_depth(stamp, stamp, 100 * 2**20)) == 8


def test_pairing_when_the_clock_is_set_back() -> None:
    for first, second in (("depth", "color"), ("color", "depth")):
        times = [*range(1000, 2000, 100), *range(500, 1500, 100)]
        rows = [row for time in times for row in ((first, time), (second, time))]
        pairing = Pairing[tuple[int, int], tuple[int, int]](10)
        out: list[tuple[int, tuple[int, int], tuple[int, int] | str]] = []
        for number, (stream, time) in enumerate(rows):
            add = pairing.add_depth if stream == "depth" else pairing.add_color
            out.extend(add(time, (number // 2, time), 1))
        out.extend(pairing.finish())
        assert [color for _, _, color in out] == [depth for _, depth, _ in out], (first, second)


@settings(max_examples=50, deadline=None)
@given(
    st.lists(st.integers(0, 500), min_size=1, max_size=40, unique=True),
    st.integers(0, 40),
    st.integers(0, 30),
)
def test_pairing_equals_a_search_over_everything(colors: list[int], delay: int, gap: int) -> None:
    depths = list(range(0, 500, 33))
    arrivals = sorted([(time, "color", time) for time in colors] + [(time + delay, "depth", time) for time in depths])
    found = paired([(stream, stamp) for _, stream, stamp in arrivals], gap)
    ordered = np.array(sorted(colors))
    steps = (ordered[2:] - ordered[:-2]) // 2
    beside = 3 * steps.min() // 4 if len(steps) >= 3 else gap
    for depth in depths:
        best = min(abs(color - depth) for color in colors)
        color = found[depth]
        assert isinstance(color, str) or best <= gap
        assert not isinstance(color, str) or best > min(gap, beside)
        assert isinstance(color, str) or abs(color - depth) == best
