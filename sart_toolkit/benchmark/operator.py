"""How well the scripted operator does on each task and backend, and how alike the backends are."""

from __future__ import annotations

import functools
import itertools
import time
from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from sart_toolkit.backends.interface import Backend, BackendFactory
from sart_toolkit.benchmark.result_log import ResultLog
from sart_toolkit.data.records import Demonstration, library_versions
from sart_toolkit.errors import InvalidInput, SartError
from sart_toolkit.evaluate.statistics import wilson_interval
from sart_toolkit.record.replay import replay_demonstration, tracking_difference
from sart_toolkit.record.scripted import ScriptedOperator
from sart_toolkit.record.session import SessionConfig, record_demonstration
from sart_toolkit.robots.model import RobotModel
from sart_toolkit.tasks.task import Placement, Task
from sart_toolkit.workers import worker_map

_BLIND = SessionConfig(cameras=(), keep_states=False)


@dataclass(frozen=True)
class Cell:
    """A task on a backend."""

    task: Task
    backend: str
    make_backend: BackendFactory

    @property
    def name(self) -> str:
        """Both names, as the results have them."""
        return f"{self.task.name}/{self.backend}"


@dataclass(frozen=True)
class BenchmarkConfig:
    """How many episodes each cell gets, from which seed, turned by up to `yaw_deg`."""

    episodes: int = 100
    seed: int = 0
    yaw_deg: float = 0.0

    def __post_init__(self) -> None:
        if self.episodes < 1:
            raise InvalidInput(f"episodes: expected at least 1, got {self.episodes}")
        if self.seed < 0:
            raise InvalidInput(f"seed: expected a whole number >= 0, got {self.seed}")


class _Operator:
    """Lets the scripted operator do an episode of a cell; keeps the last cell's backend open."""

    def __init__(self, cells: Sequence[Cell], config: BenchmarkConfig) -> None:
        self._cells = {cell.name: cell for cell in cells}
        self._config = config
        self._open: tuple[str, Any, RobotModel] | None = None

    def __call__(self, item: tuple[str, int]) -> dict[str, Any]:
        name, episode = item
        cell = self._cells[name]
        if self._open is None or self._open[0] != name:
            self.close()
            backend = cell.make_backend()
            self._open = name, backend, RobotModel(backend.robot, backend.scene.held)
        _, backend, model = self._open
        # The placement doesn't depend on the backend, so the same episodes can be compared.
        rng = np.random.default_rng([self._config.seed, episode])
        placement = cell.task.sample_placement(rng, self._config.yaw_deg)
        started = time.perf_counter()
        row = {"cell": name, "episode": episode, "placement": placement.to_json()}
        try:
            shown = _shown(cell.task, backend, model, placement, rng)
            success = cell.task.achieved(shown.success, shown.rates.record_hz)
            row |= {
                "success": success,
                "seconds": float(shown.timestamps[-1]),
                "force": float(np.nanmax(shown.steps.contact_force)),
                "reason": None if success else cell.task.failure_reason(backend.observe()),
            }
        except SartError as error:
            row |= {"success": False, "seconds": None, "force": None, "reason": str(error)}
        return row | {"wall": time.perf_counter() - started}

    def close(self) -> None:
        if self._open is not None:
            self._open[1].close()
            self._open = None


def benchmark_operator(
    cells: Sequence[Cell],
    config: BenchmarkConfig,
    out: Path,
    workers: int = 1,
    overwrite: bool = False,
    progress: Callable[[int, int, int], None] | None = None,
) -> dict[str, Any]:
    """Success rates of the scripted operator over random placements, cell by cell, without cameras.

    An episode succeeds when the goal is reached at its end and has been for the task's `hold`.
    Finished episodes are kept beside `out` until all are done: interrupted, it goes on there.

    Args:
        cells: tasks on backends.
        config: how many episodes.
        out: JSON file to write.
        workers: processes.
        overwrite: replace `out`, and forget finished episodes.
        progress: called with (done, wanted, successes) after each episode.

    Raises:
        OutputExists: `out` is there and `overwrite` is false.
        Mismatch: it was interrupted with another seed or yaw.
        InvalidInput: a task's objects can't be turned so far.
        CannotWrite: the disk refuses.
    """
    for cell in cells:
        cell.task.sample_placement(np.random.default_rng(config.seed), config.yaw_deg)
    log = ResultLog(out, {"seed": config.seed, "yaw_deg": config.yaw_deg}, overwrite)
    rows = {(row["cell"], row["episode"]): row for row in log.rows}
    wanted = [(cell.name, i) for cell in cells for i in range(config.episodes)]
    missing = [item for item in wanted if item not in rows]
    done = len(wanted) - len(missing)
    successes = sum(rows[item]["success"] for item in wanted if item in rows)
    with worker_map(functools.partial(_Operator, cells, config), workers) as run:
        for item, row in zip(missing, run(missing), strict=True):
            rows[item] = row
            log.add(row)
            done += 1
            successes += row["success"]
            if progress is not None:
                progress(done, len(wanted), successes)
    table = {
        cell.name: _summary([rows[cell.name, i] for i in range(config.episodes)]) for cell in cells
    }
    return log.finish({"config": asdict(config), "cells": table, "versions": library_versions()})


def _summary(rows: Sequence[dict[str, Any]]) -> dict[str, Any]:
    n, successes = len(rows), sum(row["success"] for row in rows)
    ended = [row for row in rows if row["seconds"] is not None]
    return {
        "n_success": successes,
        "n_episodes": n,
        "success_rate": successes / n,
        "ci95": list(wilson_interval(successes, n)),
        "median_seconds": float(np.median([row["seconds"] for row in ended])) if ended else None,
        "median_force": float(np.median([row["force"] for row in ended])) if ended else None,
        "simulated_over_wall": sum(row["seconds"] for row in ended)
        / sum(row["wall"] for row in rows),
        "failures": [
            {k: row[k] for k in ("episode", "placement", "reason")}
            for row in rows
            if not row["success"]
        ],
    }


def benchmark_replay(
    cells: Sequence[Cell],
    seed: int = 0,
    progress: Callable[[int, int], None] | None = None,
) -> dict[str, Any]:
    """What a demonstration's commands do on every other backend, object placed the same.

    For each task a demonstration is recorded on each of its backends and replayed on the others.
    Rows tell the greatest difference of the measured tool poses over all recorded steps at which
    neither run's robot, or what it carries, touched anything else.

    Args:
        cells: tasks on backends.
        seed: of placement and operator.
        progress: called with (done, wanted) after each replay.

    Raises:
        InvalidInput: no task has two backends.
    """
    pairs = [(a, b) for a, b in itertools.permutations(cells, 2) if a.task.name == b.task.name]
    if not pairs:
        raise InvalidInput("replay: needs two backends to compare, got one; name another")
    shown: dict[str, Demonstration] = {}
    rows = []
    for done, (source, target) in enumerate(pairs, 1):
        task = source.task
        rng = np.random.default_rng([seed, 0])
        placement = task.sample_placement(rng)
        if source.name not in shown:
            with closing(source.make_backend()) as backend:
                model = RobotModel(backend.robot, backend.scene.held)
                shown[source.name] = _shown(task, backend, model, placement, rng)
        original = shown[source.name]
        with closing(target.make_backend()) as backend:
            model = RobotModel(backend.robot, backend.scene.held)
            copy = replay_demonstration(original, backend, task, model, _BLIND)
            far, turn, compared = tracking_difference(
                original, copy, backend.scene, backend.robot.gripper.finger_links
            )
            reason = task.failure_reason(backend.observe())
        success = task.achieved(copy.success, copy.rates.record_hz)
        rows.append(
            {
                "task": task.name,
                "recorded_on": source.backend,
                "replayed_on": target.backend,
                "placement": placement.to_json(),
                "recorded_success": task.achieved(original.success, original.rates.record_hz),
                "replayed_success": success,
                "reason": None if success else reason,
                "tool_difference_mm": far * 1e3,
                "tool_difference_deg": float(np.rad2deg(turn)),
                "steps": len(original),
                "steps_compared": compared,
            }
        )
        if progress is not None:
            progress(done, len(pairs))
    return {"seed": seed, "replays": rows, "versions": library_versions()}


def _shown(
    task: Task, backend: Backend, model: RobotModel, placement: Placement, rng: np.random.Generator
) -> Demonstration:
    """The scripted operator's demonstration, without pictures."""
    operator = ScriptedOperator(task.plan(task.initial_state(model, placement)), rng)
    return record_demonstration(backend, task, model, operator, placement, config=_BLIND)
