"""An arm that is at once where it is sent, in real time, and notes what it is called in a file."""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np

from sart_toolkit.hardware.drivers import ArmState


class IdealArm:
    senses_force = False

    def __init__(self, notes, home, rate_hz, fails_after=None, clock=time.monotonic):
        self._notes, self._period, self._clock = Path(notes), 1 / rate_hz, clock
        self._q, self._left = np.array(home), fails_after
        self._due = 0.0

    def _note(self, what):
        with self._notes.open("a") as file:
            file.write(f"{what}\n")

    def connect(self):
        self._note("connect")

    def start(self):
        self._note("start")
        self._due = self._clock()

    def read(self):
        return ArmState(self._q, np.zeros(len(self._q)), self._clock())

    def servo(self, q, period):
        if self._left is not None:
            self._left -= 1
            if self._left < 0:
                raise ConnectionError("cable pulled")
        self._q = q

    def guide(self):
        self._note("guide")

    def hold(self):
        self._note("hold")

    def wait(self):
        self._due = max(self._due + self._period, self._clock())
        time.sleep(max(0.0, self._due - self._clock()))

    def stop(self):
        self._note("stop")

    def disconnect(self):
        self._note("disconnect")
