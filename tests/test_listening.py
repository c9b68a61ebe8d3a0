"""Which browsers may enter at a port of this machine."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from ropetrace.listening import Door


@pytest.fixture
def here() -> Iterator[Door]:
    door = Door("127.0.0.1", 0, always_locked=True)
    yield door
    door.socket.close()


@pytest.fixture
def further_out() -> Iterator[Door]:
    door = Door("0.0.0.0", 0)
    yield door
    door.socket.close()


def why(door: Door, host: str, *origins: str, key: str | None = None) -> str:
    refusal = door.refusal(host, origins, door.key if key is None else key)
    return "" if refusal is None else refusal.reason


@pytest.mark.parametrize("name", ["localhost", "127.0.0.1", "[::1]", "view.localhost"])
def test_on_loopback_one_enters_by_its_names(here: Door, name: str) -> None:
    # Another port than ours: a tunnel by SSH has one of its own.
    assert why(here, f"{name}:9000", f"http://{name}:9000") == ""
    assert why(here, name) == ""


@pytest.mark.parametrize("name", ["192.168.0.7", "robot.lab.example", "127.0.0.1.evil.example", "0.0.0.0"])
def test_further_out_a_machine_may_have_any_name(here: Door, further_out: Door, name: str) -> None:
    assert "no name of this machine's loopback" in why(here, f"{name}:80", f"http://{name}:80")
    assert why(further_out, f"{name}:80", f"http://{name}:80") == ""


def test_a_foreign_page_is_refused_wherever_it_is(here: Door, further_out: Door) -> None:
    for door, host in ((here, "localhost:9000"), (further_out, "robot:9000")):
        for foreign in ("http://evil.example", "http://localhost:9001", f"https://{host}", "null"):
            assert f"the origin '{foreign}' is foreign" in why(door, host, foreign)
            assert "foreign" in why(door, host, f"http://{host}", foreign)


def test_a_host_that_is_none(here: Door, further_out: Door) -> None:
    for door in (here, further_out):
        assert why(door, "") == "'' is no host"
        with pytest.raises(ValueError, match="IPv6"):
            why(door, "[")


def test_a_key_opens(here: Door, further_out: Door) -> None:
    for door in (here, further_out):
        assert len(door.key) > 20
        assert door.url.endswith(f":{door.port}/?key={door.key}")
        for wrong in ("", "wrong", "ü", f"{door.key}x"):
            assert "the key is missing or wrong" in why(door, "localhost", key=wrong)
    assert here.key != further_out.key


def test_without_a_key_loopback_is_open_to_all_of_this_machine() -> None:
    door = Door("127.0.0.1", 0)
    assert door.url == f"http://127.0.0.1:{door.port}/"
    assert why(door, "localhost", key="whatever") == ""
    assert not door.open_to_others
    door.socket.close()
