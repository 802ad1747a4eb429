"""Emulated gamepads: one in the place of SDL's for each axis, one of SDL's own for recordings."""

from __future__ import annotations

import ctypes
import sys
from pathlib import Path

import numpy as np
import pytest

from sart_toolkit.errors import DeviceLost, MissingExtra
from sart_toolkit.record.desk import RecordingDesk
from sart_toolkit.record.devices import gamepad as module
from sart_toolkit.record.devices.gamepad import Axis, Button, Gamepad
from sart_toolkit.record.devices.manual import SPEEDS, Control
from sart_toolkit.record.screen import start_sdl
from sart_toolkit.record.session import SessionState


class Pad:
    def __init__(self):
        self.plugged = True
        self.axes = dict.fromkeys(Axis, 0)
        self.down = set()

    def attached(self):
        return self.plugged

    def get_axis(self, axis):
        return self.axes[axis]

    def get_button(self, button):
        return button in self.down


@pytest.fixture
def pad(monkeypatch):
    pad = Pad()

    def open_pad():
        if not pad.plugged:
            raise DeviceLost("no gamepad found; plug it in")
        return pad

    monkeypatch.setattr(module, "open_pad", open_pad)
    return pad


@pytest.fixture
def gamepad(pad, peg_setup):
    device = Gamepad(peg_setup)
    device.connect()
    return device


FULL = 32767


@pytest.mark.parametrize(
    ("axis", "value", "expected"),
    [
        (Axis.LEFT_X, FULL, [1, 0, 0, 0, 0, 0]),
        (Axis.LEFT_Y, -FULL, [0, 1, 0, 0, 0, 0]),
        (Axis.LEFT_Y, FULL, [0, -1, 0, 0, 0, 0]),
        (Axis.RIGHT_TRIGGER, FULL, [0, 0, 1, 0, 0, 0]),
        (Axis.LEFT_TRIGGER, FULL, [0, 0, -1, 0, 0, 0]),
        (Axis.RIGHT_Y, -FULL, [0, 0, 0, 1, 0, 0]),
        (Axis.RIGHT_X, FULL, [0, 0, 0, 0, 0, -1]),
        (Axis.LEFT_X, -FULL - 1, [-1, 0, 0, 0, 0, 0]),
        (Axis.LEFT_X, 3000, [0] * 6),
        (Axis.RIGHT_X, -3900, [0] * 6),
    ],
)
def test_sticks_and_triggers_push_and_turn(pad, gamepad, axis, value, expected):
    pad.axes[axis] = value
    np.testing.assert_allclose(gamepad.poll(), expected)


@pytest.mark.parametrize(("button", "way"), [(Button.DPAD_LEFT, 1), (Button.DPAD_RIGHT, -1)])
def test_the_d_pad_tips_sideways(pad, gamepad, button, way):
    pad.down = {button}
    np.testing.assert_array_equal(gamepad.poll(), [0, 0, 0, 0, way, 0])


def test_deflection_rises_from_the_dead_zone_on(pad, gamepad):
    values = []
    for x in range(0, FULL + 1, FULL // 20):
        pad.axes[Axis.LEFT_X] = x
        values.append(gamepad.poll()[0])
    assert values[0] == 0 and values[-1] > 0.99 and (np.diff(values) >= 0).all()
    assert max(np.diff(values)) < 0.1


def test_a_held_button_counts_once(pad, gamepad):
    gripper = gamepad.gripper
    pad.down = {Button.A, Button.Y, Button.RIGHT_SHOULDER}
    for _ in range(5):
        gamepad.poll()
    assert gamepad.gripper != gripper and gamepad.frame == "tool"
    assert gamepad.speed is SPEEDS[2]
    pad.down = {Button.LEFT_SHOULDER}
    gamepad.poll()
    assert gamepad.speed is SPEEDS[1]


class VirtualPad:
    """A gamepad that SDL itself makes up, so that it is found and read as a real one is."""

    _GAMEPAD, _AXES, _BUTTONS = 1, 6, 15

    def __init__(self, pygame):
        (library,) = (Path(pygame.__file__).parents[1] / "pygame_ce.libs").glob("libSDL2-2*")
        self.pygame, self.sdl = pygame, ctypes.CDLL(str(library))
        self.sdl.SDL_JoystickOpen.restype = ctypes.c_void_p
        for name, value in (("Axis", ctypes.c_int16), ("Button", ctypes.c_uint8)):
            function = getattr(self.sdl, f"SDL_JoystickSetVirtual{name}")
            function.argtypes = [ctypes.c_void_p, ctypes.c_int, value]
        self.index = None

    def plug_in(self):
        self.index = self.sdl.SDL_JoystickAttachVirtual(self._GAMEPAD, self._AXES, self._BUTTONS)
        assert self.index >= 0
        self.pad = self.sdl.SDL_JoystickOpen(self.index)
        self.pull(Axis.LEFT_TRIGGER, 0.0)
        self.pull(Axis.RIGHT_TRIGGER, 0.0)

    def unplug(self):
        if self.index is not None:
            self.sdl.SDL_JoystickDetachVirtual(self.index)
            self.pygame.event.pump()
            self.index = None

    def push(self, axis, share):
        self.sdl.SDL_JoystickSetVirtualAxis(self.pad, axis, round(FULL * share))
        self.pygame.event.pump()

    def pull(self, trigger, share):
        self.push(trigger, 2 * share - 1)

    def press(self, button, down):
        self.sdl.SDL_JoystickSetVirtualButton(self.pad, button, down)
        self.pygame.event.pump()


@pytest.fixture
def pygame(monkeypatch):
    pytest.importorskip("pygame")
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    pygame = start_sdl()
    yield pygame
    pygame.display.quit()


@pytest.fixture
def virtual(pygame):
    virtual = VirtualPad(pygame)
    virtual.plug_in()
    yield virtual
    virtual.unplug()


def test_sdl_s_own_axes_and_buttons_are_the_ones_meant(virtual, peg_setup):
    device = Gamepad(peg_setup)
    device.connect()
    virtual.push(Axis.LEFT_Y, -1.0)
    assert device.poll()[1] == pytest.approx(1.0)
    virtual.push(Axis.LEFT_Y, 0.0)
    virtual.pull(Axis.RIGHT_TRIGGER, 1.0)
    np.testing.assert_allclose(device.poll(), [0, 0, 1, 0, 0, 0], atol=1e-3)
    virtual.pull(Axis.RIGHT_TRIGGER, 0.0)
    for button in Button:
        virtual.press(button, 1)
        device.poll()
        assert device._pressed == {button}
        virtual.press(button, 0)


def test_an_emulated_gamepad_drives_a_whole_recording_with_its_own_buttons(
    virtual, peg_setup, make_session, tick_until, ended
):
    saved = []
    session, device = make_session(), Gamepad(peg_setup)
    device.connect()
    desk = RecordingDesk(session, device, saved.append)

    def push(button):
        for down in (1, 0):
            virtual.press(button, down)
            desk.tick()

    push(Button.START)
    assert session.state is SessionState.RECORDING
    push(Button.BACK)
    assert session.state is SessionState.READY
    push(Button.START)
    virtual.pull(Axis.LEFT_TRIGGER, 1.0)
    tick_until(desk, lambda: session.success)
    virtual.pull(Axis.LEFT_TRIGGER, 0.0)
    tick_until(desk, ended(desk))
    push(Button.START)
    assert saved[0].device == "gamepad" and saved[0].success[-10:].all()


def test_unplugging_pauses_and_plugging_in_resumes(virtual, peg_setup, make_session, tick_until):
    session, device = make_session(), Gamepad(peg_setup)
    device.connect()
    desk = RecordingDesk(session, device, lambda _: None)
    desk.press(Control.NEXT)
    virtual.pull(Axis.LEFT_TRIGGER, 1.0)
    for _ in range(20):
        desk.tick()
    virtual.unplug()
    desk.tick()
    assert session.state is SessionState.PAUSED and session.seconds == pytest.approx(20 / 30)
    assert "the gamepad was unplugged. Plug it in" in desk.notice.text
    desk.press(Control.NEXT)
    assert session.state is SessionState.PAUSED and "no gamepad found" in desk.notice.text
    virtual.plug_in()
    desk.press(Control.NEXT)
    assert session.state is SessionState.RECORDING
    virtual.pull(Axis.LEFT_TRIGGER, 1.0)
    tick_until(desk, lambda: session.success)


def test_without_a_gamepad_the_keyboard_is_offered(pygame, peg_setup):
    with pytest.raises(DeviceLost, match="no gamepad found; plug it in, or .* --device keyboard"):
        Gamepad(peg_setup).connect()


def test_without_pygame_the_extra_is_named(monkeypatch, peg_setup):
    monkeypatch.setitem(sys.modules, "pygame", None)
    with pytest.raises(MissingExtra, match=r"pip install sart_toolkit\[teleop\]"):
        Gamepad(peg_setup).connect()
