"""What a cell's file may say."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from sart_toolkit.errors import BrokenFile, InvalidInput, Mismatch, MissingFile, UnknownName
from sart_toolkit.hardware.cell import load_cell
from sart_toolkit.hardware.robotiq import RobotiqSocket
from sart_toolkit.hardware.ur import UrRtdeArm

CELL = """
robot = "ur5e_2f85"

[arm]
driver = "ur_rtde"
host = "192.168.0.2"
gain = 250.0

[gripper]
driver = "robotiq_socket"
host = "192.168.0.2"

[camera.wrist]
driver = "realsense"
fov_y_deg = 40.0
hand_eye_mm = 2.0
hand_eye_deg = 0.3

[limits]
workspace = { low = [0.2, -0.4, 0.0], high = [0.8, 0.4, 0.6] }

[control]
rate_hz = 500
"""


@pytest.fixture
def read(tmp_path):
    def read(text):
        path = tmp_path / "cell.toml"
        path.write_text(text)
        return load_cell(path)

    return read


def test_a_cell_is_read_with_its_parts(read, robot):
    cell = read(CELL)
    assert isinstance(cell.make_arm(), UrRtdeArm)
    assert isinstance(cell.make_gripper(), RobotiqSocket)
    assert cell.limits.speed_scale == 0.1
    assert cell.cameras["wrist"].hand_eye_mm == 2.0
    (camera,) = cell.mounted(robot).cameras
    assert camera.fov_y_deg == 40.0
    np.testing.assert_array_equal(camera.T_frame_camera, robot.cameras[0].T_frame_camera)


def test_what_is_left_out_is_left_out(read, robot):
    text = CELL.split("[gripper]")[0] + "[limits]" + CELL.split("[limits]")[1]
    cell = read(text)
    assert cell.gripper is None and cell.make_gripper() is None and cell.make_cameras() == {}
    assert cell.mounted(robot).cameras == ()


def test_a_camera_is_where_the_cell_has_it(read, robot):
    T = np.eye(4)
    T[:3, 3] = 0.5, 0.1, 0.7
    extra = f'frame = "world"\nT_frame_camera = {T.tolist()}\n'
    text = CELL.replace("[camera.wrist]\n", "[camera.above]\n" + extra)
    (camera,) = read(text).mounted(robot).cameras
    assert (camera.name, camera.frame) == ("above", "world")
    np.testing.assert_array_equal(camera.T_frame_camera, T)


@pytest.mark.parametrize(
    ("old", "new", "says"),
    [
        ("[limits]", "[limit]", r"cell: unknown key 'limit': did you mean 'limits'\? expected"),
        ('robot = "ur5e_2f85"', "", "robot: is missing"),
        ('robot = "ur5e_2f85"', "robot = 5", "robot: expected text, got 5"),
        ('driver = "ur_rtde"', "", r"\[arm\] driver: is missing; choose from ur_rtde"),
        ("workspace", "box", r"\[limits\] workspace: is missing"),
        ("rate_hz = 500", "rate = 500", r"\[control\]: unknown key 'rate': did you mean 'rate_hz'"),
        ("rate_hz = 500", 'rate_hz = "fast"', r"\[control\] rate_hz: expected `int`, got `str`"),
        ("rate_hz = 500", "rate_hz = 5", "rate_hz: expected 10 to 1000 Hz, got 5"),
        ("rate_hz = 500", "buffer = 2.0", "buffer: expected 0.008 to 1 s, got 2.0"),
        ("rate_hz = 500", "buffer = 0.0", "buffer: expected 0.008 to 1 s, got 0.0"),
        ("rate_hz = 500", "silence = 0.0", "silence: expected a finite number > 0 s, got 0.0"),
        ("[0.2, -0.4, 0.0]", "[0.2, -0.4]", r"\[limits\] workspace low: expected shape \(3,\)"),
        ("[0.2, -0.4, 0.0]", "[0.9, -0.4, 0.0]", "workspace: expected low < high"),
        ("[control]", "speed_scale = 2.0\n[control]", "speed_scale: expected 0 to 1, got 2.0"),
        ("[control]", "force = 0.0\n[control]", "force: expected a finite number > 0"),
        ("hand_eye_mm = 2.0", "hand_eye_mm = -1.0", r"\[camera.wrist\] hand_eye_mm: expected"),
        ("fov_y_deg", 'frame = "tool"\nfov_y_deg', "expected both or neither"),
    ],
)
def test_a_wrong_key_or_value_is_named_with_what_was_expected(read, old, new, says):
    assert old in CELL
    with pytest.raises(InvalidInput, match=f"cell.toml: .*{says}"):
        read(CELL.replace(old, new))


@pytest.mark.parametrize(
    ("old", "new", "make", "says"),
    [
        ("gain = ", "gian = ", "arm", r"\[arm\] of driver 'ur_rtde': unknown key 'gian': did you"),
        ('host = "192.168.0.2"\ngain', "gain", "arm", "driver 'ur_rtde' needs 'host'; add it"),
        ("gain", "rate_hz = 5\ngain", "arm", "unknown key 'rate_hz'"),
        ('"realsense"', '"realsense"\nzoom = 2', "cameras", "unknown key 'zoom'"),
    ],
)
def test_options_that_a_driver_doesn_t_take_are_refused(read, old, new, make, says):
    cell = read(CELL.replace(old, new))
    with pytest.raises(InvalidInput, match=says):
        getattr(cell, f"make_{make}")()


def test_a_driver_that_isn_t_there_is_refused_with_the_nearest(read):
    with pytest.raises(UnknownName, match="did you mean 'ur_rtde'"):
        read(CELL.replace("ur_rtde", "ur_rtd")).make_arm()


def test_a_file_that_can_t_be_read_says_so(read, tmp_path):
    with pytest.raises(MissingFile, match="no such file"):
        load_cell(tmp_path / "none.toml")
    with pytest.raises(BrokenFile, match="can't be read as TOML"):
        read("[arm")


def test_another_robot_than_the_cell_s_is_refused(read, robot):
    other = dataclasses.replace(robot, name="other")
    with pytest.raises(Mismatch, match="the cell has 'ur5e_2f85', got 'other'; add --robot"):
        read(CELL).mounted(other)


def test_a_camera_that_nobody_places_is_refused(read, robot):
    with pytest.raises(InvalidInput, match="'ur5e_2f85' has no such camera; give its frame"):
        read(CELL.replace("camera.wrist", "camera.left")).mounted(robot)


@pytest.mark.parametrize(
    ("rate", "goal"), [(500, 125), (125, 125), (250, 125), (30, 30), (1000, 125)]
)
def test_goals_come_at_a_part_of_the_rate(read, rate, goal):
    control = read(CELL.replace("rate_hz = 500", f"rate_hz = {rate}")).control
    assert control.goal_hz == goal
