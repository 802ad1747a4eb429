"""A skill acting on an emulated cell."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from sart_toolkit.backends.hardware import without_motion
from sart_toolkit.data.records import DEFAULT_RATES
from sart_toolkit.errors import InvalidInput
from sart_toolkit.evaluate.deploy import deploy_skill
from sart_toolkit.hardware.cell import Limits, Workspace
from sart_toolkit.robots import get_robot
from sart_toolkit.robots.model import RobotModel
from sart_toolkit.scenes.spec import SceneSpec
from sart_toolkit.testing.emulated import EmulatedBackend

ROBOT = get_robot("ur5e_2f85")


class Upwards:
    """Goes back along its tool's axis by 5 mm a step, or more, whatever it sees."""

    cameras = ("wrist",)
    demonstration = SimpleNamespace(rates=DEFAULT_RATES)

    def __init__(self, step=0.005):
        self.step, self.seen = step, []

    def reset(self):
        self.seen.clear()

    def act(self, images, gripper):
        self.seen.append(images["wrist"].shape)
        return np.array([0, 0, -self.step, 0, 0, 0, 0.0])


@pytest.fixture
def make():
    made = []

    def make(kind=EmulatedBackend, **body):
        made.append(type("Cell", (kind,), body)(ROBOT, SceneSpec(()), 32))
        return made[-1]

    yield make
    for backend in made:
        backend.close()


def test_it_acts_at_its_rate_until_its_time_is_up(make):
    backend, skill = make(), Upwards()
    done = deploy_skill(skill, backend, 1.5)
    assert (done.steps, done.seconds, done.ended) == (15, 1.5, "time is up")
    assert len(skill.seen) == 15 and set(skill.seen) == {(32, 32, 3)}
    assert 0.04 < done.farthest < 0.075
    assert done.delays["wrist"] > 0.02 and done.slowest_decision >= done.decision
    assert backend.world.time == pytest.approx(1.5, abs=0.1)


def test_a_dry_run_decides_and_moves_nothing(make):
    backend, skill = make(without_motion(EmulatedBackend)), Upwards()
    done = deploy_skill(skill, backend, 0.5, dry_run=True)
    assert done.steps == len(skill.seen) == 5 and done.farthest < 1e-3
    assert backend.world.sent == []


def test_it_ends_at_the_border_of_the_workspace_or_out_of_reach(make):
    p = RobotModel(ROBOT).fk(ROBOT.home)[:3, 3]
    box = Limits(Workspace(p - 0.06, p + 0.06), speed_scale=1.0)
    done = deploy_skill(Upwards(), make(limits=box), 5.0)
    assert done.ended == "steered out of the workspace" and done.farthest < 0.06
    done = deploy_skill(Upwards(0.02), make(), 20.0)
    assert done.ended.startswith("steered out of reach: ")


def test_it_ends_where_somebody_says_that_the_goal_is_reached(make):
    backend, skill = make(), Upwards()
    done = deploy_skill(skill, backend, 5.0, reached=lambda: len(skill.seen) == 3)
    assert (done.steps, done.ended) == (3, "goal reached")


def test_no_time_at_all_is_refused(make):
    with pytest.raises(InvalidInput, match="seconds: expected a finite number > 0 s, got 0"):
        deploy_skill(Upwards(), None, 0.0)
