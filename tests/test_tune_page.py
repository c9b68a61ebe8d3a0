"""The page of `ropetrace tune`: who is let in, and what a real browser makes of it."""

from __future__ import annotations

import http.client
import itertools
import json
import os
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import replace
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import numpy as np
import pytest

from browser import CHROMIUM, Tab, chromium
from helpers import DATA, RED_TEXT, SHAPES, SMALL, needs_data, seen
from ropetrace import demo
from ropetrace.cli_source import Part, Source, TrackedRope
from ropetrace.cli_tune import Tune
from ropetrace.config import RopeConfig
from ropetrace.errors import ConfigError, OutputError, RecordingError
from ropetrace.picture import backdrop, pixels_of
from ropetrace.recordings import Recording, open_recording
from ropetrace.trackers import make_tracker
from ropetrace.tune_board import Board
from ropetrace.tune_page import TunePage
from ropetrace.tune_requests import Requests, SavedSettings
from ropetrace.tuning import Tuning
from ropetrace.types import BadFrame, CloudFrame, Intrinsics, RgbdFrame, Status
from test_live import ScriptedCamera, live
from test_tuning import on_the_rope

client = pytest.importorskip("websockets.sync.client", reason="websockets is not installed: ropetrace[tune]")
exceptions = pytest.importorskip("websockets.exceptions")

needs_browser = pytest.mark.skipif(CHROMIUM is None, reason="there is no chromium on the PATH")

_PATIENCE = 120
_SERIALS = itertools.count(1)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("tune") / "recording"
    demo.make_recording(folder)
    return folder


@pytest.fixture
def serve(folder: Path, tmp_path: Path) -> Iterator[Callable[..., TunePage]]:
    """Start a page on the demo's recording."""
    with ExitStack() as running:

        def start(config: RopeConfig | None = None, recording: Recording | None = None, **options: Any) -> TunePage:
            page = TunePage(
                lambda: Tuning(recording or open_recording(folder), config), tmp_path / "rope.toml", **options
            )
            running.enter_context(page)
            thread = threading.Thread(target=page.run)
            thread.start()
            running.callback(thread.join)
            running.callback(page.stop)
            return page

        yield start


def request(page: TunePage, path: str, **headers: str) -> tuple[int, str]:
    """The status and the text of an answer."""
    connection = http.client.HTTPConnection("127.0.0.1", page.door.port, timeout=_PATIENCE)
    try:
        connection.request("GET", path, headers=headers)
        answer = connection.getresponse()
        return answer.status, answer.read().decode()
    finally:
        connection.close()


def open_socket(page: TunePage, origin: str | None = "", key: str | None = None) -> Any:
    """A WebSocket as the page opens it; other origins may be claimed."""
    address = f"127.0.0.1:{page.door.port}"
    claimed = f"http://{address}" if origin == "" else origin
    url = f"ws://{address}/socket?key={page.door.key if key is None else key}"
    return client.connect(url, origin=claimed, proxy=None, max_size=None)


def hear(line: Any) -> Any:
    """What comes next; the page says that it has shown it."""
    message = json.loads(line.recv(timeout=_PATIENCE))
    line.send('{"do": "shown"}')
    return message


def talk(line: Any, **message: Any) -> Any:
    """Ask for something; what the page is then shown."""
    serial = next(_SERIALS)
    line.send(json.dumps({**message, "serial": serial}))
    return until(line, lambda said: said["done"] == serial)["state"]


def until(line: Any, is_so: Callable[[Any], object]) -> Any:
    """The first message of which something is true."""
    while not is_so(message := hear(line)):
        pass
    return message


def looked(line: Any) -> Any:
    """The state once something was made of a frame."""
    return until(line, lambda message: message["state"].get("look", {}).get("looked"))["state"]


def tuning_of(page: TunePage) -> Tuning:
    assert page.board.tuning is not None
    return page.board.tuning


def test_the_page_wants_its_key(serve: Callable[..., TunePage], capsys: pytest.CaptureFixture[str]) -> None:
    page = serve()
    assert page._server.socket.getsockname()[0] == "127.0.0.1"
    status, text = request(page, f"/?key={page.door.key}")
    assert (status, text[:15]) == (200, "<!doctype html>")
    assert request(page, "/")[0] == 403
    assert request(page, "/?key=wrong")[0] == 403
    assert request(page, f"/other?key={page.door.key}")[0] == 404
    assert request(page, f"/?key={page.door.key}", Host="rebound.example")[0] == 421
    assert "refused   127.0.0.1: the host 'rebound.example'" in capsys.readouterr().err


def test_each_refusal_is_told_once_and_of_many_the_first(
    serve: Callable[..., TunePage], capsys: pytest.CaptureFixture[str]
) -> None:
    page = serve()
    for _ in range(3):
        assert request(page, "/?key=of-yesterday")[0] == 403
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("refused   127.0.0.1: the key is missing or wrong")
    for number in range(50):
        assert request(page, f"/?key={page.door.key}", Host=f"rebound{number}.example")[0] == 421
    assert 1 < len(capsys.readouterr().err.splitlines()) < 25


@pytest.mark.parametrize(
    "origin", ["http://evil.example", "null", "http://127.0.0.1:1", "https://127.0.0.1", None], ids=str
)
def test_a_foreign_origin_is_refused(serve: Callable[..., TunePage], origin: str | None) -> None:
    page = serve()
    with pytest.raises(exceptions.InvalidStatus) as caught, open_socket(page, origin):
        pass
    assert caught.value.response.status_code == 403
    with open_socket(page) as line:
        assert looked(line)["look"]["index"] == 0


def test_a_socket_without_the_key_is_refused(serve: Callable[..., TunePage]) -> None:
    page = serve()
    for key in ("", "wrong"):
        with pytest.raises(exceptions.InvalidStatus), open_socket(page, key=key):
            pass


def test_an_address_that_is_none_is_told(serve: Callable[..., TunePage]) -> None:
    page = serve()
    assert request(page, "//[")[0] == 400


def test_pages_are_bounded(serve: Callable[..., TunePage], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("ropetrace.tune_entrance._MOST_BROWSERS", 1)
    page = serve()
    with open_socket(page) as line:
        looked(line)
        with pytest.raises(exceptions.InvalidStatus) as caught, open_socket(page):
            pass
        assert caught.value.response.status_code == 503


def test_a_browser_that_takes_nothing_is_cut_off(
    serve: Callable[..., TunePage], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("ropetrace.tune_seat._STUCK", 0.3)
    monkeypatch.setattr(Board, "newest", lambda board: (board.version, board.shown, " " * (32 << 20)))
    page = serve()
    with socket.create_connection(("127.0.0.1", page.door.port)) as gone:
        head = f"GET /socket?key={page.door.key} HTTP/1.1\r\nHost: 127.0.0.1:{page.door.port}\r\n"
        head += f"Origin: http://127.0.0.1:{page.door.port}\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
        gone.sendall(f"{head}Sec-WebSocket-Key: {'A' * 22}==\r\nSec-WebSocket-Version: 13\r\n\r\n".encode())
        assert b" 101 " in gone.recv(100)
        end = time.monotonic() + _PATIENCE
        while page._server.connections or page._server.handler_threads:
            assert time.monotonic() < end, "it is waited for"
            time.sleep(0.05)


def test_a_page_that_cannot_be_made_is_closed(
    serve: Callable[..., TunePage], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def fail(board: Board) -> Any:
        raise ZeroDivisionError("nothing to divide")

    monkeypatch.setattr(Board, "newest", fail)
    page = serve()
    with open_socket(page) as line, pytest.raises(exceptions.ConnectionClosedError) as caught:
        line.recv(timeout=_PATIENCE)
    assert caught.value.rcvd.code == 1011
    assert "ZeroDivisionError: nothing to divide" in capsys.readouterr().err


def test_a_click_on_a_frame_that_is_long_gone_counts_on_the_newest(folder: Path, tmp_path: Path) -> None:
    board = Board(tmp_path / "rope.toml")
    board.tuning = Tuning(open_recording(folder))
    board.show(replace(board.shown, look=board.tuning.glance()))
    column, row = on_the_rope()
    sent = tuple(replace(board.tuning.glance(), index=index, event=BadFrame(0, "torn")) for index in (3, 4))
    asked = {"do": "click", "index": 2, "column": column, "row": row}
    Requests(board, SavedSettings(board.out)).do(asked, sent)
    assert board.tuning.config.color is not None


def test_two_pages_show_the_same(serve: Callable[..., TunePage]) -> None:
    page = serve()
    with open_socket(page) as first, open_socket(page) as second:
        looked(second)
        talk(first, do="set", settings={"diameter": 0.017})
        until(second, lambda message: message["state"]["look"]["settings"]["diameter"] == 0.017)
        assert talk(second, do="go", index=3)["look"]["index"] == 3
        until(first, lambda message: message["state"]["look"]["index"] == 3)
    with open_socket(page) as third:
        assert looked(third)["look"]["settings"]["diameter"] == 0.017


def test_nonsense_is_answered_and_changes_nothing(serve: Callable[..., TunePage]) -> None:
    page = serve(RopeConfig(0.012, RED_TEXT))
    with open_socket(page) as line:
        looked(line)
        for text in (
            "{",
            "[]",
            "5",
            "null",
            '{"do": "fly"}',
            '{"do": "set"}',
            '{"do": "go", "index": "x"}',
            b"\xff",
        ) + (
            '{"do": "go", "serial": 1, "index": Infinity}',
            '{"do": "go", "serial": "one", "index": 1}',
            '{"do": "set", "serial": 1, "settings": 5}',
            '{"do": "click", "serial": 1, "index": [], "column": {}, "row": null}',
            '{"do": "save", "serial": 1}',
            "[" * 50_000,
        ):
            talk(line, do="set", settings={})
            line.send(text)
            until(line, lambda message: "load it again" in message["state"]["trouble"])
        assert "cannot be changed" in talk(line, do="set", settings={"method": "cpd"})["trouble"]
        assert "no such frame" in talk(line, do="go", index=9999)["said"][0]
        assert "outside" in talk(line, do="click", index=0, column=-1, row=0)["trouble"]
        assert tuning_of(page).config == RopeConfig(0.012, RED_TEXT)
        assert not page.file.path.exists()
    with open_socket(page) as line:
        hear(line)
        line.send("x" * 100_000)
        with pytest.raises(exceptions.ConnectionClosed):
            until(line, lambda message: False)


def test_a_browser_that_shows_nothing_is_sent_one_frame_and_later_the_newest(serve: Callable[..., TunePage]) -> None:
    page = serve()
    with open_socket(page) as idle, open_socket(page) as busy:
        looked(busy)
        idle.recv(timeout=_PATIENCE)
        for index in range(1, 6):
            talk(busy, do="go", index=index)
        with pytest.raises(TimeoutError):
            idle.recv(timeout=0)
        idle.send('{"do": "shown"}')
        assert json.loads(idle.recv(timeout=_PATIENCE))["state"]["look"]["index"] == 5


def test_nothing_is_saved_before_the_diameter_is_known(serve: Callable[..., TunePage]) -> None:
    page = serve()
    with open_socket(page) as line:
        looked(line)
        assert "not known" in talk(line, do="save", replace=False)["trouble"]
        assert not page.file.path.exists()
        talk(line, do="set", settings={"diameter": 0.013})
        assert "--config" in talk(line, do="save", replace=False)["said"][0]
    assert RopeConfig.from_toml(page.file.path).diameter == 0.013


def test_a_file_that_is_there_is_replaced_by_a_second_click_alone(serve: Callable[..., TunePage]) -> None:
    page = serve(RopeConfig(0.012))
    page.file.path.write_text("mine")
    with open_socket(page) as line:
        looked(line)
        state = talk(line, do="save", replace=False)
        assert "there already" in state["trouble"]
        assert state["asks_to_replace"]
        assert page.file.path.read_text() == "mine"
        assert not talk(line, do="set", settings={"diameter": 0.014})["asks_to_replace"]
        talk(line, do="save", replace=True)
        assert RopeConfig.from_toml(page.file.path).diameter == 0.014
        # What was saved here is saved again without a question, until somebody else has changed it.
        talk(line, do="set", settings={"diameter": 0.015})
        assert talk(line, do="save", replace=False)["said"]
        page.file.path.write_text("mine again")
        assert talk(line, do="save", replace=False)["asks_to_replace"]
        assert page.file.path.read_text() == "mine again"


def test_a_place_that_cannot_be_written_is_told(serve: Callable[..., TunePage], tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    page = serve(RopeConfig(0.012))
    with open_socket(page) as line:
        looked(line)
        for place in (tmp_path / "nowhere" / "rope.toml", tmp_path / "file" / "rope.toml", Path("/proc/rope.toml")):
            page.file.path = place
            assert "cannot be written" in talk(line, do="save", replace=False)["trouble"]


def test_a_save_that_fails_leaves_nothing_behind(tmp_path: Path) -> None:
    (tmp_path / "rope.toml").mkdir()
    file = SavedSettings(tmp_path / "rope.toml")
    with pytest.raises(OutputError, match="cannot be written"):
        file.save("diameter = 0.012")
    assert not file.was_saved
    assert [path.name for path in tmp_path.iterdir()] == ["rope.toml"]


# --- live sources ---


def scene(camera: Intrinsics = SMALL) -> Callable[[int], RgbdFrame]:
    """A still rope, 30 frames a second."""
    frame = seen(SHAPES["hanging"], camera=camera)
    return lambda index: replace(frame, stamp_ns=round(index / 30 * 1e9))


def test_a_live_source_runs_is_held_and_goes_on(serve: Callable[..., TunePage]) -> None:
    page = serve(RopeConfig(0.012, RED_TEXT), recording=live(ScriptedCamera(scene(), period=0.03)))
    with open_socket(page) as line:
        first = looked(line)
        assert first["live"]
        state = until(line, lambda message: message["state"]["look"]["index"] > first["look"]["index"] + 2)["state"]
        assert state["look"]["ropes"][0]["status"] == "ok"
        assert state["look"]["age"] >= 0
        assert until(line, lambda message: message["state"]["rate"])["state"]["rate"] < 40

        held = talk(line, do="freeze", frozen=True)
        assert held["frozen"]
        index = held["look"]["index"]
        assert talk(line, do="set", settings={"diameter": 0.0125})["look"]["index"] == index
        assert talk(line, do="save", replace=False)["look"]["index"] == index
        assert talk(line, do="go", index=0)["look"]["index"] > index
        talk(line, do="freeze", frozen=False)
        assert talk(line, do="save", replace=False)["said"]
    # Nobody looks, and it goes on.
    before = tuning_of(page).index
    with open_socket(page) as line:
        until(line, lambda message: message["state"]["look"]["index"] > before)


def test_a_click_counts_on_the_frame_that_was_clicked_on(serve: Callable[..., TunePage]) -> None:
    blank = seen(SHAPES["hanging"])
    blank = replace(blank, depth=np.zeros_like(blank.depth))
    gone = threading.Event()
    frame_at = scene()
    camera = ScriptedCamera(
        lambda index: replace(blank, stamp_ns=round(index / 30 * 1e9)) if gone.is_set() else frame_at(index), 0.03
    )
    page = serve(recording=live(camera))
    with open_socket(page) as line:
        shown = json.loads(line.recv(timeout=_PATIENCE))
        while "look" not in shown["state"]:
            line.send('{"do": "shown"}')
            shown = json.loads(line.recv(timeout=_PATIENCE))
        column, row = np.round(pixels_of(SHAPES["hanging"][1000:1001], SMALL)[0]).astype(int).tolist()
        gone.set()
        until_blank = time.monotonic() + _PATIENCE
        while getattr(tuning_of(page).event, "depth", blank.depth).any():
            assert time.monotonic() < until_blank
            time.sleep(0.01)
        line.send('{"do": "shown"}')
        state = talk(line, do="click", index=shown["state"]["look"]["index"], column=column, row=row)
        assert state["trouble"] == ""
        assert state["look"]["settings"]["color"] is not None


def test_a_camera_that_vanishes_is_told_and_comes_back(serve: Callable[..., TunePage]) -> None:
    away = threading.Event()
    frame_at = scene()
    camera = ScriptedCamera(lambda index: None if away.is_set() else frame_at(index), 0.03)
    page = serve(RopeConfig(0.012, RED_TEXT), recording=live(camera, silence=0.2, give_up=0.6))
    with open_socket(page) as line:
        looked(line)
        away.set()
        state = until(line, lambda message: message["state"]["look"]["bad"])["state"]
        assert "gave no frame" in state["look"]["bad"]
        assert state["look"]["picture"] is None
        assert "when it returns" in state["look"]["advice"]["text"]
        # It is given up for good, and begun anew for good.
        until(line, lambda message: "it is there, but silent" in message["state"]["look"]["bad"])
        assert talk(line, do="save", replace=False)["said"]
        away.clear()
        until(line, lambda message: message["state"]["look"]["ropes"][0]["status"] == "ok")


def test_a_request_is_answered_while_a_silent_camera_is_waited_for(serve: Callable[..., TunePage]) -> None:
    away = threading.Event()
    frame_at = scene()
    camera = ScriptedCamera(lambda index: None if away.is_set() else frame_at(index), 0.03)
    recording = live(camera, silence=0.1, give_up=0.3)
    waiting = threading.Event()
    page = serve(RopeConfig(0.012, RED_TEXT), recording=recording)
    with open_socket(page) as line:
        looked(line)
        away.set()
        until(line, lambda message: "it is there, but silent" in message["state"]["look"]["bad"])
        # It is begun anew, and waited for.
        recording._give_up = 2 * _PATIENCE
        tuning = tuning_of(page)
        take = tuning.take

        def told() -> bool:
            waiting.set()
            return take()

        tuning.take = told  # type: ignore[method-assign]
        assert waiting.wait(_PATIENCE)
        assert talk(line, do="set", settings={"diameter": 0.0131})["look"]["settings"]["diameter"] == 0.0131
        away.clear()
        until(line, lambda message: message["state"]["look"]["ropes"])


def test_live_frames_of_changing_size(serve: Callable[..., TunePage]) -> None:
    small, large = scene(), scene(Intrinsics(640, 480, 554.3, 554.3, 319.5, 239.5))
    camera = ScriptedCamera(lambda index: (small if index // 3 % 2 else large)(index), 0.03)
    page = serve(RopeConfig(0.012, RED_TEXT), recording=live(camera))
    with open_socket(page) as line:
        widths = {((hear(line)["state"].get("look") or {}).get("picture") or {}).get("width") for _ in range(40)}
        state = until(line, lambda message: message["state"]["look"]["ropes"])["state"]
    assert {480, 640} <= widths
    assert state["trouble"] == ""
    assert state["look"]["ropes"][0]["status"] != "lost"


def test_a_port_that_is_taken(serve: Callable[..., TunePage]) -> None:
    page = serve()
    with pytest.raises(OutputError, match="cannot be listened on"):
        serve(port=page.door.port)


def test_a_page_for_the_whole_network_wants_its_key_too(serve: Callable[..., TunePage]) -> None:
    page = serve(bind="0.0.0.0")
    assert page.door.url.startswith(f"http://{socket.gethostname()}:{page.door.port}/?key=")
    assert request(page, "/")[0] == 403
    for name in (socket.gethostname(), "robot.lab.example"):
        assert request(page, f"/?key={page.door.key}", Host=f"{name}:{page.door.port}")[0] == 200


def test_the_command_serves_until_it_is_interrupted(folder: Path, tmp_path: Path) -> None:
    command = [sys.executable, "-m", "ropetrace", "tune", str(folder), "--out", str(tmp_path / "rope.toml")]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        assert process.stdout.readline().startswith("page      http://127.0.0.1:")
        assert "Ctrl-C" in process.stdout.readline()
        process.send_signal(signal.SIGINT)
        assert process.wait(timeout=_PATIENCE) == 0
        assert process.stdout.read().split() == ["nothing", "was", "saved"]


def test_the_command_closes_a_live_source_when_it_is_interrupted(tmp_path: Path) -> None:
    pytest.importorskip("mujoco", reason="mujoco is not installed: ropetrace[sim]")
    command = [sys.executable, "-m", "ropetrace", "tune", "sim:swing", "--out", str(tmp_path / "rope.toml")]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        url = urlsplit(process.stdout.readline().split()[1])
        address = f"{url.scheme.replace('http', 'ws')}://{url.netloc}/socket?{url.query}"
        with client.connect(address, origin=f"http://{url.netloc}", proxy=None, max_size=None) as line:
            looked(line)
            process.send_signal(signal.SIGINT)
            out, err = process.communicate(timeout=_PATIENCE)
    assert process.returncode == 0
    assert out.splitlines()[-1] == "nothing was saved"
    assert err == ""


def test_the_command_refuses_before_it_serves(folder: Path, tmp_path: Path) -> None:
    out = tmp_path / "rope.toml"
    with pytest.raises(ConfigError, match=r"--bind no\.such\.host\.invalid: there is no such address"):
        Tune(Source(folder, Part()), TrackedRope(), out, bind="no.such.host.invalid").run()
    with pytest.raises(ConfigError, match="--port"):
        Tune(Source(folder, Part()), TrackedRope(), out, port=-1).run()
    for place in (tmp_path, tmp_path / "nowhere" / "rope.toml"):
        with pytest.raises(OutputError, match="folder that exists"):
            Tune(Source(folder, Part()), TrackedRope(), place).run()
    with pytest.raises(RecordingError):
        Tune(Source(tmp_path / "none", Part()), TrackedRope(), out).run()


def test_a_live_source_that_is_not_there_ends_the_command(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="scenario"):
        Tune(Source(Path("sim:nowhere"), Part()), TrackedRope(), tmp_path / "rope.toml").run()


# --- a real browser ---


@pytest.fixture
def tab(tmp_path: Path) -> Iterator[Tab]:
    with chromium(tmp_path / "profile") as tab:
        yield tab


def shoot(tab: Tab, name: str) -> None:
    """Keep a screenshot in the folder $ROPETRACE_SHOTS, if that is set: of simulated scenes, for docs/figures."""
    if os.environ.get("ROPETRACE_SHOTS"):
        tab.screenshot(Path(os.environ["ROPETRACE_SHOTS"]) / name)


def answered(tab: Tab, act: Callable[[], object]) -> None:
    """Do something in the page and wait for the server's answer to be shown."""
    count = int(tab.value("document.body.dataset.answers || 0"))
    act()
    tab.wait_for(f"Number(document.body.dataset.answers) > {count} && !waiting && !queue.length && !state.busy")


def open_page(tab: Tab, url: str) -> None:
    """Go to the page and wait until it shows what is made of the first frame."""
    tab.open(url)
    tab.wait_for("look && look.looked")


@needs_browser
def test_click_tune_and_save_in_a_browser(serve: Callable[..., TunePage], tab: Tab, folder: Path) -> None:
    page = serve()
    open_page(tab, page.door.url)
    assert "Click on the rope" in tab.value("document.body.innerText")

    column, row = on_the_rope()
    answered(tab, lambda: tab.click_on("#image", (column + 0.5) / demo.CAMERA.width, (row + 0.5) / demo.CAMERA.height))
    assert tab.value("document.querySelector('.rope').className") == "rope ok"
    assert tab.value("document.querySelector('#color').innerText").startswith(str(tuning_of(page).config.color))
    assert tab.value("document.querySelector('#diameter_said').innerText") == "12.0 mm"

    answered(tab, lambda: tab.click_on("#next"))
    assert "frame 1 of 0 to 44" in tab.value("document.body.innerText")
    answered(tab, lambda: tab.click_on("#tolerance", 0.4))
    assert tuning_of(page).config.segmentation.color_tolerance == pytest.approx(32, abs=2)
    answered(
        tab,
        lambda: tab.value(
            "document.querySelectorAll('.low, .high').forEach((input, k) => {"
            " input.value = [-0.6, 0.6, -0.5, 0.6, 0.5, 1.4][k]; }); document.querySelector('.low').onchange()"
        ),
    )
    assert tuning_of(page).config.segmentation.box_max == (0.6, 0.6, 1.4)
    shoot(tab, "tune.png")

    answered(tab, lambda: tab.click_on("#save"))
    assert "saved" in tab.value("document.querySelector('#said').innerText")
    assert tab.value("document.querySelector('#trouble').innerText") == ""
    tracker = make_tracker(RopeConfig.from_toml(page.file.path))
    statuses = [tracker.update(frame).status for frame in open_recording(folder).frames()]
    assert statuses.count(Status.OK) == demo.FRAMES


@needs_browser
def test_a_click_hits_the_same_pixel_when_zoomed(serve: Callable[..., TunePage], tab: Tab) -> None:
    page = serve()
    open_page(tab, page.door.url)
    column, row = on_the_rope()
    box = tab.value("document.querySelector('#image').getBoundingClientRect().toJSON()")
    tab.do("Input.dispatchMouseEvent", type="mouseWheel", x=box["x"] + 300, y=box["y"] + 300, deltaX=0, deltaY=-700)
    tab.wait_for("crop.zoom > 2")
    x, y = tab.value(f"[({column} - crop.u) * pixelSize(), ({row} - crop.v) * pixelSize()]")
    answered(tab, lambda: tab.click(box["x"] + x, box["y"] + y))
    assert tab.value("document.querySelector('.rope').className") == "rope ok"
    assert tuning_of(page).config.diameter == pytest.approx(demo.DIAMETER, rel=0.05)
    shoot(tab, "tune_zoomed.png")


@needs_browser
def test_what_was_clicked_on_does_not_keep_the_keys(serve: Callable[..., TunePage], tab: Tab) -> None:
    page = serve(RopeConfig(0.012, RED_TEXT))
    open_page(tab, page.door.url)
    for index, control in enumerate(("#tolerance", "#measure", "#show_slices", "summary"), 1):
        tab.click_on(control)
        tab.wait_for("!waiting && !queue.length")
        before = tab.value("[serial, $('show_slices').checked, document.querySelector('details').open]")
        tab.press_key(" ", 32)
        answered(tab, lambda: tab.press_key("ArrowRight", 39))
        assert tab.value("look.index") == index
        # The space bar has pressed nothing again.
        after = tab.value("[serial, $('show_slices').checked, document.querySelector('details').open]")
        assert after == [before[0] + 1, *before[1:]]
    answered(tab, lambda: tab.click_on("#box"))
    # A number is typed after a click.
    tab.click_on(".low")
    for key, code in (("ArrowRight", 39), ("7", 55)):
        tab.press_key(key, code)
    assert "7" in tab.value("document.querySelector('.low').value")
    assert tab.value("look.index") == 4


class Person:
    """Someone who has the page before them, and whose clicks are counted."""

    def __init__(self, tab: Tab) -> None:
        self.clicks = 0
        self._tab = tab

    def press(self, selector: str, across: float = 0.5, down: float = 0.5) -> None:
        """Click on a button, or at a place of a slider or the image."""
        self._clicked(lambda: self._tab.click_on(selector, across, down))

    def click_on_the_rope(self) -> None:
        """Click on the reddest thing of the image."""
        column, row = self._tab.value("""(() => {
            const canvas = document.createElement("canvas"), pen = canvas.getContext("2d"), hits = [];
            [canvas.width, canvas.height] = [view.width, view.height];
            pen.drawImage(view.picture, 0, 0);
            const data = pen.getImageData(0, 0, view.width, view.height).data;
            for (let k = 0; k < data.length; k += 4)
              if (data[k] - Math.max(data[k + 1], data[k + 2]) > 100) hits.push(k / 4);
            const hit = hits[Math.floor(hits.length / 2)];
            return [hit % view.width, Math.floor(hit / view.width)];
        })()""")
        width, height = self._tab.value("[view.width, view.height]")
        self._clicked(lambda: self._tab.click_on("#image", (column + 0.5) / width, (row + 0.5) / height))

    def save(self) -> None:
        """Press the button, and see that it was done."""
        self.press("#save")
        assert "saved" in self._tab.value("document.querySelector('#said').innerText")

    def _clicked(self, act: Callable[[], None]) -> None:
        self.clicks += 1
        answered(self._tab, act)


_MOST_CLICKS = 5


def followed(config: Path, recording: Recording, frames: int) -> list[Status]:
    """What the tracker makes of some frames with the settings that were saved."""
    tracker = make_tracker(RopeConfig.from_toml(config))
    events = [event for event in recording.frames(limit=frames) if not isinstance(event, BadFrame)]
    return [tracker.update(event).status for event in events]


@needs_browser
def test_from_a_cold_start_to_a_file_that_tracks_with_the_commands(tab: Tab, tmp_path: Path) -> None:
    pytest.importorskip("mujoco", reason="mujoco is not installed: ropetrace[sim]")
    ropetrace, out = [sys.executable, "-m", "ropetrace"], str(tmp_path / "rope.toml")
    with subprocess.Popen([*ropetrace, "tune", "sim:swing", "--out", out], stdout=subprocess.PIPE, text=True) as tune:
        assert tune.stdout is not None
        tab.open(tune.stdout.readline().split()[1])
        tab.wait_for("view")  # the image is there before the kernels are
        person = Person(tab)
        person.click_on_the_rope()
        tab.wait_for("look.ropes.length && look.ropes[0].status === 'ok'")
        person.save()
        tune.send_signal(signal.SIGINT)
        assert tune.wait(timeout=_PATIENCE) == 0
    assert person.clicks <= _MOST_CLICKS
    track = [*ropetrace, "track", "sim:swing", "--config", out, "--limit", "20"]
    said = subprocess.run(track, capture_output=True, text=True, timeout=_PATIENCE, check=True).stdout
    assert "frames    20 (20 ok" in said


@needs_browser
def test_a_cluttered_live_scene_takes_few_clicks(serve: Callable[..., TunePage], tab: Tab) -> None:
    pytest.importorskip("mujoco", reason="mujoco is not installed: ropetrace[sim]")
    page = serve(recording=open_recording("sim:clutter"))
    open_page(tab, page.door.url)
    person = Person(tab)
    person.press("#freeze")
    person.click_on_the_rope()
    person.press("#freeze")
    tab.wait_for("look.ropes[0].nodes.length && state.rate")
    shoot(tab, "tune_live.png")
    person.save()
    assert person.clicks <= _MOST_CLICKS
    page.stop()
    statuses = followed(page.file.path, open_recording("sim:clutter"), 20)
    assert Status.LOST not in statuses


@needs_browser
@needs_data
def test_real_depth_without_colour_takes_few_clicks(serve: Callable[..., TunePage], tab: Tab) -> None:
    recording = open_recording(DATA / "bcpd_rope_d435", rate=30)
    page = serve(recording=recording)
    open_page(tab, page.door.url)
    person = Person(tab)
    person.press("#image")
    person.save()
    assert person.clicks <= _MOST_CLICKS
    statuses = followed(page.file.path, recording, 6)
    assert Status.OK in statuses
    assert Status.LOST not in statuses


@needs_browser
@needs_data
def test_a_real_coloured_cloud_takes_few_clicks(serve: Callable[..., TunePage], tab: Tab) -> None:
    recording = open_recording(DATA / "kinect_rope" / "data4.npz")
    cloud = next(iter(recording.frames()))
    assert isinstance(cloud, CloudFrame)
    column, row = pixels_of(cloud.points[100:101].astype(float), backdrop(cloud)[1])[0]
    page = serve(recording=recording)
    open_page(tab, page.door.url)
    person = Person(tab)
    person.press("#image", (column + 0.5) / 640, (row + 0.5) / 480)
    person.press("#tolerance", 0.95)
    person.press("#measure")
    person.save()
    assert person.clicks <= _MOST_CLICKS
    assert followed(page.file.path, recording, 1) == [Status.OK]


@needs_browser
def test_a_gate_that_takes_the_background_is_said_in_words(serve: Callable[..., TunePage], tab: Tab) -> None:
    page = serve(RopeConfig(0.012, RED_TEXT))
    open_page(tab, page.door.url)
    person = Person(tab)
    person.press("#tolerance", 0.99)
    assert "takes more than the rope" in tab.value("document.querySelector('#advice').innerText")
    assert "lower the colour tolerance" in tab.value("document.querySelector('#ropes').innerText")
    shoot(tab, "tune_gate.png")
    person.press("#tolerance", 0.25)
    assert "The rope is followed" in tab.value("document.querySelector('#advice').innerText")


@needs_browser
def test_a_bad_frame_and_a_gate_that_nothing_passes_are_said_in_words(serve: Callable[..., TunePage], tab: Tab) -> None:
    away = threading.Event()
    frame_at = scene()
    camera = ScriptedCamera(lambda index: None if away.is_set() else frame_at(index), 0.03)
    page = serve(RopeConfig(0.012, "#00ff00"), recording=live(camera, silence=0.2))
    open_page(tab, page.door.url)
    tab.wait_for("document.querySelector('#advice').innerText.includes('raise the colour tolerance')")
    away.set()
    tab.wait_for("document.querySelector('#advice').innerText.includes('when it returns')")
    away.clear()
    tab.wait_for("document.querySelector('#advice').innerText.includes('raise the colour tolerance')")


class Foreign(BaseHTTPRequestHandler):
    """Another site, open in the same browser."""

    def do_GET(self) -> None:
        self.send_response(200)
        self.send_header("Content-Type", "text/html")
        self.end_headers()
        self.wfile.write(b"<p>foreign</p>")

    def log_message(self, *said: object) -> None:
        """Say nothing."""


@needs_browser
def test_a_foreign_page_in_the_same_browser_gets_nothing(
    serve: Callable[..., TunePage], tab: Tab, capsys: pytest.CaptureFixture[str]
) -> None:
    page = serve()
    foreign = ThreadingHTTPServer(("127.0.0.1", 0), Foreign)
    thread = threading.Thread(target=foreign.serve_forever)
    thread.start()
    tab.open(f"http://127.0.0.1:{foreign.server_port}/")
    ended = tab.value(
        f"new Promise(done => {{ const s = new WebSocket('ws://127.0.0.1:{page.door.port}/socket?key={page.door.key}');"
        " s.onopen = () => done('open'); s.onclose = () => done('closed'); })"
    )
    foreign.shutdown()
    foreign.server_close()
    thread.join(_PATIENCE)
    assert ended == "closed"
    assert f"the origin 'http://127.0.0.1:{foreign.server_port}' is foreign" in capsys.readouterr().err
    with open_socket(page) as line:
        assert looked(line)["look"]["index"] == 0
