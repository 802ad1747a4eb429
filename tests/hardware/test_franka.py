"""What `Franka` does over a fake of panda-py that refuses what the real one refuses."""

from __future__ import annotations

import sys
import time
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest

from sart_toolkit.backends.hardware import cell_backend
from sart_toolkit.backends.interface import Guides, SensesForce
from sart_toolkit.errors import InvalidInput, MissingExtra, RobotStopped
from sart_toolkit.hardware.cell import Cell, Control, Part
from sart_toolkit.hardware.franka import Franka
from sart_toolkit.hardware.servo import Servo
from sart_toolkit.robots import get_robot
from sart_toolkit.robots.model import RobotModel

from .conftest import limits

MODEL = RobotModel(get_robot("panda"))
HOME = MODEL.spec.home
RATE = 100


class Panda:
    """`panda_py.Panda`: joints are at once where its controller is told to lead them."""

    made: Panda

    def __init__(self, hostname):
        if hostname != "arm":
            raise RuntimeError("libfranka: Connection timeout")
        Panda.made = self
        self.calls, self.raising, self.error = [], None, ""
        self.q, self.force, self.mode = np.array(HOME), 1.0, 1
        self.controller, self.teaching, self.began = None, False, time.monotonic()

    def called(self, name):
        self.calls.append(name)
        if name == self.raising:
            raise RuntimeError(f"{name}: emulated failure")

    def start_controller(self, controller):
        self.called("start_controller")
        # Only one at a time may run, and none where the arm isn't at rest and ready.
        if self.mode != 1:
            raise RuntimeError("libfranka: Move command rejected: command not possible")
        self.controller, self.mode = controller, 2

    def stop_controller(self):
        self.called("stop_controller")
        self.controller, self.mode, self.teaching = None, 1 if self.mode == 2 else self.mode, False

    def teaching_mode(self, active):
        self.called(f"teaching_mode({active})")
        if active and self.mode != 1:
            raise RuntimeError("libfranka: Move command rejected: command not possible")
        self.teaching, self.mode = active, 2 if active else 1

    def raise_error(self):
        self.called("raise_error")
        if self.error:
            raise RuntimeError(self.error)

    def refresh_state(self):
        self.called("refresh_state")

    def get_state(self):
        self.called("get_state")
        now = time.monotonic() - self.began
        return SimpleNamespace(
            q=self.q.tolist(), dq=[0.0] * 7, time=SimpleNamespace(to_sec=lambda: now),
            robot_mode=self.mode, O_F_ext_hat_K=[0.0, 0.0, self.force, 9.0, 9.0, 9.0],
        )  # fmt: skip


class JointPosition:
    def __init__(self, **gains):
        self.gains = gains

    def set_control(self, position, velocity):
        Panda.made.called("set_control")
        assert np.shape(position) == np.shape(velocity) == (7,)
        # One that isn't started, or not any more, leads nothing.
        if Panda.made.controller is self:
            Panda.made.q, Panda.made.dq_d = np.array(position), np.array(velocity)


@pytest.fixture
def library(monkeypatch):
    package, controllers = ModuleType("panda_py"), ModuleType("panda_py.controllers")
    package.Panda, controllers.JointPosition = Panda, JointPosition
    monkeypatch.setitem(sys.modules, "panda_py", package)
    monkeypatch.setitem(sys.modules, "panda_py.controllers", controllers)


def made_servo(**options):
    cell = Cell("panda", Part("arm", "franka", {"host": "arm", **options}), limits(MODEL, 1.5),
                control=Control(RATE, silence=1.0))  # fmt: skip
    arm = cell.make_arm()
    arm.connect()
    return Servo(arm, MODEL, cell, time.monotonic)


@pytest.fixture
def servo(library):
    servo = made_servo()
    yield servo
    servo.close()


@pytest.mark.parametrize("name", ["panda_py", "panda_py.controllers"])
def test_a_missing_library_is_named_with_what_installs_it(library, monkeypatch, name):
    monkeypatch.setitem(sys.modules, name, None)
    with pytest.raises(MissingExtra, match=r"panda-py .*pip install sart_toolkit\[franka\]"):
        arm = Franka("arm", RATE)
        arm.connect()
        arm.start()


def test_it_is_read_without_being_taken_over(library):
    arm = Franka("arm", RATE)
    arm.connect()
    state = arm.read()
    np.testing.assert_allclose(state.q, HOME)
    assert state.trouble == "" and state.force == 1.0
    assert abs(time.monotonic() - state.time) < 1.0
    arm.stop()
    arm.disconnect()
    assert not {"start_controller", "stop_controller"} & set(Panda.made.calls)


def test_it_follows_targets_with_their_velocity_until_it_is_stopped(servo):
    servo.start()
    servo.push(HOME[None] + 0.02, 0.2)
    way = np.zeros(7)
    for _ in range(60):
        servo.tick()
        way += Panda.made.dq_d / RATE
    np.testing.assert_allclose(Panda.made.q, HOME + 0.02, atol=1e-9)
    # The velocity is what it goes on with from each tick, so the sum is off by less than one's.
    np.testing.assert_allclose(way, 0.02, atol=0.2 / RATE)
    servo.close()
    assert Panda.made.calls[-1] == "stop_controller" and Panda.made.mode == 1


def test_its_stiffness_is_the_cell_s(library):
    servo = made_servo(stiffness=[600.0] * 4 + [250.0, 150.0, 50.0])
    servo.start()
    gains = Panda.made.controller.gains
    assert list(gains) == ["stiffness"] and gains["stiffness"][0] == 600.0
    servo.close()
    with pytest.raises(InvalidInput, match="damping: expected shape"):
        Franka("arm", RATE, damping=[1.0])


@pytest.mark.parametrize(
    ("mode", "says"),
    [
        (0, "unlock its joints and activate FCI"),
        (1, "its controller has ended"),
        (3, "guided by its own buttons"),
        (4, "reflex; see what it touched"),
        (5, "user stop; make sure"),
        (6, "recovers from an error"),
        (9, "unknown mode 9"),
    ],
)
def test_what_keeps_it_from_following_stops_it(servo, mode, says):
    servo.start()
    servo.tick()
    Panda.made.mode = mode
    sent = Panda.made.calls.count("set_control")
    with pytest.raises(RobotStopped, match=says):
        servo.tick()
    assert Panda.made.calls[-1] == "stop_controller"
    assert Panda.made.calls.count("set_control") == sent


def test_what_its_controller_s_thread_ran_into_stops_it(servo):
    servo.start()
    servo.tick()
    Panda.made.error = "libfranka: joint_velocity_violation"
    with pytest.raises(RobotStopped, match="joint_velocity_violation"):
        servo.tick()


def test_one_that_isn_t_ready_is_not_taken_over(servo):
    Panda.made.mode = 5
    with pytest.raises(RobotStopped, match="Move command rejected"):
        servo.start()


def test_a_hand_guides_it_in_teaching_mode(servo):
    servo.start()
    servo.guide()
    servo.tick()
    assert Panda.made.teaching and Panda.made.controller is None
    Panda.made.q = HOME + 0.2
    servo.tick()
    np.testing.assert_allclose(servo.hold().q, HOME + 0.2)
    assert not Panda.made.teaching
    servo.tick()
    np.testing.assert_allclose(Panda.made.q, HOME + 0.2)
    servo.guide()
    servo.tick()
    servo.close()
    assert not Panda.made.teaching


CALLS = (
    "start_controller", "stop_controller", "teaching_mode(True)", "teaching_mode(False)",
    "raise_error", "refresh_state", "get_state", "set_control",
)  # fmt: skip


@pytest.mark.parametrize("moment", ["from the start", "while it moves", "while it is guided"])
@pytest.mark.parametrize("call", CALLS)
def test_whichever_call_raises_it_is_stopped(servo, call, moment):
    panda = Panda.made
    if moment == "from the start":
        panda.raising = call
    try:
        servo.start()
        if moment == "while it is guided":
            servo.guide()
        for _ in range(3):
            servo.tick()
        panda.raising = call
        for _ in range(3):
            servo.tick()
        if moment == "while it is guided":
            servo.hold()
            servo.tick()
    except RobotStopped as error:
        assert f"{call}: emulated failure" in str(error)
    else:
        assert moment != "while it is guided" or call in ("stop_controller", "teaching_mode(True)")
    servo.close()
    assert "stop_controller" in panda.calls
    if "teaching_mode(True)" in panda.calls:
        assert "teaching_mode(False)" in panda.calls
    if call != "stop_controller":
        assert panda.controller is None and not panda.teaching


def test_no_connection_is_said(library):
    with pytest.raises(RuntimeError, match="Connection timeout"):
        Franka("other", RATE).connect()


def test_its_cell_senses_force_and_can_be_guided():
    made = cell_backend(Cell("panda", Part("arm", "franka", {"host": "arm"}), limits(MODEL)))
    assert issubclass(made, Guides) and issubclass(made, SensesForce)
