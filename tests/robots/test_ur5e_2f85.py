"""The UR5e with the Robotiq 2F-85: its gripper closes as the real one, its camera sees the tips."""

import numpy as np
import pytest

from sart_toolkit.poses import inverse
from sart_toolkit.robots.model import RobotModel
from sart_toolkit.robots.spec import Shape

PAD_THICKNESS, PAD_LENGTH = 0.00635, 0.0375
COMMANDS = np.linspace(0, 1, 11)


@pytest.fixture(scope="module")
def pads(spec):
    """The fingertip pads' poses in the tool frame at each of COMMANDS: left, then right."""
    Ts = []
    for command in COMMANDS:
        model = RobotModel(spec, gripper=command)
        T_tool_world = inverse(model.fk(spec.home))
        Ts.append([T_tool_world @ model.fk(spec.home, f) for f in spec.gripper.finger_links])
    return np.array(Ts)


def opening(pads):
    """Distance [m] between the pads' inner faces along the tool's x axis."""
    left, right = pads[:, 0, 0, 3], pads[:, 1, 0, 3]
    return np.abs(right - left) - PAD_THICKNESS


def test_the_opening_falls_steadily_from_85_mm_to_nothing(pads):
    width = opening(pads)
    assert width[0] == pytest.approx(0.085, abs=0.002)
    assert width[-1] == pytest.approx(0.0, abs=0.002)
    assert (np.diff(width) < -0.005).all()


def test_the_tool_frame_lies_midway_between_the_fingertips(pads):
    middle = pads[:, :, :3, 3].mean(1)
    np.testing.assert_allclose(middle[:, :2], 0, atol=1e-4)
    # The tool's origin is beside the pads' faces, whatever the opening.
    assert np.abs(middle[:, 2]).max() < PAD_LENGTH / 2


def test_the_pads_face_each_other_along_the_tools_x_axis(pads):
    for left, right in pads:
        np.testing.assert_allclose(np.abs(left[:3, 1]), [1, 0, 0], atol=2e-3)
        np.testing.assert_allclose(left[:3, 1], -right[:3, 1], atol=2e-3)


def test_every_joint_of_the_linkage_stays_within_a_turn_of_the_driver(spec):
    for command in COMMANDS:
        angles = spec.gripper.joint_positions(command)
        driver = angles[spec.gripper.driver]
        assert driver == pytest.approx(0.8 * command)
        assert len(angles) == 6
        assert {abs(angle) for angle in angles.values()} == {driver}


def test_the_wrist_camera_sees_both_fingertips_and_what_lies_beyond_them(spec, pads):
    K = spec.cameras[0].intrinsics(128, 128)
    T_camera_tool = inverse(spec.cameras[0].T_frame_camera) @ spec.T_gripper_tool
    tips = [T[:3, 3] + [0, 0, PAD_LENGTH / 2] for T in pads.reshape(-1, 4, 4)]
    beyond = [np.array([x, 0, 0.2]) for x in (-0.05, 0.05)]
    for p_tool in [*tips, *beyond]:
        u, v, w = K @ (T_camera_tool @ np.append(p_tool, 1))[:3]
        assert w > spec.cameras[0].near
        assert 0 <= u / w <= 127
        assert 0 <= v / w <= 127


def test_the_cameras_housing_is_behind_its_image(spec):
    corners = np.concatenate([shape.corners() for shape in spec.attachments[0].shapes])
    assert spec.attachments[0].name == "wrist_camera"
    assert isinstance(spec.attachments[0].shapes[0], Shape)
    np.testing.assert_array_equal(spec.attachments[0].T_frame_body, spec.cameras[0].T_frame_camera)
    assert corners[:, 2].max() < 0
