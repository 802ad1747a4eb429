"""The scene at each waypoint: bodies where they were seen, what is grasped at the tool."""

import dataclasses

import numpy as np
import pytest

from sart_toolkit.collision.exact import ExactWorld
from sart_toolkit.collision.phases import HELD_PLAY, IN_GRASP_SLIP
from sart_toolkit.errors import InvalidInput, Mismatch
from sart_toolkit.poses import inverse
from sart_toolkit.robots import get_robot
from sart_toolkit.robots.spec import Shape
from sart_toolkit.scenes.spec import Body
from sart_toolkit.tasks import get_task

# --- where bodies are ---------------------------------------------------------------------------


@pytest.mark.parametrize("when", ["before the grasp", "in the grasp", "at the end"])
def test_all_bodies_are_where_they_were_seen(picked, when, first_grasp):
    demo, grasped = picked.demonstration, first_grasp
    t = {"before the grasp": 5, "in the grasp": grasped + 3, "at the end": len(demo) - 1}[when]
    placed = picked.placed(t)
    joints = placed.joint_poses(demo.steps.joint_positions[t])
    seen = set()
    for part in placed.parts:
        if part.body in demo.body_Ts_world:
            T = demo.body_Ts_world[part.body][t]
            local = part.points @ joints[part.joint][:3, :3].T + joints[part.joint][:3, 3]
            local = (local - T[:3, 3]) @ T[:3, :3]
            shapes = next(b.shapes for b in picked.collision.scene.bodies if b.name == part.body)
            corners = [shape.corners() for shape in shapes if shape.collides]
            assert min(np.abs(local - c).max() for c in corners if c.shape == local.shape) < 1e-5
            seen.add(part.body)
    assert seen == {"table", "toolbox"}


def test_what_is_grasped_moves_with_the_tool_and_is_no_obstacle(picked, rng, first_grasp):
    t = first_grasp + 10
    placed, steps = picked.placed(t), picked.demonstration.steps
    grasped_parts = [part for part in placed.parts if part.body == "toolbox"]
    assert {part.joint for part in grasped_parts} == {6}
    assert "toolbox" not in {placed.names(k)[1] for k in range(len(placed.pairs))}
    assert ("toolbox", "table") in {placed.names(k) for k in range(len(placed.pairs))}
    T_tool_box = inverse(steps.measured_Ts_world_tool[t])
    T_tool_box = T_tool_box @ picked.demonstration.body_Ts_world["toolbox"][t]
    q = placed.kinematics.spec.home + rng.uniform(-0.5, 0.5, 6)
    lowest = np.inf
    T = placed.kinematics.fk(q) @ T_tool_box
    (box,) = [b for b in picked.collision.scene.bodies if b.name == "toolbox"]
    for shape in box.shapes:
        if shape.collides:
            lowest = min(lowest, (shape.corners() @ T[:3, :3].T + T[:3, 3])[:, 2].min())
    distances = placed.distances(q)
    found = [d for k, d in enumerate(distances) if placed.names(k) == ("toolbox", "table")]
    # A prism about a cylinder may reach a little lower, and it may move in the grasp.
    assert lowest - 1e-5 <= min(found) + picked.slip_tolerance <= lowest + 5e-3


def test_what_is_not_grasped_stands_and_is_an_obstacle(picked, first_grasp):
    placed = picked.placed(first_grasp - 3)
    assert {part.joint for part in placed.parts if part.body == "toolbox"} == {0}
    assert "toolbox" in {placed.names(k)[1] for k in placed.tool_pairs()}


def test_fingers_at_rest_are_as_far_open_as_they_were_measured_and_hardly_farther(picked):
    steps, spec = picked.demonstration.steps, picked.collision.robot
    placed = picked.placed(0)
    assert steps.measured_gripper[0] == pytest.approx(steps.commanded_gripper[0], abs=0.001)
    bare = picked.collision.placed(*picked.at(0))
    for link in spec.gripper.finger_links:
        swept, measured = (
            np.concatenate([p.points for p in which.parts if p.body == link])
            for which in (placed, bare)
        )
        for side in (np.min, np.max):
            out = np.abs(side(swept, axis=0) - side(measured, axis=0))
            assert out.max() < 0.0005
    assert (placed.slip < 2e-5).all()


def test_a_demonstration_did_not_go_through_anything(picked, peg_world):
    for scene in (picked, peg_world):
        steps = scene.demonstration.steps
        for t in range(0, len(scene.demonstration), 5):
            placed = scene.collision.placed(*scene.at(t))
            distances = placed.distances(steps.joint_positions[t])
            # Contacts of the simulation give way by a millimetre or two.
            assert distances.min() > -2e-3


def test_what_is_carried_may_move_in_the_grasp_by_its_play(picked, toolbox, first_grasp):
    t = first_grasp + 10
    assert picked.slip_tolerance == IN_GRASP_SLIP == 0.005
    tight = ExactWorld(
        picked.demonstration, get_robot(toolbox.robot), toolbox.scene, slip_tolerance=0.0
    )
    for scene, slip in ((picked, 0.005), (tight, 0.0)):
        placed = scene.placed(t)
        of_grasped = np.array([placed.names(k)[0] == "toolbox" for k in range(len(placed.pairs))])
        first = [placed.names(k)[0] for k in range(len(placed.pairs))]
        of_fingers = np.array(["finger" in name or "knuckle" in name for name in first])
        expected = slip * of_grasped + HELD_PLAY * of_fingers
        np.testing.assert_allclose(placed.slip, expected, atol=2.1e-5)
        assert scene.placed(3).slip.max() < 2.1e-5


def test_a_scene_is_put_together_once_for_each_waypoint(picked):
    assert picked.placed(7) is picked.placed(7)
    assert picked.placed(7) is not picked.placed(8)


def test_a_door_is_where_it_was_at_each_waypoint(recorded):
    task = get_task("door_opening")
    demo = recorded(task.name)
    scene = ExactWorld(demo, get_robot(task.robot), task.scene)
    for t in (0, len(demo) - 1):
        parts = [part for part in scene.placed(t).parts if part.body == "door"]
        assert {part.joint for part in parts} == {0}
        shapes = [s for s in task.scene.jointed["door"].shapes if s.collides]
        T = demo.body_Ts_world["door"][t]
        for part, shape in zip(parts, shapes, strict=True):
            expected = shape.corners() @ T[:3, :3].T + T[:3, 3]
            np.testing.assert_allclose(part.points, expected, atol=1e-9)
    start, end = (demo.body_Ts_world["door"][t] for t in (0, -1))
    assert np.abs(start - end).max() > 0.1


# --- errors -------------------------------------------------------------------------------------


def test_a_demonstration_that_does_not_tell_where_a_body_was_is_refused(picked, toolbox):
    demo = picked.demonstration
    Ts = {name: T for name, T in demo.body_Ts_world.items() if name != "toolbox"}
    blind = dataclasses.replace(demo, body_Ts_world=Ts)
    with pytest.raises(
        Mismatch, match="doesn't tell where 'toolbox' was, so nothing can be proved"
    ):
        ExactWorld(blind, get_robot(toolbox.robot), toolbox.scene)


def test_a_scene_of_which_a_body_does_not_collide_is_refused(picked, toolbox):
    demo = picked.demonstration
    ghost = Body("ghost", (Shape("sphere", (0.1,), collides=False),))
    scene = dataclasses.replace(toolbox.scene, bodies=(*toolbox.scene.bodies, ghost))
    Ts = {**demo.body_Ts_world, "ghost": np.tile(np.eye(4), (len(demo), 1, 1))}
    changed = dataclasses.replace(demo, body_Ts_world=Ts)
    with pytest.raises(InvalidInput, match="body 'ghost': no shape of it collides"):
        ExactWorld(changed, get_robot(toolbox.robot), scene)
