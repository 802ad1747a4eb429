"""Certificates: what is called free is free, what is called a collision is one, and few are open.

The bound that all rests on, how far any point of one body can move as seen from another, is held
against densely sampled motions.
"""

from __future__ import annotations

import dataclasses
import json
from contextlib import ExitStack

import hypothesis.strategies as st
import numpy as np
import pytest
from hypothesis import assume, given, settings
from scipy.optimize import minimize_scalar

from sart_toolkit.collision.certificate import Certificate, _Knots, _Search, certify
from sart_toolkit.collision.model import CollisionModel
from sart_toolkit.errors import InvalidInput, MotionRejected
from sart_toolkit.motion.path import PolylinePath, SplinePath
from sart_toolkit.poses import pose
from sart_toolkit.robots import get_robot
from sart_toolkit.robots.spec import Shape
from sart_toolkit.scenes.spec import Body, SceneSpec
from sart_toolkit.testing.closest import ClosestPoints

PROPERTY = settings(deadline=None, derandomize=True, max_examples=40)
# coal's distances.
ACCURACY = 3e-6
# What the docstring of `ClosestPoints` says of meshes.
TOO_FAR, TOO_NEAR = 6e-5, 5e-6
DENSE = np.linspace(0, 1, 300)

seeds = st.integers(0, 2**32 - 1)
kinds = st.sampled_from(["boxes", "rods", "shelf", "mixed"])
bends = st.sampled_from([0.0, 0.05, 0.4])
lengths = st.sampled_from([0.05, 0.3, 1.0])
ARM = ("shoulder_link", "upper_arm_link", "forearm_link", "wrist_1_link", "wrist_2_link")
PATHS = {"spline": SplinePath.through, "polyline": PolylinePath}
path_kinds = st.sampled_from(sorted(PATHS))


def random_configurations(placed, rng, length, bend, n=13, spread=0.8):
    """Configurations `(n, joints)` along a way near home that bends, and may turn back."""
    home = placed.kinematics.spec.home
    start = home + rng.uniform(-spread, spread, len(home))
    u = np.linspace(0, 1, n)[:, None]
    waves = np.sin(np.pi * u * rng.integers(1, 5, len(home)))
    straight = u * length * rng.uniform(-1, 1, len(home))
    return start + straight + bend * rng.uniform(-1, 1, len(home)) * waves


def random_path(placed, rng, kind, length, bend):
    return PATHS[kind](random_configurations(placed, rng, length, bend))


def nearest_on(placed, path, s=DENSE):
    """The smallest distance of any pair at any of the path's configurations."""
    return min(placed.distances(q).min() for q in path.positions(s))


@pytest.fixture(scope="module")
def rods():
    """The robot carrying a rod or a ball, and a rod or a ball that stands."""
    shapes = {
        "rod": Shape("cylinder", (0.002, 0.4)),
        "wire": Shape("cylinder", (0.003, 0.5)),
        "bob": Shape("sphere", (0.03,)),
        "ball": Shape("sphere", (0.05,)),
    }
    bodies = tuple(Body(name, (shape,), mass=0.1) for name, shape in shapes.items())
    collision = CollisionModel(get_robot("ur5e_2f85"), SceneSpec(bodies))
    names = {part.body for part in collision.placed(dict.fromkeys(shapes, np.eye(4)), 0.0).parts}

    def place(grasped, T_tool_grasped, standing, T_world_standing):
        """Only these two are considered, or, where they are one, nothing."""
        pair = {grasped, standing}
        allowed = [(a, b) for a in names for b in names if {a, b} != pair or len(pair) == 1]
        Ts = {**dict.fromkeys(shapes, np.eye(4)), standing: T_world_standing}
        return collision.placed(Ts, 0.0, {grasped: T_tool_grasped}, allowed)

    return place


# --- the bound on motion ------------------------------------------------------------------------


def moved(placed, path, s_lo, s_hi, k, n=80):
    """How far points of a pair's first part go from an interval's start, and then on to its end.

    As seen from the second one's joint, the farthest of all points and of all parameters between.
    """
    i, j = placed.pairs[k]
    a, b = placed.parts[i], placed.parts[j]
    Ts = np.array([placed.joint_poses(q) for q in path.positions(np.linspace(s_lo, s_hi, n))])
    R_a, p_a, R_b, p_b = (
        Ts[:, joint, :3, part] for joint in (a.joint, b.joint) for part in (slice(3), 3)
    )
    world = np.einsum("sij,kj->ski", R_a, a.points[:: max(1, len(a.points) // 100)]) + p_a[:, None]
    local = np.einsum("sji,skj->ski", R_b, world - p_b[:, None])
    away = np.linalg.norm(local - local[0], axis=2) + np.linalg.norm(local[-1] - local, axis=2)
    return away.max()


def motion_bounds(placed, path, s_lo, s_hi, pairs):
    """mu, and what spheres and boxes prove, of pairs on one interval."""
    search = _Search(placed, path, 0.0, 1)
    search._knots = _Knots.at(placed, path, np.array([s_lo, s_hi]))
    return search._motion(np.array([[0], [1]]), np.zeros(len(pairs), np.intp), np.asarray(pairs))


@settings(PROPERTY, max_examples=60)
@given(seed=seeds, kind=kinds, path_kind=path_kinds, length=lengths, bend=bends)
def test_no_point_moves_farther_than_the_bound(cluttered, seed, kind, path_kind, length, bend):
    placed, rng = cluttered[kind], np.random.default_rng(seed)
    path = random_path(placed, rng, path_kind, length, bend)
    s_lo = rng.uniform(0, 0.9)
    s_hi = s_lo + rng.uniform(0.01, 1 - s_lo) ** rng.integers(1, 3)
    self_pairs = np.flatnonzero(placed.bounds.joint_b > 0)
    pairs = np.concatenate([
        rng.choice(len(placed.pairs), 6, replace=False),
        rng.choice(self_pairs, 6, replace=False),
    ])  # fmt: skip
    mu, _ = motion_bounds(placed, path, s_lo, s_hi, pairs)
    for k, bound in zip(pairs, mu, strict=True):
        assert moved(placed, path, s_lo, s_hi, k) <= bound + 1e-9, placed.names(k)


@PROPERTY
@given(seed=seeds, kind=kinds, joint=st.integers(0, 5), angle=st.floats(0.01, 3))
def test_one_joint_turning_moves_points_along_arcs_no_longer_than_the_bound(
    cluttered, seed, kind, joint, angle
):
    placed, rng = cluttered[kind], np.random.default_rng(seed)
    start = placed.kinematics.spec.home + rng.uniform(-1, 1, 6)
    path = PolylinePath([start, start + angle * np.eye(6)[joint]])
    pairs = rng.choice(len(placed.pairs), 8, replace=False)
    mu, _ = motion_bounds(placed, path, 0.0, 1.0, pairs)
    for k, bound in zip(pairs, mu, strict=True):
        between = placed.bounds.joint_b[k] <= joint < placed.bounds.joint_a[k]
        if not between:
            # What doesn't lie between two bodies moves neither as seen from the other.
            assert bound < 1e-9
        far = moved(placed, path, 0.0, 1.0, k)
        assert far <= bound + 1e-9
        # And the bound is of use.
        if between and angle < 0.5:
            assert bound <= 2 * angle * placed.bounds.reach[k, joint]


@settings(PROPERTY, max_examples=30)
@given(seed=seeds, kind=kinds, path_kind=path_kinds, length=lengths, bend=bends)
def test_what_spheres_and_boxes_prove_of_a_pair_on_an_interval_is_so(
    cluttered, seed, kind, path_kind, length, bend
):
    placed, rng = cluttered[kind], np.random.default_rng(seed)
    path = random_path(placed, rng, path_kind, length, bend)
    s_lo = rng.uniform(0, 0.8)
    s_hi = s_lo + rng.uniform(0.01, 0.2)
    pairs = np.arange(len(placed.pairs))
    _, proved = motion_bounds(placed, path, s_lo, s_hi, pairs)
    between = path.positions(np.linspace(s_lo, s_hi, 12))
    smallest = np.min([placed.distances(q) for q in between], axis=0)
    assert (proved <= np.maximum(smallest, 0) + ACCURACY).all()
    if length == 0.05 and bend == 0:
        assert (proved > 0.01).mean() > 0.3


# --- soundness ----------------------------------------------------------------------------------


@settings(PROPERTY, max_examples=16)
@given(
    seed=seeds, kind=kinds, path_kind=path_kinds, length=lengths, bend=bends,
    margin=st.sampled_from([0.0, 0.002, 0.015]),
)  # fmt: skip
def test_a_free_path_is_nowhere_nearer_than_its_clearance(
    cluttered, seed, kind, path_kind, length, bend, margin
):
    placed, rng = cluttered[kind], np.random.default_rng(seed)
    path = random_path(placed, rng, path_kind, length, bend)
    certificate = certify(placed, path, margin)
    assume(certificate.verdict == "free")
    assert certificate.clearance >= margin
    assert certificate.margin == margin
    assert nearest_on(placed, path) >= certificate.clearance - ACCURACY


@pytest.fixture(scope="module")
def pybullet(clutter):
    """PyBullet's closest points in each kind of clutter."""
    with ExitStack() as stack:
        found = {}
        for kind, it in clutter.items():
            points = ClosestPoints(get_robot(it.robot), it.scene)
            stack.callback(points.close)
            points.place(it.Ts_world_body, it.gripper)
            found[kind] = points
        yield found


@settings(PROPERTY, max_examples=60)
@given(seed=seeds, kind=kinds, path_kind=path_kinds, length=lengths, bend=bends)
def test_pybullet_finds_nothing_on_a_free_path_and_something_where_there_is_a_collision(
    cluttered, pybullet, seed, kind, path_kind, length, bend
):
    placed, rng = cluttered[kind], np.random.default_rng(seed)
    path = random_path(placed, rng, path_kind, length, bend)
    certificate = certify(placed, path)
    if certificate.verdict == "free":
        _, nearest = pybullet[kind].nearest_along(path.positions(DENSE))
        assert nearest.distance >= certificate.clearance - TOO_NEAR
    else:
        assert certificate.verdict == "collision"
        (q,) = path.positions(np.array([certificate.at]))
        assert pybullet[kind].pair(q, *certificate.pair) <= certificate.clearance + TOO_FAR


@settings(PROPERTY, max_examples=40)
@given(
    seed=seeds, kind=kinds, path_kind=path_kinds, length=lengths, bend=bends,
    margin=st.sampled_from([0.0, 0.002, 0.015]),
)  # fmt: skip
def test_a_collision_is_where_it_is_said_to_be(
    cluttered, seed, kind, path_kind, length, bend, margin
):
    placed, rng = cluttered[kind], np.random.default_rng(seed)
    path = random_path(placed, rng, path_kind, length, bend)
    certificate = certify(placed, path, margin)
    assume(certificate.verdict == "collision")
    (q,) = path.positions(np.array([certificate.at]))
    distances = placed.distances(q)
    named = [k for k in range(len(placed.pairs)) if placed.names(k) == certificate.pair]
    assert distances[named].min() < margin
    assert np.abs(distances[named] - certificate.clearance).min() < ACCURACY
    at_the_start = placed.distances(path.positions(np.zeros(1))[0]).min()
    assert (at_the_start < margin) == (certificate.at == 0)


@PROPERTY
@given(seed=seeds, bend=bends, path_kind=path_kinds)
def test_two_balls_are_proved_as_far_apart_as_they_are_and_no_farther(rods, seed, bend, path_kind):
    rng = np.random.default_rng(seed)
    T_tool, p_ball = pose(rng.uniform(-0.3, 0.3, 3)), rng.uniform([0.2, -0.4, 0], [0.8, 0.4, 0.6])
    placed = rods("bob", T_tool, "ball", pose(p_ball))
    assert [placed.names(k) for k in range(len(placed.pairs))] == [("bob", "ball")]
    path = random_path(placed, rng, path_kind, 1.0, bend)

    def distance(s):
        (q,) = path.positions(np.array([s]))
        return np.linalg.norm((placed.kinematics.fk(q) @ T_tool)[:3, 3] - p_ball) - 0.08

    sampled = [distance(s) for s in DENSE]
    at = int(np.argmin(sampled))
    around = DENSE[max(at - 1, 0)], DENSE[min(at + 1, 299)]
    least = min(minimize_scalar(distance, around, around, method="bounded").fun, min(sampled))
    assume(least > 1e-4)
    below = certify(placed, path, least - 2e-5)
    assert below.verdict == "free"
    assert least - 2e-5 <= below.clearance <= least
    assert certify(placed, path, least + 2e-5).verdict == "collision"


# --- what sampling misses -----------------------------------------------------------------------


@pytest.fixture(scope="module")
def crossing(rods, peg_model):
    """A sweep of a rod in the grasp across a wire at `s`.

    The wire is `down` [m] below the rod's middle, or `above` below its lower end.
    """
    T_tool_rod = pose([0, 0, 0.45])
    q = np.array([-1.0, -1.7, 1.9, -1.77, -np.pi / 2, 0.0])
    sweep = np.array([q, q + [2.0, 0, 0, 0, 0, 0]])

    def make(s, above, down):
        T_world_rod = peg_model.fk(sweep[0] + s * (sweep[1] - sweep[0])) @ T_tool_rod
        # From the robot outwards.
        outwards = T_world_rod[:3, 3] * [1, 1, 0]
        wire = np.eye(4)
        wire[:3, 2] = outwards / np.linalg.norm(outwards)
        wire[:3, 1] = [0, 0, 1]
        wire[:3, 0] = np.cross(wire[:3, 1], wire[:3, 2])
        wire[:3, 3] = T_world_rod[:3, 3] - [0, 0, down if above is None else 0.203 + above]
        return sweep, rods("rod", T_tool_rod, "wire", wire)

    return make


@pytest.mark.parametrize("kind", sorted(PATHS))
@PROPERTY
@given(s=st.floats(0.02, 0.98), down=st.floats(-0.15, 0.15))
def test_a_rod_that_is_passed_through_within_a_hundredth_of_the_path_is_found(
    crossing, kind, s, down
):
    sweep, placed = crossing(s, None, down)
    path = PATHS[kind](sweep if kind == "polyline" else np.linspace(*sweep, 13))
    certificate = certify(placed, path)
    assert certificate.verdict == "collision"
    assert certificate.pair == ("rod", "wire")
    assert abs(certificate.at - s) < 0.01
    # At a few per cent from there nothing is to be seen.
    for away in (-0.02, 0.02):
        assert placed.distances(path.positions(np.array([s + away]))[0]).min() > 0.003


@PROPERTY
@given(s=st.floats(0, 1), above=st.floats(2e-5, 0.005))
def test_a_rod_that_is_passed_by_a_hair_is_no_collision(crossing, s, above):
    sweep, placed = crossing(s, above, None)
    certificate = certify(placed, PolylinePath(sweep), above / 2)
    assert certificate.verdict == "free"
    assert above / 2 <= certificate.clearance <= above + 1e-6


def test_hardly_any_path_is_rejected_that_keeps_a_millimetre_more_than_is_asked_for(
    cluttered, pybullet
):
    rng, attempted, refused = np.random.default_rng(5), 0, 0
    while attempted < 200:
        kind = list(cluttered)[attempted % 4]
        placed = cluttered[kind]
        path = random_path(placed, rng, sorted(PATHS)[attempted % 2], 0.3, 0.05)
        _, nearest = pybullet[kind].nearest_along(path.positions(DENSE[::8]), 0.02)
        # Wrist 1 and wrist 3, which PyBullet doesn't compare, are 18 mm apart.
        clearance = min(nearest.distance, 0.018)
        if clearance < 0.0012:
            continue
        margin = clearance - 0.001 - TOO_FAR
        certificate = certify(placed, path, max(margin, 0.0))
        attempted += 1
        # Between samples the path may be nearer than it seemed, as a collision then shows.
        refused += certificate.verdict == "undecided"
        if certificate.verdict == "collision":
            (q,) = path.positions(np.array([certificate.at]))
            assert placed.distances(q).min() < margin
    assert refused <= 4


# --- special paths ------------------------------------------------------------------------------


@settings(PROPERTY, max_examples=16)
@given(seed=seeds, kind=kinds, path_kind=path_kinds)
def test_a_path_that_turns_back_is_judged_by_where_it_went(cluttered, seed, kind, path_kind):
    placed, rng = cluttered[kind], np.random.default_rng(seed)
    start = placed.kinematics.spec.home
    end = start + rng.uniform(-1, 1, 6)
    u = np.linspace(0, 1, 13)[:, None]
    # Knots at thirds, halves and quarters of the path see the same configuration twice.
    there_and_back = start + (1 - np.abs(2 * u - 1)) * (end - start)
    path = PATHS[path_kind](there_and_back)
    certificate = certify(placed, path)
    least = nearest_on(placed, path, np.linspace(0, 0.5, 60))
    if certificate.verdict == "free":
        assert least >= certificate.clearance - ACCURACY
    else:
        assert certificate.verdict == "collision"
        (q,) = path.positions(np.array([certificate.at]))
        assert placed.distances(q).min() < 0
    if least < 0:
        assert certificate.verdict == "collision"


@pytest.mark.parametrize("kind", sorted(PATHS))
def test_a_path_without_motion_is_as_clear_as_its_one_configuration(cluttered, kind, rng):
    verdicts = []
    for placed in cluttered.values():
        for _ in range(15):
            q = placed.kinematics.spec.home + rng.uniform(-0.8, 0.8, 6)
            path = PATHS[kind](np.tile(q, (6, 1)))
            distance = placed.distances(q).min()
            certificate = certify(placed, path)
            verdicts.append(certificate.verdict)
            if distance < 0:
                assert (certificate.verdict, certificate.at) == ("collision", 0.0)
                assert certificate.clearance < 0
            else:
                assert certificate.verdict == "free"
                # What is far is bounded by spheres and boxes.
                least = min(distance, 0.005)
                assert least - 1e-5 <= certificate.clearance <= distance + ACCURACY
                assert certify(placed, path, distance + 1e-5).verdict == "collision"
                assert certify(placed, path, distance - 1e-5).verdict == "free"
    assert {"free", "collision"} == set(verdicts)


@PROPERTY
@given(seed=seeds, kind=kinds, length=lengths, bend=bends)
def test_a_spline_and_a_polyline_sampled_from_it_have_one_verdict(
    cluttered, seed, kind, length, bend
):
    placed, rng = cluttered[kind], np.random.default_rng(seed)
    spline = random_path(placed, rng, "spline", length, bend)
    polyline = PolylinePath(spline.positions(np.linspace(0, 1, 400)))
    a, b = certify(placed, spline), certify(placed, polyline)
    # They differ by less than 0.02 mm.
    if a.verdict != b.verdict:
        assert abs(nearest_on(placed, spline)) < 1e-4
    elif a.verdict == "free":
        assert certify(placed, polyline, max(0.0, a.clearance - 1e-4)).verdict == "free"


@PROPERTY
@given(seed=seeds, kind=kinds, path_kind=path_kinds, length=lengths, bend=bends)
def test_backwards_a_path_has_the_same_verdict(cluttered, seed, kind, path_kind, length, bend):
    placed, rng = cluttered[kind], np.random.default_rng(seed)
    q = random_configurations(placed, rng, length, bend)
    a, b = certify(placed, PATHS[path_kind](q)), certify(placed, PATHS[path_kind](q[::-1]))
    assert a.verdict == b.verdict
    if a.verdict == "free":
        assert a.clearance == pytest.approx(b.clearance, abs=1e-3)


def test_where_there_is_nothing_to_hit_all_is_free(rods):
    placed = rods("bob", np.eye(4), "bob", np.eye(4))
    assert len(placed.pairs) == 0
    certificate = certify(placed, PolylinePath([np.zeros(6), np.ones(6)]), 0.1)
    assert (certificate.verdict, certificate.clearance) == ("free", np.inf)
    assert (certificate.pair, certificate.checks) == (("", ""), 0)
    certificate.check_free()


@pytest.mark.parametrize("slip", [0.0, 0.003])
def test_what_is_grasped_is_proved_clear_by_its_slip_and_the_margin(slip):
    box, table = Shape("box", (0.1, 0.1, 0.1)), Shape("box", (4, 4, 0.1))
    bodies = (Body("box", (box,), mass=0.1), Body("table", (table,)))
    collision = CollisionModel(get_robot("ur5e_2f85"), SceneSpec(bodies))
    q = collision.robot.home
    T_tool_box = pose([0, 0, 0.1])
    # It turns level: only wrist 3 moves, and the tool points down.
    lowest = (collision.kinematics.fk(q) @ T_tool_box @ [0, 0, 0.05, 1])[2]
    T_world_table = pose([0, 0, lowest - 0.05 - 0.004])
    placed = collision.placed(
        {"table": T_world_table}, 0.0, {"box": T_tool_box},
        [("base_link_inertia", "table"), *((part, "table") for part in ARM)], slip,
    )  # fmt: skip
    path = PolylinePath([q, q + [0, 0, 0, 0, 0, 1.0]])
    assert certify(placed, path, 0.004 - slip - 2e-4).verdict == "free"
    assert certify(placed, path, 0.004 - slip + 2e-4).verdict == "collision"


# --- margin and effort --------------------------------------------------------------------------


@settings(PROPERTY, max_examples=20)
@given(seed=seeds, kind=kinds, length=lengths, bend=bends)
def test_the_more_margin_is_asked_for_the_less_is_free(cluttered, seed, kind, length, bend):
    placed, rng = cluttered[kind], np.random.default_rng(seed)
    path = random_path(placed, rng, "spline", length, bend)
    verdicts = [certify(placed, path, margin).verdict for margin in (0, 0.003, 0.008, 0.017, 0.05)]
    free = [verdict == "free" for verdict in verdicts]
    assert free == sorted(free, reverse=True)
    # Wrist 1 and wrist 3 are 18 mm apart, whatever they do.
    assert verdicts[-1] == "collision"


def test_without_enough_distances_nothing_is_decided(cluttered):
    placed = cluttered["boxes"]
    path = PolylinePath(placed.kinematics.spec.home + [np.zeros(6), np.full(6, 0.05)])
    full = certify(placed, path)
    assert full.verdict == "free"
    assert full.checks > 5
    few = certify(placed, path, max_checks=5)
    assert few.verdict == "undecided"
    assert few.checks <= 5
    assert all(few.pair)
    assert certify(placed, path, max_checks=2 * full.checks) == full


@settings(PROPERTY, max_examples=25)
@given(seed=seeds, kind=kinds, path_kind=path_kinds, checks=st.integers(1, 3000))
def test_no_more_distances_are_computed_than_are_allowed(cluttered, seed, kind, path_kind, checks):
    placed, rng = cluttered[kind], np.random.default_rng(seed)
    path = random_path(placed, rng, path_kind, 1.0, 0.4)
    few, full = certify(placed, path, max_checks=checks), certify(placed, path)
    assert few.checks <= checks
    # With fewer of them a path is undecided, or judged as with many.
    assert few.verdict in ("undecided", full.verdict)


def test_the_same_path_has_the_same_certificate_in_every_fresh_model(clutter):
    it = clutter["shelf"]
    found = []
    for _ in range(2):
        collision = CollisionModel(get_robot(it.robot), it.scene)
        placed = collision.placed(it.Ts_world_body, it.gripper)
        path = random_path(placed, np.random.default_rng(0), "spline", 0.3, 0.05)
        found.append(certify(placed, path))
    assert found[0] == found[1]


@pytest.mark.parametrize("margin", [-1e-9, np.nan, np.inf])
def test_a_margin_that_is_negative_or_not_finite_is_refused(start, margin):
    path = PolylinePath([start.state.q, start.state.q])
    with pytest.raises(InvalidInput, match="margin: expected a finite number >= 0 m, got"):
        certify(start.placed, path, margin)


def test_no_distances_at_all_are_refused(start):
    path = PolylinePath([start.state.q, start.state.q])
    with pytest.raises(InvalidInput, match="max_checks: expected a finite number > 0"):
        certify(start.placed, path, max_checks=0)


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_a_path_that_is_not_finite_is_refused(start, bad):
    class Broken(PolylinePath):
        def positions(self, s):
            return np.where(np.asarray(s)[:, None] > 0.5, bad, super().positions(s))

    with pytest.raises(InvalidInput, match="joint path: has NaN or infinite entries; remove"):
        certify(start.placed, Broken([start.state.q, start.state.q]))


# --- the record ---------------------------------------------------------------------------------

FREE = Certificate("free", 0.0123456789, 0.002, ("peg", "block"), 0.0, 120)


@pytest.mark.parametrize("verdict", ["free", "collision", "undecided"])
@given(clearance=st.floats(-0.1, 1), margin=st.floats(0, 0.1), at=st.floats(0, 1))
@settings(PROPERTY, max_examples=20)
def test_a_certificate_survives_json_its_clearance_rounded_down(verdict, clearance, margin, at):
    certificate = Certificate(verdict, clearance, margin, ("a", "b"), at, 7)
    value = json.loads(json.dumps(certificate.to_json(), allow_nan=False))
    back = Certificate.from_json(value)
    assert back == dataclasses.replace(certificate, clearance=back.clearance)
    assert clearance - 1.001e-5 <= back.clearance <= clearance + 1e-11
    assert Certificate.from_json(back.to_json()).clearance == pytest.approx(
        back.clearance, abs=2e-6
    )


@pytest.mark.parametrize("missing", ["verdict", "clearance", "margin", "pair", "at", "checks"])
def test_json_without_a_field_is_refused(missing):
    value = FREE.to_json()
    del value[missing]
    with pytest.raises(
        InvalidInput, match=f"certificate: a field is missing or unknown.*{missing}"
    ):
        Certificate.from_json(value)


def test_json_with_an_unknown_field_is_refused():
    with pytest.raises(InvalidInput, match="certificate: a field is missing or unknown.*colour"):
        Certificate.from_json({**FREE.to_json(), "colour": "red"})


def test_a_free_certificate_is_let_through():
    FREE.check_free()


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"at": 0.0}, "^start too close peg / block: 12.3 mm apart, 2.0 mm are asked for; start"),
        ({"at": 0.5}, "^path too close peg / block: 12.3 mm apart, 2.0 mm are .*, 50% along; use"),
        ({"at": 0.0, "clearance": -0.004}, "^start too close peg / block: they overlap by 4.0 mm"),
        ({"at": 0.5, "clearance": -0.004}, "^path too close .*: they overlap by 4.0 mm, 50% along"),
        ({"verdict": "undecided"}, "^undecided peg / block: after 120 distances; use a smaller"),
    ],
)
def test_a_rejection_says_which_pair_where_and_by_how_much(changes, message):
    certificate = dataclasses.replace(FREE, **{"verdict": "collision", **changes})
    with pytest.raises(MotionRejected, match=message):
        certificate.check_free()
