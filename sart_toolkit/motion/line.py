"""Straight tool lines in time: p linear, R geodesic, timed by Ruckig within the joints' limits."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from ruckig import InputParameter, Result, Ruckig, Trajectory
from scipy.interpolate import make_interp_spline

from sart_toolkit.errors import MotionRejected
from sart_toolkit.poses import Array, check_pose, check_positive, interpolate
from sart_toolkit.robots.model import RobotModel

_KNOTS = 25
_RAMP = 0.25
_JERK_SHARE = 0.4


@dataclass(frozen=True)
class StraightLine:
    """A timed straight tool line at rest at both ends.

    Attributes:
        T_world_start, T_world_end: end poses `(4, 4)`.
        duration: seconds.
        knots: `(m, n)` joint configurations at equal steps of the path parameter s in [0, 1].
    """

    T_world_start: Array
    T_world_end: Array
    duration: float
    knots: Array
    _timing: Trajectory

    def s(self, time: float) -> float:
        """The path parameter in [0, 1] at a time [s]."""
        position, _, _ = self._timing.at_time(min(max(time, 0.0), self.duration))
        return float(np.clip(position[0], 0.0, 1.0))

    def T_world_tool(self, time: float) -> Array:
        """The tool pose `(4, 4)` at a time [s]."""
        if time >= self.duration:
            return self.T_world_end.copy()
        return interpolate(self.T_world_start, self.T_world_end, self.s(time))

    def sample(self, hz: float) -> Array:
        """Tool poses `(n, 4, 4)` at 1/hz, 2/hz, ... up to the end."""
        n = max(1, round(self.duration * hz))
        return np.stack([self.T_world_tool(self.duration * (i + 1) / n) for i in range(n)])


def straight_line(
    model: RobotModel,
    q_start: Array,
    T_world_start: Array,
    T_world_end: Array,
    duration: float,
    max_joint_step: float = 0.35,
) -> StraightLine:
    """A straight tool line that takes `duration` seconds and keeps the joints within their limits.

    The path parameter s rises from 0 to 1 with short jerk-limited ramps (cruise within 0.25 s:
    slow starts and ends make poor training data). The joint path is the quintic spline q(s) through
    inverse-kinematics solutions; its derivatives bound s', s'' and s''' so that the joints' limits
    hold (shared/reference, section 5: |q'| s' <= v, |q'| s'' + |q''| s'^2 <= a,
    |q'| s''' + 3 |q''| s' s'' + |q'''| s'^3 <= j).

    Args:
        model: the robot.
        q_start: joint configuration `(n,)` at the start.
        T_world_start: tool pose there `(4, 4)`.
        T_world_end: tool pose at the end `(4, 4)`.
        duration: seconds from rest to rest.
        max_joint_step: greatest joint motion [rad] between neighbouring knots.

    Raises:
        InvalidInput: not a pose, or duration not positive.
        Unreachable: some pose of the line is out of reach.
        MotionRejected: a joint would jump, or the line can't be done in `duration`.
    """
    start, end = check_pose("T_world_start", T_world_start), check_pose("T_world_end", T_world_end)
    duration = check_positive("duration", duration, "s")
    grid = np.linspace(0.0, 1.0, _KNOTS)
    knots = np.empty((_KNOTS, len(q_start)))
    knots[0] = model.ik(start, q_start, max_joint_step)
    for i in range(1, _KNOTS):
        # Extrapolating from the last two knots keeps the solver on its branch.
        near = knots[i - 1] if i < 2 else 2 * knots[i - 1] - knots[i - 2]
        near = np.clip(near, model.lower, model.upper)
        knots[i] = model.ik(interpolate(start, end, grid[i]), near, max_joint_step)
    limits = _path_limits(model, grid, knots, duration)
    timing = _timed(limits)
    if timing.duration > duration + 1e-6:
        raise MotionRejected(
            f"joint limits: the line needs {timing.duration:.2f} s, {duration:.2f} s were given; "
            "allow more time or sample nearer"
        )
    return StraightLine(start, end, duration, knots, timing)


def _path_limits(
    model: RobotModel, grid: Array, knots: Array, duration: float
) -> tuple[float, float, float]:
    """Limits of s', s'', s''': those that just fill `duration`, or less where joints demand it."""
    ramp = min(_RAMP, duration / 4)
    v = 1.0 / (duration - ramp)
    # A ramp of length r with constant-jerk ends of share e: a = v / (r (1 - e)), j = a / (r e).
    a = v / (ramp * (1.0 - _JERK_SHARE))
    j = a / (ramp * _JERK_SHARE)
    spline = make_interp_spline(grid, knots, k=5)
    fine = np.linspace(0.0, 1.0, 4 * _KNOTS)
    d1, d2, d3 = (np.abs(spline.derivative(i)(fine)).max(0) for i in (1, 2, 3))
    spec = model.spec
    tiny = 1e-12
    v = min(v, float((spec.velocity_limits / (d1 + tiny)).min()))
    a = min(a, float(((spec.acceleration_limits - d2 * v**2) / (d1 + tiny)).min()))
    if a <= 0:
        raise MotionRejected(
            "joint limits: the line bends too sharply at its speed; allow more time"
        )
    j = min(j, float(((spec.jerk_limits - 3 * d2 * v * a - d3 * v**3) / (d1 + tiny)).min()))
    if j <= 0:
        raise MotionRejected(
            "joint limits: the line needs more jerk than they allow; allow more time"
        )
    return v, a, j


def _timed(limits: tuple[float, float, float]) -> Trajectory:
    request = InputParameter(1)
    request.current_position, request.target_position = [0.0], [1.0]
    v, a, j = limits
    request.max_velocity, request.max_acceleration, request.max_jerk = [v], [a], [j]
    trajectory = Trajectory(1)
    result = Ruckig(1).calculate(request, trajectory)
    if result != Result.Working and result != Result.Finished:
        raise MotionRejected(f"joint limits: Ruckig found no timing ({result}); allow more time")
    return trajectory
