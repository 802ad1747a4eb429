"""The window of a person's recording: the scene, the wrist view, and how it stands."""

from __future__ import annotations

import time
from collections.abc import Callable

from sart_toolkit.backends.interface import SensesContacts
from sart_toolkit.data.records import Image
from sart_toolkit.errors import InvalidInput
from sart_toolkit.record.desk import FIRM, RecordingDesk, Tone
from sart_toolkit.record.devices.manual import SPEEDS, Control
from sart_toolkit.record.screen import (
    BACKGROUND,
    BLUE,
    BRIGHT,
    CARD,
    FAINT,
    GREEN,
    LINE,
    ORANGE,
    RED,
    TEXT,
    Closed,
    FocusLost,
    Key,
    Screen,
)
from sart_toolkit.record.session import SessionState

_CONTROLS = {"right": Control.NEXT, "left": Control.REDO, "escape": Control.DISCARD}
_PHASE_COLOURS = {
    SessionState.READY: BLUE,
    SessionState.RECORDING: RED,
    SessionState.PAUSED: ORANGE,
    SessionState.ENDED: ORANGE,
    SessionState.SAVED: GREEN,
}
_TONES: dict[Tone, str] = {"plain": LINE, "good": GREEN, "warning": ORANGE, "bad": RED}
# What the arrows and Esc do next, by state.
_MEANINGS = {
    SessionState.READY: ("start", "start again", "close"),
    SessionState.RECORDING: ("end", "start again", "discard"),
    SessionState.PAUSED: ("resume", "start again", "discard"),
    SessionState.ENDED: ("save", "record again", "discard"),
    SessionState.SAVED: ("close", "", ""),
}
_SCENE = (16, 16, 768, 768)
# Sizes [pixels] that the scene is drawn at while it moves, and the time [s] that one may take.
_SIZES = (256, 320, 384, 448, 512)
_SLOW, _QUICK = 0.040, 0.018
_SAVED_SHOWN = 2.0


class Pace:
    """Says when control periods are due, so that simulated and real time go by alike.

    A machine that falls behind catches up; what it can't make good within a quarter of a second it
    lets go, and `share` says by how much. No period is ever left out.

    Attributes:
        share: simulated over real time, over the last second.
    """

    _MOST_BEHIND = 0.25
    _WINDOW = 1.0

    def __init__(self, hz: int, clock: Callable[[], float] = time.monotonic) -> None:
        """The first of `hz` periods a second is due now."""
        self._hz, self._clock = hz, clock
        self._next = self._since = clock()
        self._done = 0
        self.share = 1.0

    def due(self) -> int:
        """How many control periods to carry out now."""
        now = self._clock()
        self._next = max(self._next, now - self._MOST_BEHIND)
        n = max(0, int((now - self._next) * self._hz) + (now >= self._next))
        self._next += n / self._hz
        self._done += n
        if now - self._since >= self._WINDOW:
            self.share = min(1.0, self._done / self._hz / (now - self._since))
            self._since, self._done = now, 0
        return n

    def left(self) -> float:
        """How long [s] until the next period is due."""
        return max(0.0, self._next - self._clock())


class RecordingWindow:
    """Shows a recording and passes on what is pressed, until the person is done."""

    def __init__(self, desk: RecordingDesk, screen: Screen, target: str) -> None:
        """Show what is at a desk.

        Args:
            desk: the recording.
            screen: where it is drawn.
            target: where it will be saved, for the person to read.

        Raises:
            InvalidInput: the recording has no camera.
        """
        if not desk.session.config.cameras:
            raise InvalidInput("window: the recording has no camera to show; record with one")
        self._desk, self._screen, self._target = desk, screen, target
        backend = desk.session.backend
        cameras = [c.name for c in backend.scene.cameras if c.name in backend.cameras]
        self._camera = cameras[0] if cameras else desk.session.config.cameras[0]
        self._scene: Image | None = None
        self._drawn: tuple[int, float] | None = None
        self._size = 2
        self._pace = Pace(desk.session.backend.rates.control_hz)

    def run(self) -> None:
        """Keep the recording going in real time until it is saved or discarded."""
        desk, again = self._desk, 0.0
        saved_at = None
        while not desk.done:
            for event in self._screen.events():
                self._take(event)
            for _ in range(self._pace.due()):
                desk.tick()
            if desk.session.state is SessionState.SAVED:
                saved_at = saved_at or time.monotonic()
                if time.monotonic() - saved_at > _SAVED_SHOWN:
                    desk.press(Control.NEXT)
            started = time.monotonic()
            if started >= again:
                self.draw()
                ended = time.monotonic()
                # A third of the time, at least, is left to the simulation.
                again = max(
                    ended + 0.5 * (ended - started),
                    started + 1 / desk.session.backend.rates.control_hz,
                )
            time.sleep(min(self._pace.left(), max(0.0, again - time.monotonic())))

    def _take(self, event: Key | Closed | FocusLost) -> None:
        match event:
            case Closed():
                self._desk.press(Control.DISCARD)
            case FocusLost():
                self._desk.device.let_go()
            case Key(name, down) if name in _CONTROLS:
                if down:
                    self._desk.press(_CONTROLS[name])
            case Key(name, down):
                self._desk.device.key(name, down)

    # --- drawing --------------------------------------------------------------------------------

    def draw(self) -> None:
        """Draw the window once."""
        self._screen.clear()
        self._screen.image(_SCENE, self._scene_image())
        self._head()
        self._wrist_and_settings()
        self._notice()
        self._force()
        self._keys()
        self._screen.show()

    def _scene_image(self) -> Image:
        """The scene as it is: small and often while it moves, sharp once it stands still."""
        session = self._desk.session
        state = (id(session.recorded), session.seconds)
        moving = session.state is SessionState.RECORDING
        if self._scene is not None and self._drawn == state and not moving:
            return self._scene
        size = _SIZES[self._size] if moving else _SCENE[2]
        started = time.monotonic()
        view = session.backend.observe((self._camera,), size)
        self._scene = view.cameras[self._camera].rgb
        seconds = time.monotonic() - started
        self._drawn = None if moving else state
        if moving:
            self._size += (seconds < _QUICK) - (seconds > _SLOW)
            self._size = min(max(self._size, 0), len(_SIZES) - 1)
        return self._scene

    def _head(self) -> None:
        screen, session = self._screen, self._desk.session
        screen.text((800, 14), session.task.name, 24, BRIGHT, bold=True)
        place = session.placement
        screen.text(
            (800, 48),
            f"{session.task.report_body} {place.x * 100:+.1f}, {place.y * 100:+.1f} cm"
            f" from the middle  ·  {_shortened(self._target)}",
            13, FAINT,
        )  # fmt: skip
        colour = _PHASE_COLOURS[session.state]
        screen.box((800, 76, 464, 52), CARD, edge=colour)
        screen.dot((824, 102), 9, colour)
        screen.text((844, 89), session.state.value, 22, BRIGHT, bold=True)
        screen.text((1250, 87), f"{session.seconds:.1f} s", 24, BRIGHT, align="right")

    def _wrist_and_settings(self) -> None:
        screen, desk = self._screen, self._desk
        session, device = desk.session, desk.device
        camera = session.config.cameras[0]
        screen.image((800, 140, 280, 280), session.recorded.cameras[camera].rgb)
        screen.box((806, 394, 20 + 8 * len(camera), 20), BACKGROUND, radius=4)
        screen.text((812, 395), camera, 13, FAINT)
        left = 1096
        if not device.guides:
            self._speed_and_directions(left)
        screen.text((left, 344), "Gripper (Space)", 14, FAINT)
        screen.bar((left, 370, 168, 10), session.observation.gripper, BLUE)
        # While nothing moves, what the hand has asked for in the meantime.
        commanded = "open" if device.gripper < 0.5 else "closed"
        screen.text((left, 388), f"commanded: {commanded}", 15)

    def _speed_and_directions(self, left: int) -> None:
        screen, device = self._screen, self._desk.device
        screen.text((left, 140), "Speed", 14, FAINT)
        for i, speed in enumerate(SPEEDS):
            chosen = speed is device.speed
            screen.box((left, 162 + 34 * i, 168, 30), BLUE if chosen else CARD, radius=6)
            colour = BACKGROUND if chosen else TEXT
            screen.text((left + 12, 168 + 34 * i), f"{i + 1}  {speed.name}", 15, colour)
            words = f"{speed.linear * 100:g} cm/s"
            screen.text((left + 158, 169 + 34 * i), words, 13, colour, align="right")
        screen.text((left, 276), "Directions (F)", 14, FAINT)
        for i, frame in enumerate(("world", "tool")):
            chosen = frame == device.frame
            screen.box((left + 86 * i, 298, 82, 30), BLUE if chosen else CARD, radius=6)
            colour = BACKGROUND if chosen else TEXT
            screen.text((left + 41 + 86 * i, 304), frame, 15, colour, align="middle")

    def _notice(self) -> None:
        notice = self._desk.notice
        self._screen.box((800, 432, 464, 88), CARD, edge=_TONES[notice.tone])
        self._screen.box((800, 432, 8, 88), _TONES[notice.tone], radius=4)
        self._screen.paragraph((822, 442, 430, 72), notice.text, 17)

    def _force(self) -> None:
        screen, session = self._screen, self._desk.session
        if not isinstance(session.backend, SensesContacts):
            screen.text((800, 532), "this robot can't feel contact", 14, FAINT)
            return
        if not session.contacts:
            screen.text((800, 532), "no contact", 14, FAINT)
            return
        firmest = session.contacts[0]
        screen.text((800, 532), f"contact  {firmest.a} / {firmest.b}", 14, ORANGE)
        screen.text((1264, 532), f"{firmest.force:.0f} N", 14, ORANGE, bold=True, align="right")
        screen.bar(
            (800, 556, 464, 8), firmest.force / FIRM, RED if firmest.force > FIRM else ORANGE
        )

    def _keys(self) -> None:
        screen, desk = self._screen, self._desk
        screen.box((800, 576, 464, 208), CARD)
        view = "scene" if desk.device.frame == "world" else "wrist"
        directions = "" if desk.device.guides else f", directions as in the {view} view"
        screen.text((814, 584), f"{desk.device.name}{directions}", 13, FAINT)
        for i, (keys, what) in enumerate(desk.device.key_map):
            self._row((814, 608 + 24 * i), keys, what, 96)
        meanings = _MEANINGS[desk.session.state]
        for i, (keys, what) in enumerate(zip(["→", "←", "Esc"], meanings, strict=True)):
            if what:
                self._row((1096, 608 + 24 * i), keys, what, 58)
        if not desk.device.guides:
            for i, (keys, what) in enumerate((("1 2 3", "speed"), ("F", "directions"))):
                self._row((1096, 680 + 24 * i), keys, what, 58)
        self._row((1096, 728), "Space", "gripper", 58)
        share = self._pace.share
        words = "in real time" if share > 0.97 else f"at {share:.0%} of real time"
        screen.text((1254, 760), words, 13, FAINT if share > 0.97 else ORANGE, align="right")

    def _row(self, at: tuple[int, int], keys: str, what: str, indent: int) -> None:
        self._screen.text(at, keys, 14, BRIGHT, bold=True)
        self._screen.text((at[0] + indent, at[1]), what, 14, TEXT)


def _shortened(path: str, most: int = 34) -> str:
    return path if len(path) <= most else "…" + path[-most:]
