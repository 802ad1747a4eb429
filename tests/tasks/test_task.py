"""What every task promises, and the placements that all of them share."""

from __future__ import annotations

import re

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from sart_toolkit.backends import make_backend
from sart_toolkit.errors import InvalidInput, UnknownName
from sart_toolkit.records import RECORD_HZ
from sart_toolkit.robots import get_robot
from sart_toolkit.robots.model import RobotModel
from sart_toolkit.scene.clearance import ClearanceModel
from sart_toolkit.tasks import TASKS, get_task
from sart_toolkit.tasks.task import Placement
from sart_toolkit.teach.scripted import ScriptedOperator
from sart_toolkit.teach.session import SessionConfig, record_demonstration


@pytest.fixture(scope="module", params=TASKS)
def task(request):
    return get_task(request.param)


@pytest.fixture(scope="module")
def model(task):
    return RobotModel(get_robot(task.robot), task.scene.held)


@pytest.fixture(scope="module")
def backend(task):
    backend = make_backend("pybullet", get_robot(task.robot), task.scene, 16)
    yield backend
    backend.close()


def _corners_and_some(task):
    r = task.placement_range
    corners = [Placement(x, y) for x in (-r, r) for y in (-r, r)]
    return corners + [task.sample_placement(np.random.default_rng(i)) for i in range(10)]


def test_the_docstring_is_a_card_with_numbers(task):
    card = type(task).__doc__
    for heading in ("Goal:", "Randomisation:", "Success:"):
        assert heading in card
    for heading in ("Randomisation", "Success"):
        assert re.search(rf"{heading}:[^:]*\d", card), f"{heading} has no number"


def test_it_is_called_as_in_the_table_and_names_parts_of_its_scene(task):
    assert TASKS[task.name].endswith(f":{type(task).__name__}")
    assert task.report_body in {body.name for body in task.scene.bodies}
    assert "overview" in {camera.name for camera in task.scene.cameras}
    assert task.horizon > task.hold > 0


def test_placements_are_uniform_within_range_and_follow_from_the_seed(task):
    rngs = [np.random.default_rng(7), np.random.default_rng(7)]
    drawn = [[task.sample_placement(rng) for _ in range(2000)] for rng in rngs]
    assert drawn[0] == drawn[1]
    r = task.placement_range
    for values in ([p.x for p in drawn[0]], [p.y for p in drawn[0]]):
        assert np.abs(values).max() <= r
        assert stats.kstest(values, stats.uniform(-r, 2 * r).cdf).pvalue > 0.01


def test_the_start_is_reachable_clear_of_contact_and_no_success(task, model, backend):
    gripper = task.initial_state(model, Placement()).gripper
    clearances = ClearanceModel(RobotModel(model.spec, task.scene.held, gripper), task.scene)
    for placement in _corners_and_some(task):
        state = task.initial_state(model, placement)
        assert state.gripper == gripper
        tool = clearances.tool_distances(state.q, state.Ts_world_body)
        assert min(pair.distance for pair in tool.values()) > 0.005
        assert clearances.arm_distance(state.q, state.Ts_world_body).distance > 0
        backend.reset(state)
        for _ in range(3):
            backend.command(state.q, state.gripper)
            backend.step()
            assert backend.contacts() == []
        observation = backend.observe()
        assert not task.success(observation)
        assert task.shortfall(observation)


def test_only_the_reported_body_moves_with_the_placement(task, model):
    middle = task.initial_state(model, Placement())
    moved = task.initial_state(model, Placement(0.02, -0.01, 15.0))
    np.testing.assert_array_equal(middle.q, moved.q)
    for name, T in middle.Ts_world_body.items():
        shift = moved.Ts_world_body[name] - T
        if name == task.report_body:
            np.testing.assert_allclose(shift[:3, 3], [0.02, -0.01, 0], atol=1e-12)
        else:
            assert not shift.any()


def test_the_scripted_operator_succeeds_wherever_the_object_stands(task, model, backend):
    for i, placement in enumerate(_corners_and_some(task)[-10:]):
        stages = task.plan(task.initial_state(model, placement))
        demonstration = record_demonstration(
            backend,
            task,
            model,
            ScriptedOperator(stages, np.random.default_rng(i)),
            placement,
            config=SessionConfig(cameras=()),
        )
        assert len(demonstration) < task.horizon * RECORD_HZ
        assert not demonstration.success[0]
        last = int(0.5 * RECORD_HZ)
        assert demonstration.success[-last:].all(), (i, placement)
        assert demonstration.steps.contact_force[: len(demonstration) // 3].max() == 0


def test_an_unknown_task_is_refused_with_the_nearest_name():
    with pytest.raises(UnknownName, match="did you mean 'peg_in_hole'"):
        get_task("peg-in-hole")
    with pytest.raises(UnknownName, match="choose from"):
        get_task("zzz")


@settings(max_examples=50, deadline=None, derandomize=True)
@given(st.floats(-1, 1), st.floats(-1, 1), st.floats(-180, 180))
def test_a_placement_survives_json_and_is_a_turn_and_shift_on_the_table(x, y, yaw_deg):
    placement = Placement(x, y, yaw_deg)
    assert Placement.from_json(placement.to_json()) == placement
    T = placement.T_middle_object
    np.testing.assert_allclose(T[:3, 3], [x, y, 0])
    np.testing.assert_allclose(T[:3, 2], [0, 0, 1], atol=1e-12)
    np.testing.assert_allclose(np.exp(1j * np.deg2rad(yaw_deg)), complex(*T[:2, 0]), atol=1e-12)


@pytest.mark.parametrize(
    ("value", "message"),
    [
        ({"z": 1.0}, "placement: expected x, y, yaw_deg"),
        ({"x": "far"}, "placement: expected x, y, yaw_deg"),
        ({"x": None}, "placement: expected x, y, yaw_deg"),
        ({"x": float("nan")}, "placement: has a NaN"),
        ({"yaw_deg": float("inf")}, "placement: has a NaN"),
    ],
)
def test_a_bad_placement_is_refused(value, message):
    with pytest.raises(InvalidInput, match=message):
        Placement.from_json(value)
