from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sart_toolkit.backends.interface import Observation
from sart_toolkit.poses import pose
from sart_toolkit.tasks import get_task
from sart_toolkit.tasks.lid_closing import LID_TOP, OPEN_DEG, TIP
from sart_toolkit.tasks.parts import tool_down
from sart_toolkit.tasks.task import Placement

TASK = get_task("lid_closing")
JAWS = ("gripper_left_jaw", "gripper_right_jaw")
PLACEMENT = Placement(0.06, 0.04, -10.0)
HINGE = TASK.scene.jointed["lid"].joint


def _observation(angle_deg, above=0.05, x=0.5):
    T_world_container = pose([0.5, 0.1, 0], [0, 0, 0.2])
    return Observation(
        q=np.zeros(6),
        dq=np.zeros(6),
        gripper=1.0,
        T_world_tool=tool_down([x, 0, LID_TOP + above + TIP]),
        time=0.0,
        Ts_world_body={
            "container": T_world_container,
            "lid": T_world_container @ HINGE.T_parent_moved(np.deg2rad(angle_deg)),
        },
    )


@settings(max_examples=200, deadline=None, derandomize=True)
@given(st.floats(0, 6), st.floats(0, 0.03), st.floats(0.3, 0.7))
def test_success_is_what_the_card_says(angle_deg, above, x):
    if min(abs(angle_deg - 2), abs(above - 0.010)) > 1e-6:
        wanted = angle_deg < 2 and above > 0.010
        assert TASK.success(_observation(angle_deg, above, x)) == wanted


@pytest.mark.parametrize(
    ("observation", "text"),
    [
        (_observation(30), "lid 30 deg open"),
        (_observation(0.5, 0.004), "lid shut, but the jaws only 4 mm above it"),
    ],
)
def test_a_failure_reason_says_what_is_missing(observation, text):
    assert not TASK.success(observation)
    assert TASK.failure_reason(observation) == text


def test_spring_and_catch_are_as_strong_as_the_card_says():
    effort = [HINGE.effort(np.deg2rad(angle)) for angle in np.arange(0, OPEN_DEG, 0.1)]
    angles = np.arange(0, OPEN_DEG, 0.1)
    drawn = angles[np.array(effort) < 0]
    assert drawn.min() == 0
    assert drawn.max() == pytest.approx(11, abs=0.5)
    assert len(drawn) == pytest.approx(drawn.max() / 0.1 + 1, abs=1)
    assert max(effort) == pytest.approx(0.6, abs=0.05)
    assert -effort[0] > 2 * HINGE.friction
    assert HINGE.stiffness * HINGE.rest == pytest.approx(0.13, abs=0.005)
    assert HINGE.effort(np.deg2rad(OPEN_DEG)) == pytest.approx(0.04, abs=0.005)


def _moved(steps, *p_tool):
    return [replace(step, T_world_tool=step.T_world_tool @ pose(p_tool)) for step in steps]


def _angles_deg(demonstration):
    Ts = demonstration.body_Ts_world
    poses = zip(Ts["lid"], Ts["container"], strict=True)
    at = [TASK.scene.joint_position("lid", {"lid": a, "container": b}) for a, b in poses]
    return np.rad2deg(at)


def test_the_lid_waits_open_and_stays_shut_and_nothing_else_is_touched(demonstrate):
    demonstration = demonstrate()
    assert TASK.achieved(demonstration.success)
    touched = {pair for step in demonstration.touching for pair in step}
    assert touched <= {(jaw, "lid") for jaw in JAWS}
    angle = _angles_deg(demonstration)
    press = [bool(step) for step in demonstration.touching]
    first, last = press.index(True), len(press) - press[::-1].index(True)
    np.testing.assert_allclose(angle[: first - 1], OPEN_DEG, atol=0.2)
    np.testing.assert_allclose(angle[last + 1 :], 0, atol=0.2)
    # 0.6 N m some 37 mm from the hinge.
    assert 5 < demonstration.steps.contact_force.max() < 40


@pytest.mark.parametrize(
    ("change", "opens"),
    [
        pytest.param(lambda steps: _moved(steps, 0.075, 0, 0), True, id="pressed beside"),
        pytest.param(
            lambda steps: [
                steps[0],
                *_moved(steps[1:2], 0, 0, -0.018),
                *_moved(steps[2:], 0, 0, -0.04),
            ],
            True,
            id="pressed halfway",
        ),
        pytest.param(lambda steps: steps[:2], False, id="not let go"),
    ],
)
def test_no_other_way_is_a_success(demonstrate, backend, change, opens):
    demonstration = demonstrate(change)
    assert not demonstration.success.any()
    text = f"lid {OPEN_DEG:.0f} deg open" if opens else "lid shut, but the jaws only .* mm above"
    assert re.match(text, TASK.failure_reason(backend.observe()))
