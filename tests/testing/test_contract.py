"""Our own backends and tasks, examples and skeletons of one's own, keep the contract."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from sart_toolkit.backends import BACKENDS, DEFAULT_BACKEND, make_backend
from sart_toolkit.bringup.skeleton import make_skeleton, write_source
from sart_toolkit.errors import MissingExtra
from sart_toolkit.robots import USUAL_ROBOTS, get_robot
from sart_toolkit.scenes.spec import SceneSpec
from sart_toolkit.tasks import TASKS

HERE = Path(__file__).parent
EXAMPLES = HERE.parents[1] / "docs" / "examples"


def _summary(outcome):
    return "\n\n".join(f"{test}: {message}" for test, message in outcome.failed.items())


@pytest.mark.parametrize("robot", USUAL_ROBOTS)
@pytest.mark.parametrize("backend", BACKENDS)
def test_our_backends_keep_the_whole_contract(run_suite, backend, robot):
    """Nothing is skipped; images may be where SART_NO_IMAGES says that nothing can draw."""
    try:
        made = make_backend(backend, get_robot(robot), SceneSpec(()), 8)
    except MissingExtra as error:
        pytest.skip(str(error))
    made.close()
    outcome = run_suite([backend], robot)[backend]
    assert not outcome.failed, _summary(outcome)
    if os.environ.get("SART_NO_IMAGES"):
        assert all("lacks images" in reason for reason in outcome.skipped.values())
    else:
        assert outcome.skipped == {}


@pytest.mark.parametrize(
    ("name", "lacking"),
    [
        (EXAMPLES / "07_own_backend.py:Kinematic", {"SensesContacts"}),
        (
            HERE / "core_only.py:CoreOnly",
            {
                "Resets",
                "SavesStates",
                "KnowsBodies",
                "SensesContacts",
                "images: it has no cameras",
            },
        ),
    ],
)
def test_a_backend_with_some_abilities_or_none_keeps_the_rest_of_the_contract(
    run_suite, name, lacking
):
    """The example of one's own backend, and the bare core of it."""
    name = str(name)
    outcome = run_suite([name], "ur5e_2f85")[name]
    assert not outcome.failed, _summary(outcome)
    assert outcome.passed >= 20
    reasons = {reason.split("lacks ")[1] for reason in outcome.skipped.values()}
    assert reasons == lacking


def _written(kind, folder):
    """A skeleton in a file of its own; its reference."""
    out = folder / "skeleton.py"
    new = make_skeleton(kind, "my_own", out)
    write_source(new.text, out)
    return new.reference


def test_a_new_backend_keeps_the_contract_but_for_contacts(run_suite, tmp_path):
    name = _written("backend", tmp_path)
    outcome = run_suite([name], "ur5e_hande")[name]
    assert not outcome.failed, _summary(outcome)
    assert outcome.passed >= 80
    assert {reason.split("lacks ")[1] for reason in outcome.skipped.values()} == {"SensesContacts"}


@pytest.mark.parametrize(
    "backend",
    [
        pytest.param(name, marks=[] if name == DEFAULT_BACKEND else [pytest.mark.slow])
        for name in BACKENDS
    ],
)
def test_our_tasks_and_those_of_one_s_own_keep_the_whole_contract(
    run_task_suite, backend, tmp_path
):
    """Nothing is skipped; images may be where SART_NO_IMAGES says that nothing can draw."""
    names = [*TASKS, _written("task", tmp_path), f"{EXAMPLES / '05_own_task.py'}:Drawer"]
    try:
        make_backend(backend, get_robot("ur5e_2f85"), SceneSpec(()), 8).close()
    except MissingExtra as error:
        pytest.skip(str(error))
    for name, outcome in run_task_suite(names, backend).items():
        assert not outcome.failed, f"{name}: {_summary(outcome)}"
        allowed = bool(os.environ.get("SART_NO_IMAGES"))
        assert all(allowed and "lacks images" in r for r in outcome.skipped.values()), name


def test_a_task_that_only_a_person_can_do_keeps_the_rest_of_the_contract(run_task_suite, tmp_path):
    (tmp_path / "by_hand.py").write_text(
        "from sart_toolkit.tasks.peg_in_hole import PegInHole\n\n\n"
        "class ByHand(PegInHole):\n"
        "    def plan(self, state):\n        return []\n"
    )
    name = f"{tmp_path / 'by_hand.py'}:ByHand"
    outcome = run_task_suite([name])[name]
    assert not outcome.failed, _summary(outcome)
    assert len(outcome.skipped) == 4
    assert set(outcome.skipped.values()) == {"its plan has no step: only a person can do it"}
