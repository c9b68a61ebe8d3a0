"""`ropetrace serve` as its users meet it: a process, an address, and who is let in."""

from __future__ import annotations

import asyncio
import contextlib
import glob
import http.client
import io
import os
import re
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, cast
from urllib.parse import parse_qs, urlsplit

import pytest

pytest.importorskip("mujoco")
pytest.importorskip("rerun")

from result_examples import estimate
from ropetrace import cli, cli_track, serving_gate
from ropetrace.cli_serve import _View
from ropetrace.errors import ConfigError, OutputError
from ropetrace.results.feed import stop_rerun
from ropetrace.serving import ViewServer
from ropetrace.serving_gate import READ_PATH, Gate, Request, _bring_messages
from ropetrace.terminal import BAD_INPUT, ENDINGS
from ropetrace.types import BadFrame

PATIENCE = 60.0
ROPE = ("--diameter", "15mm", "--color", "#c8281e")
GRPC = "application/grpc-web+proto"
NOTHING = bytes(5)
"""An empty message of gRPC-web."""


def until(condition: Callable[[], Any]) -> Any:
    end = time.monotonic() + PATIENCE
    while not (value := condition()):
        assert time.monotonic() < end, "it never came"
        time.sleep(0.05)
    return value


def is_running(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


def children(pid: int) -> list[int]:
    found: list[int] = []
    for file in glob.glob(f"/proc/{pid}/task/*/children"):
        with contextlib.suppress(OSError):  # it may have ended
            found += map(int, Path(file).read_text().split())
    return found + [grandchild for child in found for grandchild in children(child)]


def listening(pids: list[int]) -> list[str]:
    """The addresses of all sockets of the processes that take connections or datagrams."""
    inodes = set()
    for pid in pids:
        for entry in os.scandir(f"/proc/{pid}/fd"):
            try:
                inodes.add(os.readlink(entry.path))
            except OSError:
                continue
    found = []
    for table in ("tcp", "tcp6", "udp", "udp6"):
        for row in Path(f"/proc/{pids[0]}/net/{table}").read_text().splitlines()[1:]:
            cells = row.split()
            if f"socket:[{cells[9]}]" in inodes and (cells[3] == "0A" or table.startswith("udp")):
                address = cells[1].rpartition(":")[0]
                plain = ".".join(str(byte) for byte in reversed(bytes.fromhex(address)))
                found.append(plain if len(address) == 8 else address)
    return found


@contextmanager
def serving(*arguments: object) -> Iterator[tuple[subprocess.Popen[str], str]]:
    """A process that serves, and its address; killed at the end if it is still there."""
    command = [sys.executable, "-m", "ropetrace", "serve", *map(str, arguments), "--port", "0"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        try:
            assert process.stdout is not None
            line = process.stdout.readline()
            match = re.fullmatch(r"view +(http://127\.0\.0\.1:\d+/)\n", line)
            assert match is not None, line + (process.stderr.read() if process.stderr and not line else "")
            yield process, match[1]
        finally:
            process.kill()


def ended(process: subprocess.Popen[str]) -> tuple[int, str, str]:
    out, err = process.communicate(timeout=PATIENCE)
    assert "Traceback" not in out + err, err
    return process.returncode, out, err


def ask(url: str, method: str, path: str, body: bytes = b"", **headers: str) -> http.client.HTTPResponse:
    connection = http.client.HTTPConnection(str(urlsplit(url).netloc), timeout=PATIENCE)
    connection.request(method, path, body, {name.replace("_", "-"): value for name, value in headers.items()})
    return connection.getresponse()


def streams(url: str, *entities: bytes) -> bool:
    """Whether a viewer that connects now is sent all the entities before long."""
    answer = ask(url, "POST", READ_PATH, NOTHING, Content_Type=GRPC, Origin=url.rstrip("/"))
    assert answer.status == 200
    seen = b""
    end = time.monotonic() + PATIENCE
    while time.monotonic() < end and not all(entity in seen for entity in entities):
        seen += answer.read1(1 << 16)
    answer.close()
    return all(entity in seen for entity in entities)


@pytest.fixture(scope="module")
def served() -> Iterator[tuple[subprocess.Popen[str], str]]:
    with serving("sim:still", *ROPE) as running:
        yield running


Served = tuple[subprocess.Popen[str], str]


def test_the_page_is_served_here_and_knows_where_the_pictures_are(served: Served) -> None:
    _, url = served
    first = ask(url, "GET", "/")
    assert first.status == 302
    location = first.headers["Location"]
    assert parse_qs(urlsplit(location).query)["url"] == [f"rerun+{url}proxy"]
    page = ask(url, "GET", location)
    assert page.status == 200
    assert b"re_viewer.js" in page.read()
    # Whatever the page would like to fetch from the internet, or tell it, the browser refuses.
    assert "connect-src 'self' data: blob:" in page.headers["Content-Security-Policy"]
    assert len(ask(url, "GET", "/re_viewer_bg.wasm").read()) > 10**7


def test_several_viewers_see_the_rope_at_any_time(served: Served) -> None:
    _, url = served
    for _ in range(2):
        # None of these is in the blueprint, which names what it shows.
        assert streams(url, b"JFIF", b"/rope/axes", b"/rope/cloud", b"TextLog:text", b"/metadata/")


def test_nothing_listens_beyond_loopback(served: Served) -> None:
    process, _ = served
    heard = listening([process.pid, *children(process.pid)])
    # The gate, and Rerun's two.
    assert len(heard) == 3
    assert all(address.startswith("127.") for address in heard), heard


def test_nobody_can_write_to_the_view(served: Served) -> None:
    _, url = served
    answer = ask(url, "POST", READ_PATH.replace("Read", "Write"), NOTHING, Content_Type=GRPC)
    assert answer.status == 405


def test_a_foreign_page_gets_nothing(served: Served) -> None:
    _, url = served
    by_name = ask(url, "POST", READ_PATH, NOTHING, Host="evil.example:9090", Origin="http://evil.example:9090")
    assert by_name.status == 421
    other_port = ask(url, "POST", READ_PATH, NOTHING, Origin="http://127.0.0.1:3000")
    assert other_port.status == 403


def test_ctrl_c_ends_it_well(tmp_path: Path) -> None:
    out = tmp_path / "result.csv"
    with serving("sim:still", *ROPE, "--out", out, "--predict", "now") as (process, url):
        assert streams(url, b"/rope/axes")
        (rerun,) = children(process.pid)
        process.send_signal(signal.SIGINT)
        code, told, _ = ended(process)
    assert code == 0
    assert re.search(r"^frames +\d+ \(\d+ ok", told, re.MULTILINE)
    assert "latency   from the stamp" in told
    assert not is_running(rerun)
    assert len(out.read_text().splitlines()) > 50


def test_when_rerun_dies_the_results_are_still_written(tmp_path: Path) -> None:
    out = tmp_path / "result.csv"
    with serving("sim:still", *ROPE, "--out", out) as (process, url):
        (rerun,) = children(process.pid)
        os.kill(rerun, signal.SIGKILL)
        assert process.stderr is not None
        # The SDK has words of its own before.
        lines = process.stderr
        until(lambda: "rerun stopped with code -9; the tracking goes on" in lines.readline())
        assert ask(url, "GET", "/?url=x").status == 502
        size = out.stat().st_size
        until(lambda: out.stat().st_size > size)
        process.send_signal(signal.SIGINT)
        assert ended(process)[0] == 0


def test_without_results_there_is_nothing_to_go_on_for() -> None:
    with serving("sim:still", *ROPE) as (process, _):
        os.kill(children(process.pid)[0], signal.SIGKILL)
        code, _, err = ended(process)
    assert code == BAD_INPUT
    assert err.splitlines()[-1] == "ropetrace: the view has ended: rerun stopped with code -9: start it again"


def test_a_kill_leaves_no_rerun_behind() -> None:
    with serving("sim:still", *ROPE) as (process, _):
        (rerun,) = children(process.pid)
        process.kill()
        until(lambda: not is_running(rerun))


def test_a_port_that_is_taken(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        monkeypatch.setattr(sys, "argv", ["ropetrace", "serve", "sim:still", *ROPE, "--port", str(port)])
        before = {number: signal.getsignal(number) for number in ENDINGS}
        with pytest.raises(SystemExit) as raised:
            cli.main()
        for number, handler in before.items():
            signal.signal(number, handler)
    assert raised.value.code == BAD_INPUT
    (line,) = capsys.readouterr().err.splitlines()
    assert re.match(rf"ropetrace: 127\.0\.0\.1:{port}: cannot be listened on: .*in use.*another --port", line)


@pytest.mark.parametrize(
    ("host", "port", "said"),
    [
        ("no.such.host.invalid", 0, "--host no.such.host.invalid: there is no such address"),
        ("203.0.113.7", 0, "give an address of this machine"),
        ("127.0.0.1", 65536, "--port 65536: expected 0 to 65535"),
    ],
)
def test_an_address_that_is_none(host: str, port: int, said: str) -> None:
    with pytest.raises(ConfigError, match=said):
        Gate(host, port)


def request(target: str, **headers: str) -> Request:
    lines = [f"GET {target} HTTP/1.1", *(f"{name}: {value}" for name, value in headers.items())]
    return Request.parse("\r\n".join([*lines, "", ""]).encode())


@pytest.mark.parametrize("name", ["127.0.0.1", "localhost", "[::1]", "view.localhost"])
def test_on_loopback_one_enters_by_its_names(name: str) -> None:
    gate = Gate("127.0.0.1", 0)
    # Another port than ours: a tunnel by SSH has one of its own.
    assert gate.answer(request("/?url=x", Host=f"{name}:8000")) is None
    for foreign in ("evil.example:9090", "127.0.0.1.evil.example", "", "192.168.1.7:9090"):
        answer = gate.answer(request("/?url=x", Host=foreign))
        assert answer is not None
        assert answer.startswith(b"HTTP/1.1 421 ")
    gate.close()


def test_further_out_one_needs_the_key() -> None:
    gate = Gate("0.0.0.0", 0)
    key = parse_qs(urlsplit(gate.door.url).query)["key"][0]
    assert len(key) > 20
    for given in ({}, {"Cookie": f"ropetrace_{gate.door.port}=wrong"}):
        answer = gate.answer(request("/?url=x", Host="robot:9090", **given))
        assert answer is not None
        assert answer.startswith(b"HTTP/1.1 403 ")
    # The key opens, is put into a cookie, and vanishes from the address.
    answer = gate.answer(request(f"/?key={key}", Host="robot:9090"))
    assert answer is not None
    head = answer.decode()
    assert head.startswith("HTTP/1.1 302 ")
    assert f"Set-Cookie: ropetrace_{gate.door.port}={key}; Path=/; HttpOnly; SameSite=Lax" in head
    assert key not in head.partition("Location: ")[2].partition("\r\n")[0]
    assert gate.answer(request("/?url=x", Host="robot:9090", Cookie=f"ropetrace_{gate.door.port}={key}")) is None
    # Cookies of other servers of that machine may be anything.
    foreign = 'settings={"a": [1, 2]}; x' + f"ropetrace_{gate.door.port}=wrong; ropetrace_{gate.door.port}={key}; b=c"
    assert gate.answer(request("/?url=x", Host="robot:9090", Cookie=foreign)) is None
    answer = gate.answer(request(f"/?url=x&key={key}", Host="robot:9090", Origin="http://evil.example"))
    assert answer is not None
    assert answer.startswith(b"HTTP/1.1 403 ")
    gate.close()


def test_a_viewer_that_does_not_read_holds_up_nobody(monkeypatch: pytest.MonkeyPatch) -> None:
    """What stands for Rerun sends far more than may wait, and must get rid of it; the viewer then reads the rest."""
    monkeypatch.setattr(serving_gate, "WAITING_BYTES", 4 << 20)
    monkeypatch.setattr(serving_gate, "STUCK_SECONDS", PATIENCE)
    message = b"\0" + (1 << 20).to_bytes(4, "big") + bytes(1 << 20)
    # The kernel holds some, too.
    count = 64
    sent = threading.Event()

    def send(server: socket.socket) -> None:
        connection, _ = server.accept()
        with connection:
            connection.recv(1 << 16)
            connection.sendall(b"HTTP/1.1 200 OK\r\ntransfer-encoding: chunked\r\n\r\n")
            for _ in range(count):
                # As HTTP may: the pieces are not those of the messages.
                for piece in (message[:3], message[3:1000], message[1000:]):
                    connection.sendall(b"%x\r\n" % len(piece) + piece + b"\r\n")
            connection.sendall(b"0\r\n\r\n")
            sent.set()

    gate = Gate("127.0.0.1", 0)
    with socket.create_server(("127.0.0.1", 0)) as server:
        threading.Thread(target=send, args=(server,), daemon=True).start()
        gate.open(server.getsockname(), server.getsockname())
        answer = ask(gate.door.url, "POST", READ_PATH, NOTHING)
        assert sent.wait(PATIENCE), "the sender waits for the viewer"
        received = answer.read()
    gate.close()
    assert len(received) % len(message) == 0
    assert received == message * (len(received) // len(message))
    assert 0 < len(received) // len(message) < count


def test_a_viewer_that_takes_nothing_is_cut_off(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(serving_gate, "STUCK_SECONDS", 0.2)
    # More than the kernel holds.
    size = 24 << 20
    ended = threading.Event()

    def send(server: socket.socket) -> None:
        connection, _ = server.accept()
        with connection, contextlib.suppress(OSError):
            connection.recv(1 << 16)
            head = b"HTTP/1.1 200 OK\r\ntransfer-encoding: chunked\r\n\r\n"
            connection.sendall(head + b"%x\r\n\0" % (size + 5) + size.to_bytes(4, "big") + bytes(size) + b"\r\n")
            while connection.recv(1 << 16):
                pass
        ended.set()

    gate = Gate("127.0.0.1", 0)
    with socket.create_server(("127.0.0.1", 0)) as server:
        threading.Thread(target=send, args=(server,), daemon=True).start()
        gate.open(server.getsockname(), server.getsockname())
        answer = ask(gate.door.url, "POST", READ_PATH, NOTHING)
        assert ended.wait(PATIENCE)
        until(lambda: not gate._connections)
        received = b""
        with contextlib.suppress(http.client.IncompleteRead, OSError):
            while piece := answer.read1(1 << 20):
                received += piece
    gate.close()
    assert 0 < len(received) < size


def test_a_slow_link_may_take_long_over_a_message() -> None:
    """Each wait for the viewer is for a piece, however long the message is."""
    body = os.urandom(1 << 20)
    message = b"\0" + len(body).to_bytes(4, "big") + body
    sent: list[bytes] = []

    class Viewer:
        def __init__(self) -> None:
            self.pieces = [b""]

        def write(self, data: bytes) -> None:
            self.pieces[-1] += data

        def writelines(self, lines: Iterable[bytes]) -> None:
            self.write(b"".join(lines))

        async def drain(self) -> None:
            self.pieces.append(b"")

    async def bring() -> None:
        rerun = asyncio.StreamReader()
        rerun.feed_data(b"%x\r\n" % len(message) + message + b"\r\n0\r\n\r\n")
        rerun.feed_eof()
        viewer = Viewer()
        await _bring_messages(rerun, cast(asyncio.StreamWriter, viewer))
        sent.extend(viewer.pieces)

    asyncio.run(bring())
    assert max(map(len, sent)) < serving_gate.PIECE_BYTES + 100
    stream, received = io.BytesIO(b"".join(sent)), b""
    while size := int(stream.readline(), 16):
        received += stream.read(size)
        stream.readline()
    assert received == message


@contextmanager
def idle_gate() -> Iterator[Gate]:
    """A gate before something that takes connections, and says nothing."""
    gate = Gate("127.0.0.1", 0)
    with socket.create_server(("127.0.0.1", 0)) as server:
        gate.open(server.getsockname(), server.getsockname())
        try:
            yield gate
        finally:
            gate.close()


def test_viewers_are_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(serving_gate, "MOST_VIEWERS", 2)
    monkeypatch.setattr(serving_gate, "HEAD_SECONDS", PATIENCE)
    with idle_gate() as gate:
        viewers = [http.client.HTTPConnection("127.0.0.1", gate.door.port, timeout=PATIENCE) for _ in range(2)]
        for viewer in viewers:
            viewer.request("POST", READ_PATH, NOTHING)
        until(lambda: gate._viewers == 2)
        assert ask(gate.door.url, "POST", READ_PATH, NOTHING).status == 503
        assert ask(gate.door.url, "GET", "/").status == 302
        viewers[0].close()
        until(lambda: gate._viewers == 1)
        viewers[0].request("POST", READ_PATH, NOTHING)
        until(lambda: gate._viewers == 2)
        for viewer in viewers:
            viewer.close()


def test_connections_are_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(serving_gate, "MOST_CONNECTIONS", 3)
    monkeypatch.setattr(serving_gate, "HEAD_SECONDS", PATIENCE)
    with idle_gate() as gate:
        silent = [socket.create_connection(("127.0.0.1", gate.door.port), PATIENCE) for _ in range(3)]
        until(lambda: gate._connections == 3)
        assert ask(gate.door.url, "GET", "/").status == 503
        silent.pop().close()
        until(lambda: gate._connections == 2)
        assert ask(gate.door.url, "GET", "/").status == 302
        for connection in silent:
            connection.close()


@pytest.mark.skipif(not socket.has_dualstack_ipv6(), reason="there is no IPv6 here")
def test_all_networks_are_those_of_both_kinds() -> None:
    gate = Gate("::", 0)
    gate.open(("127.0.0.1", 1), ("127.0.0.1", 1))
    assert gate.door.key
    for address in ("127.0.0.1", "::1"):
        connection = http.client.HTTPConnection(address, gate.door.port, timeout=PATIENCE)
        connection.request("GET", f"/?key={gate.door.key}")
        assert connection.getresponse().status == 302
    gate.close()


def test_a_second_ctrl_c_leaves_nothing_behind(monkeypatch: pytest.MonkeyPatch) -> None:
    view = ViewServer("127.0.0.1", 0)
    stop = view._feed.stop

    def interrupted(timeout: float | None = None) -> None:
        if timeout is not None:
            raise KeyboardInterrupt
        stop()

    monkeypatch.setattr(view._feed, "stop", interrupted)
    with pytest.raises(KeyboardInterrupt):
        view.close()
    assert view.problem is not None
    assert not view._feed.running
    with pytest.raises(ConnectionRefusedError):
        socket.create_connection(("127.0.0.1", view._gate.door.port), PATIENCE)


def test_a_view_that_cannot_be_fed_leaves_nothing_behind(monkeypatch: pytest.MonkeyPatch) -> None:
    ended: list[int] = []

    def stop(process: subprocess.Popen[bytes]) -> None:
        stop_rerun(process)
        ended.append(process.wait())

    monkeypatch.setattr("ropetrace.serving.stop_rerun", stop)

    def fail(*_: Any, **__: Any) -> None:
        raise ValueError("no log")

    monkeypatch.setattr("ropetrace.serving.RerunLog", fail)
    with pytest.raises(ValueError, match="no log"):
        ViewServer("127.0.0.1", 0)
    assert ended == [-signal.SIGKILL]


def test_the_world_needs_the_pose_before_the_address_is_told(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "ropetrace", "serve", "sim:still", *ROPE, "--frame", "world", "--port", "0"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=PATIENCE, check=False)
    assert (done.returncode, done.stdout) == (BAD_INPUT, "")
    assert done.stderr == "ropetrace: --frame world needs camera_pose in the config\n"


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (["serve", "--port", "0", *ROPE], 0),
        (["serve", "--port", "0", "--diameter", "15mm"], 0),
        (["track", "--diameter", "15mm"], 1),
        (["record", "--out", "a.mcap"], 1),
        (["record", "--out", "a.mcap", "--diameter", "15mm"], 1),
    ],
    ids=["looking for colour", "serve", "track", "record", "record and track"],
)
def test_ctrl_c_ends_the_wait_for_the_first_frame(arguments: list[str], expected: int, tmp_path: Path) -> None:
    """A camera is silent; what waits for half a minute says when it begins to."""
    program = f"""
import sys
import ropetrace.live.stream as stream
take = stream.Stream.take
def told(self, timeout):
    print("waiting", flush=True)
    return take(self, timeout)
stream.Stream.take = told
stream.Stream._fetch_while_there = lambda self: self._stopping.wait()
sys.argv = ["ropetrace", *{arguments}, "sim:still"]
from ropetrace.cli import main
main()
"""
    with subprocess.Popen(
        [sys.executable, "-c", program], cwd=tmp_path, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as process:
        assert process.stdout is not None
        lines = process.stdout
        until(lambda: lines.readline() == "waiting\n")
        begun = time.monotonic()
        process.send_signal(signal.SIGINT)
        code, _, err = ended(process)
    assert time.monotonic() - begun < 20
    assert "gave no frame" not in err
    assert code == expected


def test_a_view_that_ended_is_told_once_or_ends_the_run(capsys: pytest.CaptureFixture[str]) -> None:
    with ViewServer("127.0.0.1", 0) as view:
        view._rerun.end()
        kept = _View(view, needed=False)
        kept.write(0, estimate(0), None, None)
        kept.write(1, estimate(1), None, None)
        with pytest.raises(OutputError, match="rerun stopped with code -9"):
            _View(view, needed=True).write(0, estimate(0), None, None)
        view.wait()
    assert capsys.readouterr().err.count("the tracking goes on") == 1


def test_the_last_words_of_rerun_are_told() -> None:
    with ViewServer("127.0.0.1", 0) as view:
        os.kill(view._rerun._process.pid, signal.SIGSEGV)
        until(lambda: view.problem)
        assert view.problem is not None
        assert re.fullmatch(r"the view has ended: rerun stopped with code -?\d+ \(.*SIGSEGV\)", view.problem)


def test_a_recording_is_shown_at_its_own_pace(monkeypatch: pytest.MonkeyPatch) -> None:
    now = [100.0]
    monkeypatch.setattr("ropetrace.cli_track.time.monotonic", lambda: now[0])
    monkeypatch.setattr("ropetrace.cli_track.time.sleep", lambda seconds: now.__setitem__(0, now[0] + seconds))
    came = []
    # A second each, one that runs back, and an hour without frames.
    for event in cli_track.at_own_pace(BadFrame(round(stamp * 1e9), "-") for stamp in (5.0, 6.0, 7.0, 6.5, 3600.0)):
        came.append((event.stamp_ns / 1e9, round(now[0] - 100.0, 6)))
        # Whoever is slower than the recording is not made to wait as well, and what follows is not rushed.
        now[0] += 1.5 if event.stamp_ns == 6 * 10**9 else 0.0
    assert came == [(5.0, 0.0), (6.0, 1.0), (7.0, 2.5), (6.5, 2.5), (3600.0, 2.5 + cli_track.LONGEST_GAP)]


@pytest.mark.parametrize(
    "sent", [b"GET / HTTP/1.1\r\nHost: [::1\r\n\r\n", b"\x16\x03\x01\x02\r\n\r\n", b"PRI * HTTP/2.0\r\n\r\n"]
)
def test_what_is_no_request_is_told(sent: bytes) -> None:
    gate = Gate("127.0.0.1", 0)
    gate.open(("127.0.0.1", 1), ("127.0.0.1", 1))
    with socket.create_connection(("127.0.0.1", gate.door.port), PATIENCE) as connection:
        connection.sendall(sent)
        assert connection.recv(1 << 16).startswith(b"HTTP/1.1 400 ")
    gate.close()
