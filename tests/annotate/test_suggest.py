from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sart_toolkit.annotate import suggest as suggest_module
from sart_toolkit.annotate.suggest import (
    Gap,
    SuggestConfig,
    certified_radius,
    suggest_annotation,
    suggest_radius,
)
from sart_toolkit.augment.strategies import SART
from sart_toolkit.collision.exact import ExactWorld
from sart_toolkit.data.records import convergence_waypoint
from sart_toolkit.data.sampling import SamplingConfig
from sart_toolkit.errors import InvalidInput
from sart_toolkit.poses import pose


def gap_at(distance, points, normal=(0.0, 0.0, 1.0)):
    """A tool part with its lowest point `distance` above an obstacle that fills all below."""
    points, normal = np.array(points), np.array(normal)
    support = (points @ normal).min() - distance
    return Gap("part", "obstacle", distance, normal, points, support)


vectors = st.tuples(*[st.floats(-1, 1)] * 3)
turns = vectors.filter(lambda v: np.linalg.norm(v) > 0.1)
parts = st.lists(vectors.map(lambda v: 0.2 * np.array(v)), min_size=1, max_size=8)


@settings(max_examples=200, deadline=None, derandomize=True)
@given(
    points=parts,
    distance=st.floats(-0.05, 0.6),
    margin=st.floats(0, 0.02),
    nu=st.floats(0, 30),
    largest=st.floats(0.01, 0.5),
)
def test_the_certified_radius_is_the_largest_that_fits(points, distance, margin, nu, largest):
    gap = gap_at(distance, points)
    r = certified_radius(gap, margin, nu, largest)
    assert 0 <= r <= largest
    assert r == 0 or gap.fits(r, margin, nu)
    assert r == largest or not gap.fits(r + 1e-9, margin, nu)


@settings(max_examples=300, deadline=None, derandomize=True)
@given(
    points=parts,
    normal=turns,
    distance=st.floats(0.001, 0.3),
    margin=st.floats(0, 0.02),
    nu=st.floats(0, 20),
    direction=turns,
    axis=turns,
    share=st.floats(-1, 1),
)
def test_no_pose_within_a_certified_radius_brings_a_part_nearer_than_the_margin(
    points, normal, distance, margin, nu, direction, axis, share
):
    normal = np.array(normal) / np.linalg.norm(normal)
    gap = gap_at(distance, points, normal)
    r = certified_radius(gap, margin, nu, 0.5)
    turn = share * nu * r * np.array(axis) / np.linalg.norm(axis)
    for way in (direction, -normal):
        offset = r * np.array(way) / np.linalg.norm(way)
        moved = gap.points @ pose(rotvec=turn)[:3, :3].T + offset
        nearest = (moved @ normal).min() - gap.support
        assert nearest >= min(margin, distance) - 1e-12


@settings(max_examples=100, deadline=None, derandomize=True)
@given(points=parts, distance=st.floats(0.01, 0.3), nu=st.floats(0, 5))
def test_by_a_plane_a_certified_radius_can_not_be_larger(points, distance, nu):
    """Some turn within nu r really brings the lowest point as near as the proof fears."""
    gap = gap_at(distance, points)
    r = certified_radius(gap, 0.0, nu, 1.0)
    if r == 1.0 or nu * r > 1.0:
        return
    grown = r + 1e-6
    lowest = np.inf
    for x in gap.points:
        across = np.array([x[1], -x[0], 0.0])
        # Straight above or below the origin any level axis does.
        across = across if np.linalg.norm(across) > 1e-9 else np.array([1.0, 0.0, 0.0])
        # Beyond straight down it would rise again.
        left = np.pi - np.arccos(np.clip(x[2] / max(np.linalg.norm(x), 1e-12), -1, 1))
        across *= min(nu * grown, left) / np.linalg.norm(across)
        for turn in (across, -across):
            lowest = min(lowest, (pose(rotvec=turn)[:3, :3] @ x)[2])
    assert lowest - grown - gap.support < 1e-9 + 1e-3 * distance


def suggested(demonstration, scene, *args, **options):
    return suggest_annotation(demonstration, scene, *args, **options)


class Elsewhere:
    """The world of a demonstration with the scene's bodies 5 m below."""

    def __init__(self, demonstration, robot, scene):
        Ts = {k: T @ pose([0, 0, -5]) for k, T in demonstration.body_Ts_world.items()}
        demo = dataclasses.replace(demonstration, body_Ts_world=Ts)
        self.world = ExactWorld(demo, robot, scene)


def test_suggested_spheres_start_at_waypoint_0_and_tile_the_free_part(
    peg_demonstration, peg_annotation
):
    d, spheres = peg_demonstration, peg_annotation.spheres
    peg_annotation.check_matches(d)
    assert spheres[0].waypoint == 0
    config = SuggestConfig()
    for sphere in spheres:
        assert config.min_radius <= sphere.radius <= config.max_radius
        assert sphere.source == "suggested" and sphere.kind == "ball"
        np.testing.assert_array_equal(
            sphere.T_world_key, d.steps.measured_Ts_world_tool[sphere.waypoint]
        )
    assert peg_annotation.settings == dataclasses.asdict(config)


def radius_at(demonstration, world, t):
    return suggest_radius(world, demonstration, t).radius


def test_suggested_spheres_shrink_step_by_step(peg_demonstration, peg_world, peg_annotation):
    """Between far away and touching there is something to correct with, and no more than needed."""
    spheres = peg_annotation.spheres
    assert spheres[0].radius > 8 * min(sphere.radius for sphere in spheres)
    for sphere, following in zip(spheres, spheres[1:], strict=False):
        ahead = convergence_waypoint(peg_demonstration, sphere)
        radii = {
            t: radius_at(peg_demonstration, peg_world, t)
            for t in range(sphere.waypoint + 1, max(ahead, following.waypoint) + 1)
        }
        wide = [t for t in range(sphere.waypoint + 1, ahead + 1) if radii[t] >= sphere.radius / 2]
        if wide:
            assert following.waypoint == wide[-1]
        else:
            # The first that has room at all.
            between = range(sphere.waypoint + 1, following.waypoint)
            assert all(radii[t] < SuggestConfig().min_radius for t in between)


def test_a_funnel_may_be_steeper(peg_demonstration, peg_world, peg_annotation):
    steep = SuggestConfig(shrink=1e9)
    spheres = suggest_annotation(peg_demonstration, peg_world, config=steep).spheres
    assert len(spheres) < len(peg_annotation.spheres)
    for sphere, following in zip(spheres, spheres[1:], strict=False):
        ahead = convergence_waypoint(peg_demonstration, sphere)
        assert following.waypoint >= ahead
        for t in range(ahead, following.waypoint):
            assert radius_at(peg_demonstration, peg_world, t) < steep.min_radius


def test_suggested_lengths_are_whole_micrometres(peg_annotation):
    """The distance library's last digits change with what the process computed before."""
    for sphere in peg_annotation.spheres:
        for length in (sphere.radius, sphere.clearance):
            assert length == round(length, 6)


def test_the_first_sphere_covers_every_placement(peg_task, peg_annotation):
    assert peg_annotation.spheres[0].radius >= np.hypot(*[peg_task.placement_range] * 2)


def test_what_limits_a_radius_is_a_pair_at_the_stated_clearance(
    peg_demonstration, peg_world, peg_annotation
):
    for sphere in peg_annotation.spheres:
        q = peg_demonstration.steps.joint_positions[sphere.waypoint]
        placed = peg_world.placed(sphere.waypoint)
        stated = {}
        for k in placed.tool_pairs():
            found = placed.witness(q, k)
            stated.setdefault(" / ".join(found.pair), []).append(found.distance)
        assert np.abs(np.array(stated[sphere.limited_by]) - sphere.clearance).min() < 2e-6
        assert sphere.radius < sphere.clearance - SuggestConfig().margin + 1e-12


def test_every_pose_that_augmentation_draws_keeps_the_whole_robot_clear(
    peg_demonstration, peg_world, peg_annotation
):
    """Monte Carlo by the paper's distribution, on each sphere and inside it."""
    rng = np.random.default_rng(0)
    margin = SuggestConfig().margin
    for sphere in peg_annotation.spheres:
        placed = peg_world.placed(sphere.waypoint)
        near = peg_demonstration.steps.joint_positions[sphere.waypoint]
        for i in range(60):
            radius = sphere.radius * (1.0 if i % 2 else rng.uniform())
            drawn = dataclasses.replace(sphere, radius=max(radius, 1e-6))
            T = SART.propose(peg_demonstration, [drawn], 0, rng, SamplingConfig()).T_world_sampled
            distances = placed.distances(placed.kinematics.ik(T, near))
            assert distances[placed.tool_pairs()].min() >= margin - 1e-6
            assert distances.min() >= 0


def test_a_little_larger_than_suggested_some_pose_would_touch(
    peg_demonstration, peg_world, peg_annotation
):
    """Draws about straight towards the obstacle, turned so that a near corner comes down."""
    rng = np.random.default_rng(0)
    for sphere in peg_annotation.spheres[:3]:
        assert sphere.limited_by == "peg / block"
        placed = peg_world.placed(sphere.waypoint)
        near = peg_demonstration.steps.joint_positions[sphere.waypoint]
        q_key = peg_demonstration.steps.joint_positions[sphere.waypoint]
        pair = min(placed.tool_pairs(), key=lambda k: placed.pair_distances(q_key, [k])[0])
        T_world_joint = placed.joint_poses(q_key)[-1]
        gap = Gap.of(placed, pair, placed.witness(q_key, pair), T_world_joint)
        corners = gap.points[np.argsort(gap.points @ gap.normal)[:4]]
        grown, least = 1.25 * sphere.radius, np.inf
        for _ in range(400):
            axis = np.cross(corners[rng.integers(4)], gap.normal)
            axis = axis / np.linalg.norm(axis) + rng.normal(0, 0.3, 3)
            turn = rng.choice([-1, 1]) * 2.0 * grown * axis / np.linalg.norm(axis)
            way = -gap.normal + rng.normal(0, 0.15, 3)
            T = sphere.T_world_key.copy()
            T[:3, :3] = pose(rotvec=turn)[:3, :3] @ T[:3, :3]
            T[:3, 3] += grown * way / np.linalg.norm(way)
            least = min(least, placed.distances(placed.kinematics.ik(T, near)).min())
        assert least < 0, sphere


def test_a_rotation_free_augmentation_gets_larger_spheres_and_a_margin_smaller_ones(
    peg_demonstration, peg_world
):
    def first(**changes):
        config = SuggestConfig(**changes)
        return suggested(peg_demonstration, peg_world, [19], config).spheres[0].radius

    assert first(rotation_per_metre=0.0) > first() > first(margin=0.005)


def test_where_nothing_is_near_the_arm_itself_limits_a_radius(
    peg_demonstration, peg_task, peg_model
):
    far = Elsewhere(peg_demonstration, peg_model.spec, peg_task.scene).world
    config = SuggestConfig(max_radius=2.0, rotation_per_metre=0.1)
    found = suggest_radius(far, peg_demonstration, 0, config)
    assert 0.1 < found.radius < 1.0
    assert found.limited_by in ("reach", "singularity", "joint limit") or "link" in found.limited_by
    found = suggest_radius(far, peg_demonstration, 0, SuggestConfig(max_radius=0.05))
    assert (found.radius, found.limited_by) == (0.05, "max_radius")
    assert 0.3 < found.clearance < 5.5


def test_a_joint_limit_and_a_singular_pose_limit_a_radius(
    peg_demonstration, peg_task, peg_model, monkeypatch
):
    far = Elsewhere(peg_demonstration, peg_model.spec, peg_task.scene).world
    q = peg_demonstration.steps.joint_positions[0]
    monkeypatch.setattr(suggest_module, "_LEAST_SINGULAR_VALUE", 1.0)
    found = suggest_radius(far, peg_demonstration, 0)
    assert (found.radius, found.limited_by) == (0.0, "singularity")
    monkeypatch.setattr(far.kinematics, "upper", q + 0.06)
    assert suggest_radius(far, peg_demonstration, 0).limited_by == "joint limit"


def test_the_waypoint_that_a_segment_starts_from_must_be_clear_too(
    peg_demonstration, peg_task, peg_model
):
    """The block stands in the robot's way from one waypoint on."""
    Ts = np.array(peg_demonstration.body_Ts_world["block"])
    Ts[12:, 2, 3] += 0.15
    demo = dataclasses.replace(
        peg_demonstration, body_Ts_world={**peg_demonstration.body_Ts_world, "block": Ts}
    )
    scene = ExactWorld(demo, peg_model.spec, peg_task.scene)
    found = suggest_radius(scene, demo, 0)
    p = demo.steps.measured_Ts_world_tool[:, :3, 3]
    assert "at waypoint" in found.limited_by
    assert found.radius < np.linalg.norm(p[12] - p[0])


def test_chosen_waypoints_are_annotated_in_order_without_repeats(peg_demonstration, peg_world):
    seen = []
    annotation = suggested(peg_demonstration, peg_world, [10, 0, 10], progress=seen.append)
    assert [sphere.waypoint for sphere in annotation.spheres] == seen == [0, 10]


@pytest.mark.parametrize("probes", [1, 10, 64])
def test_any_number_of_probes_works_without_a_warning(
    peg_task, peg_world, peg_demonstration, probes
):
    annotation = suggested(peg_demonstration, peg_world, [0], SuggestConfig(probes=probes))
    assert annotation.spheres[0].radius > peg_task.placement_range


@pytest.mark.parametrize("waypoint", [-1, 10_000])
def test_a_waypoint_outside_the_demonstration_is_refused(peg_world, peg_demonstration, waypoint):
    with pytest.raises(InvalidInput, match=rf"waypoint {waypoint}: expected 0 to \d+"):
        suggested(peg_demonstration, peg_world, [waypoint])


def test_the_last_waypoint_is_refused_for_nothing_follows_it(peg_world, peg_demonstration):
    last = len(peg_demonstration) - 1
    with pytest.raises(InvalidInput, match=f"waypoint {last}: expected 0 to {last - 1}"):
        suggested(peg_demonstration, peg_world, [last])


def test_where_no_waypoint_has_room_the_error_says_what_to_do(peg_world, peg_demonstration):
    config = SuggestConfig(min_radius=0.5, max_radius=0.5)
    with pytest.raises(InvalidInput, match="no waypoint has room for a sphere of 500.0 mm"):
        suggested(peg_demonstration, peg_world, config=config)
    with pytest.raises(InvalidInput, match="waypoint 0: no room .* clearance .* mm"):
        suggested(peg_demonstration, peg_world, [0], config=config)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"margin": 0.0}, "margin: expected a finite number > 0"),
        ({"margin": np.nan}, "margin: expected a finite number > 0"),
        ({"min_radius": -1.0}, "min_radius: expected a finite number > 0"),
        ({"max_radius": np.inf}, "max_radius: expected a finite number > 0"),
        ({"max_radius": 0.001}, "max_radius 0.001 m is below min_radius"),
        ({"rotation_per_metre": -1.0}, "rotation_per_metre: expected"),
        ({"rotation_per_metre": np.nan}, "rotation_per_metre: expected"),
        ({"rotation_per_metre": np.inf}, "rotation_per_metre: expected"),
        ({"shrink": 1.0}, "shrink: expected a factor above 1, got 1.0"),
        ({"shrink": np.nan}, "shrink: expected a factor above 1, got nan"),
        ({"probes": 0}, "probes: expected at least 1"),
    ],
)
def test_a_bad_setting_is_refused(changes, message):
    with pytest.raises(InvalidInput, match=message):
        SuggestConfig(**changes)
