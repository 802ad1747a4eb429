"""Robotiq's two-finger grippers by the socket of their URCap."""

from __future__ import annotations

import socket
import time
from contextlib import suppress

from sart_toolkit.errors import InvalidInput
from sart_toolkit.hardware.drivers import Clock

PORT = 63352
_ACTIVATION_TIME = 10.0
_POLL = 0.02
# So soon [s] after a move the gripper doesn't tell its new state yet.
_AFTER_MOVE = 0.008


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
        for name, value in (
            ("speed", speed),
            ("force", force),
            ("open_position", open_position),
            ("closed_position", closed_position),
        ):
            if isinstance(value, bool) or not isinstance(value, int) or not 0 <= value <= 255:
                raise InvalidInput(f"{name}: expected a whole number from 0 to 255, got {value!r}")
        if closed_position <= open_position:
            raise InvalidInput(
                f"closed_position: expected more than open_position ({open_position}), got "
                f"{closed_position}"
            )
        self._address, self._timeout = (host, port), timeout
        self._motion = f"SPE {speed} FOR {force} GTO 1"
        self._open, self._range = open_position, closed_position - open_position
        self._socket: socket.socket | None = None
        self._ready = 0.0

    def connect(self) -> None:
        self._socket = socket.create_connection(self._address, self._timeout)
        self._socket.settimeout(self._timeout)

    def start(self) -> None:
        if self._get("STA") == 3:
            return
        self._set("ACT 0 ATR 0")
        self._until("STA", 0)
        self._set("ACT 1")
        self._until("STA", 3)

    def move(self, target: float) -> None:
        self._set(f"POS {round(self._open + target * self._range)} {self._motion}")
        self._ready = time.monotonic() + _AFTER_MOVE

    def position(self) -> float:
        return (self._get("POS") - self._open) / self._range

    def disconnect(self) -> None:
        connection, self._socket = self._socket, None
        if connection is not None:
            with suppress(OSError):
                connection.close()

    def _until(self, variable: str, value: int) -> None:
        deadline = time.monotonic() + _ACTIVATION_TIME
        while (found := self._get(variable)) != value:
            if time.monotonic() > deadline:
                raise TimeoutError(
                    f"{self._name}: {variable} is {found} after {_ACTIVATION_TIME:g} s, expected "
                    f"{value}; activate it on the pendant"
                )
            time.sleep(_POLL)

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
