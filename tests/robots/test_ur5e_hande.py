"""The UR5e with the Robotiq Hand-E: parallel jaws of 50 mm stroke, a camera looking past them."""

import numpy as np
import pytest

from sart_toolkit.backends import BACKENDS, make_backend
from sart_toolkit.poses import inverse
from sart_toolkit.robots import get_robot
from sart_toolkit.robots.model import RobotModel
from sart_toolkit.scenes.spec import SceneSpec

SPEC = get_robot("ur5e_hande")
COMMANDS = np.linspace(0, 1, 11)
JAW_BELOW_TOOL = 0.010


@pytest.fixture(scope="module")
def jaws():
    """The jaws' poses in the tool frame at each of COMMANDS: left, then right."""
    Ts = []
    for command in COMMANDS:
        model = RobotModel(SPEC, gripper=command)
        T_tool_world = inverse(model.fk(SPEC.home))
        Ts.append([T_tool_world @ model.fk(SPEC.home, f) for f in SPEC.gripper.finger_links])
    return np.array(Ts)


def test_the_opening_falls_evenly_from_50_mm_to_nothing(jaws):
    np.testing.assert_allclose(jaws[:, 0, 0, 3], 0.025 * (1 - COMMANDS), atol=1e-9)
    np.testing.assert_allclose(jaws[:, 1, 0, 3], -0.025 * (1 - COMMANDS), atol=1e-9)


def test_the_tool_frame_lies_midway_between_parallel_jaws(jaws):
    for left, right in jaws:
        np.testing.assert_allclose(left[:3, 3] + right[:3, 3], 0, atol=1e-9)
        np.testing.assert_allclose(left[1:3, 3], 0, atol=1e-9)
        np.testing.assert_allclose(left[:3, :3], np.eye(3), atol=1e-9)
        np.testing.assert_allclose(right[:3, :3], np.eye(3), atol=1e-9)


def test_the_wrist_camera_sees_the_closed_jaws_and_20_cm_around_what_is_40_cm_below():
    K = SPEC.cameras[0].intrinsics(128, 128)
    T_camera_tool = inverse(SPEC.cameras[0].T_frame_camera) @ SPEC.T_gripper_tool
    below = [np.array([x, y, 0.4]) for x in (-0.2, 0.2) for y in (-0.2, 0.2)]
    for p_tool in [np.array([0, 0, JAW_BELOW_TOOL]), *below]:
        u, v, w = K @ (T_camera_tool @ np.append(p_tool, 1))[:3]
        assert w > SPEC.cameras[0].near
        assert 0 <= u / w <= 127
        assert 0 <= v / w <= 127


@pytest.mark.parametrize("name", BACKENDS)
def test_the_jaws_move_together_as_fast_as_the_data_sheet_allows(name):
    backend = make_backend(name, SPEC, SceneSpec(()), 16)
    scene = backend.scene
    backend.reset(scene.initial_state(SPEC.home, 0.0))
    seen = []
    for _ in range(15):
        backend.command(SPEC.home, 1.0)
        backend.step()
        seen.append(backend.observe().gripper)
    backend.close()
    # Two jaws at 75 mm/s each: 50 mm in a third of a second.
    assert seen[4] == pytest.approx(5 / 10, abs=0.08)
    assert seen[-1] == pytest.approx(1.0, abs=0.01)
