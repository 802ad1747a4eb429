"""An object with LeRobot's methods as an arm."""

from __future__ import annotations

import numpy as np
import pytest

from sart_toolkit.errors import InvalidInput
from sart_toolkit.hardware.lerobot import LeRobotArm

JOINTS = ("shoulder.pos", "elbow.pos")


class Robot:
    """As LeRobot describes a `Robot`."""

    observation_features = action_features = dict.fromkeys((*JOINTS, "gripper.pos"), float)
    is_connected, is_calibrated = False, True

    def __init__(self):
        self.at, self.sent = dict.fromkeys(self.action_features, 0.0), []

    def connect(self, calibrate=True):
        assert not calibrate
        self.is_connected = True

    def get_observation(self):
        return self.at

    def send_action(self, action):
        self.sent.append(action)
        self.at = {**self.at, **action}
        return action

    def disconnect(self):
        self.is_connected = False


@pytest.fixture
def time():
    return [0.0]


@pytest.fixture
def arm(time):
    arm = LeRobotArm(Robot(), 30, JOINTS, clock=lambda: time[0])
    arm.connect()
    return arm


def test_joints_are_sent_and_read_in_radians_whatever_its_unit(arm):
    arm.servo(np.array([np.pi / 2, -np.pi]), 1 / 30)
    assert arm._robot.sent == [{"shoulder.pos": 90.0, "elbow.pos": -180.0}]
    np.testing.assert_allclose(arm.read().q, [np.pi / 2, -np.pi])


def test_velocities_are_differences_of_what_was_read(arm, time):
    arm.read()
    arm.servo(np.array([0.1, 0.0]), 1 / 30)
    time[0] = 0.5
    np.testing.assert_allclose(arm.read().dq, [0.2, 0.0])


def test_a_stop_sends_it_to_where_it_is_and_it_is_disconnected(arm):
    robot = arm._robot
    robot.at = {"shoulder.pos": 10.0, "elbow.pos": 20.0, "gripper.pos": 1.0}
    arm.stop()
    assert robot.sent[-1] == pytest.approx({"shoulder.pos": 10.0, "elbow.pos": 20.0})
    arm.disconnect()
    assert not robot.is_connected
    arm.disconnect()


def test_an_arm_that_lost_its_connection_is_in_trouble(arm):
    arm._robot.is_connected = False
    assert "isn't connected" in arm.read().trouble


def test_joints_that_it_hasn_t_are_refused_with_those_that_it_has():
    arm = LeRobotArm(Robot(), 30, ("wrist.pos",))
    with pytest.raises(InvalidInput, match=r"no 'wrist.pos', only shoulder.pos, elbow.pos"):
        arm.connect()


def test_an_unknown_unit_is_refused():
    with pytest.raises(InvalidInput, match="unit: expected 'deg' or 'rad', got 'turns'"):
        LeRobotArm(Robot(), 30, JOINTS, unit="turns")
