"""What `XArm` does over a fake of xarm-python-sdk that refuses what the real one refuses."""

from __future__ import annotations

import sys
from types import ModuleType

import numpy as np
import pytest

from sart_toolkit.backends.hardware import cell_backend
from sart_toolkit.backends.interface import Guides, SensesForce
from sart_toolkit.errors import InvalidInput, MissingExtra, RobotStopped
from sart_toolkit.hardware.cell import Cell, Control, Part
from sart_toolkit.hardware.servo import Servo
from sart_toolkit.hardware.xarm import XArm
from sart_toolkit.robots import get_robot
from sart_toolkit.robots.model import RobotModel

from .conftest import limits

MODEL = RobotModel(get_robot("xarm6"))
HOME = MODEL.spec.home
RATE = 100


class Fake:
    """`XArmAPI` of an xArm 6: joints are at once where they are sent, in servo mode alone."""

    made: Fake
    axis = 6

    def __init__(self, port, is_radian=False, do_not_open=False):
        assert is_radian and do_not_open
        Fake.made = self
        self.port, self.calls, self.raising, self.refusing = port, [], None, None
        self.connected = self.enabled = False
        self.q, self.mode, self.state, self.error, self.other = list(HOME), 0, 4, 0, False

    def _called(self, name, *values):
        self.calls.append((name, *values))
        if name == self.raising:
            raise OSError(f"{name}: emulated failure")
        return -1 if not self.connected else (3 if name == self.refusing else 0)

    def connect(self):
        if self._called("connect") and self.port != "arm":
            raise Exception("connect socket failed")
        self.connected = True

    def disconnect(self):
        self._called("disconnect")
        self.connected = False

    def set_tcp_load(self, weight, center_of_gravity):
        return self._called("set_tcp_load", weight, center_of_gravity)

    def motion_enable(self, enable=True):
        code = self._called("motion_enable", enable)
        self.enabled = enable
        return code

    def set_mode(self, mode=0):
        code = self._called("set_mode", mode)
        # Errors that aren't cleared keep it from nothing but moving.
        if not code and not self.other:
            self.mode, self.state = mode, 5
        return code

    def set_state(self, state=0):
        code = self._called("set_state", state)
        if not code:
            self.state = 2 if state == 0 and self.enabled and not self.error else 4
        return code

    def get_joint_states(self, is_radian=None):
        assert is_radian
        code = self._called("get_joint_states")
        return code, [[*self.q, 0.0], [0.0] * 7, [0.0] * 7]

    def get_err_warn_code(self):
        return self._called("get_err_warn_code"), [self.error, 0]

    def get_state(self):
        return self._called("get_state"), self.state

    def set_servo_angle_j(self, angles, is_radian=None):
        assert is_radian
        code = self._called("set_servo_angle_j", angles)
        if code:
            return code
        if self.error:
            return 1
        if self.state in (4, 5):
            return 9
        if self.mode == 1:
            self.q = list(angles)
        return 0


@pytest.fixture
def sdk(monkeypatch):
    package, module = ModuleType("xarm"), ModuleType("xarm.wrapper")
    module.XArmAPI = Fake
    monkeypatch.setitem(sys.modules, "xarm", package)
    monkeypatch.setitem(sys.modules, "xarm.wrapper", module)
    return Fake


@pytest.fixture
def arm(sdk):
    arm = XArm("arm", RATE)
    arm.connect()
    yield arm
    arm.disconnect()


@pytest.fixture
def servo(sdk):
    """Moves it, as a cell does; connected."""
    import time

    cell = Cell("xarm6", Part("arm", "xarm", {"host": "arm"}), limits(MODEL, 1.5),
                control=Control(RATE, silence=1.0))  # fmt: skip
    arm = cell.make_arm()
    arm.connect()
    servo = Servo(arm, MODEL, cell, time.monotonic)
    yield servo
    servo.close()


def names(after=0):
    return [call[0] for call in Fake.made.calls[after:]]


def test_a_missing_library_is_named_with_what_installs_it(monkeypatch):
    monkeypatch.setitem(sys.modules, "xarm.wrapper", None)
    with pytest.raises(MissingExtra, match=r"xarm-python-sdk .*pip install sart_toolkit\[xarm\]"):
        XArm("arm", RATE).connect()


def test_it_is_read_without_being_taken_over(arm):
    state = arm.read()
    np.testing.assert_allclose(state.q, HOME)
    assert state.trouble == "" and state.force is None and len(state.dq) == 6
    arm.stop()
    assert not {"motion_enable", "set_mode", "set_state"} & set(names())


def test_it_follows_targets_in_servo_mode_and_is_stopped_in_position_mode(servo):
    servo.start()
    servo.push(HOME[None] + 0.01, 0.1)
    for _ in range(40):
        servo.tick()
    np.testing.assert_allclose(Fake.made.q, HOME + 0.01, atol=1e-9)
    servo.close()
    assert Fake.made.calls[-3:] == [("set_state", 4), ("set_mode", 0), ("disconnect",)]


def test_a_payload_is_told_in_kilograms_and_millimetres_as_it_expects(sdk):
    arm = XArm("arm", RATE, payload=0.8, centre_of_gravity=(0.0, 0.0, 0.05))
    arm.connect()
    arm.start()
    assert ("set_tcp_load", 0.8, [0.0, 0.0, 50.0]) in Fake.made.calls
    with pytest.raises(InvalidInput, match="payload: expected"):
        XArm("arm", RATE, payload=-1.0)


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"error": 1}, "emergency stop; make sure"),
        ({"error": 31}, "collision; see what it touched"),
        ({"error": 99}, "error 99; see UFACTORY Studio"),
        ({"state": 3}, "state 3 in mode 1, so that it doesn't follow"),
        ({"mode": 0}, "state 2 in mode 0, so that it doesn't follow"),
    ],
)
def test_what_keeps_it_from_following_stops_it(servo, change, says):
    servo.start()
    servo.tick()
    vars(Fake.made).update(change)
    before = len(Fake.made.calls)
    with pytest.raises(RobotStopped, match=says):
        servo.tick()
    assert "set_servo_angle_j" not in names(before) and names(before)[-2:] == [
        "set_state", "set_mode",
    ]  # fmt: skip


def test_an_error_that_is_there_keeps_it_from_being_taken_over(servo):
    Fake.made.error = 2
    with pytest.raises(RobotStopped, match="emergency input of its control box"):
        servo.start()


def test_one_that_something_else_controls_is_not_moved(servo, monkeypatch):
    monkeypatch.setattr("sart_toolkit.hardware.xarm._MODE_TIME", 0.05)
    Fake.made.other = True
    with pytest.raises(RobotStopped, match="stays in mode 0, expected 1; close what else"):
        servo.start()
    assert names()[-2:] == ["set_state", "set_mode"]


def test_a_hand_guides_it_in_teaching_mode(servo):
    servo.start()
    servo.guide()
    servo.tick()
    assert Fake.made.mode == 2
    Fake.made.q = list(HOME + 0.3)
    servo.tick()
    np.testing.assert_allclose(servo.hold().q, HOME + 0.3)
    assert Fake.made.mode == 1
    servo.tick()
    np.testing.assert_allclose(Fake.made.q, HOME + 0.3)


CALLS = (
    "motion_enable", "set_mode", "set_state", "get_joint_states", "get_err_warn_code", "get_state",
    "set_servo_angle_j",
)  # fmt: skip


@pytest.mark.parametrize("how", ["raising", "refusing"])
@pytest.mark.parametrize("moment", ["from the start", "while it moves", "while it is guided"])
@pytest.mark.parametrize("call", [*CALLS, "disconnect"])
def test_whichever_call_fails_it_is_stopped_and_disconnected(servo, call, moment, how):
    if moment == "from the start":
        setattr(Fake.made, how, call)
    try:
        servo.start()
        if moment == "while it is guided":
            servo.guide()
        for _ in range(3):
            servo.tick()
        setattr(Fake.made, how, call)
        for _ in range(3):
            servo.tick()
        if moment == "while it is guided":
            servo.hold()
            servo.tick()
        assert call in ("disconnect", "motion_enable") or (
            moment == "while it moves" and call in ("set_mode", "set_state")
        )
    except RobotStopped as error:
        assert call in str(error) and call != "disconnect"
    servo.close()
    assert ("set_state", 4) in Fake.made.calls or call == "motion_enable"
    assert "disconnect" in names()


def test_no_connection_is_said(sdk):
    with pytest.raises(Exception, match="connect socket failed"):
        XArm("other", RATE).connect()
    arm = XArm("arm", RATE)
    arm.connect()
    Fake.made.connected = False
    with pytest.raises(ConnectionError, match="the connection is lost; check the cable"):
        arm.read()


def test_its_cell_has_no_force_and_can_be_guided():
    made = cell_backend(Cell("xarm6", Part("arm", "xarm", {"host": "arm"}), limits(MODEL)))
    assert issubclass(made, Guides) and not issubclass(made, SensesForce)
