"""Franka arms (the Franka Emika Robot, or Panda, and the FR3), through `panda-py`."""

from __future__ import annotations

import time
from collections.abc import Sequence
from contextlib import suppress
from typing import Any

import numpy as np

from sart_toolkit.hardware.drivers import ArmState, Clock, ClockOffset, Periods, imported
from sart_toolkit.poses import Array, check_array

_LIBRARY = "a Franka arm needs panda-py", "franka"

_IDLE, _MOVE = 1, 2
_UNLOCK = "unlock its joints and activate FCI in Desk"
# By the numbers of libfranka's `RobotMode`.
_MODES = {
    0: ("doesn't move", _UNLOCK),
    3: ("is guided by its own buttons", "let go of them"),
    4: ("reflex", "see what it touched, clear the way, and acknowledge the error in Desk"),
    5: ("user stop", "make sure that it may move, and release the stop"),
    6: ("recovers from an error", "wait, or see Desk"),
}


class Franka:
    """An arm that follows joint targets by `panda-py`'s joint impedance controller, at 1 kHz.

    A spring leads each joint, so it gives way, and lags under a load that isn't set in Desk. The
    controller's loop is a thread of the library: where this process hangs the arm stays where it
    was sent last, or free for a hand; where it ends, the arm stops itself.
    """

    senses_force = True

    def __init__(
        self,
        host: str,
        rate_hz: int,
        stiffness: Sequence[float] | None = None,
        damping: Sequence[float] | None = None,
        clock: Clock = time.monotonic,
    ) -> None:
        """An arm that isn't connected yet.

        Args:
            host: its address.
            rate_hz: how often it is sent targets.
            stiffness: of its joints (7,) [Nm/rad]; `panda-py`'s own if left out.
            damping: of its joints (7,) [Nm s/rad]; `panda-py`'s own if left out.
            clock: the time that its states are told in.

        Raises:
            InvalidInput: a value is not seven numbers.
        """
        self._host, self._clock, self._periods = host, clock, Periods(rate_hz, clock)
        self._gains = {
            name: check_array(name, values, (7,))
            for name, values in (("stiffness", stiffness), ("damping", damping))
            if values is not None
        }
        self._offset = ClockOffset()
        self._panda: Any = None
        self._controller: Any = None
        self._sent: Array | None = None
        self._started = self._guided = False

    def connect(self) -> None:
        self._panda = imported("panda_py", *_LIBRARY).Panda(self._host)

    def start(self) -> None:
        # From here on it has to be stopped, whatever becomes of it.
        self._started = True
        self._follow()
        self._periods.start()

    def _follow(self) -> None:
        made = imported(
            "panda_py.controllers", "a Franka arm needs panda-py", "franka"
        ).JointPosition(**self._gains)
        self._panda.start_controller(made)
        self._controller, self._sent = made, None

    def read(self) -> ArmState:
        panda = self._panda
        # What went wrong in the controller's thread is told here.
        panda.raise_error()
        panda.refresh_state()
        state = panda.get_state()
        return ArmState(
            q=np.array(state.q),
            dq=np.array(state.dq),
            time=self._offset.to_clock(state.time.to_sec(), self._clock()),
            trouble=self._trouble(int(state.robot_mode)),
            force=float(np.linalg.norm(state.O_F_ext_hat_K[:3])),
        )

    def servo(self, q: Array, period: float) -> None:
        velocity = np.zeros_like(q) if self._sent is None else (q - self._sent) / period
        self._controller.set_control(q, velocity)
        self._sent = q

    def guide(self) -> None:
        if not self._guided:
            self._panda.stop_controller()
            self._guided = True
            self._panda.teaching_mode(True)

    def hold(self) -> None:
        if self._guided:
            self._panda.teaching_mode(False)
            self._guided = False
            self._follow()

    def wait(self) -> None:
        self._periods.wait()

    def stop(self) -> None:
        started, self._started = self._started, False
        guided, self._guided = self._guided, False
        if not started or self._panda is None:
            return
        # Each is worth trying whatever became of the one before.
        if guided:
            with suppress(Exception):
                self._panda.teaching_mode(False)
        with suppress(Exception):
            self._panda.stop_controller()

    def disconnect(self) -> None:
        # The library disconnects what nobody refers to.
        self._panda = self._controller = None

    def _trouble(self, mode: int) -> str:
        if mode in _MODES:
            return "{}; {}".format(*_MODES[mode])
        if mode not in (_IDLE, _MOVE):
            return f"unknown mode {mode}; see Desk"
        if self._started and mode != _MOVE:
            return "its controller has ended; see Desk"
        return ""
