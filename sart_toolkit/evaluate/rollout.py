"""Seeded rollouts of a skill, what came of each, and videos of the first of either outcome."""

from __future__ import annotations

import multiprocessing
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from sart_toolkit.backends.interface import Backend
from sart_toolkit.errors import InvalidInput, MotionRejected, Unreachable
from sart_toolkit.evaluate.statistics import wilson_interval
from sart_toolkit.evaluate.video import Outcome, caption, inset, write_video
from sart_toolkit.learn.skill import Skill, load_skill
from sart_toolkit.motion.controller import ToolController
from sart_toolkit.records import (
    CONTROL_PER_RECORD,
    RECORD_HZ,
    Image,
    apply_action,
    library_versions,
)
from sart_toolkit.robots.model import RobotModel
from sart_toolkit.storage import write_json
from sart_toolkit.tasks.task import Placement, Task

BackendFactory = Callable[[], Backend]
_VIDEO_SIZE = 384


@dataclass(frozen=True)
class EvaluateConfig:
    """How a skill is tried: number of rollouts, their seed, and how many videos of each outcome."""

    episodes: int = 50
    eval_seed: int = 1000
    videos: int = 2

    def __post_init__(self) -> None:
        if self.episodes < 1:
            raise InvalidInput(f"episodes: expected at least 1, got {self.episodes}")
        if self.eval_seed < 0:
            raise InvalidInput(f"eval_seed: expected a whole number >= 0, got {self.eval_seed}")
        if self.videos < 0:
            raise InvalidInput(f"videos: expected at least 0, got {self.videos}")


@dataclass(frozen=True)
class Rollout:
    """One rollout: `outcome` is success when it ended, `success_any` at any time."""

    episode: int
    seed: tuple[int, int]
    placement: Placement
    success: bool
    success_any: bool
    steps: int
    reason: str | None

    def to_json(self, body: str) -> dict[str, Any]:
        """The row of the per-episode table; `body` is what was placed."""
        return {
            "episode": self.episode,
            "seed": list(self.seed),
            "placement": {body: self.placement.to_json()},
            "outcome": "success" if self.success else "failure",
            "success_any": self.success_any,
            "steps": self.steps,
            "reason": self.reason,
        }


def episode_placement(task: Task, eval_seed: int, episode: int) -> Placement:
    """The placement of an episode, drawn from its own generator."""
    return task.sample_placement(np.random.default_rng([eval_seed, episode]))


def run_rollout(
    skill: Skill,
    task: Task,
    backend: Backend,
    model: RobotModel,
    placement: Placement,
    seed: tuple[int, int] = (0, 0),
    watch: Callable[[Image, int, bool], None] | None = None,
) -> Rollout:
    """Let a skill act from a task's start until success has lasted, or the horizon ends.

    Args:
        skill: what acts.
        task: what it should reach.
        backend: the robot in the task's scene.
        model: the robot's kinematics.
        placement: where the object stands.
        seed: (evaluation seed, episode), for the record.
        watch: called at each 10 Hz step with the wrist picture, the step and success so far.
    """
    state = task.initial_state(model, placement)
    backend.reset(state)
    controller = ToolController(model)
    controller.reset(state.q)
    skill.reset()
    held = 0
    success_any = False
    reason = None
    step = 0
    observation = backend.observe((skill.config.camera,))
    while step < round(task.horizon * RECORD_HZ):
        action = skill.act(observation.cameras[skill.config.camera].rgb, observation.gripper)
        desired, gripper = apply_action(controller.commanded_T_world_tool, action)
        try:
            targets = controller.move(desired, observation.T_world_tool, CONTROL_PER_RECORD)
        except (Unreachable, MotionRejected) as error:
            reason = f"steered out of reach: {str(error).split(':')[0]}"
            break
        for q in targets:
            backend.command(q, gripper)
            backend.step()
        step += 1
        observation = backend.observe((skill.config.camera,))
        success = task.success(observation)
        success_any = success_any or success
        held = held + 1 if success else 0
        if watch is not None:
            watch(observation.cameras[skill.config.camera].rgb, step, success)
        if held >= round(task.hold * RECORD_HZ):
            break
    success = task.success(observation)
    if not success and reason is None:
        reason = task.shortfall(observation)
    return Rollout(
        seed[1], seed, placement, success, success_any, step, None if success else reason
    )


class _Worker:
    """Runs episodes; one a process."""

    def __init__(self, skill: Skill, task: Task, make_backend: BackendFactory, seed: int) -> None:
        self.skill, self.task, self.seed = skill, task, seed
        self.backend = make_backend()
        self.model = RobotModel(self.backend.robot, self.backend.scene.held)

    def __call__(
        self, episode: int, watch: Callable[[Image, int, bool], None] | None = None
    ) -> Rollout:
        placement = episode_placement(self.task, self.seed, episode)
        return run_rollout(
            self.skill, self.task, self.backend, self.model, placement, (self.seed, episode), watch
        )


_worker: _Worker | None = None


def _start_worker(skill: Path, task: Task, make_backend: BackendFactory, seed: int) -> None:
    import torch

    # The processes share the cores; a thread pool in each would only make them wait.
    torch.set_num_threads(1)
    global _worker
    _worker = _Worker(load_skill(skill), task, make_backend, seed)


def _work(episode: int) -> Rollout:
    assert _worker is not None
    return _worker(episode)


def evaluate_skill(
    skill_directory: Path,
    task: Task,
    make_backend: BackendFactory,
    config: EvaluateConfig | None = None,
    out: Path | None = None,
    workers: int = 1,
    device: str = "cpu",
    progress: Callable[[int, int, int], None] | None = None,
) -> dict[str, Any]:
    """Try a skill on random placements; the result as in `evaluation.json`.

    Args:
        skill_directory: the trained skill.
        task: what it should reach.
        make_backend: makes the robot in the task's scene; picklable if `workers` > 1.
        config: how many rollouts, from which seed.
        out: where `evaluation.json` is written, `videos/` beside it; `None` writes nothing.
        workers: processes.
        device: where the policy runs if `workers` is 1.
        progress: called with (done, wanted, successes) after each rollout.

    Raises:
        MissingFile, BrokenFile: the skill can't be read.
        InvalidInput: `workers` is not positive.
        CannotWrite: the disk refuses.
    """
    config = config or EvaluateConfig()
    if workers < 1:
        raise InvalidInput(f"workers: expected at least 1, got {workers}")
    skill = load_skill(skill_directory, device)
    started = time.perf_counter()
    probe = make_backend()
    backend = probe.name
    probe.close()
    rollouts: list[Rollout] = []
    for rollout in _rollouts(skill, skill_directory, task, make_backend, config, workers):
        rollouts.append(rollout)
        if progress is not None:
            progress(len(rollouts), config.episodes, sum(r.success for r in rollouts))
    seconds = time.perf_counter() - started
    result = _summary(rollouts, skill, task, backend, config, seconds)
    if out is not None:
        result["videos"] = _videos(rollouts, skill, task, make_backend, config, out.parent)
        write_json(out, result)
    return result


def _rollouts(
    skill: Skill,
    directory: Path,
    task: Task,
    make_backend: BackendFactory,
    config: EvaluateConfig,
    workers: int,
) -> Iterator[Rollout]:
    episodes = range(config.episodes)
    if workers == 1:
        worker = _Worker(skill, task, make_backend, config.eval_seed)
        try:
            yield from map(worker, episodes)
        finally:
            worker.backend.close()
        return
    pool = ProcessPoolExecutor(
        workers,
        multiprocessing.get_context("spawn"),
        _start_worker,
        (directory, task, make_backend, config.eval_seed),
    )
    try:
        yield from pool.map(_work, episodes)
    finally:
        pool.shutdown(cancel_futures=True)


def _summary(
    rollouts: list[Rollout],
    skill: Skill,
    task: Task,
    backend: str,
    config: EvaluateConfig,
    seconds: float,
) -> dict[str, Any]:
    n = len(rollouts)
    now, ever = sum(r.success for r in rollouts), sum(r.success_any for r in rollouts)
    return {
        "task": task.name,
        "backend": backend,
        "robot": skill.config.robot,
        "policy": skill.config.training.policy,
        "n_episodes": n,
        "n_success": now,
        "success_rate": now / n,
        "ci95": list(wilson_interval(now, n)),
        "n_success_any": ever,
        "success_rate_any": ever / n,
        "ci95_any": list(wilson_interval(ever, n)),
        "seeds": {"eval_seed": config.eval_seed, "episodes": [list(r.seed) for r in rollouts]},
        "seconds": seconds,
        "config": asdict(config),
        "episodes": [r.to_json(task.report_body) for r in rollouts],
        "videos": [],
        "versions": library_versions(),
    }


def _videos(
    rollouts: list[Rollout],
    skill: Skill,
    task: Task,
    make_backend: BackendFactory,
    config: EvaluateConfig,
    directory: Path,
) -> list[dict[str, Any]]:
    """Run the first successes and failures again, drawn from outside with the wrist view inset."""
    chosen = [r for r in rollouts if r.success][: config.videos]
    chosen += [r for r in rollouts if not r.success][: config.videos]
    if not chosen or "overview" not in [camera.name for camera in task.scene.cameras]:
        return []
    worker = _Worker(skill, task, make_backend, config.eval_seed)
    rows = []
    try:
        for rollout in chosen:
            outcome: Outcome = "success" if rollout.success else "failure"
            frames = _film(worker, rollout.episode, outcome)
            name = f"videos/{outcome}_{rollout.episode:03d}.mp4"
            write_video(directory / name, frames, RECORD_HZ)
            rows.append({"path": name, "episode": rollout.episode, "outcome": outcome})
    finally:
        worker.backend.close()
    return rows


def _film(worker: _Worker, episode: int, outcome: Outcome) -> list[Image]:
    frames: list[Image] = []

    def watch(wrist: Image, step: int, success: bool) -> None:
        view = worker.backend.observe(("overview",), _VIDEO_SIZE).cameras["overview"].rgb
        detail = "goal reached" if success else ""
        frames.append(caption(inset(view, wrist), episode, step / RECORD_HZ, outcome, detail))

    worker(episode, watch)
    return frames
