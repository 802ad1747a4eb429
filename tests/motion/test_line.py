"""Straight lines: on the line, on time, brisk, and within every joint's limits or not at all."""

import hypothesis.strategies as st
import numpy as np
import pytest
from hypothesis import assume, given, settings
from ruckig import Result
from scipy.interpolate import make_interp_spline

from sart_toolkit.errors import InvalidInput, MotionRejected, Unreachable
from sart_toolkit.motion import line as line_module
from sart_toolkit.motion.line import straight_line
from sart_toolkit.poses import (
    angle_between,
    check_poses,
    distance,
    exp_rotation,
    interpolate,
    log_rotation,
    pose,
)

PROPERTY = settings(deadline=None, derandomize=True, max_examples=25)

directions = st.tuples(*[st.floats(-1, 1)] * 3).map(np.array)
durations = st.floats(0.3, 3)
NAMES = ("velocity_limits", "acceleration_limits", "jerk_limits")


@st.composite
def motions(draw):
    """A pose relative to the start, within 12 cm and 0.4 rad of it."""
    return pose(0.07 * draw(directions), 0.23 * draw(directions))


def from_home(model, motion, duration, **others):
    q = model.spec.home
    T = model.fk(q)
    return straight_line(model, q, T, T @ motion, duration, **others)


def from_home_if_possible(model, motion, duration):
    """The line, or a discarded example where the joints can't do it in time."""
    try:
        return from_home(model, motion, duration)
    except MotionRejected:
        assume(False)


def times(line, n=400):
    return np.linspace(0, line.duration, n)


def greatest_derivatives(line, hz=2400):
    """Greatest |dq/dt|, |d2q/dt2|, |d3q/dt3| of each joint along q(s(t)), at rest outside."""
    spline = make_interp_spline(np.linspace(0, 1, len(line.knots)), line.knots, k=5)
    t = np.linspace(0, line.duration, round(line.duration * hz) + 1)
    q = spline([line.s(time) for time in t])
    q = np.concatenate([np.repeat(q[:1], 3, 0), q, np.repeat(q[-1:], 3, 0)])
    return [np.abs(np.diff(q, n=n, axis=0) / t[1] ** n).max(0) for n in (1, 2, 3)]


# --- geometry -----------------------------------------------------------------------------------


@PROPERTY
@given(motion=motions(), duration=durations)
def test_every_pose_is_on_the_line(model, motion, duration):
    line = from_home_if_possible(model, motion, duration)
    T_a, T_b = line.T_world_start, line.T_world_end
    dp, turn = T_b[:3, 3] - T_a[:3, 3], log_rotation(T_a[:3, :3].T @ T_b[:3, :3])
    for time in times(line, 50):
        s, T = line.s(time), line.T_world_tool(time)
        assert np.abs(T[:3, 3] - (T_a[:3, 3] + s * dp)).max() < 1e-9
        assert angle_between(T[:3, :3], T_a[:3, :3] @ exp_rotation(s * turn)) < 1e-7


@PROPERTY
@given(motion=motions(), duration=durations)
def test_the_joint_path_stays_on_the_line_between_its_knots(model, motion, duration):
    line = from_home_if_possible(model, motion, duration)
    grid = np.linspace(0, 1, len(line.knots))
    spline = make_interp_spline(grid, line.knots, k=5)
    for s in (*grid[::6], *(grid[:-1:6] + grid[1] / 2)):
        expected = interpolate(line.T_world_start, line.T_world_end, s)
        assert max(distance(model.fk(spline(s)), expected)) < 1e-5


def test_knots_lie_close_together_and_within_the_joint_limits(model):
    line = from_home(model, pose([0.1, 0.05, -0.05], [0.1, 0.3, -0.2]), 2.0)
    assert np.abs(np.diff(line.knots, axis=0)).max() < 0.05
    assert ((model.lower <= line.knots) & (line.knots <= model.upper)).all()
    np.testing.assert_allclose(line.knots[0], model.spec.home, atol=1e-6)


# --- time ---------------------------------------------------------------------------------------


@PROPERTY
@given(motion=motions(), duration=durations)
def test_a_line_takes_exactly_its_duration_from_rest_to_rest(model, motion, duration):
    line = from_home_if_possible(model, motion, duration)
    assert line.duration == duration
    np.testing.assert_allclose(line.T_world_tool(0.0), line.T_world_start, atol=1e-9)
    np.testing.assert_array_equal(line.T_world_tool(duration), line.T_world_end)
    assert line.s(0.0) == 0
    assert line.s(duration) == pytest.approx(1, abs=1e-9)
    # Not there early: a millisecond before the end a little is still to go.
    assert 0 < 1 - line.s(duration - 1e-3) < 1e-3
    # Neither ahead of the start nor behind the end is there anything.
    assert line.s(-1.0) == 0
    np.testing.assert_array_equal(line.T_world_tool(duration + 1), line.T_world_end)


@PROPERTY
@given(motion=motions(), duration=durations)
def test_the_path_parameter_never_runs_back(model, motion, duration):
    line = from_home_if_possible(model, motion, duration)
    assert (np.diff([line.s(t) for t in times(line)]) >= -1e-12).all()


@pytest.mark.parametrize("duration", [0.65, 1.0, 2.0, 5.0])
def test_cruise_is_reached_within_0_3_s_and_left_within_0_3_s_of_the_end(model, duration):
    line = from_home(model, pose([0.05, 0.0, -0.05], [0, 0.1, 0]), duration)
    t = np.linspace(0, duration, 4001)
    speed = np.gradient([line.s(x) for x in t], t)
    brisk = speed >= 0.9 * speed.max()
    assert brisk[(t >= 0.3) & (t <= duration - 0.3)].all()


@pytest.mark.parametrize(("hz", "duration", "n"), [(10, 2.0, 20), (10, 0.97, 10), (30, 1.0, 30)])
def test_samples_are_spread_evenly_and_end_at_the_end(model, hz, duration, n):
    line = from_home(model, pose([0.03, 0.0, -0.03], [0, 0.1, 0]), duration)
    Ts = check_poses("Ts", line.sample(hz))
    assert len(Ts) == n
    np.testing.assert_array_equal(Ts[-1], line.T_world_end)
    for i, T in enumerate(Ts):
        np.testing.assert_array_equal(T, line.T_world_tool(duration * (i + 1) / n))


def test_a_line_of_no_length_stays_where_it_is(model):
    line = from_home(model, np.eye(4), 1.0)
    for T in line.sample(10):
        np.testing.assert_allclose(T, line.T_world_start, atol=1e-12)
    np.testing.assert_allclose(
        line.knots, np.tile(model.spec.home, (len(line.knots), 1)), atol=1e-6
    )


# --- joint limits -------------------------------------------------------------------------------


@PROPERTY
@given(motion=motions(), duration=st.floats(0.25, 1.5))
def test_joint_velocity_acceleration_and_jerk_stay_within_their_limits(model, motion, duration):
    line = from_home_if_possible(model, motion, duration)
    for name, greatest in zip(NAMES, greatest_derivatives(line), strict=True):
        assert (greatest <= getattr(model.spec, name) * (1 + 1e-3)).all(), name


@PROPERTY
@given(motion=motions(), duration=durations, name=st.sampled_from(NAMES))
def test_a_line_that_would_break_a_limit_is_never_given(model, with_limits, motion, duration, name):
    line = from_home_if_possible(model, motion, duration)
    greatest = greatest_derivatives(line)[NAMES.index(name)]
    assume((greatest > 1e-3).all())
    slower = with_limits(**{name: 0.97 * greatest})
    with pytest.raises(MotionRejected, match="allow more time"):
        from_home(slower, motion, duration)


def test_a_line_that_a_limit_forbids_may_be_done_in_more_time(with_limits):
    slow = with_limits(velocity_limits=np.full(6, 0.1))
    motion = pose([0.1, 0, 0])
    with pytest.raises(MotionRejected, match="allow more time"):
        from_home(slow, motion, 1.0)
    line = from_home(slow, motion, 8.0)
    assert max(greatest_derivatives(line, 240)[0]) <= 0.1


# --- what can't be done -------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("p", "rotvec", "duration", "message"),
    [
        (
            [0.1, 0, 0],
            [0, 0, 0],
            0.05,
            r"the line needs 0\.\d\d s, 0.05 s were given; allow",
        ),
        ([0, 0, -0.01], [0, 0, 0], 0.01, "bends too sharply at its speed; allow"),
        ([0, 0, -0.01], [0, 0, 0], 0.05, "needs more jerk than they allow; allow more time"),
    ],
)
def test_too_short_a_duration_is_rejected_and_says_what_it_would_break(
    model, p, rotvec, duration, message
):
    with pytest.raises(MotionRejected, match=message):
        from_home(model, pose(p, rotvec), duration)


@pytest.mark.parametrize("duration", [0, -1, np.nan, np.inf])
def test_a_duration_that_is_not_positive_is_refused(model, duration):
    with pytest.raises(InvalidInput, match="duration: expected a finite number > 0 s"):
        from_home(model, np.eye(4), duration)


def test_an_end_out_of_reach_is_unreachable(model):
    with pytest.raises(Unreachable, match="is out of reach"):
        from_home(model, pose([2, 0, 0]), 2.0)


def test_a_line_that_leaves_reach_only_in_its_middle_is_unreachable(model):
    # Half a turn of the base apart: the straight line passes through the robot's own axis.
    q = model.spec.home
    T = model.fk(q)
    opposite = pose(rotvec=[0, 0, np.pi - 0.01]) @ T
    with pytest.raises((Unreachable, MotionRejected)):
        straight_line(model, q, T, opposite, 10.0)


def test_a_start_that_the_joints_are_not_near_is_rejected(model):
    q = np.array(model.spec.home)
    T = model.fk(q)
    with pytest.raises(MotionRejected, match="joint jump: a step of .* exceeds 0.35 rad"):
        straight_line(model, q + 0.6, T, T, 2.0)


def test_a_joint_step_beyond_the_one_allowed_is_rejected(model):
    with pytest.raises(MotionRejected, match="exceeds 0.00 rad"):
        from_home(model, pose([0.1, 0, 0]), 2.0, max_joint_step=0.001)


@pytest.mark.parametrize("which", ["start", "end"])
def test_a_line_from_or_to_what_is_no_pose_is_refused(model, which):
    T = model.fk(model.spec.home)
    ends = {"T_world_start": T, "T_world_end": T, f"T_world_{which}": np.zeros((4, 4))}
    with pytest.raises(InvalidInput, match=f"T_world_{which}: not a rigid transform"):
        straight_line(model, model.spec.home, **ends, duration=2.0)


def test_a_joint_vector_of_another_shape_is_refused(model):
    T = model.fk(model.spec.home)
    with pytest.raises(InvalidInput, match=r"q: expected shape \(6,\)"):
        straight_line(model, np.zeros(5), T, T, 2.0)


def test_a_timing_that_ruckig_does_not_find_is_rejected(model, monkeypatch):
    class Helpless:
        def __init__(self, _):
            pass

        def calculate(self, *_):
            return Result.ErrorExecutionTimeCalculation

    monkeypatch.setattr(line_module, "Ruckig", Helpless)
    with pytest.raises(MotionRejected, match="Ruckig found no timing .*; allow more time"):
        from_home(model, pose([0.1, 0, 0]), 2.0)
