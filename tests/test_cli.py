"""The command line, end to end: what a newcomer types, and what it says when something is wrong."""

from __future__ import annotations

import csv
import dataclasses
import itertools
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from helpers import DATA, needs_data
from ropetrace import cli, cli_track, demo, terminal
from ropetrace.cli_source import Part
from ropetrace.errors import RecordingError
from ropetrace.live import LiveRecording
from ropetrace.recordings import open_recording
from ropetrace.recordings.base import NO_COLOR
from ropetrace.recordings.mcap_file import McapFrameWriter
from ropetrace.recordings.rgbd_folder import RgbdFolder, RgbdFolderWriter
from ropetrace.results.base import COLUMNS
from ropetrace.results.text import CsvWriter
from ropetrace.sim.camera import Capsules, RayCaster, Scene
from ropetrace.terminal import BAD_INPUT, DAMAGED, INTERRUPTED, NOTHING_FOUND
from ropetrace.tracking import track_recording
from ropetrace.types import Event, Intrinsics, RgbdFrame

CAMERA = Intrinsics(160, 120, 145.0, 145.0, 79.5, 59.5)
COLOR = "#c8281e"
FRAMES = 8

Run = Callable[..., tuple[int, str, str]]


def rope_frames(count: int = FRAMES, color: bool = True) -> list[RgbdFrame]:
    """Small frames of the demo's rope before nothing, 30 Hz."""
    caster = RayCaster(CAMERA)
    frames = []
    for index in range(count):
        image = caster.render(Scene(Capsules.along(demo.rope_curve(index / 30), 0.012, demo.COLOR)))
        depth = np.round(image.depth * 1000).astype(np.uint16)
        stamp = 10**18 + round(index * 1e9 / 30)
        frames.append(RgbdFrame(stamp, depth, 0.001, CAMERA, image.color.copy() if color else None))
    return frames


def write_folder(path: Path, frames: list[RgbdFrame]) -> Path:
    with RgbdFolderWriter(path, CAMERA, 0.001) as writer:
        for frame in frames:
            writer.write(frame)
    return path


def write_mcap(path: Path, frames: list[RgbdFrame]) -> Path:
    with McapFrameWriter(path, CAMERA, 0.001) as writer:
        for frame in frames:
            writer.write(frame)
    return path


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_folder(tmp_path_factory.mktemp("recordings") / "rope", rope_frames())


@pytest.fixture
def run(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Run:
    """Run the command line in an empty folder; its exit code, and what it printed to both streams."""
    monkeypatch.chdir(tmp_path)

    def call(*arguments: object) -> tuple[int, str, str]:
        monkeypatch.setattr(sys, "argv", ["ropetrace", *map(str, arguments)])
        before = {number: signal.getsignal(number) for number in terminal.ENDINGS}
        try:
            cli.main()
            code: object = 0
        except SystemExit as error:
            code = error.code
        finally:
            for number, handler in before.items():
                signal.signal(number, handler)
        out, err = capsys.readouterr()
        assert "Traceback" not in out + err
        return int(code) if isinstance(code, int) else 1, out, err

    return call


def rows(path: Path) -> list[dict[str, str]]:
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def statuses(path: Path) -> dict[int, str]:
    return {int(row["frame"]): row["status"] for row in rows(path)}


def test_demo_makes_tracks_and_draws(run: Run, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(demo, "FRAMES", 6)
    code, out, _ = run("demo")
    assert code == 0
    result = tmp_path / "ropetrace-demo" / "result.csv"
    assert set(statuses(result).values()) == {"ok"}
    assert len(statuses(result)) == 6
    with Image.open(tmp_path / "ropetrace-demo" / "result.png") as picture:
        pixels = np.asarray(picture)
    assert ((pixels == (255, 200, 0)).all(axis=2)).sum() > 200, "the centreline is drawn"
    for name in ("recording", "result.csv", "result.png"):
        assert str(Path("ropetrace-demo") / name) in out
    error = float(out.split("error")[1].split()[0])
    assert 0 < error < 1.0
    assert run("demo")[0] == 0, "a second demo uses the recording again"


def test_the_demos_last_line_works_as_printed(run: Run, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(demo, "FRAMES", 3)
    out = run("demo")[1]
    command = out.strip().splitlines()[-1].split()
    code, _, _ = run(*[word.strip("'") for word in command[1:]])
    assert code == 0
    assert (tmp_path / "my-result.csv").read_bytes() == (tmp_path / "ropetrace-demo" / "result.csv").read_bytes()


def test_track_writes_every_format_and_the_settings(run: Run, folder: Path, tmp_path: Path) -> None:
    outputs = ["r.csv", "r.npz", "r.parquet", "r.mcap", "r.rrd"]
    code, out, _ = run("track", folder, "--diameter", "24mm", "--color", COLOR, "--out", *outputs, "--picture", "r.png")
    assert code == 0, out
    table = rows(tmp_path / "r.csv")
    assert tuple(table[0]) == COLUMNS
    assert {row["frame"] for row in table} == {str(k) for k in range(FRAMES)}
    with np.load(tmp_path / "r.npz", allow_pickle=False) as arrays:
        assert len(arrays["positions"]) == len(table)
        np.testing.assert_allclose(arrays["positions"][5], [float(table[5][axis]) for axis in "xyz"], rtol=1e-12)
    for name in outputs:
        assert (tmp_path / name).stat().st_size > 500
        settings = (tmp_path / f"{name}.toml").read_text()
        assert "diameter = 0.024" in settings
        assert "variance_threshold" in settings
    assert (tmp_path / "r.png").exists()
    # The settings that were written are settings that can be read.
    assert run("track", folder, "--config", "r.csv.toml", "--out", "again.csv")[0] == 0
    assert (tmp_path / "again.csv").read_bytes() == (tmp_path / "r.csv").read_bytes()


def test_start_and_limit_keep_the_recordings_frame_numbers(run: Run, folder: Path, tmp_path: Path) -> None:
    assert run("track", folder, "-d", "24mm", "-c", COLOR, "--start", 3, "--limit", 2, "--out", "r.csv")[0] == 0
    assert sorted(statuses(tmp_path / "r.csv")) == [3, 4]


def test_an_mcap_tracks_like_the_folder(run: Run, folder: Path, tmp_path: Path) -> None:
    write_mcap(tmp_path / "rope.mcap", rope_frames())
    assert run("track", folder, "-d", "24mm", "-c", COLOR, "--out", "a.csv")[0] == 0
    assert run("track", "rope.mcap", "-d", "24mm", "-c", COLOR, "--out", "b.csv")[0] == 0
    assert (tmp_path / "a.csv").read_bytes() == (tmp_path / "b.csv").read_bytes()


def test_results_in_the_world(run: Run, folder: Path, tmp_path: Path) -> None:
    (tmp_path / "rope.toml").write_text(
        'diameter = "24mm"\ncolor = "#c8281e"\ncamera_pose = [1.0, 2.0, 3.0, 0, 0, 0, 1]\n'
    )
    assert run("track", folder, "--config", "rope.toml", "--out", "camera.csv")[0] == 0
    assert run("track", folder, "--config", "rope.toml", "--frame", "world", "--out", "world.csv")[0] == 0
    camera, world = rows(tmp_path / "camera.csv")[7], rows(tmp_path / "world.csv")[7]
    assert float(world["x"]) - float(camera["x"]) == pytest.approx(1.0)
    assert float(world["z"]) - float(camera["z"]) == pytest.approx(3.0)


def positions(path: Path) -> np.ndarray:
    return np.array([[float(row[axis]) for axis in "xyz"] for row in rows(path)])


def test_predicted_results(run: Run, folder: Path, tmp_path: Path) -> None:
    common = ["track", folder, "-d", "24mm", "-c", COLOR]
    assert run(*common, "--out", "plain.csv")[0] == 0
    assert run(*common, "--predict", "40ms", "--out", "ahead.csv")[0] == 0
    plain, ahead = rows(tmp_path / "plain.csv"), rows(tmp_path / "ahead.csv")
    assert [(row["frame"], row["stamp_ns"]) for row in plain] == [(row["frame"], row["stamp_ns"]) for row in ahead]
    assert {row["vx"] == "" for row in plain if row["frame"] == "0"} == {True}
    assert {row["vx"] == "" for row in plain if row["frame"] == "5"} == {False}
    assert {(row["frame"] == "0", row["ahead_ns"]) for row in ahead} == {(True, "0"), (False, "40000000")}
    moved = np.linalg.norm(positions(tmp_path / "ahead.csv") - positions(tmp_path / "plain.csv"), axis=1)
    frame = np.array([int(row["frame"]) for row in plain])
    assert moved[frame == 0].max() == 0
    assert 0 < moved[frame == 5].max() < 0.1
    assert run(*common, "--predict", "now", "--out", "now.csv")[0] == 0
    assert len(rows(tmp_path / "now.csv")) == len(plain)


def test_nothing_is_predicted_without_the_motion(run: Run, folder: Path, tmp_path: Path) -> None:
    (tmp_path / "rope.toml").write_text(f'diameter = "24mm"\ncolor = "{COLOR}"\n[motion]\nmethod = "none"\n')
    code, _, err = run("track", folder, "--config", "rope.toml", "--predict", "40ms", "--out", "r.csv")
    assert code == BAD_INPUT
    assert "--predict needs the motion" in err
    assert 'motion.method = "none"' in err
    assert run("track", folder, "--config", "rope.toml", "--out", "r.csv")[0] == 0
    assert {row["vx"] for row in rows(tmp_path / "r.csv")} == {""}


def test_a_mask_replaces_the_colour(run: Run, tmp_path: Path) -> None:
    write_folder(tmp_path / "rope", rope_frames(color=False))
    Image.fromarray(np.full((120, 160), 255, np.uint8)).save(tmp_path / "mask.png")
    Image.fromarray(np.zeros((120, 160), np.uint8)).save(tmp_path / "nothing.png")
    assert run("track", "rope", "-d", "24mm", "--mask", "mask.png", "--out", "r.csv")[0] == 0
    assert run("track", "rope", "-d", "24mm", "--mask", "nothing.png", "--out", "none.csv")[0] == NOTHING_FOUND
    assert set(statuses(tmp_path / "none.csv").values()) == {"lost"}


def test_the_diameter_and_the_colour_are_found_and_told(run: Run, folder: Path, tmp_path: Path) -> None:
    code, _, err = run("track", folder, "-d", "auto", "-c", "auto", "--out", "r.csv")
    assert code == 0
    told = {line.split()[0]: line for line in err.splitlines() if not line.startswith("track")}
    assert list(told) == ["color", "diameter"]
    assert "confidence" in told["color"]
    assert "+/-" in told["diameter"]
    settings = (tmp_path / "r.csv.toml").read_text()
    diameter = float(re.search(r"^diameter = (.*)$", settings, re.MULTILINE)[1])  # type: ignore[index]
    assert diameter == pytest.approx(0.024, rel=0.1)
    assert 'color = "#c' in settings
    assert set(statuses(tmp_path / "r.csv").values()) == {"ok"}


def test_what_is_found_goes_with_what_the_config_says(run: Run, folder: Path, tmp_path: Path) -> None:
    (tmp_path / "rope.toml").write_text(f'diameter = "50mm"\ncolor = "{COLOR}"\n')
    _, _, err = run("track", folder, "--config", "rope.toml", "-d", "auto")
    assert "diameter" in err
    assert "warning" not in err
    _, _, err = run("doctor", folder, "--config", "rope.toml", "-c", "auto")
    assert "not 50.0 mm" in err


def test_the_colour_at_a_pixel(run: Run, folder: Path, tmp_path: Path) -> None:
    rows_seen, columns_seen = np.nonzero(rope_frames(1)[0].depth)
    middle = len(rows_seen) // 2
    pixel = f"@{columns_seen[middle]},{rows_seen[middle]}"
    code, _, err = run("track", folder, "-d", "24mm", "-c", pixel, "--out", "r.csv")
    assert code == 0, err
    assert 'color = "#c' in (tmp_path / "r.csv.toml").read_text()


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["track", "nowhere", "-d", "6mm"], ["nowhere", "No such file"]),
        (["track", "nowhere", "-d", "auto"], ["nowhere", "No such file"]),
        (["track", "{folder}", "-d", "6mm", "-c", "@here"], ["@here", "@320,240"]),
        (["track", "{folder}", "-d", "6mm", "-c", "@9999,1"], ["9999,1", "160x120"]),
        (["track", "{folder}", "-d", "auto", "-c", "#00ff00"], ["#00ff00", "--diameter"]),
        (["track", "{folder}", "-d", "auto", "--start", "99"], ["no frame"]),
        (["compare", "{folder}", "-d", "auto"], ["track"]),
        (["track", "{empty}", "-d", "6mm"], ["empty"]),
        (["track", "{folder}"], ["--diameter"]),
        (["track", "{folder}", "-d", "0"], ["diameter", "0.5 mm"]),
        (["track", "{folder}", "-d", "2m"], ["diameter", "500 mm"]),
        (["track", "{folder}", "-d", "thick"], ["thick", "12mm"]),
        (["track", "{folder}", "-d", "nan"], ["nan"]),
        (["track", "{folder}", "-d", "6mm", "-c", "redish"], ["redish", "#"]),
        (["track", "{folder}", "-d", "6mm", "--method", "magic"], ["magic", "slicing"]),
        (["track", "{folder}", "-d", "6mm", "--out", "r.xyz"], [".xyz", ".csv"]),
        (["track", "{folder}", "-d", "6mm", "--out", "no/such/place.csv"], ["no/such"]),
        (["track", "{folder}", "-d", "6mm", "--start", "-1"], ["--start"]),
        (["track", "{folder}", "-d", "6mm", "--limit", "0"], ["--limit"]),
        (["track", "{folder}", "-d", "6mm", "--start", "9" * 20], ["--start"]),
        (["track", "{folder}", "-d", "6mm", "--config", "/dev/zero"], ["/dev/zero", "not a file"]),
        (["track", "{folder}", "-d", "6mm", "--mask", "/dev/zero"], ["/dev/zero"]),
        (["doctor", "{folder}", "-d", "6mm", "--frames", "0"], ["--frames"]),
        (["track", "{folder}", "-d", "6mm", "--frame", "world"], ["camera_pose"]),
        (["track", "{folder}", "-d", "6mm", "--mask", "nowhere.png"], ["nowhere.png"]),
        (["track", "{folder}", "-d", "6mm", "--config", "nowhere.toml"], ["nowhere.toml"]),
        (["track", "{folder}", "-d", "6mm", "--rate", "30"], ["rate"]),
        (["track", "{folder}", "-d", "6mm", "--predict", "soon"], ["--predict", "soon", "or now"]),
        (["track", "{folder}", "-d", "6mm", "--predict", "-10ms"], ["--predict", "0 to 1 s"]),
        (["track", "{folder}", "-d", "6mm", "--predict", "1.5s"], ["--predict 1.5s", "0 to 1 s"]),
        (["track", "{folder}", "-d", "6mm", "--predict", "nan"], ["--predict"]),
        (["info", "nowhere"], ["nowhere"]),
        (["doctor", "nowhere", "-d", "6mm"], ["nowhere"]),
    ],
)
def test_a_users_mistake_gets_one_clear_line(
    run: Run, folder: Path, tmp_path: Path, arguments: list[str], words: list[str]
) -> None:
    (tmp_path / "empty").mkdir()
    code, _, err = run(*[a.format(folder=folder, empty=tmp_path / "empty") for a in arguments])
    assert code == BAD_INPUT
    assert err.startswith("ropetrace: ")
    assert err.count("\n") == 1
    for word in words:
        assert word in err


def test_an_unknown_setting_is_named_with_the_nearest(run: Run, folder: Path, tmp_path: Path) -> None:
    (tmp_path / "rope.toml").write_text('diameter = "12mm"\n[segmentation]\ncolour_tolerance = 10\n')
    code, _, err = run("track", folder, "--config", "rope.toml")
    assert code == BAD_INPUT
    assert "segmentation.colour_tolerance" in err
    assert "did you mean segmentation.color_tolerance" in err


def test_existing_results_are_kept(run: Run, folder: Path, tmp_path: Path) -> None:
    (tmp_path / "r.csv").write_text("precious")
    code, _, err = run("track", folder, "-d", "24mm", "-c", COLOR, "--out", "r.csv")
    assert code == BAD_INPUT
    assert "--overwrite" in err
    assert (tmp_path / "r.csv").read_text() == "precious"
    assert run("track", folder, "-d", "24mm", "-c", COLOR, "--out", "r.csv", "--overwrite")[0] == 0


def test_no_output_may_be_the_input(run: Run, tmp_path: Path) -> None:
    path = write_mcap(tmp_path / "rope.mcap", rope_frames(3))
    whole = path.read_bytes()
    (tmp_path / "link.mcap").hardlink_to(path)
    for name in ("rope.mcap", "./rope.mcap", "link.mcap"):
        code, _, err = run("track", path, "-d", "24mm", "-c", COLOR, "--out", name, "--overwrite")
        assert code == BAD_INPUT
        assert "input" in err
    assert path.read_bytes() == whole


def test_an_output_in_the_recordings_folder_replaces_nothing(run: Run, folder: Path, tmp_path: Path) -> None:
    copy = shutil.copytree(folder, tmp_path / "rope")
    (copy / "notes.csv").write_text("precious")
    assert run("track", copy, "-d", "24mm", "-c", COLOR, "--out", copy / "notes.csv", "--overwrite")[0] == BAD_INPUT
    assert (copy / "notes.csv").read_text() == "precious"


def test_outputs_are_checked_before_any_is_made(run: Run, folder: Path, tmp_path: Path) -> None:
    for second in ("bad.xyz", "r.csv", "./r.csv", "no/place.csv"):
        assert run("track", folder, "-d", "24mm", "-c", COLOR, "--out", "r.csv", second)[0] == BAD_INPUT
        assert not (tmp_path / "r.csv").exists()
    (tmp_path / "r.csv.toml").write_text("precious")
    assert run("track", folder, "-d", "24mm", "-c", COLOR, "--out", "r.csv")[0] == BAD_INPUT
    assert (tmp_path / "r.csv.toml").read_text() == "precious"


def test_the_doctor_keeps_pictures_that_exist(run: Run, folder: Path, tmp_path: Path) -> None:
    (tmp_path / "mine.png").write_text("precious")
    assert run("doctor", folder, "-d", "24mm", "-c", COLOR, "--picture", "mine.png")[0] == BAD_INPUT
    assert (tmp_path / "mine.png").read_text() == "precious"


def test_a_start_beyond_the_end_is_told(run: Run, folder: Path) -> None:
    code, _, err = run("track", folder, "-d", "24mm", "-c", COLOR, "--start", 50)
    assert code == NOTHING_FOUND
    assert "--start 50" in err


def test_names_that_the_terminal_cannot_show(folder: Path, tmp_path: Path) -> None:
    command = [
        sys.executable,
        "-m",
        "ropetrace",
        "track",
        str(folder),
        "-d",
        "24mm",
        "-c",
        COLOR,
        "-o",
        "r\u00f6pe.csv",
    ]
    done = subprocess.run(
        command,
        cwd=tmp_path,
        capture_output=True,
        check=False,
        env={**os.environ, "PYTHONIOENCODING": "ascii", "PYTHONUTF8": "1"},
    )
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "r\u00f6pe.csv").exists()


def test_no_colour_where_a_colour_is_asked_for(run: Run, tmp_path: Path) -> None:
    write_folder(tmp_path / "rope", rope_frames(color=False))
    code, _, err = run("track", "rope", "-d", "24mm", "-c", COLOR, "--out", "r.csv")
    assert code == BAD_INPUT
    assert "colour" in err
    assert not (tmp_path / "r.csv").exists(), "nothing is left behind that would stop the next try"
    for command in (("record", "rope", "--out", "r.mcap"), ("batch", "rope", "--out", "r", "--jobs", 1)):
        assert NO_COLOR in run(*command, "-d", "24mm", "-c", COLOR)[2]
    assert NO_COLOR in run("doctor", "rope", "-d", "24mm", "-c", COLOR)[1]
    assert NO_COLOR in err


def _wrong_size(path: Path) -> None:
    Image.fromarray(np.zeros((60, 80), np.uint16)).save(path)


def _eight_bits(path: Path) -> None:
    Image.fromarray(np.zeros((120, 160), np.uint8)).save(path)


def _truncated(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:-40])


def _flipped(path: Path) -> None:
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    path.write_bytes(data)


def _missing(path: Path) -> None:
    path.unlink()


def _bomb(path: Path) -> None:
    """A picture that says it has 60000x60000 pixels."""
    header = b"IHDR" + (60000).to_bytes(4, "big") * 2 + bytes([16, 0, 0, 0, 0])
    data = b"IDAT" + zlib.compress(bytes(1000))
    parts = [
        part[:4] and (len(part) - 4).to_bytes(4, "big") + part + zlib.crc32(part).to_bytes(4, "big")
        for part in (header, data, b"IEND")
    ]
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + b"".join(parts))


@pytest.mark.parametrize("damage", [_wrong_size, _eight_bits, _truncated, _flipped, _missing, _bomb])
@pytest.mark.parametrize("kind", ["depth", "rgb"])
def test_one_bad_image_costs_one_frame(
    run: Run, folder: Path, tmp_path: Path, damage: Callable[[Path], None], kind: str
) -> None:
    if kind == "rgb" and damage is _eight_bits:
        pytest.skip("colour has eight bits")
    copy = shutil.copytree(folder, tmp_path / "rope")
    damage(sorted((copy / kind).iterdir())[3])
    code, out, _ = run("track", copy, "-d", "24mm", "-c", COLOR, "--out", "r.csv")
    assert code == 0
    assert statuses(tmp_path / "r.csv") == {k: "lost" if k == 3 else "ok" for k in range(FRAMES)}
    lost = [row for row in rows(tmp_path / "r.csv") if row["status"] == "lost"]
    assert [(row["waypoint"], row["x"], row["qw"]) for row in lost] == [("", "", "")]
    assert "1 lost" in out


def test_a_truncated_bag_is_used_up_to_the_damage(run: Run, tmp_path: Path) -> None:
    path = write_mcap(tmp_path / "rope.mcap", rope_frames(20))
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) * 6 // 10])
    code, out, err = run("track", path, "-d", "24mm", "-c", COLOR, "--out", "r.csv")
    assert code == DAMAGED
    assert "damage" in out
    assert "lost" in err
    found = statuses(tmp_path / "r.csv")
    assert 5 <= len(found) < 20
    assert set(found.values()) == {"ok"}


def test_a_flipped_bit_in_a_bag_is_told(run: Run, tmp_path: Path) -> None:
    path = write_mcap(tmp_path / "rope.mcap", rope_frames(20))
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 4
    path.write_bytes(data)
    code, out, _ = run("track", path, "-d", "24mm", "-c", COLOR, "--out", "r.csv")
    assert code == DAMAGED
    assert "damage" in out
    assert len(statuses(tmp_path / "r.csv")) >= 5


def test_stamps_that_repeat_and_run_back(run: Run, tmp_path: Path) -> None:
    frames = rope_frames()
    stamps = [frame.stamp_ns for frame in frames]
    stamps[3], stamps[5] = stamps[2], stamps[1]
    changed = [dataclasses.replace(frame, stamp_ns=stamp) for frame, stamp in zip(frames, stamps, strict=True)]
    write_mcap(tmp_path / "rope.mcap", changed)
    code, out, _ = run("track", "rope.mcap", "-d", "24mm", "-c", COLOR, "--out", "r.csv")
    assert code == 0
    found = statuses(tmp_path / "r.csv")
    assert (found[3], found[5]) == ("degraded", "degraded")
    assert "repeats" in out
    assert "runs back" in out


@pytest.mark.parametrize(
    ("points", "code"),
    [
        (np.empty((0, 3)), NOTHING_FOUND),
        (np.ones((1, 3)), NOTHING_FOUND),
        (np.full((500, 3), np.nan), NOTHING_FOUND),
        (np.ones((500, 3)), NOTHING_FOUND),
    ],
    ids=["empty", "one point", "all NaN", "coincident"],
)
def test_a_cloud_without_a_rope(run: Run, tmp_path: Path, points: np.ndarray, code: int) -> None:
    np.save(tmp_path / "cloud.npy", points)
    assert run("track", "cloud.npy", "-d", "12mm", "--out", "r.csv")[0] == code
    assert statuses(tmp_path / "r.csv") == {0: "lost"}


def test_forty_thousand_background_points_are_not_ok(run: Run, tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    wall = np.column_stack([rng.uniform(-1, 1, 40000), rng.uniform(-0.7, 0.7, 40000), rng.normal(1.5, 0.003, 40000)])
    np.save(tmp_path / "cloud.npy", wall)
    code, out, _ = run("track", "cloud.npy", "-d", "12mm", "--out", "r.csv")
    assert code == 0
    assert statuses(tmp_path / "r.csv") == {0: "degraded"}
    assert "background" in out


def test_info_lists_streams_and_damage(run: Run, folder: Path, tmp_path: Path) -> None:
    code, out, _ = run("info", folder)
    assert code == 0
    for word in ("depth", "160x120", "30.00 Hz", str(FRAMES), "fx 145.000"):
        assert word in out
    path = write_mcap(tmp_path / "rope.mcap", rope_frames(20))
    path.write_bytes(path.read_bytes()[:-3000])
    code, out, _ = run("info", path)
    assert code == DAMAGED
    assert "damage" in out


def test_info_says_what_it_found_instead(run: Run, tmp_path: Path) -> None:
    (tmp_path / "notes").mkdir()
    (tmp_path / "notes" / "readme.txt").write_text("hello")
    code, _, err = run("info", "notes")
    assert code == BAD_INPUT
    assert "readme.txt" in err


def test_an_interrupted_run_leaves_what_it_had(tmp_path: Path) -> None:
    write_folder(tmp_path / "rope", rope_frames(1500))
    outputs = ["r.csv", "r.npz", "r.parquet", "r.mcap"]
    command = [sys.executable, "-m", "ropetrace.cli", "track", "rope", "-d", "24mm", "-c", COLOR, "--out", *outputs]
    process = subprocess.Popen(command, cwd=tmp_path, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    deadline = time.monotonic() + 300
    while time.monotonic() < deadline:
        if (tmp_path / "r.csv").exists() and (tmp_path / "r.csv").stat().st_size > 100_000:
            break
        time.sleep(0.01)
    process.send_signal(signal.SIGINT)
    out, err = process.communicate(timeout=300)
    assert process.returncode == INTERRUPTED, err
    assert "interrupted" in err
    assert "Traceback" not in err
    frames = statuses(tmp_path / "r.csv")
    assert 3 < len(frames) < 1500
    with np.load(tmp_path / "r.npz", allow_pickle=False) as arrays:
        assert len(arrays["frame"]) == len(frames)
    import pyarrow.parquet

    assert len(set(pyarrow.parquet.read_table(tmp_path / "r.parquet")["frame"].to_pylist())) == len(frames)
    assert f"frames    {len(frames)} " in out


def test_without_a_screen_earlier_results_stay(
    run: Run, folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("rerun", reason="rerun is not installed: ropetrace[viewer]")
    for name in ("DISPLAY", "WAYLAND_DISPLAY", "WAYLAND_SOCKET"):
        monkeypatch.delenv(name, raising=False)
    for name in ("r.csv", "r.csv.toml"):
        (tmp_path / name).write_text("earlier")
    code, _, err = run("track", folder, "-d", "24mm", "-c", COLOR, "--out", "r.csv", "--overwrite", "--view")
    assert code == BAD_INPUT
    assert "no screen" in err
    assert [(tmp_path / name).read_text() for name in ("r.csv", "r.csv.toml")] == ["earlier"] * 2


def test_ctrl_c_ends_a_run_after_the_frame_that_is_worked_on(
    run: Run, folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """An exception out of a callback of the compiler would be swallowed there, or become a SystemError."""
    told: list[int] = []
    monkeypatch.setattr(terminal, "INTERRUPTS", told)
    monkeypatch.setattr(cli_track, "INTERRUPTS", told)

    def frame_by_frame(frames: Any, tracker: Any, *arguments: Any, **options: Any) -> Any:
        update = tracker.update_all

        def interrupted(*given: Any) -> Any:
            signal.raise_signal(signal.SIGINT)
            return update(*given)

        tracker.update_all = interrupted
        return track_recording(frames, tracker, *arguments, **options)

    monkeypatch.setattr("ropetrace.tracking.track_recording", frame_by_frame)
    code, out, err = run("track", folder, "-d", "24mm", "-c", COLOR, "--out", "r.csv")
    assert code == INTERRUPTED
    assert "frames    1 (1 ok" in out
    assert "what was tracked until then is written" in err
    assert list(statuses(tmp_path / "r.csv")) == [0]


@pytest.mark.parametrize(("before", "expected"), [(signal.SIG_DFL, INTERRUPTED), (signal.SIG_IGN, 0)])
def test_a_terminal_that_is_gone_ends_a_run_unless_that_is_ignored(
    run: Run, folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, before: Any, expected: int
) -> None:
    """The system tells of it, and so does the shell; `nohup` has it ignored."""
    told: list[int] = []
    monkeypatch.setattr(terminal, "INTERRUPTS", told)
    monkeypatch.setattr(cli_track, "INTERRUPTS", told)

    class Terminal(CsvWriter):
        def write(self, *given: Any) -> None:
            signal.raise_signal(signal.SIGHUP)
            signal.raise_signal(signal.SIGHUP)
            super().write(*given)

        def close(self) -> None:
            signal.raise_signal(signal.SIGHUP)
            super().close()

    monkeypatch.setattr("ropetrace.results.text.CsvWriter", Terminal)
    was = signal.signal(signal.SIGHUP, before)
    try:
        code, out, _ = run("track", folder, "-d", "24mm", "-c", COLOR, "--out", "r.csv")
    finally:
        signal.signal(signal.SIGHUP, was)
    assert code == expected
    assert len(statuses(tmp_path / "r.csv")) == (1 if expected else FRAMES)
    assert f"frames    {1 if expected else FRAMES} (" in out


def test_a_source_that_fails_later_leaves_its_summary(
    run: Run, folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    frames = RgbdFolder.frames
    fail_at = 3

    def failing(recording: RgbdFolder, *given: Any) -> Iterator[Event]:
        yield from itertools.islice(frames(recording, *given), fail_at)
        raise RecordingError("the cable was pulled")

    monkeypatch.setattr(RgbdFolder, "frames", failing)
    code, out, err = run("track", folder, "-d", "24mm", "-c", COLOR, "--out", "r.csv")
    assert (code, err) == (BAD_INPUT, "ropetrace: the cable was pulled; what was tracked until then is written\n")
    assert "frames    3 (3 ok" in out
    assert "written   r.csv" in out
    assert list(statuses(tmp_path / "r.csv")) == [0, 1, 2]
    fail_at = 0
    code, out, err = run("track", folder, "-d", "24mm", "--out", "other.csv")
    assert (code, out, err) == (BAD_INPUT, "", "ropetrace: the cable was pulled\n")


@pytest.mark.parametrize("ending", [".npz", ".parquet"])
def test_results_of_a_camera_do_not_fill_the_memory(
    run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, ending: str
) -> None:
    pytest.importorskip("mujoco")

    def opened(*_: Any) -> None:
        raise AssertionError("the camera was started")

    with monkeypatch.context() as patched:
        patched.setattr(LiveRecording, "frames", opened)
        code, _, err = run("track", "sim:still", "-d", "15mm", "--out", "a.csv", f"b{ending}")
    assert code == BAD_INPUT
    assert f"b{ending}: {ending} is kept in memory until the end" in err
    assert list(tmp_path.iterdir()) == []
    assert run("track", "sim:still", "-d", "15mm", "--out", f"b{ending}", "--limit", 2)[0] == 0


def test_piped_output_has_no_progress_bar(folder: Path, tmp_path: Path) -> None:
    command = [sys.executable, "-m", "ropetrace.cli", "track", str(folder), "-d", "24mm", "-c", COLOR]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=True)
    assert done.stderr == ""
    assert "frames    8 (8 ok" in done.stdout


def test_a_closed_pipe_is_no_error(folder: Path) -> None:
    program = f"{sys.executable} -m ropetrace.cli info {folder} | head -1; exit ${{PIPESTATUS[0]}}"
    done = subprocess.run(["bash", "-c", program], capture_output=True, text=True, check=False)
    assert "Traceback" not in done.stderr


def test_help_is_quick_and_needs_no_kernels() -> None:
    program = (
        "import sys; sys.argv = ['ropetrace', 'track', '--help']\n"
        "from ropetrace.cli import main\n"
        "try: main()\n"
        "except SystemExit: pass\n"
        "assert not {'numba', 'scipy', 'PIL', 'mcap'} & set(sys.modules), sorted(sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    for word in ("--diameter", "--color", "--config", "--out", "--view", "--method", "--start", "--limit", "--rate"):
        assert word in done.stdout


def test_the_doctor_finds_a_healthy_rope(run: Run, folder: Path, tmp_path: Path) -> None:
    code, out, _ = run("doctor", folder, "-d", "24mm", "-c", COLOR)
    assert code == 0, out
    assert "BAD" not in out
    with Image.open(tmp_path / "ropetrace-doctor.png") as picture:
        assert picture.size[0] > 600


def test_the_doctor_looks_at_the_whole_part_that_is_there(folder: Path) -> None:
    recording = open_recording(folder)
    for start, limit, expected in ((0, None, [0, 4]), (2, 1000, [2, 5]), (1, 4, [1, 3])):
        found = cli._spread(recording, Part(start=start, limit=limit), 2)
        assert [index for index, _ in found] == expected


@pytest.mark.parametrize(
    ("change", "options", "words"),
    [
        ({"depth_unit_m": 1.0}, [], ["unit", "0.001"]),
        ({"depth_unit_m": 1e-6}, [], ["unit", "0.001"]),
        ({"cx": 40.0, "cy": 30.0}, [], ["intrinsics", "another resolution"]),
        ({}, ["-c", "#1e28c8"], ["0 of", "colour"]),
        ({}, ["-d", "80mm"], ["as wide as a tube of", "diameter"]),
    ],
    ids=["metres", "micrometres", "intrinsics", "wrong colour", "wrong diameter"],
)
def test_the_doctor_names_the_trouble(
    run: Run, folder: Path, tmp_path: Path, change: dict[str, float], options: list[str], words: list[str]
) -> None:
    copy = shutil.copytree(folder, tmp_path / "rope")
    camera = json.loads((copy / "camera.json").read_text()) | change
    (copy / "camera.json").write_text(json.dumps(camera))
    given = {"-d": "24mm", "-c": COLOR} | dict(zip(options[::2], options[1::2], strict=True))
    _, out, _ = run("doctor", copy, *[word for pair in given.items() for word in pair])
    assert "BAD" in out or "warn" in out
    for word in words:
        assert word in out


@needs_data
def test_the_real_rope_from_the_command_line(run: Run, tmp_path: Path) -> None:
    code, out, _ = run("track", DATA / "bcpd_rope_d435", "--rate", 5, "--diameter", "6mm", "--out", "r.csv")
    assert code == 0
    # The rope has gaps of 2 to 4 cm: the curve is there, and the doubt is told.
    assert set(statuses(tmp_path / "r.csv").values()) <= {"ok", "degraded"}
    spots = [row for row in rows(tmp_path / "r.csv") if row["waypoint"] == "0"]
    starts = np.array([[float(row[axis]) for axis in "xyz"] for row in spots])
    assert np.ptp(starts, axis=0).max() < 0.015, "the end that lies still stays the start"
    assert "is bridged" in out
