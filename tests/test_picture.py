"""The sheet of pictures: frames spread over a run, each with all its ropes."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from result_examples import frame, told
from ropetrace.picture import ContactSheet, sheet
from ropetrace.types import Estimate


def drawn(*estimates: Estimate) -> NDArray[np.uint8]:
    """The one tile of a run of one frame with these ropes."""
    contact = ContactSheet(Path("unused.png"))
    for estimate in estimates:
        contact.write(0, estimate, frame(0), None)
    (tile,) = contact._kept
    return np.asarray(tile)


def test_ropes_of_one_frame_are_drawn_over_one_picture() -> None:
    one, two = drawn(told(0)), drawn(told(0), told(3, 1))
    assert np.any(one != two)
    assert np.any(two == (90, 190, 255))


def test_frames_are_counted_not_ropes(tmp_path: Path) -> None:
    contact = ContactSheet(tmp_path / "sheet.png", most=2)
    for index in range(3):
        for rope in range(2):
            contact.write(index, told(index, rope), frame(index), None)
    assert len(contact._kept) == 3
    assert contact.save()
    with Image.open(tmp_path / "sheet.png") as picture:
        assert picture.size == sheet([contact._kept[0]] * 2).size


def test_a_hidden_part_is_drawn_thinner() -> None:
    """In all, fewer pixels than where all is seen."""
    hidden = told(0)
    whole = drawn(Estimate(hidden.stamp_ns, hidden.status, waypoints=hidden.waypoints))
    parts = drawn(Estimate(hidden.stamp_ns, hidden.status, waypoints=hidden.waypoints, seen=hidden.seen))
    line = (255, 200, 0)
    assert 0 < (parts == line).all(axis=2).sum() < (whole == line).all(axis=2).sum()
