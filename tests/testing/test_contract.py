"""Our own backends, and the example of one's own, keep the contract."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from sart_toolkit.backends import BACKENDS, make_backend
from sart_toolkit.errors import MissingExtra
from sart_toolkit.robots import USUAL_ROBOTS, get_robot
from sart_toolkit.scenes.spec import SceneSpec

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
