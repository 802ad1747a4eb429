"""Scenes as data: names are unique, states are complete, bad values are refused."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sart_toolkit.errors import InvalidInput, UnknownName
from sart_toolkit.poses import pose
from sart_toolkit.robots.spec import Attachment, CameraSpec, Shape
from sart_toolkit.scenes.spec import Body, Detent, Joint, Light, SceneSpec, SceneState

BOX = (Shape("box", (0.1, 0.1, 0.1)),)


def test_a_body_without_shape_is_refused():
    with pytest.raises(InvalidInput, match="body 'lid': has no shape; give it at least one"):
        Body("lid", ())


@pytest.mark.parametrize("mass", [0, -1, np.nan, np.inf])
def test_a_mass_that_is_not_positive_is_refused(mass):
    with pytest.raises(InvalidInput, match="mass of lid: expected a finite number > 0 kg"):
        Body("lid", BOX, mass=mass)


def test_a_body_at_what_is_no_pose_is_refused():
    with pytest.raises(InvalidInput, match="T_world_body of lid: not a rigid transform"):
        Body("lid", BOX, np.zeros((4, 4)))


def test_two_bodies_of_one_name_are_refused_whether_standing_or_held():
    body, held = Body("lid", BOX), Attachment("lid", "tool", BOX)
    for scene in ({"bodies": (body, body)}, {"bodies": (body,), "held": (held,)}):
        with pytest.raises(InvalidInput, match="scene: two bodies are called 'lid'; rename one"):
            SceneSpec(**scene)


def test_two_cameras_of_one_name_are_refused():
    camera = CameraSpec("overview", "world", np.eye(4))
    with pytest.raises(InvalidInput, match="scene: two cameras are called 'overview'"):
        SceneSpec((), cameras=(camera, camera))


@pytest.mark.parametrize("gravity", [np.zeros(2), np.full(3, np.nan), 9.81])
def test_gravity_that_is_no_vector_is_refused(gravity):
    with pytest.raises(InvalidInput, match="gravity: "):
        SceneSpec((), gravity=gravity)


def test_a_state_has_every_body_where_the_scene_or_the_caller_puts_it():
    bodies = (Body("lid", BOX, pose([1, 0, 0])), Body("box", BOX, pose([2, 0, 0])))
    state = SceneSpec(bodies).initial_state(np.zeros(6), 0.5, {"box": pose([3, 0, 0])})
    assert {name: T[0, 3] for name, T in state.Ts_world_body.items()} == {"lid": 1, "box": 3}
    assert (state.q.shape, state.gripper) == ((6,), 0.5)


def test_a_pose_of_a_body_that_the_scene_lacks_is_reported_with_the_nearest_name():
    scene = SceneSpec((Body("lid", BOX),))
    with pytest.raises(UnknownName, match="unknown body 'lidd': did you mean 'lid'"):
        scene.initial_state(np.zeros(6), 0.0, {"lidd": np.eye(4)})


@pytest.mark.parametrize("gripper", [-0.1, 1.1, np.nan, np.inf])
def test_a_gripper_state_beyond_its_range_is_refused(gripper):
    with pytest.raises(InvalidInput, match=r"gripper: expected 0 \(open\) to 1 \(closed\), got"):
        SceneState(np.zeros(6), gripper, {})


def test_a_state_with_bad_joints_or_poses_is_refused():
    with pytest.raises(InvalidInput, match=r"q: expected shape \('n',\)"):
        SceneState(np.zeros((2, 6)), 0.0, {})
    with pytest.raises(InvalidInput, match="q: has NaN"):
        SceneState(np.full(6, np.nan), 0.0, {})
    with pytest.raises(InvalidInput, match="lid: not a rigid transform"):
        SceneState(np.zeros(6), 0.0, {"lid": np.zeros((4, 4))})


def test_a_state_does_not_follow_the_arrays_that_it_was_made_from():
    q, T = np.zeros(6), np.eye(4)
    state = SceneState(q, 0.0, {"lid": T})
    q[:] = 1
    T[0, 3] = 1
    assert (state.q == 0).all()
    assert state.Ts_world_body["lid"][0, 3] == 0
    assert not state.q.flags.writeable
    assert not state.Ts_world_body["lid"].flags.writeable


# --- joints -------------------------------------------------------------------------------------

Z = np.array([0.0, 0.0, 1.0])


def hinge(**changes):
    values = {"parent": "box", "T_parent_body": pose([0, 0, 0.1]), "axis": Z}
    return Joint(**{**values, "lower": -1.0, "upper": 2.0, **changes})


def hinged_scene(**changes):
    lid = Body("lid", BOX, mass=0.3, joint=hinge(**changes))
    return SceneSpec((Body("box", BOX, pose([1, 0, 0], [0, 0, 0.5])), lid))


@settings(deadline=None, derandomize=True, max_examples=50)
@given(
    st.floats(-1, 2),
    st.lists(st.floats(-1, 1), min_size=3, max_size=3).filter(lambda v: np.linalg.norm(v) > 0.1),
    st.sampled_from(["revolute", "prismatic"]),
)
def test_a_joint_position_can_be_read_off_the_bodies_poses(position, axis, kind):
    axis = np.array(axis) / np.linalg.norm(axis)
    scene = hinged_scene(axis=axis, kind=kind)
    state = scene.initial_state(np.zeros(6), 0.0, joint_positions={"lid": position})
    scene.check_state(state)
    assert scene.joint_position("lid", state.Ts_world_body) == pytest.approx(position, abs=1e-7)
    moved = np.linalg.inv(state.Ts_world_body["box"]) @ state.Ts_world_body["lid"]
    if kind == "prismatic":
        np.testing.assert_allclose(moved[:3, 3], [0, 0, 0.1] + position * axis, atol=1e-12)
    else:
        # A hinge's own line stays where it is.
        np.testing.assert_allclose(moved @ [*axis, 1], pose([0, 0, 0.1]) @ [*axis, 1], atol=1e-9)


def test_a_hinge_that_turns_past_half_a_turn_is_read_in_its_own_range():
    scene = hinged_scene(lower=2.0, upper=5.0)
    for position in (2.1, 3.3, 4.9):
        state = scene.initial_state(np.zeros(6), 0.0, joint_positions={"lid": position})
        assert scene.joint_position("lid", state.Ts_world_body) == pytest.approx(position)


def test_a_body_on_a_joint_follows_the_body_that_it_moves_on():
    scene = hinged_scene()
    T = pose([0.3, 0.2, 0], [0, 0, 1.0])
    state = scene.initial_state(np.zeros(6), 0.0, {"box": T}, {"lid": 0.4})
    expected = T @ pose([0, 0, 0.1], [0, 0, 0.4])
    np.testing.assert_allclose(state.Ts_world_body["lid"], expected, atol=1e-12)


def test_a_spring_pulls_to_its_rest_and_a_catch_holds_near_and_keeps_out_far():
    spring = hinge(stiffness=2.0, rest=0.5)
    assert spring.effort(0.0) == pytest.approx(1.0)
    assert spring.effort(1.0) == pytest.approx(-1.0)
    catch = hinge(detent=Detent(0.2, 0.1, 3.0))
    assert catch.effort(0.2) == pytest.approx(0.0)
    assert catch.effort(0.225) == pytest.approx(-3.0)
    assert catch.effort(0.275) == pytest.approx(3.0)
    assert catch.effort(0.175) == pytest.approx(3.0)
    assert catch.effort(0.31) == catch.effort(0.09) == 0.0


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"kind": "ball"}, "joint kind: expected 'revolute' or 'prismatic', got 'ball'"),
        ({"axis": np.array([0, 0, 2.0])}, "joint axis: expected a unit vector"),
        ({"lower": 2.0}, "joint limits: expected lower < upper"),
        ({"upper": np.nan}, "upper: has NaN"),
        ({"friction": -0.1}, "expected friction and stiffness >= 0"),
        ({"stiffness": -0.1}, "expected friction and stiffness >= 0"),
    ],
)
def test_a_bad_joint_is_refused(changes, message):
    with pytest.raises(InvalidInput, match=message):
        hinge(**changes)


@pytest.mark.parametrize(("width", "effort"), [(0.0, 1.0), (1.0, 0.0), (np.nan, 1.0)])
def test_a_bad_catch_is_refused(width, effort):
    with pytest.raises(InvalidInput, match="of a detent: expected a finite number > 0"):
        Detent(0.0, width, effort)


def test_a_body_with_a_joint_needs_a_mass_and_a_standing_parent():
    with pytest.raises(InvalidInput, match="body 'lid': has a joint but no mass"):
        Body("lid", BOX, joint=hinge())
    lid = Body("lid", BOX, mass=0.3, joint=hinge())
    with pytest.raises(UnknownName, match="which 'lid' moves on, 'box'"):
        SceneSpec((Body("box", BOX, mass=1.0), lid))
    with pytest.raises(UnknownName, match="unknown body with a joint 'box'"):
        hinged_scene().joint_position("box", {})
    with pytest.raises(UnknownName, match="unknown body 'lid'"):
        hinged_scene().joint_position("lid", {"box": np.eye(4)})


def test_a_state_of_another_scene_or_with_a_body_off_its_joint_is_refused():
    scene = hinged_scene()
    state = scene.initial_state(np.zeros(6), 0.0)
    with pytest.raises(UnknownName, match="unknown body in the state 'lid'"):
        scene.check_state(SceneState(state.q, 0.0, {"box": np.eye(4)}))
    with pytest.raises(UnknownName, match="unknown joint in the state 'lid'"):
        scene.check_state(SceneState(state.q, 0.0, state.Ts_world_body))
    with pytest.raises(InvalidInput, match="joint of 'lid': 2.500 is outside its limits"):
        scene.check_state(scene.initial_state(state.q, 0.0, joint_positions={"lid": 2.5}))
    off = {**state.Ts_world_body, "lid": np.eye(4)}
    with pytest.raises(InvalidInput, match="isn't where its joint at 0.000 has it"):
        scene.check_state(SceneState(state.q, 0.0, off, state.joint_positions))
    with pytest.raises(UnknownName, match="unknown body with a joint 'box'"):
        scene.initial_state(state.q, 0.0, joint_positions={"box": 0.0})
    with pytest.raises(UnknownName, match="unknown body 'lid'"):
        scene.initial_state(state.q, 0.0, {"lid": np.eye(4)})


def test_the_gripper_command_is_its_place_unless_another_is_in_force():
    state = SceneState(np.zeros(6), 0.4, {})
    assert state.commanded_gripper == 0.4
    assert SceneState(np.zeros(6), 0.4, {}, gripper_target=0.6).commanded_gripper == 0.6
    with pytest.raises(InvalidInput, match="gripper: expected 0"):
        SceneState(np.zeros(6), 0.4, {}, gripper_target=1.1)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"direction": np.zeros(3)}, "direction of the light: expected a vector"),
        ({"intensity": -1.0}, "intensity of the light"),
        ({"ambient": np.nan}, "ambient of the light"),
    ],
)
def test_a_bad_light_is_refused(changes, message):
    with pytest.raises(InvalidInput, match=message):
        Light(**changes)


# --- grasps and contacts ------------------------------------------------------------------------


def test_what_two_fingers_touch_and_is_free_is_in_the_grasp():
    joint = Joint("table", np.eye(4), Z, -1.0, 1.0)
    scene = SceneSpec(
        (
            Body("table", BOX),
            Body("cup", BOX, mass=0.1),
            Body("door", BOX, mass=0.1, joint=joint),
        )
    )
    fingers = ("left", "right")
    both = [(a, b) for a in ("cup", "door", "table") for b in fingers]
    assert scene.grasped(both, fingers) == {"cup"}
    assert scene.grasped([("cup", "left"), ("cup", "left"), ("cup", "palm")], fingers) == set()
    touching = [("cup", "left"), ("cup", "table"), ("door", "forearm"), ("elbow", "wrist")]
    assert scene.outer_contacts(touching, {"cup"}) == {("cup", "table"), ("door", "forearm")}
    assert scene.outer_contacts(touching, ()) == {("cup", "left"), ("door", "forearm")}


def test_a_state_is_read_from_measured_poses_a_little_out_of_range_or_not():
    joint = Joint("box", pose([0, 0, 0.1]), np.array([0, 0, 1.0]), 0.0, 1.0, "prismatic")
    scene = SceneSpec((Body("box", BOX), Body("lid", BOX, mass=0.1, joint=joint)))
    lid = pose([1, 0, 0]) @ joint.T_parent_moved(1.0 + 1e-6)
    seen = {"box": pose([1, 0, 0]), "lid": lid, "peg": np.eye(4)}
    state = scene.seen_state(np.zeros(6), 1.0001, seen)
    scene.check_state(state)
    assert state.joint_positions == {"lid": 1.0} and state.gripper == 1.0
    np.testing.assert_allclose(state.Ts_world_body["lid"], lid, atol=1e-5)
    with pytest.raises(UnknownName, match="unknown body 'lid'"):
        scene.seen_state(np.zeros(6), 0.5, {"box": np.eye(4)})
