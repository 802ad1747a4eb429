"""Whether augmentation's segments keep in simulation what is promised of them, by the thousand."""

from __future__ import annotations

import collections
import functools
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from sart_toolkit.annotate.suggest import suggest_annotation
from sart_toolkit.augment.config import AugmentConfig
from sart_toolkit.augment.executors import RestoreExecutor
from sart_toolkit.augment.planner import SegmentPlanner, world_of
from sart_toolkit.backends.interface import Backend
from sart_toolkit.benchmark.cells import WITHOUT_IMAGES, Cell, recorded
from sart_toolkit.benchmark.limits import SentTargets
from sart_toolkit.collision import Source
from sart_toolkit.data.manifest import KEPT, AttemptKey
from sart_toolkit.data.records import (
    Annotation,
    library_versions,
)
from sart_toolkit.data.result_log import ResultLog
from sart_toolkit.errors import InvalidInput, MotionRejected, Unreachable
from sart_toolkit.evaluate.statistics import wilson_interval
from sart_toolkit.record.session import SessionConfig
from sart_toolkit.workers import Workers, worker_map

_NOTHING: Mapping[str, Any] = MappingProxyType({})


@dataclass(frozen=True)
class SegmentsConfig:
    """How many segments are attempted in all, from which seeds, proved clear of what obstacles.

    Each seed has a demonstration of its own in every cell, and draws of its own.
    """

    count: int = 10_000
    seeds: tuple[int, ...] = (0,)
    obstacles: Source = "scene"

    def __post_init__(self) -> None:
        if self.count < 1:
            raise InvalidInput(f"count: expected at least 1, got {self.count}")
        object.__setattr__(self, "seeds", tuple(self.seeds))
        if not self.seeds or min(self.seeds) < 0 or len(set(self.seeds)) < len(self.seeds):
            raise InvalidInput(
                f"seeds: expected different whole numbers >= 0, at least one, got {self.seeds}"
            )


class _Segments:
    """Makes attempts of a cell; keeps the last cell's backend, demonstration and spheres."""

    def __init__(self, cells: Mapping[str, tuple[Cell, int]], config: SegmentsConfig) -> None:
        self._cells = cells
        self._augment = AugmentConfig(obstacles=config.obstacles, cameras=())
        self._open: tuple[str, Backend, Annotation, SegmentPlanner, RestoreExecutor] | None = None

    def _opened(self, name: str) -> tuple[Annotation, SegmentPlanner, RestoreExecutor]:
        if self._open is None or self._open[0] != name:
            self.close()
            cell, seed = self._cells[name]
            self._augment = replace(self._augment, seed=seed)
            backend = cell.make_backend()
            try:
                exact = self._augment.obstacles == "scene"
                session = WITHOUT_IMAGES if exact else SessionConfig()
                demonstration = recorded(cell, backend, seed, session)
                world = world_of(demonstration, backend.robot, backend.scene, self._augment)
                annotation = suggest_annotation(demonstration, world)
                executor = RestoreExecutor(backend, [(demonstration, annotation)], self._augment)
            except BaseException:
                backend.close()
                raise
            self._sent = SentTargets(backend)
            self._open = name, backend, annotation, executor.planner(0), executor
        return self._open[2:]

    def __call__(self, item: tuple[str, int]) -> dict[str, Any]:
        name, number = item
        annotation, planner, executor = self._opened(name)
        k, at = divmod(number, len(annotation.spheres))
        sphere = annotation.spheres[at]
        started = time.perf_counter()
        proposal, rng = planner.proposal(at, k)
        demonstration = planner.world.demonstration
        row: dict[str, Any] = {
            "cell": name,
            "attempt": number,
            "sphere": at,
            "k": k,
            "waypoint": sphere.waypoint,
            "radius": sphere.radius,
            "limited_by": sphere.limited_by,
            "planned": None,
            "sent": None,
            "measured": None,
        }
        try:
            motion, certificate = planner.plan(proposal, rng, executor.tracking_error)
        except (Unreachable, MotionRejected):
            pass
        else:
            row["planned"] = {
                "clearance": certificate.clearance,
                "duration": motion.duration,
                "lengthened": motion.duration > planner.duration(proposal),
            }
        attempt = executor.attempt(AttemptKey(0, at, k))
        row["outcome"] = attempt.outcome
        steps, t = demonstration.steps, proposal.t_star
        sent = self._sent.check(steps.joint_positions[t], steps.joint_velocities[t])
        row["sent"] = None if sent is None else asdict(sent)
        if attempt.episode is not None:
            proof = attempt.episode.provenance.certificate or {}
            row["measured"] = {
                "clearance": proof["measured"]["clearance"],
                "deviation": proof["deviation"],
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
    workers: int | Workers = 1,
    overwrite: bool = False,
    progress: Callable[[int, int, int], None] | None = None,
    about: Mapping[str, Any] = _NOTHING,
) -> dict[str, Any]:
    """How augmentation's segments perform in simulation, and whether they keep what they promise.

    For each cell, a task on a backend with a seed, a demonstration of the scripted operator is
    recorded and spheres are suggested; the attempts are shared evenly among the cells, and go
    round-robin over a cell's spheres. What is sent to the joints is held against the robot's
    limits, by finite differences at the physics rate. No images are taken but those that the
    obstacles are known from. Finished attempts are kept beside `out` until all are done:
    interrupted, it resumes.

    Args:
        cells: tasks on backends, each with all of the config's seeds.
        config: how many attempts, and the seeds.
        out: JSON file to write.
        workers: how many processes, or `Workers` elsewhere.
        overwrite: replace `out`, and forget finished attempts.
        progress: called with (done, wanted, kept) after each attempt.
        about: what else is to stand in the file, such as the command.

    Raises:
        OutputExists: `out` is there and `overwrite` is false.
        Mismatch: it was interrupted with other seeds or obstacles, or a demonstration failed.
        InvalidInput: there are fewer attempts than cells.
        MissingCapability: a backend can't restore states.
        CannotWrite: the disk refuses.
    """
    named = {f"{cell.name}/{seed}": (cell, seed) for cell in cells for seed in config.seeds}
    if config.count < len(named):
        raise InvalidInput(f"count: expected at least {len(named)}, got {config.count}")
    share, rest = divmod(config.count, len(named))
    wanted = [(name, i) for n, name in enumerate(named) for i in range(share + (n < rest))]
    asked = {"benchmark": "segments", "seeds": list(config.seeds), "obstacles": config.obstacles}
    with ResultLog(out, asked, overwrite) as log:
        rows = {(row["cell"], row["attempt"]): row for row in log.rows}
        missing = [item for item in wanted if item not in rows]
        done = len(wanted) - len(missing)
        kept = sum(rows[item]["outcome"] == KEPT for item in wanted if item in rows)
        with worker_map(functools.partial(_Segments, named, config), workers) as run:
            for item, row in zip(missing, run(missing), strict=True):
                rows[item] = row
                log.add(row)
                done += 1
                kept += row["outcome"] == KEPT
                if progress is not None:
                    progress(done, len(wanted), kept)
        table = {
            name: _segments_summary([rows[item] for item in wanted if item[0] == name])
            for name in named
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
        if _touched(row) or _left(row) or (row["sent"] or {}).get("violations")
    ]
    return _segments_totals(rows) | {"spheres": spheres, "alarms": alarms}


def _segments_totals(rows: Sequence[dict[str, Any]]) -> dict[str, Any]:
    kept = sum(row["outcome"] == KEPT for row in rows)
    planned = [row["planned"] for row in rows if row["planned"] is not None]
    measured = [row["measured"] for row in rows if row["measured"] is not None]
    sent = [row["sent"] for row in rows if row["sent"] is not None]
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
            "executed": len(sent),
            "targets_sent": sum(each["samples"] for each in sent),
            "motions_that_violate": sum(each["violations"] > 0 for each in sent),
            "greatest_ratio": {
                name: max((each["ratios"][i] for each in sent), default=None)
                for i, name in enumerate(("velocity", "acceleration", "jerk"))
            },
        },
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
