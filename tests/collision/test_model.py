"""Distances: exact where geometry has an answer, proved by planes elsewhere, no pair left out."""

from __future__ import annotations

import dataclasses
import itertools
from contextlib import closing

import coal
import hypothesis.strategies as st
import numpy as np
import pinocchio as pin
import pytest
from hypothesis import given, settings
from scipy.spatial import ConvexHull

from sart_toolkit.collision.model import CollisionModel
from sart_toolkit.collision.parts import robot_parts
from sart_toolkit.errors import InvalidInput, UnknownName
from sart_toolkit.poses import pose
from sart_toolkit.robots import USUAL_ROBOTS, get_robot
from sart_toolkit.robots.model import RobotModel
from sart_toolkit.robots.spec import Shape
from sart_toolkit.scenes.spec import Body, SceneSpec
from sart_toolkit.tasks import get_task
from sart_toolkit.tasks.task import Placement
from sart_toolkit.testing.closest import ClosestPoints, collision_geometry

PROPERTY = settings(deadline=None, derandomize=True, max_examples=40)
RADIUS = 0.01
# coal's own is relative: 1e-6 of the distance, which here is up to 2.5 m.
ACCURACY = 3e-6
FAR = pose([5, 5, 5])

shifts = st.tuples(*[st.floats(-0.3, 0.3)] * 3).map(np.array)
seeds = st.integers(0, 2**32 - 1)
kinds = st.sampled_from(["boxes", "rods", "shelf", "mixed"])


def joints_near(placed, rng, spread=1.5):
    model = placed.kinematics
    away = rng.uniform(-spread, spread, len(model.spec.home))
    return np.clip(model.spec.home + away, model.lower, model.upper)


def random_pose(rng, reach):
    axis = rng.normal(size=3)
    return pose(rng.uniform(-reach, reach, 3), rng.uniform(0, 3) * axis / np.linalg.norm(axis))


def by_names(placed):
    """The pairs' indices, by the names of the two bodies."""
    found = {}
    for k in range(len(placed.pairs)):
        found.setdefault(placed.names(k), []).append(k)
    return found


def body_distances(placed, q):
    """The distance of every two bodies that are considered."""
    distances = placed.distances(q)
    return {names: distances[pairs].min() for names, pairs in by_names(placed).items()}


def robot_links(placed):
    return {frame.name for frame in placed.kinematics.pinocchio_model.frames}


def scene_distance(placed, q, body):
    """The distance of a link or grasped body from the scene."""
    own = robot_links(placed)
    distances = body_distances(placed, q)
    return min(d for (a, b), d in distances.items() if a == body and b not in own)


def poses_of_parts(placed, q):
    """The poses `(4, 4)` of each part in the world, and of the joint that carries it."""
    joints = placed.joint_poses(q)
    return [(joints[part.joint] @ part.T_joint_part, joints[part.joint]) for part in placed.parts]


def reach_along(part, T_world_part, direction):
    """How far a part reaches along a direction, by the definition of its shape."""
    local, geometry = T_world_part[:3, :3].T @ direction, part.geometry
    if isinstance(geometry, coal.ConvexBase):
        reach = (np.array(geometry.points()).reshape(-1, 3) @ local).max()
    elif isinstance(geometry, coal.Box):
        reach = np.abs(local) @ np.ravel(geometry.halfSide)
    elif isinstance(geometry, coal.Cylinder):
        reach = geometry.radius * np.hypot(*local[:2]) + geometry.halfLength * abs(local[2])
    else:
        reach = geometry.radius
    return reach + direction @ T_world_part[:3, 3]


def simple(*bodies, robot="ur5e_2f85"):
    """A collision model of a robot that holds nothing, among bodies of one shape each."""
    return CollisionModel(
        get_robot(robot),
        SceneSpec(tuple(Body(name, (shape,), mass=0.1) for name, shape in bodies)),
    )


@pytest.fixture(scope="module")
def probed(peg_task):
    """Puts one small ball somewhere beside the robot with its peg."""
    scene = SceneSpec((Body("ball", (Shape("sphere", (RADIUS,)),)),), peg_task.scene.held)
    collision = CollisionModel(get_robot(peg_task.robot), scene)

    def with_ball_at(T_world_ball, gripper=0.0):
        return collision.placed({"ball": T_world_ball}, gripper)

    return with_ball_at


@pytest.fixture(scope="module")
def rods():
    """The robot, a thin rod for it to carry and one that stands."""
    rod, wire = Shape("cylinder", (0.002, 0.4)), Shape("cylinder", (0.003, 0.5))
    return simple(("rod", rod), ("wire", wire))


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
    assert scene_distance(placed, state.q, "peg") == pytest.approx(0.125, abs=1e-5)


def test_the_peg_far_from_the_block_is_nearest_to_the_table(start):
    placed = start.collision.placed({**start.state.Ts_world_body, "block": FAR}, 0.5)
    assert {pair.b for pair in placed.tool_clearances(start.state.q)} == {"table"}
    assert scene_distance(placed, start.state.q, "peg") == pytest.approx(0.165, abs=1e-5)


@PROPERTY
@given(gap=st.floats(0.001, 1))
def test_a_ball_below_the_peg_is_as_far_as_its_gap(probed, start, peg_tip, gap):
    placed = probed(pose(peg_tip - [0, 0, gap + RADIUS]))
    assert scene_distance(placed, start.state.q, "peg") == pytest.approx(gap, abs=2e-6)


@pytest.mark.parametrize(
    ("kind", "size"), [("box", (0.2, 0.2, 0.3)), ("cylinder", (0.1, 0.3)), ("sphere", (0.15,))]
)
def test_every_kind_of_shape_is_as_large_as_it_says(start, peg_task, peg_tip, kind, size):
    scene = SceneSpec((Body("thing", (Shape(kind, size),)),), peg_task.scene.held)
    T = pose(peg_tip - [0, 0, 0.1 + 0.15])
    placed = CollisionModel(start.collision.robot, scene).placed({"thing": T}, 0.0)
    assert scene_distance(placed, start.state.q, "peg") == pytest.approx(0.1, abs=1e-6)


@pytest.mark.parametrize("gap", [-0.0015, -1e-5, 1e-5, 0.0005, 0.03])
def test_a_rod_in_the_grasp_is_as_far_from_a_rod_as_their_axes_less_their_radii(rods, gap, rng):
    T_tool_rod = pose([0, 0, 0.4], [0.2, 0.1, 0])
    for _ in range(20):
        q = rods.robot.home + rng.uniform(-1, 1, 6)
        across = pose([0, gap + 0.005, 0.1], [0, rng.uniform(0.3, 2.8), 0])
        T_world_wire = rods.kinematics.fk(q) @ T_tool_rod @ across
        placed = rods.placed({"wire": T_world_wire}, 0.0, {"rod": T_tool_rod})
        assert body_distances(placed, q)["rod", "wire"] == pytest.approx(gap, abs=2e-6)


def test_a_body_in_the_grasp_is_as_far_from_a_table_as_its_lowest_corner(rng):
    collision = simple(("box", Shape("box", (0.04, 0.06, 0.2))), ("table", Shape("box", (9, 9, 1))))
    T_tool_box = pose([0.01, 0.02, 0.1], [0.4, 0.2, 0])
    placed = collision.placed({"table": pose([0, 0, -1.5])}, 0.0, {"box": T_tool_box})
    corners = np.array(list(itertools.product([-0.02, 0.02], [-0.03, 0.03], [-0.1, 0.1], [1])))
    for _ in range(20):
        q = joints_near(placed, rng)
        lowest = (corners @ (collision.kinematics.fk(q) @ T_tool_box).T)[:, 2].min()
        assert body_distances(placed, q)["box", "table"] == pytest.approx(lowest + 1, abs=ACCURACY)


# --- what distances are in general --------------------------------------------------------------


@settings(PROPERTY, max_examples=25)
@given(seed=seeds, kind=kinds)
def test_a_plane_proves_every_distance(cluttered, seed, kind):
    placed = cluttered[kind]
    q = joints_near(placed, np.random.default_rng(seed))
    distances, Ts = placed.distances(q), [T for T, _ in poses_of_parts(placed, q)]
    exactly = coal.DistanceRequest()
    exactly.gjk_tolerance, exactly.gjk_max_iterations = 1e-10, 1000
    for k in np.flatnonzero(distances > 1e-4):
        i, j = placed.pairs[k]
        (a, b), found = (placed.parts[i], placed.parts[j]), coal.DistanceResult()
        at = [coal.Transform3s(T[:3, :3], T[:3, 3]) for T in (Ts[i], Ts[j])]
        coal.distance(a.geometry, at[0], b.geometry, at[1], exactly, found)
        n = np.ravel(found.getNearestPoint2()) - np.ravel(found.getNearestPoint1())
        n /= np.linalg.norm(n)
        # No matter where the normal comes from: the bodies lie so far to its two sides.
        apart = -reach_along(b, Ts[j], -n) - reach_along(a, Ts[i], n)
        assert distances[k] <= apart + ACCURACY


@PROPERTY
@given(seed=seeds, kind=kinds)
def test_witness_points_are_on_both_bodies_and_as_far_apart_as_the_distance(cluttered, seed, kind):
    placed, rng = cluttered[kind], np.random.default_rng(seed)
    q = joints_near(placed, rng)
    distances, Ts = placed.distances(q), [T for T, _ in poses_of_parts(placed, q)]
    for k in rng.choice(len(placed.pairs), 8, replace=False):
        witness = placed.witness(q, int(k))
        assert witness.pair == placed.names(k)
        assert witness.distance == pytest.approx(distances[k], abs=ACCURACY)
        between = witness.p_b - witness.p_a
        assert np.linalg.norm(between) == pytest.approx(abs(witness.distance), abs=ACCURACY)
        for p, index in zip((witness.p_a, witness.p_b), placed.pairs[k], strict=True):
            part, T = placed.parts[index], Ts[index]
            ball = coal.Transform3s(np.eye(3), p)
            at = coal.Transform3s(T[:3, :3], T[:3, 3])
            request, found = coal.DistanceRequest(), coal.DistanceResult()
            outside = coal.distance(coal.Sphere(1e-4), ball, part.geometry, at, request, found)
            # On the surface: less than a sphere's radius either way.
            assert outside == pytest.approx(-1e-4, abs=1e-5)


@PROPERTY
@given(shift=shifts, step=st.floats(0, 0.3))
def test_no_distance_changes_by_more_than_a_body_moves(start, shift, step):
    q, Ts = start.state.q, start.state.Ts_world_body
    a, b = (
        start.collision.placed({**Ts, "block": pose(shift * by) @ Ts["block"]}, 0.5).distances(q)
        for by in (1, 1 + step)
    )
    assert np.abs(a - b).max() <= np.linalg.norm(shift) * step + ACCURACY


@PROPERTY
@given(seed=seeds, kind=kinds, step=st.floats(0, 0.5))
def test_no_distance_changes_by_more_than_the_joints_between_can_move_it(
    cluttered, seed, kind, step
):
    placed, rng = cluttered[kind], np.random.default_rng(seed)
    q = joints_near(placed, rng)
    dq = step * rng.uniform(-1, 1, 6) * (rng.random(6) < 0.4)
    change = np.abs(placed.distances(q + dq) - placed.distances(q))
    assert (change <= placed.bounds.reach @ np.abs(dq) + ACCURACY).all()


def test_distances_only_grow_when_the_scene_moves_away_below(start):
    q, Ts = start.state.q, start.state.Ts_world_body
    rows = []
    for drop in np.linspace(0, 0.5, 11):
        lower = {name: pose([0, 0, -drop]) @ T for name, T in Ts.items()}
        distances = body_distances(start.collision.placed(lower, 0.5), q)
        rows.append([d for (_, b), d in distances.items() if b in Ts])
    assert (np.diff(rows, axis=0) > 0).all()


@PROPERTY
@given(inside=st.tuples(*[st.floats(-0.9, 0.9)] * 3))
def test_a_ball_inside_the_peg_overlaps_it(probed, peg_model, start, inside):
    T = peg_model.fk(start.state.q, "peg") @ pose(np.array(inside) * [0.015, 0.015, 0.04])
    assert scene_distance(probed(T), start.state.q, "peg") < 0


def test_the_deeper_the_peg_is_in_the_table_the_more_they_overlap(start):
    depths = np.linspace(0.005, 0.045, 9)
    for depth in depths:
        Ts = {"table": pose([0, 0, 0.165 + depth]), "block": FAR}
        found = scene_distance(start.collision.placed(Ts, 0.5), start.state.q, "peg")
        assert found == pytest.approx(-depth, abs=1e-5)


def test_a_touching_pair_is_at_distance_zero(probed, start, peg_tip):
    for gap in (0.0, 1e-9, -1e-9):
        placed = probed(pose(peg_tip - [0, 0, gap + RADIUS]))
        assert scene_distance(placed, start.state.q, "peg") == pytest.approx(gap, abs=2e-6)


# --- the robot's parts --------------------------------------------------------------------------


def collision_vertices(model, q):
    """Each collision element of the composed URDF: its link, points on it `(n, 3)` in the world."""
    poses = model.link_poses(q)
    for link, geometry, T_link_part in collision_geometry(model.urdf):
        T = poses[link] @ T_link_part
        points = geometry
        if isinstance(geometry, Shape):
            directions = np.random.default_rng(0).normal(size=(100, 3))
            points = np.array([support_point(geometry, d) for d in directions])
        yield link, points @ T[:3, :3].T + T[:3, 3]


def support_point(shape, direction):
    """The point `(3,)` of a primitive that is farthest along a direction, by its definition."""
    if shape.kind == "box":
        return np.sign(direction) * shape.size / 2
    if shape.kind == "sphere":
        return shape.size[0] * direction / np.linalg.norm(direction)
    radius, length = shape.size
    around = radius * direction[:2] / np.linalg.norm(direction[:2])
    return np.array([*around, np.sign(direction[2]) * length / 2])


@pytest.mark.parametrize("gripper", [0.0, 0.37, 1.0])
@pytest.mark.parametrize("robot", [*USUAL_ROBOTS, "panda"])
def test_parts_enclose_all_collision_geometry_and_are_hardly_larger(robot, gripper, rng):
    placed = CollisionModel(get_robot(robot), SceneSpec(())).placed({}, gripper)
    q = joints_near(placed, rng)
    parts = {}
    for part, (_, T_world_joint) in zip(placed.parts, poses_of_parts(placed, q), strict=True):
        points = part.points @ T_world_joint[:3, :3].T + T_world_joint[:3, 3]
        parts.setdefault(part.body, []).append(points)
    seen = {}
    model = RobotModel(get_robot(robot), (), gripper)
    for link, points in collision_vertices(model, q):
        hulls = [ConvexHull(corners).equations for corners in parts[link]]
        assert min((points @ h[:, :3].T + h[:, 3]).max() for h in hulls) < 1e-6, link
        seen.setdefault(link, []).append(points)
    assert set(seen) == set(parts)
    # About a cylinder there is a prism, about a sphere a cube.
    round_ = {
        link
        for link, geometry, _ in collision_geometry(model.urdf)
        if isinstance(geometry, Shape) and geometry.kind != "box"
    }
    for link, points in seen.items():
        for axis in (*np.eye(3), *-np.eye(3)):
            larger = (np.concatenate(parts[link]) @ axis).max()
            larger -= (np.concatenate(points) @ axis).max()
            assert larger < (0.01 if link in round_ else 1e-6), link
    assert {*get_robot(robot).gripper.finger_links} < set(seen)
    assert {part.joint for part in placed.parts} == set(range(model.pinocchio_model.njoints))


def test_a_ball_at_a_vertex_of_any_link_overlaps_it(probed, peg_model, start):
    q = start.state.q
    overlapped = set()
    for link, vertices in collision_vertices(peg_model, q):
        for direction in ([1, 0, 0], [-1, -1, -1]):
            vertex = vertices[np.argmin(vertices @ direction)]
            distances = body_distances(probed(pose(vertex)), q)
            if link == "base_link_inertia":
                # What never moves is no business of the robot's.
                assert (link, "ball") not in distances
            else:
                assert distances[link, "ball"] < -RADIUS / 2, link
                overlapped.add(link)
    assert {"shoulder_link", "upper_arm_link", "forearm_link", "wrist_1_link"} < overlapped
    assert {"wrist_2_link", "wrist_3_link", "gripper_left_inner_finger_pad"} < overlapped


@pytest.mark.parametrize(
    ("geometry", "corner"),
    [
        (coal.Box(0.02, 0.04, 0.06), (0.01, 0.02, 0.03)),
        (coal.Cylinder(0.01, 0.06), (0.01, 0.0, 0.03)),
        (coal.Sphere(0.02), (0.0, 0.02, 0.0)),
    ],
    ids=["box", "cylinder", "sphere"],
)
def test_points_enclose_a_held_body_of_any_kind_and_the_reach_is_little_more(
    peg_model, peg_task, monkeypatch, geometry, corner
):
    build = pin.buildGeomFromUrdf

    def with_another_peg(*args, **kwargs):
        loaded = build(*args, **kwargs)
        (peg,) = [item for item in loaded.geometryObjects if item.name.startswith("peg")]
        peg.geometry = geometry
        return loaded

    monkeypatch.setattr(pin, "buildGeomFromUrdf", with_another_peg)
    (peg,) = [part for part in robot_parts(peg_model) if part.body == "peg"]
    local = (peg.points - peg.T_joint_part[:3, 3]) @ peg.T_joint_part[:3, :3]
    hull = ConvexHull(local).equations
    assert (hull[:, :3] @ corner + hull[:, 3]).max() < 1e-9
    for direction in np.random.default_rng(0).normal(size=(50, 3)):
        direction /= np.linalg.norm(direction)
        assert reach_along(peg, np.eye(4), direction) <= (local @ direction).max() + 1e-9
    farthest = max(np.linalg.norm(peg.T_joint_part @ [*corner, 1]), 0)
    assert peg.reach < farthest + 0.03
    centre, radius = peg.sphere
    assert (np.linalg.norm(peg.points - centre, axis=1) <= radius + 1e-12).all()


@settings(PROPERTY, max_examples=15)
@given(seed=seeds, kind=kinds)
def test_no_point_is_farther_from_a_joint_than_the_reach(cluttered, seed, kind):
    placed = cluttered[kind]
    joints = placed.joint_poses(joints_near(placed, np.random.default_rng(seed), 3))
    bounds, firsts = placed.bounds, placed.pairs[:, 0]
    for k in range(len(placed.pairs)):
        part = placed.parts[firsts[k]]
        T = joints[part.joint]
        points = part.points @ T[:3, :3].T + T[:3, 3]
        for joint in range(bounds.joint_b[k] + 1, bounds.joint_a[k] + 1):
            far = np.linalg.norm(points - joints[joint][:3, 3], axis=1).max()
            assert far <= bounds.reach[k, joint - 1] + 1e-9


@pytest.mark.parametrize("robot", [*USUAL_ROBOTS, "panda"])
def test_fingers_move_with_the_gripper(robot):
    collision = simple(("ball", Shape("sphere", (0.002,))), robot=robot)
    q = collision.robot.home
    left, right = collision.robot.gripper.finger_links
    T = collision.kinematics.fk(q)
    rows = []
    for gripper in (0.0, 0.3, 0.6, 1.0):
        # Between the fingers, which close about it.
        distances = body_distances(collision.placed({"ball": T}, gripper), q)
        rows.append((distances[left, "ball"], distances[right, "ball"]))
    assert (np.diff(rows, axis=0) < -0.004).all()
    np.testing.assert_allclose(*np.transpose(rows), atol=1e-4)


def test_the_tool_frame_is_where_kinematics_has_it(cluttered, rng):
    for placed in cluttered.values():
        q = joints_near(placed, rng)
        T = placed.joint_poses(q)[-1] @ placed.T_joint_tool
        np.testing.assert_allclose(T, placed.kinematics.fk(q), atol=1e-12)


# --- which pairs --------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["boxes", "rods", "shelf", "mixed"])
def test_all_that_moves_is_compared_with_all_that_stands(cluttered, kind):
    placed = cluttered[kind]
    scene = {part.body for part in placed.parts} - robot_links(placed)
    pairs = {tuple(pair) for pair in placed.pairs.tolist()}
    assert len(pairs) == len(placed.pairs)
    for i, a in enumerate(placed.parts):
        for j, b in enumerate(placed.parts):
            if b.body in scene:
                assert ((i, j) in pairs) == (a.joint > 0)
            elif a.joint - b.joint >= 2:
                assert (i, j) in pairs
            else:
                assert (i, j) not in pairs


@pytest.mark.parametrize("robot", [*USUAL_ROBOTS, "panda"])
def test_no_pair_of_the_robots_own_overlaps_at_home_at_any_opening(robot):
    collision = CollisionModel(get_robot(robot), SceneSpec(()))
    for gripper in (0.0, 0.3, 0.6, 1.0):
        placed = collision.placed({}, gripper)
        assert len(placed.pairs) > 50
        assert placed.distances(placed.kinematics.spec.home).min() > 0.01


@pytest.mark.parametrize("robot", [*USUAL_ROBOTS, "panda"])
@pytest.mark.parametrize("first", [0.0, 1.0])
def test_which_pairs_are_considered_does_not_depend_on_the_opening(robot, first):
    collision = CollisionModel(get_robot(robot), SceneSpec(()))
    collision.placed({}, first)
    names = {collision.placed({}, 0.5).names(k) for k in range(len(collision.placed({}, 0).pairs))}
    links = {part.body: part.joint for part in collision.placed({}, 0.5).parts}
    expected = {(a, b) for a in links for b in links if links[a] - links[b] >= 2}
    assert names == expected


def test_what_overlaps_at_home_is_left_out_and_nothing_else():
    # As if an odd mesh reached into what isn't its neighbour: this home is folded.
    spec = get_robot("ur5e_2f85")
    folded = np.array([0.0, -0.6, 2.7, 0.6, 1.6, 0.0])
    odd = CollisionModel(dataclasses.replace(spec, home=folded), SceneSpec(())).placed({}, 0.0)
    placed = CollisionModel(spec, SceneSpec(())).placed({}, 0.0)
    distances = body_distances(placed, folded)
    overlapping = {names for names, distance in distances.items() if distance <= 0}
    assert 0 < len(overlapping) < len(distances) / 2
    assert set(by_names(odd)) == set(distances) - overlapping
    np.testing.assert_allclose(
        [body_distances(odd, spec.home)[names] for names in by_names(odd)],
        [body_distances(placed, spec.home)[names] for names in by_names(odd)],
        atol=ACCURACY,
    )


def test_tool_bodies_are_what_the_last_joint_carries(probed, start):
    pairs = probed(FAR).tool_clearances(start.state.q)
    links = [pair.a for pair in pairs]
    assert {"peg", "wrist_camera", "gripper_left_inner_finger_pad", "wrist_3_link"} <= set(links)
    assert {"forearm_link", "upper_arm_link", "wrist_1_link", "wrist_2_link"}.isdisjoint(links)
    assert len(links) == len(set(links))
    distances = [pair.distance for pair in pairs]
    assert distances == sorted(distances)


def test_tool_clearances_are_the_smallest_of_each_tool_body_to_all_that_stands(cluttered, rng):
    for placed in cluttered.values():
        q = joints_near(placed, rng)
        distances = placed.distances(q)
        pairs = placed.tool_pairs()
        expected = [
            k
            for k, (i, j) in enumerate(placed.pairs)
            if placed.parts[i].joint == 6 and placed.parts[j].joint == 0
        ]
        assert pairs == expected
        assert {placed.names(k)[1] for k in pairs} > {"table", "base_link_inertia"}
        for clearance in placed.tool_clearances(q):
            own = [k for k in pairs if placed.names(k)[0] == clearance.a]
            assert clearance.distance == pytest.approx(distances[own].min(), abs=ACCURACY)


def test_a_tool_folded_onto_the_arm_is_reported(probed, start):
    placed, q = probed(FAR), np.array(start.state.q)
    assert placed.nearest(q).distance > 0.01
    found = []
    for wrist_1, elbow in itertools.product(np.linspace(-3, 3, 13), (1.9, 2.6)):
        q[2:4] = elbow, wrist_1
        found.append(placed.nearest(q))
    nearest = min(found, key=lambda pair: pair.distance)
    assert nearest.distance < 0
    assert nearest.b in {"forearm_link", "upper_arm_link", "shoulder_link"}


def test_a_tool_at_the_robots_own_foot_is_reported(probed):
    # Straight down beside the base.
    q = np.array([0.0, -0.6, 2.7, 0.6, 1.6, 0.0])
    nearest = probed(FAR).nearest(q)
    assert nearest.distance < 0
    assert nearest.b in {"base_link_inertia", "shoulder_link", "upper_arm_link"}


def test_a_shape_that_does_not_collide_is_not_near(peg_model, start):
    shapes = (Shape("sphere", (0.1,), collides=False), Shape("sphere", (0.01,), pose([0, 0, 3])))
    collision = CollisionModel(start.collision.robot, SceneSpec((Body("ghost", shapes),)))
    placed = collision.placed({"ghost": pose(peg_model.fk(start.state.q)[:3, 3])}, 0.0)
    assert scene_distance(placed, start.state.q, "wrist_camera") > 2.5


def test_among_nothing_only_the_robot_itself_is_in_its_way(start):
    placed = CollisionModel(start.collision.robot, SceneSpec(())).placed({}, 0.0)
    assert {pair.b for pair in placed.tool_clearances(start.state.q)} == {"base_link_inertia"}
    assert placed.sphere_clearance(np.zeros(3), 0.1) is None
    assert set(placed.nearest(start.state.q).pair) <= robot_links(placed)


def test_where_all_may_touch_nothing_is_near(start):
    links = {part.body for part in start.placed.parts}
    allowed = list(itertools.product(links, links))
    placed = start.collision.placed(start.state.Ts_world_body, 0.5, allowed=allowed)
    assert len(placed.pairs) == 0
    assert placed.nearest(start.state.q) is None
    assert placed.too_close(start.state.q, 1.0) is None
    assert placed.distances(start.state.q).shape == (0,)
    assert placed.tool_clearances(start.state.q) == []


def test_a_body_in_the_grasp_counts_as_the_tools_and_no_longer_as_the_scenes(peg_model, start):
    box = Shape("box", (0.02, 0.02, 0.06))
    collision = simple(("box", box), ("floor", box))
    q = start.state.q
    T = peg_model.fk(q)
    Ts = {"box": T @ pose([0, 0, 0.10]), "floor": T @ pose([0, 0, 0.20])}
    assert {pair.b for pair in collision.placed(Ts, 0.0).tool_clearances(q)} == {"box"}
    placed = collision.placed(Ts, 0.0, {"box": pose([0, 0, 0.10])})
    clearances = placed.tool_clearances(q)
    assert {pair.b for pair in clearances} == {"floor"}
    assert scene_distance(placed, q, "box") == pytest.approx(0.04, abs=1e-6)
    assert clearances[0].a == "box"
    # It moves with the tool: the floor is not where the tool is elsewhere.
    away = q + [0.5, 0, 0, 0, 0, 0]
    moved = collision.placed({"floor": pose(rotvec=[0, 0, 0.5]) @ Ts["floor"]}, 0.0,
                             {"box": pose([0, 0, 0.10])})  # fmt: skip
    assert scene_distance(moved, away, "box") == pytest.approx(0.04, abs=1e-6)
    assert scene_distance(placed, away, "box") > 0.1
    # It is compared with the arm, but with what holds it and the wrist beside it not.
    with_box = {b for a, b in by_names(placed) if a == "box"}
    assert {"floor", "base_link_inertia", "shoulder_link", "forearm_link"} < with_box
    assert "wrist_1_link" in with_box
    assert not any(b.startswith("gripper_") for b in with_box)
    assert {"wrist_2_link", "wrist_3_link"}.isdisjoint(with_box)


def test_a_long_body_in_the_grasp_hits_the_arm(start):
    collision = simple(("pole", Shape("cylinder", (0.01, 1.2))))
    q = start.state.q
    # To the side of the tool it passes beside the arm; towards the base it goes through the foot.
    for turn, clear in (([0, np.pi / 2, 0], True), ([np.pi / 2, 0, 0], False)):
        placed = collision.placed({}, 0.5, {"pole": pose([0, 0, 0.1], turn)})
        distances = [d for (a, _), d in body_distances(placed, q).items() if a == "pole"]
        assert len(distances) >= 5
        assert (min(distances) > 0.02) == clear
        assert (min(distances) < 0) == (not clear)


def test_bodies_in_one_grasp_are_not_compared(start):
    box = Shape("box", (0.02, 0.02, 0.06))
    collision = simple(("left", box), ("right", box))
    placed = collision.placed({}, 0.0, {"left": np.eye(4), "right": np.eye(4)})
    assert {"left", "right"}.isdisjoint(b for _, b in by_names(placed))


def test_allowed_pairs_are_left_out_whichever_way_round_and_no_others(start):
    Ts, q = start.state.Ts_world_body, start.state.q
    before = by_names(start.placed)
    allowed = [("peg", "block"), ("base_link_inertia", "forearm_link")]
    placed = start.collision.placed(Ts, start.state.gripper, allowed=allowed)
    after = by_names(placed)
    assert set(before) - set(after) == {("peg", "block"), ("forearm_link", "base_link_inertia")}
    distances = body_distances(start.placed, q)
    for names, distance in body_distances(placed, q).items():
        assert distance == pytest.approx(distances[names], abs=ACCURACY)


def test_a_door_is_where_its_pose_says(rng):
    task = get_task("door_opening")
    model = RobotModel(get_robot(task.robot))
    collision = CollisionModel(get_robot(task.robot), task.scene)
    state = task.initial_state(model, Placement())
    q = state.q
    found = []
    for angle in (0.0, 1.0):
        Ts = task.scene.initial_state(q, 0.0, joint_positions={"door": angle}).Ts_world_body
        placed = collision.placed(Ts, 0.0)
        distance = body_distances(placed, q)["gripper_left_inner_finger_pad", "door"]
        found.append(distance)
        corners = np.concatenate([
            part.points for part in placed.parts if part.body == "door"
        ])  # fmt: skip
        local = (corners - Ts["door"][:3, 3]) @ Ts["door"][:3, :3]
        shapes = [s for s in task.scene.bodies[-1].shapes if s.collides]
        expected = np.concatenate([shape.corners() for shape in shapes])
        np.testing.assert_allclose(local, expected, atol=1e-12)
    assert abs(found[0] - found[1]) > 0.02


# --- beside PyBullet ----------------------------------------------------------------------------

# What the docstring of `ClosestPoints` says of meshes, and coal's accuracy.
TOO_FAR, TOO_NEAR = 6e-5 + ACCURACY, 5e-6 + ACCURACY


@pytest.mark.parametrize("robot", [*USUAL_ROBOTS, "panda"])
def test_distances_are_those_of_pybullet(robot, peg_task, rng):
    peg, rod = peg_task.scene.held, Body("rod", (Shape("cylinder", (0.01, 0.2)),), mass=0.1)
    things = [
        Body(
            "box", (Shape("box", (0.2, 0.1, 0.3), random_pose(rng, 0.05)),), pose([0.5, 0.2, 0.2])
        ),
        Body("can", (Shape("cylinder", (0.1, 0.2)),), pose([0.4, -0.3, 0.4], [1, 0.5, 0])),
        Body("ball", (Shape("sphere", (0.1,)),), pose([0.6, 0, 0.6])),
    ]
    scene = SceneSpec((*things, rod), peg)
    spec, Ts = get_robot(robot), {body.name: body.T_world_body for body in things}
    T_tool_rod, gripper = pose([0.01, 0, 0.05], [0.3, 1, 0]), 0.43
    placed = CollisionModel(spec, scene).placed(Ts, gripper, {"rod": T_tool_rod})
    overlaps = apart = 0
    with closing(ClosestPoints(spec, scene)) as points:
        points.place(Ts, gripper, {"rod": T_tool_rod})
        for _ in range(60):
            q = joints_near(placed, rng)
            for (a, b), distance in body_distances(placed, q).items():
                if distance > 0.1:
                    continue
                found = points.pair(q, a, b)
                assert (found < 0) == (distance < 0) or abs(found) < TOO_FAR, (a, b)
                if distance > 0:
                    assert -TOO_NEAR < found - distance < TOO_FAR, (a, b)
                overlaps, apart = overlaps + (distance < 0), apart + (distance > 0)
            # Nothing that PyBullet finds nearest is missing here.
            nearest = points.nearest(q, 0.2)
            assert placed.nearest(q).distance <= max(nearest.distance, 0) + TOO_NEAR
    # The last joints of panda are farther apart.
    assert overlaps > (100 if robot in USUAL_ROBOTS else 50)
    assert apart > 500


# --- quick bounds -------------------------------------------------------------------------------


def rough_distances(placed, q):
    """What spheres and boxes say of each pair's distance."""
    bounds = placed.bounds
    every = np.arange(len(placed.pairs))
    enclosures = bounds.placed(placed.joint_poses(q)[None])
    return bounds.rough_distances(enclosures, np.zeros_like(every), every)


def assert_not_above(rough, exact):
    """Where they are above 0, rough distances are no more than exact ones.

    Where spheres and boxes overlap nothing is said, nor of how deep.
    """
    assert (rough <= np.maximum(exact, 0) + ACCURACY).all()


@settings(PROPERTY, max_examples=100)
@given(seed=seeds, kind=kinds, spread=st.sampled_from([0.3, 1.5, 6]))
def test_rough_distances_are_never_above_true_ones(cluttered, seed, kind, spread):
    placed = cluttered[kind]
    q = joints_near(placed, np.random.default_rng(seed), spread)
    rough, distances = rough_distances(placed, q), placed.distances(q)
    assert_not_above(rough, distances)
    # They are of use: they tell apart most of what is far.
    assert (rough > 0.01).sum() > 0.6 * (distances > 0.1).sum()


@PROPERTY
@given(seed=seeds, grasped=st.booleans(), slip=st.sampled_from([0.0, 0.02]))
def test_rough_distances_are_never_above_true_ones_whatever_is_grasped(rods, seed, grasped, slip):
    rng = np.random.default_rng(seed)
    Ts = {"wire": random_pose(rng, 0.6), "rod": random_pose(rng, 0.6)}
    in_grasp = {"rod": random_pose(rng, 0.3)} if grasped else None
    placed = rods.placed(Ts, rng.uniform(), in_grasp, slip_tolerance=slip)
    q = joints_near(placed, rng)
    assert_not_above(rough_distances(placed, q), placed.distances(q))


@pytest.mark.parametrize("kind", ["boxes", "rods", "shelf", "mixed"])
def test_spheres_and_boxes_enclose_what_they_stand_for(cluttered, kind, rng):
    placed = cluttered[kind]
    bounds = placed.bounds
    q = joints_near(placed, rng)
    centres, axes, middles, _ = (each[0] for each in bounds.placed(placed.joint_poses(q)[None]))
    world = [
        part.points @ T[:3, :3].T + T[:3, 3]
        for part, (_, T) in zip(placed.parts, poses_of_parts(placed, q), strict=True)
    ]
    for k, (i, j) in enumerate(placed.pairs):
        assert (bounds.joint_a[k], bounds.joint_b[k]) == (
            placed.parts[i].joint, placed.parts[j].joint
        )  # fmt: skip
        to_centre = np.linalg.norm(world[i] - centres[i], axis=1)
        assert to_centre.max() <= bounds.radii[k] + 1e-9
        local = (world[j] - middles[j]) @ axes[j].T
        assert (np.abs(local) <= bounds.half[k] + 1e-9).all()


# --- slip in the grasp --------------------------------------------------------------------------


@PROPERTY
@given(seed=seeds, slip=st.floats(0, 0.02))
def test_all_that_is_grasped_is_nearer_by_its_slip_and_nothing_else_is(rods, seed, slip):
    rng = np.random.default_rng(seed)
    Ts, T_tool_rod = {"wire": random_pose(rng, 0.6)}, random_pose(rng, 0.3)
    tight = rods.placed(Ts, 0.2, {"rod": T_tool_rod})
    loose = rods.placed(Ts, 0.2, {"rod": T_tool_rod}, slip_tolerance=slip)
    q = joints_near(loose, rng)
    grasped = np.array([loose.names(k)[0] == "rod" for k in range(len(loose.pairs))])
    assert 0 < grasped.sum() < len(grasped)
    expected = tight.distances(q) - slip * grasped
    np.testing.assert_allclose(loose.distances(q), expected, rtol=0, atol=ACCURACY)
    every = list(range(len(loose.pairs)))
    np.testing.assert_allclose(loose.pair_distances(q, every), expected, rtol=0, atol=ACCURACY)
    assert loose.nearest(q).distance == pytest.approx(expected.min(), abs=ACCURACY)
    k = int(np.flatnonzero(grasped)[0])
    assert loose.witness(q, k).distance == pytest.approx(expected[k], abs=ACCURACY)
    margin = expected.min() + 1e-4
    if margin > 0:
        assert loose.too_close(q, margin) is not None
        assert loose.too_close(q, max(margin - 2e-4, 0.0)) is None or expected.min() < 0


def test_rough_distances_take_the_slip_into_account():
    # A pole that points at the middle of a block: the sphere about it is hardly nearer.
    collision = simple(
        ("pole", Shape("box", (1e-3, 1e-3, 0.4))), ("block", Shape("box", (1, 1, 1)))
    )
    q = collision.robot.home
    T = collision.kinematics.fk(q)
    Ts = {"block": pose(T[:3, 3] - [0, 0, 0.2 + 0.05 + 0.5])}
    for slip in (0.0, 0.02):
        placed = collision.placed(Ts, 0.0, {"pole": np.eye(4)}, slip_tolerance=slip)
        (k,) = by_names(placed)["pole", "block"]
        assert placed.distances(q)[k] == pytest.approx(0.05 - slip, abs=ACCURACY)
        assert rough_distances(placed, q)[k] == pytest.approx(0.05 - slip, abs=1e-4)
        assert rough_distances(placed, q)[k] <= 0.05 - slip + ACCURACY


@pytest.mark.parametrize("slip", [-1e-6, np.nan, np.inf])
def test_a_slip_tolerance_that_is_negative_or_not_finite_is_refused(rods, slip):
    with pytest.raises(InvalidInput, match="slip_tolerance: expected a finite number >= 0 m, got"):
        rods.placed({"wire": FAR}, 0.0, {"rod": np.eye(4)}, slip_tolerance=slip)


# --- other questions ----------------------------------------------------------------------------


@settings(PROPERTY, max_examples=100)
@given(seed=seeds, kind=kinds, margin=st.sampled_from([0.0, 0.003, 0.02, 0.1]))
def test_too_close_says_what_the_distances_say(cluttered, seed, kind, margin):
    placed = cluttered[kind]
    q = joints_near(placed, np.random.default_rng(seed), 1.0)
    distances = placed.distances(q)
    found = placed.too_close(q, margin)
    if abs(distances.min() - margin) > ACCURACY:
        assert (found is not None) == (distances.min() < margin)
    if found is not None:
        nearest = distances[by_names(placed)[found]].min()
        assert nearest == pytest.approx(distances.min(), abs=ACCURACY)


@PROPERTY
@given(seed=seeds, kind=kinds)
def test_the_nearest_is_the_smallest_distance(cluttered, seed, kind):
    placed = cluttered[kind]
    q = joints_near(placed, np.random.default_rng(seed))
    distances, nearest = placed.distances(q), placed.nearest(q)
    assert nearest.distance == pytest.approx(distances.min(), abs=ACCURACY)
    assert distances[by_names(placed)[nearest.pair]].min() <= distances.min() + ACCURACY


@PROPERTY
@given(seed=seeds, kind=kinds)
def test_some_pairs_are_as_far_as_among_all(cluttered, seed, kind):
    placed, rng = cluttered[kind], np.random.default_rng(seed)
    q = joints_near(placed, rng)
    distances = placed.distances(q)
    some = rng.permutation(len(placed.pairs))[:50]
    np.testing.assert_allclose(
        placed.pair_distances(q, some.tolist()), distances[some], rtol=0, atol=ACCURACY
    )


@pytest.mark.parametrize("overlapping", [False, True])
@pytest.mark.parametrize("kind", ["boxes", "shelf", "mixed"])
def test_gradients_are_those_of_the_distances(cluttered, kind, overlapping, rng):
    placed, h = cluttered[kind], 1e-3
    errors = []
    for _ in range(30):
        q = joints_near(placed, rng)
        distances = placed.distances(q)
        choice = (distances < -1e-3) if overlapping else (distances > 1e-3) & (distances < 0.3)
        pairs = np.flatnonzero(choice)
        pairs = rng.permutation(pairs)[:8]
        steps = h * np.eye(6)
        ahead, behind = (
            np.array([placed.distances(q + side * dq)[pairs] for dq in steps]) for side in (1, -1)
        )
        for k, expected in zip(pairs, ((ahead - behind) / (2 * h)).T, strict=True):
            errors.append(np.abs(placed.gradient(q, int(k)) - expected).max())
    assert len(errors) > 50
    # But for where another corner or face becomes the nearest, or the nearest way out.
    assert np.quantile(errors, 0.85) < 0.02


def test_a_pair_that_just_touches_has_no_gradient(rods):
    q = rods.robot.home
    T = rods.kinematics.fk(q)
    placed = rods.placed({"wire": T @ pose([0, 0.005, 0])}, 0.0, {"rod": np.eye(4)})
    (k,) = by_names(placed)["rod", "wire"]
    assert np.isfinite(placed.gradient(q, k)).all()


@pytest.fixture(scope="module")
def box_and_ball():
    return simple(("box", Shape("box", (0.2, 0.1, 0.4))), ("far", Shape("sphere", (0.1,))))


@PROPERTY
@given(p=shifts, radius=st.floats(0.001, 0.1), seed=seeds)
def test_a_bare_sphere_is_as_far_from_a_box_as_geometry_says(box_and_ball, p, radius, seed):
    half, T = np.array([0.1, 0.05, 0.2]), random_pose(np.random.default_rng(seed), 0.5)
    placed = box_and_ball.placed({"box": T, "far": FAR}, 0.0)
    found = placed.sphere_clearance((T @ [*p, 1])[:3], radius)
    outside = np.abs(p) - half
    exact = np.linalg.norm(np.maximum(outside, 0)) + min(outside.max(), 0) - radius
    assert found.pair == ("sphere", "box")
    assert found.distance == pytest.approx(exact, abs=1e-5)
    if exact > 1e-5:
        assert np.linalg.norm(found.p_a - found.p_b) == pytest.approx(exact, abs=1e-6)
        assert np.linalg.norm(found.p_a - (T @ [*p, 1])[:3]) == pytest.approx(radius, abs=1e-6)


def test_a_bare_sphere_is_compared_neither_with_the_robot_nor_with_what_it_carries(start):
    box = Shape("box", (0.02, 0.02, 0.06))
    collision = simple(("box", box), ("floor", box))
    T = collision.kinematics.fk(start.state.q)
    Ts = {"box": np.eye(4), "floor": T @ pose([0, 0, 0.5])}
    placed = collision.placed(Ts, 0.0, {"box": np.eye(4)})
    found = placed.sphere_clearance(T[:3, 3], 0.01)
    assert found.pair == ("sphere", "floor")
    assert found.distance == pytest.approx(0.5 - 0.03 - 0.01, abs=1e-6)


# --- errors -------------------------------------------------------------------------------------


def test_a_body_whose_pose_is_missing_is_reported(start):
    with pytest.raises(UnknownName, match="unknown body 'block': did you mean 'blok'"):
        start.collision.placed({"table": np.eye(4), "blok": np.eye(4)}, 0.0)


def test_a_grasped_body_that_the_scene_has_not_is_reported(start):
    Ts = start.state.Ts_world_body
    with pytest.raises(UnknownName, match="unknown grasped body 'blok': did you mean 'block'"):
        start.collision.placed(Ts, 0.0, {"blok": np.eye(4)})


@pytest.mark.parametrize("pair", [("peg", "tabel"), ("tabel", "peg")])
def test_an_allowed_pair_of_what_is_no_body_is_reported(start, pair):
    with pytest.raises(UnknownName, match="unknown body or link 'tabel': did you mean 'table'"):
        start.collision.placed(start.state.Ts_world_body, 0.0, allowed=[pair])


def test_what_is_no_pose_is_refused(start):
    Ts = start.state.Ts_world_body
    with pytest.raises(InvalidInput, match="block: not a rigid transform"):
        start.collision.placed({**Ts, "block": np.zeros((4, 4))}, 0.0)
    with pytest.raises(InvalidInput, match="block: not a rigid transform"):
        start.collision.placed(Ts, 0.0, {"block": np.zeros((4, 4))})


@pytest.mark.parametrize("gripper", [-0.1, 1.1, np.nan])
def test_a_gripper_out_of_range_is_refused(start, gripper):
    with pytest.raises(InvalidInput, match="gripper: expected 0"):
        start.collision.placed(start.state.Ts_world_body, gripper)


def test_a_body_of_which_nothing_collides_is_refused(start):
    ghost = Body("ghost", (Shape("sphere", (0.1,), collides=False),))
    with pytest.raises(InvalidInput, match="body 'ghost': no shape of it collides, so nothing"):
        CollisionModel(start.collision.robot, SceneSpec((ghost,)))


@pytest.mark.parametrize("q", [np.zeros(5), np.full(6, np.nan)], ids=["short", "NaN"])
def test_joints_that_are_no_configuration_are_refused(start, q):
    for ask in (start.placed.tool_clearances, start.placed.nearest):
        with pytest.raises(InvalidInput, match="q: "):
            ask(q)


def test_a_robot_part_that_is_not_convex_is_refused(peg_task, monkeypatch):
    build = pin.buildGeomFromUrdf

    def with_a_halfspace(*args, **kwargs):
        loaded = build(*args, **kwargs)
        loaded.geometryObjects[0].geometry = coal.Halfspace(np.array([0, 0, 1.0]), 0.0)
        return loaded

    monkeypatch.setattr(pin, "buildGeomFromUrdf", with_a_halfspace)
    with pytest.raises(
        InvalidInput,
        match="geometry Halfspace is neither a mesh nor a box, sphere or cylinder; use",
    ):
        CollisionModel(get_robot(peg_task.robot), peg_task.scene)


def test_witnesses_can_not_be_changed(start):
    with pytest.raises(ValueError, match="read-only"):
        start.placed.nearest(start.state.q).p_a[0] = 0
