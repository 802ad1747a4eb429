"""What an arm, a gripper and a camera promise, whoever made them.

A driver is made with the options of its table in the cell's file, as keyword arguments, and with
`clock`, the time [s] that all its times are told in; an arm with `rate_hz` as well, how often it
is sent targets. Whatever goes wrong a driver raises, with what it got and what to do; who calls it
has the robot stopped then.
"""

from __future__ import annotations

import importlib
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

from sart_toolkit.data.records import DepthImage, Image
from sart_toolkit.errors import MissingExtra
from sart_toolkit.poses import Array

Clock = Callable[[], float]


@dataclass(frozen=True)
class ArmState:
    """What an arm measured: `q`, `dq (n,)` [rad, rad/s] at `time` [s].

    `trouble`: why it doesn't move now and what to do, empty where it does. `force`: the contact
    force [N] at the tool, `None` where the arm doesn't sense any.
    """

    q: Array
    dq: Array
    time: float
    trouble: str = ""
    force: float | None = None


class World(Protocol):
    """Where a cell's parts are, where that isn't the real world; they find it by themselves.

    One with a method `attend(text)` does by itself what a person beside a robot is asked to.
    """

    def now(self) -> float:
        """Its time [s]."""

    def close(self) -> None:
        """Free it; calling it again does nothing."""


class Arm(Protocol):
    """An arm that follows joint targets at its controller's rate.

    Attributes:
        senses_force: whether its states hold a force.
    """

    senses_force: bool

    def connect(self) -> None:
        """Open the connection, so that it can be read; nothing moves, nothing is taken over."""

    def start(self) -> None:
        """Take over control: targets may be sent from now on, until `stop`."""

    def read(self) -> ArmState:
        """What it measures now."""

    def servo(self, q: Array, period: float) -> None:
        """Send the joints `(n,)` [rad] that it is to be at in `period` [s]."""

    def wait(self) -> None:
        """Return when the next period of its controller begins."""

    def stop(self) -> None:
        """Have it come to a stop, and give control back; without `start` nothing happens."""

    def disconnect(self) -> None:
        """Close the connection; calling it again does nothing."""


class GuidedArm(Arm, Protocol):
    """An arm that a person's hand may move, too; one that can't has none of these methods."""

    def guide(self) -> None:
        """Leave the joints to a person's hand for the next period, in place of `servo`."""

    def hold(self) -> None:
        """Take the joints back where they are; without `guide` nothing happens. `stop` does so too.

        Targets may be sent again.
        """


class Gripper(Protocol):
    """A gripper that goes to where it is sent, 0 open, 1 closed."""

    def connect(self) -> None:
        """Open the connection, so that it can be read; nothing moves."""

    def start(self) -> None:
        """Make it ready to move. It may have to open and close for that."""

    def move(self, target: float) -> None:
        """Send it to a target in [0, 1] and don't wait."""

    def position(self) -> float:
        """Where it is, in [0, 1]."""

    def disconnect(self) -> None:
        """Close the connection; calling it again does nothing."""


@dataclass(frozen=True)
class CameraImage:
    """One image, taken at `time` [s].

    `rgb (H,W,3)` uint8; `depth (H,W)` float32 [m] along z of the same camera, 0 where there is
    none; `intrinsics (3,3)` [pixels] of both, without distortion.
    """

    rgb: Image
    depth: DepthImage
    intrinsics: Array
    time: float


class Camera(Protocol):
    """An RGB-D camera that takes images by itself."""

    def connect(self) -> None:
        """Open it; images are taken from now on."""

    def newest(self) -> float:
        """When the newest image was taken [s]; returns at once."""

    def read(self) -> CameraImage:
        """The newest image."""

    def disconnect(self) -> None:
        """Close it; calling it again does nothing."""


class Periods:
    """Waits for each of an arm's periods to begin, where its own library doesn't."""

    def __init__(self, rate_hz: int, clock: Clock) -> None:
        """Count `rate_hz` periods a second by a clock, from `start` on."""
        self._period, self._clock, self._next = 1.0 / rate_hz, clock, 0.0

    def start(self) -> None:
        """A period begins now."""
        self._next = self._clock()

    def wait(self) -> None:
        """Return when the next one begins; those that were missed are left out."""
        self._next = max(self._next + self._period, self._clock())
        time.sleep(max(0.0, self._next - self._clock()))


class ClockOffset:
    """Turns a device's own times into those of our clock.

    What a device sends arrives late, and never early, so the least difference seen is the nearest
    to that of the clocks.
    """

    def __init__(self) -> None:
        self._least: float | None = None

    def to_clock(self, stamp: float, now: float) -> float:
        """A device's time [s] in ours, what bears it having arrived at `now` [s]."""
        if self._least is None or now - stamp < self._least:
            self._least = now - stamp
        return stamp + self._least


def imported(name: str, need: str, extra: str) -> Any:
    """A module of a driver's library, imported when it is needed.

    Args:
        name: of the module.
        need: what needs which library.
        extra: of the toolkit's, that brings it.

    Raises:
        MissingExtra: it isn't installed.
    """
    try:
        return importlib.import_module(name)
    except ImportError as error:
        raise MissingExtra(f"{need} ({error}); pip install sart_toolkit[{extra}]") from error
