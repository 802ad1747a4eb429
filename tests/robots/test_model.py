"""Kinematics: IK inverts FK within joint limits, and what can't be answered is refused."""

import dataclasses

import hypothesis.strategies as st
import numpy as np
import pinocchio as pin
import pytest
from hypothesis import given, settings

from sart_toolkit.errors import InvalidInput, MotionRejected, UnknownName, Unreachable
from sart_toolkit.poses import (
    angle_between,
    check_pose,
    distance,
    inverse,
    pose,
    relative_motion,
)
from sart_toolkit.robots import get_robot
from sart_toolkit.robots.model import RobotModel
from sart_toolkit.robots.references import resource_path
from sart_toolkit.robots.spec import Attachment, Shape

PROPERTY = settings(deadline=None, derandomize=True, max_examples=60)


def offsets(largest):
    return st.tuples(*[st.floats(-largest, largest)] * 6).map(np.array)


@PROPERTY
@given(dq=offsets(0.7), away=offsets(0.2))
def test_fk_of_ik_is_the_pose_asked_for(model, dq, away):
    T = model.fk(model.spec.home + dq)
    q = model.ik(T, model.spec.home + dq + away)
    assert max(distance(T, model.fk(q))) < 3e-6


@PROPERTY
@given(dq=offsets(0.7))
def test_ik_that_starts_at_an_answer_stays_there(model, dq):
    q = model.spec.home + dq
    np.testing.assert_allclose(model.ik(model.fk(q), q), q, atol=1e-12)


@PROPERTY
@given(dq=offsets(0.4), step=offsets(0.02))
def test_ik_follows_a_small_step_with_a_small_step(model, dq, step):
    q = model.spec.home + dq
    np.testing.assert_allclose(model.ik(model.fk(q + step), q), q + step, atol=1e-4)


@PROPERTY
@given(dq=offsets(1.5))
def test_the_jacobian_is_the_derivative_of_fk(model, dq):
    q, h = model.spec.home + dq, 1e-6
    for frame in (None, "forearm_link"):
        J = model.jacobian(q, frame)
        T = model.fk(q, frame)
        for j, e in enumerate(np.eye(6) * h):
            ahead = relative_motion(T, model.fk(q + e, frame))
            behind = relative_motion(T, model.fk(q - e, frame))
            np.testing.assert_allclose(J[:, j], (ahead - behind) / (2 * h), atol=1e-7)


@PROPERTY
@given(dq=offsets(3.0))
def test_link_poses_are_fk_of_every_frame(model, dq):
    q = model.spec.home + dq
    poses = model.link_poses(q)
    assert {"tool", "base_link", "wrist_camera", "gripper_left_inner_finger_pad"} <= set(poses)
    for name in ("tool", "forearm_link", "gripper_right_inner_finger_pad"):
        np.testing.assert_array_equal(poses[name], model.fk(q, name))
    np.testing.assert_array_equal(poses[model.spec.tool_frame], model.fk(q))
    for name, T in poses.items():
        check_pose(name, T)


def test_a_pose_once_returned_does_not_change_with_the_next_question(model):
    T = model.fk(model.spec.home)
    poses, kept = model.link_poses(model.spec.home), T.copy()
    model.fk(model.spec.home + 1)
    np.testing.assert_array_equal(T, kept)
    np.testing.assert_array_equal(poses["tool"], kept)


def test_the_arm_moves_as_its_source_says(model):
    source = pin.buildModelFromUrdf(str(resource_path(model.spec.urdf)))
    data = source.createData()
    rng = np.random.default_rng(0)
    for q in rng.uniform(-3, 3, (20, 6)):
        pin.framesForwardKinematics(source, data, q)
        expected = data.oMf[source.getFrameId("tool0")].homogeneous
        np.testing.assert_allclose(model.fk(q, "tool0"), expected, atol=1e-9)
    np.testing.assert_array_equal(model.lower, source.lowerPositionLimit)
    np.testing.assert_array_equal(model.upper, source.upperPositionLimit)


def test_the_tool_points_down_at_home(model):
    np.testing.assert_allclose(model.fk(model.spec.home)[:3, 2], [0, 0, -1], atol=0.01)


def test_what_is_held_has_a_frame_fixed_to_the_tool(peg_model):
    q = peg_model.spec.home + 0.3
    T_tool_peg = inverse(peg_model.fk(q)) @ peg_model.fk(q, "peg")
    np.testing.assert_allclose(T_tool_peg, peg_model.held[0].T_frame_body, atol=1e-9)


@PROPERTY
@given(joint=st.integers(0, 5), side=st.sampled_from([-1, 1]), beyond=st.floats(0.02, 0.3))
def test_ik_never_leaves_the_joint_limits(model, joint, side, beyond):
    limit = model.upper if side > 0 else model.lower
    near = np.array(model.spec.home)
    near[joint] = limit[joint] - side * 0.01
    wanted = near.copy()
    wanted[joint] = limit[joint] + side * beyond
    try:
        q = model.ik(model.fk(wanted), near)
    except Unreachable:
        return
    assert (model.lower <= q).all()
    assert (q <= model.upper).all()
    assert max(distance(model.fk(wanted), model.fk(q))) < 3e-6


def test_a_pose_beyond_a_joint_limit_is_unreachable(model):
    near = np.array(model.spec.home)
    near[5] = model.upper[5] - 0.01
    wanted = near + [0, 0, 0, 0, 0, 0.2]
    with pytest.raises(Unreachable, match="remain within joint limits; choose a pose nearer"):
        model.ik(model.fk(wanted), near)


@pytest.mark.parametrize("p", [(3, 0, 0), (0, 0, 2), (0, 0, -1.5)])
def test_a_pose_beyond_the_arm_is_unreachable(model, p):
    x, y, z = p
    with pytest.raises(Unreachable, match=rf"\({x:.3f}, {y:.3f}, {z:.3f}\) m is out of reach: "):
        model.ik(pose(p, [np.pi, 0, 0]), model.spec.home)


def test_an_answer_farther_than_the_greatest_step_is_rejected(model):
    T = model.fk(model.spec.home + 0.1)
    with pytest.raises(MotionRejected, match="joint jump: a step of 0.10 rad exceeds 0.05 rad, "):
        model.ik(T, model.spec.home, max_step=0.05)
    model.ik(T, model.spec.home, max_step=0.11)


@pytest.mark.parametrize("shape", [(5,), (7,), (1, 6), ()])
def test_a_joint_vector_of_another_shape_is_refused(model, shape):
    q = np.zeros(shape)
    for ask in (
        model.fk,
        model.jacobian,
        model.link_poses,
        lambda q: model.ik(model.fk(model.spec.home), q),
    ):
        with pytest.raises(InvalidInput, match=r"q: expected shape \(6,\), got \("):
            ask(q)


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_a_joint_vector_that_is_not_finite_is_refused(model, bad):
    with pytest.raises(InvalidInput, match="q: has NaN or infinite entries"):
        model.fk(np.full(6, bad))


@pytest.mark.parametrize("T", [np.eye(3), np.full((4, 4), np.nan), 2 * np.eye(4)])
def test_ik_of_what_is_no_pose_is_refused(model, T):
    with pytest.raises(InvalidInput, match="T_world_tool: "):
        model.ik(T, model.spec.home)


def test_an_unknown_frame_is_reported_with_the_nearest_name(model):
    for ask in (model.fk, model.jacobian):
        with pytest.raises(UnknownName, match="unknown frame 'toool': did you mean 'tool'"):
            ask(model.spec.home, "toool")


@pytest.mark.parametrize("gripper", [-0.1, 1.5, np.nan, np.inf])
def test_a_gripper_command_beyond_its_range_is_refused(spec, gripper):
    with pytest.raises(InvalidInput, match="gripper: expected 0 .*to 1"):
        RobotModel(spec, gripper=gripper)


# --- another robot ------------------------------------------------------------------------------


def test_a_robot_of_other_urdfs_needs_only_its_spec(make_tiny):
    model = RobotModel(make_tiny())
    T = model.fk(np.array([np.pi / 2, 0.0]))
    # Two joints 0.3 m apart, the gripper on the last, its tool frame 0.1 m on.
    np.testing.assert_allclose(T, pose([0, 0, 0.7], [0, 0, np.pi / 2]), atol=1e-9)


def test_an_arm_joint_that_the_urdf_lacks_is_reported_with_the_nearest_name(make_tiny):
    spec = make_tiny(arm_joints=("shoulder", "wrst"))
    with pytest.raises(UnknownName, match="unknown joint 'wrst': did you mean 'wrist'"):
        RobotModel(spec)


def test_arm_joints_in_another_order_are_refused(make_tiny):
    spec = make_tiny(arm_joints=("wrist", "shoulder"))
    with pytest.raises(InvalidInput, match="tiny: arm_joints must be in the URDF's order"):
        RobotModel(spec)


@pytest.mark.parametrize(
    "change",
    [{"driver": "gripper_fingr_joint"}, {"followers": {"gripper_fingr_joint": 1.0}}],
    ids=["driver", "follower"],
)
def test_a_gripper_joint_that_the_urdf_lacks_is_reported_with_the_nearest_name(make_tiny, change):
    with pytest.raises(UnknownName, match="'gripper_fingr_joint': did you mean 'gripper_finger_j"):
        RobotModel(make_tiny(gripper=change))


def test_a_body_held_by_an_unknown_frame_is_reported_with_the_nearest_name(make_tiny):
    held = Attachment("peg", "toool", (Shape("box", (0.01, 0.01, 0.01)),))
    with pytest.raises(UnknownName, match="'toool': did you mean 'tool'"):
        RobotModel(make_tiny(), (held,))


def test_a_gripper_on_an_unknown_frame_is_reported_with_the_nearest_name(make_tiny):
    with pytest.raises(UnknownName, match="'flang': did you mean 'flange'"):
        RobotModel(make_tiny(gripper={"parent_frame": "flang"}))


def test_the_gripper_is_held_at_the_opening_asked_for(make_tiny):
    spec = make_tiny()
    for command in (0.0, 0.5, 1.0):
        model = RobotModel(spec, gripper=command)
        T_base_finger = inverse(model.fk(spec.home, "gripper_base_link")) @ model.fk(
            spec.home, "gripper_finger"
        )
        np.testing.assert_allclose(T_base_finger, pose([0, 0, 0.3], [command, 0, 0]), atol=1e-9)


def test_a_model_keeps_its_spec_and_what_it_holds(make_tiny):
    spec = make_tiny()
    held = (Attachment("peg", "tool", (Shape("box", (0.01, 0.01, 0.01)),)),)
    model = RobotModel(spec, list(held), 0.25)
    assert (model.spec, model.held, model.gripper) == (spec, held, 0.25)
    assert dataclasses.is_dataclass(model.spec)
    with pytest.raises(ValueError, match="read-only"):
        model.lower[0] = 0


def test_a_frame_moves_with_the_tool_stands_still_or_neither(model):
    wrist = model.spec.cameras[0].frame
    mounts = {
        name: model.mount_of(name) for name in ("tool", wrist, "world", "base_link", "forearm_link")
    }
    assert mounts == {
        "tool": "tool", wrist: "tool", "world": "world", "base_link": "world",
        "forearm_link": None,
    }  # fmt: skip
    with pytest.raises(UnknownName, match="unknown frame 'forearm'"):
        model.mount_of("forearm")


def test_an_arm_of_seven_joints_comes_home_while_its_tool_stays():
    panda = RobotModel(get_robot("panda"))
    home = panda.spec.home
    T = panda.fk(home)
    # Turned about the line from shoulder to wrist, the tool where it was.
    away = panda.ik(T, home + [0.3, 0, -0.3, 0, 0.2, 0, 0])
    assert np.abs(away - home).max() > 0.1
    off = [float(np.abs(away - home).max())]
    q = away
    for i in range(300):
        moved = T.copy()
        moved[:3, 3] += 1e-5 * (i % 2)
        q = panda.ik(moved, q, 0.05)
        assert np.abs(panda.fk(q) - moved).max() < 2e-6
        off.append(float(np.abs(q - home).max()))
    assert off[-1] < 0.2 * off[0]


def test_an_arm_of_few_joints_goes_to_the_position_and_turns_as_far_as_it_can(make_tiny, tmp_path):
    # Yaw, then three joints in a plane: position and pitch are free, roll isn't.
    def joint(name, parent, child, axis):
        return (
            f'<joint name="{name}" type="revolute"><parent link="{parent}"/><child link="{child}"/>'
            f'<origin xyz="0 0 0.3"/><axis xyz="{axis}"/><limit lower="-3" upper="3"/></joint>'
        )

    box = '<collision><geometry><box size="0.1 0.1 0.1"/></geometry></collision>'
    links = "".join(f'<link name="{name}">{box}</link>' for name in "abcd")
    joints = [joint("yaw", "a", "b", "0 0 1"), joint("lift", "b", "c", "0 1 0")]
    joints += [joint("bend", "c", "d", "0 1 0"), joint("pitch", "d", "flange", "0 1 0")]
    (tmp_path / "arm.urdf").write_text(
        f'<robot name="few">{links}<link name="flange">{box}</link>{"".join(joints)}</robot>'
    )
    four = dict.fromkeys(("velocity_limits", "acceleration_limits", "jerk_limits"), np.ones(4))
    home = np.array([0.2, 0.5, 0.8, 0.4])
    model = RobotModel(make_tiny(arm_joints=("yaw", "lift", "bend", "pitch"), home=home, **four))
    reachable = model.fk(home + [0.3, -0.2, 0.1, 0.2])
    assert np.abs(model.fk(model.ik(reachable, home)) - reachable).max() < 1e-5
    rolled = reachable @ pose((0, 0, 0), (0.2, 0, 0.3))
    q = model.ik(rolled, home)
    reached = model.reached(rolled, q)
    assert np.abs(reached[:3, 3] - rolled[:3, 3]).max() < 2e-6
    least = angle_between(reached[:3, :3], rolled[:3, :3])
    assert 0.05 < least < 0.4
    # No motion of the joints that keeps the position turns the tool nearer.
    J = model.jacobian(q)
    still = np.linalg.svd(J[:3])[2][3:]
    for way in (*still, *-still):
        try:
            near = model.fk(model.ik(model.fk(q + 1e-3 * way), q + 1e-3 * way))
        except Unreachable:
            continue
        assert angle_between(near[:3, :3], rolled[:3, :3]) > least - 1e-5
    with pytest.raises(Unreachable, match="is out of reach"):
        model.ik(pose([9.0, 0, 0]), home)


def test_limits_of_a_joint_that_slides_are_in_metres(make_tiny, tmp_path):
    arm = tmp_path / "arm.urdf"
    arm.write_text(
        arm.read_text().replace('name="wrist" type="revolute"', 'name="wrist" type="prismatic"')
    )
    with pytest.raises(InvalidInput, match="wrist: 2.500 m is outside its limits"):
        RobotModel(make_tiny()).check_limits(np.array([0.0, 2.5]))


def test_mounted_cameras_are_where_a_pose_of_the_arm_has_them(model):
    """In the world where they stand still, with the tool where they move with it."""
    spec = model.spec
    wrist = spec.cameras[0]
    still = dataclasses.replace(wrist, name="still", frame="world")
    elbow = dataclasses.replace(wrist, name="elbow", frame="forearm_link")
    both = RobotModel(dataclasses.replace(spec, cameras=(wrist, still, elbow)))
    mounted = both.mounted_cameras()
    assert {name: frame for name, (frame, _) in mounted.items()} == {
        wrist.name: "tool",
        "still": "world",
    }
    np.testing.assert_allclose(mounted["still"][1], wrist.T_frame_camera, atol=1e-12)
    q = spec.home + 0.3
    T_world_camera = both.fk(q) @ mounted[wrist.name][1]
    expected = both.fk(q, wrist.frame) @ wrist.T_frame_camera
    np.testing.assert_allclose(T_world_camera, expected, atol=1e-9)
