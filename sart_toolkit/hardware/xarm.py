"""UFACTORY arms (xArm 5, 6, 7, 850, Lite 6), through `xarm-python-sdk`."""

from __future__ import annotations

import time
from collections.abc import Sequence
from contextlib import suppress
from typing import Any

import numpy as np

from sart_toolkit.errors import MissingExtra
from sart_toolkit.hardware.drivers import ArmState, Clock, Periods
from sart_toolkit.poses import Array, check_array, check_positive

_POSITION, _SERVO, _TEACHING = 0, 1, 2
_MOTION, _STOP = 0, 4
# Of the states that it tells, those in which it follows targets or a hand: moving, and at rest.
_READY = (1, 2)
# For so long [s] it may take to tell that it is in another mode.
_MODE_TIME = 2.0
_RELEASE = "make sure that it may move, release it, and clear the error in UFACTORY Studio"
_CLEAR = "see what it touched, clear the way, and clear the error in UFACTORY Studio"
_ERRORS = {
    1: ("emergency stop", _RELEASE),
    2: ("emergency input of its control box", _RELEASE),
    3: ("emergency stop of its three-state switch", _RELEASE),
    22: ("self-collision", _CLEAR),
    23: ("a joint is beyond its limit", "move it back by hand in UFACTORY Studio"),
    24: ("a joint is too fast", "lower speed_scale, and clear the error in UFACTORY Studio"),
    31: ("collision", _CLEAR),
    35: ("safety boundary", "move it back by hand in UFACTORY Studio"),
    37: ("moved where it shouldn't while guided", "set its payload, and clear the error"),
    60: ("its tool is too fast", "lower speed_scale, and clear the error in UFACTORY Studio"),
}


class XArm:
    """An arm that follows `set_servo_angle_j` targets in servo mode; a hand moves it in mode 2.

    It has no watchdog: where targets stop coming it stays at the last one. Its own detection of
    collisions stays on, with the sensitivity that it is set to.
    """

    senses_force = False

    def __init__(
        self,
        host: str,
        rate_hz: int,
        payload: float | None = None,
        centre_of_gravity: Sequence[float] = (0.0, 0.0, 0.0),
        clock: Clock = time.monotonic,
    ) -> None:
        """An arm that isn't connected yet.

        Args:
            host: address of its control box, in numbers.
            rate_hz: how often it is sent targets: 100 is usual, 250 the most it takes.
            payload: mass [kg] at its flange; its own setting if left out.
            centre_of_gravity: of the payload, in the flange's frame [m].
            clock: the time that its states are told in.

        Raises:
            InvalidInput: a value is out of range.
        """
        self._host, self._clock, self._periods = host, clock, Periods(rate_hz, clock)
        self._payload = None if payload is None else check_positive("payload", payload, "kg")
        self._centre = check_array("centre_of_gravity", centre_of_gravity, (3,))
        self._arm: Any = None
        # What it was put into, once control is taken over.
        self._mode: int | None = None

    def connect(self) -> None:
        try:
            from xarm.wrapper import XArmAPI
        except ImportError as error:
            raise MissingExtra(
                f"an xArm needs xarm-python-sdk ({error}); pip install sart_toolkit[xarm]"
            ) from error
        self._arm = XArmAPI(self._host, is_radian=True, do_not_open=True)
        self._arm.connect()

    def start(self) -> None:
        if self._payload is not None:
            centre = (1e3 * self._centre).tolist()
            self._do("set_tcp_load", self._payload, centre)
        self._do("motion_enable", True)
        self._enter(_SERVO)
        self._periods.start()

    def read(self) -> ArmState:
        arm = self._arm
        if not arm.connected:
            raise ConnectionError(f"arm at {self._host}: the connection is lost; check the cable")
        q, dq = self._asked("get_joint_states", is_radian=True)[:2]
        (error, _), state = self._asked("get_err_warn_code"), self._asked("get_state")
        n = arm.axis
        return ArmState(
            np.array(q[:n]), np.array(dq[:n]), self._clock(), self._trouble(error, state)
        )

    def servo(self, q: Array, period: float) -> None:
        self._do("set_servo_angle_j", q.tolist(), is_radian=True)

    def guide(self) -> None:
        if self._mode != _TEACHING:
            self._enter(_TEACHING)

    def hold(self) -> None:
        if self._mode == _TEACHING:
            self._enter(_SERVO)

    def wait(self) -> None:
        self._periods.wait()

    def stop(self) -> None:
        mode, self._mode = self._mode, None
        if mode is None or self._arm is None:
            return
        # Each is worth trying whatever became of the one before; in position mode no hand moves it.
        for last in (lambda: self._arm.set_state(_STOP), lambda: self._arm.set_mode(_POSITION)):
            with suppress(Exception):
                last()

    def disconnect(self) -> None:
        arm, self._arm = self._arm, None
        if arm is not None:
            with suppress(Exception):
                arm.disconnect()

    def _enter(self, mode: int) -> None:
        # From here on it has to be stopped, whatever becomes of it.
        self._mode = mode
        self._do("set_mode", mode)
        self._do("set_state", _MOTION)
        # In another mode targets are taken and not followed.
        ends = self._clock() + _MODE_TIME
        while self._arm.mode != mode:
            if self._clock() > ends:
                raise ConnectionError(
                    f"arm at {self._host}: stays in mode {self._arm.mode}, expected {mode}; close "
                    "what else controls it"
                )
            time.sleep(0.01)

    def _trouble(self, error: int, state: int) -> str:
        if error:
            known = _ERRORS.get(error, (f"error {error}", "see UFACTORY Studio, and clear it"))
            return "{}; {}".format(*known)
        if self._mode is None:
            return ""
        if state not in _READY or self._arm.mode != self._mode:
            return (
                f"state {state} in mode {self._arm.mode}, so that it doesn't follow; close what "
                "else controls it"
            )
        return ""

    def _do(self, name: str, *values: Any, **options: Any) -> None:
        if (code := getattr(self._arm, name)(*values, **options)) != 0:
            raise ConnectionError(self._refused(name, code))

    def _asked(self, name: str, **options: Any) -> Any:
        code, answer = getattr(self._arm, name)(**options)
        if code != 0:
            raise ConnectionError(self._refused(name, code))
        return answer

    def _refused(self, name: str, code: int) -> str:
        return f"arm at {self._host}: {name} is refused with code {code}; see UFACTORY Studio"
