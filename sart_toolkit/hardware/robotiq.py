"""Robotiq's two-finger grippers, by the socket of their URCap or by Modbus."""

from __future__ import annotations

import socket
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

from sart_toolkit.errors import InvalidInput, MissingExtra
from sart_toolkit.hardware.drivers import Clock

PORT = 63352
# Registers by the grippers' manual: what is asked of them, and what they say.
_ASKED, _SAID = 0x03E8, 0x07D0
_ACTIVATE, _GO = 0x01, 0x08
# From this code on a fault keeps the gripper from moving.
_FAULT = 0x08
_ACTIVATION_TIME = 10.0
_POLL = 0.02
# So soon [s] after a move the gripper doesn't tell its new state yet.
_AFTER_MOVE = 0.008


@dataclass(frozen=True)
class _Motion:
    """How a gripper moves, and between which of its own positions, all 0 to 255."""

    speed: int
    force: int
    open_position: int
    closed_position: int

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if isinstance(value, bool) or not isinstance(value, int) or not 0 <= value <= 255:
                raise InvalidInput(f"{name}: expected a whole number from 0 to 255, got {value!r}")
        if self.closed_position <= self.open_position:
            raise InvalidInput(
                f"closed_position: expected more than open_position ({self.open_position}), got "
                f"{self.closed_position}"
            )

    def position(self, target: float) -> int:
        """The gripper's own of a target in [0, 1]."""
        return round(self.open_position + target * (self.closed_position - self.open_position))

    def target(self, position: int) -> float:
        """Where in [0, 1] it is."""
        return (position - self.open_position) / (self.closed_position - self.open_position)


def _until(name: str, what: str, read: Callable[[], int], value: int, remedy: str) -> None:
    """Return once it reads so."""
    deadline = time.monotonic() + _ACTIVATION_TIME
    while (found := read()) != value:
        if time.monotonic() > deadline:
            raise TimeoutError(
                f"{name}: {what} is {found} after {_ACTIVATION_TIME:g} s, expected {value}; "
                f"{remedy}"
            )
        time.sleep(_POLL)


class RobotiqSocket:
    """A 2F-85, 2F-140 or Hand-E behind a UR controller."""

    def __init__(
        self,
        host: str,
        port: int = PORT,
        speed: int = 255,
        force: int = 100,
        open_position: int = 3,
        closed_position: int = 228,
        timeout: float = 1.0,
        clock: Clock = time.monotonic,
    ) -> None:
        """A gripper that isn't connected yet.

        Args:
            host: address of the controller.
            port: of the URCap.
            speed, force: of its motion, 0 to 255.
            open_position, closed_position: what it says of itself, 0 to 255, when it is open and
                when it is closed on nothing.
            timeout: how long it may take to answer [s].
            clock: not used, it tells no times.

        Raises:
            InvalidInput: a value is out of range.
        """
        self._motion = _Motion(speed, force, open_position, closed_position)
        self._address, self._timeout = (host, port), timeout
        self._socket: socket.socket | None = None
        self._ready = 0.0

    def connect(self) -> None:
        self._socket = socket.create_connection(self._address, self._timeout)
        self._socket.settimeout(self._timeout)

    def start(self) -> None:
        if self._get("STA") == 3:
            return
        self._set("ACT 0 ATR 0")
        self._until_state(0)
        self._set("ACT 1")
        self._until_state(3)

    def move(self, target: float) -> None:
        motion = self._motion
        self._set(f"POS {motion.position(target)} SPE {motion.speed} FOR {motion.force} GTO 1")
        self._ready = time.monotonic() + _AFTER_MOVE

    def position(self) -> float:
        return self._motion.target(self._get("POS"))

    def disconnect(self) -> None:
        connection, self._socket = self._socket, None
        if connection is not None:
            with suppress(OSError):
                connection.close()

    def _until_state(self, state: int) -> None:
        remedy = "activate it on the pendant"
        _until(self._name, "STA", lambda: self._get("STA"), state, remedy)

    def _set(self, values: str) -> None:
        answer = self._ask(f"SET {values}", words=1)
        if answer != "ack":
            raise ConnectionError(
                f"{self._name}: refuses SET {values}, it answers {answer!r}; see the pendant"
            )

    def _get(self, variable: str) -> int:
        answer = self._ask(f"GET {variable}", words=2)
        name, _, number = answer.partition(" ")
        if name != variable or not number.isdigit():
            raise ConnectionError(
                f"{self._name}: answers GET {variable} with {answer!r}; see the pendant"
            )
        return int(number)

    def _ask(self, line: str, words: int) -> str:
        """The answer to a line, of so many words. It need not end a line: `ack` comes without."""
        if self._socket is None:
            raise ConnectionError(f"{self._name}: isn't connected")
        if (early := self._ready - time.monotonic()) > 0:
            time.sleep(early)
        answer = b""
        try:
            self._socket.sendall(line.encode() + b"\n")
            while len(answer.split()) < words:
                more = self._socket.recv(1024)
                if not more:
                    raise ConnectionError("it hung up")
                answer += more
        except OSError as error:
            raise ConnectionError(
                f"{self._name}: doesn't answer ({error}); check its cable and that its URCap runs"
            ) from error
        return answer.decode(errors="replace").strip()

    @property
    def _name(self) -> str:
        host, port = self._address
        return f"gripper at {host}:{port}"


class RobotiqModbus:
    """A 2F-85, 2F-140 or Hand-E on a serial line, by Modbus RTU: no URCap and no UR is needed."""

    def __init__(
        self,
        device: str,
        address: int = 9,
        baudrate: int = 115200,
        speed: int = 255,
        force: int = 100,
        open_position: int = 3,
        closed_position: int = 228,
        timeout: float = 0.2,
        clock: Clock = time.monotonic,
    ) -> None:
        """A gripper that isn't connected yet.

        Args:
            device: the serial line, such as /dev/ttyUSB0.
            address: its own on the line.
            baudrate: of the line.
            speed, force: of its motion, 0 to 255.
            open_position, closed_position: what it says of itself, 0 to 255, when it is open and
                when it is closed on nothing.
            timeout: how long it may take to answer [s].
            clock: not used, it tells no times.

        Raises:
            InvalidInput: a value is out of range.
        """
        self._motion = _Motion(speed, force, open_position, closed_position)
        self._device, self._address, self._baudrate = device, address, baudrate
        self._timeout = timeout
        self._line: Any = None

    def connect(self) -> None:
        try:
            from pymodbus.client import ModbusSerialClient
            from pymodbus.exceptions import ModbusException
        except ImportError as error:
            raise MissingExtra(
                f"a gripper by Modbus needs pymodbus ({error}); pip install sart_toolkit[modbus]"
            ) from error
        line = ModbusSerialClient(self._device, baudrate=self._baudrate, timeout=self._timeout)
        if not line.connect():
            raise ConnectionError(
                f"{self._name}: the line can't be opened; check its adapter, and that "
                "you may read it"
            )
        self._line, self._failure = line, ModbusException

    def start(self) -> None:
        if self._state() == 3:
            return
        remedy = "see its light, and the manual"
        self._ask(0, 0)
        _until(self._name, "gSTA", self._state, 0, remedy)
        self._ask(_ACTIVATE, 0)
        _until(self._name, "gSTA", self._state, 3, remedy)

    def move(self, target: float) -> None:
        self._ask(_ACTIVATE | _GO, self._motion.position(target))

    def position(self) -> float:
        _, fault, position = self._said()
        if fault >= _FAULT:
            raise ConnectionError(
                f"{self._name}: reports fault 0x{fault:02X}; see the manual, and activate it again"
            )
        return self._motion.target(position)

    def disconnect(self) -> None:
        line, self._line = self._line, None
        if line is not None:
            line.close()

    def _state(self) -> int:
        return self._said()[0] >> 4 & 0x03

    def _said(self) -> tuple[int, int, int]:
        """Its status, fault and position, a byte each."""
        words = self._answer(
            lambda line: line.read_input_registers(_SAID, count=3, device_id=self._address)
        ).registers
        return words[0] >> 8, words[1] >> 8, words[2] >> 8

    def _ask(self, action: int, position: int) -> None:
        words = [action << 8, position, self._motion.speed << 8 | self._motion.force]
        self._answer(lambda line: line.write_registers(_ASKED, words, device_id=self._address))

    def _answer(self, ask: Callable[[Any], Any]) -> Any:
        if self._line is None:
            raise ConnectionError(f"{self._name}: isn't connected")
        try:
            answer = ask(self._line)
        except (self._failure, OSError) as error:
            raise ConnectionError(
                f"{self._name}: doesn't answer ({error}); check its power, its cable "
                "and its address"
            ) from error
        if answer.isError():
            raise ConnectionError(f"{self._name}: refuses what it is asked ({answer})")
        return answer

    @property
    def _name(self) -> str:
        return f"gripper {self._address} at {self._device}"
