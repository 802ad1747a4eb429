from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sart_toolkit.backends.interface import Observation
from sart_toolkit.poses import pose
from sart_toolkit.tasks import get_task
from sart_toolkit.tasks.door_opening import BAR_GAP, BAR_RADIUS
from sart_toolkit.tasks.task import Placement

TASK = get_task("door_opening")
PLACEMENT = Placement(0.03, -0.06, -10.0)
FINGERS = {
    f"gripper_{side}_inner_finger{part}" for side in ("left", "right") for part in ("", "_pad")
}


def _observation(opened_deg, T_world_cabinet):
    state = TASK.scene.initial_state(
        np.zeros(6), 1.0, {"cabinet": T_world_cabinet}, {"door": np.deg2rad(opened_deg)}
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
@given(st.floats(0, 110), st.floats(-1, 1), st.floats(-1, 1), st.floats(-180, 180))
def test_success_is_45_degrees_wherever_the_cabinet_stands(opened, x, y, yaw):
    if abs(opened - 45) > 1e-6:
        observation = _observation(opened, pose([x, y, 0], [0, 0, np.deg2rad(yaw)]))
        assert TASK.success(observation) is (opened > 45)


def test_a_failure_reason_says_how_far_the_door_is_open():
    assert TASK.failure_reason(_observation(30.2, np.eye(4))) == "door open by 30 of 45 deg"


def _opened_deg(demonstration):
    """How far the door is open at each step `(T,)` [deg]."""
    Ts = demonstration.body_Ts_world
    rows = [{name: Ts[name][i] for name in Ts} for i in range(len(demonstration))]
    return np.rad2deg([TASK.scene.joint_position("door", row) for row in rows])


def _shifted(steps, p_cabinet):
    """The steps with the tool shifted [m], in the cabinet's axes."""
    shift = pose(PLACEMENT.T_middle_object[:3, :3] @ p_cabinet)
    return [replace(step, T_world_tool=shift @ step.T_world_tool) for step in steps]


def _handle_pixels(rgb):
    """How many pixels of images `(..., H, W, 3)` have the handle's yellow."""
    return (rgb[..., 0].astype(int) - rgb[..., 2] > 80).sum((-2, -1))


@pytest.mark.parametrize("x", [-0.1, 0.1])
@pytest.mark.parametrize("y", [-0.1, 0.0, 0.1])
def test_the_handle_is_seen_at_the_start(backend, model, x, y):
    backend.reset(TASK.initial_state(model, Placement(x, y)))
    assert _handle_pixels(backend.observe(("wrist",)).cameras["wrist"].rgb) >= 15


def test_the_fingers_pull_gently_at_nothing_but_the_door_and_see_the_handle(demonstrate):
    demonstration = demonstrate(cameras=("wrist",))
    assert TASK.achieved(demonstration.success)
    pairs = {pair for step in demonstration.touching for pair in step}
    assert pairs and pairs <= {("door", finger) for finger in FINGERS}
    assert 0.5 < demonstration.steps.contact_force.max() < 15
    assert 7 < demonstration.timestamps[-1] < 15
    assert _handle_pixels(demonstration.steps.cameras["wrist"].rgb).min() >= 15


def test_a_door_that_is_let_go_falls_shut(demonstrate):
    def let_go(steps):
        back = replace(_shifted(steps, [0.02, -0.02, 0])[-1], tolerance=0.01)
        return [*steps, back, _shifted([back], [0, 0, 0.06])[0]]

    demonstration = demonstrate(let_go)
    assert demonstration.success.any()
    assert _opened_deg(demonstration)[-1] < 1.0
    assert not TASK.achieved(demonstration.success)


def test_pulling_over_the_handle_leaves_the_door_shut(demonstrate):
    demonstration = demonstrate(lambda steps: _shifted(steps, [0, 0, 0.03]))
    assert not any(demonstration.touching)
    assert _opened_deg(demonstration).max() < 0.1


def test_pulling_in_front_of_the_handle_leaves_the_door_shut(demonstrate):
    before = [-2 * BAR_RADIUS - BAR_GAP, 0, 0]
    demonstration = demonstrate(lambda steps: _shifted(steps, before))
    assert _opened_deg(demonstration).max() < 0.1


def test_pushing_against_the_panel_leaves_the_door_shut(demonstrate):
    def push(steps):
        beside = _shifted(steps[:2], [0, 0.1, 0])
        return [*beside, replace(_shifted(beside[-1:], [0.016, 0, 0])[0], tolerance=0.004)]

    demonstration = demonstrate(push)
    assert any(demonstration.touching)
    assert _opened_deg(demonstration).max() < 0.5


def test_a_door_pulled_half_open_is_no_success(demonstrate):
    demonstration = demonstrate(lambda steps: [*steps[:4], replace(steps[4], through=False)])
    assert 20 < _opened_deg(demonstration)[-1] < 40
    assert not demonstration.success.any()
