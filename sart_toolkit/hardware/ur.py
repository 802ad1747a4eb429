"""Universal Robots arms by RTDE, through `ur-rtde`."""

from __future__ import annotations

import time
from collections.abc import Sequence
from contextlib import suppress
from typing import Any

import numpy as np

from sart_toolkit.hardware.drivers import ArmState, Clock, ClockOffset, imported
from sart_toolkit.poses import Array, check_array, check_positive

_LIBRARY = "a UR arm needs ur-rtde", "ur"

_RUNNING = 7
_ROBOT_MODES = {
    -1: "no controller",
    0: "disconnected",
    1: "confirm safety",
    2: "booting",
    3: "power off",
    4: "power on",
    5: "idle",
    6: "backdrive",
    8: "updating its firmware",
}
_ENABLE = "switch it on and release its brakes on the pendant"
_RELEASE = "make sure that it may move, and release the stop"
# Normal and reduced mode let it move.
_SAFETY_MODES = {
    3: ("protective stop", "see what it touched, clear the way, and enable it on the pendant"),
    4: ("recovery mode", "move its joints back into their range on the pendant"),
    5: ("safeguard stop", _RELEASE),
    6: ("emergency stop", _RELEASE),
    7: ("emergency stop", _RELEASE),
    8: ("safety violation", "restart its controller"),
    9: ("safety fault", "restart its controller"),
}


class UrRtdeArm:
    """A UR arm (CB3 or e-Series) that follows `servoJ` targets.

    The controller's own watchdog ends the motion, or a person's guiding, where it isn't kicked in
    every period. A hand moves it in the controller's freedrive.
    """

    senses_force = True

    def __init__(
        self,
        host: str,
        rate_hz: int,
        lookahead: float = 0.1,
        gain: float = 300.0,
        watchdog_hz: float = 25.0,
        deceleration: float = 10.0,
        payload: float | None = None,
        centre_of_gravity: Sequence[float] = (0.0, 0.0, 0.0),
        clock: Clock = time.monotonic,
    ) -> None:
        """An arm that isn't connected yet.

        Args:
            host: address of its controller.
            rate_hz: how often it is sent targets: 125 for a CB3, up to 500 for an e-Series.
            lookahead: smooths what it is sent [s].
            gain: how strongly it follows.
            watchdog_hz: where targets come less often, the controller stops the arm.
            deceleration: of a stop [m/s²].
            payload: mass [kg] at its flange; the pendant's own setting if left out.
            centre_of_gravity: of the payload, in the flange's frame [m].
            clock: the time that its states are told in.

        Raises:
            InvalidInput: a value is out of range.
        """
        self._host, self._rate_hz, self._clock = host, float(rate_hz), clock
        self._lookahead, self._gain = check_positive("lookahead", lookahead, "s"), gain
        self._watchdog_hz = check_positive("watchdog_hz", watchdog_hz, "Hz")
        self._deceleration = check_positive("deceleration", deceleration, "m/s²")
        self._payload = None if payload is None else check_positive("payload", payload, "kg")
        self._centre = check_array("centre_of_gravity", centre_of_gravity, (3,))
        self._offset = ClockOffset()
        self._receive: Any = None
        self._control: Any = None
        self._period: Any = None
        self._guided = False

    def connect(self) -> None:
        module = imported("rtde_receive", *_LIBRARY)
        self._receive = module.RTDEReceiveInterface(self._host, self._rate_hz)

    def start(self) -> None:
        module = imported("rtde_control", *_LIBRARY)
        self._control = module.RTDEControlInterface(self._host, self._rate_hz)
        self._control.setWatchdog(self._watchdog_hz)
        if self._payload is not None:
            self._control.setPayload(self._payload, self._centre.tolist())
        self._control.zeroFtSensor()
        self._period = self._control.initPeriod()

    def read(self) -> ArmState:
        receive = self._receive
        if not receive.isConnected():
            raise ConnectionError(f"arm at {self._host}: the connection is lost; check the cable")
        force = np.linalg.norm(receive.getActualTCPForce()[:3])
        return ArmState(
            q=np.array(receive.getActualQ()),
            dq=np.array(receive.getActualQd()),
            time=self._offset.to_clock(receive.getTimestamp(), self._clock()),
            trouble=_trouble(receive.getRobotMode(), receive.getSafetyMode()),
            force=float(force),
        )

    def servo(self, q: Array, period: float) -> None:
        control = self._control
        # Velocity and acceleration have no effect here.
        if not control.servoJ(q.tolist(), 0.0, 0.0, period, self._lookahead, self._gain):
            raise ConnectionError(
                f"arm at {self._host}: refuses servoJ; see the pendant, and set remote control"
            )
        control.kickWatchdog()

    def guide(self) -> None:
        control = self._control
        if not self._guided:
            # Only one of them may move the arm.
            control.servoStop(self._deceleration)
            control.kickWatchdog()
            # Where its answer is lost it may be free nevertheless.
            self._guided = True
            if not control.teachMode():
                raise ConnectionError(
                    f"arm at {self._host}: refuses freedrive; see the pendant, and set remote "
                    "control"
                )
        control.kickWatchdog()

    def hold(self) -> None:
        if self._guided and not self._control.endTeachMode():
            raise ConnectionError(f"arm at {self._host}: doesn't leave freedrive; see the pendant")
        self._guided = False

    def wait(self) -> None:
        self._control.waitPeriod(self._period)
        self._period = self._control.initPeriod()

    def stop(self) -> None:
        control, self._control = self._control, None
        guided, self._guided = self._guided, False
        if control is None:
            return
        # Each is worth trying whatever became of the one before.
        for last in (
            *([control.endTeachMode] if guided else []),
            lambda: control.servoStop(self._deceleration),
            control.stopScript,
            control.disconnect,
        ):
            with suppress(Exception):
                last()

    def disconnect(self) -> None:
        receive, self._receive = self._receive, None
        if receive is not None:
            with suppress(Exception):
                receive.disconnect()


def _trouble(robot_mode: int, safety_mode: int) -> str:
    """Why the arm doesn't move and what to do, by the numbers of RTDE; empty where it does."""
    if safety_mode in _SAFETY_MODES:
        return "{}; {}".format(*_SAFETY_MODES[safety_mode])
    if safety_mode not in (1, 2):
        return f"unknown safety mode {safety_mode}; see the pendant"
    if robot_mode != _RUNNING:
        return f"{_ROBOT_MODES.get(robot_mode, f'robot mode {robot_mode}')}; {_ENABLE}"
    return ""
