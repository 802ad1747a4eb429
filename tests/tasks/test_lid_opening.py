from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sart_toolkit.backends.interface import Observation
from sart_toolkit.poses import pose
from sart_toolkit.tasks import get_task
from sart_toolkit.tasks.lid_opening import BOX_HEIGHT, LID_THICKNESS, STOP_DEG
from sart_toolkit.tasks.task import Placement

TASK = get_task("lid_opening")
PLACEMENT = Placement(-0.04, 0.07, 12.0)
PADS = {f"gripper_{side}_inner_finger_pad" for side in ("left", "right")}


def _observation(opened_deg, T_world_box):
    state = TASK.scene.initial_state(
        np.zeros(6), 1.0, {"box": T_world_box}, {"lid": np.deg2rad(opened_deg)}
    )
    return Observation(
        q=state.q,
        dq=np.zeros(6),
        gripper=1.0,
        T_world_tool=np.eye(4),
        time=0.0,
        Ts_world_body=state.Ts_world_body,
    )


@settings(max_examples=200, deadline=None, derandomize=True)
@given(st.floats(0, STOP_DEG), st.floats(-1, 1), st.floats(-1, 1), st.floats(-180, 180))
def test_success_is_more_than_120_degrees_wherever_the_box_stands(opened, x, y, yaw):
    if abs(opened - 120) > 1e-6:
        observation = _observation(opened, pose([x, y, 0], [0, 0, np.deg2rad(yaw)]))
        assert TASK.success(observation) is (opened > 120)


def test_a_failure_reason_says_how_far_the_lid_is_open():
    assert TASK.failure_reason(_observation(89.7, np.eye(4))) == "lid open by 90 of 120 deg"


def _opened_deg(demonstration):
    """How far the lid is open at each step `(T,)` [deg]."""
    Ts = demonstration.body_Ts_world
    rows = [{name: Ts[name][i] for name in Ts} for i in range(len(demonstration))]
    return np.rad2deg([TASK.scene.joint_position("lid", row) for row in rows])


def _raised(steps, height):
    return [replace(step, T_world_tool=pose([0, 0, height]) @ step.T_world_tool) for step in steps]


def _rim_pixels(rgb):
    """How many pixels of images `(..., H, W, 3)` have the yellow of the notch's rim."""
    return (rgb[..., 0].astype(int) - rgb[..., 2] > 80).sum((-2, -1))


@pytest.mark.parametrize("x", [-0.1, 0.1])
@pytest.mark.parametrize("y", [-0.1, 0.0, 0.1])
def test_the_notch_is_seen_at_the_start(backend, model, x, y):
    backend.reset(TASK.initial_state(model, Placement(x, y)))
    assert _rim_pixels(backend.observe(("wrist",)).cameras["wrist"].rgb) >= 15


def test_the_fingertips_lift_gently_touch_nothing_but_the_lid_and_see_the_notch(demonstrate):
    demonstration = demonstrate(cameras=("wrist",))
    assert TASK.achieved(demonstration.success)
    pairs = {pair for step in demonstration.touching for pair in step}
    assert pairs and pairs <= {(pad, "lid") for pad in PADS}
    assert 2 < demonstration.steps.contact_force.max() < 40
    assert 8 < demonstration.timestamps[-1] < 16
    assert _rim_pixels(demonstration.steps.cameras["wrist"].rgb).min() >= 15
    # It lies against its stop, out of the robot's hands.
    assert _opened_deg(demonstration)[-1] == pytest.approx(STOP_DEG, abs=0.5)
    assert demonstration.steps.contact_force[-5:].max() == 0


@pytest.mark.parametrize("count", [5, 6])
def test_a_lid_let_go_before_it_turns_over_falls_shut(demonstrate, count):
    def let_go(steps):
        last = replace(steps[count - 1], through=False, tolerance=0.005)
        away = replace(last, T_world_tool=last.T_world_tool @ pose([0, 0, -0.08]))
        return [*steps[: count - 1], last, away]

    demonstration = demonstrate(let_go)
    assert 40 < _opened_deg(demonstration).max() < 80
    assert _opened_deg(demonstration)[-1] < 1.0
    assert not demonstration.success.any()


def test_sweeping_over_the_lid_leaves_it_shut(demonstrate):
    demonstration = demonstrate(lambda steps: _raised(steps, 0.07))
    assert not any(demonstration.touching)
    assert _opened_deg(demonstration).max() < 0.1


def test_pressing_on_the_lid_leaves_it_shut(demonstrate, model):
    def press(steps):
        T_world_box = TASK.initial_state(model, PLACEMENT).Ts_world_body["box"]
        T = steps[1].T_world_tool.copy()
        p_lowest = T[:3, :3] @ [0, -0.011, 0.018]
        T[:3, 3] = (T_world_box @ [0.06, 0, BOX_HEIGHT + LID_THICKNESS, 1])[:3] - p_lowest
        on_lid = replace(steps[1], T_world_tool=T, tolerance=0.004)
        return [*_raised([on_lid], 0.05), *_raised([on_lid], -0.002)]

    demonstration = demonstrate(press)
    assert any(demonstration.touching)
    assert _opened_deg(demonstration).max() < 0.5
