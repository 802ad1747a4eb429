"""Carries out a plan: every job once, on any number of workers, each result kept as it comes."""

from __future__ import annotations

import functools
import logging
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from sart_toolkit.benchmark.jobs import Job, jobs_of
from sart_toolkit.benchmark.plans import STAGES, Plan, PlanCell
from sart_toolkit.benchmark.tables import summarise
from sart_toolkit.data.records import library_versions
from sart_toolkit.data.schemas import EvaluationFile, JobFile
from sart_toolkit.data.storage import OutputLock, read_json, remove, write_json
from sart_toolkit.errors import SartError
from sart_toolkit.report.benchmark import write_benchmark_page
from sart_toolkit.workers import Workers, worker_map
from sart_toolkit.workers.parcels import Output

TABLE, CELLS, STORE, PAGE = "benchmark.json", "cells", "stages", "benchmark.html"
_DONE = "job.json"
# Before any was measured: what one of a stage's units takes [s, bytes], on one core.
_USUAL = {
    "record": (3.0, 4e6),
    "suggest": (3.0, 2e4),
    "augment": (0.5, 4e5),
    "train": (4.0, 1e5),
    "evaluate": (2.0, 5e3),
}
_log = logging.getLogger(__name__)

# Carries out a stage: its name, the directory for its result, what it is made from by name, and its
# options; figures to keep.
CarryOut = Callable[[str, Path, Mapping[str, Path], Mapping[str, Any]], Mapping[str, Any]]


@dataclass(frozen=True)
class _Errand:
    """A job for a worker: `inputs` are directories, whose content travels with it."""

    stage: str
    options: Mapping[str, Any]
    inputs: Mapping[str, Path]
    key: str
    size: int


@dataclass(frozen=True)
class _Outcome:
    """Where a job's result is, or why there is none."""

    directory: Path | None
    failure: str = ""


class _Worker:
    """Carries out errands; what fails is said, and doesn't stop the others."""

    def __init__(self, carry_out: CarryOut, store: Output) -> None:
        self._carry_out, self._store = carry_out, store.path

    def __call__(self, errand: _Errand) -> _Outcome:
        directory = self._store / errand.stage / errand.key
        done = directory / _DONE
        started = time.perf_counter()
        try:
            figures = self._carry_out(errand.stage, directory, errand.inputs, errand.options)
        except Exception as error:
            kind = "" if isinstance(error, SartError) else f"{type(error).__name__}: "
            return _Outcome(None, f"{errand.stage}: {kind}{error}")
        seconds = time.perf_counter() - started
        n_bytes = sum(file.stat().st_size for file in directory.rglob("*") if file.is_file())
        write_json(
            done,
            {
                "stage": errand.stage,
                "options": dict(errand.options),
                "size": errand.size,
                "seconds": seconds,
                "bytes": n_bytes,
                "figures": dict(figures),
            },
        )
        return _Outcome(directory)

    def close(self) -> None:
        """Nothing is held."""


class _Store:
    """Results of jobs by stage and key: what is there is not done again."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def directory(self, job: Job) -> Path:
        return self.path / job.stage / job.key

    def done(self, job: Job) -> bool:
        return (self.directory(job) / _DONE).exists()

    def read(self, job: Job) -> dict[str, Any]:
        return read_json(self.directory(job) / _DONE, JobFile)

    def errand(self, job: Job) -> _Errand:
        inputs = {name: self.directory(given) for name, given in job.inputs.items()}
        return _Errand(job.stage, job.options, inputs, job.key, job.size)

    def costs(self) -> dict[str, tuple[float, float]]:
        """What one of each stage's units takes [s, bytes], by the median of those done."""
        costs = dict(_USUAL)
        for stage in STAGES:
            files = sorted(self.path.glob(f"{stage}/*/{_DONE}"))
            rows = [read_json(file, JobFile) for file in files]
            if rows:
                per_unit = [[row[k] / row["size"] for k in ("seconds", "bytes")] for row in rows]
                seconds, n_bytes = np.median(per_unit, axis=0)
                costs[stage] = float(seconds), float(n_bytes)
        return costs


def preview_plan(
    plan: Plan, out: Path, workers: int | Workers = 1, store: Path | None = None
) -> dict[str, Any]:
    """What is done of a plan, and what the rest would take, by what was measured so far.

    `cells`: for each the stages that are missing and their time [s]; `seconds`: of all that is
    missing, shared jobs counted once, on so many workers; `bytes` that it would add.

    Args:
        plan: the plan.
        out: directory of its result.
        workers: how many processes, or `Workers` elsewhere.
        store: directory of the stages' results, `out`/stages if left out.
    """
    kept = _Store(store or out / STORE)
    costs = kept.costs()
    cells: dict[str, Any] = {}
    missing: dict[str, Job] = {}
    for cell in plan.cells:
        left = {s: job for s, job in jobs_of(cell).items() if not kept.done(job)}
        missing |= {job.key: job for job in left.values()}
        seconds = sum(costs[stage][0] * job.size for stage, job in left.items())
        cells[cell.name] = {"missing": list(left), "seconds": seconds}
    total = sum(costs[job.stage][0] * job.size for job in missing.values())
    return {
        "cells": cells,
        "jobs": len(missing),
        "seconds": total / Workers.of(workers).count,
        "bytes": sum(costs[job.stage][1] * job.size for job in missing.values()),
        "measured": [stage for stage in STAGES if costs[stage] != _USUAL[stage]],
    }


def run_plan(
    plan: Plan,
    out: Path,
    carry_out: CarryOut,
    workers: int | Workers = 1,
    store: Path | None = None,
    about: Mapping[str, Any] | None = None,
    progress: Callable[[str, int, int, str], None] | None = None,
) -> dict[str, Any]:
    """The result of a plan, as in `out`/benchmark.json; a file of each cell and a page beside it.

    Cells are in `out`/cells, the page is `out`/benchmark.html. Stage by stage every job that isn't
    done is carried out once, however many cells share it, and kept under its key: called again,
    after an interruption or with another plan and the same store, only what is missing is done. A
    job that fails leaves out its cells and no others.

    Args:
        plan: the plan.
        out: directory to write.
        carry_out: carries out a stage; picklable if there are several workers.
        workers: how many processes, or `Workers` elsewhere; no disk need be shared.
        store: directory of the stages' results, `out`/stages if left out.
        about: what is to be kept with the result: command and machine, say.
        progress: called with "benchmark", the jobs done of how many, and the stage.

    Raises:
        UnknownName: a cell's reference leads to nothing.
        CannotWrite: another process is at work on it, or the disk refuses.
        SartError: a worker process ended unexpectedly.
    """
    out = Path(out)
    kept = _Store(store or out / STORE)
    with OutputLock(out / TABLE):
        jobs = {cell.name: jobs_of(cell) for cell in plan.cells}
        failures: dict[str, str] = {}
        for stage in STAGES:
            _carry_out_stage(stage, jobs, kept, carry_out, workers, failures, progress)
        cells, failed = [], {}
        for cell in plan.cells:
            stages = jobs[cell.name]
            reason = next((failures[j.key] for j in stages.values() if j.key in failures), None)
            path = out / CELLS / f"{cell.name}.json"
            if reason is not None:
                failed[cell.name] = reason
                # Of an earlier time, when it was made from something else.
                remove(path)
                continue
            cells.append(_cell_result(cell, stages, kept, about or {}))
            write_json(path, cells[-1])
        result = {
            "plan": plan.name,
            "about": plan.about,
            "rows": plan.rows,
            "columns": plan.columns,
            "reference": plan.reference,
            "cells": [cell.name for cell in plan.cells if cell.name not in failed],
            "failed": failed,
            "tables": summarise(plan, cells),
            **(about or {}),
            "versions": library_versions(),
        }
        write_json(out / TABLE, result)
        images = {
            name: kept.directory(stages["evaluate"])
            for name, stages in jobs.items()
            if "evaluate" in stages
        }
        write_benchmark_page(result, cells, images, out / PAGE)
    return result


def _carry_out_stage(
    stage: str,
    jobs: Mapping[str, Mapping[str, Job]],
    kept: _Store,
    carry_out: CarryOut,
    workers: int | Workers,
    failures: dict[str, str],
    progress: Callable[[str, int, int, str], None] | None,
) -> None:
    """Do what is missing of a stage; `failures` gets the reason by the key of each that failed."""
    unique = {cell[stage].key: cell[stage] for cell in jobs.values() if stage in cell}
    missing: list[Job] = []
    for job in unique.values():
        reason = next((failures[i.key] for i in job.inputs.values() if i.key in failures), None)
        if reason is not None:
            failures[job.key] = reason
        elif not kept.done(job):
            missing.append(job)
    if not missing:
        return
    workers = Workers.of(workers)
    make_worker = functools.partial(_Worker, carry_out, Output(kept.path))
    gpu = any(job.options.get("device", "cpu") != "cpu" for job in missing)
    n_failed = 0
    if progress is not None:
        progress("benchmark", 0, len(missing), stage)
    with worker_map(make_worker, workers, gpu) as run:
        outcomes = run([kept.errand(job) for job in missing])
        for done, (job, outcome) in enumerate(zip(missing, outcomes, strict=True), 1):
            if outcome.directory is None:
                failures[job.key] = outcome.failure
                n_failed += 1
                _log.warning("%s", outcome.failure)
            if progress is not None:
                text = f"{stage}, {n_failed} failed" if n_failed else stage
                progress("benchmark", done, len(missing), text)


def _cell_result(
    cell: PlanCell, stages: Mapping[str, Job], kept: _Store, about: Mapping[str, Any]
) -> dict[str, Any]:
    """What a cell's file holds."""
    rows = {stage: kept.read(job) for stage, job in stages.items()}
    evaluation = None
    if "evaluate" in stages:
        directory = kept.directory(stages["evaluate"])
        evaluation = read_json(directory / "evaluation.json", EvaluationFile)
    return {
        "name": cell.name,
        "cell": cell.to_json(),
        "keys": {stage: job.key for stage, job in stages.items()},
        "seconds": {stage: row["seconds"] for stage, row in rows.items()},
        "figures": {stage: row["figures"] for stage, row in rows.items()},
        "evaluation": evaluation,
        **about,
    }
