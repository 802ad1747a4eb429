"""Steering with a gamepad, read through pygame-ce (SDL's game controllers)."""

from __future__ import annotations

import enum
from collections.abc import Callable
from typing import Any

import numpy as np

from sart_toolkit.errors import DeviceLost, MissingExtra
from sart_toolkit.poses import Array
from sart_toolkit.record.devices.manual import Control, ManualDevice

_DEAD_ZONE = 0.12
_FULL = 32767.0


class Axis(enum.IntEnum):
    """SDL's numbers of a gamepad's axes: sticks right and down, triggers pressed, are positive."""

    LEFT_X = 0
    LEFT_Y = 1
    RIGHT_X = 2
    RIGHT_Y = 3
    LEFT_TRIGGER = 4
    RIGHT_TRIGGER = 5


class Button(enum.IntEnum):
    """SDL's numbers of a gamepad's buttons, named as on an Xbox pad."""

    A = 0
    Y = 3
    BACK = 4
    START = 6
    LEFT_SHOULDER = 9
    RIGHT_SHOULDER = 10
    DPAD_LEFT = 13
    DPAD_RIGHT = 14


class Gamepad(ManualDevice):
    """Sticks and triggers push and turn the tool; buttons do the rest."""

    name = "gamepad"
    key_map = (
        ("Left stick", "away, near, sideways"),
        ("Triggers", "down (left), up (right)"),
        ("Right stick", "tip away, near; turn"),
        ("D-pad ← →", "tip left, right"),
        ("A   Y", "gripper, directions"),
        ("LB RB", "slower, faster"),
        ("Start Back", "as → and ←"),
    )
    _pad: Any = None

    def connect(self) -> None:
        self._pad = open_pad()
        self.let_go()

    def close(self) -> None:
        self._pad = None

    def let_go(self) -> None:
        self._pressed: set[Button] = set()

    def poll(self) -> Array:
        if self._pad is None or not self._pad.attached():
            self._pad = None
            self.let_go()
            raise DeviceLost("the gamepad was unplugged")
        self._press({button for button in Button if self._pad.get_button(button)})
        x, y, turn, tip, down, up = (self._axis(axis) for axis in Axis)
        roll = (Button.DPAD_LEFT in self._pressed) - (Button.DPAD_RIGHT in self._pressed)
        return np.array([x, -y, up - down, -tip, roll, -turn], dtype=np.float64)

    def _axis(self, axis: Axis) -> float:
        value = float(np.clip(self._pad.get_axis(axis) / _FULL, -1.0, 1.0))
        return float(np.sign(value)) * max(0.0, abs(value) - _DEAD_ZONE) / (1.0 - _DEAD_ZONE)

    def _press(self, down: set[Button]) -> None:
        does: dict[Button, Callable[[], None]] = {
            Button.A: self.switch_gripper,
            Button.Y: self.switch_frame,
            Button.LEFT_SHOULDER: lambda: self.change_speed(-1),
            Button.RIGHT_SHOULDER: lambda: self.change_speed(+1),
            Button.START: lambda: self._controls.append(Control.NEXT),
            Button.BACK: lambda: self._controls.append(Control.REDO),
        }
        for button in down - self._pressed:
            does.get(button, lambda: None)()
        self._pressed = down


def open_pad() -> Any:
    """The first gamepad that SDL has a map of.

    Raises:
        DeviceLost: there is none.
        MissingExtra: pygame-ce isn't installed.
    """
    try:
        import pygame
        from pygame._sdl2 import controller
    except ImportError as error:
        raise MissingExtra(
            f"a gamepad needs pygame-ce ({error}); pip install sart_toolkit[teleop]"
        ) from error
    pygame.joystick.init()
    controller.init()
    # What was plugged in a moment ago is known once its event is taken.
    pygame.event.pump()
    for index in range(controller.get_count()):
        if controller.is_controller(index):
            return controller.Controller(index)
    raise DeviceLost(
        "no gamepad found; plug it in, or record with --device keyboard (one that SDL doesn't know "
        "needs its map in the variable SDL_GAMECONTROLLERCONFIG)"
    )
