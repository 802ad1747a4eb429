"""Distances: exact where geometry has an answer, proved by planes elsewhere, no pair left out."""

from __future__ import annotations

import itertools
import xml.etree.ElementTree as ET
from contextlib import closing

import coal
import hypothesis.strategies as st
import numpy as np
import pinocchio as pin
import pytest
import trimesh
from hypothesis import given, settings
from scipy.spatial import ConvexHull

from sart_toolkit.errors import InvalidInput, UnknownName
from sart_toolkit.poses import exp_rotation, inverse, pose, rpy_pose
from sart_toolkit.robots import ROBOTS, get_robot
from sart_toolkit.robots.model import RobotModel
from sart_toolkit.robots.spec import Shape
from sart_toolkit.scene.collision import CollisionModel, robot_parts
from sart_toolkit.scene.spec import Body, SceneSpec
from sart_toolkit.tasks import get_task
from sart_toolkit.tasks.task import Placement
from sart_toolkit.testing.closest import ClosestPoints

PROPERTY = settings(deadline=None, derandomize=True, max_examples=40)
RADIUS = 0.01
# coal's own, relative to 2 m.
ACCURACY = 3e-6
FAR = pose([5, 5, 5])

shifts = st.tuples(*[st.floats(-0.3, 0.3)] * 3).map(np.array)
seeds = st.integers(0, 2**32 - 1)
KINDS = ("boxes", "rods", "shelf", "mixed")
kinds = st.sampled_from(KINDS)


def joints_near(placed, rng, spread=1.5):
    model = placed.kinematics
    away = rng.uniform(-spread, spread, 6)
    return np.clip(model.spec.home + away, model.lower, model.upper)


def body_pairs(placed):
    """The pairs' indices, by the names of the two bodies."""
    found = {}
    for k in range(len(placed.pairs)):
        found.setdefault(placed.names(k), []).append(k)
    return found


def of(placed, q, body):
    """The distance of a robot's body from the scene."""
    return min(pair.distance for pair in placed.tool_clearances(q) if pair.a == body)


def poses_of_parts(placed, q):
    """Where each part is: its joint's pose and its own `(4, 4)`, both in the world."""
    joints = placed.joint_poses(q)
    return [(joints[part.joint], joints[part.joint] @ part.T_joint_part) for part in placed.parts]


def reach_along(part, T_world_part, direction):
    """How far a part reaches along a direction, by the definition of its shape."""
    R, p = T_world_part[:3, :3], T_world_part[:3, 3]
    local, geometry = R.T @ direction, part.geometry
    if isinstance(geometry, coal.ConvexBase):
        reach = (np.array(geometry.points()).reshape(-1, 3) @ local).max()
    elif isinstance(geometry, coal.Box):
        reach = np.abs(local) @ np.ravel(geometry.halfSide)
    elif isinstance(geometry, coal.Cylinder):
        reach = geometry.radius * np.hypot(*local[:2]) + geometry.halfLength * abs(local[2])
    else:
        reach = geometry.radius
    return reach + direction @ p


@pytest.fixture(scope="module")
def probed(peg_task):
    """The robot with its peg, and one small ball that a test puts somewhere."""
    scene = SceneSpec((Body("ball", (Shape("sphere", (RADIUS,)),)),), peg_task.scene.held)
    collision = CollisionModel(get_robot(peg_task.robot), scene)

    def with_ball_at(T_world_ball, gripper=0.0):
        return collision.placed({"ball": T_world_ball}, gripper)

    return with_ball_at


@pytest.fixture(scope="module")
def peg_tip(peg_model, start):
    """Centre of the peg's lower face in the world at the start."""
    return (peg_model.fk(start.state.q, "peg") @ [0, 0, 0.04, 1])[:3]


# --- analytic cases -----------------------------------------------------------------------------


def test_the_peg_starts_12_5_cm_above_the_block(start):
    nearest = start.placed.tool_clearances(start.state.q)[0]
    assert nearest.pair == ("peg", "block")
    # Over the middle of the hole: 12.5 cm down to the rim, and 1 cm from peg to wall.
    assert nearest.distance == pytest.approx(np.hypot(0.125, 0.010), abs=1e-5)


def test_the_peg_above_a_wall_of_the_block_is_12_5_cm_from_it(start, peg_task, peg_model):
    state = peg_task.initial_state(peg_model, Placement(0.04, 0.0))
    placed = start.collision.placed(state.Ts_world_body, state.gripper)
    assert of(placed, state.q, "peg") == pytest.approx(0.125, abs=1e-5)


def test_the_peg_far_from_the_block_is_nearest_to_the_table(start):
    placed = start.collision.placed({**start.state.Ts_world_body, "block": FAR}, 0.5)
    pairs = placed.tool_clearances(start.state.q)
    assert {pair.b for pair in pairs} == {"table"}
    assert of(placed, start.state.q, "peg") == pytest.approx(0.165, abs=1e-5)


@PROPERTY
@given(gap=st.floats(0.001, 1))
def test_a_ball_below_the_peg_is_as_far_as_its_gap(probed, start, peg_tip, gap):
    placed = probed(pose(peg_tip - [0, 0, gap + RADIUS]))
    assert of(placed, start.state.q, "peg") == pytest.approx(gap, abs=1e-6)


@pytest.mark.parametrize(
    ("kind", "size", "reach"),
    [("box", (0.2, 0.2, 0.3), 0.15), ("cylinder", (0.1, 0.3), 0.15), ("sphere", (0.15,), 0.15)],
)
def test_every_kind_of_shape_is_as_large_as_it_says(
    among, peg_model, start, peg_tip, kind, size, reach
):
    rod = Body("rod", (Shape("box", (0.03, 0.03, 0.08)),), mass=0.1)
    thing = Body("thing", (Shape(kind, size),), pose(peg_tip - [0, 0, 0.1 + reach]))
    placed = among(thing, rod, carried={"rod": pose([0, 0, 0.02])})
    assert of(placed, start.state.q, "rod") == pytest.approx(0.1, abs=1e-5)


@pytest.mark.parametrize("gap", [-0.0015, -1e-5, 1e-5, 0.0005, 0.03])
def test_a_rod_in_the_grasp_is_as_far_from_a_rod_as_their_axes_less_their_radii(among, gap, rng):
    carried = pose([0, 0, 0.4], [0.2, 0.1, 0])
    for _ in range(5):
        placed = among(
            Body("rod", (Shape("cylinder", (0.002, 0.4)),), mass=0.1),
            Body("wire", (Shape("cylinder", (0.003, 0.5)),)),
            carried={"rod": carried},
        )
        q = joints_near(placed, rng)
        across = pose([0, gap + 0.005, 0.1], [0, rng.uniform(0.3, 2.8), 0])
        wire = placed.kinematics.fk(q) @ carried @ across
        placed = among(*placed_bodies(placed, wire=wire), carried={"rod": carried})
        (k,) = body_pairs(placed)["rod", "wire"]
        assert placed.distances(q)[k] == pytest.approx(gap, abs=2e-6)


def placed_bodies(placed, **Ts_world_body):
    """The bodies of a scene, some of them elsewhere."""
    rod = Body("rod", (Shape("cylinder", (0.002, 0.4)),), mass=0.1)
    return rod, Body("wire", (Shape("cylinder", (0.003, 0.5)),), Ts_world_body["wire"])
