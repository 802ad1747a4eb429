"""Whether augmentation's segments keep in simulation what is promised of them, by the thousand."""

from __future__ import annotations

import collections
import functools
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from sart_toolkit.annotate.suggest import suggest_annotation
from sart_toolkit.augment.config import AugmentConfig
from sart_toolkit.augment.executors import RestoreExecutor
from sart_toolkit.augment.planner import SegmentPlanner, world_of
from sart_toolkit.backends.interface import Backend
from sart_toolkit.benchmark.cells import WITHOUT_IMAGES, Cell, check_counts, recorded
from sart_toolkit.collision import Source
from sart_toolkit.data.manifest import KEPT, AttemptKey
from sart_toolkit.data.records import (
    Annotation,
    Rates,
    library_versions,
)
from sart_toolkit.data.result_log import ResultLog
from sart_toolkit.errors import InvalidInput, MotionRejected, Unreachable
from sart_toolkit.evaluate.statistics import wilson_interval
from sart_toolkit.motion.path import nearest_on_polyline
from sart_toolkit.motion.timing import Motion
from sart_toolkit.poses import Array
from sart_toolkit.record.session import SessionConfig
from sart_toolkit.robots.model import RobotModel
from sart_toolkit.workers import worker_map

_NOTHING: Mapping[str, Any] = MappingProxyType({})
# Rounding lets a timing that just meets a limit exceed it by less than this fraction.
_ROUNDING = 1e-9


@dataclass(frozen=True)
class SegmentsConfig:
    """How many segments are attempted in all, from which seed, proved clear of what obstacles."""

    count: int = 10_000
    seed: int = 0
    obstacles: Source = "scene"

    def __post_init__(self) -> None:
        check_counts(self, "count")


@dataclass(frozen=True)
class LimitCheck:
    """How a motion compares with the robot's limits, and what is commanded against its path.

    `ratios`: the greatest joint velocity, acceleration and jerk over their limits, at any physics
    step; `violations`: how many of these samples, joints counted singly, exceed theirs. `off` [m]:
    how far the tool is at most from the path at what the backend commands at each physics step.
    """

    ratios: tuple[float, float, float]
    violations: int
    off: float


def check_motion(model: RobotModel, motion: Motion, q_start: Array, rates: Rates) -> LimitCheck:
    """A motion's joint velocities, accelerations and jerks, and its commands, at each physics step.

    Args:
        model: the robot.
        motion: what is commanded, its joints straight between control periods.
        q_start: joints `(n,)` commanded before.
        rates: how often it is commanded, and how often physics moves it.
    """
    spec = model.spec
    limits = np.array([spec.velocity_limits, spec.acceleration_limits, spec.jerk_limits])
    times = np.concatenate([[0.0], motion.times(rates.physics_hz)])
    ratios = np.abs(motion.derivatives(times)) / limits[:, None]
    targets = np.concatenate([q_start[None], motion.joints(motion.times(rates.control_hz))])
    per_target = rates.physics_per_control
    fraction = np.arange(1, per_target + 1)[:, None] / per_target
    commanded = targets[:-1, None] + fraction * np.diff(targets, axis=0)[:, None]
    commanded = commanded.reshape(-1, len(q_start))
    v, a, j = (float(ratio) for ratio in ratios.max((1, 2)))
    violations = int((ratios > 1.0 + _ROUNDING).sum())
    return LimitCheck((v, a, j), violations, tool_off_path(model, motion, commanded, rates))


def tool_off_path(model: RobotModel, motion: Motion, configurations: Array, rates: Rates) -> float:
    """How far [m] the tool is at most from a motion's path, at configurations `(k, n)`."""
    on_path = motion.joints(np.concatenate([[0.0], motion.times(rates.physics_hz)]))
    points = _tool_points(model, configurations)
    off = points - nearest_on_polyline(points, _tool_points(model, on_path))
    return float(np.linalg.norm(off, axis=1).max())


def _tool_points(model: RobotModel, configurations: Array) -> Array:
    return np.array([model.fk(q)[:3, 3] for q in configurations])


class _Segments:
    """Makes attempts of a cell; keeps the last cell's backend, demonstration and spheres."""

    def __init__(self, cells: Sequence[Cell], config: SegmentsConfig) -> None:
        self._cells = {cell.name: cell for cell in cells}
        self._augment = AugmentConfig(seed=config.seed, obstacles=config.obstacles, cameras=())
        self._open: tuple[str, Backend, Annotation, SegmentPlanner, RestoreExecutor] | None = None

    def _opened(self, name: str) -> tuple[Annotation, SegmentPlanner, RestoreExecutor]:
        if self._open is None or self._open[0] != name:
            self.close()
            cell = self._cells[name]
            backend = cell.make_backend()
            try:
                exact = self._augment.obstacles == "scene"
                session = WITHOUT_IMAGES if exact else SessionConfig()
                demonstration = recorded(cell, backend, self._augment.seed, session)
                world = world_of(demonstration, backend.robot, backend.scene, self._augment)
                annotation = suggest_annotation(demonstration, world)
                executor = RestoreExecutor(backend, [(demonstration, annotation)], self._augment)
            except BaseException:
                backend.close()
                raise
            self._open = name, backend, annotation, executor.planner(0), executor
        return self._open[2:]

    def __call__(self, item: tuple[str, int]) -> dict[str, Any]:
        name, number = item
        annotation, planner, executor = self._opened(name)
        k, at = divmod(number, len(annotation.spheres))
        sphere = annotation.spheres[at]
        started = time.perf_counter()
        proposal, rng = planner.proposal(at, k)
        model, demonstration = planner.world.kinematics, planner.world.demonstration
        motion: Motion | None = None
        row: dict[str, Any] = {
            "cell": name,
            "attempt": number,
            "sphere": at,
            "k": k,
            "waypoint": sphere.waypoint,
            "radius": sphere.radius,
            "limited_by": sphere.limited_by,
            "planned": None,
            "measured": None,
        }
        try:
            motion, certificate = planner.plan(proposal, rng)
        except (Unreachable, MotionRejected):
            pass
        else:
            commanded = demonstration.steps.commanded_joint_positions
            found = check_motion(model, motion, commanded[proposal.t_star], demonstration.rates)
            row["planned"] = {
                "clearance": certificate.clearance,
                "duration": motion.duration,
                "lengthened": motion.duration > self._augment.duration,
                **asdict(found),
            }
        attempt = executor.attempt(AttemptKey(0, at, k))
        row["outcome"] = attempt.outcome
        if attempt.episode is not None and motion is not None:
            proof = attempt.episode.provenance.certificate or {}
            row["measured"] = {
                "clearance": proof["measured"]["clearance"],
                "deviation": proof["deviation"],
                "off": tool_off_path(
                    model, motion, attempt.episode.joint_path, demonstration.rates
                ),
            }
        return row | {"wall": time.perf_counter() - started}

    def close(self) -> None:
        if self._open is not None:
            self._open[1].close()
            self._open = None


def benchmark_segments(
    cells: Sequence[Cell],
    config: SegmentsConfig,
    out: Path,
    workers: int = 1,
    overwrite: bool = False,
    progress: Callable[[int, int, int], None] | None = None,
    about: Mapping[str, Any] = _NOTHING,
) -> dict[str, Any]:
    """How augmentation's segments perform in simulation, and whether they keep what they promise.

    For each cell a demonstration of the scripted operator is recorded and spheres are suggested;
    the attempts are shared evenly among the cells, and go round-robin over a cell's spheres. No
    images are taken but those that the obstacles are known from. Finished attempts are kept
    beside `out` until all are done: interrupted, it resumes.

    Args:
        cells: tasks on backends.
        config: how many attempts.
        out: JSON file to write.
        workers: processes.
        overwrite: replace `out`, and forget finished attempts.
        progress: called with (done, wanted, kept) after each attempt.
        about: what else is to stand in the file, such as the command.

    Raises:
        OutputExists: `out` is there and `overwrite` is false.
        Mismatch: it was interrupted with another seed or obstacles, or a demonstration failed.
        InvalidInput: there are fewer attempts than cells.
        MissingCapability: a backend can't restore states.
        CannotWrite: the disk refuses.
    """
    if config.count < len(cells):
        raise InvalidInput(f"count: expected at least {len(cells)}, got {config.count}")
    share, rest = divmod(config.count, len(cells))
    wanted = [(cell.name, i) for n, cell in enumerate(cells) for i in range(share + (n < rest))]
    asked = {"benchmark": "segments", "seed": config.seed, "obstacles": config.obstacles}
    with ResultLog(out, asked, overwrite) as log:
        rows = {(row["cell"], row["attempt"]): row for row in log.rows}
        missing = [item for item in wanted if item not in rows]
        done = len(wanted) - len(missing)
        kept = sum(rows[item]["outcome"] == KEPT for item in wanted if item in rows)
        with worker_map(functools.partial(_Segments, cells, config), workers) as run:
            for item, row in zip(missing, run(missing), strict=True):
                rows[item] = row
                log.add(row)
                done += 1
                kept += row["outcome"] == KEPT
                if progress is not None:
                    progress(done, len(wanted), kept)
        table = {
            cell.name: _segments_summary([rows[item] for item in wanted if item[0] == cell.name])
            for cell in cells
        }
        return log.finish({
            **about,
            "config": asdict(config),
            "total": _segments_totals([rows[item] for item in wanted]),
            "cells": table,
            "versions": library_versions(),
        })  # fmt: skip


def _segments_summary(rows: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """A cell's totals, the same for each of its spheres in short, and what should not have been."""
    spheres = []
    for at in sorted({row["sphere"] for row in rows}):
        here = [row for row in rows if row["sphere"] == at]
        spheres.append({key: here[0][key] for key in ("waypoint", "radius", "limited_by")} | {
            "attempted": len(here),
            "kept": sum(row["outcome"] == KEPT for row in here),
            "rejections": _rejections(here),
        })  # fmt: skip
    alarms = [
        {key: row[key] for key in ("sphere", "k", "waypoint", "outcome")}
        for row in rows
        if _touched(row) or _left(row) or (row["planned"] or {}).get("violations")
    ]
    return _segments_totals(rows) | {"spheres": spheres, "alarms": alarms}


def _segments_totals(rows: Sequence[dict[str, Any]]) -> dict[str, Any]:
    kept = sum(row["outcome"] == KEPT for row in rows)
    planned = [row["planned"] for row in rows if row["planned"] is not None]
    measured = [row["measured"] for row in rows if row["measured"] is not None]
    return {
        "attempted": len(rows),
        "certified": len(planned),
        "kept": kept,
        "kept_rate": kept / len(rows),
        "ci95": list(wilson_interval(kept, len(rows))),
        "rejections": _rejections(rows),
        "contacts": sum(map(_touched, rows)),
        "left_path": sum(map(_left, rows)),
        "least_clearance_mm": _least_mm(planned, "clearance"),
        "least_measured_clearance_mm": _least_mm(measured, "clearance"),
        "deviation_mm": _spread_mm(measured, "deviation"),
        "limits": {
            "motions_that_violate": sum(each["violations"] > 0 for each in planned),
            "greatest_ratio": {
                name: max((each["ratios"][i] for each in planned), default=None)
                for i, name in enumerate(("velocity", "acceleration", "jerk"))
            },
        },
        "commands_off_path_mm": _spread_mm(planned, "off"),
        "measured_off_path_mm": _spread_mm(measured, "off"),
        "lengthened": sum(each["lengthened"] for each in planned),
        "longest_seconds": max((each["duration"] for each in planned), default=None),
        "tries_per_second_and_process": len(rows) / sum(row["wall"] for row in rows),
    }


def _touched(row: Mapping[str, Any]) -> bool:
    return str(row["outcome"]).startswith("contact ")


def _left(row: Mapping[str, Any]) -> bool:
    """Whether the measured path could not be proved clear."""
    return str(row["outcome"]).startswith("left its path")


def _rejections(rows: Sequence[dict[str, Any]]) -> dict[str, int]:
    outcomes = collections.Counter(row["outcome"] for row in rows if row["outcome"] != KEPT)
    return dict(outcomes.most_common())


def _least_mm(rows: Sequence[Mapping[str, float]], key: str) -> float | None:
    return min((row[key] * 1e3 for row in rows), default=None)


def _spread_mm(rows: Sequence[Mapping[str, float]], key: str) -> dict[str, float | None]:
    lengths = [row[key] * 1e3 for row in rows]
    return {
        "median": float(np.median(lengths)) if lengths else None,
        "max": max(lengths, default=None),
    }
