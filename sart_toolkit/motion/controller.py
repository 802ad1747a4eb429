"""From desired tool poses to joint targets, the same way for whatever moves the robot."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sart_toolkit.errors import InvalidInput, MotionRejected
from sart_toolkit.poses import (
    Array,
    angle_between,
    check_pose,
    check_positive,
    distance,
    exp_rotation,
    interpolate,
    log_rotation,
    orthonormalised,
)
from sart_toolkit.robots.model import RobotModel


@dataclass(frozen=True)
class ControllerConfig:
    """Bounds of the `ToolController`.

    `max_lead` [m], `max_lead_deg`: how far the commanded pose may be from the measured one.
    `max_joint_step` [rad]: greatest joint motion in one control period.
    """

    max_lead: float = 0.020
    max_lead_deg: float = 5.0
    max_joint_step: float = 0.35

    def __post_init__(self) -> None:
        check_positive("max_lead", self.max_lead, "m")
        check_positive("max_lead_deg", self.max_lead_deg, "deg")
        check_positive("max_joint_step", self.max_joint_step, "rad")


class ToolController:
    """Turns desired tool poses into joint targets for consecutive control periods.

    The commanded pose is held to within `max_lead` of the measured one. Pressing against something
    is so bounded in force, and the command is never re-anchored to the measurement.
    """

    def __init__(self, model: RobotModel, config: ControllerConfig | None = None) -> None:
        """Control the tool of `model`; call `reset` before `move`."""
        self.model = model
        self.config = config or ControllerConfig()
        self._q = np.array(model.spec.home)
        self._T = model.fk(self._q)

    def reset(self, q_commanded: Array, T_world_tool_commanded: Array | None = None) -> None:
        """Start from joint targets `(n,)`, at the commanded pose `(4, 4)` that they stand for.

        Nothing changes if an error is raised.

        Raises:
            InvalidInput: not a joint configuration, or not a pose.
        """
        q = self.model.check_q(q_commanded)
        T = (
            self.model.fk(q)
            if T_world_tool_commanded is None
            else check_pose("T_world_tool_commanded", T_world_tool_commanded)
        )
        self._q, self._T = q, T

    def acknowledge(self, q_sent: Array) -> None:
        """Continue from the joint targets `(n,)` that the robot was really sent.

        They are the last ones of `move` or `follow`, unless the robot can't go so far in one step.

        Raises:
            InvalidInput: not a joint configuration.
        """
        if not np.array_equal(q_sent, self._q):
            self.reset(q_sent)

    @property
    def commanded_T_world_tool(self) -> Array:
        """The tool pose `(4, 4)` commanded last."""
        return self._T.copy()

    @property
    def commanded_q(self) -> Array:
        """The joint targets `(n,)` [rad] commanded last."""
        return self._q.copy()

    def move(self, desired_T_world_tool: Array, measured_T_world_tool: Array, n: int) -> Array:
        """Joint targets `(periods, n_joints)` that bring the command to a desired pose.

        The desired pose is first clamped to the measured one, then approached in a straight line.
        Nothing changes if an error is raised.

        Args:
            desired_T_world_tool: pose `(4, 4)` wanted at the end of `n` control periods.
            measured_T_world_tool: where the tool is now `(4, 4)`.
            n: number of control periods.

        Raises:
            InvalidInput: not a pose, or `n` is not positive.
            Unreachable: no joint configuration within limits.
            MotionRejected: a joint would jump.
        """
        if n < 1:
            raise InvalidInput(f"n: expected at least 1 control period, got {n}")
        goal = self.clamped(
            check_pose("desired_T_world_tool", desired_T_world_tool),
            check_pose("measured_T_world_tool", measured_T_world_tool),
        )
        targets = np.empty((n, len(self._q)))
        q = self._q
        for i in range(n):
            T = goal if i == n - 1 else interpolate(self._T, goal, (i + 1) / n)
            q = targets[i] = self.model.ik(T, q, self.config.max_joint_step)
        self._q, self._T = q.copy(), goal
        return targets

    def follow(self, q: Array, T_world_tool: Array, measured_T_world_tool: Array) -> None:
        """Take the next joint target `(n,)` of a motion planned before, and the pose it stands for.

        Nothing changes if an error is raised.

        Raises:
            InvalidInput: not a joint configuration, or not a pose.
            MotionRejected: the pose is farther from the measured one than a command may be.
        """
        measured = check_pose("measured_T_world_tool", measured_T_world_tool)
        T = check_pose("T_world_tool", T_world_tool)
        if not np.array_equal(self.clamped(T, measured), T):
            far, turn = distance(measured, T)
            raise MotionRejected(
                f"tool lags behind: {far * 1e3:.0f} mm and {np.rad2deg(turn):.0f} deg; allow more "
                "time"
            )
        self._q, self._T = self.model.check_q(q), T

    def clamped(self, desired: Array, measured: Array) -> Array:
        """The pose nearest to `desired` within the allowed lead of `measured`, both `(4, 4)`."""
        result = desired.copy()
        offset = desired[:3, 3] - measured[:3, 3]
        far = float(np.linalg.norm(offset))
        if far > self.config.max_lead:
            result[:3, 3] = measured[:3, 3] + offset * (self.config.max_lead / far)
        limit = np.deg2rad(self.config.max_lead_deg)
        if angle_between(measured[:3, :3], desired[:3, :3]) > limit:
            rotvec = log_rotation(measured[:3, :3].T @ desired[:3, :3])
            R = measured[:3, :3] @ exp_rotation(rotvec * (limit / np.linalg.norm(rotvec)))
            result[:3, :3] = orthonormalised(R)
        return result
