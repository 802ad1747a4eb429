"""Steering with the keys of the recording's window."""

from __future__ import annotations

import numpy as np

from sart_toolkit.poses import Array
from sart_toolkit.record.devices.manual import ManualDevice

# Key: the axis it pushes along or turns about (right, forward, up, then turns), and which way.
KEYS = {
    "d": (0, +1), "a": (0, -1),
    "w": (1, +1), "s": (1, -1),
    "e": (2, +1), "q": (2, -1),
    "i": (3, +1), "k": (3, -1),
    "u": (4, +1), "o": (4, -1),
    "j": (5, +1), "l": (5, -1),
}  # fmt: skip


class Keyboard(ManualDevice):
    """Keys held down push and turn the tool; the window passes them on."""

    name = "keyboard"
    key_map = (
        ("W S", "away, near"),
        ("A D", "left, right"),
        ("E Q", "up, down"),
        ("I K", "tip away, near"),
        ("U O", "tip left, right"),
        ("J L", "turn left, right"),
    )

    def connect(self) -> None:
        self.let_go()

    def let_go(self) -> None:
        self._down: set[str] = set()

    def key(self, name: str, down: bool) -> bool:
        if name not in KEYS:
            return super().key(name, down)
        (self._down.add if down else self._down.discard)(name)
        return True

    def poll(self) -> Array:
        axes = np.zeros(6)
        for name in self._down:
            axis, way = KEYS[name]
            axes[axis] += way
        return axes
