"""The convex parts that proofs are about are those of the robot, all of them and whole."""

from __future__ import annotations

import shutil
import xml.etree.ElementTree as ET

import coal
import numpy as np
import pytest
from scipy.spatial import ConvexHull

from sart_toolkit.collision.model import CollisionModel
from sart_toolkit.collision.obstacles import hull_part
from sart_toolkit.collision.parts import (
    ConvexPart,
    coal_geometry,
    coal_transform,
    convex_distance,
    primitive,
    robot_parts,
)
from sart_toolkit.errors import BrokenFile
from sart_toolkit.poses import pose
from sart_toolkit.robots import get_robot
from sart_toolkit.robots.enclosure import HullPart, ShapePart
from sart_toolkit.robots.model import RobotModel
from sart_toolkit.robots.spec import Shape
from sart_toolkit.robots.urdf import link_parts
from sart_toolkit.scenes.spec import SceneSpec


@pytest.fixture(scope="module", params=["ur5e_2f85", "ur5e_hande"])
def model(request):
    return RobotModel(get_robot(request.param))


def test_hulls_that_were_written_as_text_and_read_by_coal_lose_nothing(model):
    """Text rounds, and the reader builds its own hull."""
    found = {}
    for part in robot_parts(model):
        found.setdefault(part.body, []).append(part)
    frames = {frame.name: frame for frame in model.pinocchio_model.frames}
    for link in ET.parse(model.urdf).getroot().findall("link"):
        written = link_parts(link, model.urdf.parent)
        for ours, part in zip(written, found.get(link.get("name"), []), strict=True):
            T = frames[part.body].placement.homogeneous
            if isinstance(ours, ShapePart):
                assert primitive(part.geometry).kind == ours.shape.kind
                np.testing.assert_allclose(primitive(part.geometry).size, ours.shape.size)
                np.testing.assert_allclose(
                    T @ ours.shape.T_body_shape, part.T_joint_part, atol=1e-12
                )
                continue
            points = np.array(part.geometry.points()).reshape(-1, 3)
            T_part = part.T_joint_part
            read = HullPart(points @ T_part[:3, :3].T + T_part[:3, 3])
            assert read.outside(ours.points @ T[:3, :3].T + T[:3, 3]).max() < 1e-6


@pytest.mark.parametrize(
    "shape",
    [Shape("box", (0.1, 0.2, 0.3)), Shape("cylinder", (0.1, 0.3)), Shape("sphere", (0.1,))],
)
def test_the_points_sphere_and_box_of_a_part_enclose_a_primitive(shape):
    T = pose([0.1, 0.2, -0.3], [0.3, 0.2, -1])
    geometry = coal_geometry(shape)
    points = Shape(shape.kind, shape.size, T).corners()
    part = ConvexPart("b", 1, geometry, T, points)
    directions = np.random.default_rng(0).normal(size=(2000, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    for n in directions:
        local = T[:3, :3].T @ n
        reach = _support(shape, local) + n @ T[:3, 3]
        assert (points @ n).max() >= reach - 1e-12
        centre, radius = part.sphere
        assert centre @ n + radius >= reach - 1e-12
        R, middle, half = part.box
        assert middle @ n + np.abs(R.T @ n) @ half >= reach - 1e-12
        assert part.reach >= reach - 1e-12


def _support(shape, n):
    """How far a primitive at the origin reaches in a direction."""
    if shape.kind == "box":
        return float(np.abs(n) @ shape.size) / 2
    if shape.kind == "sphere":
        return shape.size[0]
    return float(shape.size[0] * np.hypot(n[0], n[1]) + abs(n[2]) * shape.size[1] / 2)


@pytest.mark.parametrize("damage", ["rpy", "left out"])
def test_a_shape_that_the_reader_drops_is_refused_by_its_link(tmp_path, damage):
    model = RobotModel(get_robot("ur5e_hande"))
    folder = tmp_path / "robot"
    shutil.copytree(model.urdf.parent, folder)
    tree = ET.parse(model.urdf)
    link = next(e for e in tree.getroot().findall("link") if e.get("name") == "gripper_rail")
    shape = link.find("collision")
    if damage == "rpy":
        shape.find("origin").set("rpy", "inf 0 0")
    else:
        shape.find("geometry").clear()
    tree.write(folder / "robot.urdf")
    model.urdf = folder / "robot.urdf"
    with pytest.raises(BrokenFile, match="gripper_rail|can't read its collision shapes"):
        robot_parts(model)


def test_the_gripper_does_not_pass_through_the_base_that_is_drawn():
    """Seen: two spheres stood for the base, 0.8 mm "free" with a finger 2.8 mm inside it."""
    collision = CollisionModel(get_robot("ur5e_2f85"), SceneSpec(()))
    q = np.array([1.5437, -1.5849, 2.6609, -1.5939, -1.6396, -0.2803])
    nearest = collision.placed({}, 0.0).nearest(q)
    assert nearest.pair == ("gripper_right_inner_finger", "base_link_inertia")
    assert nearest.distance < -0.002


@pytest.mark.parametrize("robot", ["ur5e_2f85", "ur5e_hande"])
def test_no_pair_of_links_goes_unchecked_for_the_size_of_its_parts(robot):
    """What overlaps at home is not checked, so parts must not be grown that far."""
    collision = CollisionModel(get_robot(robot), SceneSpec(()))
    placed = collision.placed({}, 0.0)
    checked = {placed.names(i) for i in range(len(placed.pairs))}
    assert checked == {
        (a.body, b.body) for a in placed.parts for b in placed.parts if a.joint - b.joint >= 2
    }


def test_a_hull_of_which_too_much_is_flat_is_enclosed_all_the_same():
    angles = np.linspace(0, 2 * np.pi, 900, endpoint=False)
    # A disc whose rim is all in one plane, and a tip that each of its corners meets.
    rim = np.stack([0.05 * np.cos(angles), 0.05 * np.sin(angles), np.zeros(900)], axis=1)
    points = np.concatenate([rim, [[0, 0, 0.1]]])
    part = hull_part("disc", 1, points)
    hull = ConvexHull(part.points)
    assert (points @ hull.equations[:, :3].T + hull.equations[:, 3]).max() < 1e-9
    assert hull.volume < 2 * ConvexHull(points).volume
    # coal computes with it.
    ball, far = coal.Sphere(0.01), pose([0.2, 0, 0])
    found = convex_distance(part.geometry, coal_transform(np.eye(4)), ball, coal_transform(far))
    assert 0.12 < found < 0.14 + 1e-9
