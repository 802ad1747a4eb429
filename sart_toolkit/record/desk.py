"""A person's recording, without its window: what each control does, and the messages."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Literal

from sart_toolkit.data.records import Demonstration
from sart_toolkit.errors import DeviceLost, InvalidInput, SartError
from sart_toolkit.record.devices.manual import Control, ManualDevice
from sart_toolkit.record.session import End, SessionState, TeleopSession

# More than this [N] is a hard press, which a person should be warned of before all else.
FIRM = 50.0
# So much [s] may be discarded without confirmation.
_SOON_DONE_AGAIN = 3.0

Tone = Literal["plain", "good", "warning", "bad"]


@dataclass(frozen=True)
class Notice:
    """A sentence for the person, and how grave it is."""

    text: str
    tone: Tone = "plain"


class RecordingDesk:
    """Where a person's session, device and controls meet.

    Whoever shows it calls `tick` for each control period, `press` for each control, and reads
    `notice`. Discarding a recording, or saving one that missed the goal, has to be confirmed.

    Attributes:
        session: the recording.
        device: what the person steers with.
        demonstration: what was saved; none until then.
        done: whether there is nothing left to do.
    """

    def __init__(
        self,
        session: TeleopSession,
        device: ManualDevice,
        save: Callable[[Demonstration], None],
        watch: Callable[[Mapping[str, Any]], None] | None = None,
    ) -> None:
        """Ready to record.

        Args:
            session: the recording.
            device: what the person steers with, connected.
            save: writes a demonstration; if it raises a `SartError` saving can be attempted again.
            watch: called with JSON values after each recorded step and each change of state.
        """
        self.session, self.device = session, device
        self.demonstration: Demonstration | None = None
        self.done = False
        self._save, self._watch = save, watch
        # Why it stands still, or what the person is asked to confirm.
        self._said: Notice | None = None
        self._asked: Control | None = None
        self._tell()

    @property
    def notice(self) -> Notice:
        """What the person should know now."""
        session = self.session
        if self._said is not None:
            return self._said
        match session.state:
            case SessionState.READY:
                return Notice("This is the start. Press → to record.")
            case SessionState.PAUSED:
                return Notice("Paused. Press → to resume.")
            case SessionState.ENDED:
                return self._ended_notice()
            case SessionState.SAVED:
                return Notice("Saved.", "good")
        if session.trouble:
            return Notice(f"The tool stays here: {session.trouble}. Steer back.", "bad")
        touch = ""
        if session.contacts:
            firmest = session.contacts[0]
            touch = f"{firmest.a} / {firmest.b}, {firmest.force:.0f} N"
            if firmest.force > FIRM:
                return Notice(f"Pressing hard: {touch}. Ease off.", "bad")
        if session.success:
            left = max(0.0, session.task.hold - session.success_held)
            return Notice(f"Goal reached. Keep it for another {left:.1f} s", "good")
        if touch:
            return Notice(f"Contact: {touch}", "warning")
        return Notice("Recording. → ends it, ← starts again.")

    def _ended_notice(self) -> Notice:
        session = self.session
        if session.end is End.ROBOT_STOPPED:
            return Notice(f"{session.trouble}. → saves what was recorded until then.", "bad")
        if session.achieved:
            return Notice("Goal reached. Press → to save.", "good")
        if session.judged_by == "nobody":
            return Notice(
                "Was the goal reached? → saves it as reached, ← records again.", "warning"
            )
        why = session.failure_reason
        if session.success:
            why = "not kept for long enough"
        text = f"Goal not reached: {why}."
        if session.end is End.TIME:
            text = f"{session.config.max_seconds:g} s are over. {text}"
        return Notice(f"{text} ← records again; → twice saves it nevertheless.", "warning")

    def tick(self) -> None:
        """One control period: the device is read and, while recording, the robot moves.

        A device that no longer answers pauses the recording; nothing is lost.
        """
        session = self.session
        try:
            command = self.device.read(session.observation)
        except DeviceLost as error:
            # While nothing is recorded it may come back by itself, or at the next →.
            if session.state is SessionState.RECORDING:
                self._pause(f"Paused: {error}. Plug it in and press → to resume; nothing is lost.")
            return
        for control in self.device.controls():
            self.press(control)
        if session.state is not SessionState.RECORDING:
            return
        steps = session.steps
        session.advance(command)
        if session.state is SessionState.ENDED or session.steps > steps:
            self._tell()

    def press(self, control: Control) -> None:
        """Do what a control means now; what can't be undone only when pressed a second time."""
        again = self._asked is control
        self._asked, self._said = None, None
        match control:
            case Control.NEXT:
                self._next(again)
            case Control.REDO:
                if self.session.state is not SessionState.SAVED:
                    self.session.redo()
                    self.device.rest()
            case Control.DISCARD:
                self._discard(again)
        self._tell()

    def _next(self, again: bool) -> None:
        session = self.session
        match session.state:
            case SessionState.READY | SessionState.PAUSED:
                self._go_on()
            case SessionState.RECORDING:
                session.stop()
            case SessionState.ENDED if session.end is End.ROBOT_STOPPED:
                self._keep()
            case SessionState.ENDED if session.judged_by == "nobody":
                session.say_reached()
                self._keep()
            case SessionState.ENDED if session.achieved or again:
                self._keep()
            case SessionState.ENDED:
                self._ask(Control.NEXT, "The goal was not reached. → again saves it nevertheless.")
            case SessionState.SAVED:
                self.done = True

    def _go_on(self) -> None:
        try:
            # Reading shows whether it answers; what it asks for is not carried out.
            self.device.read(self.session.observation)
        except DeviceLost:
            try:
                self.device.connect()
            except DeviceLost as error:
                self._said = Notice(f"Can't steer: {error}. Then press →.", "bad")
                return
        self.device.halt()
        self.session.start()

    def _pause(self, why: str) -> None:
        self.session.pause()
        self._said = Notice(why, "bad")
        self._tell()

    def _discard(self, again: bool) -> None:
        session = self.session
        unsaved = session.state not in (SessionState.READY, SessionState.SAVED)
        if not unsaved or again or session.seconds < _SOON_DONE_AGAIN:
            self.done = True
            return
        if session.state is SessionState.RECORDING:
            session.pause()
        resumes = "→ saves it" if session.state is SessionState.ENDED else "→ resumes"
        self._ask(
            Control.DISCARD,
            f"Esc again discards {session.seconds:.0f} s of recording; {resumes}.",
        )

    def _ask(self, control: Control, question: str) -> None:
        self._asked, self._said = control, Notice(question, "warning")

    def _keep(self) -> None:
        session, device = self.session, self.device
        demonstration = session.demonstration(device.operator, device.name, session.seconds_spent)
        try:
            self._save(demonstration)
        except InvalidInput as error:
            self._said = Notice(f"Not saved: {error}. ← records again.", "bad")
            return
        except SartError as error:
            self._said = Notice(f"Not saved: {error}. → saves again; nothing is lost.", "bad")
            return
        self.demonstration = demonstration
        session.mark_saved()

    def _tell(self) -> None:
        if self._watch is None:
            return
        session, now = self.session, self.session.observation
        self._watch(
            {
                "state": session.state.value,
                "seconds": round(session.seconds, 3),
                "success": session.success,
                "T_world_tool": now.T_world_tool.tolist(),
                "gripper": session.gripper,
                "notice": self.notice.text,
            }
        )
