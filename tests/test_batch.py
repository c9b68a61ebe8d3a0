"""Many recordings: found, tracked side by side, kept as they finish; one that is broken, dies or hangs stops none."""

from __future__ import annotations

import csv
import fcntl
import importlib.util
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from ropetrace.batch import Task, run_batch, track_task
from ropetrace.batch_folder import DiskFullError, Outcome, ResultFolder
from ropetrace.config import RopeConfig
from ropetrace.errors import OutputError, RecordingError
from ropetrace.evaluation import workers
from ropetrace.recorder import Recorder
from ropetrace.recordings.find import find_recordings
from test_cli import COLOR, Run, rope_frames, run, write_folder, write_mcap
from test_recorder import small_file_system, wait_until

__all__ = ["run"]

ROPE = ("--diameter", "12mm", "--color", COLOR)
CONFIG = RopeConfig(0.012, COLOR)
HAS_DASK = importlib.util.find_spec("distributed") is not None


@pytest.fixture(scope="module")
def samples(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A tree of four recordings, a broken one, one that is cut off, and other things."""
    path = tmp_path_factory.mktemp("samples")
    for name in ("day1", "day2"):
        (path / name).mkdir()
    write_mcap(path / "day1" / "a.mcap", rope_frames(3))
    write_folder(path / "day1" / "a", rope_frames(3))
    write_folder(path / "day1" / "a10", rope_frames(3))
    data = write_mcap(path / "day2" / "a.mcap", rope_frames(4)).read_bytes()
    (path / "day2" / "cut.mcap").write_bytes(data[: len(data) // 2])
    (path / "day2" / "broken.mcap").write_bytes(b"nothing")
    (path / "day2" / "a.mcap.truth.npz").write_bytes(b"")
    (path / "notes.txt").write_text("a letter")
    return path


@pytest.fixture
def tree(samples: Path, tmp_path: Path) -> Path:
    shutil.copytree(samples, tmp_path / "in")
    return tmp_path / "in"


def rows(folder: Path) -> dict[str, dict[str, str]]:
    with (folder / "summary.csv").open(newline="") as file:
        return {row["recording"]: row for row in csv.DictReader(file)}


def results(folder: Path) -> dict[str, int]:
    """When each result was written."""
    return {str(path.relative_to(folder)): path.stat().st_mtime_ns for path in folder.rglob("*.csv")}


ALL = ["day1/a", "day1/a10", "day1/a.mcap", "day2/a.mcap", "day2/broken.mcap", "day2/cut.mcap"]


@pytest.mark.parametrize(
    ("patterns", "root", "names"),
    [
        (["in/**"], "in", ALL),
        (["in"], "in", ALL),
        (["in/*"], "in", ALL),
        (["in/**/*.mcap"], "in", ["day1/a.mcap", "day2/a.mcap", "day2/broken.mcap", "day2/cut.mcap"]),
        (["in/day?/a.mcap"], "in", ["day1/a.mcap", "day2/a.mcap"]),
        (["in/day1/a.mcap", "in/day2/a.mcap", "in/day1/a.mcap"], "in", ["day1/a.mcap", "day2/a.mcap"]),
        (["in/day1/a"], "in/day1", ["a"]),
        (["in/day1/a/**"], "in/day1", ["a"]),
        (["in/notes.txt"], "in", ["notes.txt"]),
        (["in/day1/*", "in/day1/a"], "in/day1", ["a", "a10", "a.mcap"]),
    ],
)
def test_recordings_are_found_once(
    tree: Path, monkeypatch: pytest.MonkeyPatch, patterns: list[str], root: str, names: list[str]
) -> None:
    monkeypatch.chdir(tree.parent)
    found = find_recordings(patterns, Path("out"))
    assert found.root == tree.parent / root
    assert list(found.recordings) == names


def test_a_folder_of_one_recording_is_one(tree: Path) -> None:
    shutil.rmtree(tree / "day1")
    (tree / "day2" / "metadata.yaml").touch()
    (tree / "clouds").mkdir()
    for name in ("1.npy", "2.npy"):
        (tree / "clouds" / name).touch()
    (tree / "loop").symlink_to(tree)
    assert list(find_recordings([str(tree)], tree / "out").recordings) == ["clouds", "day2"]
    assert list(find_recordings([str(tree)], tree / "clouds").recordings) == ["day2"]
    for nothing in ("none", "day*/x", "notes/**"):
        with pytest.raises(RecordingError, match="no recording is there"):
            find_recordings([str(tree / nothing)], tree / "out")


def test_a_link_never_names_what_is_there_itself(tree: Path) -> None:
    """Else the recordings of another day would count as finished when ``current`` points to it."""
    (tree / "current").symlink_to("day2")
    (tree / "day1" / "0").symlink_to("../day2/a.mcap")
    (tree / "elsewhere").symlink_to(tree.parent / "other")
    shutil.copytree(tree / "day1" / "a", tree.parent / "other" / "b")
    out = tree.parent / "out"
    for patterns in (["**"], [""], ["*"]):
        found = find_recordings([str(tree / pattern) for pattern in patterns], out)
        assert list(found.recordings) == [*ALL, "elsewhere/b"]
    assert list(find_recordings([f"{tree}/*/*.mcap"], out).recordings) == ALL[2:]
    assert list(find_recordings([f"{tree}/current"], out).recordings) == ["a.mcap", "broken.mcap", "cut.mcap"]


def test_results_are_no_recordings(tree: Path) -> None:
    out = tree / "out"
    write_mcap(make_folder(out) / "a.mcap.mcap", rope_frames(1))
    shutil.copytree(out, out / "day1")
    (tree / "results").symlink_to(out)
    for pattern in ("in/**", "in/*", "in/*/*", "in/**/*.mcap"):
        found = find_recordings([str(tree.parent / pattern)], out)
        assert not [name for name in found.recordings if "out" in name or "results" in name]
    for pattern in ("out/*/*", "out/a.mcap.mcap", "results"):
        with pytest.raises(RecordingError, match=r"no recording is there; the folder of results, .*, is left out"):
            find_recordings([str(tree / pattern)], out)


def test_what_cannot_be_searched_is_told_and_passed_over(run: Run, tree: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tree / "round").symlink_to("about")
    (tree / "about").symlink_to("round")
    listdir = os.listdir

    def listed(path: Any) -> list[str]:
        if Path(path).name == "day2":
            raise PermissionError(13, "Permission denied")
        return listdir(path)

    monkeypatch.setattr(os, "listdir", listed)
    code, out, err = run("batch", "in/**", "--out", "out", *ROPE, "--jobs", 1)
    assert code == 0
    assert "recordings 3 (3 finished" in out
    assert err == f"{tree}/day2: cannot be searched: Permission denied\n"
    code, _, err = run("batch", "in/round", "in/day2", "--out", "out", *ROPE)
    assert (code, err) == (2, "ropetrace: in/round: no recording is there\n")


def test_batch_goes_on_where_it_was(run: Run, tree: Path) -> None:
    code, out, err = run("batch", "in/**", "--out", "out", *ROPE, "--jobs", 2)
    assert code == 3
    assert "recordings 6 (5 finished, 0 of them before, 1 failed, 1 damaged)" in out
    assert len([line for line in err.splitlines() if line.startswith("day2/")]) == 2
    out_folder = tree.parent / "out"
    table = rows(out_folder)
    assert list(table) == ALL
    assert (table["day1/a"]["frames"], table["day2/a.mcap"]["frames"]) == ("3", "4")
    assert table["day1/a"]["error"] == ""
    assert "without any readable message" in table["day2/broken.mcap"]["error"]
    assert "damaged" in table["day2/cut.mcap"]["error"]
    assert all(int(row["ok"]) + int(row["degraded"]) + int(row["lost"]) == int(row["frames"]) for row in table.values())
    before = results(out_folder)
    assert sorted(before) == sorted([*(f"{name}.csv" for name in ALL if "broken" not in name), "summary.csv"])
    assert [path.name for path in out_folder.glob(".*")] == [".lock"]

    (out_folder / "day1" / "a.csv").unlink()
    with (out_folder / "summary.csv").open("a") as file:
        file.write("day1/a10,3,3,0")  # cut off by a kill
    write_mcap(tree / "new.mcap", rope_frames(2))
    code, out, _ = run("batch", "in/**", "--out", "out", *ROPE, "--jobs", 1)
    assert code == 3
    assert "recordings 7 (6 finished, 4 of them before, 1 failed, 1 damaged)" in out
    after = results(out_folder)
    assert after.keys() - before.keys() == {"new.mcap.csv"}
    assert {name for name in before if after[name] != before[name]} == {"day1/a.csv", "summary.csv"}
    assert len(rows(out_folder)) == 7

    code, _, err = run("batch", "in/**", "--out", "out", "--diameter", "13mm")
    assert code == 2
    assert "begun with other settings" in err
    (out_folder / "mine.txt").touch()
    code, out, _ = run("batch", "in/day1/*", "--out", "out", *ROPE, "--format", "npz", "--overwrite", "--jobs", 1)
    assert code == 0
    assert sorted(path.name for path in out_folder.rglob("[!.]*.*")) == [
        "a.mcap.npz", "a.npz", "a10.npz", "mine.txt", "settings.toml", "summary.csv",
    ]  # fmt: skip


def test_batch_refuses_in_one_line(run: Run, tree: Path) -> None:
    (tree / "day1" / "summary").mkdir()
    shutil.copytree(tree / "day1" / "a", tree / "day1" / "summary", dirs_exist_ok=True)
    for arguments, words in (
        (("in/**", "--out", "out"), "diameter is missing"),
        (("in/**", "--out", "out", "--diameter", "auto"), "auto and @COLUMN,ROW"),
        (("in/**", "--out", "in/day1/a/out", *ROPE), "lies in, the recording"),
        (("in/**", "--out", "in", *ROPE), "no recording is there"),
        (("", "--out", "out", *ROPE), "an empty pattern"),
        (("in/x/**", "--out", "out", *ROPE), "no recording is there"),
        (("in/**", "--out", "in/notes.txt", *ROPE), "is a file"),
        (("in/**", "--out", "out", *ROPE, "--jobs", 0), "--jobs 0"),
        (("in/**", "--out", "out", *ROPE, "--cluster", "x"), "Dask scheduler" if HAS_DASK else "ropetrace[cluster]"),
        (("in/day1/*", "--out", "out", *ROPE), "summary.csv is the summary"),
    ):
        code, _, err = run("batch", *arguments)
        assert (code, err.count("\n")) == (2, 1), err
        assert words in err
    assert [path.name for path in tree.parent.iterdir()] == ["in"]


def test_only_one_batch_writes_to_a_folder(tmp_path: Path) -> None:
    with (
        ResultFolder(tmp_path / "out", {"a": 1}, overwrite=False),
        pytest.raises(OutputError, match="being written by another"),
    ):
        ResultFolder(tmp_path / "out", {"a": 1}, overwrite=False)
    ResultFolder(tmp_path / "out", {"a": 1}, overwrite=False).__exit__(None, None, None)


def test_the_lock_is_one_that_nfs_takes_and_no_results(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    modes = []
    flock = fcntl.flock

    def lock(file: Any, operation: int) -> None:
        modes.append(fcntl.fcntl(file, fcntl.F_GETFL) & os.O_ACCMODE)
        flock(file, operation)

    monkeypatch.setattr(fcntl, "flock", lock)
    (make_folder(tmp_path / "out") / ".lock").touch()  # of a run that was killed at once
    ResultFolder(tmp_path / "out", {}, overwrite=False).__exit__(None, None, None)
    assert modes == [os.O_RDWR]


def test_folders_of_any_bytes_are_tracked(run: Run, tree: Path) -> None:
    odd = tree / os.fsdecode(b"\xff\r\x7f")
    shutil.copytree(tree / "day1", odd)
    for finished in (0, 3):
        code, out, err = run("batch", odd, "--out", "out", *ROPE, "--jobs", 1)
        assert code == 0, err
        assert f"recordings 3 (3 finished, {finished} of them before" in out


def test_damage_without_an_end_leaves_a_summary_that_can_be_read(tmp_path: Path) -> None:
    with ResultFolder(tmp_path / "out", {}, overwrite=False) as folder:
        folder.add(Outcome("long", error="x" * 200_000))
        (folder.parts / "r").touch()
        folder.add(Outcome("good", 1, 1, 0, 0, 0.5, "r"))
    assert 1000 < len(rows(tmp_path / "out")["long"]["error"]) < 10_000
    with (tmp_path / "out" / "summary.csv").open("a") as file:
        file.write(f"older,1,1,0,0,0.5,r,{'x' * 200_000}\nnext,1,1,0,0,0.5,r,\n")
    with ResultFolder(tmp_path / "out", {}, overwrite=False) as folder:
        assert list(folder.outcomes) == ["good", "next"]


def test_the_summary_has_the_first_of_much_damage(tree: Path, tmp_path: Path) -> None:
    starts = []
    with Recorder(tmp_path / "a.mcap") as recorder:
        for frame in rope_frames(12):
            starts.append(recorder.size)
            recorder.write(frame)
    data = bytearray((tmp_path / "a.mcap").read_bytes())
    for start in starts[1:-1]:
        data[start + 500] ^= 1
    (tmp_path / "a.mcap").write_bytes(data)
    error = track_task(task("a", tmp_path / "a.mcap"), make_folder(tmp_path / "parts")).error
    assert error.count(" is damaged (") == 5
    assert re.search(r"; and \d+ more$", error)


def test_names_of_any_bytes_come_back(tmp_path: Path) -> None:
    outcomes = [
        Outcome(os.fsdecode(b"\xff,\n\"'"), 1, 1, 0, 0, 0.5, "r", "two\nlines, and a comma"),
        Outcome("a\rb\r\n", 1, 1, 0, 0, 0.5, "r", "\r"),
    ]
    (tmp_path / "out").mkdir()
    with ResultFolder(tmp_path / "out", {}, overwrite=True) as folder:
        for outcome in outcomes:
            (folder.parts / "r").touch()
            folder.add(outcome)
    with ResultFolder(tmp_path / "out", {}, overwrite=False) as folder:
        assert list(folder.outcomes.values()) == outcomes


@dataclass(frozen=True)
class Deadly:
    """A path that ends or holds up the worker that opens it."""

    hangs: bool
    home: int = field(default_factory=os.getpid)

    def __fspath__(self) -> str:
        if os.getpid() == self.home:
            return "none"
        if self.hangs:
            time.sleep(1000)
        os.kill(os.getpid(), signal.SIGKILL)
        return ""


def task(name: str, recording: Any) -> Task:
    return Task(recording, name, "csv", CONFIG, {})


def test_a_worker_that_dies_or_hangs_fails_its_recording_alone(
    tree: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "out"
    told: list[Outcome] = []

    def tell(outcome: Outcome) -> None:
        told.append(outcome)
        if len(told) == 4:  # the fifth hangs
            monkeypatch.setattr(workers, "LONGEST_SILENCE", 0.5)

    with ResultFolder(out, {}, overwrite=False) as folder:
        tasks = [
            task("dying", Deadly(hangs=False)),
            task("hanging", Deadly(hangs=True)),
            task("good", tree / "day1" / "a"),
            task("broken", tree / "day2" / "broken.mcap"),
            task("better", tree / "day1" / "a.mcap"),
        ]
        run_batch(folder, tasks, jobs=2, on_outcome=tell)
        found = {name: outcome.error for name, outcome in folder.outcomes.items()}
    assert len(told) == 5
    assert found["dying"] == "its process was killed (SIGKILL)"
    assert found["hanging"].startswith("it hung")
    assert "without any readable message" in found["broken"]
    assert found["good"] == found["better"] == ""
    assert sorted(path.name for path in out.glob("[!.]*")) == ["better.csv", "good.csv", "settings.toml", "summary.csv"]


def silent(seconds: float, tells: bool, on_frame: Any) -> str:
    if tells:
        on_frame()
    time.sleep(seconds)
    return "done"


def answer(worker: workers.Worker) -> Any:
    wait_until(lambda: worker.is_done)
    try:
        return worker.result()
    except workers.WorkerLostError as error:
        return str(error)
    finally:
        worker.kill()


def test_a_large_recording_may_be_read_before_its_first_frame(
    tree: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    told: dict[str, float] = {}
    begin = workers.Worker.begin

    def listen(worker: workers.Worker, function: Any, task: Task, parts: Path, **options: float) -> None:
        told[task.name] = options["before_first"]
        begin(worker, function, task, parts, **options)

    with (tmp_path / "large.mcap").open("wb") as file:
        file.truncate(20 * 10**9)
    monkeypatch.setattr(workers.Worker, "begin", listen)
    with ResultFolder(tmp_path / "out", {}, overwrite=False) as folder:
        run_batch(folder, [task("large", tmp_path / "large.mcap"), task("small", tree / "day1" / "a")])
    assert told["large"] > 600
    assert told["small"] < 1
    monkeypatch.setattr(workers.Worker, "begin", begin)

    monkeypatch.setattr(workers, "LONGEST_SILENCE", 0.2)
    patient, late, hasty = (workers.Worker() for _ in range(3))
    patient.begin(silent, 1.0, False, before_first=600)
    late.begin(silent, 600.0, True, before_first=600)
    hasty.begin(silent, 600.0, False)
    assert answer(patient) == "done"
    assert answer(late).startswith("it hung")
    assert answer(hasty).startswith("it hung")


def test_only_silence_that_was_listened_to_counts(monkeypatch: pytest.MonkeyPatch) -> None:
    """Ctrl-Z stops whoever listens, and all workers; after ``fg`` they are not taken for hung."""
    now = [0.0]
    monkeypatch.setattr(workers, "time", SimpleNamespace(monotonic=lambda: now[0]))
    worker = workers.Worker()
    worker.begin(silent, 1000.0, False)
    for now[0] in (1.0, 100_000.0, 100_001.0):
        assert not worker.is_done
    for now[0] in range(100_002, 100_002 + round(workers.LONGEST_SILENCE)):
        is_done = worker.is_done
    assert is_done
    assert answer(worker) == "it hung: no frame was finished for 120 s"


def test_the_disk_has_a_result_before_it_is_listed(tree: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    synced: set[tuple[int, int]] = set()
    fsync = os.fsync

    def listen(file: int) -> None:
        fsync(file)
        status = os.fstat(file)
        synced.add((status.st_ino, status.st_size))

    monkeypatch.setattr(os, "fsync", listen)
    track_task(task("a", tree / "day1" / "a"), make_folder(tmp_path / "parts"))
    status = (tmp_path / "parts" / "a.csv").stat()
    assert (status.st_ino, status.st_size) in synced


def test_a_result_that_cannot_be_written_is_one_recordings_failure(tree: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    with ResultFolder(out, {}, overwrite=False) as folder:
        (out / "taken.csv").mkdir()
        names = ["n" * 300, "taken", "good"]
        run_batch(folder, [task(name, tree / "day1" / "a") for name in names])
        found = {name: outcome.error for name, outcome in folder.outcomes.items()}
    assert "File name too long" in found["n" * 300]
    assert "is a folder" in found["taken"]
    assert found["good"] == ""
    assert (out / "good.csv").is_file()


def test_what_is_listed_is_never_done_again(tmp_path: Path) -> None:
    """Killed between the row and the move, which is one call later."""
    out = tmp_path / "out"
    (tmp_path / "parts" / "day").mkdir(parents=True)
    (tmp_path / "parts" / "day" / "a.csv").write_text("whole")
    with ResultFolder(out, {}, overwrite=False) as folder:
        shutil.copytree(tmp_path / "parts", folder.parts, dirs_exist_ok=True)
        (folder.parts / "day" / "b.csv").write_text("not listed")
        folder.add(Outcome("day/a", 3, 3, 0, 0, 0.5, "day/a.csv"))
    shutil.copytree(tmp_path / "parts", out / ".part-killed")
    (out / "day" / "a.csv").unlink()
    with ResultFolder(out, {}, overwrite=False) as folder:
        assert folder.finished("day/a")
        assert not folder.finished("day/b")
    assert sorted(path.name for path in out.rglob("[!.]*")) == ["a.csv", "day", "settings.toml", "summary.csv"]
    assert (out / "day" / "a.csv").read_text() == "whole"


def batch_command(*arguments: str) -> list[str]:
    return [sys.executable, "-m", "ropetrace", "batch", *arguments, *ROPE]


def results_are_there(out: Path, count: int) -> bool:
    return len(list(out.glob("*.csv"))) > count  # the summary is one


@contextmanager
def endless(recording: Path) -> Iterator[None]:
    """The first image of a recording in a folder never comes, so that no run is over before it is ended."""
    image = min((recording / "depth").iterdir())
    content = image.read_bytes()
    image.unlink()
    os.mkfifo(image)
    try:
        yield
    finally:
        image.unlink()
        image.write_bytes(content)


def test_killed_half_way_and_resumed_nothing_is_done_twice(run: Run, tree: Path) -> None:
    many = tree.parent / "many"
    for index in range(40):
        shutil.copytree(tree / "day1" / "a", many / f"{index}")
    for index, content in enumerate((b"nothing", b"", (tree / "day2" / "a.mcap").read_bytes()[:900])):
        (many / f"broken{index}.mcap").write_bytes(content)
    out = tree.parent / "out"
    with endless(many / "20"):
        process = subprocess.Popen(
            batch_command("many", "--out", "out", "--jobs", "2"),
            cwd=tree.parent,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            start_new_session=True,
        )
        wait_until(lambda: results_are_there(out, 5))
        os.killpg(process.pid, signal.SIGKILL)
        process.wait()
    before = {name: stamp for name, stamp in results(out).items() if not name.startswith(".")}
    assert 5 < len(before) < 41
    # A row more may be there, whose result is moved by the next run.
    assert before.keys() - {"summary.csv"} <= {row["result"] for row in rows(out).values()}
    code, told, _ = run("batch", "many", "--out", "out", *ROPE, "--jobs", 1)
    assert code == 3
    assert "recordings 43 (40 finished, " in told
    after = results(out)
    assert {name for name in before if after[name] != before[name]} == {"summary.csv"}
    assert run("batch", "many", "--out", "whole", *ROPE, "--jobs", 1)[0] == 3
    assert results(tree.parent / "whole").keys() == after.keys()
    for name in after.keys() - {"summary.csv"}:
        assert (out / name).read_bytes() == (tree.parent / "whole" / name).read_bytes()
    assert [path.name for path in out.glob(".*")] == [".lock"]


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    with small_file_system(tmp_path / "disk", 4096) as path:
        yield path


@pytest.mark.parametrize("format", ["csv", "parquet", "npz", "mcap"])
def test_a_full_disk_is_no_recordings_failure(tree: Path, small_disk: Path, format: str) -> None:
    if format == "parquet":
        pytest.importorskip("pyarrow")
    (small_disk / "filler").write_bytes(bytes(4096 * 1023))
    with pytest.raises(DiskFullError, match=re.escape(f"{tree.parent}/disk: the disk is full (No space left")):
        track_task(Task(tree / "day1" / "a", "a", format, CONFIG, {}), make_folder(small_disk / "parts"))
    assert list((small_disk / "parts").iterdir()) == []


def make_folder(path: Path) -> Path:
    path.mkdir()
    return path


def test_a_full_disk_ends_the_batch_and_the_same_command_goes_on(run: Run, tree: Path, small_disk: Path) -> None:
    for index in range(12):
        shutil.copytree(tree / "day1" / "a", tree / "many" / f"{index:02d}")
    out = small_disk / "out"
    assert track_task(task("a", tree / "day1" / "a"), tree).result == "a.csv"
    pages = (tree / "a.csv").stat().st_size // 4096 + 1
    filler = small_disk / "filler"
    filler.write_bytes(bytes(4096 * (1024 - 8 - 6 * pages)))
    arguments = ("batch", "in/many", "--out", out, *ROPE, "--jobs", 2)
    code, _, err = run(*arguments)
    assert code == 2
    kept = [path for path in out.glob("*.csv") if path.name != "summary.csv"]
    assert err.endswith(
        f"the disk is full (No space left on device); {len(kept)} of 12 recordings are finished and kept in {out}\n"
    )
    assert err.count("\n") == 1
    assert 0 < len(kept) < 12
    written = {path: path.stat().st_mtime_ns for path in kept}
    filler.unlink()
    code, told, _ = run(*arguments)
    assert code == 0
    assert f"recordings 12 (12 finished, {len(kept)} of them before, 0 failed" in told
    assert written == {path: path.stat().st_mtime_ns for path in kept}
    assert [path.name for path in out.glob(".*")] == [".lock"]


def test_ctrl_c_keeps_what_is_finished(tree: Path) -> None:
    for index in range(40):
        shutil.copytree(tree / "day1" / "a", tree / "many" / f"{index}")
    out = tree.parent / "out"
    with endless(tree / "many" / "20"):
        process = subprocess.Popen(
            batch_command("in/many", "--out", "out", "--jobs", "1"),
            cwd=tree.parent,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            start_new_session=True,
        )
        wait_until(lambda: results_are_there(out, 3))
        os.killpg(process.pid, signal.SIGINT)  # as a terminal does: the workers get it too
        _, err = process.communicate(timeout=300)
    assert process.returncode == 130, err
    kept = rows(out)
    assert err == f"ropetrace: interrupted; {len(kept)} of 40 recordings are finished and kept in out\n"
    assert 3 <= len(kept) < 40
    assert not any(row["error"] for row in kept.values())
    assert sorted(results(out)) == sorted([*(row["result"] for row in kept.values()), "summary.csv"])


def test_on_a_dask_cluster_the_results_are_the_same(run: Run, tree: Path) -> None:
    pytest.importorskip("distributed")
    # In a process of its own: Dask leaves threads and warnings behind.
    code = f"""
import sys
from distributed import LocalCluster
from ropetrace import cli
options = dict(n_workers=1, threads_per_worker=1, processes=False, protocol="tcp", dashboard_address=None)
with LocalCluster(host="127.0.0.1", **options) as cluster:
    address = cluster.scheduler_address
    sys.argv = ["ropetrace", "batch", "in/**", "--out", "there", *{ROPE!r}, "--cluster", address]
    cli.main()
"""
    process = subprocess.run(
        [sys.executable, "-c", code], cwd=tree.parent, check=False, capture_output=True, text=True, timeout=300
    )
    assert process.returncode == 3, process.stderr
    assert run("batch", "in/**", "--out", "here", *ROPE)[0] == 3
    here, there = tree.parent / "here", tree.parent / "there"
    assert results(here).keys() == results(there).keys()
    for name in results(here).keys() - {"summary.csv"}:
        assert (here / name).read_bytes() == (there / name).read_bytes()
    shown = [{name: {**row, "seconds": ""} for name, row in rows(folder).items()} for folder in (here, there)]
    assert shown[0] == shown[1]
