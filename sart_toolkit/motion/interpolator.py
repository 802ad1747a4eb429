"""Joint targets at a backend's own rate, smooth and within limits, from a goal a period."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from ruckig import InputParameter, Result, Ruckig, RuckigError, Synchronization, Trajectory

from sart_toolkit.data.records import DEFAULT_RATES, Rates
from sart_toolkit.poses import Array
from sart_toolkit.robots.model import RobotModel

# A uniform cubic B-spline's piece in powers of u, from four control points.
_BASIS = np.array([[1, 4, 1, 0], [-3, 0, 3, 0], [3, -6, 3, 0], [-1, 3, -3, 1]]) / 6
# So little [rad, with seconds as control periods] off the spline is rounding.
_ON_SPLINE = 1e-10
# Ruckig ends at most this share of the limits in motion, so that it can always brake.
_SHARE = 0.9


class JointInterpolator:
    """Turns joint goals, one in each control period, into targets at a backend's own rate.

    The goals are the control points of a uniform cubic B-spline: what is sent follows them one
    control period late, exactly straight where they are in line, never beyond them, and with
    finite jerk. Where a piece of it would exceed a joint's limit of velocity, acceleration or jerk,
    Ruckig leads the joints back onto the spline as fast as the limits allow. So the n-th finite
    differences of all that is sent keep the limits, whatever the goals are.

    Attributes:
        sent: the joint targets `(n,)` [rad] sent last.
    """

    def __init__(self, model: RobotModel, rates: Rates = DEFAULT_RATES) -> None:
        """Follow goals for the joints of `model`, given and sent at `rates`."""
        spec = model.spec
        self._model = model
        self._dt = 1.0 / rates.control_hz
        count = rates.physics_per_control
        self._times = self._dt * np.arange(1, count + 1) / count
        powers = (np.arange(1, count + 1) / count)[:, None] ** np.arange(4)
        self._weights = powers @ _BASIS
        self._limits = spec.velocity_limits, spec.acceleration_limits, spec.jerk_limits
        self._ruckig = Ruckig(len(spec.arm_joints))
        self.reset(np.array(spec.home))

    def reset(self, q: Array, dq: Array | None = None) -> None:
        """Start from joints `q (n,)` [rad], at rest or moving at `dq (n,)` [rad/s]; stay there."""
        self._goals = np.repeat(np.array(q, dtype=np.float64)[None], 3, axis=0)
        v = np.zeros(len(q)) if dq is None else np.array(dq, dtype=np.float64)
        self._state = self._goals[0], v, np.zeros(len(q))

    @property
    def sent(self) -> Array:
        """The joint targets `(n,)` [rad] sent last."""
        return self._state[0].copy()

    @property
    def settled(self) -> bool:
        """Whether the joints are sent to the last goal and to stay there."""
        return bool((self._goals == self._goals[-1]).all()) and self._on_spline()

    def towards(self, goal: Array) -> Array:
        """The targets `(m, n)` [rad] of the next control period, at even steps, towards a goal.

        Args:
            goal: joints `(n,)` [rad] within their limits.
        """
        follows = self._on_spline()
        goals = np.concatenate([self._goals, np.asarray(goal, dtype=np.float64)[None]])
        self._goals = goals[1:]
        if follows and self._within_limits(goals):
            self._state = self._spline_state()
            rows = self._weights @ goals
            # Rounding would have a resting joint move by its last digit.
            still = (goals == goals[-1]).all(0)
            rows[:, still] = goals[-1, still]
            rows[-1] = self._state[0]
            return np.asarray(rows)
        return self._caught_up()

    def _spline_state(self) -> tuple[Array, Array, Array]:
        """Where the spline of the last three goals ends: positions, velocities, accelerations."""
        a, b, c = self._goals
        still = (a == b) & (b == c)
        q = np.where(still, c, (a + 4 * b + c) / 6)
        return q, (c - a) / (2 * self._dt), (a - 2 * b + c) / self._dt**2

    def _on_spline(self) -> bool:
        units = 1.0, self._dt, self._dt**2
        return all(
            np.abs((at - on) * unit).max() <= _ON_SPLINE
            for at, on, unit in zip(self._state, self._spline_state(), units, strict=True)
        )

    def _within_limits(self, goals: Array) -> bool:
        """Whether the spline's piece over four goals keeps the limits, and the joints can brake."""
        v_max, a_max, j_max = self._limits
        # The derivatives lie in the hulls of their own control points.
        v, a, j = (np.diff(goals, order, axis=0) / self._dt**order for order in (1, 2, 3))
        q_end, v_end, a_end = self._spline_state()
        braking = v_end + a_end * np.abs(a_end) / (2 * j_max)
        return bool(
            (np.abs(v) <= v_max).all()
            and (np.abs(a) <= a_max).all()
            and (np.abs(j) <= j_max).all()
            and (np.abs(braking) <= v_max).all()
            and self._can_stop(q_end, v_end).all()
        )

    def _can_stop(self, q: Array, v: Array) -> NDArray[np.bool_]:
        """For each joint whether it can stop within its range, passing `q` at `v` [rad/s]."""
        _, a_max, j_max = self._limits
        # Of a motion that begins without acceleration; twice that leaves room for one.
        way = np.abs(v) * (np.abs(v) / a_max + a_max / j_max)
        room = np.where(v > 0, self._model.upper - q, q - self._model.lower)
        return np.asarray((way <= room) | (v == 0))

    def _caught_up(self) -> Array:
        """The targets `(m, n)` that lead back onto the spline within the limits, by Ruckig."""
        v_max, a_max, _ = self._limits
        target, v, a = self._spline_state()
        v = np.where(self._can_stop(target, v), np.clip(v, -_SHARE * v_max, _SHARE * v_max), 0.0)
        rest = np.zeros(len(v))
        ends = (v, np.clip(a, -_SHARE * a_max, _SHARE * a_max)), (v, rest), (rest, rest)
        found = [motion for end in ends if (motion := self._motion(target, *end)) is not None]
        inside = [motion for motion in found if self._stays_in_range(motion)]
        # Braking to a rest keeps the limits from any state that they allow.
        motion = (inside or found[-1:])[0]
        rows = np.array([motion.at_time(time)[0] for time in self._times])
        q, dq, ddq = (np.array(each) for each in motion.at_time(self._dt))
        if np.abs(q - target).max() <= _ON_SPLINE:
            # The spline's own value, to the last digit: there the joints may come to rest.
            rows[-1] = target
        rows = np.clip(rows, self._model.lower, self._model.upper)
        self._state = rows[-1], dq, ddq
        return rows

    def _motion(self, q: Array, dq: Array, ddq: Array) -> Trajectory | None:
        """The fastest motion to a state that takes no less than a control period, if any."""
        request = InputParameter(len(q))
        for name, limit in zip(("velocity", "acceleration", "jerk"), self._limits, strict=True):
            setattr(request, f"max_{name}", limit.tolist())
        parts = "position", "velocity", "acceleration"
        for name, now, end in zip(parts, self._state, (q, dq, ddq), strict=True):
            setattr(request, f"current_{name}", now.tolist())
            setattr(request, f"target_{name}", end.tolist())
        request.minimum_duration = self._dt
        # Straight in joint space wherever that can be.
        request.synchronization = Synchronization.Phase
        motion = Trajectory(len(q))
        try:
            result = self._ruckig.calculate(request, motion)
        except RuckigError:
            # An end from which a joint can't but exceed its limits.
            return None
        return motion if result in (Result.Working, Result.Finished) else None

    def _stays_in_range(self, motion: Trajectory) -> bool:
        extrema = motion.position_extrema
        low, high = (np.array([getattr(at, end) for at in extrema]) for end in ("min", "max"))
        return bool((low >= self._model.lower).all() and (high <= self._model.upper).all())
