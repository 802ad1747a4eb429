"""Moves an arm, one period of its controller at a time, within its limits, or stops it."""

from __future__ import annotations

from collections import deque
from contextlib import suppress
from typing import cast

import numpy as np

from sart_toolkit.data.records import Rates
from sart_toolkit.errors import RobotStopped, SartError
from sart_toolkit.hardware.cell import Cell
from sart_toolkit.hardware.drivers import Arm, ArmState, Clock, GuidedArm
from sart_toolkit.motion.interpolator import JointInterpolator
from sart_toolkit.poses import Array
from sart_toolkit.robots.model import RobotModel

# What rounding may add to a difference of joints, as a share of its limit.
_ROUNDING = 1e-6
# For so long [s] a hand may move an arm while nobody follows what it does.
_MOST_UNASKED = 1.0
RESUME = "then type the same command again"


class Servo:
    """Sends an arm smooth targets along the joints that it is given, as long as all is well.

    What is given is followed late by two goals (`Control.goal_hz`), slower by the cell's
    `speed_scale`, and to its end: where nothing more comes the arm comes to a rest there. Before
    each target is sent the arm's state is read and checked: that it is fresh, that robot and safety
    mode let it move, the force at the tool, how far the joints are behind; and of the target
    velocity, acceleration, jerk, and the workspace. Whatever is wrong, or raises, stops the arm for
    good.

    A person's hand may move the arm instead (`guide`): no targets are sent then, what is given
    only takes its time, and all of the state is checked but force and lag, which are the hand's.

    Attributes:
        consumed: for how long [s] the arm has gone along what it was given, at the speed given.
        stopped: why the arm was stopped; empty as long as it wasn't.
    """

    def __init__(self, arm: Arm, model: RobotModel, cell: Cell, clock: Clock) -> None:
        """Move an arm that is connected; `start` takes over control."""
        control = cell.control
        self._arm, self._model, self._clock = arm, model, clock
        self._limits, self._control = cell.limits, control
        self._period = 1.0 / control.rate_hz
        self._ahead = cell.limits.speed_scale / control.goal_hz
        self._interpolator = JointInterpolator(
            model, Rates(control.rate_hz, control.goal_hz, control.goal_hz)
        )
        spec = model.spec
        self._most = tuple(
            np.asarray(limit) * (1 + _ROUNDING) * self._period**order
            for order, limit in enumerate(
                (spec.velocity_limits, spec.acceleration_limits, spec.jerk_limits), 1
            )
        )
        self._rows: deque[Array] = deque()
        self._knots: deque[tuple[float, Array]] = deque()
        self._pushed = self.consumed = 0.0
        self._guided = False
        # For how long [s] it has been guided without anybody waiting for it.
        self._unasked = 0.0
        self.stopped = ""

    def start(self) -> ArmState:
        """Take over control, the arm at rest where it is; what it measures there.

        Raises:
            RobotStopped: it can't be moved.
        """
        try:
            self._arm.start()
            return self._rest()
        except Exception as error:
            raise self._stop(error) from error

    def _rest(self) -> ArmState:
        """What the arm measures where it is at rest; targets lead on from there."""
        state = self._checked()
        self._interpolator.reset(state.q)
        self._rows.clear()
        self._knots = deque([(self._pushed, state.q)])
        self.consumed = self._pushed
        self._sent = [state.q] * 4
        return state

    def guide(self) -> None:
        """Leave the arm to a person's hand, from the next `tick` to `hold`."""
        self._guided, self.consumed = True, self._pushed
        self._unasked = 0.0

    def hold(self) -> ArmState:
        """Take the arm back from a person's hand; what it measures where it is then.

        Raises:
            RobotStopped: it can't be moved.
        """
        try:
            cast(GuidedArm, self._arm).hold()
            self._guided = False
            return self._rest()
        except Exception as error:
            raise self._stop(error) from error

    @property
    def target(self) -> Array:
        """The joints `(n,)` [rad] that all it was given leads to."""
        return self._knots[-1][1]

    def push(self, targets: Array, seconds: float) -> None:
        """Give joints `(m, n)` [rad] to follow, at even steps over the next `seconds`."""
        start = self._pushed
        if not self._guided:
            for i, q in enumerate(targets, 1):
                self._knots.append((start + seconds * i / len(targets), q))
        self._pushed = start + seconds

    def tick(self) -> ArmState:
        """Send one target, wait for the next period; what the arm measured before.

        Raises:
            RobotStopped: something is wrong; the arm was stopped, now or before.
        """
        if self.stopped:
            raise RobotStopped(self.stopped)
        try:
            state = self._checked()
            if self._guided:
                cast(GuidedArm, self._arm).guide()
                self._check_awaited()
                # By less than a period beyond what was given, so that periods add up to it.
                self.consumed = min(self.consumed, self._pushed) + self._period
            else:
                q = self._next()
                self._check_target(q, state)
                self._arm.servo(q, self._period)
                self._sent = [*self._sent[1:], q]
            self._arm.wait()
        except Exception as error:
            raise self._stop(error) from error
        return state

    def _check_awaited(self) -> None:
        """Return if somebody still follows what a hand does.

        Raises:
            RobotStopped: nobody does; a free arm would stay free.
        """
        waits = self.consumed < self._pushed
        self._unasked = 0.0 if waits else self._unasked + self._period
        if self._unasked > _MOST_UNASKED:
            raise _stopped("arm: a hand could move it, but the program doesn't follow any more")

    def close(self) -> None:
        """Stop the arm and disconnect."""
        self.stopped = self.stopped or "robot is closed; make it again"
        for last in (self._arm.stop, self._arm.disconnect):
            with suppress(Exception):
                last()

    def stop(self, reason: str) -> None:
        """Stop the arm for a reason of the caller's."""
        self._stop(RobotStopped(reason))

    def _stop(self, error: Exception) -> RobotStopped:
        with suppress(Exception):
            self._arm.stop()
        if not self.stopped:
            self.stopped = str(error)
            if not isinstance(error, SartError):
                self.stopped = f"robot stopped: {error or type(error).__name__}; {RESUME}"
        return RobotStopped(self.stopped)

    def _checked(self) -> ArmState:
        """What the arm measures.

        Raises:
            RobotStopped: it must not be moved.
        """
        state, limits = self._arm.read(), self._limits
        age = self._clock() - state.time
        # Written so that what is no number stops it, too.
        if not age <= self._control.silence:
            raise _stopped(
                f"arm: its state is {age * 1e3:.0f} ms old, expected at most "
                f"{self._control.silence * 1e3:.0f} ms; check its connection"
            )
        if state.trouble:
            raise _stopped(f"arm: {state.trouble}")
        pressed = state.force is not None and not state.force <= limits.force
        if pressed and not self._guided:
            raise _stopped(
                f"arm: {state.force:.0f} N at the tool, expected at most {limits.force:g} N; see "
                "what it touches and clear the way"
            )
        if not np.isfinite(state.q).all():
            raise _stopped("arm: joints are no numbers; check its connection")
        return state

    def _next(self) -> Array:
        """The next target `(n,)` [rad]."""
        if not self._rows:
            self.consumed = min(self.consumed + self._ahead, self._pushed)
            while len(self._knots) > 1 and self._knots[1][0] <= self.consumed:
                self._knots.popleft()
            (t, q), *after = list(self._knots)[:2]
            if after:
                share = (self.consumed - t) / (after[0][0] - t)
                q = q + share * (after[0][1] - q)
            self._rows.extend(self._interpolator.towards(q))
        return self._rows.popleft()

    def _check_target(self, q: Array, state: ArmState) -> None:
        """Return if a target may be sent.

        Raises:
            RobotStopped: it may not.
        """
        rows = np.array([*self._sent[1:], q])
        for order, (most, what) in enumerate(
            zip(self._most, ("velocity", "acceleration", "jerk"), strict=True), 1
        ):
            over = np.abs(np.diff(rows, order, axis=0)[-1]) - most
            # Positions are rounded, and their differences of third order eight times as much.
            if not (over <= 1e-14).all():
                joint = self._model.spec.arm_joints[int(np.argmax(over))]
                raise _stopped(f"target refused: {what} of {joint} is over its limit")
        off = self._limits.workspace.outside(self._model.fk(q)[:3, 3])
        if not off <= 0:
            raise _stopped(
                f"target refused: the tool would be {off * 1e3:.0f} mm outside the workspace; move "
                "the arm back into it by hand"
            )
        lag = np.abs(state.q - self._sent[-1])
        if not (lag <= self._limits.most_lag).all():
            joint = self._model.spec.arm_joints[int(np.argmax(lag))]
            raise _stopped(
                f"arm: {joint} is {lag.max():.2f} rad behind what it was sent, expected at most "
                f"{self._limits.most_lag:g} rad; see what holds it"
            )


def _stopped(what: str) -> RobotStopped:
    return RobotStopped(f"robot stopped: {what}; {RESUME}")
