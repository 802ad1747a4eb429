"""A skill that acts on a real robot, from where it stands, with nobody to reset or judge it."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from sart_toolkit.backends.hardware import HardwareBackend
from sart_toolkit.data.records import Rates, apply_action
from sart_toolkit.errors import MotionRejected, Unreachable
from sart_toolkit.learn.skill import Skill
from sart_toolkit.motion.controller import ToolController
from sart_toolkit.poses import check_positive
from sart_toolkit.robots.model import RobotModel


@dataclass(frozen=True)
class Deployment:
    """What came of it.

    `steps` decisions in `seconds` of the skill's own time; `ended`: why it ended; `decision`,
    `slowest_decision` [s]: how long one took, median and most; `delays` [s]: how old images were,
    by camera; `farthest` [m]: how far the tool came from where it began.
    """

    steps: int
    seconds: float
    ended: str
    decision: float
    slowest_decision: float
    delays: dict[str, float]
    farthest: float


def deploy_skill(
    skill: Skill,
    backend: HardwareBackend,
    seconds: float,
    dry_run: bool = False,
    progress: Callable[[float], None] | None = None,
    reached: Callable[[], bool] | None = None,
) -> Deployment:
    """Let a skill act at its rate, within the limits and stops of the backend.

    Args:
        skill: what acts.
        backend: the robot, at rest where the skill is to begin.
        seconds: for how long, at most, of the skill's own time.
        dry_run: whether its decisions are made and not carried out.
        progress: called with the seconds done.
        reached: asked after each step whether the goal is reached, which ends it.

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
    for _ in range(max(1, round(seconds * record_hz))):
        began = time.perf_counter()
        images = {name: observation.cameras[name].rgb for name in skill.cameras}
        action = skill.act(images, observation.gripper)
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
        if ended == "time is up" and reached is not None and reached():
            ended = "goal reached"
        if ended != "time is up":
            break
    return Deployment(
        len(decisions), len(decisions) / record_hz, ended, float(np.median(decisions)),
        max(decisions), backend.delays, farthest,
    )  # fmt: skip
