"""Straight tool lines: p linear, R geodesic, by a smooth joint path on one branch."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sart_toolkit.data.records import DEFAULT_RATES
from sart_toolkit.errors import MotionRejected
from sart_toolkit.motion.path import SplinePath
from sart_toolkit.motion.timing import Motion, timed
from sart_toolkit.poses import Array, StraightLine, check_pose, check_positive, distance
from sart_toolkit.robots.model import RobotModel

# The number of knots is doubled until the tool's deviation is within bounds.
_FEWEST, _MANY, _MOST = 13, 49, 200


def straight_line(
    model: RobotModel,
    q_start: Array,
    T_world_start: Array,
    T_world_end: Array,
    duration: float,
    max_joint_step: float = 0.35,
    deviation: float = 2e-5,
    record_hz: int = DEFAULT_RATES.record_hz,
) -> Motion:
    """The motion of the tool in a straight line, in `duration` or as much longer as joints need.

    An arm of fewer than six joints follows the line's positions and turns the tool as far as it
    can. The joint path is a quintic spline through inverse-kinematics solutions on the line, as
    many as keep the tool within `deviation` of it between them. See `timed` for its course in time.

    Args:
        model: the robot.
        q_start: joint configuration `(n,)` at the start.
        T_world_start: tool pose there `(4, 4)`.
        T_world_end: tool pose at the end `(4, 4)`.
        duration: seconds from rest to rest, if the limits allow.
        max_joint_step: greatest joint motion [rad] between neighbouring knots.
        deviation: how far the tool may be from the line, [m] and [rad].
        record_hz: recorded steps a second.

    Raises:
        InvalidInput: not a pose, or duration or deviation not positive.
        Unreachable: some pose of the line is out of reach.
        MotionRejected: a joint would jump, or leave its range, or the line bends too much.
    """
    start, end = check_pose("T_world_start", T_world_start), check_pose("T_world_end", T_world_end)
    check_positive("duration", duration, "s")
    check_positive("deviation", deviation, "m")
    T_at = StraightLine(start, end)
    count = _FEWEST
    try:
        knots = _solutions(model, q_start, T_at, np.linspace(0.0, 1.0, count), max_joint_step)
    except MotionRejected:
        # A joint that turns quickly may only seem to jump.
        count = _MANY
        knots = _solutions(model, q_start, T_at, np.linspace(0.0, 1.0, count), max_joint_step)
    while True:
        path = SplinePath.through(knots)
        middles = (np.arange(count - 1) + 0.5) / (count - 1)
        between = path.positions(middles)
        # Next to the path's ends a spline is farthest off nearer to these than half way.
        sampled = np.concatenate([middles, np.array([0.25, 0.35]) / (count - 1)])
        sampled = np.concatenate([sampled, 1 - sampled[-2:]])
        # An arm of fewer than six joints is held to the positions, and turns as far as it can.
        errors = 2 if len(q_start) >= 6 else 1
        off = max(
            max(distance(model.fk(q), T_at(s))[:errors])
            for q, s in zip(path.positions(sampled), sampled, strict=True)
        )
        if off <= deviation:
            poses = T_at if errors == 2 else _PosesOf(model, path)
            return timed(model, path, duration, poses, record_hz)
        if 2 * count > _MOST:
            raise MotionRejected(
                f"joint path: {off * 1e3:.2f} mm off the line with {count} knots, a joint turns "
                "too sharply; sample nearer"
            )
        # The solutions between the knots are found from where the spline is already.
        new = np.array([
            model.ik(T_at(s), q, max_joint_step) for q, s in zip(between, middles, strict=True)
        ])  # fmt: skip
        count = 2 * count - 1
        merged = np.empty((count, knots.shape[1]))
        merged[::2], merged[1::2] = knots, new
        knots = merged


def _solutions(
    model: RobotModel, q_start: Array, T_at: StraightLine, grid: Array, max_step: float
) -> Array:
    """Joint configurations `(m, n)` at path parameters `(m,)`, on the branch of `q_start`."""
    knots = np.empty((len(grid), len(q_start)))
    for i, s in enumerate(grid):
        # Extrapolating from the last two knots keeps the solver on its branch.
        near = q_start if i == 0 else knots[i - 1] if i == 1 else 2 * knots[i - 1] - knots[i - 2]
        near = near if i == 0 else np.clip(near, model.lower, model.upper)
        knots[i] = model.ik(T_at(float(s)), near, max_step)
    return knots


@dataclass(frozen=True)
class _PosesOf:
    """The tool's poses on a joint path."""

    model: RobotModel
    path: SplinePath

    def __call__(self, s: float) -> Array:
        """The pose `(4, 4)` at path parameter `s`."""
        return self.model.fk(self.path.positions(np.array([s]))[0])
