"""What a person's controls do, what they must confirm, and what they are told."""

from __future__ import annotations

import numpy as np
import pytest

from sart_toolkit.errors import CannotWrite, DeviceLost
from sart_toolkit.record.checks import check_recording
from sart_toolkit.record.desk import RecordingDesk
from sart_toolkit.record.devices.keyboard import Keyboard
from sart_toolkit.record.devices.manual import Control
from sart_toolkit.record.session import SessionState

NEXT, REDO, DISCARD = Control.NEXT, Control.REDO, Control.DISCARD


@pytest.fixture
def keyboard(peg_setup):
    device = Keyboard(peg_setup)
    device.connect()
    return device


@pytest.fixture
def saved():
    return []


@pytest.fixture
def desk(make_session, keyboard, saved):
    return RecordingDesk(make_session(), keyboard, saved.append)


def recorded(desk, seconds):
    desk.press(NEXT)
    for _ in range(round(30 * seconds)):
        desk.tick()
    return desk


def reached_goal(desk, keyboard, tick_until, ended):
    desk.press(NEXT)
    keyboard.key("q", True)
    tick_until(desk, lambda: desk.session.success)
    keyboard.key("q", False)
    tick_until(desk, ended(desk))
    return desk


def test_before_the_start_it_says_how_to_start_and_nothing_moves(desk, peg_backend):
    assert "Press → to record" in desk.notice.text
    before = peg_backend.observe().time
    desk.device.key("q", True)
    for _ in range(5):
        desk.tick()
    assert desk.session.state is SessionState.READY and peg_backend.observe().time == before


def test_a_reached_goal_is_saved_at_one_press_and_closed_at_the_next(
    desk, keyboard, saved, tick_until, ended
):
    reached_goal(desk, keyboard, tick_until, ended)
    assert desk.notice.text == "Goal reached. Press → to save." and desk.notice.tone == "good"
    assert not saved and not desk.done
    desk.press(NEXT)
    assert desk.session.state is SessionState.SAVED and saved == [desk.demonstration]
    desk.press(REDO)
    desk.press(DISCARD)
    assert saved == [desk.demonstration] and desk.done


def test_short_of_the_goal_it_says_why_and_saves_only_when_asked_twice(desk, saved):
    recorded(desk, 1.0)
    desk.press(NEXT)
    assert desk.session.state is SessionState.ENDED
    assert "Goal not reached: peg over the hole, tip" in desk.notice.text
    desk.press(NEXT)
    assert not saved and "→ again saves it nevertheless" in desk.notice.text
    desk.press(NEXT)
    assert len(saved) == 1 and not saved[0].success.any()


def test_a_question_is_forgotten_when_something_else_is_pressed(desk, saved):
    recorded(desk, 1.0)
    desk.press(NEXT)
    desk.press(NEXT)
    desk.press(REDO)
    assert desk.session.state is SessionState.READY
    desk.press(NEXT)
    desk.press(NEXT)
    desk.press(NEXT)
    assert not saved and "again" in desk.notice.text


def test_time_up_is_reported(make_session, keyboard):
    desk = recorded(RecordingDesk(make_session(seconds=1.0), keyboard, lambda _: None), 2.0)
    assert desk.session.state is SessionState.ENDED and desk.notice.text.startswith(
        "1 s are over. Goal"
    )


def test_redo_puts_robot_and_gripper_back(desk, keyboard):
    recorded(desk, 0.5)
    keyboard.key("space", True)
    desk.press(REDO)
    assert desk.session.state is SessionState.READY and keyboard.gripper == pytest.approx(0.67)


def test_little_is_thrown_away_at_once_and_much_only_when_asked_twice(desk, saved):
    recorded(desk, 1.0)
    desk.press(DISCARD)
    assert desk.done and not saved


@pytest.mark.parametrize("end_first", [False, True])
def test_much_is_thrown_away_only_when_asked_twice(desk, saved, end_first):
    recorded(desk, 4.0)
    if end_first:
        desk.press(NEXT)
    desk.press(DISCARD)
    assert not desk.done and "Esc again discards 4 s of recording" in desk.notice.text
    assert desk.session.state is (SessionState.ENDED if end_first else SessionState.PAUSED)
    for _ in range(5):
        desk.tick()
    desk.press(DISCARD)
    assert desk.done and not saved and desk.demonstration is None


def test_after_a_discard_that_was_not_meant_it_resumes(desk):
    recorded(desk, 4.0)
    desk.press(DISCARD)
    desk.press(NEXT)
    assert desk.session.state is SessionState.RECORDING
    desk.press(DISCARD)
    assert not desk.done, "asked again"


def test_a_save_that_fails_loses_nothing_and_can_be_repeated(
    make_session, keyboard, tick_until, ended
):
    full, saved = [True], []

    def save(demonstration):
        if full[0]:
            raise CannotWrite("demo.h5: No space left on device; nothing was replaced")
        saved.append(demonstration)

    desk = RecordingDesk(make_session(), keyboard, save)
    reached_goal(desk, keyboard, tick_until, ended)
    desk.press(NEXT)
    assert desk.session.state is SessionState.ENDED and desk.demonstration is None
    assert "No space left" in desk.notice.text and "→ saves again" in desk.notice.text
    full[0] = False
    desk.press(NEXT)
    assert saved == [desk.demonstration]


def test_a_recording_that_cannot_be_learned_from_is_to_be_recorded_again(
    make_session, keyboard, saved
):
    def save(demonstration):
        check_recording(demonstration)
        saved.append(demonstration)

    desk = RecordingDesk(make_session(), keyboard, save)
    recorded(desk, 2.0)
    for _ in range(3):
        desk.press(NEXT)
    assert not saved and desk.session.state is SessionState.ENDED
    assert desk.notice.text.startswith("Not saved: demonstration: nothing moves: for 22 steps")
    assert "← records again" in desk.notice.text and "→ saves" not in desk.notice.text


def test_seconds_spent_are_kept_with_the_demonstration(
    make_session, keyboard, saved, tick_until, ended
):
    now = [0.0]
    desk = RecordingDesk(make_session(clock=lambda: now[0]), keyboard, saved.append)
    recorded(desk, 0.5)
    now[0] += 7.0
    desk.press(REDO)
    now[0] += 2.0
    reached_goal(desk, keyboard, tick_until, ended)
    now[0] += 60.0
    desk.press(NEXT)
    assert saved[0].seconds == pytest.approx(9.0)


def test_trouble_and_contact_are_reported_at_once(desk, keyboard, tick_until):
    desk.press(NEXT)
    keyboard.key("3", True)
    keyboard.key("q", True)
    keyboard.key("d", True)
    tick_until(desk, lambda: "block / peg" in desk.notice.text or "peg / table" in desk.notice.text)
    assert desk.notice.tone in ("warning", "bad")
    tick_until(desk, lambda: "Pressing hard" in desk.notice.text)
    assert desk.notice.tone == "bad"
    keyboard.key("q", False)
    keyboard.key("e", True)
    tick_until(desk, lambda: not desk.session.contacts)
    keyboard.key("d", False)
    tick_until(desk, lambda: bool(desk.session.trouble), seconds=30)
    assert "The tool stays here: " in desk.notice.text


def test_success_tells_how_long_to_keep_it(desk, keyboard, tick_until):
    desk.press(NEXT)
    keyboard.key("q", True)
    tick_until(desk, lambda: desk.session.success)
    assert desk.notice.text.startswith("Goal reached. Keep it for another 0.9 s")


def test_a_device_lost_before_the_start_is_asked_for_at_the_start(desk, keyboard, monkeypatch):
    def lost(*_):
        raise DeviceLost("no mouse found; plug it in")

    monkeypatch.setattr(keyboard, "poll", lost)
    monkeypatch.setattr(keyboard, "connect", lost)
    desk.tick()
    assert desk.session.state is SessionState.READY
    desk.press(NEXT)
    assert (
        desk.session.state is SessionState.READY
        and "no mouse found; plug it in" in desk.notice.text
    )
    monkeypatch.setattr(keyboard, "connect", lambda: None)
    desk.press(NEXT)
    assert desk.session.state is SessionState.RECORDING


def test_who_watches_is_reported_of_each_step_and_each_phase(make_session, keyboard):
    status = []
    desk = RecordingDesk(make_session(), keyboard, lambda _: None, status.append)
    recorded(desk, 1.0)
    desk.press(NEXT)
    states = [row["state"] for row in status]
    assert states[:2] == ["ready", "recording"] and states[-1] == "ended"
    assert states.count("recording") == 11
    assert np.array(status[-1]["T_world_tool"]).shape == (4, 4)
    seconds = [row["seconds"] for row in status]
    assert seconds == sorted(seconds) and status[-1]["success"] is False
