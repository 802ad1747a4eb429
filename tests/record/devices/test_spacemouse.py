"""An emulated SpaceMouse: the bytes that real ones send, through a stand-in for hidapi."""

from __future__ import annotations

import struct
import sys
import types

import numpy as np
import pytest

from sart_toolkit.errors import DeviceLost, MissingExtra
from sart_toolkit.record.desk import RecordingDesk
from sart_toolkit.record.devices.manual import SPEEDS, Control
from sart_toolkit.record.devices.spacemouse import SpaceMouse
from sart_toolkit.record.session import SessionState

COMPACT = {
    "path": b"1-1:1.0", "vendor_id": 0x256F, "product_id": 0xC635,
    "usage_page": 1, "usage": 8, "interface_number": 0,
}  # fmt: skip
MOUSE = COMPACT | {"path": b"1-2:1.0", "vendor_id": 0x046D, "product_id": 0xC077, "usage": 2}


def translation(x=0, y=0, z=0):
    return bytes([1]) + struct.pack("<3h", x, y, z)


def rotation(x=0, y=0, z=0):
    return bytes([2]) + struct.pack("<3h", x, y, z)


def both(*axes):
    return bytes([1]) + struct.pack("<6h", *axes)


def buttons(*pressed):
    return bytes([3]) + struct.pack("<H", sum(1 << (n - 1) for n in pressed))


class Bus:
    """What hidapi sees: devices that are plugged in, and reports that wait to be read."""

    def __init__(self):
        self.plugged = [MOUSE, COMPACT]
        self.reports = []
        self.opened = []
        self.refuses = False

    def module(self):
        bus = self

        class Device:
            def open_path(self, path):
                if bus.refuses:
                    raise OSError("open failed")
                bus.opened.append(path)

            def set_nonblocking(self, on):
                assert on == 1

            def read(self, length):
                if COMPACT not in bus.plugged:
                    raise OSError("read error")
                return list(bus.reports.pop(0))[:length] if bus.reports else []

            def close(self):
                bus.opened.append(None)

        return types.SimpleNamespace(enumerate=lambda: bus.plugged, device=Device)

    def send(self, *reports):
        self.reports += reports


@pytest.fixture
def bus(monkeypatch):
    bus = Bus()
    monkeypatch.setitem(sys.modules, "hid", bus.module())
    return bus


@pytest.fixture
def spacemouse(bus, peg_setup):
    device = SpaceMouse(peg_setup)
    device.connect()
    return device


def test_it_is_found_among_other_devices(bus, spacemouse):
    assert bus.opened == [b"1-1:1.0"]


@pytest.mark.parametrize(
    ("vendor", "product", "usage", "is_one"),
    [
        (0x046D, 0xC626, (0, 0), True),
        (0x046D, 0xC62B, (1, 8), True),
        (0x256F, 0xC652, (0, 0), True),
        (0x256F, 0xFFFF, (1, 8), True),
        (0x256F, 0xC650, (1, 2), False),
        (0x046D, 0xC534, (1, 2), False),
        (0x1234, 0xC626, (1, 8), False),
    ],
)
def test_old_and_new_models_are_known_and_other_mice_are_not(
    bus, peg_setup, vendor, product, usage, is_one
):
    info = {"vendor_id": vendor, "product_id": product}
    bus.plugged = [COMPACT | info | {"usage_page": usage[0], "usage": usage[1]}]
    device = SpaceMouse(peg_setup)
    if is_one:
        device.connect()
        assert bus.opened == [COMPACT["path"]]
    else:
        with pytest.raises(DeviceLost, match="no SpaceMouse found; plug it in"):
            device.connect()


def test_of_a_receiver_s_interfaces_the_one_with_axes_is_taken(bus, peg_setup):
    keyboard = COMPACT | {"path": b"keys", "usage": 6}
    bus.plugged = [keyboard, COMPACT]
    SpaceMouse(peg_setup).connect()
    assert bus.opened == [COMPACT["path"]]


@pytest.mark.parametrize(
    ("report", "axes"),
    [
        (translation(x=350), [1, 0, 0, 0, 0, 0]),
        (translation(y=350), [0, -1, 0, 0, 0, 0]),
        (translation(z=350), [0, 0, -1, 0, 0, 0]),
        (translation(x=-500), [-1, 0, 0, 0, 0, 0]),
        (rotation(x=350), [0, 0, 0, 1, 0, 0]),
        (rotation(y=350), [0, 0, 0, 0, -1, 0]),
        (rotation(z=350), [0, 0, 0, 0, 0, -1]),
        (both(350, -350, 0, 0, 0, -350), [1, 1, 0, 0, 0, 1]),
        (translation(x=350) + b"\x00" * 3, [1, 0, 0, 0, 0, 0]),
        (translation(x=15, y=-20), [0] * 6),
        (b"\x17\x50", [0] * 6),
        (b"\x01\x00", [0] * 6),
        (b"\x01", [0] * 6),
    ],
)
def test_reports_become_right_forward_and_up(bus, spacemouse, report, axes):
    bus.send(report)
    np.testing.assert_allclose(spacemouse.poll(), axes)


def test_translation_and_rotation_reports_keep_each_other_s_axes(bus, spacemouse):
    bus.send(translation(x=350), rotation(z=-350))
    np.testing.assert_allclose(spacemouse.poll(), [1, 0, 0, 0, 0, 1])
    bus.send(translation())
    np.testing.assert_allclose(spacemouse.poll(), [0, 0, 0, 0, 0, 1])


def test_the_newest_of_many_reports_counts_and_silence_keeps_it(bus, spacemouse):
    bus.send(*(translation(x=x) for x in range(0, 351, 10)))
    assert spacemouse.poll()[0] == 1.0
    assert spacemouse.poll()[0] == 1.0


def test_deflection_rises_from_the_dead_zone_on(bus, spacemouse):
    values = []
    for x in range(0, 351, 25):
        bus.send(translation(x=x))
        values.append(spacemouse.poll()[0])
    assert values[0] == 0 and values[-1] == 1 and (np.diff(values) >= 0).all()
    assert max(np.diff(values)) < 0.12


def test_button_1_is_the_gripper_and_button_2_the_speed_once_a_press(bus, spacemouse):
    gripper = spacemouse.gripper
    bus.send(buttons(1), buttons(1), buttons(), translation())
    spacemouse.poll()
    assert spacemouse.gripper != gripper
    bus.send(buttons(2))
    spacemouse.poll()
    assert spacemouse.speed is SPEEDS[2]
    bus.send(buttons(1, 2), buttons())
    spacemouse.poll()
    assert spacemouse.gripper == 1.0 and spacemouse.speed is SPEEDS[2]


def test_an_emulated_spacemouse_drives_a_whole_recording(
    bus, spacemouse, make_session, tick_until, ended
):
    saved = []
    session = make_session()
    desk = RecordingDesk(session, spacemouse, saved.append)
    desk.press(Control.NEXT)
    bus.send(translation(z=350))
    tick_until(desk, lambda: session.success)
    bus.send(translation())
    tick_until(desk, ended(desk))
    desk.press(Control.NEXT)
    assert saved[0].device == "spacemouse" and saved[0].success[-10:].all()


def test_unplugging_pauses_keeps_the_data_and_says_so_and_plugging_in_resumes(
    bus, spacemouse, make_session, tick_until, ended
):
    saved = []
    session = make_session()
    desk = RecordingDesk(session, spacemouse, saved.append)
    desk.press(Control.NEXT)
    bus.send(translation(z=350))
    for _ in range(30):
        desk.tick()
    bus.plugged = [MOUSE]
    desk.tick()
    assert session.state is SessionState.PAUSED and session.seconds == pytest.approx(1.0)
    assert desk.notice.tone == "bad"
    assert "the SpaceMouse was unplugged. Plug it in and press →" in desk.notice.text
    assert "nothing is lost" in desk.notice.text
    for _ in range(10):
        desk.tick()
    desk.press(Control.NEXT)
    assert (
        session.state is SessionState.PAUSED
        and "Can't steer: no SpaceMouse found; plug" in desk.notice.text
    )
    assert session.seconds == pytest.approx(1.0)

    bus.plugged = [COMPACT]
    desk.press(Control.NEXT)
    assert session.state is SessionState.RECORDING
    desk.tick()
    bus.send(translation(z=350))
    tick_until(desk, lambda: session.success)
    bus.send(translation())
    tick_until(desk, ended(desk))
    desk.press(Control.NEXT)
    assert saved[0].success[-1]
    raw = saved[0].raw_commands
    assert raw[29, :6].any() and not raw[30, :6].any(), "from rest, though it moved before"


def test_one_that_can_t_be_opened_leads_to_the_udev_rule(bus, peg_setup):
    bus.refuses = True
    with pytest.raises(DeviceLost, match=r"can't be opened \(open failed\); set up its udev rule"):
        SpaceMouse(peg_setup).connect()


def test_without_hidapi_the_extra_is_named(monkeypatch, peg_setup):
    monkeypatch.setitem(sys.modules, "hid", None)
    with pytest.raises(MissingExtra, match=r"pip install sart_toolkit\[teleop\]"):
        SpaceMouse(peg_setup).connect()


def test_closing_twice_is_fine(bus, spacemouse):
    spacemouse.close()
    spacemouse.close()
    assert bus.opened[-1] is None and bus.opened.count(None) == 1
