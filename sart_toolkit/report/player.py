"""What was recorded, to look at again: images and facts by waypoint, as a film or in a window."""

from __future__ import annotations

import time
from collections import OrderedDict
from collections.abc import Callable, Iterator, Sequence
from typing import Literal

import numpy as np

from sart_toolkit.backends.interface import Backend, Draws, require
from sart_toolkit.collision.phases import Phase, demonstration_phases
from sart_toolkit.collision.world import CollisionWorld
from sart_toolkit.data.records import Demonstration, Episode, Image
from sart_toolkit.errors import InvalidInput, unknown_name
from sart_toolkit.poses import Array, check_positive, inverse
from sart_toolkit.record.screen import (
    BACKGROUND,
    BLUE,
    BRIGHT,
    CARD,
    FAINT,
    GREEN,
    LINE,
    ORANGE,
    TEXT,
    Closed,
    Key,
    Screen,
)
from sart_toolkit.report.video import inset, strip
from sart_toolkit.scenes.spec import SceneState

FILM_SIZE = 480
_WINDOW_SIZE = 448
# Images of the scene kept in the window, so that stepping to and fro is quick.
_KEPT = 120
# How long [s] a stopped player waits for something to do.
_IDLE = 0.5


class Playback:
    """A demonstration, or an episode and the part of its demonstration that it joins.

    Attributes:
        title: what is played.
        demonstration: the recorded one, or what the episode was made from.
        split: how many waypoints come from the episode; 0 for a demonstration.
        camera: the recorded camera whose images are shown; another of them may be set.
    """

    def __init__(
        self,
        title: str,
        demonstration: Demonstration,
        episode: Episode | None = None,
    ) -> None:
        """Play a demonstration, or one of the episodes made from it.

        Args:
            title: what it is called.
            demonstration: the recorded demonstration.
            episode: its segment is played first, then what follows of the demonstration.

        Raises:
            InvalidInput: no images were recorded.
        """
        self.title, self.demonstration = title, demonstration
        self._parts = [(demonstration.steps, t) for t in range(len(demonstration))]
        self.split = 0
        if episode is not None:
            self.split = len(episode)
            segment = [(episode.steps, i) for i in range(len(episode))]
            self._parts = segment + self._parts[episode.suffix(demonstration)]
        self._first = 0 if episode is None else episode.provenance.t_star
        cameras = list(demonstration.steps.cameras)
        if not cameras:
            raise InvalidInput(f"{title}: holds no images; record it with a camera")
        self.camera = cameras[0]

    def __len__(self) -> int:
        return len(self._parts)

    @property
    def seconds(self) -> float:
        """How long it lasts [s]."""
        return (len(self) - 1) / self.hz

    @property
    def hz(self) -> int:
        """Steps a second."""
        return self.demonstration.rates.record_hz

    def waypoint(self, i: int) -> int:
        """The demonstration's waypoint at step `i`; in a segment, the one it joins."""
        return self._first + max(0, i - self.split)

    def image(self, i: int) -> Image:
        """What the recorded camera saw at step `i`, `(H, W, 3)` uint8."""
        steps, t = self._parts[i]
        return steps.cameras[self.camera].rgb[t]

    def gripper(self, i: int) -> tuple[float, float]:
        """The gripper's measured and commanded opening at step `i`, in [0, 1]."""
        steps, t = self._parts[i]
        return float(steps.measured_gripper[t]), float(steps.commanded_gripper[t])

    def force(self, i: int) -> float:
        """The contact force at step `i` [N]; NaN where it was not measured."""
        steps, t = self._parts[i]
        return float(steps.contact_force[t])

    def success(self, i: int) -> bool:
        """Whether the goal was reached at step `i`; never within an episode's segment."""
        return i >= self.split and bool(self.demonstration.success[self.waypoint(i)])

    def part(self, i: int) -> Literal["demonstration", "segment"]:
        """Where step `i` comes from."""
        return "segment" if i < self.split else "demonstration"

    def joints(self, i: int) -> tuple[Array, Array]:
        """The measured joints `(n,)` [rad] and tool pose `(4, 4)` at step `i`."""
        steps, t = self._parts[i]
        return steps.joint_positions[t], steps.measured_Ts_world_tool[t]

    def bodies(self, i: int, phases: Sequence[Phase]) -> dict[str, Array]:
        """Where the scene's bodies were at step `i` `(4, 4)`, as far as the demonstration tells.

        Through an episode's segment they are where the demonstration had them at the waypoint that
        it joins, and what is grasped there, as the demonstration's `phases` say, moves with the
        tool.
        """
        t, demonstration = self.waypoint(i), self.demonstration
        Ts = {name: poses[t] for name, poses in demonstration.body_Ts_world.items()}
        T_then = demonstration.steps.measured_Ts_world_tool[t]
        T_moved = self.joints(i)[1] @ inverse(T_then)
        return {name: T_moved @ T if name in phases[t].grasped else T for name, T in Ts.items()}

    def clearances(self, world: CollisionWorld) -> Array:
        """How far `(n,)` [m] the tool was from the nearest obstacle at each step."""
        steps = range(len(self))
        return np.array([world.tool_clearance(self.waypoint(i), self.joints(i)[0]) for i in steps])


class SceneView:
    """Draws the scene from outside as it was at each step, from recorded joints and bodies."""

    def __init__(self, playback: Playback, backend: Backend, camera: str) -> None:
        """Draw with a backend of the demonstration's robot and scene.

        Raises:
            MissingCapability: the backend doesn't draw.
            UnknownName: no such camera in the scene.
            InvalidInput: where the bodies were wasn't recorded.
        """
        self._stage = require(backend, Draws, "a recording is drawn from outside")
        if camera not in backend.cameras:
            known = {*backend.cameras, *playback.demonstration.steps.cameras}
            raise unknown_name("camera", camera, known)
        missing = [
            body.name
            for body in backend.scene.bodies
            if body.name not in playback.demonstration.body_Ts_world
        ]
        if missing:
            raise InvalidInput(
                f"{playback.title}: doesn't tell where {missing[0]!r} was, so the scene can't be "
                f"drawn; add --camera {playback.camera}"
            )
        self._playback, self._scene, self._camera = playback, backend.scene, backend.cameras[camera]
        self._phases = demonstration_phases(playback.demonstration, backend.robot, backend.scene)

    def image(self, i: int, size: int) -> Image:
        """The scene at step `i`, `(size, size, 3)` uint8."""
        return self._stage.draw(self._state(i), self._camera, size, size).rgb

    def _state(self, i: int) -> SceneState:
        playback, scene = self._playback, self._scene
        Ts = playback.bodies(i, self._phases)
        known = {body.name: Ts[body.name] for body in scene.bodies}
        return scene.seen_state(playback.joints(i)[0], playback.gripper(i)[0], known)


def film(playback: Playback, scene: SceneView | None) -> Iterator[Image]:
    """The frames of a film, one each recorded step.

    Args:
        playback: what is shown.
        scene: draws it from outside, the wrist view inset; without it the wrist view alone.
    """
    for i in range(len(playback)):
        image = playback.image(i)
        frame = image if scene is None else inset(scene.image(i, FILM_SIZE), image)
        yield strip(_large(frame), _facts(playback, i), i / playback.hz)


def _large(frame: Image) -> Image:
    """A small image made large enough to write under, each pixel a square."""
    times = max(1, round(FILM_SIZE / frame.shape[0]))
    return np.repeat(np.repeat(frame, times, axis=0), times, axis=1)


def _facts(playback: Playback, i: int) -> str:
    force = playback.force(i)
    force_text = "" if np.isnan(force) else f" · {force:.0f} N"
    reached = " · goal reached" if playback.success(i) else ""
    return f"{playback.part(i)} · gripper {playback.gripper(i)[0]:.2f}{force_text}{reached}"


class Player:
    """At which step a playback is, and whether it moves on by itself.

    Attributes:
        at: the step shown.
        playing: whether it moves on by itself.
        closed: whether the person has left.
    """

    def __init__(
        self,
        playback: Playback,
        speed: float = 1.0,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """Begin to play at the first step.

        Args:
            playback: what is shown.
            speed: times real time.
            clock: returns the time [s].

        Raises:
            InvalidInput: the speed is not positive.
        """
        self._period = 1.0 / (playback.hz * check_positive("speed", speed))
        self._playback, self._speed, self._clock = playback, speed, clock
        self.at, self.playing = 0, True
        self.closed = False
        self._due = clock() + self._period

    @property
    def pace(self) -> str:
        """How fast it plays, in words."""
        return "in real time" if self._speed == 1 else f"{self._speed:g} times real time"

    @property
    def wait(self) -> float:
        """How long [s] nothing is to be done."""
        return max(0.0, self._due - self._clock()) if self.playing else _IDLE

    def advance(self) -> None:
        """Go one step forward if it is time to."""
        if self.playing and self._clock() >= self._due:
            self.step(1)
            # Where drawing takes longer than a step, no step is left out.
            self._due = max(self._due + self._period, self._clock())

    def key(self, name: str) -> None:
        """Do what a key means, by pygame's name of it."""
        last = len(self._playback) - 1
        match name:
            case "space":
                if not self.playing and self.at == last:
                    self.at = 0
                self.playing = not self.playing
            case "right" | "left":
                self.playing = False
                self.step(1 if name == "right" else -1)
            case "home" | "end":
                self.go(0 if name == "home" else last)
            case "escape":
                self.closed = True
        self._due = self._clock() + self._period

    def go(self, i: int) -> None:
        """Stop at a step, or the nearest that there is."""
        self.playing = False
        self.at = min(max(i, 0), len(self._playback) - 1)

    def step(self, by: int) -> None:
        """Go forward, or back, by a number of steps, as far as there are any."""
        last = len(self._playback) - 1
        self.at = min(max(self.at + by, 0), last)
        if self.playing and self.at == last:
            self.playing = False


class PlayWindow(Player):
    """Shows a playback in a window until it is closed."""

    def __init__(
        self,
        playback: Playback,
        scene: SceneView | None,
        screen: Screen,
        speed: float = 1.0,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """Begin to play.

        Args:
            playback: what is shown.
            scene: draws it from outside; without it the wrist view is shown large.
            screen: where it is drawn.
            speed: times real time.
            clock: returns the time [s].

        Raises:
            InvalidInput: the speed is not positive.
        """
        super().__init__(playback, speed, clock)
        self._scene, self._screen = scene, screen
        self._kept: OrderedDict[int, Image] = OrderedDict()

    def run(self) -> None:
        """Play until the window is closed."""
        drawn = None
        while not self.closed:
            for event in self._screen.events():
                if isinstance(event, Closed):
                    self.closed = True
                elif isinstance(event, Key) and event.down:
                    self.key(event.name)
            self.advance()
            if drawn != (self.at, self.playing):
                self.draw()
                drawn = (self.at, self.playing)
            else:
                time.sleep(0.005)

    def _scene_image(self) -> Image:
        i = self.at
        if self._scene is None:
            return self._playback.image(i)
        if i not in self._kept:
            self._kept[i] = self._scene.image(i, _WINDOW_SIZE)
            if len(self._kept) > _KEPT:
                self._kept.popitem(last=False)
        return self._kept[i]

    def draw(self) -> None:
        """Draw the window once."""
        screen, playback, i = self._screen, self._playback, self.at
        screen.clear()
        screen.image((16, 16, 720, 720), self._scene_image())
        screen.text((752, 14), playback.title, 22, BRIGHT, bold=True)
        demonstration = playback.demonstration
        screen.text(
            (752, 48),
            f"{demonstration.task}  ·  {demonstration.backend}  ·  by {demonstration.operator}",
            14,
            FAINT,
        )
        screen.box((752, 76, 512, 52), CARD, edge=BLUE if self.playing else LINE)
        screen.text((768, 89), "playing" if self.playing else "stopped", 22, BRIGHT, bold=True)
        screen.text((1250, 87), f"{i / playback.hz:.1f} s", 24, BRIGHT, align="right")
        screen.image((752, 140, 320, 320), playback.image(i))
        screen.box((758, 434, 20 + 8 * len(playback.camera), 20), BACKGROUND, radius=4)
        screen.text((764, 435), playback.camera, 13, FAINT)
        measured, commanded = playback.gripper(i)
        force = playback.force(i)
        self._fact(140, "Step", f"{i + 1} of {len(playback)}")
        self._fact(196, "From the", playback.part(i))
        self._fact(252, "Waypoint", str(playback.waypoint(i)) if i >= playback.split else "–")
        self._fact(308, "Gripper, commanded", f"{measured:.2f}, {commanded:.2f}")
        words = "not measured" if np.isnan(force) else f"{force:.0f} N"
        self._fact(364, "Contact force", words, ORANGE if force > 0 else TEXT)
        reached = playback.success(i)
        self._fact(420, "Goal", "reached" if reached else "–", GREEN if reached else TEXT)
        screen.box((752, 480, 512, 256), CARD)
        rows = (
            ("Space", "stop, play"), ("→ ←", "one step on, back"), ("Home End", "first, last step"),
            ("Esc", "close"),
        )  # fmt: skip
        for row, (keys, what) in enumerate(rows):
            screen.text((768, 496 + 30 * row), keys, 15, BRIGHT, bold=True)
            screen.text((880, 496 + 30 * row), what, 15, TEXT)
        screen.text((768, 704), self.pace, 13, FAINT)
        self._timeline()
        screen.show()

    def _fact(self, top: int, name: str, value: str, colour: str = TEXT) -> None:
        self._screen.text((1090, top), name, 13, FAINT)
        self._screen.text((1090, top + 18), value, 18, colour, bold=True)

    def _timeline(self) -> None:
        """Segment and demonstration side by side, as far as they are played."""
        last = max(1, len(self._playback) - 1)
        screen, left, width = self._screen, 16, 1248
        screen.bar((left, 762, width, 10), self.at / last, BLUE)
        if self._playback.split:
            x = left + round(width * self._playback.split / last)
            screen.box((x - 1, 754, 3, 26), ORANGE, radius=1)
        screen.dot((left + round(width * self.at / last), 767), 9, BRIGHT)
