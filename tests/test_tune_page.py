"""The page of `ropetrace tune`: who is let in, and what a real browser makes of it."""

from __future__ import annotations

import http.client
import json
import os
import signal
import socket
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import pytest

from browser import CHROMIUM, Tab, chromium
from helpers import RED_TEXT
from ropetrace import demo
from ropetrace.cli_source import Part, Source, TrackedRope
from ropetrace.cli_tune import Tune
from ropetrace.config import RopeConfig
from ropetrace.errors import ConfigError, OutputError
from ropetrace.recordings import open_recording
from ropetrace.trackers import make_tracker
from ropetrace.tune_page import TunePage, refusal
from ropetrace.tuning import Tuning
from ropetrace.types import Status
from test_tuning import on_the_rope

client = pytest.importorskip("websockets.sync.client", reason="websockets is not installed: ropetrace[tune]")
exceptions = pytest.importorskip("websockets.exceptions")

needs_browser = pytest.mark.skipif(CHROMIUM is None, reason="there is no chromium on the PATH")

_PATIENCE = 20


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("tune") / "recording"
    demo.make_recording(folder)
    return folder


@pytest.fixture
def serve(folder: Path, tmp_path: Path) -> Iterator[Callable[..., TunePage]]:
    """Start a page on the demo's recording."""
    with ExitStack() as running:

        def start(config: RopeConfig | None = None, **options: Any) -> TunePage:
            tuning = Tuning(open_recording(folder), config)
            return running.enter_context(TunePage(tuning, tmp_path / "rope.toml", **options))

        yield start


def request(page: TunePage, path: str, **headers: str) -> tuple[int, str]:
    """The status and the text of an answer."""
    connection = http.client.HTTPConnection("127.0.0.1", page.port, timeout=_PATIENCE)
    try:
        connection.request("GET", path, headers=headers)
        answer = connection.getresponse()
        return answer.status, answer.read().decode()
    finally:
        connection.close()


def open_socket(page: TunePage, origin: str | None = "", token: str | None = None) -> Any:
    """A WebSocket as the page opens it; other origins may be claimed."""
    address = f"127.0.0.1:{page.port}"
    claimed = f"http://{address}" if origin == "" else origin
    url = f"ws://{address}/socket?token={page.token if token is None else token}"
    return client.connect(url, origin=claimed, proxy=None, max_size=None)


def talk(line: Any, **message: Any) -> Any:
    """Ask for something; the answer."""
    line.send(json.dumps(message))
    return json.loads(line.recv(timeout=_PATIENCE))


def test_the_page_wants_its_token(serve: Callable[..., TunePage], capsys: pytest.CaptureFixture[str]) -> None:
    page = serve()
    assert page._server.socket.getsockname()[0] == "127.0.0.1"
    status, text = request(page, f"/?token={page.token}")
    assert (status, text[:15]) == (200, "<!doctype html>")
    assert request(page, "/")[0] == 403
    assert request(page, "/?token=wrong")[0] == 403
    assert request(page, f"/other?token={page.token}")[0] == 404
    assert request(page, f"/?token={page.token}", Host="rebound.example")[0] == 403
    assert "refused   127.0.0.1: the host 'rebound.example'" in capsys.readouterr().err


@pytest.mark.parametrize(
    "origin", ["http://evil.example", "null", "http://127.0.0.1:1", "https://127.0.0.1", None], ids=str
)
def test_a_foreign_origin_is_refused(serve: Callable[..., TunePage], origin: str | None) -> None:
    page = serve()
    with pytest.raises(exceptions.InvalidStatus) as caught, open_socket(page, origin):
        pass
    assert caught.value.response.status_code == 403
    with open_socket(page) as line:
        assert json.loads(line.recv(timeout=_PATIENCE))["index"] == 0


def test_a_socket_without_the_token_is_refused(serve: Callable[..., TunePage]) -> None:
    page = serve()
    for token in ("", "wrong"):
        with pytest.raises(exceptions.InvalidStatus), open_socket(page, token=token):
            pass


def test_who_is_let_in() -> None:
    assert refusal("localhost:9000", "http://localhost:9000", "t", "t") is None
    assert refusal("192.168.0.7:80", "http://192.168.0.7:80", "t", "t") is None
    assert refusal("[::1]:80", None, "t", "t") is None
    assert "host" in (refusal("", None, "t", "t") or "")
    assert "host" in (refusal("[", None, "t", "t") or "")
    assert "host" in (refusal("evil.example", "http://evil.example", "t", "t") or "")
    assert "origin" in (refusal("localhost:9000", "http://localhost:9001", "t", "t") or "")
    assert "token" in (refusal("localhost", None, "t", "") or "")
    assert "token" in (refusal("localhost", None, "t", "ü") or "")


def test_one_page_at_a_time(serve: Callable[..., TunePage]) -> None:
    page = serve()
    with open_socket(page) as first:
        first.recv(timeout=_PATIENCE)
        with open_socket(page) as second, pytest.raises(exceptions.ConnectionClosed) as caught:
            second.recv(timeout=_PATIENCE)
        assert caught.value.rcvd.code == 1013
    with open_socket(page) as third:
        third.recv(timeout=_PATIENCE)


def test_nonsense_is_answered_and_changes_nothing(serve: Callable[..., TunePage]) -> None:
    page = serve(RopeConfig(0.012, RED_TEXT))
    with open_socket(page) as line:
        line.recv(timeout=_PATIENCE)
        for text in ("{", "[]", "5", '{"do": "fly"}', '{"do": "set"}', '{"do": "go", "index": "x"}', b"\xff") + (
            '{"do": "go", "index": Infinity}',
            '{"do": "set", "settings": 5}',
            "[" * 50_000,
        ):
            line.send(text)
            assert "load it again" in json.loads(line.recv(timeout=_PATIENCE))["trouble"]
        assert "cannot be changed" in talk(line, do="set", settings={"method": "cpd"})["trouble"]
        assert "no such frame" in talk(line, do="go", index=9999)["said"][0]
        assert "outside" in talk(line, do="click", column=-1, row=0)["trouble"]
        assert page.tuning.config == RopeConfig(0.012, RED_TEXT)
    with open_socket(page) as line:
        line.recv(timeout=_PATIENCE)
        line.send("x" * 100_000)
        with pytest.raises(exceptions.ConnectionClosed):
            line.recv(timeout=_PATIENCE)


def test_nothing_is_saved_before_the_diameter_is_known(serve: Callable[..., TunePage]) -> None:
    page = serve()
    with open_socket(page) as line:
        line.recv(timeout=_PATIENCE)
        assert "not known" in talk(line, do="save")["trouble"]
        assert not page.out.exists()
        talk(line, do="set", settings={"diameter": 0.013})
        assert "--config" in talk(line, do="save")["said"][0]
    assert RopeConfig.from_toml(page.out).diameter == 0.013


def test_a_place_that_cannot_be_written(folder: Path, serve: Callable[..., TunePage], tmp_path: Path) -> None:
    page = serve(RopeConfig(0.012))
    page.out = tmp_path / "nowhere" / "rope.toml"
    with open_socket(page) as line:
        line.recv(timeout=_PATIENCE)
        assert "cannot be written" in talk(line, do="save")["trouble"]


def test_a_port_that_is_taken(serve: Callable[..., TunePage]) -> None:
    page = serve()
    with pytest.raises(OutputError, match="cannot be listened on"):
        serve(port=page.port)


def test_a_page_for_the_whole_network_wants_its_token_too(serve: Callable[..., TunePage]) -> None:
    page = serve(bind="0.0.0.0")
    assert page.url.startswith(f"http://{socket.gethostname()}:{page.port}/?token=")
    assert request(page, "/")[0] == 403
    assert request(page, f"/?token={page.token}", Host=f"{socket.gethostname()}:{page.port}")[0] == 200


def test_the_command_serves_until_it_is_interrupted(folder: Path, tmp_path: Path) -> None:
    command = [sys.executable, "-m", "ropetrace", "tune", str(folder), "--out", str(tmp_path / "rope.toml")]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        assert process.stdout.readline().startswith("page      http://127.0.0.1:")
        assert "Ctrl-C" in process.stdout.readline()
        process.send_signal(signal.SIGINT)
        assert process.wait(timeout=_PATIENCE) == 0
        assert process.stdout.read().split() == ["nothing", "was", "saved"]


def test_the_command_refuses_before_it_serves(folder: Path, tmp_path: Path) -> None:
    out = tmp_path / "rope.toml"
    with pytest.raises(ConfigError, match="--port"):
        Tune(Source(folder, Part()), TrackedRope(), out, port=-1).run()
    with pytest.raises(ConfigError, match="live source"):
        Tune(Source(Path("sim:rope"), Part()), TrackedRope(), out).run()
    out.write_text("mine")
    with pytest.raises(OutputError, match="--overwrite"):
        Tune(Source(folder, Part()), TrackedRope(), out).run()


# --- a real browser ---


@pytest.fixture
def tab(tmp_path: Path) -> Iterator[Tab]:
    with chromium(tmp_path / "profile") as tab:
        yield tab


def answered(tab: Tab, act: Callable[[], object]) -> None:
    """Do something in the page and wait for the server's answer to be shown."""
    count = int(tab.value("document.body.dataset.answers || 0"))
    act()
    tab.wait_for(f"Number(document.body.dataset.answers) > {count} && !waiting")


@needs_browser
def test_click_tune_and_save_in_a_browser(serve: Callable[..., TunePage], tab: Tab, folder: Path) -> None:
    page = serve()
    tab.open(page.url)
    tab.wait_for("document.body.dataset.answers")
    assert "everything passes" in tab.value("document.body.innerText")

    column, row = on_the_rope()
    answered(tab, lambda: tab.click_on("#image", (column + 0.5) / demo.CAMERA.width, (row + 0.5) / demo.CAMERA.height))
    assert tab.value("document.querySelector('.rope').className") == "rope ok"
    assert tab.value("document.querySelector('#color').innerText") == page.tuning.config.color
    assert tab.value("document.querySelector('#diameter_said').innerText") == "12.0 mm"

    answered(tab, lambda: tab.click_on("#next"))
    assert "frame 1 of 44" in tab.value("document.body.innerText")
    answered(tab, lambda: tab.click_on("#tolerance", 0.4))
    assert page.tuning.config.segmentation.color_tolerance == pytest.approx(32, abs=2)
    answered(
        tab,
        lambda: tab.value(
            "document.querySelectorAll('.low, .high').forEach((input, k) => {"
            " input.value = [-0.6, 0.6, -0.5, 0.6, 0.5, 1.4][k]; }); document.querySelector('.low').onchange()"
        ),
    )
    assert page.tuning.config.segmentation.box_max == (0.6, 0.6, 1.4)
    if os.environ.get("ROPETRACE_SHOTS"):
        tab.screenshot(Path(os.environ["ROPETRACE_SHOTS"]) / "tune.png")

    answered(tab, lambda: tab.click_on("#save"))
    assert "saved" in tab.value("document.querySelector('#said').innerText")
    assert tab.value("document.querySelector('#trouble').innerText") == ""
    tracker = make_tracker(RopeConfig.from_toml(page.out))
    statuses = [tracker.update(frame).status for frame in open_recording(folder).frames()]
    assert statuses.count(Status.OK) == demo.FRAMES


@needs_browser
def test_a_click_hits_the_same_pixel_when_zoomed(serve: Callable[..., TunePage], tab: Tab) -> None:
    page = serve()
    tab.open(page.url)
    tab.wait_for("document.body.dataset.answers")
    column, row = on_the_rope()
    box = tab.value("document.querySelector('#image').getBoundingClientRect().toJSON()")
    tab.do("Input.dispatchMouseEvent", type="mouseWheel", x=box["x"] + 300, y=box["y"] + 300, deltaX=0, deltaY=-700)
    tab.wait_for("crop.zoom > 2")
    x, y = tab.value(f"[({column} - crop.u) * pixelSize(), ({row} - crop.v) * pixelSize()]")
    answered(tab, lambda: tab.click(box["x"] + x, box["y"] + y))
    assert tab.value("document.querySelector('.rope').className") == "rope ok"
    assert page.tuning.config.diameter == pytest.approx(demo.DIAMETER, rel=0.05)
    if os.environ.get("ROPETRACE_SHOTS"):
        tab.screenshot(Path(os.environ["ROPETRACE_SHOTS"]) / "zoomed.png")


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
        f"new Promise(done => {{ const s = new WebSocket('ws://127.0.0.1:{page.port}/socket?token={page.token}');"
        " s.onopen = () => done('open'); s.onclose = () => done('closed'); })"
    )
    foreign.shutdown()
    foreign.server_close()
    thread.join(_PATIENCE)
    assert ended == "closed"
    assert f"the origin 'http://127.0.0.1:{foreign.server_port}' is foreign" in capsys.readouterr().err
    with open_socket(page) as line:
        assert json.loads(line.recv(timeout=_PATIENCE))["index"] == 0
