"""PyBullet's closest points: exact for shapes, as coal has them for the robot, no pair left out."""

from __future__ import annotations

import ast
import dataclasses
from contextlib import closing
from pathlib import Path

import coal
import numpy as np
import pinocchio as pin
import pytest

from sart_toolkit.collision.parts import coal_transform, convex_distance, robot_parts
from sart_toolkit.errors import InvalidInput, UnknownName
from sart_toolkit.poses import exp_rotation, inverse, pose
from sart_toolkit.robots import get_robot
from sart_toolkit.robots.model import RobotModel
from sart_toolkit.robots.spec import Shape
from sart_toolkit.scenes.spec import Body, Joint, SceneSpec
from sart_toolkit.testing import closest, clutter
from sart_toolkit.testing.closest import ClosestPoints, cover_spheres
from sart_toolkit.testing.clutter import CLUTTER

# What the module's docstring claims [m].
SHAPE_ACCURACY = 1e-6
MESH_TOO_FAR, MESH_TOO_NEAR = 6e-5, 5e-6

BALL = 0.02


def random_pose(rng, reach):
    T = pose(rng.uniform(-reach, reach, 3))
    axis = rng.normal(size=3)
    T[:3, :3] = exp_rotation(rng.uniform(0, np.pi) * axis / np.linalg.norm(axis))
    return T


def joints_near(model, rng, spread=1.2):
    return np.clip(model.spec.home + rng.uniform(-spread, spread, 6), model.lower, model.upper)


@pytest.fixture(scope="module")
def solids(peg_model):
    """A ball, a box, two cylinders and two thin rods, to be placed anywhere."""
    shapes = {
        "ball": Shape("sphere", (BALL,)),
        "box": Shape("box", (0.06, 0.11, 0.04)),
        "can": Shape("cylinder", (0.03, 0.1)),
        "tin": Shape("cylinder", (0.05, 0.02)),
        "rod": Shape("cylinder", (0.002, 0.4)),
        "wire": Shape("cylinder", (0.003, 0.5)),
        "cube": Shape("box", (0.05, 0.05, 0.05)),
    }
    scene = SceneSpec(tuple(Body(name, (shape,)) for name, shape in shapes.items()))
    with closing(ClosestPoints(peg_model.spec, scene)) as points:
        yield points


@pytest.fixture(scope="module")
def peg(peg_task, peg_model):
    """The peg-in-hole scene, the gripper as in `peg_model`."""
    with closing(ClosestPoints(peg_model.spec, peg_task.scene)) as points:
        yield points


@pytest.fixture(scope="module")
def probed(peg_task, peg_model):
    """The robot with its peg, and one small ball."""
    scene = SceneSpec((Body("ball", (Shape("sphere", (BALL,)),)),), peg_task.scene.held)
    with closing(ClosestPoints(peg_model.spec, scene)) as points:
        yield points


def place(points, gripper=0.0, grasped=None, **Ts_world_body):
    """Put bodies somewhere, those not given far away."""
    far = {b.name: pose([5.0 + i, 5, 5]) for i, b in enumerate(points.scene.bodies)}
    points.place({**far, **Ts_world_body}, gripper, grasped or {})


# --- exact distances ----------------------------------------------------------------------------


def exact_from_ball(kind, size, p):
    """Signed distance of the ball at `p` in the other shape's frame."""
    if kind == "box":
        outside = np.abs(p) - np.array(size) / 2
    else:
        outside = np.array([np.hypot(p[0], p[1]) - size[0], abs(p[2]) - size[1] / 2])
    return np.linalg.norm(np.maximum(outside, 0)) + min(outside.max(), 0) - BALL


@pytest.mark.parametrize("name", ["box", "cube", "can", "tin", "rod"])
def test_a_ball_is_as_far_from_any_shape_as_geometry_says(solids, name, rng):
    q = solids.robot.home
    (shape,) = next(body.shapes for body in solids.scene.bodies if body.name == name)
    overlaps = 0
    for _ in range(80):
        T, T_ball = random_pose(rng, 0.5), random_pose(rng, 0.07)
        place(solids, **{name: T, "ball": T @ T_ball})
        exact = exact_from_ball(shape.kind, shape.size, T_ball[:3, 3])
        found = solids.pair(q, "ball", name)
        # How deep a round shape is inside is found less well, and said nothing of.
        tolerance = SHAPE_ACCURACY if exact > 0 or shape.kind == "box" else 1e-5
        assert found == pytest.approx(exact, abs=tolerance)
        overlaps += exact < 0
    assert 3 < overlaps < 77


@pytest.mark.parametrize("gap", [-0.0015, -1e-5, 1e-5, 0.0005, 0.03])
def test_crossing_rods_are_as_far_apart_as_their_axes_less_their_radii(solids, gap, rng):
    for _ in range(20):
        T = random_pose(rng, 0.5)
        angle = rng.uniform(0.3, np.pi - 0.3)
        across = pose([0, 0.05, 0], [0, angle, 0]) @ pose([0, gap + 0.005 - 0.05, 0])
        place(solids, rod=T, wire=T @ across)
        found = solids.pair(solids.robot.home, "rod", "wire")
        assert found == pytest.approx(gap, abs=SHAPE_ACCURACY)


@pytest.mark.parametrize("gap", [-0.01, -1e-5, 1e-5, 0.001, 0.2])
def test_boxes_are_exact_at_faces_edges_and_corners(solids, gap):
    q = solids.robot.home
    place(solids, box=np.eye(4), cube=pose([0.055 + gap, 0.01, 0.01]))
    assert solids.pair(q, "box", "cube") == pytest.approx(gap, abs=SHAPE_ACCURACY)
    if gap > 0:
        place(solids, box=np.eye(4), cube=pose([0.055 + gap, 0.08 + gap, 0.01]))
        assert solids.pair(q, "box", "cube") == pytest.approx(np.sqrt(2) * gap, abs=SHAPE_ACCURACY)
        place(solids, box=np.eye(4), cube=pose(np.array([0.055, 0.08, 0.045]) + gap))
        assert solids.pair(q, "box", "cube") == pytest.approx(np.sqrt(3) * gap, abs=SHAPE_ACCURACY)


def test_a_ball_below_the_peg_is_as_far_as_its_gap_wherever_pinocchio_has_the_peg(
    probed, peg_model, rng
):
    for _ in range(40):
        q, gap = joints_near(peg_model, rng), rng.uniform(0.001, 0.3)
        place(probed, ball=peg_model.fk(q, "peg") @ pose([0, 0, 0.04 + gap + BALL]))
        assert probed.pair(q, "peg", "ball") == pytest.approx(gap, abs=SHAPE_ACCURACY)


# --- beside coal --------------------------------------------------------------------------------


class ByCoal:
    """Distances of the same pairs by coal and Pinocchio."""

    def __init__(self, model, scene):
        self.model = model.pinocchio_model
        self.data = self.model.createData()
        self.parts = robot_parts(model)
        make = {"box": coal.Box, "sphere": coal.Sphere, "cylinder": coal.Cylinder}
        self.shapes = [
            (body.name, make[s.kind](*s.size), coal_transform(body.T_world_body @ s.T_body_shape))
            for body in scene.bodies
            for s in body.shapes
            if s.collides
        ]

    def distances(self, q):
        """By the pair's names."""
        pin.forwardKinematics(self.model, self.data, q)
        placed = [
            (part, coal_transform(self.data.oMi[part.joint].homogeneous @ part.T_joint_part))
            for part in self.parts
        ]
        found = {}
        for part, T in placed:
            others = self.shapes if part.joint > 0 else []
            others = others + [
                (other.body, other.geometry, T_other)
                for other, T_other in placed
                if part.joint - other.joint >= 3
            ]
            for name, geometry, T_other in others:
                distance = convex_distance(part.geometry, T, geometry, T_other)
                pair = part.body, name
                found[pair] = min(distance, found.get(pair, np.inf))
        return found


@pytest.mark.parametrize("robot", ["ur5e_2f85", "ur5e_hande"])
def test_the_nearest_pair_is_the_one_that_coal_finds_and_as_far(robot, peg_task, rng):
    spec = get_robot(robot)
    # The peg-in-hole scene's block stands clear of the base.
    scene = dataclasses.replace(peg_task.scene, bodies=_at_half_a_metre(peg_task.scene.bodies))
    gripper = 0.4
    model = RobotModel(spec, scene.held, gripper)
    by_coal = ByCoal(model, scene)
    with closing(ClosestPoints(spec, scene)) as points:
        points.place({body.name: body.T_world_body for body in scene.bodies}, gripper)
        overlaps = 0
        for i in range(120):
            q = joints_near(model, rng, 0.6 + i % 3)
            all_by_coal = by_coal.distances(q)
            distance = min(all_by_coal.values())
            found = points.nearest(q, 5.0)
            assert (found.distance < 0) == (distance < 0)
            assert points.collides(q) == (distance < 0)
            if distance > 0:
                assert -MESH_TOO_NEAR < found.distance - distance < MESH_TOO_FAR
                # Another pair only where it is as near.
                assert all_by_coal[found.a, found.b] < distance + MESH_TOO_FAR
            overlaps += distance < 0
        assert 20 < overlaps < 100


def _at_half_a_metre(bodies):
    return tuple(
        dataclasses.replace(b, T_world_body=pose([0.5, 0, 0])) if b.name == "block" else b
        for b in bodies
    )


def test_every_pair_is_as_far_as_coal_has_it(peg_task, peg_model, rng):
    scene = dataclasses.replace(CLUTTER["mixed"](rng), held=peg_task.scene.held)
    by_coal = ByCoal(peg_model, scene)
    with closing(ClosestPoints(peg_model.spec, scene)) as points:
        errors = []
        for _ in range(25):
            q = joints_near(peg_model, rng)
            for (a, b), distance in by_coal.distances(q).items():
                found = points.pair(q, a, b)
                assert np.sign(found) == np.sign(distance), (a, b)
                errors.append(found - distance)
    assert len(errors) > 8000
    assert min(errors) > -MESH_TOO_NEAR
    assert max(errors) < MESH_TOO_FAR
    assert np.median(np.abs(errors)) < 1e-5


@pytest.mark.parametrize("module", [closest, clutter], ids=["closest", "clutter"])
def test_no_distance_comes_from_coal(module):
    tree = ast.parse(Path(module.__file__).read_text())
    imported = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            imported |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            imported |= {f"{node.module}.{alias.name}" for alias in node.names}
    words = ("coal", "pinocchio", "clearance", "collision", "certificate")
    from_coal = {name for name in imported if any(word in name.split(".") for word in words)}
    assert from_coal == set()


# --- which pairs, and that none is lost ---------------------------------------------------------


@pytest.mark.parametrize("kind", ["rods", "shelf"])
def test_no_nearer_pair_is_left_out_than_the_one_found(kind, peg_task, peg_model, rng):
    scene = dataclasses.replace(CLUTTER[kind](rng), held=peg_task.scene.held)
    with closing(ClosestPoints(peg_model.spec, scene)) as points:
        for _ in range(6):
            q = joints_near(peg_model, rng, 0.8)
            every = {(a.name, b.name) for a, b in points._bounds.pairs}
            distances = {pair: points.pair(q, *pair) for pair in every}
            pair, smallest = min(distances.items(), key=lambda item: item[1])
            assert points.nearest(q, 2.0) == (*pair, smallest)
            assert points.collides(q) == (smallest < 0)
            assert points.nearest(q, smallest - 1e-9) == ("", "", np.inf)


def test_pairs_are_links_that_move_with_bodies_and_links_three_joints_apart(peg):
    pairs = {(a.name, b.name) for a, b in peg._bounds.pairs}
    standing = {"table", "block"}
    assert {a for a, b in pairs if b in standing} == {
        link
        for link in {part.name for part in peg._parts}
        if not link.startswith("base_link")
    }  # fmt: skip
    own = {pair for pair in pairs if pair[1] not in standing}
    assert {b for a, b in own if a == "peg"} == {
        "base_link_inertia",
        "shoulder_link",
        "upper_arm_link",
        "forearm_link",
    }
    assert {b for a, b in own if a == "forearm_link"} == {"base_link_inertia"}
    assert not any(a == "upper_arm_link" for a, b in own)


def test_a_folded_arm_collides_with_itself_and_one_at_home_does_not(probed, peg_model):
    place(probed)
    assert not probed.collides(peg_model.spec.home)
    q = np.array(peg_model.spec.home)
    found = []
    for q[3] in np.linspace(-3, 3, 25):
        found.append(probed.nearest(q))
    deepest = min(found, key=lambda pair: pair.distance)
    assert deepest.distance < 0
    assert deepest.b in {"forearm_link", "upper_arm_link"}


def test_a_scene_without_bodies_leaves_the_robot_alone(peg_model):
    with closing(ClosestPoints(peg_model.spec, SceneSpec(()))) as points:
        a, b, distance = points.nearest(peg_model.spec.home, 1.0)
        assert b in {"forearm_link", "upper_arm_link", "shoulder_link"}
        assert 0 < distance < 0.2


def test_a_shape_that_does_not_collide_is_not_near(peg_model):
    ghost = Shape("sphere", (0.3,), collides=False)
    scene = SceneSpec((Body("ghost", (ghost,), peg_model.fk(peg_model.spec.home)),))
    with closing(ClosestPoints(peg_model.spec, scene)) as points:
        assert not points.collides(peg_model.spec.home)
        with pytest.raises(UnknownName, match="unknown link or body 'ghost'"):
            points.pair(peg_model.spec.home, "forearm_link", "ghost")


def test_pairs_that_may_touch_are_ignored(peg_task, peg_model):
    home = peg_model.spec.home
    tip = peg_model.fk(home, "peg")
    Ts = {"table": pose([0, 0, -1]), "block": tip @ pose([0.03, 0, 0.02])}
    with closing(ClosestPoints(peg_model.spec, peg_task.scene)) as points:
        points.place(Ts, 0.0)
        assert points.nearest(home)[:2] == ("peg", "block")
        assert points.collides(home)
        for pair in (("peg", "block"), ("block", "peg")):
            points.place(Ts, 0.0, allowed=[pair])
            assert not points.collides(home)
            a, b, distance = points.nearest(home)
            assert (a, b) != ("peg", "block")
            assert distance > 0
        q = np.array(home)
        q[2:4] = 2.6, -3.0
        points.place(Ts, 0.0)
        a, b, distance = points.nearest(q)
        assert distance < 0
        points.place(Ts, 0.0, allowed=[(a, b)])
        assert points.nearest(q)[:2] != (a, b)


def test_links_may_be_compared_from_fewer_joints_apart(peg_model):
    with closing(ClosestPoints(peg_model.spec, SceneSpec(()), joints_apart=2)) as points:
        pairs = {(a.name, b.name) for a, b in points._bounds.pairs}
    assert ("wrist_3_link", "wrist_1_link") in pairs
    assert ("wrist_3_link", "wrist_2_link") not in pairs


# --- paths --------------------------------------------------------------------------------------


def descent(peg_model):
    """From above the block, beside the hole, down into the block."""
    start = peg_model.spec.home
    over = peg_model.fk(start)
    over[:3, 3] = [0.5, 0.04, 0.2]
    q = peg_model.ik(over, start)
    low = over.copy()
    low[2, 3] = 0.09
    return np.linspace(q, peg_model.ik(low, q), 70)


def test_along_a_path_the_nearest_is_the_smallest_of_all_and_the_first_collision_the_first(
    peg, peg_model
):
    place(peg, table=np.eye(4), block=pose([0.5, 0, 0]))
    qs = descent(peg_model)
    each = [peg.nearest(q, 0.3) for q in qs]
    distances = [nearest.distance for nearest in each]
    collides = [peg.collides(q) for q in qs]
    assert collides == [distance < 0 for distance in distances]
    assert 3 < sum(collides) < 60
    index, nearest = peg.nearest_along(qs, 0.3)
    assert (index, nearest) == (int(np.argmin(distances)), min(each, key=lambda n: n.distance))
    assert peg.first_collision(qs) == collides.index(True)
    free = qs[: collides.index(True)]
    assert peg.first_collision(free) is None
    index, nearest = peg.nearest_along(free, 0.3)
    assert nearest.distance == min(distances[: len(free)]) > 0
    assert index == int(np.argmin(distances[: len(free)]))
    assert nearest[:2] == ("peg", "block")


def test_where_nothing_is_within_reach_no_pair_is_named(peg, peg_model):
    place(peg, table=np.eye(4), block=pose([0.5, 0, 0]))
    home = peg_model.spec.home
    assert peg.nearest(home, 0.01) == ("", "", np.inf)
    assert peg.nearest_along(np.stack([home, home]), 0.01) == (-1, ("", "", np.inf))
    assert peg.nearest_along(np.zeros((0, 6))) == (-1, ("", "", np.inf))
    assert peg.first_collision(np.zeros((0, 6))) is None
    assert peg.pair(home, "peg", "block", within=0.01) == np.inf


# --- what place does ----------------------------------------------------------------------------


def test_a_grasped_body_follows_the_tool_and_touches_only_what_stands(solids, peg_model, rng):
    T_tool_box = pose([0, 0, 0.1], [0.3, 0, 0])
    model = RobotModel(solids.robot)
    for _ in range(10):
        q = joints_near(model, rng, 0.3)
        gap = rng.uniform(0.001, 0.05)
        T_box = model.fk(q) @ T_tool_box
        # Below the box's lower face.
        place(solids, grasped={"box": T_tool_box}, ball=T_box @ pose([0, 0, 0.02 + gap + BALL]))
        assert solids.pair(q, "box", "ball") == pytest.approx(gap, abs=SHAPE_ACCURACY)
        a, b, distance = solids.nearest(q)
        assert (a, b) == ("box", "ball")
        assert distance == pytest.approx(gap, abs=SHAPE_ACCURACY)
    # In the gripper's body it touches nothing while grasped; standing there it does.
    place(solids, grasped={"box": pose([0, 0, -0.1])})
    assert solids.pair(q, "box", "gripper_base_link_inertia") < 0
    assert not solids.collides(q)
    place(solids, box=model.fk(q) @ pose([0, 0, -0.1]))
    assert solids.pair(q, "box", "gripper_base_link_inertia") < 0
    assert solids.collides(q)
    assert not solids.collides(q + [1, 0, 0, 0, 0, 0])


def test_a_grasped_body_may_hit_the_arm_that_carries_it(solids):
    model = RobotModel(solids.robot)
    home = model.spec.home
    place(solids)
    assert not solids.collides(home)
    T_tool_forearm = inverse(model.fk(home)) @ model.fk(home, "forearm_link")
    place(solids, grasped={"cube": T_tool_forearm @ pose([-0.2, 0, 0])})
    assert solids.nearest(home)[:2] == ("cube", "forearm_link")
    assert solids.collides(home)


def test_the_fingers_are_as_far_apart_as_the_gripper_is_open(solids):
    pads = "gripper_left_inner_finger_pad", "gripper_right_inner_finger_pad"
    distances = []
    for gripper in np.linspace(0, 0.9, 7):
        place(solids, gripper)
        distances.append(solids.pair(solids.robot.home, *pads))
    # A Robotiq 2F-85 opens by 85 mm.
    assert distances[0] == pytest.approx(0.085, abs=0.002)
    assert (np.diff(distances) < -0.005).all()
    place(solids, 0.0)
    assert solids.pair(solids.robot.home, *pads) == distances[0]


def test_bodies_stand_where_the_scene_has_them_until_placed_and_jointed_ones_on_their_parents(
    peg_model,
):
    joint = Joint("post", pose([0, 0, 0.3]), np.array([1.0, 0, 0]), 0, 0.1, "prismatic")
    slider = Body("slider", (Shape("sphere", (0.01,)),), mass=0.1, joint=joint)
    post = Body("post", (Shape("box", (0.02, 0.02, 0.1)),), pose([0.4, 0.4, 0.05]))
    scene = SceneSpec((post, slider))
    with closing(ClosestPoints(peg_model.spec, scene)) as points:
        home = peg_model.spec.home
        assert points.pair(home, "post", "slider") == pytest.approx(0.24, abs=1e-9)
        state = scene.initial_state(home, 0.0, joint_positions={"slider": 0.1})
        points.place(state.Ts_world_body, 0.0)
        assert points.pair(home, "post", "slider") == pytest.approx(
            np.hypot(0.25, 0.09) - 0.01, abs=1e-6
        )


def test_the_same_question_has_the_same_answer_whatever_was_asked_before(peg, peg_model, rng):
    place(peg, table=np.eye(4), block=pose([0.5, 0, 0]))
    qs = [joints_near(peg_model, rng) for _ in range(20)]
    forwards = [peg.nearest(q, 0.5) for q in qs]
    backwards = [peg.nearest(q, 0.5) for q in reversed(qs)]
    assert forwards == backwards[::-1]


# --- the bounds ---------------------------------------------------------------------------------


def test_covering_spheres_leave_no_point_of_a_hull_outside(rng):
    for size in ([1, 1, 1], [6, 1, 1], [0.2, 3, 1], [9, 9, 0.01]):
        points = rng.normal(size=(40, 3)) * size
        spheres = cover_spheres(points, 0.1)
        inside = rng.dirichlet(np.full(40, 0.2), 2000) @ points
        directions = rng.normal(size=(2000, 3))
        grown = inside + 0.1 * directions / np.linalg.norm(directions, axis=1)[:, None]
        for p in (points, inside, grown):
            outside = np.linalg.norm(p[:, None] - spheres[:, :3], axis=2) - spheres[:, 3]
            assert (outside.min(1) < 1e-9).all()
    assert len(cover_spheres(rng.normal(size=(40, 3)) * [6, 1, 1])) > 1


def test_bounds_are_below_every_distance(peg_task, peg_model, rng):
    scene = dataclasses.replace(CLUTTER["mixed"](rng), held=peg_task.scene.held)
    with closing(ClosestPoints(peg_model.spec, scene)) as points:
        qs = np.stack([joints_near(peg_model, rng) for _ in range(3)])
        ((_, bounds),) = points._chunks(qs)
        for q, row in zip(qs, bounds, strict=True):
            points._configure(q)
            distances = [points._distance(a, b, 100.0) for a, b in points._bounds.pairs]
            # Below 0 nothing is bounded.
            assert (np.maximum(row, 0) <= np.maximum(distances, 0) + 1e-9).all()
            assert np.median(distances - row) < 0.05


# --- errors, output -----------------------------------------------------------------------------


def test_nothing_is_printed(peg_model, capfd):
    ClosestPoints(peg_model.spec, SceneSpec(())).close()
    assert capfd.readouterr() == ("", "")


def test_closing_twice_is_no_error(peg_model):
    points = ClosestPoints(peg_model.spec, SceneSpec(()))
    points.close()
    # It may be given what the first one let go of.
    other = ClosestPoints(peg_model.spec, SceneSpec(()))
    before = other.nearest(peg_model.spec.home).distance
    points.close()
    assert other.nearest(peg_model.spec.home).distance == before
    other.close()


@pytest.mark.parametrize("q", [np.zeros(5), np.full(6, np.nan)], ids=["short", "NaN"])
def test_joints_that_are_no_configuration_are_refused(peg, q):
    for ask in (peg.nearest, peg.collides):
        with pytest.raises(InvalidInput, match="q: "):
            ask(q)
    with pytest.raises(InvalidInput, match="q: "):
        peg.pair(q, "peg", "block")
    for ask in (peg.nearest_along, peg.first_collision):
        with pytest.raises(InvalidInput, match="qs: "):
            ask(q[None])


def test_bodies_and_links_that_are_missing_are_reported(peg):
    with pytest.raises(UnknownName, match="unknown body 'block': did you mean 'blok'"):
        peg.place({"table": np.eye(4), "blok": np.eye(4)}, 0.0)
    with pytest.raises(UnknownName, match="unknown body 'blok': did you mean 'block'"):
        peg.place({"table": np.eye(4), "block": np.eye(4)}, 0.0, {"blok": np.eye(4)})
    with pytest.raises(UnknownName, match="unknown link or body 'pegg': did you mean 'peg'"):
        peg.place({"table": np.eye(4), "block": np.eye(4)}, 0.0, allowed=[("pegg", "block")])
    with pytest.raises(UnknownName, match="unknown link or body 'pegg': did you mean 'peg'"):
        peg.pair(peg.robot.home, "pegg", "table")


def test_what_is_no_pose_or_no_gripper_position_is_refused(peg):
    Ts = {"table": np.eye(4), "block": np.eye(4)}
    with pytest.raises(InvalidInput, match="T_world_block: not a rigid transform"):
        peg.place({**Ts, "block": 2 * np.eye(4)}, 0.0)
    with pytest.raises(InvalidInput, match="T_tool_block: not a rigid transform"):
        peg.place(Ts, 0.0, {"block": 2 * np.eye(4)})
    with pytest.raises(InvalidInput, match="gripper: expected 0"):
        peg.place(Ts, 1.5)


@pytest.fixture
def rng():
    return np.random.default_rng(3)
