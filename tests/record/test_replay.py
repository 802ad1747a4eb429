"""Replays: the same commands on the same simulator give the same run to the bit."""

import dataclasses

import numpy as np
import pytest

from sart_toolkit.errors import Mismatch
from sart_toolkit.record.replay import replay_demonstration, tracking_difference


def test_a_replay_on_the_same_simulator_is_the_same_run(
    peg_demonstration, peg_backend, peg_task, peg_model
):
    copy = replay_demonstration(peg_demonstration, peg_backend, peg_task, peg_model)
    n = len(peg_demonstration)
    for name in ("joint_positions", "commanded_Ts_world_tool", "measured_gripper"):
        a, b = (getattr(run.steps, name)[:n] for run in (peg_demonstration, copy))
        np.testing.assert_array_equal(a, b)
    assert copy.success[-1]
    assert copy.device == "replay"
    fingers = peg_model.spec.gripper.finger_links
    far, turn, compared = tracking_difference(peg_demonstration, copy, peg_task.scene, fingers)
    assert (far, turn) == (0.0, 0.0)
    assert compared == n


def test_the_difference_leaves_out_steps_in_contact(peg_demonstration, peg_task, peg_model):
    fingers = peg_model.spec.gripper.finger_links
    n = len(peg_demonstration)
    Ts = np.array(peg_demonstration.steps.measured_Ts_world_tool)
    Ts[5, 0, 3] += 0.003
    Ts[9, 0, 3] += 0.002
    steps = dataclasses.replace(peg_demonstration.steps, measured_Ts_world_tool=Ts)
    touching = [()] * n
    moved = dataclasses.replace(peg_demonstration, steps=steps, touching=tuple(touching))
    a = dataclasses.replace(peg_demonstration, touching=tuple(touching))
    assert tracking_difference(a, moved, peg_task.scene, fingers)[0] == pytest.approx(0.003)
    touching[5] = (("block", "peg"),)
    other = dataclasses.replace(moved, touching=tuple(touching))
    for pair in ((a, other), (other, a)):
        far, _, compared = tracking_difference(*pair, peg_task.scene, fingers)
        assert far == pytest.approx(0.002)
        assert compared == n - 1


@pytest.mark.parametrize("what", ["task", "robot"])
def test_a_demonstration_of_something_else_is_refused(
    peg_demonstration, peg_backend, peg_task, peg_model, what
):
    other = dataclasses.replace(peg_demonstration, **{what: "other"})
    with pytest.raises(Mismatch, match=f"the demonstration is of {what} 'other', not"):
        replay_demonstration(other, peg_backend, peg_task, peg_model)
