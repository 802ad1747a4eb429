from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sart_toolkit.augment.strategies import SamplingConfig, sart
from sart_toolkit.errors import InvalidInput
from sart_toolkit.poses import pose
from sart_toolkit.records import convergence_waypoint
from sart_toolkit.robots.model import RobotModel
from sart_toolkit.scene.clearance import ClearanceModel
from sart_toolkit.teach.suggest import (
    SuggestConfig,
    certified_radius,
    suggest_annotation,
    suggest_radius,
)


def _swept(r, reach, nu):
    return r + 2 * reach * np.sin(min(nu * r, np.pi) / 2)


@settings(max_examples=300, deadline=None, derandomize=True)
@given(
    clearance=st.floats(-0.05, 0.6),
    reach=st.floats(0, 0.4),
    margin=st.floats(0, 0.02),
    nu=st.floats(0, 30),
    largest=st.floats(0.01, 0.5),
)
def test_the_certified_radius_is_the_largest_whose_sweep_fits_the_clearance(
    clearance, reach, margin, nu, largest
):
    r = certified_radius(clearance, reach, margin, nu, largest)
    assert 0 <= r <= largest
    if r > 0:
        assert _swept(r, reach, nu) + margin <= clearance
    if r < largest:
        assert _swept(r + 1e-9, reach, nu) + margin > clearance - 1e-12


@settings(max_examples=100, deadline=None, derandomize=True)
@given(
    direction=st.tuples(*[st.floats(-1, 1)] * 3).filter(lambda v: np.linalg.norm(v) > 0.1),
    axis=st.tuples(*[st.floats(-1, 1)] * 3).filter(lambda v: np.linalg.norm(v) > 0.1),
    point=st.tuples(*[st.floats(-1, 1)] * 3),
    r=st.floats(0.001, 0.3),
    nu=st.floats(0, 20),
    share=st.floats(-1, 1),
)
def test_no_point_of_a_body_moves_farther_than_the_certificate_allows(
    direction, axis, point, r, nu, share
):
    point = 0.2 * np.array(point)
    moved = r * np.array(direction) / np.linalg.norm(direction) + pose(
        rotvec=share * nu * r * np.array(axis) / np.linalg.norm(axis)
    )[:3, :3] @ (point)
    assert np.linalg.norm(moved - point) <= _swept(r, np.linalg.norm(point), nu) + 1e-12


@pytest.fixture(scope="module")
def clearances(peg_task, peg_model, peg_demonstration):
    """Clearance with the gripper as measured at a waypoint."""

    def at(t):
        gripper = float(peg_demonstration.steps.measured_gripper[t])
        return ClearanceModel(
            RobotModel(peg_model.spec, peg_task.scene.held, gripper), peg_task.scene
        )

    return at


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
    for sphere, following in zip(spheres, spheres[1:], strict=False):
        assert following.waypoint >= convergence_waypoint(d, sphere)
    assert peg_annotation.settings == dataclasses.asdict(config)


def test_between_two_spheres_no_waypoint_has_room(
    peg_task, peg_model, peg_demonstration, peg_annotation
):
    spheres = peg_annotation.spheres
    for sphere, following in zip(spheres, spheres[1:], strict=False):
        for t in range(convergence_waypoint(peg_demonstration, sphere), following.waypoint):
            with pytest.raises(InvalidInput, match="no room"):
                suggest_annotation(peg_demonstration, peg_model.spec, peg_task.scene, [t])


def test_suggested_lengths_are_whole_micrometres(peg_annotation):
    """The distance library's last digits change with what the process computed before."""
    for sphere in peg_annotation.spheres:
        for length in (sphere.radius, sphere.clearance):
            assert length == round(length, 6)


def test_the_first_sphere_covers_every_placement(peg_task, peg_annotation):
    assert peg_annotation.spheres[0].radius >= np.hypot(*[peg_task.placement_range] * 2)


def test_what_limits_a_radius_is_a_pair_at_the_stated_clearance(
    peg_demonstration, peg_annotation, clearances
):
    for sphere in peg_annotation.spheres:
        t = sphere.waypoint
        bodies = {name: Ts[t] for name, Ts in peg_demonstration.body_Ts_world.items()}
        q = peg_demonstration.steps.joint_positions[t]
        pairs = [body.nearest for body in clearances(t).tool_clearances(q, bodies)]
        stated = {f"{pair.a} / {pair.b}": pair.distance for pair in pairs}
        assert stated[sphere.limited_by] == pytest.approx(sphere.clearance, abs=5e-4)
        assert sphere.radius < sphere.clearance - SuggestConfig().margin + 1e-12


def test_every_pose_that_augmentation_draws_keeps_tool_and_arm_clear(
    peg_demonstration, peg_annotation, clearances
):
    """Monte Carlo by the paper's law, on each sphere and inside it."""
    rng = np.random.default_rng(0)
    margin = SuggestConfig().margin
    for sphere in peg_annotation.spheres:
        t = sphere.waypoint
        model = clearances(t)
        bodies = {name: Ts[t] for name, Ts in peg_demonstration.body_Ts_world.items()}
        for i in range(60):
            radius = sphere.radius * (1.0 if i % 2 else rng.uniform())
            drawn = dataclasses.replace(sphere, radius=max(radius, 1e-6))
            T = sart(peg_demonstration, drawn, rng, SamplingConfig()).T_world_sampled
            q = model.model.ik(T, peg_demonstration.steps.joint_positions[t])
            tool = min(body.nearest.distance for body in model.tool_clearances(q, bodies))
            # The gripper's opening is rounded to a hundredth for the certificate.
            assert tool >= margin - 5e-4
            assert model.arm_distance(q, bodies).distance >= 0


def test_a_rotation_free_augmentation_gets_larger_spheres_and_a_margin_smaller_ones(
    peg_task, peg_model, peg_demonstration, peg_annotation
):
    def first(**changes):
        config = SuggestConfig(**changes)
        return (
            suggest_annotation(peg_demonstration, peg_model.spec, peg_task.scene, [19], config)
            .spheres[0]
            .radius
        )

    assert first(rotation_per_metre=0.0) > first() > first(margin=0.005)


def test_the_arm_s_reach_and_own_links_shrink_a_radius(peg_demonstration, clearances):
    steps = peg_demonstration.steps
    far = {name: Ts[0] @ pose([0, 0, -5]) for name, Ts in peg_demonstration.body_Ts_world.items()}
    q, T = steps.joint_positions[0], steps.measured_Ts_world_tool[0]
    config = SuggestConfig(max_radius=2.0, rotation_per_metre=0.1)
    found = suggest_radius(clearances(0), q, T, far, config)
    assert 0.1 < found.radius < 1.0
    assert found.limited_by != "max_radius" and "table" not in found.limited_by


def test_with_nothing_near_the_largest_radius_is_suggested(peg_demonstration, clearances):
    steps = peg_demonstration.steps
    far = {name: Ts[0] @ pose([0, 0, -5]) for name, Ts in peg_demonstration.body_Ts_world.items()}
    config = SuggestConfig(max_radius=0.05)
    found = suggest_radius(
        clearances(0), steps.joint_positions[0], steps.measured_Ts_world_tool[0], far, config
    )
    assert (found.radius, found.limited_by) == (0.05, "max_radius")
    assert 4.5 < found.clearance < 5.5


def test_chosen_waypoints_are_annotated_in_order_without_repeats(
    peg_task, peg_model, peg_demonstration
):
    seen = []
    annotation = suggest_annotation(
        peg_demonstration, peg_model.spec, peg_task.scene, [10, 0, 10], progress=seen.append
    )
    assert [sphere.waypoint for sphere in annotation.spheres] == seen == [0, 10]


@pytest.mark.parametrize("probes", [1, 10, 64])
def test_any_number_of_probes_works_without_a_warning(
    peg_task, peg_model, peg_demonstration, probes
):
    config = SuggestConfig(probes=probes)
    annotation = suggest_annotation(peg_demonstration, peg_model.spec, peg_task.scene, [0], config)
    assert annotation.spheres[0].radius > peg_task.placement_range


@pytest.mark.parametrize("waypoint", [-1, 10_000])
def test_a_waypoint_outside_the_demonstration_is_refused(
    peg_task, peg_model, peg_demonstration, waypoint
):
    with pytest.raises(InvalidInput, match=rf"waypoint {waypoint}: expected 0 to \d+"):
        suggest_annotation(peg_demonstration, peg_model.spec, peg_task.scene, [waypoint])


def test_the_last_waypoint_is_refused_for_nothing_follows_it(
    peg_task, peg_model, peg_demonstration
):
    last = len(peg_demonstration) - 1
    with pytest.raises(InvalidInput, match=f"waypoint {last}: expected 0 to {last - 1}"):
        suggest_annotation(peg_demonstration, peg_model.spec, peg_task.scene, [last])


def test_where_no_waypoint_has_room_the_error_says_what_to_do(
    peg_task, peg_model, peg_demonstration
):
    config = SuggestConfig(min_radius=0.5, max_radius=0.5)
    with pytest.raises(InvalidInput, match="no waypoint has room for a sphere of 500.0 mm"):
        suggest_annotation(peg_demonstration, peg_model.spec, peg_task.scene, config=config)
    with pytest.raises(InvalidInput, match="waypoint 0: no room .* clearance .* mm"):
        suggest_annotation(peg_demonstration, peg_model.spec, peg_task.scene, [0], config=config)


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
        ({"probes": 0}, "probes: expected at least 1"),
    ],
)
def test_a_bad_setting_is_refused(changes, message):
    with pytest.raises(InvalidInput, match=message):
        SuggestConfig(**changes)
