"""Certificates against a cloud: as sound as those against bodies, the balls about its points.

The same balls as bodies of a scene are what these are held against, by coal and by PyBullet.
"""

from __future__ import annotations

from typing import NamedTuple

import hypothesis.strategies as st
import numpy as np
import pytest
from hypothesis import assume, given, settings

from sart_toolkit.collision.certificate import certify
from sart_toolkit.collision.cloud import CloudConfig, SceneCloud
from sart_toolkit.collision.model import CLOUD, CollisionModel
from sart_toolkit.collision.obstacles import CloudObstacles, hull_part
from sart_toolkit.motion.path import PolylinePath, SplinePath
from sart_toolkit.poses import pose
from sart_toolkit.robots import get_robot
from sart_toolkit.robots.spec import Shape
from sart_toolkit.scenes.spec import Body, SceneSpec
from sart_toolkit.testing.closest import ClosestPoints

PROPERTY = settings(deadline=None, derandomize=True, max_examples=30)
# coal's distances; those of bodies that overlap, by another of its algorithms.
ACCURACY, DEPTH_ACCURACY = 3e-6, 1e-4
# What the docstring of `ClosestPoints` says of meshes.
TOO_FAR = 6e-5
DENSE = np.linspace(0, 1, 200)
PATHS = {"spline": SplinePath.through, "polyline": PolylinePath}
BALL = 0.004
ROBOT = "ur5e_2f85"

seeds = st.integers(0, 2**32 - 1)
path_kinds = st.sampled_from(sorted(PATHS))
lengths = st.sampled_from([0.05, 0.3, 1.0])
margins = st.sampled_from([0.0, 0.0002, 0.01])
NOTHING = SceneSpec(())


def obstacles_of(points, inflation=BALL):
    n = len(points)
    config = CloudConfig(inflation=inflation)
    colours = np.zeros((n, 3), np.uint8)
    return CloudObstacles(SceneCloud(np.array(points), colours, np.zeros(n, bool), config))


def random_path(rng, kind, length):
    home = np.array(get_robot(ROBOT).home)
    u = np.linspace(0, 1, 13)[:, None]
    bend = 0.3 * length * np.sin(np.pi * u * rng.integers(1, 4, 6)) * rng.uniform(-1, 1, 6)
    q = home + rng.uniform(-0.5, 0.5, 6) + u * length * rng.uniform(-1, 1, 6) + bend
    return PATHS[kind](q)


class Both(NamedTuple):
    """Some balls as a cloud, and as bodies."""

    cloud: object
    bodies: object
    oracle: ClosestPoints


@pytest.fixture(scope="module")
def worlds():
    """Three worlds of balls about the robot: few, many, and many small ones."""
    made = []
    robot = get_robot(ROBOT)
    for seed, (n, radius) in enumerate([(15, 0.03), (120, BALL), (120, 0.0012)]):
        rng = np.random.default_rng(seed)
        points = rng.uniform([0.1, -0.5, 0.05], [0.9, 0.7, 0.7], (n, 3))
        shapes = tuple(Shape("sphere", (radius,), pose(p)) for p in points)
        scene = SceneSpec((Body("balls", shapes),))
        bodies = CollisionModel(robot, scene).placed({"balls": np.eye(4)}, 0.3)
        cloud = CollisionModel(robot, NOTHING).placed({}, 0.3, cloud=obstacles_of(points, radius))
        oracle = ClosestPoints(robot, scene, joints_apart=2)
        oracle.place({"balls": np.eye(4)}, 0.3)
        made.append(Both(cloud, bodies, oracle))
    yield made
    for each in made:
        each.oracle.close()


def by_part(placed, distances, other):
    """The smallest distance of each moving part from what is called so."""
    least = {}
    for k, distance in enumerate(distances):
        if placed.names(k)[1] == other:
            i = int(placed.pairs[k, 0])
            least[i] = min(distance, least.get(i, np.inf))
    return np.array([least[i] for i in sorted(least)])


# --- distances ----------------------------------------------------------------------------------


@PROPERTY
@given(seed=seeds, which=st.integers(0, 2))
def test_every_part_is_as_far_from_the_cloud_as_from_the_nearest_ball(worlds, seed, which):
    cloud, bodies, _ = worlds[which]
    q = cloud.kinematics.spec.home + np.random.default_rng(seed).uniform(-1, 1, 6)
    found = by_part(cloud, cloud.distances(q), CLOUD)
    exact = by_part(bodies, bodies.distances(q), "balls")
    apart = exact > 0
    np.testing.assert_allclose(found[apart], exact[apart], atol=ACCURACY)
    np.testing.assert_allclose(found[~apart], exact[~apart], atol=DEPTH_ACCURACY)
    some = [k for k in range(len(cloud.pairs)) if cloud.names(k)[1] == CLOUD][::3]
    np.testing.assert_allclose(
        cloud.pair_distances(q, some), cloud.distances(q)[some], atol=ACCURACY
    )


@PROPERTY
@given(seed=seeds, which=st.integers(0, 2))
def test_rough_distances_from_the_cloud_are_never_above_true_ones(worlds, seed, which):
    cloud = worlds[which].cloud
    q = cloud.kinematics.spec.home + np.random.default_rng(seed).uniform(-2, 2, 6)
    every = np.arange(len(cloud.pairs))
    enclosures = cloud.bounds.placed(cloud.joint_poses(q)[None])
    rough = cloud.bounds.rough_distances(enclosures, np.zeros_like(every), every)
    distances = cloud.distances(q)
    assert (rough <= np.maximum(distances, 0) + ACCURACY).all()
    for within in (0.0, 0.01, 0.1):
        assert set(np.flatnonzero(distances < within)) <= set(cloud.near_pairs(q, within))


def test_witnesses_and_gradients_are_those_of_the_nearest_ball(worlds, rng):
    cloud, step = worlds[0].cloud, 1e-5
    pairs = [k for k in range(len(cloud.pairs)) if cloud.names(k)[1] == CLOUD]
    checked = 0
    for _ in range(10):
        q = cloud.kinematics.spec.home + rng.uniform(-0.6, 0.6, 6)
        k = pairs[int(np.argmin(cloud.pair_distances(q, pairs)))]
        found = cloud.witness(q, k)
        (distance,) = cloud.pair_distances(q, [k])
        assert found.pair == cloud.names(k)
        assert found.distance == pytest.approx(distance, abs=1e-9)
        assert np.linalg.norm(found.p_a - found.p_b) == pytest.approx(abs(distance), abs=1e-5)
        others = cloud.witnesses(q, k, 0.05)
        assert others[0].distance == pytest.approx(distance, abs=1e-9)
        assert all(distance <= each.distance <= distance + 0.05 for each in others)
        if distance < 0.002:
            continue
        slopes = [(cloud.pair_distances(q + step * e, [k])[0] - distance) / step for e in np.eye(6)]
        np.testing.assert_allclose(cloud.gradient(q, k), slopes, atol=5e-3)
        checked += 1
    assert checked >= 3


# --- soundness ----------------------------------------------------------------------------------


@PROPERTY
@given(seed=seeds, which=st.integers(0, 2), kind=path_kinds, length=lengths, margin=margins)
def test_a_path_that_is_free_of_the_cloud_is_nowhere_nearer_to_a_ball_than_its_clearance(
    worlds, seed, which, kind, length, margin
):
    cloud, bodies, oracle = worlds[which]
    path = random_path(np.random.default_rng(seed), kind, length)
    certificate = certify(cloud, path, margin)
    assume(certificate.verdict == "free")
    assert certificate.clearance >= margin
    along = path.positions(DENSE)
    assert min(bodies.distances(q).min() for q in along) >= certificate.clearance - ACCURACY
    _, nearest = oracle.nearest_along(along, 0.02)
    assert nearest.distance >= certificate.clearance - TOO_FAR


@PROPERTY
@given(seed=seeds, which=st.integers(0, 2), kind=path_kinds, length=lengths, margin=margins)
def test_a_collision_with_the_cloud_is_one_with_a_ball_or_of_the_robot_with_itself(
    worlds, seed, which, kind, length, margin
):
    cloud, bodies, _ = worlds[which]
    path = random_path(np.random.default_rng(seed), kind, length)
    certificate = certify(cloud, path, margin)
    assume(certificate.verdict == "collision")
    (q,) = path.positions(np.array([certificate.at]))
    assert bodies.distances(q).min() < margin + ACCURACY


@PROPERTY
@given(seed=seeds, which=st.integers(0, 2), kind=path_kinds, length=lengths, margin=margins)
def test_cloud_and_bodies_have_one_verdict(worlds, seed, which, kind, length, margin):
    cloud, bodies, _ = worlds[which]
    path = random_path(np.random.default_rng(seed), kind, length)
    a, b = certify(cloud, path, margin), certify(bodies, path, margin)
    if a.verdict != b.verdict:
        # What just passes one of them is next to the margin.
        least = min(bodies.distances(q).min() for q in path.positions(DENSE))
        assert abs(least - margin) < 1e-4


def sampled_surface(scene, spacing):
    """Points on all faces of the boxes of a scene, none farther from a grid point than half of
    the grid's diagonal.
    """
    points = []
    for body in scene.bodies:
        for shape in body.shapes:
            half = np.array(shape.size) / 2
            T = body.T_world_body @ shape.T_body_shape
            counts = np.maximum(np.ceil(np.array(shape.size) / spacing).astype(int), 1) + 1
            axes = [np.linspace(-h, h, n) for h, n in zip(half, counts, strict=True)]
            for normal in range(3):
                faces = [axes[i] if i != normal else half[i] * np.array([-1, 1]) for i in range(3)]
                grid = np.stack(np.meshgrid(*faces, indexing="ij"), -1).reshape(-1, 3)
                points.append(grid @ T[:3, :3].T + T[:3, 3])
    return np.concatenate(points)


@pytest.fixture(scope="module")
def boxes(clutter):
    """A robot among boxes, exactly, and among points that cover their surfaces."""
    it, spacing = clutter["boxes"], 0.012
    robot = get_robot(it.robot)
    exact = CollisionModel(robot, it.scene).placed(it.Ts_world_body, it.gripper)
    # Every point of a face is in the ball about a corner of its grid cell.
    covering = obstacles_of(sampled_surface(it.scene, spacing), spacing / np.sqrt(2))
    cloud = CollisionModel(robot, NOTHING).placed({}, it.gripper, cloud=covering)
    return exact, cloud


@PROPERTY
@given(seed=seeds, kind=path_kinds, length=lengths, margin=margins)
def test_what_is_clear_of_a_cloud_that_covers_all_surfaces_is_clear_of_the_bodies(
    boxes, seed, kind, length, margin
):
    exact, cloud = boxes
    path = random_path(np.random.default_rng(seed), kind, length)
    certificate = certify(cloud, path, margin)
    assume(certificate.verdict == "free")
    start, *along = path.positions(DENSE)
    # A surface tells nothing of a body that one is inside of already.
    assume(exact.distances(start).min() > 0)
    assert min(exact.distances(q).min() for q in along) >= certificate.clearance - ACCURACY
    assert certify(exact, path, margin).verdict == "free"


# --- what is grasped ----------------------------------------------------------------------------


@pytest.mark.parametrize("slip", [0.0, 0.003])
def test_what_is_grasped_keeps_clear_of_the_cloud_by_its_slip_tolerance(slip):
    collision = CollisionModel(get_robot(ROBOT), NOTHING)
    q = np.array(collision.robot.home)
    T = collision.T_joint_tool
    corners = Shape("box", (0.1, 0.1, 0.1), pose([0, 0, 0.1])).corners()
    part = hull_part("box", 6, corners @ T[:3, :3].T + T[:3, 3])
    # The tool points down; only wrist 3 turns.
    p_below = collision.kinematics.fk(q) @ [0, 0, 0.15, 1]
    points = [p_below[:3] - [0, 0, BALL + 0.01]]
    placed = collision.placed(
        {}, 0.0, slip_tolerance=slip, grasped_parts=(part,), cloud=obstacles_of(points)
    )
    grasped = [k for k in range(len(placed.pairs)) if placed.names(k)[0] == "box"]
    others = [k for k in range(len(placed.pairs)) if placed.names(k)[0] != "box"]
    np.testing.assert_array_equal(placed.slip[grasped], slip)
    assert not placed.slip[others].any()
    # It is held against the arm's links too.
    assert {"forearm_link", CLOUD} <= {placed.names(k)[1] for k in grasped}
    assert placed.tool_clearances(q)[0].pair == ("box", CLOUD)
    path = PolylinePath([q, q + [0, 0, 0, 0, 0, 1.0]])
    assert certify(placed, path, 0.01 - slip - 2e-4).verdict == "free"
    found = certify(placed, path, 0.01 - slip + 2e-4)
    assert (found.verdict, found.pair, found.at) == ("collision", ("box", CLOUD), 0.0)
