from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sart_toolkit.backends.interface import Observation
from sart_toolkit.poses import inverse, pose
from sart_toolkit.tasks import get_task
from sart_toolkit.tasks.parts import tool_down
from sart_toolkit.tasks.task import Placement
from sart_toolkit.tasks.toolbox_picking import BAR_HEIGHT, MASS

TASK = get_task("toolbox_picking")
PADS = ("gripper_left_inner_finger_pad", "gripper_right_inner_finger_pad")
PLACEMENT = Placement(0.04, -0.06, 10.0)


def _observation(height, tilt_deg=0.0, about_deg=0.0, p_tool_bar=(0, 0, 0), yaw_deg=0.0):
    """The box tilted about a level axis, its lowest point aside, the bar somewhere in the tool."""
    about = np.deg2rad(about_deg)
    T = pose([0.5, 0.1, height], [0, 0, np.deg2rad(yaw_deg)])
    T = T @ pose(rotvec=np.deg2rad(tilt_deg) * np.array([np.cos(about), np.sin(about), 0]))
    T_world_tool = tool_down([0, 0, 0])
    p_world_bar = (T @ [0, 0, BAR_HEIGHT, 1])[:3]
    T_world_tool[:3, 3] = p_world_bar - T_world_tool[:3, :3] @ p_tool_bar
    return Observation(
        q=np.zeros(6),
        dq=np.zeros(6),
        gripper=0.8,
        T_world_tool=T_world_tool,
        time=0.0,
        Ts_world_body={"toolbox": T},
    )


angles = st.floats(-180, 180)


@settings(max_examples=200, deadline=None, derandomize=True)
@given(
    st.floats(0, 0.1),
    st.floats(0, 30),
    angles,
    st.tuples(st.floats(-0.015, 0.015), st.floats(-0.04, 0.04), st.floats(-0.02, 0.02)),
    angles,
)
def test_success_is_what_the_card_says(height, tilt, about, bar, yaw):
    within = np.abs(bar) - [0.010, 0.030, 0.015]
    wanted = height > 0.05 and tilt < 15 and (within < 0).all()
    if min(abs(height - 0.05), abs(tilt - 15), *np.abs(within)) > 1e-6:
        assert TASK.success(_observation(height, tilt, about, bar, yaw)) == wanted


@pytest.mark.parametrize(
    ("observation", "text"),
    [
        (_observation(0.07, 20), "toolbox tilted 20 deg"),
        (_observation(0.07, 0, 0, (0, 0.04, 0)), "handle 40 mm from between the fingers"),
        (_observation(0.02), "toolbox between the fingers but only 20 mm above the table"),
    ],
)
def test_a_failure_reason_says_what_is_missing(observation, text):
    assert not TASK.success(observation)
    assert TASK.failure_reason(observation) == text


def _moved(steps, *p_tool):
    return [replace(step, T_world_tool=step.T_world_tool @ pose(p_tool)) for step in steps]


def test_the_box_hangs_still_between_the_pads_and_nothing_else_is_touched(demonstrate):
    demonstration = demonstrate()
    assert TASK.achieved(demonstration.success)
    pairs = {pair for step in demonstration.touching for pair in step}
    assert pairs == {("table", "toolbox"), *((pad, "toolbox") for pad in PADS)}
    first = int(np.argmax(demonstration.success))
    Ts_tool_box = [
        inverse(tool) @ box
        for tool, box in zip(
            demonstration.steps.measured_Ts_world_tool,
            demonstration.body_Ts_world["toolbox"],
            strict=True,
        )
    ][first:]
    p_bar = np.array([(T @ [0, 0, BAR_HEIGHT, 1])[:3] for T in Ts_tool_box])
    assert np.ptp(p_bar, axis=0).max() < 0.004
    turn = np.rad2deg([np.arccos(np.clip(-T[2, 2], -1, 1)) for T in Ts_tool_box])
    assert turn.max() < 12
    # Friction that bears the weight needs less than this of a squeeze; the drive gives 50 N.
    assert MASS * 9.81 < demonstration.steps.contact_force[first:].max() < 100


@pytest.mark.parametrize(
    ("change", "text"),
    [
        pytest.param(
            lambda steps: [replace(step, gripper=0.0) for step in steps],
            "from between the fingers",
            id="fingers left open",
        ),
        pytest.param(
            lambda steps: [*steps[:-1], *_moved(steps[2:3], 0, 0, -0.02)],
            "only (1|2)[0-9] mm above the table",
            id="lifted by 2 cm only",
        ),
        pytest.param(
            lambda steps: _moved(steps, 0.09, 0, 0),
            "from between the fingers",
            id="grasped beside the handle",
        ),
    ],
)
def test_no_other_way_is_a_success(demonstrate, backend, change, text):
    demonstration = demonstrate(change)
    assert not demonstration.success.any()
    assert re.search(text, TASK.failure_reason(backend.observe()))
