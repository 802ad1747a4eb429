"""A skill acting on an emulated cell."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from sart_toolkit.backends.hardware import without_motion
from sart_toolkit.data.records import DEFAULT_RATES
from sart_toolkit.data.schemas import EvaluationFile
from sart_toolkit.data.storage import read_json
from sart_toolkit.errors import InvalidInput, Mismatch, OutputExists, RobotStopped
from sart_toolkit.evaluate.compare import compare_rollouts
from sart_toolkit.evaluate.deploy import deploy_skill, go_back, judge_skill
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
    config = SimpleNamespace(training=SimpleNamespace(policy="upwards"))

    def __init__(self, step=0.005):
        self.step, self.seen = step, []

    def reset(self):
        self.seen.clear()

    def act(self, images, gripper, up):
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


def test_it_ends_where_somebody_says_so(make):
    backend, skill = make(), Upwards()
    done = deploy_skill(skill, backend, 5.0, ask_end=lambda: "enough" * (len(skill.seen) == 3))
    assert (done.steps, done.ended) == (3, "enough")


def test_no_time_at_all_is_refused(make):
    with pytest.raises(InvalidInput, match="seconds: expected a finite number > 0 s, got 0"):
        deploy_skill(Upwards(), None, 0.0)


# --- judged by a person -------------------------------------------------------------------------

REQUEST = {"task": "up", "robot": "ur5e_2f85", "backend": "emulated", "seconds": 1.0}


class Person:
    """Says at which of a trial's steps what it is, or afterwards; then where the robot is to go."""

    def __init__(self, *says, back="closed"):
        self.says, self.way, self.begun, self.asked = list(says), back, [], []

    def begin(self, trial, trials, successes):
        self.begun.append((trial, trials, successes))
        self.step, (self.at, self.what) = 0, self.says.pop(0)
        if self.what == "ctrl-c":
            raise KeyboardInterrupt

    def pressed(self):
        self.step += 1
        return self.what if self.step == self.at else None

    def verdict(self, ended):
        self.asked.append(ended)
        return self.what

    def back(self):
        return self.way


@pytest.fixture
def judged(make, tmp_path):
    def judged(person, trials, backend=None, **options):
        return judge_skill(
            Upwards(), backend or make(), trials, 1.0, person, tmp_path / "trials.json",
            {**REQUEST, **options.pop("request", {})}, **options,
        )  # fmt: skip

    return judged


def test_a_person_s_verdicts_are_the_result(judged, tmp_path):
    person = Person((4, "success"), (None, "failure"), (2, "again"), (None, "success"))
    seen = []
    found = judged(person, 3, progress=lambda *done: seen.append(done))
    assert (found["n_success"], found["n_episodes"]) == (2, 3)
    assert [row["outcome"] for row in found["episodes"]] == ["success", "failure", "success"]
    assert [row["steps"] for row in found["episodes"]] == [4, 10, 10]
    assert [row["reason"] for row in found["episodes"]] == [None, "time is up", None]
    assert person.begun == [(0, 3, 0), (1, 3, 1), (2, 3, 1), (2, 3, 1)]
    assert person.asked == ["time is up", "time is up"]
    assert seen == [(1, 3, 1), (2, 3, 1), (3, 3, 2)]
    read = read_json(tmp_path / "trials.json", EvaluationFile)
    read = read_json(tmp_path / "trials.json", EvaluationFile)
    assert read["n_success"] == 2 and read["ci95"] == found["ci95"]
    assert compare_rollouts(found["episodes"], found["episodes"])["test"] == "barnard"


def test_between_trials_the_robot_goes_back_the_way_it_came(judged, make):
    backend = make()
    starts = []

    class Watching(Person):
        def begin(self, *said):
            starts.append(backend.observe().q)
            super().begin(*said)

    judged(Watching((5, "success"), (None, "failure"), (3, "success")), 3, backend)
    for q in (*starts, backend.observe().q):
        np.testing.assert_allclose(q, ROBOT.home, atol=2e-3)


def test_a_robot_that_stays_is_where_the_trial_ended(judged, make):
    backend = make()
    judged(Person((6, "success"), back="stay"), 1, backend)
    model = RobotModel(ROBOT)
    up = model.fk(backend.observe().q)[:3, 3] - model.fk(ROBOT.home)[:3, 3]
    assert np.linalg.norm(up) > 0.01


def test_the_way_back_is_the_way_there(make):
    backend = make()
    done = deploy_skill(Upwards(0.01), backend, 2.0)
    there = len(backend.world.sent)
    go_back(backend, done.path, 0.0)
    back = [q for _, q in backend.world.sent[there:]]
    assert all(np.abs(done.path - q).max(1).min() < 0.02 for q in back)
    np.testing.assert_allclose(backend.observe().q, done.path[0], atol=2e-3)


def test_the_gripper_opens_before_the_robot_goes_back(make):
    backend = make()
    done = deploy_skill(Upwards(), backend, 0.5)
    for _ in range(backend.rates.control_hz):
        backend.command(done.path[-1], 1.0)
        backend.step()
    assert backend.observe().gripper > 0.9
    go_back(backend, done.path, 0.0)
    assert backend.observe().gripper < 0.1


def test_verdicts_are_kept_and_the_same_call_goes_on(judged, make):
    first = Person((2, "success"), (3, "failure"), (None, "ctrl-c"))
    with pytest.raises(KeyboardInterrupt):
        judged(first, 4)
    with pytest.raises(Mismatch, match="holds results of"):
        judged(Person(), 4, request={"task": "down"})
    second = Person((None, "success"), (1, "success"))
    found = judged(second, 4)
    assert second.begun == [(2, 4, 1), (3, 4, 2)]
    outcomes = [row["outcome"] for row in found["episodes"]]
    assert outcomes == ["success", "failure", "success", "success"]
    with pytest.raises(OutputExists):
        judged(Person(), 4)


def test_a_trial_in_which_the_robot_stopped_does_not_count(judged, make):
    backend = make()

    class Bumping(Person):
        def pressed(self):
            if self.step == 2 and len(self.begun) == 2:
                backend.world.safety_mode = 3
            return super().pressed()

    with pytest.raises(RobotStopped):
        judged(Bumping((2, "success"), (8, "success")), 3, backend)
    again = Person((2, "failure"), (2, "failure"))
    assert judged(again, 3)["n_success"] == 1
    assert again.begun[0] == (1, 3, 1)


def test_no_trials_are_refused(judged):
    with pytest.raises(InvalidInput, match="trials: expected at least 1, got 0"):
        judged(Person(), 0)
