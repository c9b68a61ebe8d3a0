"""What is proposed for the colour and the diameter of ropes whose colour and diameter are known.

    python benchmarks/proposal.py

Colour images are sharp and free of noise, as the ray caster gives them, or `lens`: blurred by 0.7 pixels, in linear
light, with noise of 3 counts.

Diameters: curved, swaying ropes before a wall, six of each, seen by a 640x480 camera, 15 frames each. Colours: the
cases of the suite, and scenes with other things in them. `rope` is the share of the rope's points that pass the
proposed gate, `other` the share of the passing points that are not the rope's; beside each what the gate of the true
colour does.
"""

from __future__ import annotations

import dataclasses
import itertools
import math
import os
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from ropetrace import Intrinsics, RgbdFrame
from ropetrace.config import SegmentationConfig, format_color, parse_color
from ropetrace.errors import RopetraceError
from ropetrace.proposal import propose_color, propose_diameter
from ropetrace.segmentation import LINEAR_OF_SRGB, ColorGate
from ropetrace.sim.camera import Boxes, Capsules, DepthCamera, Plane, Scene
from ropetrace.sim.noise import NOISE_MODELS
from ropetrace.sim.scenario import CLUTTER, ROPE, ROPE_COLOR, SECOND_ROPE, SimulatedScene
from ropetrace.sim.scene import Color
from ropetrace.suite import ScenarioCase, open_case
from ropetrace.types import FloatArray

DATA = Path(os.environ.get("ROPETRACE_DATA", Path(__file__).parents[2] / "shared" / "data"))
FRAMES, ROPES, RANDOM_SCENES = 15, 6, 60
DIAMETERS = (0.005, 0.008, 0.012, 0.015, 0.025)
DISTANCES = (0.6, 1.0, 1.5)
SUITE = (
    "swing", "still", "clutter", "two_ropes", "noise_kinect_v1", "noise_stereo",
    "loop", "hairpin", "crossing", "coil", "occlusion_50", "middle_hidden",
)  # fmt: skip
GREY, WHITE, BLACK, SKIN = (150, 150, 140), (235, 235, 235), (30, 30, 32), (224, 172, 140)


@dataclass(frozen=True, slots=True, eq=False)
class Sight:
    """A frame, and the pixels in it that show the rope, (H, W)."""

    frame: RgbdFrame
    rope: NDArray[np.bool_]


def swaying(rng: np.random.Generator, distance: float, sway: float = 0.05) -> Iterator[FloatArray]:
    """The axis of a curved rope in each frame, (K, 3), metres."""
    t = np.linspace(-0.5, 0.5, 200)
    lean, bow, out = rng.uniform(-0.4, 0.4), rng.uniform(-0.15, 0.15), rng.uniform(-0.3, 0.3)
    for index in range(FRAMES):
        x = (lean + sway * math.sin(index / 5)) * t + bow * np.sin(np.pi * (t + 0.5)) + 0.05
        yield 0.8 * distance * np.stack([x, t, out * t], axis=1) + [0.0, 0.0, distance]


def through_lens(color: NDArray[np.uint8], seed: int, blur: float = 0.7, noise: float = 3.0) -> NDArray[np.uint8]:
    """Blurred, by so many pixels, and noisy, by so many counts."""
    light = ndimage.gaussian_filter(LINEAR_OF_SRGB[color], (blur, blur, 0))
    counts = np.interp(light, LINEAR_OF_SRGB, np.arange(256)) + np.random.default_rng(seed).normal(
        0, noise, color.shape
    )
    return np.clip(np.rint(counts), 0, 255).astype(np.uint8)


def sights(
    axes: Iterator[FloatArray], diameter: float, color: Color, rest: Scene, noise: str, lens: bool = False
) -> list[Sight]:
    """What a camera sees of a rope and the rest of a scene."""
    eye = DepthCamera(640, 480, math.radians(60), 30.0, noise=NOISE_MODELS[noise], depth_unit=0.001)
    seen = []
    for index, axis in enumerate(axes):
        rope = Capsules.along(axis, diameter / 2, color, ROPE)
        scene = Scene(rope + rest.capsules, rest.planes, rest.boxes)
        frame = eye.expose(lambda _, scene=scene: scene, index / 30, index)  # type: ignore[misc]
        assert frame.color is not None
        if lens:
            frame = dataclasses.replace(frame, color=through_lens(frame.color, index))
        seen.append(Sight(frame, eye.render(scene).label == ROPE))
    return seen


def diameters() -> None:
    """Bias, scatter and honesty of the diameters."""
    print("noise            lens   z_m  true_mm  mean_mm  bias_%  rms_%  sigma_%  within_2s")
    for noise, lens in (("none", False), ("kinect_v1_edges", False), ("stereo_edges", False), ("stereo_edges", True)):
        for distance in DISTANCES:
            wall = Scene(Capsules.none(), (Plane((0.0, 0.0, 1.0), distance + 0.6, GREY, CLUTTER),))
            for diameter in DIAMETERS:
                found = []
                for seed in range(ROPES):
                    axes = swaying(np.random.default_rng(seed), distance)
                    frames = [sight.frame for sight in sights(axes, diameter, ROPE_COLOR, wall, noise, lens)]
                    try:
                        one = propose_diameter(frames, format_color(ROPE_COLOR))
                    except RopetraceError:
                        continue
                    found.append((one.diameter, one.sigma))
                row = f"{noise:16s} {lens!s:5s} {distance:4.1f}  {diameter * 1e3:7.1f}"
                if not found:
                    print(row, "  nothing proposed")
                    continue
                values, sigmas = np.array(found).T
                off = values / diameter - 1
                within = np.count_nonzero(np.abs(values - diameter) <= 2 * sigmas)
                print(
                    f"{row}  {values.mean() * 1e3:7.2f}  {off.mean() * 100:6.1f}  {np.sqrt(np.mean(off**2)) * 100:5.1f}"
                    f"  {np.mean(sigmas / values) * 100:7.1f}  {within:4d} of {len(found)} of {ROPES}"
                )


def suite_scene(name: str) -> tuple[list[Sight], float]:
    """The first frames of a case, and the diameter."""
    case = open_case(name)
    assert isinstance(case, ScenarioCase)
    scene = SimulatedScene(case.scenario)
    seen = []
    for frame, _ in itertools.islice(scene.frames(), FRAMES):
        label = scene.camera.render(scene.scene()).label
        seen.append(Sight(frame, (label == ROPE) | (label == SECOND_ROPE)))
    return seen, case.diameter


def colored_scenes() -> Iterator[tuple[str, list[Sight], float, Color]]:
    """Ropes among other things."""
    wall = (Plane((0.0, 0.0, 1.0), 1.6, GREY, CLUTTER),)
    blue_box = Boxes.one((0.3, 0.2, 1.1), (0.25, 0.25, 0.2), (30, 60, 200), CLUTTER)
    orange_box = Boxes.one((-0.3, 0.2, 1.1), (0.25, 0.25, 0.2), (235, 120, 20), CLUTTER)
    hand = Capsules.sphere((0.0, -0.35, 1.0), 0.045, SKIN, CLUTTER)
    for finger in range(4):
        start = np.array([[0.03 * finger - 0.045, -0.34, 0.97]])
        hand += Capsules.between(start, start + [[0.0, 0.07, 0.0]], 0.009, SKIN, CLUTTER)
    rod = Capsules.along(np.array([[0.25, -0.4, 1.2], [0.25, 0.4, 1.2]]), 0.01, (30, 150, 60), CLUTTER)
    bare, crowd = Scene(Capsules.none(), wall), Scene(hand, wall, blue_box + orange_box)
    white_wall = Scene(Capsules.none(), (Plane((0.0, 0.0, 1.0), 1.6, WHITE, CLUTTER),))
    table = Scene(Capsules.none(), (Plane((0.0, 0.0, 1.0), 1.012, (190, 150, 110), CLUTTER),))
    for name, color, scene, sway, thick in (
        ("red, wall", ROPE_COLOR, bare, 0.05, 0.012),
        ("red, boxes and hand", ROPE_COLOR, crowd, 0.05, 0.012),
        ("blue, blue box", (40, 70, 210), crowd, 0.05, 0.012),
        ("orange, orange box", (235, 130, 30), crowd, 0.05, 0.012),
        ("red, still, green rod", ROPE_COLOR, Scene(rod, wall), 0.0, 0.012),
        ("red, moves, green rod", ROPE_COLOR, Scene(rod, wall), 0.08, 0.012),
        ("black, white wall", BLACK, white_wall, 0.05, 0.012),
        ("white, grey wall", WHITE, bare, 0.05, 0.012),
        ("grey, grey wall", GREY, bare, 0.05, 0.012),
        ("red, on a table", ROPE_COLOR, table, 0.0, 0.012),
        ("white, on a table", WHITE, table, 0.0, 0.012),
        ("red, 5 mm, wall", ROPE_COLOR, bare, 0.05, 0.005),
        ("red, 25 mm, boxes", ROPE_COLOR, crowd, 0.05, 0.025),
    ):
        for noise, lens in (("none", False), ("kinect_v1_edges", True), ("stereo_edges", True)):
            seen = sights(swaying(np.random.default_rng(1), 1.0, sway), thick, color, scene, noise, lens)
            yield f"{name}{', lens' if lens else ''}, {noise}", seen, thick, color
    nothing = [dataclasses.replace(sight, rope=sight.rope & False) for sight in sights(
        swaying(np.random.default_rng(1), -1.0), 0.012, ROPE_COLOR, crowd, "stereo_edges", True
    )]  # fmt: skip
    yield "no rope: boxes, hand, wall", nothing, math.nan, ROPE_COLOR


def recorded_scenes() -> Iterator[tuple[str, list[Sight], float, Color]]:
    """Real clouds with colour, drawn back into the camera's image; what is rope in them is not known."""
    if not DATA.is_dir():
        print(f"recordings: skipped, no recorded data in {DATA}: set ROPETRACE_DATA to their folder")
        return
    for name, files in (("kinect_rope", ("data4",)), ("xtion_cable", ("cableA", "plane2"))):
        packs = [np.load(DATA / name / f"{file}.npz") for file in files]
        points = np.concatenate([pack["points"] for pack in packs])
        colors = np.concatenate([pack["colors_rgb"] for pack in packs])
        lens = Intrinsics(640, 480, 525.0, 525.0, 319.5, 239.5)
        columns = np.rint(points[:, 0] / points[:, 2] * lens.fx + lens.cx).astype(int)
        rows = np.rint(points[:, 1] / points[:, 2] * lens.fy + lens.cy).astype(int)
        inside = (columns >= 0) & (columns < lens.width) & (rows >= 0) & (rows < lens.height)
        depth, color = np.zeros((480, 640), np.float32), np.zeros((480, 640, 3), np.uint8)
        depth[rows[inside], columns[inside]] = points[inside, 2]
        color[rows[inside], columns[inside]] = colors[inside]
        yield f"real: {name}", [Sight(RgbdFrame(0, depth, 1.0, lens, color), depth < 0)], math.nan, ROPE_COLOR


def passing(seen: list[Sight], color: Color) -> tuple[float, float]:
    """The share of the rope's points that pass a colour's gate, and the share of what passes that is not the rope."""
    gate = ColorGate.around_color(color, SegmentationConfig().color_tolerance)
    passed = rope = both = 0
    for sight in seen:
        assert sight.frame.color is not None
        passes = gate.accepts(sight.frame.color) & (sight.frame.depth > 0)
        there = sight.rope & (sight.frame.depth > 0)
        passed, rope = passed + int(passes.sum()), rope + int(there.sum())
        both += int((passes & there).sum())
    return both / max(rope, 1), 1 - both / max(passed, 1)


def colors() -> None:
    """Whether the colour is found, and the diameter with it."""
    print(f"{'scene':44s} color    conf  rope_%  (true)  other_% (true)  ok   true_mm  found_mm       seconds")
    suite = ((name, *suite_scene(name), ROPE_COLOR) for name in SUITE)
    for name, seen, diameter, true in itertools.chain(suite, colored_scenes(), recorded_scenes()):
        frames = [sight.frame for sight in seen]
        begin = time.perf_counter()
        try:
            color = propose_color(frames)
        except RopetraceError as error:
            print(f"{name:44s} {error}")
            continue
        seconds = time.perf_counter() - begin
        try:
            size = propose_diameter(frames, color.color).text()
        except RopetraceError as error:
            size = str(error)
        kept, wrong = passing(seen, parse_color(color.color))
        best_kept, best_wrong = passing(seen, true)
        ok = "yes" if kept > min(0.9, best_kept - 0.03) and wrong < max(0.05, best_wrong + 0.03) else "NO"
        shares = f"{kept:6.1%} {best_kept:6.1%}  {wrong:6.1%} {best_wrong:6.1%}  {ok:4s} {diameter * 1e3:7.1f}"
        if math.isnan(diameter):
            shares = "the truth is not known".ljust(46)
        print(f"{name:44s} {color.color}  {color.confidence:.2f}  {shares}  {size}  {seconds:.2f}")
        for reason in color.reasons[1:]:
            print(" " * 10 + reason)


def random_scenes(first_seed: int = 3000, shift: int = 0) -> None:
    """Any colour before any wall that its gate rejects, any size, blur, noise; colour moved `shift` pixels aside."""
    widths, errors, scores, verdicts = [], [], [], []
    for seed in range(first_seed, first_seed + RANDOM_SCENES):
        rng = np.random.default_rng(seed)
        rope = wall = (0, 0, 0)
        while ColorGate.around_color(rope, 20.0).accepts(np.outer((1, 0.85, 0.73), wall).astype(np.uint8)).any():
            r, g, b, *behind = (int(value) for value in rng.integers(20, 240, 6))
            rope, wall = (r, g, b), (behind[0], behind[1], behind[2])
        diameter, distance = rng.uniform(0.005, 0.025), rng.uniform(0.6, 1.5)
        blur, counts = rng.uniform(0.3, 1.2), rng.uniform(1, 6)
        plane = Plane((rng.uniform(-0.3, 0.3), 0.0, 1.0), distance + 0.5, wall, CLUTTER)
        noise = ("none", "kinect_v1_edges", "stereo_edges")[seed % 3]
        axes = itertools.islice(swaying(rng, distance, 0.05 * (seed % 2)), 5)
        seen: list[Sight] = []
        for sight in sights(axes, diameter, rope, Scene(Capsules.none(), (plane,)), noise):
            assert sight.frame.color is not None
            color = through_lens(np.roll(sight.frame.color, shift, axis=1), seed + len(seen), blur, counts)
            seen.append(Sight(dataclasses.replace(sight.frame, color=color), sight.rope))
        frames = [sight.frame for sight in seen]
        try:
            size = propose_diameter(frames, format_color(rope))
        except RopetraceError:
            continue
        widths.append(size.pixels)
        errors.append(size.diameter / diameter - 1)
        scores.append((size.diameter - diameter) / size.sigma)
        try:
            found = passing(seen, parse_color(propose_color(frames).color))
        except RopetraceError:
            verdicts.append("refused")
            continue
        best = passing(seen, rope)
        good = found[0] > min(0.9, best[0] - 0.05) and found[1] < max(0.05, best[1] + 0.05)
        verdicts.append("right" if good else "wrong")
    print(f"{RANDOM_SCENES} random scenes, colour {shift} pixels beside depth: {len(errors)} diameters proposed")
    for low, high in ((0, 4), (4, 8), (8, 99)):
        chosen = [k for k, width in enumerate(widths) if low <= width < high]
        if chosen:
            error, score = np.array(errors)[chosen], np.abs(np.array(scores)[chosen])
            print(
                f"  {low} to {high} pixels wide: {np.count_nonzero(score <= 2)} of {len(chosen)} within 2 sigma, "
                f"median error {np.median(error):.1%}, rms {np.sqrt(np.mean(error**2)):.1%}"
            )
    print("  colours: " + ", ".join(f"{verdicts.count(name)} {name}" for name in ("right", "wrong", "refused")))


def main() -> None:
    diameters()
    print()
    random_scenes()
    random_scenes(5000, shift=2)
    print()
    colors()


if __name__ == "__main__":
    main()
