"""How well the scripted operator does on each task and backend."""

from __future__ import annotations

import functools
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from sart_toolkit.benchmark.cells import BLIND, Cell, check_counts, demonstrate
from sart_toolkit.data.records import library_versions
from sart_toolkit.data.result_log import ResultLog
from sart_toolkit.errors import SartError
from sart_toolkit.evaluate.statistics import wilson_interval
from sart_toolkit.robots.model import RobotModel
from sart_toolkit.workers import Workers, worker_map


@dataclass(frozen=True)
class BenchmarkConfig:
    """How many episodes each cell gets, from which seed, turned by up to `yaw_deg`."""

    episodes: int = 100
    seed: int = 0
    yaw_deg: float = 0.0

    def __post_init__(self) -> None:
        check_counts(self, "episodes")


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
            demonstration = demonstrate(cell.task, backend, model, placement, rng, BLIND)
            success = cell.task.achieved(demonstration.success, demonstration.rates.record_hz)
            row |= {
                "success": success,
                "seconds": float(demonstration.timestamps[-1]),
                "force": float(np.nanmax(demonstration.steps.contact_force)),
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
    workers: int | Workers = 1,
    overwrite: bool = False,
    progress: Callable[[int, int, int], None] | None = None,
) -> dict[str, Any]:
    """Success rates of the scripted operator over random placements, cell by cell, without cameras.

    An episode succeeds when the goal is reached at its end and has been for the task's `hold`.
    Finished episodes are kept beside `out` until all are done: interrupted, it resumes there.

    Args:
        cells: tasks on backends.
        config: how many episodes.
        out: JSON file to write.
        workers: how many processes, or `Workers` elsewhere.
        overwrite: replace `out`, and forget finished episodes.
        progress: called with (done, wanted, successes) after each episode.

    Raises:
        OutputExists: `out` is there and `overwrite` is false.
        Mismatch: it was interrupted with another seed or yaw.
        InvalidInput: a task's objects can't be turned so far.
        CannotWrite: the disk refuses.
    """
    for cell in cells:
        cell.task.check_operable(config.yaw_deg)
    with ResultLog(out, {"seed": config.seed, "yaw_deg": config.yaw_deg}, overwrite) as log:
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
            cell.name: _summary([rows[cell.name, i] for i in range(config.episodes)])
            for cell in cells
        }
        return log.finish(
            {"config": asdict(config), "cells": table, "versions": library_versions()}
        )


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
