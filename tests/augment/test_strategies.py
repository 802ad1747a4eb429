from __future__ import annotations

import dataclasses
import sys

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from sart_toolkit.augment import STRATEGIES, get_strategy
from sart_toolkit.augment.config import ALLOCATIONS, AugmentConfig
from sart_toolkit.augment.strategies import (
    SART,
    SART_PLANNED,
    ContactFreeMiles,
    Proposal,
    Strategy,
)
from sart_toolkit.data.records import Demonstration, PrecisionSphere, Steps, convergence_waypoint
from sart_toolkit.data.sampling import (
    DISTRIBUTIONS,
    SamplingConfig,
    sample_direction,
    sample_rotation,
)
from sart_toolkit.errors import InvalidInput, MissingExtra, UnknownName
from sart_toolkit.poses import angle_between, log_rotation, pose

N = 20_000
some = settings(max_examples=100, deadline=None, derandomize=True)


def _fits(values, distribution):
    return stats.kstest(values, distribution.cdf).pvalue > 0.01


def _demonstration(positions):
    """A demonstration whose tool goes through `positions (n, 3)`, its angle growing."""
    n = len(positions)
    Ts = np.stack([pose(p, [0, 0, 0.1 * i]) for i, p in enumerate(positions)])
    steps = Steps(
        joint_positions=np.zeros((n, 6)),
        joint_velocities=np.zeros((n, 6)),
        commanded_joint_positions=np.zeros((n, 6)),
        measured_Ts_world_tool=Ts,
        commanded_Ts_world_tool=Ts,
        measured_gripper=np.zeros(n),
        commanded_gripper=np.zeros(n),
        contact_force=np.zeros(n),
        cameras={},
    )
    return Demonstration(
        task="none",
        task_parameters={},
        robot="none",
        backend="none",
        steps=steps,
        timestamps=np.arange(n) / 10,
        body_Ts_world={},
        success=np.zeros(n, bool),
        touching=((),) * n,
        raw_commands=np.zeros((3 * n, 7)),
        states=(),
        operator="test",
        device="none",
        seconds=1.0,
    )


# --- sampling distributions ---------------------------------------------------------------------


@pytest.fixture(scope="module", params=DISTRIBUTIONS)
def distribution(request):
    return request.param


@pytest.fixture(scope="module")
def directions(distribution):
    rng = np.random.default_rng(0)
    return np.array([sample_direction(rng, distribution) for _ in range(N)])


def test_phi_is_uniform_by_the_paper_s_distribution_and_its_cosine_by_area(
    distribution, directions
):
    phi = np.arccos(np.clip(directions[:, 2], -1, 1))
    assert _fits(phi, stats.uniform(0, np.pi)) == (distribution == "paper")
    assert _fits(np.cos(phi), stats.uniform(-1, 2)) == (distribution == "area")


def test_the_paper_s_distribution_draws_a_third_near_the_poles_and_area_an_eighth(
    distribution, directions
):
    near_pole = (np.abs(directions[:, 2]) > np.cos(np.deg2rad(30))).mean()
    expected = {"paper": 1 / 3, "area": 1 - np.cos(np.deg2rad(30))}[distribution]
    assert near_pole == pytest.approx(expected, abs=0.01)


def test_psi_is_uniform_and_directions_are_unit_vectors(directions):
    psi = np.arctan2(directions[:, 1], directions[:, 0])
    assert _fits(psi, stats.uniform(-np.pi, 2 * np.pi))
    np.testing.assert_allclose(np.linalg.norm(directions, axis=1), 1.0, atol=1e-12)


@pytest.mark.parametrize("largest", [0.02, 0.3, 2.5])
def test_the_rotation_angle_is_uniform_and_its_axis_too(largest):
    rng = np.random.default_rng(1)
    vectors = np.array([log_rotation(sample_rotation(rng, largest)) for _ in range(N)])
    angles = np.linalg.norm(vectors, axis=1)
    assert angles.max() <= largest + 1e-12
    # U[-largest, largest] about an axis is U[0, largest] about it or its opposite.
    assert _fits(angles, stats.uniform(0, largest))
    axes = vectors / angles[:, None]
    for k in range(3):
        assert _fits(axes[:, k], stats.uniform(-1, 2))
    assert _fits(np.arctan2(axes[:, 1], axes[:, 0]), stats.uniform(-np.pi, 2 * np.pi))


def test_no_rotation_is_drawn_where_none_is_allowed():
    np.testing.assert_array_equal(sample_rotation(np.random.default_rng(0), 0.0), np.eye(3))


# --- the strategy of the paper ------------------------------------------------------------------

points = st.tuples(*[st.floats(-1, 1)] * 3)


@some
@given(
    centre=points,
    turn=points,
    radius=st.floats(0.001, 0.5),
    nu=st.floats(0, 3),
    distribution=st.sampled_from(DISTRIBUTIONS),
    seed=st.integers(0, 2**32),
)
def test_the_sampled_pose_lies_on_the_sphere_turned_by_no_more_than_allowed(
    centre, turn, radius, nu, distribution, seed
):
    demonstration = _demonstration([[0, 0, 0], [9, 9, 9]])
    sphere = PrecisionSphere(0, pose(centre, turn), radius)
    config = SamplingConfig(distribution, nu)
    drawn = [
        SART.propose(demonstration, [sphere], 0, np.random.default_rng(seed), config)
        for _ in range(2)
    ]
    T = drawn[0].T_world_sampled
    np.testing.assert_array_equal(T, drawn[1].T_world_sampled)
    assert np.linalg.norm(T[:3, 3] - sphere.T_world_key[:3, 3]) == pytest.approx(radius, abs=1e-12)
    assert angle_between(sphere.T_world_key[:3, :3], T[:3, :3]) <= nu * radius + 1e-9
    np.testing.assert_allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3), atol=1e-12)


def test_the_rotation_is_drawn_for_the_radius_of_the_sphere():
    demonstration = _demonstration([[0, 0, 0], [9, 9, 9]])
    rng = np.random.default_rng(2)
    for radius in (0.05, 0.2):
        sphere = PrecisionSphere(0, pose(), radius)
        angles = [
            angle_between(
                np.eye(3),
                SART.propose(demonstration, [sphere], 0, rng, SamplingConfig()).T_world_sampled[
                    :3, :3
                ],
            )
            for _ in range(3000)
        ]
        assert _fits(angles, stats.uniform(0, 2.0 * radius))


@some
@given(
    st.lists(points, min_size=2, max_size=12),
    st.floats(0.01, 2.5),
    st.data(),
)
def test_t_star_is_the_first_waypoint_after_the_key_outside_its_sphere(path, radius, data):
    waypoint = data.draw(st.integers(0, len(path) - 2))
    demonstration = _demonstration(path)
    sphere = PrecisionSphere(waypoint, pose(path[waypoint]), radius)
    expected = len(path) - 1
    for t in reversed(range(waypoint + 1, len(path))):
        if np.linalg.norm(np.subtract(path[t], path[waypoint])) > radius:
            expected = t
    assert convergence_waypoint(demonstration, sphere) == expected
    proposal = SART.propose(demonstration, [sphere], 0, np.random.default_rng(0), SamplingConfig())
    assert proposal.t_star == expected


def test_a_demonstration_that_never_leaves_a_sphere_is_joined_at_its_last_waypoint():
    demonstration = _demonstration([[0, 0, 0.001 * t] for t in range(8)])
    assert convergence_waypoint(demonstration, PrecisionSphere(2, pose(), 0.1)) == 7


@pytest.mark.parametrize("strategy", [SART, SART_PLANNED])
def test_every_strategy_rejoins_ahead_of_its_sphere_and_follows_from_the_rng(
    strategy, peg_demonstration, peg_annotation
):
    spheres = peg_annotation.spheres
    for i, sphere in enumerate(spheres):
        drawn = [
            strategy.propose(
                peg_demonstration, spheres, i, np.random.default_rng(3), SamplingConfig()
            )
            for _ in range(2)
        ]
        assert sphere.waypoint < drawn[0].t_star < len(peg_demonstration)
        np.testing.assert_array_equal(drawn[0].T_world_sampled, drawn[1].T_world_sampled)
        with pytest.raises(ValueError, match="read-only"):
            drawn[0].T_world_sampled[0, 0] = 1.0


# --- free-space regions -------------------------------------------------------------------------


def _distances(region, distribution, n=3000):
    demonstration = _demonstration([[0, 0, 0], [9, 9, 9]])
    rng = np.random.default_rng(5)
    drawn = [
        SART_PLANNED.propose(demonstration, [region], 0, rng, SamplingConfig(distribution))
        for _ in range(n)
    ]
    offsets = np.array([d.T_world_sampled[:3, 3] for d in drawn]) - region.T_world_key[:3, 3]
    turns = [angle_between(region.T_world_key[:3, :3], d.T_world_sampled[:3, :3]) for d in drawn]
    return offsets, np.array(turns)


def test_a_pose_in_a_free_space_region_is_drawn_from_its_volume(distribution):
    region = PrecisionSphere(0, pose([0.3, 0.1, 0.2], [0.4, 0, 0]), 0.25, kind="free_space")
    offsets, turns = _distances(region, distribution)
    distances = np.linalg.norm(offsets, axis=1)
    assert _fits((distances / 0.25) ** 3, stats.uniform(0, 1))
    assert _fits(turns, stats.uniform(0, 2.0 * 0.25))
    phi = np.arccos(offsets[:, 2] / distances)
    assert _fits(phi, stats.uniform(0, np.pi)) == (distribution == "paper")
    # By area the volume is filled evenly: an axis-parallel slab's share is its volume's.
    inside = (np.abs(offsets[:, 2]) < 0.05).mean()
    share = 0.5 * (3 * 0.2 - 0.2**3)
    assert (abs(inside - share) < 0.03) == (distribution == "area")


@pytest.mark.parametrize("kind", ["ball", "free_space"])
def test_the_paper_s_strategy_draws_from_the_surface_of_a_sphere_of_either_kind(kind):
    demonstration = _demonstration([[0, 0, 0], [9, 9, 9]])
    sphere = PrecisionSphere(0, pose([0.1, 0, 0]), 0.25, kind=kind)
    T = SART.propose(
        demonstration, [sphere], 0, np.random.default_rng(1), SamplingConfig()
    ).T_world_sampled
    assert np.linalg.norm(T[:3, 3] - [0.1, 0, 0]) == pytest.approx(0.25, abs=1e-12)


def test_in_a_ball_the_strategy_that_plans_draws_what_the_paper_s_does(distribution):
    demonstration = _demonstration([[0, 0, 0], [9, 9, 9]])
    sphere, config = PrecisionSphere(0, pose([0.1, 0, 0]), 0.2), SamplingConfig(distribution)
    for seed in range(5):
        a, b = (
            strategy.propose(demonstration, [sphere], 0, np.random.default_rng(seed), config)
            for strategy in (SART, SART_PLANNED)
        )
        assert a.t_star == b.t_star
        np.testing.assert_array_equal(a.T_world_sampled, b.T_world_sampled)


def test_only_the_planned_strategy_plans():
    assert [name for name in STRATEGIES if get_strategy(name).plans] == ["sart_planned"]


# --- ablations and baselines, each from its definition ------------------------------------------

# A straight way along x, a waypoint each centimetre, and two spheres on it.
LINE = _demonstration([[0.01 * t, 0, 0] for t in range(31)])
PAIR = tuple(
    PrecisionSphere(t, LINE.steps.measured_Ts_world_tool[t], radius)
    for t, radius in ((4, 0.035), (12, 0.055))
)


def _drawn(name, i=0, n=200, spheres=PAIR):
    strategy, rng = get_strategy(name), np.random.default_rng(4)
    return [strategy.propose(LINE, spheres, i, rng, SamplingConfig()) for _ in range(n)]


def _offsets(proposals, sphere):
    """Distance of each from the sphere's centre [m], and the angle between them [rad]."""
    key = sphere.T_world_key
    Ts = [proposal.T_world_sampled for proposal in proposals]
    return (
        np.array([np.linalg.norm(T[:3, 3] - key[:3, 3]) for T in Ts]),
        np.array([angle_between(key[:3, :3], T[:3, :3]) for T in Ts]),
    )


@pytest.mark.parametrize(
    ("name", "joins"),
    [
        # Waypoint 4 is left behind 35 mm away: at 8; 12 behind 55 mm: at 18.
        ("sart", (8, 18)),
        ("sart_planned", (8, 18)),
        ("no_position", (8, 18)),
        ("no_orientation", (8, 18)),
        ("no_merge", (8, 18)),
        ("inside_sphere", (8, 18)),
        # kappa*_i = kappa_i.
        ("return_to_center", (4, 12)),
        # c_(i+1); there is none after the last.
        ("next_sphere_center", (12, 18)),
        # kappa*_(i+1).
        ("next_sphere_convergence", (18, 18)),
        # Farther than 2 r: 70 mm after 40 mm is 120 mm, 110 after 120 is 230 mm.
        ("extended_convergence", (12, 24)),
    ],
)
def test_a_strategy_rejoins_where_it_is_defined_to(name, joins):
    if name == "sart_planned":
        pytest.importorskip("ompl")
    for i, expected in enumerate(joins):
        if name == "extended_convergence":
            # Rounding decides what lies exactly on the sphere.
            assert _drawn(name, i, 1)[0].t_star in (expected, expected - 1)
        else:
            assert _drawn(name, i, 1)[0].t_star == expected


def test_every_other_strategy_is_tested_by_a_definition_of_its_own():
    tested = {"miles", "miles_1cm", "miles_10cm", "bc", "replay"}
    mark = next(
        mark
        for mark in test_a_strategy_rejoins_where_it_is_defined_to.pytestmark
        if mark.name == "parametrize"
    )
    assert {name for name, _ in mark.args[1]} | tested == set(STRATEGIES)


def test_without_position_augmentation_poses_are_the_centre_turned():
    distances, angles = _offsets(_drawn("no_position"), PAIR[0])
    assert distances.max() < 1e-12
    assert _fits(angles, stats.uniform(0, 2.0 * PAIR[0].radius))


def test_without_orientation_augmentation_poses_lie_on_the_sphere_unturned():
    drawn = _drawn("no_orientation")
    distances, angles = _offsets(drawn, PAIR[0])
    np.testing.assert_allclose(distances, PAIR[0].radius, atol=1e-12)
    assert angles.max() == 0.0
    for ours, sart in zip(drawn[:1], _drawn("sart")[:1], strict=True):
        np.testing.assert_array_equal(ours.T_world_sampled[:3, 3], sart.T_world_sampled[:3, 3])


def test_inside_the_sphere_poses_fill_its_volume():
    distances, angles = _offsets(_drawn("inside_sphere", n=2000), PAIR[0])
    assert _fits((distances / PAIR[0].radius) ** 3, stats.uniform(0, 1))
    assert _fits(angles, stats.uniform(0, 2.0 * PAIR[0].radius))


def test_only_without_merging_nothing_follows():
    for name in ("sart", "no_merge", "return_to_center", "miles"):
        assert all(p.merged == (name != "no_merge") for p in _drawn(name, n=3))


def test_where_spheres_tile_the_path_the_next_centre_is_the_convergence_waypoint():
    """As the paper says of its own annotations: then the ablation is SART."""
    at = LINE.steps.measured_Ts_world_tool
    tiling = [PrecisionSphere(2, at[2], 0.045)]
    for radius in (0.035, 0.025):
        t = convergence_waypoint(LINE, tiling[-1])
        tiling.append(PrecisionSphere(t, at[t], radius))
    for i in range(3):
        ours, sart = (_drawn(n, i, 5, tiling) for n in ("next_sphere_center", "sart"))
        assert [p.t_star for p in ours] == [p.t_star for p in sart]


@pytest.mark.parametrize(
    ("name", "radius"), [("miles", 0.02), ("miles_1cm", 0.01), ("miles_10cm", 0.1)]
)
def test_contact_free_miles_has_a_sphere_at_every_waypoint_and_returns_to_its_centre(name, radius):
    strategy = get_strategy(name)
    spheres = strategy.spheres(LINE, None)
    assert [sphere.waypoint for sphere in spheres] == list(range(len(LINE) - 1))
    assert {sphere.radius for sphere in spheres} == {radius}
    for sphere, T in zip(spheres, LINE.steps.measured_Ts_world_tool, strict=False):
        np.testing.assert_array_equal(sphere.T_world_key, T)
    for i in (0, 9, len(spheres) - 1):
        drawn = _drawn(name, i, 20, spheres)
        assert {proposal.t_star for proposal in drawn} == {i}
        np.testing.assert_allclose(_offsets(drawn, spheres[i])[0], radius, atol=1e-12)
    # All waypoints alike, by either allocation.
    for allocation in ALLOCATIONS:
        assert len(set(strategy.weights(spheres, allocation))) == 1


def test_a_radius_that_is_none_is_refused():
    with pytest.raises(InvalidInput, match="radius"):
        ContactFreeMiles(radius=0.0)


@pytest.mark.parametrize(
    ("name", "policy", "n"), [("bc", "compact_mlp", 40), ("replay", "replay", 1)]
)
def test_behavioural_cloning_and_replay_draw_nothing(name, policy, n):
    strategy = get_strategy(name)
    assert not strategy.draws and strategy.spheres(LINE, None) == ()
    assert (strategy.policy, strategy.n) == (policy, n)
    with pytest.raises(InvalidInput, match="draws no segments; use another, such as sart"):
        _drawn(name, n=1)


def test_weights_follow_the_radii_or_are_equal():
    assert list(SART.weights(PAIR, "radius")) == [0.035, 0.055]
    assert list(SART.weights(PAIR, "equal")) == [1.0, 1.0]


# --- a strategy of one's own --------------------------------------------------------------------


class Still(Strategy):
    """A strategy from outside: stay at the key pose."""

    def propose(self, demonstration, spheres, i, rng, config):
        return Proposal(spheres[i].waypoint + 1, spheres[i].T_world_key)


def test_a_strategy_of_one_s_own_is_taken_as_it_is_and_noted_by_its_reference():
    still = Still()
    assert get_strategy(still) is still
    assert AugmentConfig(strategy=still).strategy.endswith("test_strategies:Still")
    assert AugmentConfig(strategy=SART).strategy == "sart"


# --- errors -------------------------------------------------------------------------------------


def test_an_unknown_strategy_is_refused_with_the_nearest_name():
    with pytest.raises(UnknownName, match="unknown strategy 'srat': did you mean 'sart'"):
        get_strategy("srat")


def test_an_unknown_sampling_distribution_is_refused_with_the_nearest_name():
    with pytest.raises(UnknownName, match="sampling distribution 'papers': did you mean 'paper'"):
        SamplingConfig(distribution="papers")


@pytest.mark.parametrize("value", [-0.1, np.nan, np.inf])
def test_a_rotation_per_metre_that_is_no_angle_is_refused(value):
    with pytest.raises(InvalidInput, match="rotation_per_metre: expected a finite number >= 0"):
        SamplingConfig(rotation_per_metre=value)
    assert dataclasses.replace(SamplingConfig(), rotation_per_metre=0.0).rotation_per_metre == 0


def test_without_ompl_a_strategy_that_plans_is_refused_at_once_and_the_other_is_not(monkeypatch):
    monkeypatch.setitem(sys.modules, "ompl", None)
    for ask in (get_strategy, lambda name: AugmentConfig(strategy=name)):
        ask("sart")
        with pytest.raises(MissingExtra, match=r"pip install 'sart_toolkit\[planning\]'"):
            ask("sart_planned")
