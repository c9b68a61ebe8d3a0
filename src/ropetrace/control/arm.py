"""A robot arm: a chain of revolute joints from a URDF, where its tool is and how the tool moves.

The kinematics are Pinocchio's. It is given the chain alone, joint by joint, so that nothing else in the file (meshes,
fingers, plug-ins) can make it fail.
"""

from __future__ import annotations

import difflib
import math
from collections.abc import Sequence
from dataclasses import dataclass, fields
from importlib import resources
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray

from ropetrace.errors import ConfigError, import_extra
from ropetrace.types import FloatArray

_SHIPPED = {"panda": "panda_hand_tcp", "fr3": "fr3_hand_tcp"}
"""Arms that come with ropetrace, and their tools' frames."""


@dataclass(frozen=True, slots=True, eq=False)
class JointLimits:
    """What the joints of an arm can do.

    Parameters
    ----------
    lower, upper : (n,) float array
        Ends of each joint's range, rad.
    velocity : (n,) float array
        Greatest speed of each joint in either direction, rad/s.
    acceleration : (n,) float array
        rad/s^2.
    jerk : (n,) float array
        rad/s^3.

    Raises
    ------
    ConfigError
        If shapes differ, a value is not finite, a range is empty, or a speed, acceleration or jerk is not positive.
    """

    lower: FloatArray
    upper: FloatArray
    velocity: FloatArray
    acceleration: FloatArray
    jerk: FloatArray

    def __post_init__(self) -> None:
        for item in fields(self):
            values = np.array(getattr(self, item.name), dtype=np.float64)
            object.__setattr__(self, item.name, values)
            if values.ndim != 1 or values.shape != self.lower.shape or not len(values):
                raise ConfigError(
                    f"joint limits: {item.name} has shape {values.shape}, lower {self.lower.shape}: "
                    "expected one number a joint"
                )
            for joint, value in enumerate(values, 1):
                if not math.isfinite(value):
                    raise ConfigError(f"joint limits: {item.name} of joint {joint} is {value}, not a finite number")
                if item.name not in ("lower", "upper") and value <= 0:
                    raise ConfigError(f"joint limits: {item.name} of joint {joint} is {value:g}: it must be positive")
        for joint, (low, high) in enumerate(zip(self.lower, self.upper, strict=True), 1):
            if low >= high:
                raise ConfigError(f"joint limits: joint {joint} has the range {low:g} to {high:g} rad: it is empty")

    def __len__(self) -> int:
        return len(self.lower)


class Arm:
    """A chain of revolute joints with a tool at its end. Made by `from_urdf` or `named`.

    Joints beyond the tool or beside the chain, such as fingers, stand still at zero. The base is the root of the
    URDF's tree. An arm keeps the scratch memory of its kinematics: one thread at a time, or an arm for each.

    Attributes
    ----------
    name : str
        The robot's name in its URDF.
    joint_names : tuple of str
        From the base to the tool.
    limits : JointLimits
        In the order of `joint_names`.
    count : int
        n, the joints.
    path : Path
        Of the URDF.

    Raises
    ------
    MissingExtraError
        If Pinocchio is not installed.
    """

    def __init__(self, urdf: _Urdf, tool_frame: str, limits: JointLimits | None) -> None:
        chain = urdf.chain(tool_frame)
        revolute = [joint for joint in chain if joint.kind == "revolute"]
        self.name = urdf.name
        self.path = urdf.path
        self.joint_names = tuple(joint.name for joint in revolute)
        self.count = len(revolute)
        self.limits = urdf.limits(revolute) if limits is None else limits
        if len(self.limits) != self.count:
            raise ConfigError(
                f"{urdf.path}: limits for {len(self.limits)} joints, but {self.count} lead to {tool_frame!r}: "
                f"{', '.join(self.joint_names)}"
            )
        self._capsules = urdf.capsules(self.joint_names, chain[0].parent)
        self._build(chain)

    def _build(self, chain: Sequence[_Joint]) -> None:
        pinocchio: Any = import_extra("pinocchio", "arm")
        model = pinocchio.Model()
        last, placement = 0, np.eye(4)
        for joint in chain:
            placement = placement @ joint.origin
            if joint.kind == "revolute":
                turn = pinocchio.JointModelRevoluteUnaligned(joint.axis)
                last = model.addJoint(last, turn, pinocchio.SE3(placement), joint.name)
                placement = np.eye(4)
        tool = pinocchio.Frame("tool", last, pinocchio.SE3(placement), pinocchio.FrameType.OP_FRAME)
        self._frame = model.addFrame(tool)
        self._model, self._data = model, model.createData()
        self._axes = pinocchio.LOCAL_WORLD_ALIGNED
        self._jacobian, self._forward = pinocchio.computeFrameJacobian, pinocchio.forwardKinematics
        self._tool = self._data.oMf[self._frame]

    @classmethod
    def from_urdf(cls, path: str | Path, tool_frame: str, limits: JointLimits | None = None) -> Arm:
        """Any arm of revolute joints.

        Parameters
        ----------
        path : str or Path
            The URDF. Meshes are not read.
        tool_frame : str
            The link that is guided.
        limits : JointLimits, optional
            By default those of the URDF: each joint's ``<limit lower upper velocity acceleration jerk>``, of which the
            last two are no part of the standard.

        Raises
        ------
        ConfigError
            If the file cannot be read or is no URDF; there is no such frame; a joint between base and tool is neither
            revolute nor fixed, or mimics another; a limit is missing or impossible.
        """
        return cls(_Urdf(Path(path)), tool_frame, limits)

    @classmethod
    def named(cls, name: str) -> Arm:
        """An arm that comes with ropetrace: ``panda`` or ``fr3``, each with its hand, the tool between its fingers.

        Raises
        ------
        ConfigError
            If there is no such arm.
        """
        if name not in _SHIPPED:
            raise ConfigError(f"there is no arm {name!r}: use one of {', '.join(_SHIPPED)}, or a URDF of your own")
        with resources.as_file(resources.files(__package__).joinpath("robots", f"{name}.urdf")) as file:
            return cls.from_urdf(file, _SHIPPED[name])

    def _checked(self, q: FloatArray) -> FloatArray:
        joints = np.asarray(q, dtype=np.float64)
        if joints.shape != (self.count,):
            raise ValueError(f"q has shape {joints.shape}: {self.name} has {self.count} joints")
        return joints

    def kinematics(self, q: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Pose and Jacobian of the tool, in one pass.

        Parameters
        ----------
        q : (n,) float array
            Joint angles, rad. They may lie outside the limits; one that is not a finite number gives such results.

        Returns
        -------
        base_from_tool : (4, 4) float array
            Metres.
        jacobian : (6, n) float array
            From joint velocities, rad/s, to the tool's twist: rows 0-2 the velocity of its origin, m/s, rows 3-5 its
            angular velocity, rad/s, both along the base's axes.

        Raises
        ------
        ValueError
            If there is not one angle a joint.
        """
        jacobian = self._jacobian(self._model, self._data, self._checked(q), self._frame, self._axes)
        return self._tool.homogeneous, np.ascontiguousarray(jacobian)

    def forward(self, q: FloatArray) -> FloatArray:
        """The pose of the tool, ``base_from_tool``, (4, 4), metres, at joint angles (n,), rad."""
        return self.kinematics(q)[0]

    def jacobian(self, q: FloatArray) -> FloatArray:
        """The Jacobian of the tool, (6, n), at joint angles (n,), rad: see `kinematics`."""
        return self.kinematics(q)[1]

    def link_poses(self, q: FloatArray) -> FloatArray:
        """Where the links are, for drawing.

        Parameters
        ----------
        q : (n,) float array
            Joint angles, rad.

        Returns
        -------
        (n, 4, 4) float array
            ``base_from_joint``, metres: the frames that turn with the joints.
        """
        return self._poses(q)[1:]

    def _poses(self, q: FloatArray) -> FloatArray:
        """Those of the base and the joints, (n + 1, 4, 4)."""
        self._forward(self._model, self._data, self._checked(q))
        return np.array([pose.homogeneous for pose in self._data.oMi])

    def capsules(self, q: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """The links' shapes, from the cylinders, capsules and spheres of the URDF's collision geometry.

        A cylinder becomes the capsule that holds it: rounded beyond its ends by its radius. Boxes and meshes are left
        out.

        Parameters
        ----------
        q : (n,) float array
            Joint angles, rad.

        Returns
        -------
        starts, ends : (K, 3) float array
            Ends of the capsules' axes, metres, in the base's frame; equal for a sphere.
        radii : (K,) float array
            Metres.
        """
        carriers, starts, ends, radii = self._capsules
        poses = self._poses(q)[carriers]
        turns, places = poses[:, :3, :3], poses[:, :3, 3]
        return (
            np.einsum("kij,kj->ki", turns, starts) + places,
            np.einsum("kij,kj->ki", turns, ends) + places,
            radii.copy(),
        )


@dataclass(frozen=True, slots=True, eq=False)
class _Joint:
    """A joint of a URDF: `origin` is ``parent_from_child`` at zero, `axis` a unit vector in the child's frame."""

    name: str
    kind: str
    parent: str
    child: str
    origin: FloatArray
    axis: FloatArray
    limit: dict[str, str]


class _Urdf:
    """The tree of a URDF, and what an arm wants of it."""

    def __init__(self, path: Path) -> None:
        self.path = path
        robot = self._read()
        self.name = robot.get("name") or path.stem
        self._links = {link.get("name", ""): link for link in robot.findall("link")}
        self._above: dict[str, _Joint] = {}
        for element in robot.findall("joint"):
            joint = self._joint(element)
            if joint.child in self._above:
                raise ConfigError(
                    f"{path}: link {joint.child!r} hangs on two joints, {self._above[joint.child].name!r} and "
                    f"{joint.name!r}: the links of a URDF are a tree"
                )
            self._above[joint.child] = joint

    def _read(self) -> ElementTree.Element:
        try:
            robot = ElementTree.parse(self.path).getroot()
        except OSError as error:
            raise ConfigError(f"{self.path}: cannot be read: {error.strerror or error}") from None
        except (ElementTree.ParseError, ValueError, LookupError) as error:
            raise ConfigError(f"{self.path}: is not XML: {error}") from None
        if robot.tag != "robot":
            raise ConfigError(f"{self.path}: is no URDF: it begins with <{robot.tag}>, not with <robot>")
        if any("ros.org/wiki/xacro}" in str(element.tag) for element in robot.iter()):
            raise ConfigError(f"{self.path}: holds xacro macros: expand them first (xacro {self.path.name} > arm.urdf)")
        return robot

    def _joint(self, element: ElementTree.Element) -> _Joint:
        name = element.get("name", "")
        ends = [getattr(element.find(end), "attrib", {}).get("link") for end in ("parent", "child")]
        for link in ends:
            if link not in self._links:
                raise ConfigError(f"{self.path}: joint {name!r} ties {ends[0]!r} to {ends[1]!r}: there is no {link!r}")
        kind = "mimic" if element.find("mimic") is not None else element.get("type", "")
        axis = self._numbers(element.find("axis"), "xyz", "1 0 0", 3)
        size = float(np.linalg.norm(axis))
        if kind == "revolute" and not size > 0:
            raise ConfigError(f"{self.path}: joint {name!r} has an axis of no length")
        limit = element.find("limit")
        return _Joint(
            name,
            kind,
            str(ends[0]),
            str(ends[1]),
            self._origin(element),
            axis / (size or 1.0),
            {} if limit is None else dict(limit.attrib),
        )

    def _numbers(self, element: ElementTree.Element | None, key: str, default: str, count: int) -> FloatArray:
        text = default if element is None else element.get(key, default)
        try:
            values = np.array([float(word) for word in text.split()])
        except ValueError:
            values = np.empty(0)
        if len(values) != count or not np.isfinite(values).all():
            tag = "" if element is None else element.tag
            raise ConfigError(f"{self.path}: <{tag} {key}={text!r}>: expected {count} finite number{'s'[: count - 1]}")
        return values

    def _origin(self, element: ElementTree.Element) -> FloatArray:
        origin = element.find("origin")
        (a, b, c), (d, e, f) = np.cos(rpy := self._numbers(origin, "rpy", "0 0 0", 3)), np.sin(rpy)
        pose = np.eye(4)
        pose[:3, :3] = [
            [c * b, c * e * d - f * a, c * e * a + f * d],
            [f * b, f * e * d + c * a, f * e * a - c * d],
            [-e, b * d, b * a],
        ]
        pose[:3, 3] = self._numbers(origin, "xyz", "0 0 0", 3)
        return pose

    def chain(self, tool_frame: str) -> list[_Joint]:
        """The joints from the root to a link."""
        if tool_frame not in self._links:
            nearest = difflib.get_close_matches(tool_frame, self._links, 3, 0.0)
            raise ConfigError(f"{self.path}: there is no frame {tool_frame!r}; nearest: {', '.join(nearest) or 'none'}")
        chain: list[_Joint] = []
        link = tool_frame
        while link in self._above and len(chain) <= len(self._above):
            chain.append(self._above[link])
            link = chain[-1].parent
        if len(chain) > len(self._above):
            raise ConfigError(f"{self.path}: the links above {tool_frame!r} form a ring: those of a URDF are a tree")
        for joint in chain:
            if joint.kind not in ("revolute", "fixed"):
                raise ConfigError(
                    f"{self.path}: joint {joint.name!r} on the way to {tool_frame!r} is {joint.kind or 'of no type'}: "
                    "only revolute and fixed joints are supported there"
                )
        names = [joint.name for joint in chain if joint.kind == "revolute"]
        if not names:
            raise ConfigError(f"{self.path}: no joint moves {tool_frame!r}")
        if len(set(names)) < len(names):
            raise ConfigError(f"{self.path}: two joints on the way to {tool_frame!r} have one name: {', '.join(names)}")
        return chain[::-1]

    def limits(self, joints: Sequence[_Joint]) -> JointLimits:
        """As the URDF has them."""
        table: dict[str, list[float]] = {item.name: [] for item in fields(JointLimits)}
        for joint in joints:
            for key, column in table.items():
                try:
                    column.append(float(joint.limit[key]))
                except KeyError:
                    raise ConfigError(
                        f"{self.path}: the <limit> of joint {joint.name!r} has no {key}: add it (rad, s; acceleration "
                        "and jerk are attributes beside velocity), or pass limits=JointLimits(...)"
                    ) from None
                except ValueError:
                    raise ConfigError(
                        f"{self.path}: joint {joint.name!r} has the limit {key}={joint.limit[key]!r}: expected a number"
                    ) from None
        try:
            return JointLimits(**{key: np.array(column) for key, column in table.items()})
        except ConfigError as error:
            raise ConfigError(f"{self.path}: {error} (joint 1 is {joints[0].name!r})") from None

    def capsules(
        self, moving: Sequence[str], base: str
    ) -> tuple[NDArray[np.int64], FloatArray, FloatArray, FloatArray]:
        """What carries each capsule (0 the base, i the i-th moving joint), its ends there, and its radius."""
        below: dict[str, list[_Joint]] = {}
        for joint in self._above.values():
            below.setdefault(joint.parent, []).append(joint)
        carriers, ends, radii = [], [], []
        reached = [(base, 0, np.eye(4))]
        for link, carrier, placement in reached:
            for shape in self._links[link].findall("collision"):
                for tag in ("cylinder", "capsule", "sphere"):
                    solid = shape.find(f"geometry/{tag}")
                    if solid is not None:
                        half = self._numbers(solid, "length", "0" if tag == "sphere" else "", 1)[0] / 2
                        pose = placement @ self._origin(shape)
                        carriers.append(carrier)
                        ends.append([pose[:3, 3] - half * pose[:3, 2], pose[:3, 3] + half * pose[:3, 2]])
                        radii.append(self._numbers(solid, "radius", "", 1)[0])
            for joint in below.get(link, []):
                if joint.name in moving:
                    reached.append((joint.child, moving.index(joint.name) + 1, np.eye(4)))
                else:
                    reached.append((joint.child, carrier, placement @ joint.origin))
        axes = np.array(ends).reshape(-1, 2, 3)
        return (
            np.array(carriers, dtype=np.int64),
            axes[:, 0].copy(),
            axes[:, 1].copy(),
            np.array(radii, dtype=np.float64),
        )
