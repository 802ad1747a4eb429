"""What is drawn is where the robot and the scene are."""

import numpy as np
import pytest

from sart_toolkit.errors import InvalidInput
from sart_toolkit.poses import pose
from sart_toolkit.robots import get_robot
from sart_toolkit.robots.model import RobotModel
from sart_toolkit.robots.spec import Shape
from sart_toolkit.robots.visuals import RobotVisuals, body_meshes


@pytest.mark.parametrize(
    ("shape", "half"),
    [
        (Shape("box", (0.2, 0.4, 0.6)), (0.1, 0.2, 0.3)),
        (Shape("cylinder", (0.1, 0.5)), (0.1, 0.1, 0.25)),
        (Shape("sphere", (0.3,)), (0.3, 0.3, 0.3)),
    ],
)
def test_a_shape_is_drawn_in_its_size_and_place(shape, half):
    mesh = body_meshes([Shape(shape.kind, shape.size, pose([1, 2, 3]), (1, 0, 0, 0.5))])[0]
    centre, size = mesh.vertices.mean(0), np.ptp(mesh.vertices, axis=0)
    np.testing.assert_allclose(centre, [1, 2, 3], atol=1e-9)
    np.testing.assert_allclose(size / 2, half, atol=1e-9)
    assert mesh.triangles.max() < len(mesh.vertices) and mesh.rgba == (1, 0, 0, 0.5)
    outwards = ((mesh.vertices - [1, 2, 3]) * mesh.normals).sum(axis=1)
    assert (outwards > 0).all()
    np.testing.assert_allclose(np.linalg.norm(mesh.normals, axis=1), 1.0, atol=1e-9)


@pytest.fixture(scope="module")
def model(peg_task):
    return RobotModel(get_robot(peg_task.robot), peg_task.scene.held)


def test_round_sides_are_smooth_and_edges_are_sharp():
    mesh = body_meshes([Shape("cylinder", (0.1, 0.5))])[0]
    cap = np.abs(mesh.normals[:, 2]) > 0.5
    np.testing.assert_allclose(np.abs(mesh.normals[cap, 2]), 1.0, atol=1e-9)
    side = mesh.normals[~cap]
    np.testing.assert_allclose(side[:, :2], mesh.vertices[~cap, :2] / 0.1, atol=0.01)


def test_what_the_wrist_carries_moves_with_the_tool_and_nothing_else_does(model):
    drawn = RobotVisuals(model)
    home = np.array(model.spec.home)
    turned = home.copy()
    turned[-1] += 0.5
    before, after = drawn.poses_at(home, 0.0), drawn.poses_at(turned, 0.0)
    T = model.fk(turned) @ np.linalg.inv(model.fk(home))
    for name in drawn.bodies:
        moved = T if name in drawn.tool else np.eye(4)
        np.testing.assert_allclose(after[name], moved @ before[name], atol=1e-9)
    assert 0 < len(drawn.tool) < len(drawn.bodies)


def test_a_frame_is_where_the_joint_that_moves_it_has_it(model):
    drawn, home = RobotVisuals(model), np.array(model.spec.home)
    for frame in (model.spec.tool_frame, "wrist_camera", "peg", "base_link"):
        joint, T_joint_frame = drawn.mount(frame)
        T = drawn.poses_at(home, 0.0)[joint] @ T_joint_frame
        np.testing.assert_allclose(T, model.fk(home, frame), atol=1e-9)
    assert drawn.mount("world")[0] == drawn.mount("base_link")[0] == "universe"


def test_the_peg_is_drawn_where_the_gripper_holds_it(model):
    drawn = RobotVisuals(model)
    home = np.array(model.spec.home)
    p_tool = model.fk(home)[:3, 3]
    Ts = drawn.poses_at(home, 0.5)
    meshes = [(mesh, Ts[name]) for name, ms in drawn.bodies.items() for mesh in ms]
    ends = [(mesh.vertices @ T[:3, :3].T + T[:3, 3])[:, 2].min() for mesh, T in meshes]
    assert min(ends) < p_tool[2]
    assert len({mesh.rgba for mesh, _ in meshes}) > 1


def test_the_fingers_close_with_the_command(model):
    drawn, home = RobotVisuals(model), np.array(model.spec.home)
    opened, closed = drawn.poses_at(home, 0.0), drawn.poses_at(home, 1.0)
    moved = {name for name in opened if np.abs(closed[name] - opened[name]).max() > 1e-3}
    assert moved and moved <= set(drawn.tool)
    with pytest.raises(InvalidInput, match="gripper: expected 0"):
        drawn.poses_at(home, 1.5)
