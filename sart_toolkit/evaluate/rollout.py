"""Seeded rollouts of a skill, the outcome of each, and the first of either outcome for a video."""

from __future__ import annotations

import contextlib
import functools
import logging
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from PIL import Image as PillowImage

from sart_toolkit.backends.interface import (
    Backend,
    BackendFactory,
    Draws,
    Observation,
    Resets,
    missing_abilities,
    require,
)
from sart_toolkit.data.records import (
    DEFAULT_RATES,
    Demonstration,
    Image,
    Rates,
    apply_action,
    library_versions,
)
from sart_toolkit.data.result_log import ResultLog
from sart_toolkit.data.storage import check_writable, replacing
from sart_toolkit.errors import InvalidInput, MotionRejected, Unreachable
from sart_toolkit.evaluate.progress import Progress, progress_along
from sart_toolkit.evaluate.statistics import few_rollouts, wilson_interval
from sart_toolkit.learn.frames import resize_area
from sart_toolkit.learn.skill import Skill, load_skill, skill_hash
from sart_toolkit.motion.controller import ToolController
from sart_toolkit.poses import Array, inverse
from sart_toolkit.robots.model import RobotModel
from sart_toolkit.scenes.appearance import AppearanceConfig, randomise_appearance
from sart_toolkit.tasks.task import Placement, Task
from sart_toolkit.workers import Workers, worker_map

_OVERVIEW, _VIDEO_SIZE, _FINAL_SIZE = "overview", 384, 192
_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Moment:
    """A step of a rollout as cameras saw it: from outside, from the wrist, `seconds` after the
    start, and whether the goal was reached then.
    """

    overview: Image
    wrist: Image
    seconds: float
    success: bool


# Makes a video, at a path, of a rollout's moments at a rate [1/s], its number and its outcome.
Film = Callable[[Path, Sequence[Moment], float, int, Literal["success", "failure"]], object]


@dataclass(frozen=True)
class EvaluateConfig:
    """How a skill is evaluated: number of rollouts, their seed, how many of each outcome to film.

    `yaw_deg`: objects also turn, uniformly within ± this [deg], also farther than the operator
    copes with; `placement_range` [m]: half width of the square that they are placed in, the task's
    own if None; `appearance`: colours, light, camera mounting and distractors differ from rollout
    to rollout so far. `latency` [s]: so late the policy gets images and gripper, whole control
    steps. With `final_images`, what overview and wrist camera saw at the end of each failure is
    kept beside the result.
    """

    episodes: int = 50
    eval_seed: int = 1000
    videos: int = 0
    yaw_deg: float = 0.0
    placement_range: float | None = None
    appearance: AppearanceConfig | None = None
    latency: float = 0.0
    final_images: bool = False

    def __post_init__(self) -> None:
        if not 0 <= self.yaw_deg <= 180:
            raise InvalidInput(f"yaw_deg: expected 0 to 180 deg, got {self.yaw_deg}")
        if self.placement_range is not None and not 0 <= self.placement_range <= 1:
            raise InvalidInput(
                f"placement_range: expected 0 to 1 m, got {self.placement_range}; leave it out for "
                "the task's own"
            )
        if not 0 <= self.latency <= 10:
            raise InvalidInput(f"latency: expected 0 to 10 s, got {self.latency}")
        if self.episodes < 1:
            raise InvalidInput(f"episodes: expected at least 1, got {self.episodes}")
        if self.eval_seed < 0:
            raise InvalidInput(f"eval_seed: expected a whole number >= 0, got {self.eval_seed}")
        if self.videos < 0:
            raise InvalidInput(f"videos: expected at least 0, got {self.videos}")


@dataclass(frozen=True)
class Rollout:
    """One rollout: `success` as `Task.achieved` judges it, `success_any` at any single step.

    `progress`: the furthest waypoint of the demonstration that the tool reached, seen from the
    object, and when; None if it came near to none.
    """

    episode: int
    seed: tuple[int, int]
    placement: Placement
    success: bool
    success_any: bool
    steps: int
    reason: str | None
    progress: Progress | None = None
    record_hz: int = DEFAULT_RATES.record_hz

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
            "progress": self.progress
            and {
                "waypoint": self.progress.waypoint,
                "of": self.progress.n,
                "seconds": self.progress.step / self.record_hz,
            },
        }


def episode_placement(
    task: Task,
    eval_seed: int,
    episode: int,
    yaw_deg: float = 0.0,
    half_width: float | None = None,
) -> Placement:
    """The placement of an episode, drawn from its own generator."""
    rng = np.random.default_rng([eval_seed, episode])
    return task.sample_placement(rng, yaw_deg, half_width)


def run_rollout(
    skill: Skill,
    task: Task,
    backend: Backend,
    model: RobotModel,
    placement: Placement,
    seed: tuple[int, int] = (0, 0),
    watch: Callable[[Observation, int, bool], None] | None = None,
    latency: float = 0.0,
) -> Rollout:
    """Let a skill act from a task's start until success has lasted, or the horizon ends.

    Args:
        skill: what acts.
        task: what it should reach.
        backend: the robot in the task's scene.
        model: the robot's kinematics.
        placement: where the object stands.
        seed: (evaluation seed, episode), for the record.
        watch: called at the start and after each step with what is observed, the number of steps
            done and whether the goal is reached.
        latency: how much earlier than its action is commanded the skill saw what it acts on [s].

    Raises:
        MissingCapability: the backend can't be reset, or lacks what the task's success needs.
        InvalidInput: the backend's control rate is no multiple of the rate that the skill acts at,
            or `latency` is no whole number of its control steps.
    """
    for ability in task.observes:
        require(backend, ability, f"the success of task {task.name!r} is judged by it")
    state = task.initial_state(model, placement)
    require(backend, Resets, "a rollout begins at the task's start").reset(state)
    record_hz = skill.demonstration.rates.record_hz
    rates = Rates(backend.rates.physics_hz, backend.rates.control_hz, record_hz)
    whole, rest = _delay(latency, rates)
    controller = ToolController(model, rates=rates)
    controller.reset(state.q)
    skill.reset()
    reached: list[bool] = []
    achieved = False
    reason = None
    step = 0
    observation = backend.observe(skill.cameras)
    # As long as nothing newer has arrived, the skill sees what was observed first.
    arriving = deque([observation], maxlen=whole + 1)
    path = [(observation.T_world_tool[:3, 3], observation.gripper)]
    if watch is not None:
        watch(observation, step, False)
    while step < round(task.horizon * record_hz):
        seen = arriving[0]
        images = {name: seen.cameras[name].rgb for name in skill.cameras}
        action = skill.act(images, seen.gripper, seen.up)
        desired, gripper = apply_action(controller.commanded_T_world_tool, action)
        try:
            targets = controller.move(desired, observation.T_world_tool, rates.control_per_record)
        except (Unreachable, MotionRejected) as error:
            reason = f"steered out of reach: {str(error).split(':')[0]}"
            break
        for tick, q in enumerate(targets, 1):
            sent = backend.command(q, gripper)
            backend.step()
            if rest and tick == rates.control_per_record - rest:
                arriving.append(backend.observe(skill.cameras))
        controller.acknowledge(sent.q)
        step += 1
        observation = backend.observe(skill.cameras)
        if not rest:
            arriving.append(observation)
        path.append((observation.T_world_tool[:3, 3], observation.gripper))
        reached.append(task.success(observation))
        if watch is not None:
            watch(observation, step, reached[-1])
        achieved = task.achieved(np.array(reached), record_hz)
        if achieved:
            break
    if not achieved and reason is None:
        reason = _shortfall(task, reached, record_hz) or task.failure_reason(observation)
    return Rollout(
        seed[1], seed, placement, achieved, any(reached), step, None if achieved else reason,
        _progress(skill.demonstration, task, model, placement, path), record_hz,
    )  # fmt: skip


def _delay(latency: float, rates: Rates) -> tuple[int, int]:
    """A latency [s] in whole recorded steps, and the control steps that are left.

    Raises:
        InvalidInput: it is no whole number of control steps.
    """
    ticks = round(latency * rates.control_hz)
    if abs(ticks / rates.control_hz - latency) > 1e-3 / rates.control_hz:
        raise InvalidInput(
            f"latency: expected whole control steps of 1/{rates.control_hz} s, got {latency}; "
            f"take {ticks / rates.control_hz:.4f}"
        )
    return divmod(ticks, rates.control_per_record)


def _progress(
    demonstration: Demonstration,
    task: Task,
    model: RobotModel,
    placement: Placement,
    path: Sequence[tuple[Array, float]],
) -> Progress | None:
    """How far tool positions `(3,)` with gripper came along the demonstration, from the object."""
    shown = Placement.from_json(demonstration.task_parameters.get("placement", {}))
    T_object_world, T_shown_world = (
        inverse(task.initial_state(model, at).Ts_world_body[task.report_body])
        for at in (placement, shown)
    )
    steps = demonstration.steps
    done, gripper = zip(*path, strict=True)
    return progress_along(
        steps.measured_Ts_world_tool[:, :3, 3] @ T_shown_world[:3, :3].T + T_shown_world[:3, 3],
        steps.measured_gripper,
        np.array(done) @ T_object_world[:3, :3].T + T_object_world[:3, 3],
        np.array(gripper),
    )


def _shortfall(task: Task, reached: Sequence[bool], record_hz: int) -> str:
    """By how much the goal was reached too late; empty where it isn't reached at the end."""
    held = next((n for n, now in enumerate(reversed(reached)) if not now), len(reached))
    if not held:
        return ""
    return f"goal reached only for the last {held / record_hz:g} s, not for {task.hold:g} s"


@dataclass(frozen=True)
class _Ended:
    """A rollout, and what overview and wrist camera saw at its end, beside each other, if asked."""

    rollout: Rollout
    image: Image | None


class _Worker:
    """Runs episodes of a seed."""

    def __init__(
        self,
        skill_directory: Path,
        task: Task,
        make_backend: BackendFactory,
        config: EvaluateConfig,
        device: str,
    ) -> None:
        self.skill = load_skill(skill_directory, device)
        self.task, self.config = task, config
        self.backend = make_backend()
        self.model = RobotModel(self.backend.robot, self.backend.scene.held)

    def __call__(self, episode: int) -> _Ended:
        last: list[Observation] = []

        def watch(seen: Observation, step: int, success: bool) -> None:
            last[:] = [seen]

        rollout = self.run(episode, watch if self.config.final_images else None)
        failed = bool(last) and not rollout.success
        return _Ended(rollout, self.drawn(last[0]) if failed else None)

    def run(
        self, episode: int, watch: Callable[[Observation, int, bool], None] | None = None
    ) -> Rollout:
        """The rollout of an episode."""
        config, seed = self.config, self.config.eval_seed
        placement = episode_placement(
            self.task, seed, episode, config.yaw_deg, config.placement_range
        )
        if config.appearance is not None:
            rng = np.random.default_rng([seed, episode, 1])
            at = self.task.initial_state(self.model, placement).Ts_world_body
            robot, scene = randomise_appearance(
                self.model.spec, self.task.scene, rng, config.appearance, at
            )
            self.backend.close()
            old = self.backend
            self.backend = type(old)(robot, scene, old.image_size, old.rates)
        return run_rollout(
            self.skill, self.task, self.backend, self.model, placement, (seed, episode), watch,
            config.latency,
        )  # fmt: skip

    def drawn(self, seen: Observation) -> Image:
        """What the overview, if there is one, and the wrist camera see, beside each other."""
        wrist = seen.cameras[self.skill.cameras[0]].rgb
        height, width = wrist.shape[:2]
        views = [resize_area(wrist, (_FINAL_SIZE, round(_FINAL_SIZE * width / height)))]
        if self.seen_from_outside:
            views.insert(0, self.outside(seen, _FINAL_SIZE))
        return np.hstack(views)

    @property
    def seen_from_outside(self) -> bool:
        """Whether the overview can be drawn."""
        return _OVERVIEW in self.backend.cameras and not missing_abilities(self.backend, [Draws])

    def outside(self, seen: Observation, size: int) -> Image:
        """What the overview sees [pixels, square]."""
        # With varied appearance each rollout has a backend of its own.
        backend = self.backend
        state = backend.scene.seen_state(seen.q, seen.gripper, seen.Ts_world_body)
        stage = require(backend, Draws, "rollouts are drawn from outside")
        return stage.draw(state, backend.cameras[_OVERVIEW], size, size).rgb

    def close(self) -> None:
        self.backend.close()


def evaluate_skill(
    skill_directory: Path,
    task: Task,
    make_backend: BackendFactory,
    config: EvaluateConfig | None = None,
    out: Path | None = None,
    workers: int | Workers = 1,
    device: str = "cpu",
    progress: Callable[[int, int, int], None] | None = None,
    film: Film | None = None,
    overwrite: bool = False,
) -> dict[str, Any]:
    """Evaluate a skill on random placements; the result as in `evaluation.json`.

    Neither the number of processes nor running a rollout again for a video changes what the policy
    does: it computes with one thread everywhere. With `out`, finished rollouts are kept beside it
    until all are done: interrupted, it resumes there.

    Args:
        skill_directory: the trained skill.
        task: what it should reach.
        make_backend: makes the robot in the task's scene; picklable if `workers` > 1.
        config: how many rollouts, from which seed.
        out: where `evaluation.json` is written, `videos/` beside it; `None` writes nothing.
        workers: how many processes, or `Workers` elsewhere.
        device: where the policy runs.
        progress: called with (done, wanted, successes) after each rollout.
        film: makes the videos, such as `report.video.film_rollout`.
        overwrite: replace `out`, and forget finished rollouts.

    Raises:
        MissingFile, BrokenFile: the skill can't be read.
        InvalidInput: `workers` is not positive, or videos are wanted without `film` or `out`, or
            final images without `out`.
        OutputExists: `out` is there and `overwrite` is false.
        Mismatch: another evaluation into `out` was interrupted.
        CannotWrite: another process is at work on `out`, or the disk refuses.
    """
    config = config or EvaluateConfig()
    if config.videos and (film is None or out is None):
        raise InvalidInput(
            f"videos: expected 0 without `film` and `out`, got {config.videos}; pass "
            "film=sart_toolkit.film_rollout and where to write"
        )
    if config.final_images and out is None:
        raise InvalidInput("final_images: expected False without `out`; pass where to write")
    workers = Workers.of(workers)
    if out is not None:
        check_writable(out, overwrite)
    make_worker = functools.partial(_Worker, skill_directory, task, make_backend, config, device)
    with contextlib.ExitStack() as stack:
        worker = stack.enter_context(closing(make_worker()))
        log = None
        if out is not None:
            request = _request(skill_directory, task, worker, config)
            log = stack.enter_context(ResultLog(out, request, overwrite))
        run: Callable[[Iterable[int]], Iterator[_Ended]] = functools.partial(map, worker)
        if not workers.here:
            gpu = device != "cpu"
            run = stack.enter_context(worker_map(make_worker, workers, gpu))
        rows = _rows(run, task, config, log, progress, out)
        result = _summary(rows, worker, task, config)
        if out is not None and log is not None:
            if film is not None and config.videos:
                result["videos"] = _videos(result["episodes"], worker, config, out.parent, film)
            log.finish(result)
    return result


def _request(
    skill_directory: Path, task: Task, worker: _Worker, config: EvaluateConfig
) -> dict[str, Any]:
    """What decides a rollout, besides its number."""
    return {
        "verb": "evaluate",
        "skill": skill_hash(skill_directory),
        "task": task.name,
        "robot": worker.backend.robot.name,
        "backend": worker.backend.name,
        "image_size": worker.backend.image_size,
        **{k: v for k, v in asdict(config).items() if k not in ("episodes", "videos")},
    }


def _rows(
    run: Callable[[Iterable[int]], Iterator[_Ended]],
    task: Task,
    config: EvaluateConfig,
    log: ResultLog | None,
    progress: Callable[[int, int, int], None] | None,
    out: Path | None,
) -> list[dict[str, Any]]:
    """The row of each rollout and the seconds that it took; only what isn't in the log is run."""
    rows = {row["episode"]: row for row in log.rows} if log is not None else {}
    wanted = range(config.episodes)
    missing = [episode for episode in wanted if episode not in rows]
    done = len(wanted) - len(missing)
    successes = sum(rows[i]["outcome"] == "success" for i in wanted if i in rows)
    began = time.perf_counter()
    for episode, ended in zip(missing, run(missing), strict=True):
        now = time.perf_counter()
        rollout = ended.rollout
        row = rollout.to_json(task.report_body) | {"seconds": now - began}
        began = now
        if ended.image is not None and out is not None:
            row["final_image"] = f"{out.stem}_failures/{episode:03d}.png"
            with replacing(out.parent / row["final_image"]) as temporary:
                PillowImage.fromarray(ended.image).save(temporary)
        rows[episode] = row
        if log is not None:
            log.add(row)
        done += 1
        successes += rollout.success
        if progress is not None:
            progress(done, len(wanted), successes)
    return [rows[episode] for episode in wanted]


def _summary(
    rows: Sequence[Mapping[str, Any]], worker: _Worker, task: Task, config: EvaluateConfig
) -> dict[str, Any]:
    n, skill = len(rows), worker.skill
    if (warning := few_rollouts(n)) is not None:
        _log.warning(warning)
    now = sum(row["outcome"] == "success" for row in rows)
    ever = sum(row["success_any"] for row in rows)
    return {
        "task": task.name,
        "backend": worker.backend.name,
        "robot": skill.config.robot,
        "policy": skill.config.training.policy,
        "n_episodes": n,
        "n_success": now,
        "success_rate": now / n,
        "ci95": list(wilson_interval(now, n)),
        "n_success_any": ever,
        "success_rate_any": ever / n,
        "ci95_any": list(wilson_interval(ever, n)),
        "seeds": {"eval_seed": config.eval_seed, "episodes": [row["seed"] for row in rows]},
        "seconds": sum(row["seconds"] for row in rows),
        "config": asdict(config),
        "episodes": [{k: v for k, v in row.items() if k != "seconds"} for row in rows],
        "videos": [],
        "versions": library_versions(),
    }


def _videos(
    episodes: Sequence[Mapping[str, Any]],
    worker: _Worker,
    config: EvaluateConfig,
    directory: Path,
    film: Film,
) -> list[dict[str, Any]]:
    """Run the first successes and failures again, seen from outside as well, and film them."""
    if not worker.seen_from_outside:
        _log.warning(
            "no videos: the scene has no camera named %r, or the backend can't draw it", _OVERVIEW
        )
        return []
    rows = []
    outcomes: tuple[Literal["success", "failure"], ...] = ("success", "failure")
    for outcome in outcomes:
        chosen = [row["episode"] for row in episodes if row["outcome"] == outcome]
        for episode in chosen[: config.videos]:
            moments, again = _filmed(worker, episode)
            # What is seen is the run that was filmed, which need not end as the first one did.
            shown: Literal["success", "failure"] = "success" if again.success else "failure"
            name = f"videos/{shown}_{episode:03d}.mp4"
            hz = worker.skill.demonstration.rates.record_hz
            film(directory / name, moments, hz, episode, shown)
            row = {"path": name, "episode": episode, "outcome": shown}
            if shown != outcome:
                _log.warning(
                    "video of episode %d: it was a %s when it was evaluated, and a %s when it was "
                    "run again to be filmed",
                    episode, outcome, shown,
                )  # fmt: skip
                row["evaluated_outcome"] = outcome
            rows.append(row)
    return rows


def _filmed(worker: _Worker, episode: int) -> tuple[list[Moment], Rollout]:
    """What the cameras see when an episode is run again, and how that ends."""
    moments: list[Moment] = []
    hz = worker.skill.demonstration.rates.record_hz

    def watch(seen: Observation, step: int, success: bool) -> None:
        wrist = seen.cameras[worker.skill.cameras[0]].rgb
        view = worker.outside(seen, _VIDEO_SIZE)
        moments.append(Moment(view, wrist, step / hz, success))

    return moments, worker.run(episode, watch)
