"""What `UrRtdeArm` makes of what ur-rtde tells, and what it does in which order."""

from __future__ import annotations

import sys

import numpy as np
import pytest

from sart_toolkit.errors import InvalidInput, MissingExtra
from sart_toolkit.hardware.ur import UrRtdeArm


@pytest.fixture
def arm(world):
    arm = UrRtdeArm(world.host, world.emulation.rate_hz, clock=world.now)
    arm.connect()
    yield arm
    arm.stop()
    arm.disconnect()


def names(world):
    return [call.name for call in world.calls]


def test_a_missing_library_is_named_with_what_installs_it(monkeypatch):
    monkeypatch.setitem(sys.modules, "rtde_receive", None)
    with pytest.raises(MissingExtra, match=r"needs ur-rtde .*pip install sart_toolkit\[ur\]"):
        UrRtdeArm("robot", 500).connect()


def test_it_is_read_without_being_taken_over(arm, world):
    state = arm.read()
    np.testing.assert_allclose(state.q, world.q, atol=1e-4)
    assert state.trouble == "" and state.force is not None and state.force < 3
    assert not {"RTDEControlInterface", "servoJ", "servoStop"} & set(names(world))


def test_its_times_are_told_in_our_clock(arm, world):
    world.advance(1.0)
    assert 0 <= world.now() - arm.read().time < 0.05


@pytest.mark.parametrize(
    ("robot_mode", "safety_mode", "says"),
    [
        (7, 2, None),
        (7, 3, "protective stop; see what it touched"),
        (7, 4, "recovery mode; move its joints"),
        (7, 5, "safeguard stop; make sure"),
        (7, 6, "emergency stop; make sure"),
        (7, 7, "emergency stop; make sure"),
        (7, 8, "safety violation; restart"),
        (7, 9, "safety fault; restart"),
        (7, 12, "unknown safety mode 12"),
        (5, 1, "idle; switch it on"),
        (3, 1, "power off; switch it on"),
        (99, 1, "robot mode 99; switch it on"),
    ],
)
def test_only_a_running_arm_in_normal_or_reduced_mode_is_without_trouble(
    arm, world, robot_mode, safety_mode, says
):
    world.robot_mode, world.safety_mode = robot_mode, safety_mode
    trouble = arm.read().trouble
    assert trouble == "" if says is None else says in trouble


def test_it_is_watched_before_it_is_moved_and_kicked_with_each_target(arm, world):
    arm.start()
    arm.servo(world.q, 1 / 125)
    arm.wait()
    called = names(world)
    assert called.index("setWatchdog") < called.index("servoJ") < called.index("kickWatchdog")
    assert "zeroFtSensor" in called and "setPayload" not in called


def test_a_payload_is_set_where_the_cell_gives_one(world):
    arm = UrRtdeArm(world.host, 125, payload=1.2, clock=world.now)
    arm.start()
    assert "setPayload" in names(world)
    arm.stop()


def test_a_stop_does_each_of_its_calls_even_if_all_fail(arm, world):
    arm.start()
    for name in ("servoStop", "stopScript", "control.disconnect"):
        world.inject(f"raise:{name}", world.time)
    world.advance(0.01)
    arm.stop()
    assert names(world)[-3:] == ["servoStop", "stopScript", "control.disconnect"]
    world.calls.clear()
    arm.stop()
    assert names(world) == []


def test_the_controller_s_watchdog_stops_an_arm_that_gets_no_targets(arm, world):
    arm.start()
    for _ in range(30):
        arm.servo(world.q + 0.02, 1 / 125)
        arm.wait()
    before = world.q.copy()
    world.advance(0.5)
    assert np.abs(world.q - before).max() < 0.1
    after = world.q.copy()
    world.advance(0.5)
    np.testing.assert_array_equal(world.q, after)


def test_a_hand_guides_it_in_freedrive_once_nothing_else_moves_it(arm, world):
    arm.start()
    arm.servo(world.q, 1 / 125)
    arm.wait()
    world.calls.clear()
    for _ in range(30):
        arm.guide()
        arm.wait()
    called = names(world)
    assert called.index("servoStop") < called.index("teachMode") and called.count("teachMode") == 1
    assert called.count("kickWatchdog") > 30 and world.free
    arm.hold()
    arm.hold()
    assert names(world).count("endTeachMode") == 1 and not world.free
    arm.servo(world.q, 1 / 125)
    # Again, and ended by a stop.
    arm.guide()
    arm.stop()
    assert not world.free


def test_one_that_refuses_freedrive_says_so_and_leaves_it_all_the_same(arm, world):
    arm.start()
    world.safety_mode = 3
    with pytest.raises(ConnectionError, match="refuses freedrive; see the pendant"):
        arm.guide()
    arm.stop()
    assert "endTeachMode" in names(world)


def test_the_controller_s_watchdog_ends_freedrive(arm, world):
    arm.start()
    arm.guide()
    world.advance(0.5)
    assert not world.free


@pytest.mark.parametrize("name", ["lookahead", "watchdog_hz", "deceleration", "payload"])
def test_options_out_of_range_are_refused(name):
    with pytest.raises(InvalidInput, match=f"{name}: expected"):
        UrRtdeArm("robot", 500, **{name: -1.0})
