"""The one home of every setting and its default; dataclasses that read and write TOML.

A setting of ``None`` is derived from the rope's diameter or from the data: `RopeConfig.resolved` fills it in.
"""

from __future__ import annotations

import dataclasses
import difflib
import json
import math
import os
import re
import stat
import tomllib
import types
import typing
from collections.abc import Iterable
from dataclasses import dataclass, field
from numbers import Integral, Real
from pathlib import Path
from typing import Any, Literal, Self

import numpy as np

from ropetrace.config_methods import CdcpdConfig, CpdConfig, GltpConfig, SchulmanConfig, SprConfig, TrackDloConfig
from ropetrace.errors import ConfigError
from ropetrace.types import FloatArray

Vector = tuple[float, float, float]

DIAMETER_RANGE = (0.0005, 0.5)
"""What a depth camera can track, metres: half a millimetre to half a metre."""

_MOST_CONFIG_BYTES = 1_000_000

_UNITS = {"m": 1.0, "cm": 1e-2, "mm": 1e-3, "um": 1e-6, "in": 0.0254}
_LENGTH = {"unit": "length"}


def parse_length(text: str | float) -> float:
    """Metres from a number of metres or from a text with a unit.

    >>> parse_length("12mm"), parse_length("1.2 cm"), parse_length("0.5"), parse_length(0.012)
    (0.012, 0.012, 0.5, 0.012)

    Raises
    ------
    ConfigError
        If the text is not a length.
    """
    if not isinstance(text, str):
        return float(text)
    match = re.fullmatch(r"\s*([-+0-9.eE]+?)\s*(m|cm|mm|um|in)?\s*", text)
    try:
        if match is None:
            raise ValueError
        value = float(match[1])
    except ValueError:
        raise ConfigError(
            f"{text!r} is not a length: write it like 12mm, 1.2cm or 0.012 (metres); units: {', '.join(_UNITS)}"
        ) from None
    # Dividing by a whole number rounds correctly where multiplying by its inverse does not: 12mm is 0.012.
    unit = _UNITS[match[2] or "m"]
    return value * unit if unit >= 1 or match[2] == "in" else value / round(1 / unit)


def parse_color(text: str) -> tuple[int, int, int]:
    """sRGB from ``#rrggbb``, ``#rgb`` or ``r,g,b``.

    >>> parse_color("#c8281e"), parse_color("200, 40, 30")
    ((200, 40, 30), (200, 40, 30))

    Raises
    ------
    ConfigError
        If the text is not a colour.
    """
    hexadecimal = re.fullmatch(r"#?([0-9a-fA-F]{6}|[0-9a-fA-F]{3})", text.strip())
    if hexadecimal:
        digits = hexadecimal[1] if len(hexadecimal[1]) == 6 else "".join(2 * c for c in hexadecimal[1])
        return int(digits[:2], 16), int(digits[2:4], 16), int(digits[4:], 16)
    numbers = re.fullmatch(r"\s*(\d{1,3})\s*,\s*(\d{1,3})\s*,\s*(\d{1,3})\s*", text)
    if numbers and all(int(number) <= 255 for number in numbers.groups()):
        return int(numbers[1]), int(numbers[2]), int(numbers[3])
    raise ConfigError(f"{text!r} is not a colour: write it like '#c8281e' or '200,40,30' (sRGB)")


def format_color(rgb: Iterable[int]) -> str:
    """``#rrggbb`` of an sRGB colour, as `parse_color` reads it."""
    return "#{:02x}{:02x}{:02x}".format(*rgb)


def _require(condition: bool, message: str) -> None:
    if not condition:
        raise ConfigError(message)


def _finite(*values: float) -> bool:
    """Whether all are real numbers, NumPy's among them, that a double can hold."""
    return all(isinstance(value, Real) and math.isfinite(_as_float(value)) for value in values)


def _as_float(value: float) -> float:
    try:
        return float(value)
    except OverflowError:  # a whole number of hundreds of digits
        return math.inf


@dataclass(frozen=True, slots=True)
class SegmentationConfig:
    """Which points belong to the rope (section 6.1)."""

    color_tolerance: float = 20.0
    """How far from the rope's colour, in full light or in its own shade, a pixel may lie: CIELAB units (delta E)."""
    more_colors: tuple[str, ...] = ()
    """Colours in full light of further ropes, ``#rrggbb``, beside `color`."""
    color_pixel: tuple[int, int] | None = None
    """Take the colour from this pixel (column, row) of the first frame, in the place of `color`."""
    lab_min: Vector | None = None
    """Lower corner (L*, a*, b*) of a CIELAB box, in the place of `color`."""
    lab_max: Vector | None = None
    """Upper corner (L*, a*, b*) of that box."""
    box_min: Vector | None = None
    """Lower corner (x, y, z) of the position box, metres."""
    box_max: Vector | None = None
    """Upper corner (x, y, z) of the position box, metres."""
    box_frame: Literal["camera", "world"] = "camera"
    """The frame of the position box; `world` needs `camera_pose`."""
    reject_flying_pixels: bool = False
    """Drop pixels that hang in the air between the rope and what is behind it."""

    def __post_init__(self) -> None:
        _require(
            _finite(self.color_tolerance) and 0 < self.color_tolerance <= 200,
            f"segmentation.color_tolerance = {self.color_tolerance}: expected 0 to 200 CIELAB units",
        )
        for color in self.more_colors:
            parse_color(color)
        for name in ("lab", "box"):
            low, high = getattr(self, f"{name}_min"), getattr(self, f"{name}_max")
            _require(
                (low is None) == (high is None),
                f"segmentation.{name}_min and segmentation.{name}_max go together: give both or neither",
            )
            if low is not None:
                _require(
                    _finite(*low, *high) and all(a < b for a, b in zip(low, high, strict=True)),
                    f"segmentation.{name}_min = {low} must lie below segmentation.{name}_max = {high} on each axis",
                )
        if self.color_pixel is not None:
            _require(
                min(self.color_pixel) >= 0, f"segmentation.color_pixel = {self.color_pixel}: expected column, row >= 0"
            )
        _require(
            self.lab_min is None or self.color_pixel is None,
            "segmentation.lab_min and segmentation.color_pixel both set the colour: give one of them",
        )


@dataclass(frozen=True, slots=True)
class SlicingConfig:
    """How the points are cut into nodes (section 4.1)."""

    variance_threshold: float | None = None
    """delta_sigma of equation 9, m^2: the largest trace of a slice's covariance. Derived from the diameter."""
    min_points: int | None = None
    """delta_O of equation 10: slices with fewer points are dropped. Derived from the slices of the frame."""
    surface_offset: Vector | None = None
    """v_c of equation 11, the paper's constant vector, metres. Default: from the geometry of a cylinder."""
    max_nodes: int = 400
    """More slices than this are not made: the frame is then degraded."""
    max_points: int = 200_000
    """With more points than this, only every k-th is used: the frame is then degraded."""

    def __post_init__(self) -> None:
        if self.variance_threshold is not None:
            _require(
                _finite(self.variance_threshold) and 0 < self.variance_threshold < 1,
                f"slicing.variance_threshold = {self.variance_threshold}: expected a variance in m^2 above 0, "
                "such as 1e-4",
            )
        _require(
            self.min_points is None or 1 <= self.min_points <= 1_000_000,
            f"slicing.min_points = {self.min_points}: expected 1 to 1 000 000",
        )
        _require(
            self.surface_offset is None or (_finite(*self.surface_offset) and max(map(abs, self.surface_offset)) < 1),
            f"slicing.surface_offset = {self.surface_offset}: expected x, y, z in metres",
        )
        _require(4 <= self.max_nodes <= 4096, f"slicing.max_nodes = {self.max_nodes}: expected 4 to 4096")
        _require(
            100 <= self.max_points <= 10_000_000,
            f"slicing.max_points = {self.max_points}: expected 100 to 10 000 000",
        )


@dataclass(frozen=True, slots=True)
class OrderingConfig:
    """How the nodes become a chain (section 4.2)."""

    method: Literal["path", "greedy"] = "path"
    """`path`: the open chain of the least cost. `greedy`: the paper's equations 12-14."""
    first: Literal["up", "point"] = "up"
    """Which end comes first in the first frame: the upper one in the image, or the one closest to `first_point`."""
    first_point: Vector | None = None
    """For `first = "point"`: metres, camera frame."""
    follow_previous: bool = True
    """After the first frame, start where the previous frame started. If not, apply `first` to every frame."""
    max_gap: float | None = field(default=None, metadata=_LENGTH)
    """Pieces of rope farther apart than this are not joined, metres. Derived from the diameter."""

    def __post_init__(self) -> None:
        _require(
            (self.first == "point") == (self.first_point is not None),
            'ordering.first = "point" and ordering.first_point go together: give both or neither',
        )
        _require(
            self.max_gap is None or (_finite(self.max_gap) and self.max_gap > 0),
            f"ordering.max_gap = {self.max_gap}: expected a length above 0",
        )


@dataclass(frozen=True, slots=True)
class CenterlineConfig:
    """How the chain becomes waypoints (section 4.2)."""

    spacing: float | None = field(default=None, metadata=_LENGTH)
    """Arc length between waypoints, metres. Derived from the diameter."""

    def __post_init__(self) -> None:
        _require(
            self.spacing is None or (_finite(self.spacing) and 1e-5 <= self.spacing <= 10),
            f"centerline.spacing = {self.spacing}: expected 0.01 mm to 10 m",
        )


@dataclass(frozen=True, slots=True)
class MotionConfig:
    """How velocities and accelerations are estimated (section 5.1)."""

    method: Literal["arc_length", "closest", "none"] = "arc_length"
    """`arc_length`: points at equal arc length, each with a bank of filters. `closest`: the paper's Algorithm 1."""


MOST_ROPES = 50
"""That are followed at once."""


@dataclass(frozen=True, slots=True)
class RopeConfig:
    """Everything that ropetrace must be told of a rope; the diameter and the colour are enough.

    Raises
    ------
    ConfigError
        If a setting is impossible; the message names it and what would do.
    """

    diameter: float = field(metadata=_LENGTH)
    """The rope's diameter, metres."""
    color: str | None = None
    """The rope's colour in full light, ``#rrggbb``."""
    method: str = "persistent"
    """The tracker."""
    ropes: int | Literal["auto"] = 1
    """How many ropes are followed; ``"auto"`` for all that are seen. Only `persistent` follows more than one."""
    camera_pose: tuple[float, float, float, float, float, float, float] | None = None
    """The camera in the world: x, y, z in metres, then the quaternion qx, qy, qz, qw of its optical frame."""
    segmentation: SegmentationConfig = field(default_factory=SegmentationConfig)
    slicing: SlicingConfig = field(default_factory=SlicingConfig)
    ordering: OrderingConfig = field(default_factory=OrderingConfig)
    centerline: CenterlineConfig = field(default_factory=CenterlineConfig)
    motion: MotionConfig = field(default_factory=MotionConfig)
    schulman: SchulmanConfig = field(default_factory=SchulmanConfig)
    cpd: CpdConfig = field(default_factory=CpdConfig)
    gltp: GltpConfig = field(default_factory=GltpConfig)
    spr: SprConfig = field(default_factory=SprConfig)
    trackdlo: TrackDloConfig = field(default_factory=TrackDloConfig)
    cdcpd: CdcpdConfig = field(default_factory=CdcpdConfig)

    def __post_init__(self) -> None:
        low, high = DIAMETER_RANGE
        shown = f"{self.diameter:g} m" if _finite(self.diameter) else repr(self.diameter)
        _require(
            _finite(self.diameter) and low <= self.diameter <= high,
            f"diameter = {shown}: expected {low * 1e3:g} mm to {high * 1e3:g} mm "
            "(a number without a unit is in metres)",
        )
        if self.color is not None:
            parse_color(self.color)
            _require(
                self.segmentation.lab_min is None and self.segmentation.color_pixel is None,
                "color, segmentation.lab_min and segmentation.color_pixel each set the colour: give one of them",
            )
        _require(
            self.color is not None or not self.segmentation.more_colors,
            "segmentation.more_colors stands beside color: give that, too",
        )
        _require(
            self.ropes == "auto" or (isinstance(self.ropes, int) and 1 <= self.ropes <= MOST_ROPES),
            f'ropes = {self.ropes!r}: expected 1 to {MOST_ROPES}, or "auto"',
        )
        _require(
            self.ropes == 1 or self.method == "persistent",
            f'ropes = {self.ropes!r} with method = "{self.method}": only "persistent" follows more than one',
        )
        if self.camera_pose is not None:
            _require(
                _finite(*self.camera_pose) and abs(math.hypot(*self.camera_pose[3:]) - 1) < 1e-3,
                f"camera_pose = {self.camera_pose}: expected x, y, z and a unit quaternion qx, qy, qz, qw",
            )
        _require(
            self.segmentation.box_frame == "camera" or self.camera_pose is not None,
            'segmentation.box_frame = "world" needs camera_pose, the camera\'s pose in the world',
        )

    @property
    def radius(self) -> float:
        """Half the diameter, metres."""
        return self.diameter / 2

    @property
    def asks_for_color(self) -> bool:
        """Whether the frames must have colour."""
        return (
            self.color is not None or self.segmentation.lab_min is not None or self.segmentation.color_pixel is not None
        )

    def world_from_camera(self) -> FloatArray:
        """The camera's pose as a (4, 4) transform; the identity where none is given."""
        transform = np.eye(4)
        if self.camera_pose is not None:
            x, y, z, w = np.array(self.camera_pose[3:]) / math.hypot(*self.camera_pose[3:])
            transform[:3, :3] = [
                [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
                [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
                [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
            ]
            transform[:3, 3] = self.camera_pose[:3]
        return transform

    def resolved(self) -> Self:
        """The same settings with everything filled in that follows from the diameter."""
        slicing, ordering, centerline = self.slicing, self.ordering, self.centerline
        if slicing.variance_threshold is None:
            slicing = dataclasses.replace(slicing, variance_threshold=default_variance_threshold(self.diameter))
        if ordering.max_gap is None:
            ordering = dataclasses.replace(ordering, max_gap=max(10 * self.diameter, 0.06))
        if centerline.spacing is None:
            centerline = dataclasses.replace(centerline, spacing=min(max(self.diameter / 2, 0.002), 0.01))
        return dataclasses.replace(self, slicing=slicing, ordering=ordering, centerline=centerline)

    @classmethod
    def from_toml(cls, path: str | Path, **overrides: Any) -> Self:
        """Read the settings from a TOML file.

        Parameters
        ----------
        path : path
            The file.
        **overrides
            Top-level settings that count in the place of the file's, where they are not None.

        Raises
        ------
        ConfigError
            If the file cannot be read, is not TOML, or holds an unknown or impossible setting.
        """
        table = read_toml(path)
        table |= {name: value for name, value in overrides.items() if value is not None}
        try:
            return from_table(cls, table, "")
        except ConfigError as error:
            raise ConfigError(f"{path}: {error}") from None

    def to_toml(self) -> str:
        """The settings as TOML; what is None is left out, and so are defaults of methods other than `method`."""
        top: list[str] = []
        tables: list[str] = []
        for item in dataclasses.fields(self):
            value = getattr(self, item.name)
            if dataclasses.is_dataclass(value):
                default = _METHOD_TABLES.get(item.name)
                if default is not None and item.name != self.method and value == default():
                    continue
                rows = [
                    f"{inner.name} = {_toml_value(getattr(value, inner.name))}"
                    for inner in dataclasses.fields(value)
                    if getattr(value, inner.name) is not None
                ]
                tables.append("\n".join([f"[{item.name}]", *rows]))
            elif value is not None:
                top.append(f"{item.name} = {_toml_value(value)}")
        return "\n\n".join(["\n".join(top), *tables]) + "\n"


_METHOD_TABLES: dict[str, type[Any]] = {
    "schulman": SchulmanConfig,
    "cpd": CpdConfig,
    "gltp": GltpConfig,
    "spr": SprConfig,
    "trackdlo": TrackDloConfig,
    "cdcpd": CdcpdConfig,
}
"""Tables that matter to one method only, and have its name."""


def default_variance_threshold(diameter: float) -> float:
    """The variance of a slice of visible surface that is `SLICE_LENGTH` diameters long, m^2.

    Seen from afar, a cylinder of radius r shows points spread evenly over its width, with variance r^2/3, and a depth
    sqrt(r^2 - x^2), with variance r^2 (2/3 - pi^2/16); along the rope a slice of length l has variance l^2/12.
    """
    radius = diameter / 2
    across = radius**2 * (1 / 3 + 2 / 3 - math.pi**2 / 16)
    return across + (SLICE_LENGTH * diameter) ** 2 / 12


SLICE_LENGTH = 2.5
"""Longest slice, in diameters. Much shorter, and noise turns cuts along the rope; longer, and bends are cut short."""


def _toml_value(value: Any) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, str):
        # JSON escapes as TOML does, but for this one character.
        return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
    if isinstance(value, (tuple, list)):
        return "[" + ", ".join(_toml_value(item) for item in value) + "]"
    return repr(int(value) if isinstance(value, Integral) else float(value))


def read_toml(path: str | Path) -> dict[str, Any]:
    """The table that a TOML file holds.

    Raises
    ------
    ConfigError
        If the file cannot be read or is not TOML.
    """
    try:
        if not stat.S_ISREG(os.stat(path).st_mode):
            raise ConfigError(f"{path}: not a file")
        with open(path, "rb") as file:
            text = file.read(_MOST_CONFIG_BYTES + 1)
        if len(text) > _MOST_CONFIG_BYTES:
            raise ConfigError(f"{path}: larger than {_MOST_CONFIG_BYTES} bytes: not a file of settings")
        return tomllib.loads(text.decode("utf-8-sig"))
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read: {error.strerror}") from None
    except (ValueError, RecursionError) as error:
        raise ConfigError(f"{path}: not a TOML file: {error}") from None


def from_table(cls: type[Any], table: dict[str, Any], where: str = "", root: type[Any] | None = None) -> Any:
    """A dataclass of settings from a TOML table, with every key and type checked.

    Raises
    ------
    ConfigError
        If a key is unknown or missing, or a value is of the wrong type or impossible; it names the key.
    """
    known = {item.name: item for item in dataclasses.fields(cls)}
    hints = typing.get_type_hints(cls)
    values: dict[str, Any] = {}
    for key, value in table.items():
        if key not in known:
            raise ConfigError(f"unknown setting {where}{key}{_nearest(key, where, known, root or cls)}")
        hint = hints[key]
        if dataclasses.is_dataclass(hint):
            if not isinstance(value, dict):
                raise ConfigError(f"{where}{key} is a table: write [{where}{key}]")
            values[key] = from_table(typing.cast(type[Any], hint), value, f"{where}{key}.", root or cls)
        else:
            values[key] = _converted(value, hint, known[key].metadata.get("unit") == "length", where + key)
    missing = [
        name
        for name, item in known.items()
        if item.default is dataclasses.MISSING and item.default_factory is dataclasses.MISSING and name not in values
    ]
    if missing:
        raise ConfigError(f"{where}{missing[0]} is missing")
    return cls(**values)


def _nearest(key: str, where: str, known: dict[str, Any], root: type[Any]) -> str:
    """A hint at the setting that was meant: in this table, else in any of the file."""
    close = difflib.get_close_matches(key, known, 1)
    if close:
        return f": did you mean {where}{close[0]}?"
    everywhere = {item.name: item.name for item in dataclasses.fields(root)}
    for item in dataclasses.fields(root):
        if dataclasses.is_dataclass(item.default_factory):
            everywhere |= {
                inner.name: f"{item.name}.{inner.name}"
                for inner in dataclasses.fields(typing.cast(type[Any], item.default_factory))
            }
    close = difflib.get_close_matches(key, everywhere, 1)
    if close and everywhere[close[0]] != f"{where}{key}":
        return f": did you mean {everywhere[close[0]]}?"
    return f"; known here: {', '.join(known)}"


def _converted(value: Any, hint: Any, is_length: bool, name: str) -> Any:
    """The TOML value as the type of the setting, or a ConfigError that says what was expected."""
    options = typing.get_args(hint) if typing.get_origin(hint) in (types.UnionType, typing.Union) else (hint,)
    for option in options:
        origin, arguments = typing.get_origin(option), typing.get_args(option)
        if origin is Literal:
            if value in arguments:
                return value
            raise ConfigError(f"{name} = {value!r}: expected one of {', '.join(map(repr, arguments))}")
        if origin is tuple and arguments[1:] == (Ellipsis,):
            if isinstance(value, (list, tuple)):
                return tuple(_converted(item, arguments[0], is_length, name) for item in value)
            raise ConfigError(f"{name} = {value!r}: expected a list in brackets")
        if origin is tuple:
            if isinstance(value, (list, tuple)) and len(value) == len(arguments):
                return tuple(
                    _converted(item, argument, is_length, name) for item, argument in zip(value, arguments, strict=True)
                )
            raise ConfigError(f"{name} = {value!r}: expected {len(arguments)} numbers in brackets")
        if option is bool and isinstance(value, bool):
            return value
        if option is int and isinstance(value, int) and not isinstance(value, bool):
            return value
        if option is float and isinstance(value, (int, float)) and not isinstance(value, bool):
            return _as_float(value)
        if option is float and is_length and isinstance(value, str):
            return parse_length(value)
        if option is str and isinstance(value, str):
            return value
    wanted = [{float: "a number", int: "a whole number", bool: "true or false", str: "a text"}.get(o) for o in options]
    raise ConfigError(f"{name} = {value!r}: expected {' or '.join(w for w in wanted if w)}")
