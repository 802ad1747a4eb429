"""Motions in time: a joint path, its timing by Ruckig, and the tool's pose along it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from ruckig import InputParameter, Result, Ruckig, Trajectory

from sart_toolkit.data.records import DEFAULT_RATES
from sart_toolkit.errors import MotionRejected
from sart_toolkit.motion.path import SplinePath
from sart_toolkit.poses import Array, check_positive
from sart_toolkit.robots.model import RobotModel
from sart_toolkit.robots.spec import RobotSpec

_RAMP = 0.25
_JERK_SHARE = 0.4
_LONGEST = 600.0
_LIMIT_MARGIN = 1e-3
_ROUNDING = 1e-6


@dataclass(frozen=True)
class Motion:
    """A joint path with its course in time, at rest at both ends.

    Attributes:
        path: the joint path over s in [0, 1].
        duration: seconds, no less than was asked for, in whole recorded steps.
        T_at: the tool pose `(4, 4)` that a path parameter stands for.
    """

    path: SplinePath
    duration: float
    T_at: Callable[[float], Array]
    _timing: Trajectory

    def s(self, time: float) -> float:
        """The path parameter in [0, 1] at a time [s]."""
        if time >= self.duration:
            return 1.0
        position, _, _ = self._timing.at_time(max(time, 0.0))
        return min(max(float(position[0]), 0.0), 1.0)

    def T_world_tool(self, time: float) -> Array:
        """The tool pose `(4, 4)` at a time [s]."""
        return self.T_at(self.s(time))

    def times(self, hz: float) -> Array:
        """The times [s] 1/hz, 2/hz, ... up to the end, evenly spread."""
        n = max(1, round(self.duration * hz))
        return self.duration * (np.arange(1, n + 1) / n)

    def joints(self, times: Array) -> Array:
        """Joint configurations `(k, n)` [rad] at times `(k,)` [s]."""
        return self.path.positions(np.array([self.s(time) for time in times]))

    def derivatives(self, times: Array) -> tuple[Array, Array, Array]:
        """Joint velocities, accelerations and jerks `(k, n)` at times `(k,)` [s].

        By the chain rule from the derivatives of path and timing: q' s', q' s'' + q'' s'^2,
        q' s''' + 3 q'' s' s'' + q''' s'^3.
        """
        timing = [self._timing.at_time(float(np.clip(time, 0.0, self.duration))) for time in times]
        s, v, a = (np.array([row[i][0] for row in timing]) for i in range(3))
        j = self._jerks(times)
        q1, q2, q3 = (self.path.spline(np.clip(s, 0.0, 1.0), nu=i) for i in (1, 2, 3))
        v, a, j = v[:, None], a[:, None], j[:, None]
        return q1 * v, q1 * a + q2 * v**2, q1 * j + 3 * q2 * v * a + q3 * v**3

    def _jerks(self, times: Array) -> Array:
        """s''' `(k,)` at times: the timing is made of pieces of constant jerk."""
        profile = self._timing.profiles[0][0]
        pieces = np.asarray(profile.j)
        ends = np.cumsum(profile.t)
        at = np.minimum(np.searchsorted(ends, times, side="right"), len(pieces) - 1)
        inside = (np.asarray(times) >= 0) & (np.asarray(times) <= self.duration)
        return np.where(inside, pieces[at], 0.0)


def timed(
    model: RobotModel,
    path: SplinePath,
    duration: float,
    T_at: Callable[[float], Array],
    record_hz: int = DEFAULT_RATES.record_hz,
) -> Motion:
    """The motion along a joint path that takes `duration`, or as much longer as the joints need.

    It takes a whole number of recorded steps: `duration` is rounded up to these.

    The path parameter s rises from 0 to 1 with short jerk-limited ramps (cruise within 0.25 s:
    slow starts and ends make poor training data). The greatest |q'|, |q''| and |q'''| of the path
    bound s', s'' and s''' so that every joint's limits hold: |q'| s' <= v,
    |q'| s'' + |q''| s'^2 <= a, |q'| s''' + 3 |q''| s' s'' + |q'''| s'^3 <= j (shared/reference,
    section 5). Where that takes longer than `duration` the motion is slowed down as a whole.

    Args:
        model: the robot.
        path: its joint path.
        duration: seconds from rest to rest, if the limits allow.
        T_at: the tool pose `(4, 4)` at a path parameter.
        record_hz: recorded steps a second.

    Raises:
        InvalidInput: duration not positive.
        MotionRejected: the path leaves the joints' ranges, or no time is enough for it.
    """
    # What is a whole number of steps but for rounding stays as it is.
    steps = int(np.ceil(check_positive("duration", duration, "s") * record_hz - _ROUNDING))
    duration = max(1, steps) / record_hz
    # A spline lies within the range of its coefficients.
    low, high = path.spline.c.min(0), path.spline.c.max(0)
    over = np.maximum(model.lower + _LIMIT_MARGIN - low, high - model.upper + _LIMIT_MARGIN)
    if over.max() > 0:
        joint = model.spec.arm_joints[int(np.argmax(over))]
        raise MotionRejected(f"joint limits: the path leaves the range of {joint}; sample nearer")
    timing = _timing(path, model.spec, duration)
    if timing is None:
        # In recorded steps: the fewest that are enough, and some that aren't.
        enough, few = round(_LONGEST * record_hz), max(1, steps)
        if few >= enough or _timing(path, model.spec, _LONGEST) is None:
            raise MotionRejected(
                f"joint limits: the path needs more than {_LONGEST:.0f} s; sample nearer"
            )
        while enough - few > 1:
            middle = (enough + few) // 2
            if _timing(path, model.spec, middle / record_hz) is None:
                few = middle
            else:
                enough = middle
        duration = enough / record_hz
        timing = _timing(path, model.spec, duration)
        assert timing is not None
    return Motion(path, duration, T_at, timing)


def _timing(path: SplinePath, spec: RobotSpec, duration: float) -> Trajectory | None:
    """The timing that just fills `duration`, or None where a joint's limit forbids it."""
    ramp = min(_RAMP, duration / 4)
    v = 1.0 / (duration - ramp)
    # A ramp of length r with constant-jerk ends of share e: a = v / (r (1 - e)), j = a / (r e).
    a = v / (ramp * (1.0 - _JERK_SHARE))
    j = a / (ramp * _JERK_SHARE)
    d1, d2, d3 = path.most
    if (
        (d1 * v > spec.velocity_limits).any()
        or (d1 * a + d2 * v**2 > spec.acceleration_limits).any()
        or (d1 * j + 3 * d2 * v * a + d3 * v**3 > spec.jerk_limits).any()
    ):
        return None
    request = InputParameter(1)
    request.current_position, request.target_position = [0.0], [1.0]
    request.max_velocity, request.max_acceleration, request.max_jerk = [v], [a], [j]
    trajectory = Trajectory(1)
    result = Ruckig(1).calculate(request, trajectory)
    if result not in (Result.Working, Result.Finished):
        raise MotionRejected(f"timing: Ruckig found none ({result}); allow more time")
    return trajectory
