"""What is drawn is where the robot and the scene are."""

import numpy as np
import pytest

from sart_toolkit.annotate.visuals import DrawnRobot, body_meshes, shape_mesh
from sart_toolkit.errors import InvalidInput
from sart_toolkit.poses import pose
from sart_toolkit.robots import get_robot
from sart_toolkit.robots.model import RobotModel
from sart_toolkit.robots.spec import Shape
from sart_toolkit.scenes.spec import Body


@pytest.mark.parametrize(
    ("shape", "half"),
    [
        (Shape("box", (0.2, 0.4, 0.6)), (0.1, 0.2, 0.3)),
        (Shape("cylinder", (0.1, 0.5)), (0.1, 0.1, 0.25)),
        (Shape("sphere", (0.3,)), (0.3, 0.3, 0.3)),
    ],
)
def test_a_shape_is_drawn_in_its_size_and_place(shape, half):
    mesh = shape_mesh(Shape(shape.kind, shape.size, pose([1, 2, 3]), (1, 0, 0, 0.5)))
    centre, size = mesh.vertices.mean(0), np.ptp(mesh.vertices, axis=0)
    np.testing.assert_allclose(centre, [1, 2, 3], atol=1e-9)
    np.testing.assert_allclose(size / 2, half, atol=1e-9)
    assert mesh.triangles.max() < len(mesh.vertices) and mesh.rgba == (1, 0, 0, 0.5)
    (drawn,) = body_meshes(Body("b", (shape,)))
    np.testing.assert_allclose(np.ptp(drawn.vertices, axis=0), size)


@pytest.fixture(scope="module")
def model(peg_task):
    return RobotModel(get_robot(peg_task.robot), peg_task.scene.held)


def test_what_the_wrist_carries_moves_with_the_tool_and_nothing_else_does(model):
    drawn = DrawnRobot(model)
    home = np.array(model.spec.home)
    turned = home.copy()
    turned[-1] += 0.5
    before, after = drawn.poses(home, 0.0), drawn.poses(turned, 0.0)
    T = model.fk(turned) @ np.linalg.inv(model.fk(home))
    for i in range(len(drawn.meshes)):
        np.testing.assert_allclose(after[i], (T if i in drawn.tool else np.eye(4)) @ before[i],
                                   atol=1e-9)  # fmt: skip
    assert 0 < len(drawn.tool) < len(drawn.meshes)


def test_the_peg_is_drawn_where_the_gripper_holds_it(model):
    drawn = DrawnRobot(model)
    home = np.array(model.spec.home)
    p_tool = model.fk(home)[:3, 3]
    Ts = drawn.poses(home, 0.5)
    ends = [
        (mesh.vertices @ T[:3, :3].T + T[:3, 3])[:, 2].min()
        for mesh, T in zip(drawn.meshes, Ts, strict=True)
    ]
    assert min(ends) < p_tool[2]
    assert len({m.rgba for m in drawn.meshes}) > 1


def test_the_fingers_close_with_the_command(model):
    drawn, home = DrawnRobot(model), np.array(model.spec.home)
    moved = np.abs(drawn.poses(home, 1.0) - drawn.poses(home, 0.0)).max((1, 2)) > 1e-3
    assert moved.any() and set(np.flatnonzero(moved)) <= set(drawn.tool)
    with pytest.raises(InvalidInput, match="gripper: expected 0"):
        drawn.poses(home, 1.5)
