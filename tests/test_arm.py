"""The arm: its kinematics against the published table, and URDFs good and bad."""

from __future__ import annotations

import re
from importlib import resources
from pathlib import Path

import numpy as np
import pytest

from ropetrace.control.arm import Arm, JointLimits
from ropetrace.errors import ConfigError
from ropetrace.types import FloatArray

pinocchio = pytest.importorskip("pinocchio")

ARMS = ("panda", "fr3")
TABLE_A = (0.0, 0.0, 0.0, 0.0825, -0.0825, 0.0, 0.088)
TABLE_D = (0.333, 0.0, 0.316, 0.0, 0.384, 0.0, 0.0)
TABLE_ALPHA = np.radians((0, -90, 90, 90, -90, 90, 90))


def about_x(angle: float) -> FloatArray:
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[1, 0, 0, 0], [0, c, -s, 0], [0, s, c, 0], [0, 0, 0, 1.0]])


def about_z(angle: float) -> FloatArray:
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s, 0, 0], [s, c, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1.0]])


def shift(x: float, z: float) -> FloatArray:
    pose = np.eye(4)
    pose[[0, 2], 3] = x, z
    return pose


def by_table(q: FloatArray) -> tuple[list[FloatArray], FloatArray]:
    """Poses of the joints and of the tool by the modified Denavit-Hartenberg table of the Panda and the FR3."""
    pose, joints = np.eye(4), []
    for a, d, alpha, angle in zip(TABLE_A, TABLE_D, TABLE_ALPHA, q, strict=True):
        pose = pose @ about_x(alpha) @ shift(a, 0) @ about_z(angle) @ shift(0, d)
        joints.append(pose)
    return joints, pose @ shift(0, 0.107) @ about_z(-np.pi / 4) @ shift(0, 0.1034)


def random_joints(arm: Arm, count: int, seed: int = 0) -> FloatArray:
    return np.random.default_rng(seed).uniform(arm.limits.lower, arm.limits.upper, (count, arm.count))


# --- the shipped arms ---


@pytest.mark.parametrize("name", ARMS)
def test_kinematics_are_those_of_the_published_table(name: str) -> None:
    arm = Arm.named(name)
    for q in random_joints(arm, 150):
        joints, tool = by_table(q)
        pose, jacobian = arm.kinematics(q)
        expected = [np.r_[np.cross(joint[:3, 2], tool[:3, 3] - joint[:3, 3]), joint[:3, 2]] for joint in joints]
        np.testing.assert_allclose(pose, tool, atol=1e-12)
        np.testing.assert_allclose(jacobian, np.transpose(expected), atol=1e-12)
        np.testing.assert_allclose(arm.link_poses(q), joints, atol=1e-12)
        np.testing.assert_array_equal(arm.forward(q), pose)
        np.testing.assert_array_equal(arm.jacobian(q), jacobian)


def test_jacobian_is_the_derivative_of_the_pose() -> None:
    arm, step = Arm.named("panda"), 1e-6
    for q in random_joints(arm, 20):
        pose, jacobian = arm.kinematics(q)
        for joint in range(7):
            change = np.eye(7)[joint] * step
            slope = (arm.forward(q + change) - arm.forward(q - change)) / (2 * step)
            spin = slope[:3, :3] @ pose[:3, :3].T
            np.testing.assert_allclose(slope[:3, 3], jacobian[:3, joint], atol=1e-8)
            np.testing.assert_allclose(spin[[2, 0, 1], [1, 2, 0]], jacobian[3:, joint], atol=1e-8)


def test_results_are_the_callers_own() -> None:
    arm = Arm.named("panda")
    first, second = random_joints(arm, 2)
    pose, jacobian = arm.kinematics(first)
    kept = pose.copy(), jacobian.copy()
    arm.kinematics(second)
    np.testing.assert_array_equal(pose, kept[0])
    np.testing.assert_array_equal(jacobian, kept[1])
    assert jacobian.flags.c_contiguous


def test_published_limits() -> None:
    panda, fr3 = Arm.named("panda"), Arm.named("fr3")
    assert panda.joint_names == tuple(f"panda_joint{joint}" for joint in range(1, 8))
    assert (panda.name, fr3.name, panda.count, fr3.count) == ("panda", "fr3", 7, 7)
    assert panda.limits.lower.tolist() == [-2.8973, -1.7628, -2.8973, -3.0718, -2.8973, -0.0175, -2.8973]
    assert panda.limits.upper.tolist() == [2.8973, 1.7628, 2.8973, -0.0698, 2.8973, 3.7525, 2.8973]
    assert panda.limits.velocity.tolist() == [2.175] * 4 + [2.61] * 3
    assert panda.limits.acceleration.tolist() == [15, 7.5, 10, 12.5, 15, 20, 20]
    assert panda.limits.jerk.tolist() == [7500, 3750, 5000, 6250, 7500, 10000, 10000]
    assert fr3.limits.lower.tolist() == [-2.3093, -1.5133, -2.4937, -2.7478, -2.48, 0.8521, -2.6895]
    assert fr3.limits.upper.tolist() == [2.3093, 1.5133, 2.4937, -0.4461, 2.48, 4.2094, 2.6895]
    assert fr3.limits.velocity.tolist() == [2, 1, 1.5, 1.25, 3, 1.5, 3]
    assert fr3.limits.acceleration.tolist() == [10] * 7
    assert fr3.limits.jerk.tolist() == [5000] * 7


@pytest.mark.parametrize("name", ARMS)
def test_other_programs_read_the_files(name: str, capfd: pytest.CaptureFixture[str]) -> None:
    arm = Arm.named(name)
    q = random_joints(arm, 1)[0]
    with resources.as_file(resources.files("ropetrace.control") / "robots" / f"{name}.urdf") as file:
        model = pinocchio.buildModelFromUrdf(str(file))
        data = model.createData()
        pinocchio.framesForwardKinematics(model, data, q)
        tool = data.oMf[model.getFrameId(f"{name}_hand_tcp")].homogeneous
        np.testing.assert_allclose(arm.forward(q), tool, atol=1e-12)
        mujoco = pytest.importorskip("mujoco")
        physics = mujoco.MjModel.from_xml_path(str(file))
    assert physics.nq == 7
    assert physics.ngeom == len(arm.capsules(q)[2])
    assert capfd.readouterr() == ("", "")


def test_capsules_follow_the_links() -> None:
    mujoco = pytest.importorskip("mujoco")
    arm = Arm.named("panda")
    with resources.as_file(resources.files("ropetrace.control") / "robots" / "panda.urdf") as file:
        physics = mujoco.MjModel.from_xml_path(str(file))
    data = mujoco.MjData(physics)
    for q in random_joints(arm, 5):
        data.qpos[:] = q
        mujoco.mj_kinematics(physics, data)
        starts, ends, radii = arm.capsules(q)
        axes = data.geom_xmat.reshape(-1, 3, 3)[:, :, 2] * physics.geom_size[:, 1:2]
        np.testing.assert_allclose((starts + ends) / 2, data.geom_xpos, atol=1e-6)
        np.testing.assert_allclose((ends - starts) / 2, axes, atol=1e-6)
        np.testing.assert_allclose(radii, physics.geom_size[:, 0], atol=1e-9)


def test_joints_are_checked_at_the_door() -> None:
    arm = Arm.named("panda")
    with pytest.raises(ValueError, match=re.escape("q has shape (6,): panda has 7 joints")):
        arm.kinematics(np.zeros(6))
    with pytest.raises(ValueError, match=re.escape("q has shape (7, 1)")):
        arm.link_poses(np.zeros((7, 1)))


def test_an_arm_that_does_not_come_with_us() -> None:
    with pytest.raises(ConfigError, match=r"there is no arm 'ur5': use one of panda, fr3, or a URDF of your own"):
        Arm.named("ur5")


# --- any other arm ---

LIMIT = '<limit lower="-2" upper="2" velocity="1" effort="5" acceleration="3" jerk="40"/>'


def joint(
    name: str, parent: str, child: str, kind: str = "revolute", inside: str = LIMIT, origin: str = "0.5 0 0"
) -> str:
    return (
        f'<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>'
        f'<origin xyz="{origin}"/><axis xyz="0 0 2"/>{inside}</joint>'
    )


BALL = '<collision><origin xyz="0.1 0 0"/><geometry><sphere radius="0.05"/></geometry></collision>'
BOX = '<collision><geometry><box size="1 1 1"/></geometry></collision>'
FINGERS = joint("left", "palm", "thumb", "prismatic") + joint(
    "right", "palm", "finger", "prismatic", LIMIT + '<mimic joint="left"/>'
)


def planar(*changed: str, links: str = "") -> str:
    """Three links of half a metre, the last one fixed to a palm with two fingers; joints of the same name replaced."""
    joints = [
        joint("shoulder", "base", "upper", origin="0 0 0"),
        joint("elbow", "upper", "fore"),
        joint("wrist", "fore", "palm"),
        joint("tip", "palm", "tool", "fixed", ""),
    ]
    for new in changed:
        name = new.split('"')[1]
        joints = [new if old.split('"')[1] == name else old for old in joints]
    bodies = "".join(f'<link name="{name}"/>' for name in ("base", "upper", "tool", "thumb"))
    shaped = f'<link name="fore">{BALL}{BOX}</link><link name="palm"/><link name="finger">{BALL}</link>'
    return f'<robot name="planar">{bodies}{shaped}{links}{"".join(joints)}{FINGERS}</robot>'


def written(folder: Path, text: str) -> Path:
    path = folder / "arm.urdf"
    path.write_text(text)
    return path


def test_a_planar_arm_with_fingers_beyond_its_tool(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    arm = Arm.from_urdf(written(tmp_path, planar()), "tool")
    assert arm.joint_names == ("shoulder", "elbow", "wrist")
    for q in random_joints(arm, 20):
        angles = np.cumsum(q)
        pose, jacobian = arm.kinematics(q)
        place = 0.5 * np.array([np.cos(angles), np.sin(angles)])
        np.testing.assert_allclose(pose[:2, 3], place.sum(axis=1), atol=1e-14)
        np.testing.assert_allclose(jacobian[0], -np.cumsum(place[1][::-1])[::-1], atol=1e-14)
        np.testing.assert_allclose(jacobian[1], np.cumsum(place[0][::-1])[::-1], atol=1e-14)
        np.testing.assert_allclose(jacobian[2:], [[0.0] * 3] * 3 + [[1.0] * 3], atol=1e-14)
        starts, ends, radii = arm.capsules(q)
        turn = about_z(angles[1])[:2, 0]
        np.testing.assert_allclose(starts[0], [*(place[:, 0] + 0.1 * turn), 0], atol=1e-14)
        np.testing.assert_array_equal(starts, ends)
        np.testing.assert_array_equal(radii, [0.05, 0.05])
        finger = place.sum(axis=1) + 0.1 * about_z(angles[2])[:2, 0]
        np.testing.assert_allclose(starts[1], [*finger, 0], atol=1e-14)
    assert capfd.readouterr() == ("", "")


def test_any_axes_and_origins(tmp_path: Path) -> None:
    rng = np.random.default_rng(3)
    links = "".join(f'<link name="l{index}"/>' for index in range(7))
    joints = ""
    for index in range(6):
        numbers = [" ".join(map(str, rng.normal(size=3))) for _ in range(3)]
        joints += (
            f'<joint name="j{index}" type="revolute"><parent link="l{index}"/><child link="l{index + 1}"/>'
            f'<origin xyz="{numbers[0]}" rpy="{numbers[1]}"/><axis xyz="{numbers[2]}"/>{LIMIT}</joint>'
        )
    path = written(tmp_path, f'<robot name="odd">{links}{joints}</robot>')
    arm, model = Arm.from_urdf(path, "l6"), pinocchio.buildModelFromUrdf(str(path))
    data = model.createData()
    for q in random_joints(arm, 20):
        jacobian = pinocchio.computeFrameJacobian(model, data, q, model.getFrameId("l6"), pinocchio.LOCAL_WORLD_ALIGNED)
        np.testing.assert_allclose(arm.forward(q), data.oMf[model.getFrameId("l6")].homogeneous, atol=1e-12)
        np.testing.assert_allclose(arm.jacobian(q), jacobian, atol=1e-12)
    assert [len(part) for part in arm.capsules(q)] == [0, 0, 0]
    assert arm.capsules(q)[0].shape == (0, 3)


def test_limits_of_ones_own(tmp_path: Path) -> None:
    path = written(tmp_path, planar(joint("elbow", "upper", "fore", inside="")))
    ones = np.ones(3)
    limits = JointLimits(-ones, ones, ones, ones, ones)
    assert Arm.from_urdf(path, "tool", limits).limits is limits
    with pytest.raises(ConfigError, match=r"limits for 2 joints, but 3 lead to 'tool': shoulder, elbow, wrist"):
        Arm.from_urdf(path, "tool", JointLimits(*np.outer([-1, 1, 1, 1, 1], [1, 1])))


PLAIN_LIMIT = '<limit lower="-2" upper="2" velocity="1" effort="5"/>'
XACRO = '<robot name="a" xmlns:xacro="http://www.ros.org/wiki/xacro"><xacro:include filename="b"/></robot>'


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "is not XML: no element found"),
        ("not XML at all", "is not XML: syntax error"),
        ('<?xml version="1.0" encoding="none-such"?><robot/>', "is not XML"),
        ("<sdf/>", "is no URDF: it begins with <sdf>, not with <robot>"),
        (XACRO, "holds xacro macros: expand them first (xacro arm.urdf > arm.urdf)"),
        (planar().replace('"tool"', '"tol"'), "there is no frame 'tool'; nearest: tol, "),
        ("<robot/>", "there is no frame 'tool'; nearest: none"),
        (
            planar(joint("elbow", "upper", "fore", inside=PLAIN_LIMIT)),
            "the <limit> of joint 'elbow' has no acceleration: add it (rad, s; acceleration and jerk are attributes "
            "beside velocity), or pass limits=JointLimits(...)",
        ),
        (planar(joint("elbow", "upper", "fore", inside="")), "the <limit> of joint 'elbow' has no lower"),
        (planar().replace('upper="2"', 'upper="-3"'), "joint 1 has the range -2 to -3 rad: it is empty"),
        (planar().replace('velocity="1"', 'velocity="fast"'), "'shoulder' has the limit velocity='fast'"),
        (planar().replace('velocity="1"', 'velocity="nan"'), "velocity of joint 1 is nan, not a finite number"),
        (
            planar().replace('jerk="40"', 'jerk="0"'),
            "jerk of joint 1 is 0: it must be positive (joint 1 is 'shoulder')",
        ),
        *[
            (
                planar(joint("elbow", "upper", "fore", kind)),
                f"joint 'elbow' on the way to 'tool' is {kind}: only revolute and fixed joints are supported there",
            )
            for kind in ("prismatic", "continuous", "floating", "planar")
        ],
        (
            planar(joint("elbow", "upper", "fore", inside=LIMIT + '<mimic joint="wrist"/>')),
            "joint 'elbow' on the way to 'tool' is mimic",
        ),
        (planar(joint("elbow", "upper", "fore", origin="0 0")), "<origin xyz='0 0'>: expected 3 finite numbers"),
        (planar(joint("elbow", "upper", "fore", origin="0 0 inf")), "expected 3 finite numbers"),
        (planar().replace("0 0 2", "0 0 0"), "joint 'shoulder' has an axis of no length"),
        (planar().replace("0.05", "wide"), "<sphere radius='wide'>: expected 1 finite number"),
        (planar(joint("elbow", "upper", "lost")), "joint 'elbow' ties 'upper' to 'lost': there is no 'lost'"),
        (planar(joint("elbow", "palm", "fore")), "the links above 'tool' form a ring"),
        (planar(joint("elbow", "upper", "palm")), "link 'palm' hangs on two joints, 'elbow' and 'wrist'"),
        (
            planar().replace('"wrist"', '"elbow"'),
            "two joints on the way to 'tool' have one name: elbow, elbow, shoulder",
        ),
        ('<robot><link name="tool"/></robot>', "no joint moves 'tool'"),
    ],
)
def test_a_bad_urdf_is_one_line(tmp_path: Path, text: str, message: str) -> None:
    path = written(tmp_path, text)
    with pytest.raises(ConfigError, match=f"^{re.escape(str(path))}: ") as caught:
        Arm.from_urdf(path, "tool")
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_urdf_that_is_not_there(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"none\.urdf: cannot be read: No such file or directory"):
        Arm.from_urdf(tmp_path / "none.urdf", "tool")
    with pytest.raises(ConfigError, match="cannot be read: Is a directory"):
        Arm.from_urdf(tmp_path, "tool")


@pytest.mark.parametrize(
    ("name", "values", "message"),
    [
        ("upper", [1, np.inf], "upper of joint 2 is inf, not a finite number"),
        ("upper", [1, -1], "joint 2 has the range -1 to -1 rad: it is empty"),
        ("velocity", [0, 1], "velocity of joint 1 is 0: it must be positive"),
        ("acceleration", [1, -2], "acceleration of joint 2 is -2: it must be positive"),
        ("jerk", [1], "jerk has shape (1,), lower (2,): expected one number a joint"),
        ("lower", [[-1, -1]], "lower has shape (1, 2)"),
        ("lower", [], "lower has shape (0,)"),
    ],
)
def test_impossible_limits(name: str, values: list[float], message: str) -> None:
    table = {"lower": [-1, -1]} | {key: [1, 1] for key in ("upper", "velocity", "acceleration", "jerk")}
    with pytest.raises(ConfigError, match=re.escape(message)):
        JointLimits(**{key: np.array(column, float) for key, column in (table | {name: values}).items()})


def test_limits_are_a_copy() -> None:
    values = np.ones(2)
    limits = JointLimits(-values, values, values, values, values)
    values[0] = 5
    assert limits.velocity.tolist() == [1, 1]
