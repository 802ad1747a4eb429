"""From desired tool poses to joint targets, the same way for whatever moves the robot."""

from __future__ import annotations

import numpy as np

from sart_toolkit.data.records import DEFAULT_RATES, Rates
from sart_toolkit.errors import InvalidInput, MotionRejected
from sart_toolkit.motion.config import ControllerConfig
from sart_toolkit.motion.interpolator import JointInterpolator
from sart_toolkit.poses import (
    Array,
    check_array,
    check_pose,
    distance,
    exp_rotation,
    interpolate,
    log_rotation,
    orthonormalised,
)
from sart_toolkit.robots.model import RobotModel

# So much of the lead that was allowed for the joints' lag is left a control period later.
_FADING = 0.8
_NO_LEAD = 1e-9


class ToolController:
    """Turns desired tool poses into joint targets, smooth and within the robot's limits.

    The commanded pose is held to within `max_lead` of the measured one. Pressing against something
    is so bounded in force, and the command is never re-anchored to the measurement. The joints
    follow the command one control period later, or more where a limit binds (see
    `JointInterpolator`); this lag, up to `max_lead` too, is allowed on top, and fades where the
    command rests.
    """

    def __init__(
        self,
        model: RobotModel,
        config: ControllerConfig | None = None,
        rates: Rates = DEFAULT_RATES,
    ) -> None:
        """Control the tool of `model` at the backend's `rates`; call `reset` before `move`."""
        self.model = model
        self.config = config or ControllerConfig()
        self._interpolator = JointInterpolator(model, rates)
        self._q = np.array(model.spec.home)
        self._T = model.fk(self._q)
        self._most = self.config.max_lead, np.deg2rad(self.config.max_lead_deg)
        # How much more lead [m], [rad] is allowed for the joints' lag.
        self._slack = np.zeros(2)

    def reset(
        self,
        q_commanded: Array,
        T_world_tool_commanded: Array | None = None,
        moving: tuple[Array, Array] | None = None,
    ) -> None:
        """Start from a joint command `(n,)`, at the pose `(4, 4)` that it stands for.

        Nothing changes if an error is raised.

        Args:
            q_commanded: the command in force `(n,)` [rad].
            T_world_tool_commanded: the pose that it stands for; by forward kinematics if left out.
            moving: where the joints are and how fast they move, `(n,)` [rad] and `(n,)` [rad/s], if
                not at rest at the command.

        Raises:
            InvalidInput: not a joint configuration, or not a pose.
        """
        q = self.model.check_q(q_commanded)
        T = (
            self.model.fk(q)
            if T_world_tool_commanded is None
            else check_pose("T_world_tool_commanded", T_world_tool_commanded)
        )
        start = (q, np.zeros_like(q)) if moving is None else tuple(map(self.model.check_q, moving))
        self._q, self._T, self._slack = q, T, np.zeros(2)
        self._interpolator.reset(*start)

    def acknowledge(self, q_sent: Array) -> None:
        """Continue from the joint targets `(n,)` that the robot was really sent.

        They are the last ones of `move` or `follow`, unless the robot can't go so far in one step.

        Raises:
            InvalidInput: not a joint configuration.
        """
        if not np.array_equal(q_sent, self._interpolator.sent):
            self.reset(q_sent)

    @property
    def commanded_T_world_tool(self) -> Array:
        """The tool pose `(4, 4)` commanded last."""
        return self._T.copy()

    @property
    def commanded_q(self) -> Array:
        """The joints `(n,)` [rad] of the pose commanded last; what is sent follows them."""
        return self._q.copy()

    @property
    def settled(self) -> bool:
        """Whether the joints are sent to the command, and to stay there."""
        return self._interpolator.settled and np.array_equal(self._interpolator.sent, self._q)

    def move(self, desired_T_world_tool: Array, measured_T_world_tool: Array, n: int) -> Array:
        """Joint targets `(periods, steps, n_joints)` while the command goes to a desired pose.

        The desired pose is first clamped to the measured one, then approached in a straight line.
        Each control period has its targets at even steps, at the backend's own rate. Nothing
        changes if an error is raised.

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
        desired = check_pose("desired_T_world_tool", desired_T_world_tool)
        measured = check_pose("measured_T_world_tool", measured_T_world_tool)
        slack = self._allowed_lag(measured, n)
        goal = self.clamped(desired, measured, slack)
        goals = np.empty((n, len(self._q)))
        q = self._q
        for i in range(n):
            T = goal if i == n - 1 else interpolate(self._T, goal, (i + 1) / n)
            q = goals[i] = self.model.ik(T, q, self.config.max_joint_step)
        self._q, self._T, self._slack = q.copy(), goal, slack
        return np.stack([self._interpolator.towards(q) for q in goals])

    def hold(self) -> Array:
        """Joint targets `(steps, n_joints)` of a control period in which the command stays."""
        return self._interpolator.towards(self._q)

    def follow(
        self,
        targets: Array,
        T_world_tool: Array,
        measured_T_world_tool: Array,
        sent: Array | None = None,
    ) -> None:
        """Take the targets `(steps, n)` of a control period of a motion that was planned before.

        Nothing changes if an error is raised.

        Args:
            targets: what is commanded.
            T_world_tool: the pose `(4, 4)` that the last of them stands for.
            measured_T_world_tool: where the tool is `(4, 4)`, or was when its command was given.
            sent: the joints `(n,)` that are sent at the end of the period, where they lag behind.

        Raises:
            InvalidInput: not a joint configuration, or not a pose.
            MotionRejected: the pose is farther from the measured one than a command may be.
        """
        rows = check_array("targets", targets, (None, len(self._q)))
        measured = check_pose("measured_T_world_tool", measured_T_world_tool)
        T = check_pose("T_world_tool", T_world_tool)
        slack = self._allowed_lag(measured, 1)
        if not np.array_equal(self.clamped(T, measured, slack), T):
            far, turn = distance(measured, T)
            raise MotionRejected(
                f"tool lags behind: {far * 1e3:.0f} mm and {np.rad2deg(turn):.0f} deg; allow more "
                "time"
            )
        self._q, self._T, self._slack = rows[-1].copy(), T, slack
        self._interpolator.reset(self._q if sent is None else sent)

    def _allowed_lag(self, measured: Array, n: int) -> Array:
        """How much more lead [m], [rad] than usual is allowed, as what is sent lags behind.

        Only what adds to the lead counts, and what is left of it fades.
        """
        if np.array_equal(self._interpolator.sent, self._q):
            return _FADING**n * self._slack
        ahead = _offsets(measured, self._T)
        lags = _offsets(self.model.fk(self._interpolator.sent), self._T)
        along = [
            float(lag @ lead) / max(float(np.linalg.norm(lead)), _NO_LEAD)
            for lag, lead in zip(lags, ahead, strict=True)
        ]
        return np.maximum(_FADING**n * self._slack, np.minimum(along, self._most))

    def clamped(self, desired: Array, measured: Array, slack: Array | None = None) -> Array:
        """The pose nearest to `desired` within the allowed lead of `measured`, both `(4, 4)`.

        `slack (2,)` [m], [rad] is allowed on top.
        """
        result = desired.copy()
        offset, rotvec = _offsets(measured, desired)
        lead, lead_angle = self._most if slack is None else self._most + slack
        far, angle = float(np.linalg.norm(offset)), float(np.linalg.norm(rotvec))
        if far > lead:
            result[:3, 3] = measured[:3, 3] + offset * (lead / far)
        if angle > lead_angle:
            R = measured[:3, :3] @ exp_rotation(rotvec * (lead_angle / angle))
            result[:3, :3] = orthonormalised(R)
        return result


def settling_targets(
    model: RobotModel,
    q_commanded: Array,
    moving: tuple[Array, Array],
    rates: Rates = DEFAULT_RATES,
) -> Array:
    """The joint targets `(m, n)`, one a physics step, that bring joints to rest at a command.

    The first row is where the joints are; the others are whole control periods.

    Args:
        model: the robot.
        q_commanded: where they are to rest `(n,)` [rad].
        moving: where they are and how fast they move, `(n,)` [rad] and `(n,)` [rad/s].
        rates: how often targets are sent.

    Raises:
        InvalidInput: not joint configurations.
    """
    controller = ToolController(model, rates=rates)
    controller.reset(q_commanded, moving=moving)
    periods = [np.array(moving[0])[None], controller.hold()]
    while not controller.settled:
        periods.append(controller.hold())
    return np.concatenate(periods)


def _offsets(a: Array, b: Array) -> tuple[Array, Array]:
    """From pose a to b: the way `(3,)` [m] in the world, and the rotation `(3,)` [rad] in a."""
    return b[:3, 3] - a[:3, 3], log_rotation(a[:3, :3].T @ b[:3, :3])
