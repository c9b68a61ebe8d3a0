"""The colour and the diameter that are proposed: right, or honest about not being so."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from scipy import ndimage

from helpers import RED, RED_TEXT, SMALL
from ropetrace.config import RopeConfig, parse_color
from ropetrace.errors import ConfigError, FrameError
from ropetrace.proposal import contradictions, propose_color, propose_color_at, propose_diameter
from ropetrace.segmentation import LINEAR_OF_SRGB, ColorGate
from ropetrace.sim.camera import Boxes, Capsules, Plane, RayCaster, Scene
from ropetrace.sim.noise import kinect_axial
from ropetrace.sim.scene import Color
from ropetrace.things import connected, depth_in_metres, measured, surfaces
from ropetrace.types import CloudFrame, FloatArray, Intrinsics, RgbdFrame

GREY, BLUE, GREEN = (150, 150, 140), (30, 60, 200), (30, 150, 60)
WALL = (Plane((0.0, 0.0, 1.0), 1.6, GREY, 2),)
BOX = Boxes.one((0.25, 0.15, 1.2), (0.2, 0.2, 0.2), BLUE, 2)
CASTER = RayCaster(SMALL)


def curve(lean: float, middle: float = 0.0) -> FloatArray:
    """A bent rope of 0.65 m, a metre away."""
    t = np.linspace(-0.5, 0.5, 60)
    return 0.65 * np.stack([lean * t + 0.08 * np.cos(3 * t) + middle, t, 0.1 * t], axis=1) + [0.0, 0.0, 1.0]


def seen(
    more: Capsules | None = None,
    diameter: float = 0.012,
    color: Color = RED,
    boxes: Boxes | None = None,
    planes: tuple[Plane, ...] = WALL,
    sway: float = 0.05,
    noisy: bool = False,
    blur: float = 0.0,
) -> list[RgbdFrame]:
    """Three frames of a swaying rope and other things, with a Kinect's depth and a lens's colour if so wanted."""
    frames = []
    for index in range(3):
        rope = Capsules.along(curve(0.15 + sway * index), diameter / 2, color)
        capsules = rope if more is None else rope + more
        image = CASTER.render(Scene(capsules, planes, Boxes.none() if boxes is None else boxes))
        rng = np.random.default_rng(index)
        depth = kinect_axial(image.depth, rng) if noisy else (image.depth * 1000).astype(np.uint16)
        pixels = image.color.copy()
        if blur:
            light = ndimage.gaussian_filter(LINEAR_OF_SRGB[pixels], (blur, blur, 0))
            counts = np.interp(light, LINEAR_OF_SRGB, np.arange(256)) + rng.normal(0, 2, pixels.shape)
            pixels = np.clip(np.rint(counts), 0, 255).astype(np.uint8)
        frames.append(RgbdFrame(index * 10**8, depth, 0.001, SMALL, pixels))
    return frames


def same_gate(color: str, true: Color) -> bool:
    """Whether two colours let the same shades pass: each is well inside the other's gate."""
    return bool(
        ColorGate.around_color(parse_color(color), 8.0).accepts(np.array(true, np.uint8))
        and ColorGate.around_color(true, 8.0).accepts(np.array(parse_color(color), np.uint8))
    )


@pytest.mark.parametrize("noisy", [False, True])
def test_the_rope_among_other_things(noisy: bool) -> None:
    hand = Capsules.sphere((-0.2, -0.2, 1.0), 0.04, (224, 172, 140))
    proposal = propose_color(seen(hand, boxes=BOX, noisy=noisy, blur=0.7 if noisy else 0.0))
    assert same_gate(proposal.color, RED)
    assert proposal.confidence > 0.8
    assert "moves" in proposal.reasons[0]


def test_what_moves_comes_before_a_longer_thing_that_stands_still() -> None:
    rod = Capsules.along(np.array([[-0.2, -0.4, 1.1], [-0.2, 0.45, 1.1]]), 0.008, GREEN)
    proposal = propose_color(seen(rod))
    assert same_gate(proposal.color, RED)
    assert same_gate(proposal.others[0].color, GREEN)


def test_between_two_things_that_stand_still_the_diameter_decides() -> None:
    rod = Capsules.along(np.array([[-0.2, -0.4, 1.1], [-0.2, 0.45, 1.1]]), 0.02, GREEN)
    frames = seen(rod, sway=0.0)
    assert same_gate(propose_color(frames, 0.012).color, RED)
    assert same_gate(propose_color(frames, 0.040).color, GREEN)
    assert propose_color(frames).confidence < 0.7


def test_no_rope_is_said() -> None:
    image = CASTER.render(Scene(Capsules.sphere((0.0, 0.0, 1.0), 0.1), WALL, BOX))
    frame = RgbdFrame(0, image.depth.copy(), 1.0, SMALL, image.color.copy())
    with pytest.raises(ConfigError, match=r"thin and long like a rope.*--color"):
        propose_color([frame])


def test_a_rope_of_the_walls_colour_is_said() -> None:
    with pytest.raises(ConfigError, match=r"do not differ enough in colour.*position box"):
        propose_color(seen(color=GREY))


@pytest.mark.parametrize("blur", [0.0, 0.7])
@pytest.mark.parametrize("diameter", [0.008, 0.012, 0.025])
def test_the_diameter_is_within_its_uncertainty(diameter: float, blur: float) -> None:
    proposal = propose_diameter(seen(diameter=diameter, noisy=True, blur=blur), RED_TEXT)
    assert abs(proposal.diameter - diameter) < 2 * proposal.sigma
    assert abs(proposal.diameter / diameter - 1) < 0.06
    assert proposal.sigma < 0.1 * diameter


def test_the_diameter_far_from_the_middle_of_the_image() -> None:
    wide = Intrinsics(480, 360, 240.0, 240.0, 239.5, 179.5)
    axis = curve(0.15) + [0.7, 0.0, 0.0]
    image = RayCaster(wide).render(Scene(Capsules.along(axis, 0.0125, RED), WALL))
    proposal = propose_diameter([RgbdFrame(0, image.depth, 1.0, wide, image.color)], RED_TEXT)
    assert abs(proposal.diameter - 0.025) < 2 * proposal.sigma
    assert abs(proposal.diameter / 0.025 - 1) < 0.04


def test_the_diameter_without_colour_is_less_sure() -> None:
    frames = [dataclasses.replace(frame, color=None) for frame in seen(planes=())]
    proposal = propose_diameter(frames)
    assert abs(proposal.diameter - 0.012) < 2 * proposal.sigma
    assert proposal.sigma > 1.5 * propose_diameter(seen(planes=()), RED_TEXT).sigma


def test_no_diameter_of_what_is_not_there() -> None:
    with pytest.raises(ConfigError, match=r"no thin thing of the colour #00ff00.*--diameter"):
        propose_diameter(seen(), "#00ff00")


def test_a_click_on_a_shaded_edge_gives_the_colour_in_full_light() -> None:
    frame = seen(boxes=BOX)[0]
    assert frame.color is not None
    row = 180
    edge = int(np.flatnonzero(ColorGate.around_color(RED, 20.0).accepts(frame.color[row]))[0])
    assert frame.color[row, edge].astype(int).sum() < 0.9 * sum(RED)
    proposal = propose_color_at(frame, edge, row)
    assert np.abs(np.subtract(parse_color(proposal.color), RED)).max() <= 6
    assert proposal.confidence > 0.9
    on_wall = propose_color_at(frame, 20, 20)
    assert on_wall.confidence < 0.1
    assert "not like a rope" in on_wall.reasons[1]


def test_a_click_on_nothing_is_said() -> None:
    frame = seen(planes=())[0]
    with pytest.raises(ConfigError, match="outside the 480x360 image"):
        propose_color_at(frame, 480, 3)
    with pytest.raises(ConfigError, match="no pixel near 3,3 has depth"):
        propose_color_at(frame, 3, 3)


def test_a_wrong_diameter_is_contradicted_and_a_right_one_is_not() -> None:
    frames = seen(boxes=BOX)
    assert contradictions(RopeConfig(0.012, RED_TEXT), frames) == []
    assert contradictions(RopeConfig(0.014, RED_TEXT), frames) == []
    (trouble,) = contradictions(RopeConfig(0.025, RED_TEXT), frames)
    assert "not 25.0 mm" in trouble
    assert "--diameter 1" in trouble


def test_a_second_rope_is_told() -> None:
    second = Capsules.along(curve(0.1, -0.3), 0.006, RED)
    (trouble,) = contradictions(RopeConfig(0.012, RED_TEXT), seen(second))
    assert "two thin things pass" in trouble


def test_a_surface_that_passes_is_told() -> None:
    trouble = contradictions(RopeConfig(0.012, "#96968c"), seen())
    assert "not thin like a rope" in trouble[0]


def test_frames_that_cannot_be_looked_at() -> None:
    with pytest.raises(FrameError, match="only depth images"):
        propose_color([CloudFrame(0, np.zeros((3, 3)))])
    with pytest.raises(FrameError, match="no colour"):
        propose_color([dataclasses.replace(frame, color=None) for frame in seen()])


def test_the_same_frames_give_the_same_proposals() -> None:
    frames = seen(boxes=BOX, noisy=True, blur=0.7)
    assert propose_color(frames) == propose_color(frames)
    assert propose_diameter(frames, RED_TEXT) == propose_diameter(frames, RED_TEXT)


def test_surfaces_are_what_hangs_together_in_depth_and_colour() -> None:
    rng = np.random.default_rng(0)
    depth = np.where(rng.random((20, 30)) < 0.3, 0, rng.choice([1000, 1010, 1100], (20, 30))).astype(np.uint16)
    palette = np.array([[200, 40, 30], [140, 25, 18], [30, 60, 200], [20, 10, 5]], np.uint8)
    frame = RgbdFrame(0, depth, 0.001, Intrinsics(30, 20, 30.0, 30.0, 14.5, 9.5), palette[rng.integers(0, 4, (20, 30))])
    labels = surfaces(frame)
    assert np.array_equal(labels == 0, depth == 0)
    expected = flooded(frame)
    pairs = set(zip(labels.ravel().tolist(), expected.ravel().tolist(), strict=True))
    assert len(pairs) == len(np.unique(labels)) == len(np.unique(expected))


def flooded(frame: RgbdFrame) -> np.ndarray:
    """What `surfaces` must equal, but for the names: each surface is flooded from its first pixel."""
    from ropetrace.segmentation import lab_from_rgb
    from ropetrace.things import _COLOR_STEP, _DEPTH_STEP, _LIGHT_STEP

    assert frame.color is not None
    depth, lab = depth_in_metres(frame), lab_from_rgb(frame.color)
    light = (lab[..., 0] + 16) / 116
    labels = np.zeros(depth.shape, int)
    for start in np.ndindex(*depth.shape):
        if depth[start] == 0 or labels[start]:
            continue
        labels[start] = labels.max() + 1
        front = [start]
        while front:
            here = front.pop()
            for step in np.ndindex(3, 3):
                there = (here[0] + step[0] - 1, here[1] + step[1] - 1)
                if not (0 <= there[0] < depth.shape[0] and 0 <= there[1] < depth.shape[1]):
                    continue
                dark, bright = sorted((light[here], light[there]))
                hues = lab[here][1:] / light[here] - lab[there][1:] / light[there]
                near, far = sorted((depth[here], depth[there]))
                if (
                    labels[there] == 0
                    and near > 0
                    and far - near <= _DEPTH_STEP * near
                    and bright <= _LIGHT_STEP * dark
                    and dark * np.linalg.norm(hues) <= _COLOR_STEP
                ):
                    labels[there] = labels[start]
                    front.append(there)
    return labels


def test_the_measures_of_a_ribbon_and_of_a_disc() -> None:
    camera = Intrinsics(200, 200, 500.0, 500.0, 99.5, 99.5)
    mask = np.zeros((200, 200), bool)
    mask[20:180, 10:20] = True
    rows, columns = np.indices(mask.shape)
    mask |= (rows - 100) ** 2 + (columns - 120) ** 2 < 40**2
    things = measured(connected(mask), np.full(mask.shape, 2.0), camera)
    assert things.widths[1] == pytest.approx(0.040, rel=0.1)
    assert things.lengths[1] == pytest.approx(0.640, rel=0.1)
    assert things.slenderness[2] == pytest.approx(1.8, rel=0.1)
