"""What every device of the table promises."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from sart_toolkit.backends.interface import Guides
from sart_toolkit.errors import DeviceLost, InvalidInput, UnknownName
from sart_toolkit.record.devices import DEVICES, make_device
from sart_toolkit.record.devices.manual import SPEEDS, Control, ManualDevice, views
from sart_toolkit.record.session import TeleopCommand


class Guided(Guides):
    """In place of a backend whose arm a hand may move."""

    def __init__(self, backend):
        self.scene, self.rates = backend.scene, backend.rates

    def guide(self):
        pass

    def hold(self):
        pass


@pytest.fixture(params=DEVICES)
def device(request, peg_setup):
    if request.param == "hand_guiding":
        peg_setup = dataclasses.replace(peg_setup, backend=Guided(peg_setup.backend))
    return make_device(request.param, peg_setup)


def test_a_device_is_called_as_in_the_table(device):
    assert DEVICES[device.name] and device.operator


def test_one_that_a_person_holds_says_so_and_has_a_key_map_that_fits_the_window(device):
    assert device.interactive == isinstance(device, ManualDevice)
    if isinstance(device, ManualDevice):
        assert device.operator == "tester"
        assert 0 < len(device.key_map) <= 7
        assert all(len(keys) <= 12 and len(what) <= 24 for keys, what in device.key_map)


def test_an_unknown_device_is_refused_with_the_nearest(peg_setup):
    with pytest.raises(UnknownName, match="unknown device 'space': did you mean 'spacemouse'"):
        make_device("space", peg_setup)


class Puppet(ManualDevice):
    """Pushes and turns as set."""

    name = "puppet"
    axes = np.zeros(6)

    def connect(self):
        self.let_go()

    def poll(self):
        return self.axes.copy()


@pytest.fixture
def puppet(peg_setup):
    return Puppet(peg_setup)


def settled(device, observation, periods=60):
    for _ in range(periods):
        command = device.read(observation)
    assert isinstance(command, TeleopCommand)
    return command.velocity


def test_world_directions_are_those_of_the_scene_view(puppet, peg_task, make_session):
    """Right moves right in the image, forward away from the camera, up moves up."""
    now = make_session().observation
    R_world_tool = now.T_world_tool[:3, :3]
    R_world_camera = peg_task.scene.cameras[0].T_frame_camera[:3, :3]
    right, forward, up = (
        R_world_camera.T @ R_world_tool @ settled(_pushed(puppet, axis), now)[:3]
        for axis in range(3)
    )
    assert right[0] == pytest.approx(0.06) and abs(right[1]) < 1e-6
    assert forward[2] > 0.04 and abs(forward[0]) < 1e-6
    assert up[1] < -0.04 and abs(up[0]) < 1e-6
    world_up = R_world_tool @ settled(_pushed(puppet, 2), now)[:3]
    np.testing.assert_allclose(world_up, [0, 0, 0.06], atol=1e-6)


def test_tool_directions_are_those_of_the_wrist_view(puppet, make_session):
    session = make_session(cameras=("wrist",))
    now = session.observation
    R_tool_camera = (
        now.T_world_tool[:3, :3].T @ session.recorded.cameras["wrist"].T_world_camera[:3, :3]
    )
    puppet.switch_frame()
    right, forward, up = (
        R_tool_camera.T @ settled(_pushed(puppet, axis), now)[:3] for axis in range(3)
    )
    assert right[0] == pytest.approx(0.06)
    assert forward[1] < -0.03
    assert up[2] < -0.03, "out of the image, back along the tool"


def test_without_a_camera_in_the_scene_the_person_stands_behind_the_robot(peg_model, peg_task):
    R = views(peg_model, dataclasses.replace(peg_task.scene, cameras=())).R_world_hand
    np.testing.assert_allclose(R, [[0, 1, 0], [-1, 0, 0], [0, 0, 1]])


def test_a_wrist_camera_mounted_a_little_askew_does_not_tilt_the_directions(peg_model, peg_task):
    straight = views(peg_model, peg_task.scene).R_tool_hand
    np.testing.assert_array_equal(straight, np.round(straight))
    assert np.linalg.det(straight) == pytest.approx(1.0)


def _pushed(device, axis, by=1.0):
    device.axes = np.eye(6)[axis] * by
    return device


def test_a_turn_is_about_the_same_directions_as_a_push_is_along(puppet, make_session):
    now = make_session().observation
    for frame in ("world", "tool"):
        puppet.frame = frame
        for axis in range(3):
            along = settled(_pushed(puppet, axis), now)[:3]
            about = settled(_pushed(puppet, 3 + axis), now)[3:]
            cosine = along @ about / np.linalg.norm(along) / np.linalg.norm(about)
            assert cosine == pytest.approx(1.0)


@pytest.mark.parametrize("number", [1, 2, 3])
def test_full_deflection_is_the_chosen_speed_also_with_two_at_once(puppet, make_session, number):
    now = make_session().observation
    speed = SPEEDS[number - 1]
    assert puppet.key(str(number), True)
    assert puppet.speed is speed
    for axes in (np.eye(6)[0], [1, 1, 1, 0, 0, 0], [5, 0, 0, 0, 0, 0]):
        puppet.axes = np.array(axes, float)
        assert np.linalg.norm(settled(puppet, now)[:3]) == pytest.approx(speed.linear)
    puppet.axes = np.array([0, 0, 0, 1, 1, 0.0])
    assert np.linalg.norm(settled(puppet, now)[3:]) == pytest.approx(np.deg2rad(speed.turn_deg))


def test_speeds_rise_and_stay_within_what_a_person_can_watch():
    linear = [speed.linear for speed in SPEEDS]
    assert linear == sorted(linear) and linear[0] <= 0.03 and linear[-1] <= 0.25


def test_velocity_rises_and_falls_smoothly_and_ends_at_rest(puppet, make_session):
    now = make_session().observation
    _pushed(puppet, 0)
    rising = [np.linalg.norm(puppet.read(now).velocity[:3]) for _ in range(10)]
    assert rising[0] < 0.3 * 0.06 and (np.diff(rising) > 0).all()
    puppet.axes = np.zeros(6)
    falling = [puppet.read(now).velocity.copy() for _ in range(40)]
    assert not falling[-1].any()


def test_a_tap_is_a_small_move(puppet, make_session):
    now = make_session().observation
    puppet.key("1", True)
    way = 0.0
    for period in range(60):
        puppet.axes = np.eye(6)[0] * (period < 3)
        way += np.linalg.norm(puppet.read(now).velocity[:3]) / 30
    assert 0.0005 < way < 0.003


@pytest.mark.parametrize("start", [0.0, 0.67, 1.0])
def test_space_opens_what_holds_and_closes_what_is_open(puppet, start):
    puppet.gripper = start
    assert puppet.key("space", True) and puppet.key("space", False)
    first = puppet.gripper
    assert first == (1.0 if start == 0.0 else 0.0)
    puppet.key("space", True)
    assert puppet.gripper == 1.0 - first


def test_f_changes_the_frame_to_and_fro(puppet):
    frames = []
    for _ in range(3):
        puppet.key("f", True)
        puppet.key("f", False)
        frames.append(puppet.frame)
    assert frames == ["tool", "world", "tool"]


def test_a_key_without_a_meaning_is_not_taken(puppet):
    assert not puppet.key("x", True) and not puppet.key("4", True)


def test_rest_puts_the_gripper_back_and_stands_still(puppet, make_session):
    now = make_session().observation
    start = puppet.gripper
    puppet.key("space", True)
    settled(_pushed(puppet, 0), now)
    puppet.axes = np.zeros(6)
    puppet.rest()
    command = puppet.read(now)
    assert command.gripper == start and not command.velocity.any()


def test_speed_steps_stop_at_the_ends_or_go_round(puppet):
    for _ in range(5):
        puppet.change_speed(+1)
    assert puppet.speed is SPEEDS[-1]
    puppet.next_speed()
    assert puppet.speed is SPEEDS[0]
    puppet.change_speed(-1)
    assert puppet.speed is SPEEDS[0]


def test_an_unknown_frame_is_refused(peg_setup):
    with pytest.raises(InvalidInput, match="frame: expected 'world' or 'tool', got 'base'"):
        Puppet(dataclasses.replace(peg_setup, frame="base"))


def test_controls_are_reported_once(puppet):
    puppet._controls.append(Control.NEXT)
    assert puppet.controls() == [Control.NEXT] and puppet.controls() == []


def test_a_device_that_was_never_connected_is_lost(peg_setup):
    for name in ("spacemouse", "gamepad"):
        with pytest.raises(DeviceLost):
            make_device(name, peg_setup).poll()
