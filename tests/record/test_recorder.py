from __future__ import annotations

import numpy as np
import pytest

from sart_toolkit.motion.controller import ToolController
from sart_toolkit.poses import pose
from sart_toolkit.record.recorder import StepRecorder
from sart_toolkit.tasks.task import Placement


@pytest.fixture
def recorder(peg_backend, peg_model, peg_task):
    """Five steps of a tool that moves down, its gripper command and force counted up."""
    state = peg_task.initial_state(peg_model, Placement())
    peg_backend.reset(state)
    controller = ToolController(peg_model)
    controller.reset(state.q)
    recorder = StepRecorder(peg_backend, peg_model, ("wrist",))
    for i in range(5):
        measured = peg_backend.observe().T_world_tool
        goal = controller.commanded_T_world_tool @ pose([0, 0, 0.004])
        for q in controller.move(goal, measured, 3):
            peg_backend.command(q, 0.6 + 0.01 * i)
            peg_backend.step()
        recorder.add(controller, 0.6 + 0.01 * i, float(i))
    return recorder


def test_each_row_holds_what_was_measured_commanded_and_seen(recorder, peg_model):
    steps = recorder.steps()
    assert len(steps) == len(recorder.observations) == 5
    np.testing.assert_allclose(steps.commanded_gripper, [0.6, 0.61, 0.62, 0.63, 0.64])
    np.testing.assert_array_equal(steps.contact_force, [0, 1, 2, 3, 4])
    heights = steps.commanded_Ts_world_tool[:, 2, 3]
    np.testing.assert_allclose(np.diff(heights), -0.004, atol=1e-9)
    for i, row in enumerate(recorder.observations):
        np.testing.assert_array_equal(steps.joint_positions[i], row.q)
        np.testing.assert_array_equal(steps.measured_Ts_world_tool[i], row.T_world_tool)
        np.testing.assert_array_equal(steps.cameras["wrist"].rgb[i], row.cameras["wrist"].rgb)
        np.testing.assert_allclose(
            peg_model.fk(steps.commanded_joint_positions[i]),
            steps.commanded_Ts_world_tool[i],
            atol=1e-5,
        )


def test_a_record_backwards_has_the_same_rows_in_the_opposite_order(recorder):
    forward, backward = recorder.steps().content(), recorder.steps(backwards=True).content()
    for name, values in forward.items():
        if name.endswith("T_frame_camera"):
            np.testing.assert_allclose(backward[name], values, atol=1e-6)
        elif name.endswith(("intrinsics", "frame")):
            np.testing.assert_array_equal(backward[name], values)
        elif name not in ("joint_velocities", "contact_force"):
            np.testing.assert_array_equal(backward[name], values[::-1])


def test_backwards_the_joints_move_the_opposite_way(recorder):
    forward, backward = recorder.steps(), recorder.steps(backwards=True)
    assert np.abs(forward.joint_velocities).max() > 0.01
    np.testing.assert_array_equal(backward.joint_velocities, -forward.joint_velocities[::-1])
    for steps in (forward, backward):
        moved = np.diff(steps.joint_positions, axis=0)
        fast = np.abs(moved) > 1e-4
        assert fast.any()
        np.testing.assert_array_equal(
            np.sign(moved)[fast], np.sign(steps.joint_velocities[1:])[fast]
        )


def test_backwards_the_force_of_a_step_still_stands_at_the_step_s_end(recorder):
    """The force 0, 1, 2, 3, 4 [N] was that of the steps before rows 0 to 4."""
    np.testing.assert_array_equal(recorder.steps(backwards=True).contact_force, [0, 4, 3, 2, 1])


def test_a_force_that_was_not_measured_is_not_measured_backwards_either(recorder, monkeypatch):
    monkeypatch.setattr(recorder, "_force", [np.nan] * 5)
    assert np.isnan(recorder.steps(backwards=True).contact_force).all()


def test_intrinsics_are_those_of_the_recorded_image_size(recorder, peg_backend):
    camera = recorder.steps().cameras["wrist"]
    height, width = camera.rgb.shape[1:3]
    assert (width, height) == peg_backend.image_size
    expected = peg_backend.cameras["wrist"].intrinsics(width, height)
    np.testing.assert_array_equal(camera.intrinsics, expected)
