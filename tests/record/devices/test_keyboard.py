"""Each key of the map moves the tool the way it says; the rest is the same for all devices."""

from __future__ import annotations

import numpy as np
import pytest

from sart_toolkit.poses import relative_motion
from sart_toolkit.record.desk import RecordingDesk
from sart_toolkit.record.devices.keyboard import KEYS, Keyboard
from sart_toolkit.record.devices.manual import Control, views
from sart_toolkit.record.session import SessionState


@pytest.fixture
def keyboard(peg_setup):
    device = Keyboard(peg_setup)
    device.connect()
    return device


def test_the_key_map_shows_exactly_the_keys_there_are(keyboard):
    assert {key.lower() for keys, _ in keyboard.key_map for key in keys.split()} == set(KEYS)


@pytest.mark.parametrize("frame", ["world", "tool"])
@pytest.mark.parametrize("name", KEYS)
def test_each_key_moves_the_robot_s_tool_along_its_own_direction(
    keyboard, make_session, peg_model, peg_task, name, frame
):
    session = make_session()
    desk = RecordingDesk(session, keyboard, lambda _: None)
    keyboard.frame = frame
    desk.press(Control.NEXT)
    before = session.observation.T_world_tool
    keyboard.key(name, True)
    for _ in range(15):
        desk.tick()
    keyboard.key(name, False)
    for _ in range(30):
        desk.tick()
    motion = relative_motion(before, session.observation.T_world_tool)
    seen = views(peg_model, peg_task.scene)
    R = seen.R_tool_hand if frame == "tool" else before[:3, :3].T @ seen.R_world_hand
    axis, way = KEYS[name]
    expected = np.zeros((2, 3))
    expected[axis // 3] = way * R[:, axis % 3]
    moved = np.array([motion[:3] / 0.03, motion[3:] / np.deg2rad(12.5)])
    # Half a second at normal speed.
    np.testing.assert_allclose(moved, expected, atol=0.1)


def test_opposite_keys_cancel_and_keys_add_up(keyboard):
    for name in "wsd":
        keyboard.key(name, True)
    np.testing.assert_array_equal(keyboard.poll(), [1, 0, 0, 0, 0, 0])
    keyboard.key("s", False)
    np.testing.assert_array_equal(keyboard.poll(), [1, 1, 0, 0, 0, 0])


def test_keys_are_let_go_when_the_window_no_longer_hears_them(keyboard):
    keyboard.key("w", True)
    keyboard.let_go()
    assert not keyboard.poll().any()
    keyboard.key("w", False)


def test_a_peg_is_put_into_its_hole_by_keys(keyboard, make_session, tick_until, ended):
    saved = []
    session = make_session()
    desk = RecordingDesk(session, keyboard, saved.append)
    desk.press(Control.NEXT)
    keyboard.key("q", True)
    tick_until(desk, lambda: session.observation.T_world_tool[2, 3] < 0.12)
    keyboard.key("1", True)
    tick_until(desk, lambda: session.success)
    keyboard.key("q", False)
    tick_until(desk, ended(desk))
    desk.press(Control.NEXT)
    (demonstration,) = saved
    assert session.state is SessionState.SAVED and demonstration.success[-10:].all()
    assert demonstration.device == "keyboard" and demonstration.operator == "tester"
    assert len(demonstration.raw_commands) == 3 * (len(demonstration) - 1)
