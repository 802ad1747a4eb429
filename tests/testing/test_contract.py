"""Our own backends, and the example of one's own, keep the contract."""

from __future__ import annotations

import os

import pytest

from sart_toolkit.backends import BACKENDS, make_backend
from sart_toolkit.errors import MissingExtra
from sart_toolkit.robots import ROBOTS, get_robot
from sart_toolkit.scenes.spec import SceneSpec


def _told(outcome):
    return "\n\n".join(f"{test}: {message}" for test, message in outcome.failed.items())


@pytest.mark.parametrize("robot", ROBOTS)
@pytest.mark.parametrize("backend", BACKENDS)
def test_our_backends_keep_the_whole_contract(run_suite, backend, robot):
    """Nothing is skipped; pictures may be where SART_NO_PICTURES says that nothing can draw."""
    try:
        made = make_backend(backend, get_robot(robot), SceneSpec(()), 8)
    except MissingExtra as error:
        pytest.skip(str(error))
    made.close()
    outcome = run_suite([backend], robot)[backend]
    assert not outcome.failed, _told(outcome)
    if os.environ.get("SART_NO_PICTURES"):
        assert all("renders=False" in reason for reason in outcome.skipped.values())
    else:
        assert outcome.skipped == {}


def test_the_example_of_one_s_own_backend_keeps_what_it_declares(run_suite):
    name = "03_own_backend:KinematicBackend"
    outcome = run_suite([name], "ur5e_2f85")[name]
    assert not outcome.failed, _told(outcome)
    assert outcome.passed > 50
    reasons = {reason.split("declares ")[1] for reason in outcome.skipped.values()}
    assert reasons == {"has_contacts=False", "renders=False"}
