"""Point cloud files."""

from __future__ import annotations

import io
import os
import pickle
import struct
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ropetrace.errors import MissingExtraError, RecordingError
from ropetrace.recordings import clouds, open_recording
from ropetrace.types import BadFrame, CloudFrame

DATA = Path(os.environ.get("ROPETRACE_DATA", Path(__file__).parents[2] / "shared" / "data"))
POINTS = np.random.default_rng(3).normal(size=(20, 3)).astype(np.float32)
COLORS = np.random.default_rng(4).integers(0, 256, (20, 3)).astype(np.uint8)


def ply(form: str = "binary_little_endian", count: Any = 20, colors: bool = True, extra: str = "") -> bytes:
    order = ">" if form == "binary_big_endian" else "<"
    fields = [(name, order + "f4") for name in "xyz"] + [(name, "u1") for name in ("red", "green", "blue")] * colors
    table = np.zeros(20, fields)
    for axis, (position, color) in enumerate(zip("xyz", ("red", "green", "blue"), strict=True)):
        table[position] = POINTS[:, axis]
        if colors:
            table[color] = COLORS[:, axis]
    header = f"ply\nformat {form} 1.0\nelement vertex {count}\n"
    header += "".join(f"property {'float' if 'f' in kind else 'uchar'} {name}\n" for name, kind in fields)
    body = table.tobytes()
    if form == "ascii":
        body = "".join(" ".join(repr(value) for value in row.tolist()) + "\n" for row in table).encode()
    return (header + extra + "end_header\n").encode() + body


def pcd(data: str = "binary", **changes: Any) -> bytes:
    table = np.zeros(20, [("x", "f4"), ("y", "f4"), ("z", "f4"), ("rgb", "u4")])
    for axis, name in enumerate("xyz"):
        table[name] = POINTS[:, axis]
    table["rgb"] = COLORS.astype(np.uint32) @ np.array([65536, 256, 1], np.uint32)
    rows = {
        "VERSION": "0.7",
        "FIELDS": "x y z rgb",
        "SIZE": "4 4 4 4",
        "TYPE": "F F F U",
        "COUNT": "1 1 1 1",
        "WIDTH": 20,
        "HEIGHT": 1,
        "VIEWPOINT": "0 0 0 1 0 0 0",
        "POINTS": 20,
        "DATA": data,
    } | changes
    body = table.tobytes()
    if data == "ascii":
        body = "".join(" ".join(repr(value) for value in row.tolist()) + "\n" for row in table).encode()
    if data == "binary_compressed":
        import lzf  # type: ignore[import-not-found, import-untyped, unused-ignore]

        columns = b"".join(table[name].tobytes() for name in ("x", "y", "z", "rgb"))
        packed = lzf.compress(columns, 2 * len(columns))
        body = struct.pack("<II", len(packed), len(columns)) + packed
    return ("".join(f"{key} {value}\n" for key, value in rows.items())).encode() + body


def npy(array: Any, **options: Any) -> bytes:
    stream = io.BytesIO()
    np.save(stream, array, **options)
    return stream.getvalue()


def npz(**arrays: Any) -> bytes:
    stream = io.BytesIO()
    np.savez_compressed(stream, **arrays)
    return stream.getvalue()


def load(tmp_path: Path, name: str, data: bytes) -> CloudFrame:
    (tmp_path / name).write_bytes(data)
    (event,) = open_recording(tmp_path / name).frames()
    assert isinstance(event, CloudFrame)
    assert event.stamp_ns == 0
    return event


@pytest.mark.parametrize(
    ("name", "make", "colors"),
    [
        ("a.npy", lambda: npy(POINTS), False),
        ("a.npy", lambda: npy(np.asfortranarray(POINTS)), False),
        ("a.npy", lambda: npy(POINTS.astype(">f4")), False),
        ("a.npy", lambda: npy(np.hstack([POINTS, COLORS.astype(np.float32)])), True),
        ("a.npy", lambda: npy(np.hstack([POINTS, (COLORS / 255).astype(np.float32)])), True),
        ("a.npz", lambda: npz(points=POINTS, other=np.zeros(3)), False),
        ("a.npz", lambda: npz(points=POINTS, colors_rgb=COLORS), True),
        ("a.npz", lambda: npz(points=POINTS, colors=COLORS / 255), True),
        ("a.npz", lambda: npz(arr_0=POINTS), False),
        ("a.ply", ply, True),
        ("a.ply", lambda: ply("binary_big_endian"), True),
        ("a.ply", lambda: ply("ascii"), True),
        ("a.ply", lambda: ply(colors=False), False),
        ("a.pcd", pcd, True),
        ("a.pcd", lambda: pcd("ascii"), True),
        ("a.pcd", lambda: pcd("binary_compressed"), True),
    ],
)
def test_every_kind_is_exact(tmp_path: Path, name: str, make: Callable[[], bytes], colors: bool) -> None:
    event = load(tmp_path, name, make())
    assert np.array_equal(event.points, POINTS)
    assert event.points.dtype.kind == "f"
    assert event.points.flags.writeable
    assert (event.colors is not None) == colors
    assert event.colors is None or np.array_equal(event.colors, COLORS)


def test_numbers_of_every_kind(tmp_path: Path) -> None:
    assert load(tmp_path, "a.npy", npy(POINTS.astype(np.float64))).points.dtype == np.float64
    assert load(tmp_path, "a.npy", npy(np.arange(12).reshape(4, 3))).points.tolist()[3] == [9.0, 10.0, 11.0]
    assert load(tmp_path, "a.npy", npy(POINTS.astype(np.float16))).points.dtype == np.float32
    assert load(tmp_path, "a.npy", npy(np.empty((0, 3)))).points.shape == (0, 3)


def test_folder_in_natural_order_with_one_bad_file(tmp_path: Path) -> None:
    for number in (10, 9, 1):
        (tmp_path / f"c{number}.npy").write_bytes(npy(np.full((2, 3), number, np.float32)))
    (tmp_path / "c2.npy").write_bytes(b"junk")
    with pytest.raises(RecordingError, match="--rate"):
        open_recording(tmp_path)
    recording = open_recording(tmp_path, rate=4)
    events = list(recording.frames())
    assert [event.stamp_ns for event in events] == [0, 250_000_000, 500_000_000, 750_000_000]
    assert isinstance(events[1], BadFrame)
    assert [float(event.points[0, 0]) for event in events if isinstance(event, CloudFrame)] == [1, 9, 10]
    assert recording.frame_count == 4
    assert "1 of 4 files" in recording.info().problems[0]


class Evil:
    def __reduce__(self) -> tuple[Any, tuple[str]]:
        return os.mkdir, ("/tmp/ropetrace-was-here",)


def header_of(shape: str, kind: str = "<f4") -> bytes:
    header = f"{{'descr': '{kind}', 'fortran_order': False, 'shape': {shape}}}\n".encode()
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(header)) + header


def bomb() -> bytes:
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("points.npy", npy(POINTS))
    data = stream.getvalue()
    at = data.index(b"PK\x01\x02")
    return data[: at + 24] + struct.pack("<I", 2**31) + data[at + 28 :]


@pytest.mark.parametrize(
    ("name", "make", "words"),
    [
        ("a.npy", lambda: npy(np.array([Evil()]), allow_pickle=True), "object"),
        ("a.npy", lambda: pickle.dumps(Evil()), "damaged"),
        ("a.npy", lambda: header_of("(1000000000000, 3)"), "not of that length"),
        ("a.npy", lambda: header_of("(-1, 3)"), "not of that length"),
        ("a.npy", lambda: header_of("(0, 3, 99999999999999999999)"), "damaged"),
        ("a.npy", lambda: header_of("(2, 3)") + bytes(23), "not of that length"),
        ("a.npy", lambda: header_of("__import__('os')"), "damaged"),
        ("a.npy", lambda: npy(np.zeros((4, 4))), r"shape \(4, 4\)"),
        ("a.npy", lambda: npy(np.zeros(4, [("x", "f4")])), "must be numbers"),
        ("a.npy", lambda: npy(np.array([["a"] * 3])), "must be numbers"),
        ("a.npz", lambda: npz(markers=POINTS, keys=COLORS), "'markers', 'keys'"),
        ("a.npz", lambda: npz(points=POINTS, colors=COLORS[:5]), "point colours"),
        ("a.npz", lambda: npz(points=POINTS, colors=COLORS * 3.0), "colours of"),
        ("a.npz", bomb, "declares 2147483648"),
        ("a.npz", lambda: npz(points=POINTS)[:-30], "damaged"),
        ("a.npz", lambda: b"PK", "damaged"),
        ("a.ply", lambda: ply(count=-1), "element vertex -1"),
        ("a.ply", lambda: ply(count=10**12), "too short"),
        ("a.ply", lambda: ply(count=21), "too short"),
        ("a.ply", lambda: ply("ascii", count=10**9), "too short"),
        (
            "a.ply",
            lambda: ply(extra="element face 1000000000\nproperty list uchar int vertex_index\n"),
            "too short",
        ),
        ("a.ply", lambda: ply(extra="property float\n")[:200], "PLY"),
        ("a.ply", lambda: ply().replace(b"property float x", b"property float w"), "damaged"),
        ("a.ply", lambda: b"ply\n", "no whole header"),
        ("a.pcd", lambda: pcd(COUNT="-1 1 1 1"), "COUNT -1"),
        ("a.pcd", lambda: pcd(POINTS=10**12, WIDTH=10**12), "not of that length"),
        ("a.pcd", lambda: pcd(WIDTH=21), "does not fit"),
        ("a.pcd", lambda: pcd(POINTS=-1), "POINTS -1"),
        ("a.pcd", lambda: pcd(SIZE="4 4 4"), "not of one length"),
        ("a.pcd", lambda: pcd(COUNT="1 1 1 100000"), "PCD header declares"),
        ("a.pcd", lambda: pcd(FIELDS="x y w rgb"), "needs the fields x, y, z"),
        ("a.pcd", lambda: pcd("ascii", POINTS=10**7, WIDTH=10**7), "not of that length"),
        ("a.pcd", lambda: pcd("binary_compressed", POINTS=10**6, WIDTH=10**6), "not of that length"),
        ("a.pcd", lambda: b"# .PCD\n", "no whole header"),
    ],
)
def test_bad_file_is_refused(tmp_path: Path, name: str, make: Callable[[], bytes], words: str) -> None:
    (tmp_path / name).write_bytes(make())
    with pytest.raises(RecordingError, match=words) as caught:
        list(open_recording(tmp_path / name).frames())
    assert str(tmp_path / name) in str(caught.value)
    assert "\n" not in str(caught.value)
    assert not Path("/tmp/ropetrace-was-here").exists()


def test_missing_package_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def absent(module: str, extra: str) -> Any:
        raise MissingExtraError(f"pip install 'ropetrace[{extra}]'")

    monkeypatch.setattr(clouds, "import_extra", absent)
    (tmp_path / "a.ply").write_bytes(ply())
    with pytest.raises(MissingExtraError, match=r"ropetrace\[clouds\]"):
        open_recording(tmp_path / "a.ply")


@pytest.mark.skipif(not (DATA / "kinect_rope").is_dir(), reason=f"no recorded data in {DATA}")
def test_real_clouds() -> None:
    counts = {}
    for name in ("kinect_rope", "xtion_cable", "azure_soft_joint", "branched_cable_cloud"):
        events = list(open_recording(DATA / name, rate=30).frames())
        counts[name] = [
            (len(event.points), event.colors is not None) for event in events if isinstance(event, CloudFrame)
        ]
    assert counts == {
        "kinect_rope": [(921, True), (272, False)],
        "xtion_cable": [(12450, True), (89931, True)],
        "azure_soft_joint": [(805, False), (706, False), (1005, False), (849, False)],
        "branched_cable_cloud": [(7166, False)],
    }
