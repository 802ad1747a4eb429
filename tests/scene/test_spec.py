"""Scenes as data: names are unique, states are complete, bad values are refused."""

import numpy as np
import pytest

from sart_toolkit.errors import InvalidInput, UnknownName
from sart_toolkit.poses import pose
from sart_toolkit.robots.spec import Attachment, CameraSpec, Shape
from sart_toolkit.scene.spec import Body, SceneSpec, SceneState

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


def test_a_pose_of_a_body_that_the_scene_lacks_is_told_with_the_nearest_name():
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
