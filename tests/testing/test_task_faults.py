"""The suite names what is wrong with a task: one fault fails one test, and no other."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

# What is wrong, and the test that must say so.
FAULTS = {
    "PlacedTooFar": "test_a_placement_is_within_its_range",
    "ForgetsTheTable": "test_a_start_is_a_state_of_the_scene",
    "DropsACup": "test_all_is_at_rest_at_the_start",
    "AlwaysSatisfied": "test_the_goal_is_not_reached_at_the_start",
    "PlansForTheMiddle": "test_the_plan_reaches_the_goal_wherever_the_object_stands",
    "PullsItOutAgain": "test_success_lasts_until_the_plan_s_end",
}

# Run with -m slow: some three seconds each.
MORE_FAULTS = {
    "ReportsNoBody": "test_its_attributes_fit_together",
    "Nameless": "test_a_recording_leads_back_to_its_task",
    "HoldsAFunction": "test_it_can_go_to_other_processes",
    "AlwaysTurned": "test_a_placement_is_within_its_range",
    "KnowsOneSquare": "test_a_placement_is_drawn_from_another_square_where_one_is_given",
    "RandomOfItsOwn": "test_placements_follow_from_the_random_numbers_given",
    "SinglePrecision": "test_a_placement_survives_json",
    "TurnedAnyhow": "test_a_turn_beyond_what_the_operator_copes_with_is_refused",
    "NowhereIsTheMiddle": "test_a_placement_that_is_nowhere_is_refused",
    "BeyondTheLimits": "test_the_robot_can_be_at_every_start",
    "OutOfReach": "test_the_robot_can_be_at_every_start",
    "NeverTwiceTheSame": "test_a_start_follows_from_the_placement_alone",
    "Mirrored": "test_the_object_stands_where_the_placement_says",
    "TurnedTheOtherWay": "test_the_object_stands_where_the_placement_says",
    "BeginsPressing": "test_nothing_touches_the_robot_at_the_start",
    "LooksAway": "test_the_robot_s_camera_sees_the_object_at_the_start",
    "WithoutReasons": "test_a_failure_has_a_reason",
    "RemembersSuccess": "test_success_follows_from_the_observation_alone",
    "InAHurry": "test_the_plan_takes_no_longer_than_a_rollout_may",
}

HERE = Path(__file__).parent


def _params(faults: dict[str, str], *marks: pytest.MarkDecorator) -> list[object]:
    return [pytest.param(name, test, marks=marks, id=name) for name, test in faults.items()]


@pytest.fixture(scope="module")
def outcomes(request, run_task_suite):
    """What the suite says of all faults that are to be tested, in one run."""
    asked = {
        item.callspec.params["fault"]
        for item in request.session.items
        if item.path == request.path and "fault" in getattr(item, "fixturenames", ())
    }
    return run_task_suite([f"task_faults:{name}" for name in sorted(asked)])


@pytest.mark.parametrize(
    ("fault", "test"), [*_params(FAULTS), *_params(MORE_FAULTS, pytest.mark.slow)]
)
def test_a_fault_fails_the_one_test_that_names_it(outcomes, fault, test):
    assert set(outcomes[f"task_faults:{fault}"].failed) == {test}


def test_every_broken_task_is_tested_and_every_promise_broken():
    tree = ast.parse((HERE / "task_faults.py").read_text())
    names = {node.name for node in ast.walk(tree) if isinstance(node, ast.ClassDef)}
    assert names == {*FAULTS, *MORE_FAULTS}
    suite = HERE.parents[1] / "sart_toolkit" / "testing" / "test_tasks.py"
    tests = {n.name for n in ast.parse(suite.read_text()).body if isinstance(n, ast.FunctionDef)}
    promises = {name for name in tests if name.startswith("test_")}
    assert promises == {*FAULTS.values(), *MORE_FAULTS.values()}
