"""What is sent to the joints: smooth, within limits whatever the goals are, exact in the end."""

import hypothesis.strategies as st
import numpy as np
import pytest
from hypothesis import given, settings

from sart_toolkit.data.records import Rates
from sart_toolkit.motion.interpolator import JointInterpolator

PROPERTY = settings(deadline=None, derandomize=True, max_examples=60)
HZ = 240
# Differences of rounded numbers, times the rate cubed.
ROUNDING = 1e-5


def sent_towards(model, goals, q=None, dq=None):
    """All targets `(k, n)` sent while goals are given, and the interpolator."""
    interpolator = JointInterpolator(model)
    q = model.spec.home if q is None else q
    interpolator.reset(q, dq)
    return np.concatenate([interpolator.towards(goal) for goal in goals]), interpolator


def ratios(model, rows, q, dq=0.0):
    """The greatest finite differences of what was sent over the limits, from what was before."""
    before = [q - k * dq / HZ for k in (3, 2, 1, 0)]
    rows = np.concatenate([before, rows])
    spec = model.spec
    limits = spec.velocity_limits, spec.acceleration_limits, spec.jerk_limits
    return [
        float((np.abs(np.diff(rows, order, axis=0)) * HZ**order / limit).max())
        for order, limit in enumerate(limits, 1)
    ]


jumps = st.builds(
    lambda scale, seed, hold: (
        np.random.default_rng(seed).normal(size=(12, 6)).repeat(hold, 0) * scale
    ),
    st.sampled_from([1e-4, 1e-3, 0.01, 0.1, 0.5, 3.0]),
    st.integers(0, 10**6),
    st.integers(1, 6),
)


@PROPERTY
@given(away=jumps)
def test_no_goal_makes_what_is_sent_exceed_a_limit_or_leave_the_range(model, away):
    home = model.spec.home
    goals = np.clip(home + away, model.lower, model.upper)
    rows, _ = sent_towards(model, goals)
    assert max(ratios(model, rows, home)) <= 1 + ROUNDING
    assert (rows >= model.lower).all() and (rows <= model.upper).all()


@PROPERTY
@given(away=jumps)
def test_goals_that_run_on_and_on_keep_the_limits_too(model, away):
    home = model.spec.home
    goals = np.clip(home + np.cumsum(away * 0.1, 0), model.lower, model.upper)
    rows, _ = sent_towards(model, goals)
    assert max(ratios(model, rows, home)) <= 1 + ROUNDING


@PROPERTY
@given(away=jumps)
def test_what_is_sent_ends_on_the_last_goal_and_rests_there(model, away):
    goals = np.clip(model.spec.home + away, model.lower, model.upper)
    goals = np.concatenate([goals, np.repeat(goals[-1:], 400, 0)])
    rows, interpolator = sent_towards(model, goals)
    assert interpolator.settled
    np.testing.assert_array_equal(rows[-16:], np.repeat(goals[-1:], 16, 0))


@PROPERTY
@given(seed=st.integers(0, 1000), speed=st.floats(0.0, 1.5))
def test_joints_that_move_are_led_to_a_rest_within_the_limits(model, seed, speed):
    rng = np.random.default_rng(seed)
    q, dq = model.spec.home, speed * rng.uniform(-1, 1, 6)
    goal = q + dq / 30
    rows, interpolator = sent_towards(model, np.repeat(goal[None], 60, 0), q, dq)
    assert max(ratios(model, rows, q, dq)) <= 1 + ROUNDING
    assert interpolator.settled
    np.testing.assert_array_equal(interpolator.sent, goal)


def test_a_steady_motion_is_followed_exactly_one_control_period_late(model):
    home = model.spec.home
    step = np.array([0.004, -0.003, 0.002, 0.001, -0.002, 0.003])
    goals = home + np.arange(1, 30)[:, None] * step
    rows, _ = sent_towards(model, goals)
    at_ends = rows[7::8]
    np.testing.assert_allclose(at_ends[4:], goals[3:-1], atol=1e-12)
    np.testing.assert_allclose(np.diff(rows[40:], axis=0), np.tile(step / 8, (191, 1)), atol=1e-12)


def test_a_stop_is_never_overshot(model):
    home = model.spec.home
    goals = home + np.minimum(np.arange(1, 40), 20)[:, None] * np.full(6, 0.004)
    rows, _ = sent_towards(model, goals)
    assert (np.diff(rows, axis=0) >= 0).all()
    assert (rows <= goals[-1]).all()


@pytest.mark.parametrize(("rates", "steps"), [(Rates(), 8), (Rates(500, 50, 10), 10)])
def test_each_control_period_has_a_target_for_each_physics_step(model, rates, steps):
    interpolator = JointInterpolator(model, rates)
    rows = interpolator.towards(model.spec.home + 0.001)
    assert rows.shape == (steps, 6)
    np.testing.assert_array_equal(rows[-1], interpolator.sent)


def test_what_rests_is_sent_to_where_it_is(model):
    rows, interpolator = sent_towards(model, [model.spec.home] * 3)
    np.testing.assert_array_equal(rows, np.tile(model.spec.home, (24, 1)))
    assert interpolator.settled
