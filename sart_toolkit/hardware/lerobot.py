"""Any arm with the methods of LeRobot's `Robot`; nothing of LeRobot is imported."""

from __future__ import annotations

import time
from collections.abc import Sequence
from contextlib import suppress
from typing import Any, Literal

import numpy as np

from sart_toolkit.errors import InvalidInput
from sart_toolkit.hardware.drivers import ArmState, Clock, Periods
from sart_toolkit.poses import Array
from sart_toolkit.registry import resolve


class LeRobotArm:
    """An arm that is read by `get_observation` and moved by `send_action`.

    It goes where it is sent at its own motors' pace, senses no force, and stops by being sent to
    where it is.
    """

    senses_force = False

    def __init__(
        self,
        robot: str | Any,
        rate_hz: int,
        joints: Sequence[str],
        unit: Literal["deg", "rad"] = "deg",
        clock: Clock = time.monotonic,
    ) -> None:
        """An arm that isn't connected yet.

        Args:
            robot: the `Robot`, or a reference to what makes it, called without arguments.
            rate_hz: how often it is sent targets.
            joints: the keys of its joints in observations and actions, in the order of the
                `RobotSpec`'s: "shoulder_pan.pos", say.
            unit: of the joints there.
            clock: the time that its states are told in.
        """
        if unit not in ("deg", "rad"):
            raise InvalidInput(f"unit: expected 'deg' or 'rad', got {unit!r}")
        self._reference, self._joints, self._clock = robot, tuple(joints), clock
        self._scale = np.pi / 180 if unit == "deg" else 1.0
        self._period, self._periods = 1.0 / rate_hz, Periods(rate_hz, clock)
        self._robot: Any = None
        self._before: tuple[float, Array] | None = None

    def connect(self) -> None:
        made = resolve("LeRobot arm", self._reference, {})
        self._robot = made() if isinstance(self._reference, str) else made
        # A calibration would move it.
        self._robot.connect(calibrate=False)
        for name, features in (
            ("observation", self._robot.observation_features),
            ("action", self._robot.action_features),
        ):
            missing = [joint for joint in self._joints if joint not in features]
            if missing:
                raise InvalidInput(
                    f"joints: the arm's {name}s have no {missing[0]!r}, only {', '.join(features)}"
                )

    def start(self) -> None:
        self._periods.start()

    def read(self) -> ArmState:
        seen, now = self._robot.get_observation(), self._clock()
        q = np.array([float(seen[joint]) for joint in self._joints]) * self._scale
        dq = np.zeros_like(q)
        if self._before is not None and now > self._before[0]:
            dq = (q - self._before[1]) / (now - self._before[0])
        self._before = now, q
        trouble = "" if self._robot.is_connected else "arm isn't connected; check its cable"
        return ArmState(q, dq, now, trouble)

    def servo(self, q: Array, period: float) -> None:
        values = (q / self._scale).tolist()
        self._robot.send_action(dict(zip(self._joints, values, strict=True)))

    def wait(self) -> None:
        self._periods.wait()

    def stop(self) -> None:
        if self._robot is not None:
            with suppress(Exception):
                self.servo(self.read().q, self._period)

    def disconnect(self) -> None:
        robot, self._robot = self._robot, None
        if robot is not None:
            with suppress(Exception):
                robot.disconnect()
