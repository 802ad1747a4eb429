"""Who keeps the arm's rate: a process of its own, the caller itself, or nobody."""

from __future__ import annotations

import multiprocessing
import signal
import time
from collections import deque
from collections.abc import Sequence
from contextlib import suppress
from multiprocessing.connection import Connection
from types import FrameType
from typing import Any, Protocol

from sart_toolkit.errors import RobotStopped, SartError
from sart_toolkit.hardware.cell import Cell
from sart_toolkit.hardware.drivers import Arm, ArmState, Clock
from sart_toolkit.hardware.servo import RESUME, Servo
from sart_toolkit.poses import Array
from sart_toolkit.robots.model import RobotModel
from sart_toolkit.robots.spec import Attachment, RobotSpec

# How long [s] the process may take to begin, and then to answer.
_START_TIME, _ANSWER_TIME = 60.0, 0.5
# For so long [s] it remembers what the arm measured, in case nobody asks.
_REMEMBERED = 10.0
_REPORT = "report"
_NO_ANSWER = (
    f"robot stopped: the process that moves the arm doesn't answer; see the robot, {RESUME}"
)


class Link(Protocol):
    """A servo, wherever it runs; all but `close` raise `RobotStopped` once the arm is stopped."""

    first: ArmState

    def push(self, targets: Array, seconds: float) -> None:
        """Give joints `(m, n)` [rad] to follow, at even steps over the next `seconds`."""

    def wait(self, left: float) -> Sequence[ArmState]:
        """Wait until at most `left` seconds of what was given are left.

        Returns what the arm measured since this was called before.
        """

    def newest(self) -> Sequence[ArmState]:
        """What the arm measured since, without waiting; nothing where time stands still."""

    def guide(self) -> None:
        """Leave the arm to a person's hand, until `hold`: what is pushed only takes its time."""

    def hold(self) -> ArmState:
        """Take the arm back; what it measures where it is then."""

    def stop(self, reason: str) -> None:
        """Stop the arm for good."""

    def close(self) -> None:
        """Stop the arm and disconnect; calling it again does nothing."""


class Inline:
    """A servo that runs while it is waited for, and only then: with an emulated arm."""

    def __init__(self, cell: Cell, model: RobotModel, clock: Clock) -> None:
        """Connect the arm and take over control.

        Raises:
            RobotStopped: it can't be moved.
        """
        arm = cell.make_arm(clock)
        self._servo, self._pushed = Servo(arm, model, cell, clock), 0.0
        try:
            _connect(arm)
            self.first = self._servo.start()
        except BaseException:
            self._servo.close()
            raise

    def push(self, targets: Array, seconds: float) -> None:
        self._servo.push(targets, seconds)
        self._pushed += seconds

    def wait(self, left: float) -> Sequence[ArmState]:
        states = list[ArmState]()
        while not states or self._pushed - self._servo.consumed > left + 1e-9:
            states.append(self._servo.tick())
        return states

    def newest(self) -> Sequence[ArmState]:
        return ()

    def guide(self) -> None:
        self._servo.guide()

    def hold(self) -> ArmState:
        return self._servo.hold()

    def stop(self, reason: str) -> None:
        self._servo.stop(reason)

    def close(self) -> None:
        self._servo.close()


class Watching:
    """An arm that is read and never moved: what is pushed has no effect."""

    def __init__(self, cell: Cell, clock: Clock) -> None:
        """Connect the arm; control stays where it is."""
        self._arm, self._clock = cell.make_arm(clock), clock
        self._speed, self._due = cell.limits.speed_scale, clock()
        try:
            _connect(self._arm)
            self.first = self._read()
        except BaseException:
            self.close()
            raise

    def push(self, targets: Array, seconds: float) -> None:
        self._due += seconds / self._speed

    def wait(self, left: float) -> Sequence[ArmState]:
        if (early := self._due - self._clock()) > 0:
            time.sleep(early)
        self._due = max(self._due, self._clock())
        return [self._read()]

    def newest(self) -> Sequence[ArmState]:
        return [self._read()]

    def guide(self) -> None:
        pass

    def hold(self) -> ArmState:
        return self._read()

    def stop(self, reason: str) -> None:
        pass

    def close(self) -> None:
        with suppress(Exception):
            self._arm.disconnect()

    def _read(self) -> ArmState:
        try:
            return self._arm.read()
        except Exception as error:
            raise RobotStopped(f"arm can't be read: {error}; {RESUME}") from error


class OwnProcess:
    """A servo in a process of its own, which keeps the arm's rate whatever this one does.

    If this process ends, however it does, the other stops the arm and ends. If it hangs, the arm
    comes to a rest where it was sent last.
    """

    def __init__(self, cell: Cell, robot: RobotSpec, held: Sequence[Attachment]) -> None:
        """Start the process, connect the arm and take over control.

        Raises:
            RobotStopped: the arm can't be moved.
        """
        context = multiprocessing.get_context("spawn")
        self._pipe, theirs = context.Pipe()
        self._process = context.Process(
            target=_serve, args=(cell, robot, tuple(held), theirs), daemon=True
        )
        self._process.start()
        theirs.close()
        self._pushed, self._consumed = 0.0, 0.0
        # How fast what is pushed is followed.
        self._scale = self._speed = cell.limits.speed_scale
        try:
            self.first = self._answer(_START_TIME)
        except BaseException:
            self.close()
            raise

    def push(self, targets: Array, seconds: float) -> None:
        self._send("push", targets, seconds)
        self._pushed += seconds

    def wait(self, left: float) -> Sequence[ArmState]:
        states: list[ArmState] = []
        while True:
            states += self.newest()
            over = self._pushed - self._consumed - left
            if states and over <= 1e-9:
                return states
            time.sleep(max(over, 1e-3) / self._speed)

    def newest(self) -> Sequence[ArmState]:
        self._send(_REPORT)
        self._consumed, states = self._answer(_ANSWER_TIME)
        return list(states)

    def guide(self) -> None:
        self._send("guide")
        # A hand isn't slowed down.
        self._speed = 1.0

    def hold(self) -> ArmState:
        self._send("hold")
        self._speed = self._scale
        state: ArmState = self._answer(_ANSWER_TIME)
        return state

    def stop(self, reason: str) -> None:
        with suppress(RobotStopped):
            self._send("stop", reason)

    def close(self) -> None:
        self._pipe.close()
        # Long enough for the arm to stop.
        self._process.join(5.0)
        if self._process.is_alive():
            self._process.terminate()
            self._process.join()

    def _send(self, what: str, *values: Any) -> None:
        """Have the servo do something, by its method's name, or ask for a report."""
        try:
            self._pipe.send((what, *values))
        except OSError as error:
            raise RobotStopped(_NO_ANSWER) from error

    def _answer(self, seconds: float) -> Any:
        try:
            if not self._pipe.poll(seconds):
                raise RobotStopped(_NO_ANSWER)
            answer = self._pipe.recv()
        except (EOFError, OSError) as error:
            raise RobotStopped(_NO_ANSWER) from error
        if isinstance(answer, Exception):
            raise answer
        return answer


def _connect(arm: Arm) -> None:
    try:
        arm.connect()
    except SartError:
        raise
    except Exception as error:
        raise RobotStopped(
            f"arm can't be connected: {error}; check its address and cable, {RESUME}"
        ) from error


def _serve(cell: Cell, robot: RobotSpec, held: tuple[Attachment, ...], pipe: Connection) -> None:
    """The other process: moves the arm until the pipe is closed."""

    def end(number: int, frame: FrameType | None) -> None:
        raise SystemExit(128 + number)

    # A person's Ctrl-C is for the process that asks, which closes the pipe then.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, end)
    servo: Servo | None = None
    with suppress(EOFError, OSError):
        try:
            arm = cell.make_arm()
            servo = Servo(arm, RobotModel(robot, held), cell, time.monotonic)
            _connect(arm)
            pipe.send(servo.start())
            _move(servo, pipe, cell.control.rate_hz)
        except SartError as error:
            _refuse(error, pipe)
        except (EOFError, BrokenPipeError):
            raise
        except Exception as error:
            _refuse(RobotStopped(f"robot stopped: {error}; {RESUME}"), pipe)
        finally:
            if servo is not None:
                servo.close()


def _move(servo: Servo, pipe: Connection, rate_hz: int) -> None:
    states: deque[ArmState] = deque(maxlen=round(_REMEMBERED * rate_hz))
    while True:
        while pipe.poll():
            what, *values = pipe.recv()
            if what == _REPORT:
                pipe.send((servo.consumed, list(states)))
                states.clear()
            elif (answer := getattr(servo, what)(*values)) is not None:
                pipe.send(answer)
        states.append(servo.tick())


def _refuse(error: SartError, pipe: Connection) -> None:
    """Answer every question with an error, until the pipe is closed."""
    pipe.send(error)
    while True:
        if pipe.recv()[0] == _REPORT:
            pipe.send(error)
