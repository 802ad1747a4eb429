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
from sart_toolkit.tasks.bottle_placing import CUP_DEPTH, CUP_DIAMETER, FLOOR, GRIP_HEIGHT, STROKE
from sart_toolkit.tasks.task import Placement

TASK = get_task("bottle_placing")
JAWS = ("gripper_left_jaw", "gripper_right_jaw")
PLACEMENT = Placement(-0.05, 0.06)


def _observation(bottom, tilt_deg=0.0, about_deg=0.0, opening=STROKE):
    """The bottle with its bottom's middle at `bottom` from that of the cup's floor, tilted."""
    about = np.deg2rad(about_deg)
    axis = np.array([np.cos(about), np.sin(about), 0])
    T_cup_bottle = pose([0, 0, FLOOR]) @ pose(bottom, np.deg2rad(tilt_deg) * axis)
    T_world_cup = pose([0.4, -0.1, 0], [0, 0, 0.3])
    return Observation(
        q=np.zeros(6),
        dq=np.zeros(6),
        gripper=1 - opening / STROKE,
        T_world_tool=np.eye(4),
        time=0.0,
        Ts_world_body={"cup": T_world_cup, "bottle": T_world_cup @ T_cup_bottle},
    )


offsets = st.floats(-0.02, 0.02)


@settings(max_examples=200, deadline=None, derandomize=True)
@given(
    offsets, offsets, st.floats(0, 0.02), st.floats(0, 20), st.floats(-180, 180), st.floats(0, 0.05)
)
def test_success_is_what_the_card_says(x, y, z, tilt, about, opening):
    beside = np.hypot(x, y)
    wanted = beside < 0.012 and z < 0.010 and tilt < 10 and opening > 0.040
    if min(np.abs([beside - 0.012, z - 0.010, tilt - 10, opening - 0.040])) > 1e-6:
        assert TASK.success(_observation([x, y, z], tilt, about, opening)) == wanted


@pytest.mark.parametrize(
    ("observation", "text"),
    [
        (_observation([0, 0, 0], 30), "bottle tilted 30 deg"),
        (
            _observation([0, 0.06, 0.1]),
            "bottle 60 mm beside the cup's axis, +100 mm from its floor",
        ),
        (_observation([0, 0, 0.03]), "bottle over the cup's floor, but 30 mm above it"),
        (_observation([0, 0, 0], opening=0.03), "bottle in the cup, but the jaws only 30 mm apart"),
    ],
)
def test_a_failure_reason_says_what_is_missing(observation, text):
    assert not TASK.success(observation)
    assert TASK.failure_reason(observation) == text


def test_the_cup_is_as_wide_and_deep_inside_as_its_card_says():
    cup = next(body for body in TASK.scene.bodies if body.name == "cup")
    *walls, floor = cup.shapes
    for wall in walls:
        T = wall.T_body_shape
        inner = T[:2, :2] @ [-wall.size[0] / 2, 0] + T[:2, 3]
        assert np.linalg.norm(inner) == pytest.approx(CUP_DIAMETER / 2)
        rim = T[2, 3] + wall.size[2] / 2
        assert rim - FLOOR == pytest.approx(CUP_DEPTH)
    assert floor.T_body_shape[2, 3] + floor.size[1] / 2 == pytest.approx(FLOOR)


def _moved(steps, *p_world):
    return [replace(step, T_world_tool=pose(p_world) @ step.T_world_tool) for step in steps]


def test_the_bottle_does_not_slip_and_nothing_else_is_touched(demonstrate):
    demonstration = demonstrate()
    assert TASK.achieved(demonstration.success)
    pairs = {pair for step in demonstration.touching for pair in step}
    assert pairs == {("bottle", "cup"), *(("bottle", jaw) for jaw in JAWS)}
    steps = demonstration.steps
    held = int(np.argmax(steps.commanded_gripper < 0.5))
    bottom = np.array(
        [
            (inverse(tool) @ bottle)[:3, 3]
            for tool, bottle in zip(
                steps.measured_Ts_world_tool[:held],
                demonstration.body_Ts_world["bottle"][:held],
                strict=True,
            )
        ]
    )
    assert held > 30
    assert np.abs(bottom - [0, 0, GRIP_HEIGHT]).max() < 0.006
    assert np.ptp(bottom[:, 2]) < 0.002
    # The drive's 60 N are shared by the two jaws.
    assert 20 < np.median(steps.contact_force[1:held]) < 40


@pytest.mark.parametrize(
    ("change", "text"),
    [
        pytest.param(
            lambda steps: [replace(s, gripper=1.0) for s in steps[:3]],
            "jaws only (2|3)[0-9] mm apart",
            id="never let go",
        ),
        pytest.param(
            lambda steps: _moved(steps, 0, 0.055, CUP_DEPTH + 0.01),
            "tilted|beside",
            id="let go over the rim",
        ),
        pytest.param(
            lambda steps: _moved(steps, 0.12, 0, 0),
            "1[12][0-9] mm beside",
            id="stood beside the cup",
        ),
    ],
)
def test_no_other_way_is_a_success(demonstrate, backend, change, text):
    demonstration = demonstrate(change)
    assert not demonstration.success.any()
    assert re.search(text, TASK.failure_reason(backend.observe()))
