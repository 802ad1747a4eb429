"""Poses drawn in fours: where a tool is drawn says nothing of how it is turned."""

import types

import numpy as np
import pytest

from sart_toolkit.augment.config import AugmentConfig
from sart_toolkit.augment.planner import SegmentPlanner
from sart_toolkit.augment.strategies import SART, SART_PLANNED, SphereStrategy
from sart_toolkit.data.records import Annotation, PrecisionSphere
from sart_toolkit.data.sampling import SamplingConfig, antithetic_pose, sample_pose
from sart_toolkit.poses import inverse, log_rotation, pose


def _upwards(sphere, rng, config):
    """A pose on the upper half of a sphere."""
    T = sample_pose(sphere, rng, config)
    up = abs(T[2, 3] - sphere.T_world_key[2, 3])
    T[2, 3] = sphere.T_world_key[2, 3] + up
    return T


UPPER_HALF = SphereStrategy(draw=_upwards)


@pytest.fixture(scope="module")
def proposals(peg_demonstration):
    """The first n draws of a sphere, as offset `(n, 3)` and turn `(n, 3)` in its key pose."""

    def proposals(n, strategy=SART, kind="ball", **sampling):
        T_key = peg_demonstration.steps.measured_Ts_world_tool[5]
        spheres = (PrecisionSphere(5, T_key, 0.05, kind=kind),)
        annotation = Annotation(spheres, peg_demonstration.content_hash())
        config = AugmentConfig(strategy=strategy, sampling=SamplingConfig(**sampling))
        world = types.SimpleNamespace(demonstration=peg_demonstration)
        planner = SegmentPlanner(world, annotation, config)
        Ts = [inverse(T_key) @ planner.proposal(0, k)[0].T_world_sampled for k in range(n)]
        return np.array([T[:3, 3] for T in Ts]), np.array([log_rotation(T[:3, :3]) for T in Ts])

    return proposals


@pytest.mark.parametrize("distribution", ["area", "paper"])
@pytest.mark.parametrize(("strategy", "kind"), [(SART, "ball"), (SART_PLANNED, "free_space")])
def test_each_two_draws_are_mirrored_and_each_four_both_ways(
    proposals, strategy, kind, distribution
):
    offsets, turns = proposals(12, strategy, kind, distribution=distribution)
    for i in range(0, 12, 4):
        d, w = offsets[i], turns[i]
        np.testing.assert_allclose(offsets[i : i + 4], [d, -d, d, -d], atol=1e-12)
        np.testing.assert_allclose(turns[i : i + 4], [w, w, -w, -w], atol=1e-9)
    assert np.linalg.norm(offsets[0] - offsets[4]) > 1e-3
    assert np.linalg.norm(turns[0] - turns[4]) > 1e-3


@pytest.mark.parametrize("n", [2, 4, 10, 40])
def test_turns_do_not_go_with_offsets(proposals, n):
    offsets, turns = proposals(n)
    np.testing.assert_allclose(np.einsum("ki,kj->ij", offsets, turns), 0, atol=1e-12)
    offsets, turns = proposals(n, antithetic=False)
    assert np.abs(np.einsum("ki,kj->ij", offsets, turns)).max() > 1e-4


@pytest.mark.parametrize(
    ("strategy", "sampling"),
    [(SART, {"antithetic": False}), (UPPER_HALF, {})],
)
def test_draws_are_each_on_their_own_if_asked_for_or_if_a_strategy_is_not_symmetric(
    proposals, strategy, sampling
):
    offsets, turns = proposals(8, strategy, **sampling)
    for of in (offsets, turns):
        for i in range(8):
            for other in (*of[:i], *-of[:i]):
                assert np.linalg.norm(of[i] - other) > 1e-6


def test_a_draw_of_one_s_own_is_not_mirrored_to_where_it_draws_nothing(peg_demonstration):
    config = AugmentConfig(strategy=UPPER_HALF)
    T_key = peg_demonstration.steps.measured_Ts_world_tool[5]
    annotation = Annotation((PrecisionSphere(5, T_key, 0.05),), peg_demonstration.content_hash())
    world = types.SimpleNamespace(demonstration=peg_demonstration)
    planner = SegmentPlanner(world, annotation, config)
    heights = [planner.proposal(0, k)[0].T_world_sampled[2, 3] for k in range(16)]
    assert min(heights) >= T_key[2, 3]


def test_a_pose_drawn_is_the_first_of_its_four_and_the_fifth():
    T_key, T = pose((0.3, 0.1, 0.2), (0.4, -0.2, 1.0)), pose((0.35, 0.1, 0.1), (0.5, -0.2, 0.9))
    for k in (0, 4):
        np.testing.assert_array_equal(antithetic_pose(T_key, T, k), T)


def test_a_dataset_from_before_there_was_a_choice_is_of_draws_on_their_own():
    values = AugmentConfig().to_json()
    assert AugmentConfig.from_json(values).sampling.antithetic
    del values["sampling"]["antithetic"]
    assert not AugmentConfig.from_json(values).sampling.antithetic
