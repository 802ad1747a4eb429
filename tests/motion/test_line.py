"""Straight lines: the tool on the line as nearly as is said, the joints on one branch, in time."""

import hypothesis.strategies as st
import numpy as np
import pytest
from hypothesis import assume, given, settings
from ruckig import Result

from sart_toolkit.errors import InvalidInput, MotionRejected, Unreachable
from sart_toolkit.motion import timing
from sart_toolkit.motion.line import straight_line
from sart_toolkit.poses import (
    angle_between,
    check_poses,
    distance,
    exp_rotation,
    log_rotation,
    pose,
)

PROPERTY = settings(deadline=None, derandomize=True, max_examples=25)
# That of inverse kinematics, in each of six directions.
IK_ACCURACY = 2e-6

directions = st.tuples(*[st.floats(-1, 1)] * 3).map(np.array)
durations = st.floats(0.3, 3)
# Wrist 2 hardly bent.
NEARLY_SINGULAR = np.array([0.0, -1.7, 1.9, -1.77, -0.02, 0.0])
NAMES = ("velocity_limits", "acceleration_limits", "jerk_limits")


@st.composite
def motions(draw):
    """A pose relative to the start, within 12 cm and 0.4 rad of it."""
    return pose(0.07 * draw(directions), 0.23 * draw(directions))


def from_home(model, motion, duration, **others):
    q = model.spec.home
    T = model.fk(q)
    return straight_line(model, q, T, T @ motion, duration, **others)


def ends(model, motion):
    T = model.fk(model.spec.home)
    return T, T @ motion


def farthest_off(model, line, n=300):
    """How far the tool is from the line, [m] or [rad], at `n` places of the joint path."""
    s = np.linspace(0, 1, n)
    q = line.path.positions(s)
    return max(max(distance(model.fk(each), line.T_at(at))) for each, at in zip(q, s, strict=True))


def count_knots(line):
    return len(line.path.spline.c)


# --- geometry -----------------------------------------------------------------------------------


@PROPERTY
@given(motion=motions(), duration=durations)
def test_every_pose_is_on_the_line(model, motion, duration):
    T_a, T_b = ends(model, motion)
    line = from_home(model, motion, duration)
    dp, turn = T_b[:3, 3] - T_a[:3, 3], log_rotation(T_a[:3, :3].T @ T_b[:3, :3])
    for time in np.linspace(0, line.duration, 50):
        s, T = line.s(time), line.T_world_tool(time)
        assert np.abs(T[:3, 3] - (T_a[:3, 3] + s * dp)).max() < 1e-9
        assert angle_between(T[:3, :3], T_a[:3, :3] @ exp_rotation(s * turn)) < 1e-7


@PROPERTY
@given(motion=motions(), deviation=st.sampled_from([1e-5, 2e-5, 1e-4, 1e-3]))
def test_the_joints_keep_the_tool_on_the_line_as_nearly_as_is_said(model, motion, deviation):
    line = from_home(model, motion, 2.0, deviation=deviation)
    # It is sampled half way between knots; at the path's ends it may be a little more elsewhere.
    assert farthest_off(model, line) <= 1.3 * deviation + IK_ACCURACY


def test_unless_specified_otherwise_the_tool_is_within_0_02_mm_of_the_line(model):
    line = from_home(model, pose([0.1, 0.05, -0.05], [0.1, 0.3, -0.2]), 2.0)
    assert farthest_off(model, line) <= 2e-5


def test_more_knots_are_used_where_the_joints_bend_and_fewer_do_where_less_is_asked_for(model):
    # Wrist 1 and 3 turn sharply, the more the nearer to the singularity.
    counts = []
    for wrist_2, deviation in ((-0.1, 1e-3), (-0.1, 2e-5), (-0.02, 2e-5)):
        q = np.array([*NEARLY_SINGULAR[:4], wrist_2, 0.0])
        T = model.fk(q)
        reach = 0.12 if wrist_2 == -0.1 else 0.08
        line = straight_line(model, q, T, T @ pose([0, 0, reach]), 1.0, deviation=deviation)
        assert farthest_off(model, line) <= 1.3 * deviation + IK_ACCURACY
        assert line.duration > 1
        assert_within_limits(model, line)
        counts.append(count_knots(line))
    assert counts == [13, 25, 49]
    assert count_knots(from_home(model, pose([0.1, 0.1, 0]), 2.0)) == 13


@PROPERTY
@given(motion=motions())
def test_the_path_starts_at_the_start_and_stays_on_its_branch_within_limits(model, motion):
    line = from_home(model, motion, 2.0)
    q = line.path.positions(np.linspace(0, 1, 200))
    np.testing.assert_allclose(q[0], model.spec.home, atol=1e-5)
    assert np.abs(np.diff(q, axis=0)).max() < 0.05
    assert ((model.lower <= q) & (q <= model.upper)).all()


def test_a_line_of_no_length_stays_where_it_is(model):
    line = from_home(model, np.eye(4), 1.0)
    assert line.duration == 1.0
    times = line.times(10)
    for time in times:
        np.testing.assert_allclose(line.T_world_tool(time), ends(model, np.eye(4))[0], atol=1e-12)
    np.testing.assert_allclose(
        line.joints(times), np.tile(model.spec.home, (len(times), 1)), atol=1e-6
    )


# --- time ---------------------------------------------------------------------------------------


@PROPERTY
@given(motion=motions(), duration=durations)
def test_a_line_takes_its_duration_or_longer_from_rest_to_rest(model, motion, duration):
    line = from_home(model, motion, duration)
    T_start, T_end = ends(model, motion)
    assert line.duration >= duration
    if line.duration > duration:
        assert line.duration * 10 == pytest.approx(round(line.duration * 10), abs=1e-9)
    np.testing.assert_allclose(line.T_world_tool(0.0), T_start, atol=1e-9)
    np.testing.assert_allclose(line.T_world_tool(line.duration), T_end, atol=1e-9)
    assert (line.s(0.0), line.s(line.duration)) == (0, 1)
    at_ends = np.array([0.0, line.duration])
    for derivative in line.derivatives(at_ends)[:2]:
        assert np.abs(derivative).max() < 1e-6


def test_a_usual_line_takes_exactly_the_time_asked_for(model):
    for duration in (1.0, 1.4, 2.0, 5.0):
        assert (
            from_home(model, pose([0.05, 0.0, -0.05], [0, 0.1, 0]), duration).duration == duration
        )


@pytest.mark.parametrize("duration", [0.01, 0.05, 0.2])
def test_too_short_a_duration_makes_the_line_take_longer(model, duration):
    line = from_home(model, pose([0.1, 0, 0]), duration)
    assert 0.2 < line.duration < 2
    assert line.duration * 10 == pytest.approx(round(line.duration * 10), abs=1e-9)
    assert_within_limits(model, line)


def test_a_line_whose_joints_are_slow_takes_longer(with_limits):
    slow = with_limits(velocity_limits=np.full(6, 0.1))
    line = from_home(slow, pose([0.1, 0, 0]), 1.0)
    assert 2 < line.duration < 8
    assert_within_limits(slow, line)


def assert_within_limits(model, line):
    """By the derivatives that the motion tells, and by differences of its joints."""
    times = np.arange(round(line.duration * 2400) + 1) / 2400
    for name, values in zip(NAMES, line.derivatives(times), strict=True):
        assert (np.abs(values) <= getattr(model.spec, name) * (1 + 1e-9)).all(), name
    q = line.joints(times)
    # At rest before and after.
    q = np.concatenate([np.repeat(q[:1], 3, 0), q, np.repeat(q[-1:], 3, 0)])
    for n, name in enumerate(NAMES[:2], 1):
        greatest = np.abs(np.diff(q, n=n, axis=0) * 2400**n).max(0)
        assert (greatest <= getattr(model.spec, name) * (1 + 1e-3)).all(), name


@PROPERTY
@given(motion=motions(), duration=st.floats(0.05, 1.5))
def test_joint_velocity_acceleration_and_jerk_stay_within_their_limits(model, motion, duration):
    assert_within_limits(model, from_home(model, motion, duration))


@PROPERTY
@given(motion=motions(), name=st.sampled_from(NAMES))
def test_a_line_that_would_break_a_limit_takes_longer(model, with_limits, motion, name):
    line = from_home(model, motion, 1.0)
    times = np.linspace(0, line.duration, 1000)
    greatest = np.abs(line.derivatives(times)[NAMES.index(name)]).max(0)
    assume((greatest > 1e-3).all())
    slower = with_limits(**{name: 0.97 * greatest})
    longer = from_home(slower, motion, 1.0)
    assert longer.duration > line.duration
    assert_within_limits(slower, longer)


@PROPERTY
@given(motion=motions(), duration=durations)
def test_the_path_parameter_never_runs_back(model, motion, duration):
    line = from_home(model, motion, duration)
    s = [line.s(time) for time in np.linspace(0, line.duration, 400)]
    assert (np.diff(s) >= -1e-12).all()


@pytest.mark.parametrize("duration", [0.65, 1.0, 2.0, 5.0])
def test_cruise_is_reached_within_0_3_s_and_left_within_0_3_s_of_the_end(model, duration):
    line = from_home(model, pose([0.05, 0.0, -0.05], [0, 0.1, 0]), duration)
    t = np.linspace(0, line.duration, 4001)
    speed = np.gradient([line.s(x) for x in t], t)
    brisk = speed >= 0.9 * speed.max()
    assert brisk[(t >= 0.3) & (t <= line.duration - 0.3)].all()


@pytest.mark.parametrize(("hz", "duration", "n"), [(10, 2.0, 20), (10, 0.97, 10), (30, 1.0, 30)])
def test_poses_at_its_times_end_at_the_end(model, hz, duration, n):
    motion = pose([0.03, 0.0, -0.03], [0, 0.1, 0])
    line = from_home(model, motion, duration)
    Ts = check_poses("Ts", np.stack([line.T_world_tool(time) for time in line.times(hz)]))
    assert len(Ts) == n
    np.testing.assert_allclose(Ts[-1], ends(model, motion)[1], atol=1e-9)


# --- what can't be done -------------------------------------------------------------------------


@pytest.mark.parametrize("duration", [0, -1, np.nan, np.inf])
def test_a_duration_that_is_not_positive_is_refused(model, duration):
    with pytest.raises(InvalidInput, match="duration: expected a finite number > 0 s"):
        from_home(model, np.eye(4), duration)


@pytest.mark.parametrize("deviation", [0, -1e-5, np.nan, np.inf])
def test_a_deviation_that_is_not_positive_is_refused(model, deviation):
    with pytest.raises(InvalidInput, match="deviation: expected a finite number > 0 m"):
        from_home(model, np.eye(4), 1.0, deviation=deviation)


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


def test_a_line_nearer_to_its_poses_than_inverse_kinematics_is_rejected(model):
    with pytest.raises(MotionRejected, match="joint path: .* mm off the line with 193 knots, a"):
        from_home(model, pose([0.1, 0.1, 0]), 2.0, deviation=1e-12)


@pytest.mark.parametrize(
    ("rotvec", "message"), [([0.6, 0, 0], "joint jump: a step"), ([0, -0.6, 0], "joint path: .* a")]
)
def test_a_line_through_a_singularity_is_rejected(model, rotvec, message):
    T = model.fk(NEARLY_SINGULAR)
    with pytest.raises(MotionRejected, match=message):
        straight_line(model, NEARLY_SINGULAR, T, T @ pose(rotvec=rotvec), 1.0)


def test_a_line_to_the_end_of_a_joints_range_is_rejected(model):
    q = np.array(model.spec.home)
    q[5] = model.upper[5] - 0.05
    T = model.fk(q)
    straight_line(model, q, T, T @ pose(rotvec=[0, 0, 0.04]), 1.0)
    with pytest.raises(
        (MotionRejected, Unreachable), match="leaves the range of wrist_3_joint|within joint limits"
    ):
        straight_line(model, q, T, T @ pose(rotvec=[0, 0, 0.0499]), 1.0)


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
    both = {"T_world_start": T, "T_world_end": T, f"T_world_{which}": np.zeros((4, 4))}
    with pytest.raises(InvalidInput, match=f"T_world_{which}: not a rigid transform"):
        straight_line(model, model.spec.home, **both, duration=2.0)


@pytest.mark.parametrize("q", [np.zeros(5), np.full(6, np.nan)], ids=["short", "NaN"])
def test_joints_that_are_no_configuration_are_refused(model, q):
    T = model.fk(model.spec.home)
    with pytest.raises(InvalidInput, match="q: "):
        straight_line(model, q, T, T, 2.0)


def test_a_timing_that_ruckig_does_not_find_is_rejected(model, monkeypatch):
    class Helpless:
        def __init__(self, _):
            pass

        def calculate(self, *_):
            return Result.ErrorExecutionTimeCalculation

    monkeypatch.setattr(timing, "Ruckig", Helpless)
    with pytest.raises(MotionRejected, match="timing: Ruckig found none .*; allow more time"):
        from_home(model, pose([0.1, 0, 0]), 2.0)
