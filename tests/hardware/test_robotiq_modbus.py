"""The Modbus driver against a gripper that speaks Modbus RTU on a pseudo-terminal."""

import os
import struct
import sys
import threading
import time
import tty

import pytest

from sart_toolkit.errors import InvalidInput, MissingExtra
from sart_toolkit.hardware import DRIVERS
from sart_toolkit.hardware.cell import Part
from sart_toolkit.hardware.robotiq import RobotiqModbus


def _crc(data: bytes) -> bytes:
    """CRC-16 of the serial line protocol, low byte first."""
    crc = 0xFFFF
    for byte in data:
        crc ^= byte
        for _ in range(8):
            crc = crc >> 1 ^ 0xA001 if crc & 1 else crc >> 1
    return struct.pack("<H", crc)


class Gripper:
    """A gripper by its manual: registers, activation in steps, motion at its speed."""

    def __init__(self) -> None:
        self.line, self._end = os.openpty()
        tty.setraw(self.line)
        tty.setraw(self._end)
        self.device = os.ttyname(self._end)
        self.address, self.fault, self.silent, self.refuses = 9, 0, False, False
        self.status, self.position, self.wanted = 0, 3, 3
        self.asked: list[tuple[int, int, int, int]] = []
        self._activated = 0.0
        threading.Thread(target=self._serve, daemon=True).start()

    def close(self) -> None:
        os.close(self.line)
        os.close(self._end)

    def _serve(self) -> None:
        got = b""
        while True:
            try:
                got += os.read(self.line, 256)
            except OSError:
                return
            # Read input registers, or write several: as long as their heads say.
            while len(got) >= 8:
                n = 8 if got[1] == 4 else 9 + got[6]
                if len(got) < n:
                    break
                frame, got = got[:n], got[n:]
                assert frame[-2:] == _crc(frame[:-2])
                if frame[0] == self.address and not self.silent:
                    answer = self._answer(frame)
                    os.write(self.line, answer + _crc(answer))

    def _answer(self, frame: bytes) -> bytes:
        function, start, count = struct.unpack(">BHH", frame[1:6])
        if self.refuses:
            return bytes([self.address, function | 0x80, 2])
        if function == 4:
            assert (start, count) == (0x07D0, 3)
            self._live()
            words = (self.status << 8, self.fault << 8 | self.wanted, self.position << 8)
            return bytes([self.address, 4, 6]) + struct.pack(">3H", *words)
        assert (function, start, count) == (16, 0x03E8, 3)
        action, wanted, motion = struct.unpack(">3H", frame[7:13])
        self._take(action >> 8, wanted, motion >> 8, motion & 0xFF)
        return frame[:6]

    def _take(self, action: int, wanted: int, speed: int, force: int) -> None:
        self.asked.append((action, wanted, speed, force))
        if not action & 1:
            self.status = 0
        elif not self.status & 1:
            self.status, self._activated = 0x11, time.monotonic() + 0.1
        elif self.status >> 4 == 3 and action & 8:
            self.wanted = self.position = wanted

    def _live(self) -> None:
        if self.status == 0x11 and time.monotonic() > self._activated:
            self.status = 0x31


@pytest.fixture
def server():
    server = Gripper()
    yield server
    server.close()


@pytest.fixture
def gripper(server):
    gripper = RobotiqModbus(server.device, force=40)
    gripper.connect()
    yield gripper
    gripper.disconnect()


def test_it_is_activated_once_and_goes_where_it_is_sent(gripper, server):
    gripper.start()
    assert [action for action, *_ in server.asked] == [0, 1]
    gripper.start()
    assert len(server.asked) == 2
    for target, position in ((1.0, 228), (0.0, 3), (0.4, 93)):
        gripper.move(target)
        assert server.asked[-1] == (0x09, position, 255, 40)
        assert gripper.position() == pytest.approx(target, abs=1e-9)


def test_before_it_is_activated_it_is_where_it_was(gripper, server):
    gripper.move(1.0)
    assert gripper.position() == 0.0


def test_a_fault_is_an_error_and_a_warning_is_none(gripper, server):
    gripper.start()
    server.fault = 0x05
    assert gripper.position() == 0.0
    server.fault = 0x0E
    with pytest.raises(ConnectionError, match="fault 0x0E; see the manual"):
        gripper.position()


def test_one_that_does_not_answer_is_named(server):
    gripper = RobotiqModbus(server.device, timeout=0.02)
    gripper.connect()
    server.silent = True
    with pytest.raises(ConnectionError, match="gripper 9 at .* doesn't answer"):
        gripper.position()
    gripper.disconnect()


def test_another_address_on_the_line_is_another_gripper(server):
    gripper = RobotiqModbus(server.device, address=10, timeout=0.02)
    gripper.connect()
    with pytest.raises(ConnectionError, match="gripper 10 at .* doesn't answer"):
        gripper.position()
    gripper.disconnect()


def test_what_it_refuses_is_said(gripper, server):
    server.refuses = True
    with pytest.raises(ConnectionError, match="refuses what it is asked"):
        gripper.move(1.0)


def test_activation_that_does_not_end_is_given_up(gripper, server, monkeypatch):
    monkeypatch.setattr("sart_toolkit.hardware.robotiq._ACTIVATION_TIME", 0.05)
    monkeypatch.setattr(server, "_live", lambda: None)
    with pytest.raises(TimeoutError, match=r"gSTA is 1 after 0\.05 s, expected 3; see its light"):
        gripper.start()


def test_a_line_that_is_not_there_is_named(tmp_path):
    with pytest.raises(ConnectionError, match="the line can't be opened; check its adapter"):
        RobotiqModbus(str(tmp_path / "ttyUSB7")).connect()


def test_a_closed_gripper_is_no_gripper(gripper):
    gripper.disconnect()
    gripper.disconnect()
    with pytest.raises(ConnectionError, match="isn't connected"):
        gripper.position()


def test_a_missing_library_is_named_with_what_installs_it(monkeypatch):
    monkeypatch.setitem(sys.modules, "pymodbus.client", None)
    with pytest.raises(MissingExtra, match=r"pip install sart_toolkit\[modbus\]"):
        RobotiqModbus("/dev/null").connect()


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"force": 300}, "force: expected a whole number from 0 to 255, got 300"),
        ({"open_position": 228}, "closed_position: expected more than open_position"),
    ],
)
def test_an_option_that_can_not_be_is_refused(options, said):
    with pytest.raises(InvalidInput, match=said):
        RobotiqModbus("/dev/ttyUSB0", **options)


def test_a_cell_s_file_names_it():
    assert "robotiq_modbus" in DRIVERS["gripper"]
    part = Part("gripper", "robotiq_modbus", {"device": "/dev/ttyUSB0"})
    assert isinstance(part.made(clock=time.monotonic), RobotiqModbus)
