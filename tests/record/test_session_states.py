"""The session's states: what leads from one to the next, and what each keeps."""

from __future__ import annotations

import numpy as np
import pytest

from sart_toolkit.errors import InvalidInput
from sart_toolkit.motion.config import ControllerConfig
from sart_toolkit.poses import distance
from sart_toolkit.record.session import (
    End,
    SessionConfig,
    SessionState,
    TeleopCommand,
    TeleopSession,
)

STILL = TeleopCommand(np.zeros(6), 0.67)
# The tool points down at the start: along its z is down.
DOWN = TeleopCommand([0, 0, 0.1, 0, 0, 0], 0.67)


def advanced(session, command, periods):
    for _ in range(periods):
        session.advance(command)
    return session


@pytest.fixture
def session(make_session):
    return make_session()


def test_a_new_session_is_ready_at_the_task_s_start(session, peg_task, peg_model):
    assert session.state is SessionState.READY and session.steps == 1 and session.seconds == 0
    start = peg_task.initial_state(peg_model, session.placement)
    np.testing.assert_allclose(session.observation.q, start.q, atol=1e-9)


def test_ready_recording_paused_recording_ended_saved(session):
    session.start()
    assert session.state is SessionState.RECORDING
    advanced(session, STILL, 4).pause()
    assert session.state is SessionState.PAUSED
    session.start()
    assert session.state is SessionState.RECORDING and session.seconds == pytest.approx(4 / 30)
    session.stop()
    assert session.state is SessionState.ENDED and session.end is End.STOPPED
    session.mark_saved()
    assert session.state is SessionState.SAVED


READY = ["start", "redo"]
RECORDING = ["pause", "stop", "redo", "advance"]
PAUSED = ["start", "stop", "redo"]
ENDED = ["redo", "mark_saved"]
ALL = ["start", "pause", "redo", "stop", "mark_saved", "advance"]


def brought_to(session, state):
    if state is not SessionState.READY:
        session.start()
        advanced(session, STILL, 3)
    if state is SessionState.PAUSED:
        session.pause()
    if state in (SessionState.ENDED, SessionState.SAVED):
        session.stop()
    if state is SessionState.SAVED:
        session.mark_saved()
    return session


@pytest.mark.parametrize(
    ("state", "allowed"),
    [
        (SessionState.READY, READY),
        (SessionState.RECORDING, RECORDING),
        (SessionState.PAUSED, PAUSED),
        (SessionState.ENDED, ENDED),
        (SessionState.SAVED, []),
    ],
)
def test_what_a_phase_does_not_allow_is_refused_and_changes_nothing(session, state, allowed):
    brought_to(session, state)
    for name in ALL:
        if name not in allowed:
            arguments = [STILL] if name == "advance" else []
            with pytest.raises(InvalidInput, match=f"{name}: the session is {state.value}; expec"):
                getattr(session, name)(*arguments)
    assert session.state is state


@pytest.mark.parametrize(
    "state", [SessionState.READY, SessionState.RECORDING, SessionState.PAUSED, SessionState.ENDED]
)
def test_redo_forgets_what_was_recorded_and_puts_everything_back(session, state):
    start = session.observation
    if state is not SessionState.READY:
        session.start()
        advanced(session, DOWN, 9)
        assert session.steps == 4
    if state is SessionState.PAUSED:
        session.pause()
    if state is SessionState.ENDED:
        session.stop()
    session.redo()
    assert session.state is SessionState.READY and session.steps == 1 and session.seconds == 0
    np.testing.assert_array_equal(session.observation.q, start.q)
    session.start()
    session.stop()
    assert len(session.demonstration("p", "d", 1.0).raw_commands) == 3


def test_while_paused_the_simulation_stands_still_and_nothing_is_recorded(session, peg_backend):
    session.start()
    advanced(session, DOWN, 6).pause()
    before = peg_backend.observe()
    steps = session.steps
    with pytest.raises(InvalidInput, match="advance: the session is paused"):
        session.advance(DOWN)
    after = peg_backend.observe()
    assert after.time == before.time and session.steps == steps
    np.testing.assert_array_equal(after.q, before.q)


def test_a_pause_leaves_no_trace_in_what_is_recorded(make_session):
    hashes = []
    for pauses in (False, True):
        session = make_session()
        session.start()
        for i in range(12):
            if pauses and i in (2, 7):
                session.pause()
                session.start()
            session.advance(DOWN)
        session.stop()
        hashes.append(session.demonstration("p", "d", 1.0).content_hash())
    assert hashes[0] == hashes[1]


def test_it_ends_by_itself_once_success_has_lasted(session, peg_task):
    session.start()
    held = []
    while session.state is SessionState.RECORDING:
        session.advance(STILL if session.success else DOWN)
        held.append(session.success_held)
    assert session.end is End.SUCCESS and session.achieved
    assert session.success_held == pytest.approx(peg_task.hold)
    demo = session.demonstration("p", "d", 1.0)
    assert demo.success[-10:].all() and not demo.success[-11]
    assert max(held) == held[-1]


def test_it_ends_when_time_is_up(make_session):
    session = make_session(seconds=1.0)
    session.start()
    advanced(session, STILL, 30)
    assert session.state is SessionState.ENDED and session.end is End.TIME
    assert len(session.demonstration("p", "d", 1.0)) == 11


def test_seconds_spent_run_from_the_first_start_to_the_end_with_redos_and_pauses(make_session):
    now = [100.0]
    session = make_session(clock=lambda: now[0])
    now[0] += 50.0
    assert session.seconds_spent == 0
    session.start()
    now[0] += 3.0
    session.advance(STILL)
    session.redo()
    now[0] += 2.0
    session.start()
    now[0] += 4.0
    session.advance(STILL)
    session.pause()
    now[0] += 5.0
    session.start()
    session.stop()
    now[0] += 1000.0
    assert session.seconds_spent == pytest.approx(14.0)


def test_a_limited_joint_is_named_and_the_tool_stays(session):
    session.start()
    # The last wrist joint turns with the tool about its own axis, until its limit.
    turn = TeleopCommand([0, 0, 0, 0, 0, 4.0], 0.67)
    while not session.trouble:
        session.advance(turn)
    assert session.trouble == "joint limit: wrist_3_joint"
    before = session.observation.T_world_tool
    advanced(session, turn, 3)
    assert distance(before, session.observation.T_world_tool)[0] < 1e-3
    session.advance(TeleopCommand([0, 0, 0, 0, 0, -1.0], 0.67))
    assert session.trouble == ""


def test_out_of_reach_is_reported_at_once_and_no_command_ever_jumps(
    peg_backend, peg_task, peg_model
):
    fastest = float(peg_model.spec.velocity_limits.min()) / 30
    config = SessionConfig((), 60, False, controller=ControllerConfig(max_joint_step=fastest))
    session = TeleopSession(peg_backend, peg_task, peg_model, config=config)
    session.start()
    R = peg_model.fk(session.observation.q)[:3, :3]
    away = TeleopCommand([*(R.T @ [0.3, 0.0, 0.0]), 0, 0, 0], 0.67)
    troubles = set()
    for _ in range(120):
        session.advance(away)
        troubles.add(session.trouble)
    assert troubles - {""} <= {"out of reach", "joints would jump"} and len(troubles) > 1
    # And back: steering the other way works at once.
    back = TeleopCommand(-np.array(away.velocity), 0.67)
    session.advance(back)
    assert session.trouble == ""
    session.stop()
    steps = session.demonstration("p", "d", 1.0).steps
    assert np.abs(np.diff(steps.commanded_joint_positions, axis=0)).max() <= 3 * fastest + 1e-9
    moved = np.diff(steps.commanded_Ts_world_tool[:, :3, 3], axis=0)
    assert np.linalg.norm(moved, axis=1).max() <= 0.3 / 10 + 1e-6


def test_contact_is_reported_with_its_pair_and_force_and_what_is_held_does_not_count(session):
    session.start()
    assert session.contacts == []
    # Beside the hole and down on its rim.
    aside = TeleopCommand([0.1, 0, 0, 0, 0, 0], 0.67)
    advanced(session, aside, 8)
    for _ in range(60):
        session.advance(DOWN)
        if session.contacts:
            break
    (contact,) = session.contacts[:1]
    assert {contact.a, contact.b} == {"block", "peg"} and contact.force > 0
    advanced(session, TeleopCommand([0, 0, -0.1, 0, 0, 0], 0.67), 15)
    assert session.contacts == []


def test_a_recording_must_have_ended_to_become_a_demonstration(session):
    session.start()
    with pytest.raises(InvalidInput, match="demonstration: the session is recording"):
        session.demonstration("p", "d", 1.0)
