"""A skill that acts on a real robot, from where it stands, and a person who judges it."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, Protocol

import numpy as np

from sart_toolkit.backends.hardware import HardwareBackend
from sart_toolkit.data.records import Rates, apply_action, library_versions
from sart_toolkit.data.result_log import ResultLog
from sart_toolkit.errors import InvalidInput, MotionRejected, Unreachable
from sart_toolkit.evaluate.statistics import wilson_interval
from sart_toolkit.learn.skill import Skill
from sart_toolkit.motion.controller import ToolController
from sart_toolkit.motion.interpolator import JointInterpolator
from sart_toolkit.poses import Array, check_positive
from sart_toolkit.robots.model import RobotModel


@dataclass(frozen=True)
class Deployment:
    """What came of it.

    `steps` decisions in `seconds` of the skill's own time; `ended`: why it ended; `decision`,
    `slowest_decision` [s]: how long one took, median and most; `delays` [s]: how old images were,
    by camera; `farthest` [m]: how far the tool came from where it began; `path (k, n)`: the joints
    [rad] at the start and those sent in each control period; `gripper`: its last target.
    """

    steps: int
    seconds: float
    ended: str
    decision: float
    slowest_decision: float
    delays: dict[str, float]
    farthest: float
    path: Array
    gripper: float


def deploy_skill(
    skill: Skill,
    backend: HardwareBackend,
    seconds: float,
    dry_run: bool = False,
    progress: Callable[[float], None] | None = None,
    ask_end: Callable[[], str] | None = None,
) -> Deployment:
    """Let a skill act at its rate, within the limits and stops of the backend.

    Args:
        skill: what acts.
        backend: the robot, at rest where the skill is to begin.
        seconds: for how long, at most, of the skill's own time.
        dry_run: whether its decisions are made and not carried out.
        progress: called with the seconds done.
        ask_end: asked after each step why it is to end there, empty if it is to go on.

    Raises:
        InvalidInput: `seconds` is not positive, or the backend's control rate is no multiple of the
            rate that the skill acts at.
        RobotStopped: the robot stopped.
    """
    check_positive("seconds", seconds, "s")
    record_hz = skill.demonstration.rates.record_hz
    rates = Rates(backend.rates.physics_hz, backend.rates.control_hz, record_hz)
    controller = ToolController(RobotModel(backend.robot, backend.scene.held), rates=rates)
    skill.reset()
    observation = start = backend.observe(skill.cameras)
    controller.reset(observation.q)
    decisions, farthest, ended = list[float](), 0.0, "time is up"
    path, gripper = [start.q], start.gripper
    for _ in range(max(1, round(seconds * record_hz))):
        began = time.perf_counter()
        images = {name: observation.cameras[name].rgb for name in skill.cameras}
        action = skill.act(images, observation.gripper, observation.up)
        decisions.append(time.perf_counter() - began)
        desired, gripper = apply_action(controller.commanded_T_world_tool, action)
        try:
            targets = controller.move(desired, observation.T_world_tool, rates.control_per_record)
        except (Unreachable, MotionRejected) as error:
            ended = f"steered out of reach: {str(error).partition(':')[0]}"
            break
        for q in targets:
            if not dry_run:
                sent = backend.command(q, gripper)
                path.append(sent.q)
                if not np.array_equal(sent.q, q[-1]):
                    controller.reset(sent.q)
                    ended = "steered out of the workspace"
            backend.step()
            if ended != "time is up":
                break
        if dry_run:
            controller.reset(observation.q)
        observation = backend.observe(skill.cameras)
        away = observation.T_world_tool[:3, 3] - start.T_world_tool[:3, 3]
        farthest = max(farthest, float(np.linalg.norm(away)))
        if progress is not None:
            progress(len(decisions) / record_hz)
        if ended == "time is up" and ask_end is not None:
            ended = ask_end() or ended
        if ended != "time is up":
            break
    return Deployment(
        len(decisions), len(decisions) / record_hz, ended, float(np.median(decisions)),
        max(decisions), backend.delays, farthest, np.array(path), gripper,
    )  # fmt: skip


# --- judged by a person -------------------------------------------------------------------------

Verdict = Literal["success", "failure", "again"]
"""What a person says of a trial; "again": it doesn't count, such as one that was set up wrongly."""

# [s] A gripper opens in less, and an arm that lags behind what it was sent has arrived.
_GRIPPER_TIME, _REST_TIME = 1.0, 0.5


class Judge(Protocol):
    """The person beside the robot."""

    def begin(self, trial: int, trials: int, successes: int) -> None:
        """Return when the scene is set up for a trial, counted from 0, and the robot may move."""

    def pressed(self) -> Verdict | None:
        """What the person says while the skill acts, which ends the trial; `None`: nothing yet."""

    def verdict(self, ended: str) -> Verdict:
        """What the person says of a trial that ended by itself."""

    def back(self) -> Literal["closed", "open", "stay"]:
        """Whether the robot goes back the way it came, its gripper as it is or opened, or stays."""


def judge_skill(
    skill: Skill,
    backend: HardwareBackend,
    trials: int,
    seconds: float,
    judge: Judge,
    out: Path,
    request: Mapping[str, Any],
    overwrite: bool = False,
    progress: Callable[[int, int, int], None] | None = None,
) -> dict[str, Any]:
    """How often a skill succeeds on a robot as a person judges it; as `evaluate`'s result.

    Every verdict is kept as it is given: after an interruption, or where the robot stopped, the
    same call goes on with the next trial.

    Args:
        skill: what acts.
        backend: the robot, at rest where the skill is to begin.
        trials: how many count.
        seconds: for how long each lasts at most, of the skill's own time.
        judge: the person.
        out: JSON file to write.
        request: what identifies the evaluation, as JSON values: what is written of it, and compared
            where an interrupted one is resumed.
        overwrite: whether `out` may be replaced.
        progress: called with (done, wanted, successes) after each verdict.

    Raises:
        InvalidInput: `trials` or `seconds` is not positive.
        RobotStopped: the robot stopped.
        OutputExists, Mismatch, CannotWrite: as `ResultLog`.
    """
    if trials < 1:
        raise InvalidInput(f"trials: expected at least 1, got {trials}")
    with ResultLog(out, request, overwrite) as log:
        rows = log.rows[:trials]
        while len(rows) < trials:
            judge.begin(len(rows), trials, _successes(rows))
            said: list[Verdict] = []

            def ask_end(said: list[Verdict] = said) -> str:
                if (verdict := judge.pressed()) is not None:
                    said.append(verdict)
                return "ended by the person" if said else ""

            done = deploy_skill(skill, backend, seconds, ask_end=ask_end)
            verdict = said[0] if said else judge.verdict(done.ended)
            if verdict != "again":
                success = verdict == "success"
                row = {
                    "episode": len(rows), "outcome": verdict, "success_any": success,
                    "steps": done.steps, "reason": None if success else done.ended,
                }  # fmt: skip
                log.add(row)
                rows.append(row)
                if progress is not None:
                    progress(len(rows), trials, _successes(rows))
            way = judge.back()
            if way != "stay":
                go_back(backend, done.path, 0.0 if way == "open" else done.gripper)
        return log.finish(_summary(rows, skill, request))


def _successes(rows: Sequence[Mapping[str, Any]]) -> int:
    return sum(row["outcome"] == "success" for row in rows)


def _summary(
    rows: Sequence[dict[str, Any]], skill: Skill, request: Mapping[str, Any]
) -> dict[str, Any]:
    n, k = len(rows), _successes(rows)
    return {
        "task": request["task"],
        "backend": request["backend"],
        "robot": request["robot"],
        "policy": skill.config.training.policy,
        "n_episodes": n,
        "n_success": k,
        "success_rate": k / n,
        "ci95": list(wilson_interval(k, n)),
        "config": {"judged_by": "a person", "seconds": request["seconds"]},
        "episodes": list(rows),
        "versions": library_versions(),
    }


def go_back(backend: HardwareBackend, path: Array, gripper: float) -> None:
    """Follow a path of joints backwards, from its end where the robot is, to rest at its start.

    Args:
        backend: the robot.
        path: joints `(k, n)` [rad], one a control period.
        gripper: its target, in [0, 1]; it has a second to get there before the robot moves.

    Raises:
        RobotStopped: the robot stopped.
    """
    interpolator = JointInterpolator(RobotModel(backend.robot, backend.scene.held), backend.rates)
    interpolator.reset(path[-1])
    waits, rests = (round(t * backend.rates.control_hz) for t in (_GRIPPER_TIME, _REST_TIME))
    for goal in (*[path[-1]] * waits, *path[-2::-1]):
        backend.command(interpolator.towards(goal), gripper)
        backend.step()
    while not interpolator.settled or rests > 0:
        rests -= interpolator.settled
        backend.command(interpolator.towards(path[0]), gripper)
        backend.step()
