"""Courses in time: from rest to rest, brisk, within all joints' limits, no slower than asked."""

import functools

import hypothesis.strategies as st
import numpy as np
import pytest
from hypothesis import assume, given, reject, settings
from ruckig import Result

from sart_toolkit.errors import InvalidInput, MotionRejected
from sart_toolkit.motion import timing
from sart_toolkit.motion.path import SplinePath
from sart_toolkit.motion.timing import timed
from sart_toolkit.poses import pose

PROPERTY = settings(deadline=None, derandomize=True, max_examples=40)
NAMES = ("velocity_limits", "acceleration_limits", "jerk_limits")

seeds = st.integers(0, 2**32 - 1)
durations = st.floats(0.05, 4)


def T_at(s):
    return pose([s, 0.0, 0.0])


def random_path(model, seed):
    """A joint path about home, from nearly none to a long and winding one."""
    rng = np.random.default_rng(seed)
    count = int(rng.integers(6, 30))
    u = np.linspace(0, 1, count)[:, None]
    straight = u * rng.uniform(-1, 1, 6) * rng.choice([0.01, 0.2, 0.8])
    waves = np.sin(np.pi * u * rng.integers(1, 4, 6)) * rng.choice([0.0, 0.02, 0.15], 6)
    return SplinePath.through(model.spec.home + straight + waves)


def moved(model, seed, duration):
    return timed(model, random_path(model, seed), duration, T_at)


def assert_within_limits(model, motion, n=2000):
    found = motion.derivatives(np.linspace(0, motion.duration, n))
    for name, values in zip(NAMES, found, strict=True):
        assert (np.abs(values) <= getattr(model.spec, name) * (1 + 1e-9)).all(), name


# --- how long -----------------------------------------------------------------------------------


@PROPERTY
@given(seed=seeds, duration=durations)
def test_a_motion_takes_the_time_asked_for_or_whole_tenths_of_a_second(model, seed, duration):
    motion = moved(model, seed, duration)
    assert motion.duration >= duration
    if motion.duration != duration:
        assert motion.duration * 10 == pytest.approx(round(motion.duration * 10), abs=1e-9)


@PROPERTY
@given(seed=seeds, duration=durations)
def test_joint_velocity_acceleration_and_jerk_stay_within_their_limits(model, seed, duration):
    assert_within_limits(model, moved(model, seed, duration))


@PROPERTY
@given(seed=seeds, name=st.sampled_from(NAMES), share=st.floats(0.05, 0.97))
def test_a_tighter_limit_holds_too_and_takes_longer(model, with_limits, seed, name, share):
    quick = moved(model, seed, 1.0)
    times = np.linspace(0, quick.duration, 2000)
    greatest = np.abs(quick.derivatives(times)[NAMES.index(name)]).max(0)
    assume((greatest > 1e-3).all())
    slower = with_limits(**{name: share * greatest})
    try:
        motion = moved(slower, seed, 1.0)
    except MotionRejected as error:
        # Bounds are of the whole path: a joint that is fast where the timing is slow meets a limit
        # drawn from its true accelerations only in ages.
        assert "more than 600 s" in str(error)
        reject()
    assert motion.duration > quick.duration
    assert_within_limits(slower, motion)


@pytest.mark.parametrize("binding", NAMES)
def test_a_winding_path_is_run_slowly_enough_for_its_bends(model, with_limits, binding):
    # All but one of the limits are out of reach.
    wide = {name: np.full(6, 1e6) for name in NAMES if name != binding}
    winding = with_limits(**wide)
    u = np.linspace(0, 1, 120)[:, None]
    path = SplinePath.through(model.spec.home + 0.05 * np.sin(2 * np.pi * u * np.arange(7, 13)))
    motion = timed(winding, path, 0.5, T_at)
    assert motion.duration > 0.5
    assert_within_limits(winding, motion, 20_000)


@PROPERTY
@given(seed=seeds)
def test_a_motion_is_slowed_down_no_more_than_needed(model, seed):
    motion = moved(model, seed, 0.05)
    assume(motion.duration > 0.05)
    # Not 0.2 s less would do.
    asked = motion.duration - 0.2
    if asked > 0.05:
        assert moved(model, seed, asked).duration > asked
    # What was found to be enough is enough if it is asked for.
    assert moved(model, seed, motion.duration).duration == motion.duration
    assert moved(model, seed, motion.duration + 0.037).duration == pytest.approx(
        motion.duration + 0.1, abs=1e-9
    )


@pytest.mark.parametrize(
    ("asked", "hz", "duration"),
    [(1.75, 10, 1.8), (2.05, 10, 2.1), (0.33, 10, 0.4), (2.0, 10, 2.0), (0.7, 10, 0.7),
     (0.01, 10, 0.1), (1.01, 15, 16 / 15), (1.0, 15, 1.0)],
)  # fmt: skip
def test_a_duration_is_rounded_up_to_whole_recorded_steps(model, asked, hz, duration):
    still = SplinePath.through(np.tile(model.spec.home, (6, 1)))
    motion = timed(model, still, asked, T_at, hz)
    assert motion.duration == duration
    times = motion.times(hz)
    np.testing.assert_allclose(times, np.arange(1, len(times) + 1) / hz, rtol=1e-12)
    assert motion.s(times[-1]) == 1.0


@PROPERTY
@given(seed=seeds, duration=durations, more=st.floats(0, 2))
def test_who_asks_for_more_time_gets_no_less(model, seed, duration, more):
    less = moved(model, seed, duration)
    assert moved(model, seed, duration + more).duration > less.duration - 0.1 - 1e-9


# --- the course ---------------------------------------------------------------------------------


@PROPERTY
@given(seed=seeds, duration=durations)
def test_a_motion_runs_from_rest_to_rest_over_the_whole_path(model, seed, duration):
    path = random_path(model, seed)
    motion = timed(model, path, duration, T_at)
    end = motion.duration
    assert motion.s(0.0) == 0
    assert motion.s(end) == 1
    # Not there early: a millisecond before the end a little is still to go.
    assert 0 < 1 - motion.s(end - 1e-3) < 1e-2
    velocity, acceleration, _ = motion.derivatives(np.array([0.0, end]))
    assert np.abs(velocity).max() < 1e-6
    assert np.abs(acceleration).max() < 1e-6
    np.testing.assert_array_equal(
        motion.joints(np.array([0.0, end])), path.positions(np.array([0.0, 1.0]))
    )


@PROPERTY
@given(seed=seeds, duration=durations)
def test_before_the_start_and_after_the_end_nothing_moves(model, seed, duration):
    motion = moved(model, seed, duration)
    outside = np.array([-1.0, -1e-9, motion.duration + 1e-9, motion.duration + 1])
    assert [motion.s(time) for time in outside] == [0, 0, 1, 1]
    velocity, acceleration, jerk = motion.derivatives(outside)
    assert np.abs(velocity).max() < 1e-6
    assert np.abs(acceleration).max() < 1e-6
    assert np.abs(jerk).max() < 1e-6
    np.testing.assert_array_equal(motion.T_world_tool(motion.duration + 1), T_at(1.0))


@PROPERTY
@given(seed=seeds, duration=durations)
def test_the_path_parameter_never_runs_back(model, seed, duration):
    motion = moved(model, seed, duration)
    s = [motion.s(time) for time in np.linspace(0, motion.duration, 400)]
    assert (np.diff(s) >= -1e-12).all()


@pytest.mark.parametrize("duration", [0.65, 1.0, 2.0, 5.0])
def test_cruise_is_reached_within_0_3_s_and_left_within_0_3_s_of_the_end(model, duration):
    motion = timed(model, random_path(model, 1), duration, T_at)
    t = np.linspace(0, motion.duration, 4001)
    speed = np.gradient([motion.s(x) for x in t], t)
    brisk = speed >= 0.9 * speed.max()
    assert brisk[(t >= 0.3) & (t <= motion.duration - 0.3)].all()


@PROPERTY
@given(seed=seeds, duration=durations)
def test_derivatives_are_those_of_the_joints_in_time(model, seed, duration):
    motion = moved(model, seed, duration)
    h = motion.duration / 1500
    times = np.arange(1501) * h
    q = motion.joints(times)
    velocity, acceleration, jerk = motion.derivatives(times)
    spread = np.ptp(q, axis=0).max()
    # Differences are of second order in h; the timing's jerk jumps a few times.
    for exact, rough, order in (
        (velocity[1:-1], (q[2:] - q[:-2]) / (2 * h), 1),
        (acceleration[1:-1], (velocity[2:] - velocity[:-2]) / (2 * h), 2),
        (jerk[1:-1], (acceleration[2:] - acceleration[:-2]) / (2 * h), 3),
    ):
        error = np.abs(exact - rough).max(1)
        scale = np.abs(exact).max() + spread / motion.duration**order + 1e-6
        assert np.quantile(error, 0.99) <= 1e-2 * scale


@PROPERTY
@given(seed=seeds, duration=durations, share=st.floats(0, 1))
def test_joints_and_tool_are_where_the_path_parameter_says(model, seed, duration, share):
    motion = moved(model, seed, duration)
    time = share * motion.duration
    s = motion.s(time)
    np.testing.assert_array_equal(
        motion.joints(np.array([time])), motion.path.positions(np.array([s]))
    )
    np.testing.assert_array_equal(motion.T_world_tool(time), T_at(s))


@pytest.mark.parametrize(("hz", "duration", "n"), [(10, 2.0, 20), (10, 0.9, 9), (30, 1.0, 30)])
def test_times_are_spread_evenly_and_end_at_the_end(model, hz, duration, n):
    motion = timed(model, SplinePath.through(np.tile(model.spec.home, (6, 1))), duration, T_at)
    times = motion.times(hz)
    assert len(times) == n
    np.testing.assert_allclose(np.diff(times, prepend=0.0), duration / n, rtol=1e-12)
    assert times[-1] == duration


def test_a_motion_of_one_recorded_step_has_one_time(model):
    motion = timed(model, SplinePath.through(np.tile(model.spec.home, (6, 1))), 0.01, T_at)
    np.testing.assert_array_equal(motion.times(10), [0.1])


def test_the_same_path_is_timed_the_same(model):
    a, b = (moved(model, 3, 0.3) for _ in range(2))
    times = np.linspace(0, a.duration, 100)
    assert a.duration == b.duration
    np.testing.assert_array_equal(a.joints(times), b.joints(times))


# --- what can't be done -------------------------------------------------------------------------


@pytest.mark.parametrize("joint", range(6))
@pytest.mark.parametrize("side", [-1, 1])
def test_a_path_that_leaves_a_joints_range_is_rejected(model, joint, side):
    q = np.tile(model.spec.home, (8, 1))
    limit = model.upper[joint] if side > 0 else model.lower[joint]
    # To just short of the limit, and back.
    q[:, joint] = limit - side * np.abs(np.linspace(-1, 1, 8))
    bound = functools.partial(timed, model, duration=1000.0, T_at=T_at)
    with pytest.raises(
        MotionRejected,
        match=f"joint limits: the path leaves the range of {model.spec.arm_joints[joint]}; sample",
    ):
        bound(SplinePath.through(q))
    q[:, joint] -= side * 0.5
    bound(SplinePath.through(q))


def test_limits_that_no_time_is_enough_for_are_rejected(with_limits):
    slow = with_limits(velocity_limits=np.full(6, 1e-5))
    with pytest.raises(
        MotionRejected, match="joint limits: the path needs more than 600 s; sample"
    ):
        moved(slow, 0, 1.0)


def test_more_than_600_s_may_be_asked_for(model):
    assert moved(model, 0, 1000.0).duration == 1000.0


@pytest.mark.parametrize("duration", [0, -1, np.nan, np.inf, "1"])
def test_a_duration_that_is_not_positive_is_refused(model, duration):
    with pytest.raises(InvalidInput, match="duration: expected a finite number > 0 s"):
        moved(model, 0, duration)


def test_a_timing_that_ruckig_does_not_find_is_rejected(model, monkeypatch):
    class Helpless:
        def __init__(self, _):
            pass

        def calculate(self, *_):
            return Result.ErrorExecutionTimeCalculation

    monkeypatch.setattr(timing, "Ruckig", Helpless)
    with pytest.raises(MotionRejected, match="timing: Ruckig found none .*; allow more time"):
        moved(model, 0, 2.0)
