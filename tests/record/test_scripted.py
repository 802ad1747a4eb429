from __future__ import annotations

import numpy as np
import pytest

from sart_toolkit.data.records import DEFAULT_RATES
from sart_toolkit.errors import InvalidInput
from sart_toolkit.record.scripted import OperatorStyle, ScriptedOperator
from sart_toolkit.record.session import record_demonstration
from sart_toolkit.tasks.task import Placement


@pytest.fixture(scope="module")
def plan(peg_task, peg_model):
    return peg_task.plan(peg_task.initial_state(peg_model, Placement()))


@pytest.fixture
def record(make_peg_backend, peg_task, peg_model, plan):
    """Records in a backend of its own, so that nothing carries over."""

    def record(rng, style=None):
        backend = make_peg_backend()
        operator = ScriptedOperator(plan, rng, style)
        demonstration = record_demonstration(backend, peg_task, peg_model, operator)
        backend.close()
        return demonstration

    return record


def test_the_same_rng_gives_the_same_demonstration_to_the_bit(record, peg_demonstration):
    again = record(np.random.default_rng(0))
    assert again.content_hash() == peg_demonstration.content_hash()
    assert again.states == peg_demonstration.states


def test_another_rng_gives_another_demonstration(record, peg_demonstration):
    other = record(np.random.default_rng(1))
    assert other.content_hash() != peg_demonstration.content_hash()
    assert other.success[-1]


def test_speed_is_a_person_s_and_the_end_is_still(peg_demonstration, plan):
    positions = peg_demonstration.steps.measured_Ts_world_tool[:, :3, 3]
    speed = np.linalg.norm(np.diff(positions, axis=0), axis=1) * DEFAULT_RATES.record_hz
    assert speed.max() < 1.3 * max(step.speed for step in plan)
    assert speed[-4:].max() < 0.005
    assert 2.0 < len(peg_demonstration) / DEFAULT_RATES.record_hz < 12.0


def test_without_noise_the_last_leg_s_goal_is_met_within_its_tolerance(record, plan):
    calm = OperatorStyle(tremor=0.0, tremor_deg=0.0, hesitation=0.0)
    demonstration = record(np.random.default_rng(0), calm)
    assert demonstration.content_hash() == record(np.random.default_rng(9), calm).content_hash()
    at = demonstration.steps.measured_Ts_world_tool[-1, :3, 3]
    goal = plan[-1].T_world_tool[:3, 3]
    assert np.linalg.norm(at - goal) < plan[-1].tolerance + 0.001


def test_a_plan_without_a_step_is_refused():
    with pytest.raises(InvalidInput, match="the plan has no step"):
        ScriptedOperator([], np.random.default_rng(0))


@pytest.mark.parametrize("name", ["reaction", "approach", "creep", "tremor_time", "turn_deg"])
@pytest.mark.parametrize("value", [0.0, -1.0, np.nan])
def test_a_style_s_rates_and_times_are_positive(name, value):
    with pytest.raises(InvalidInput, match=f"{name}: expected a finite number > 0"):
        OperatorStyle(**{name: value})


@pytest.mark.parametrize("name", ["tremor", "tremor_deg", "hesitation", "rest"])
@pytest.mark.parametrize("value", [-1.0, np.nan, np.inf])
def test_a_style_s_noise_and_pauses_are_not_negative(name, value):
    with pytest.raises(InvalidInput, match=f"{name}: expected a finite number >= 0"):
        OperatorStyle(**{name: value})
