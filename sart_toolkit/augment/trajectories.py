"""Executes the trajectories of a dataset to the end of the task, commanded as a policy would."""

from __future__ import annotations

import contextlib
import functools
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import closing
from pathlib import Path
from typing import Any

from sart_toolkit.augment.planner import SegmentPlanner, world_of
from sart_toolkit.augment.rehearsal import Rehearsal
from sart_toolkit.augment.validate import generated_with
from sart_toolkit.backends.interface import BackendFactory
from sart_toolkit.data.dataset import REPLAY, load_dataset
from sart_toolkit.data.records import library_versions
from sart_toolkit.data.result_log import ResultLog
from sart_toolkit.tasks.task import Task
from sart_toolkit.workers import Workers, worker_map


def replay_dataset(
    path: Path,
    task: Task,
    make_backend: BackendFactory,
    workers: int | Workers = 1,
    overwrite: bool = False,
    progress: Callable[[int, int, int], None] | None = None,
) -> dict[str, Any]:
    """Whether a dataset's trajectories lead to the goal; as in `replay.json` in its directory.

    Each starts from the restored state of t*, from where the robot goes out to the sampled pose and
    comes to a rest. From there it is given the trajectory's actions at the rate of a policy, and
    what it measures is compared with what was recorded, through the segment and the demonstration
    to its end. A trajectory that isn't merged ends at t*, so that it has no success to judge.
    Interrupted, it resumes.

    Args:
        path: directory from `sart augment`.
        task: judges the success.
        make_backend: makes the robot in the task's scene; picklable if `workers` > 1.
        workers: how many processes, or `Workers` elsewhere.
        overwrite: replace `replay.json`, and forget what was executed before.
        progress: called with (done, all, failed) after each trajectory.

    Raises:
        MissingFile, BrokenFile: the dataset can't be read.
        MissingCapability: the backend can't restore states, or lacks what success is judged by.
        InvalidInput: `workers` is not positive.
        OutputExists: there is a `replay.json` and `overwrite` is false.
        Mismatch: an execution with another task or backend was interrupted.
        CannotWrite: another process is at work on it, or the disk refuses.
    """
    workers = Workers.of(workers)
    dataset = load_dataset(path)
    make_worker = functools.partial(_Worker, path, task, make_backend)
    with contextlib.ExitStack() as stack:
        worker = stack.enter_context(closing(make_worker()))
        request = {
            "dataset": dataset.content_hash,
            "task": task.name,
            "backend": worker.backend_name,
        }
        log = stack.enter_context(ResultLog(path / REPLAY, request, overwrite))
        run: Callable[[Iterable[int]], Iterator[dict[str, Any]]] = functools.partial(map, worker)
        if not workers.here:
            run = stack.enter_context(worker_map(make_worker, workers))
        rows = {row["index"]: row for row in log.rows}
        failed = sum(row["success"] is False for row in rows.values())
        for row in run([i for i in range(len(dataset)) if i not in rows]):
            log.add(row)
            rows[row["index"]] = row
            failed += row["success"] is False
            if progress is not None:
                progress(len(rows), len(dataset), failed)
        return log.finish(_summary(request, [rows[i] for i in sorted(rows)]))


def _summary(request: Mapping[str, Any], rows: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    judged = [row for row in rows if row["success"] is not None]
    return {
        **request,
        "n_trajectories": len(rows),
        "n_judged": len(judged),
        "n_success": sum(row["success"] for row in judged),
        "failures": dict(Counter(row["kind"] for row in judged if not row["success"])),
        "largest_difference_mm": _largest(rows, "largest_mm"),
        "largest_difference_deg": _largest(rows, "largest_deg"),
        "largest_segment_difference_mm": _largest(rows, "segment_mm"),
        "trajectories": [{k: v for k, v in row.items() if k != "index"} for row in rows],
        "versions": library_versions(),
    }


def _largest(rows: Sequence[Mapping[str, Any]], name: str) -> float | None:
    return max((row[name] for row in rows if row[name] is not None), default=None)


class _Worker:
    """Executes trajectories of a dataset by their numbers."""

    def __init__(self, path: Path, task: Task, make_backend: BackendFactory) -> None:
        self._dataset = load_dataset(path)
        # What each source was generated with.
        self._configs = generated_with(self._dataset)
        self._backend = make_backend()
        try:
            self._rehearsal = Rehearsal(self._backend, task)
        except BaseException:
            self.close()
            raise
        self._planners: dict[int, SegmentPlanner] = {}

    @property
    def backend_name(self) -> str:
        return self._backend.name

    def close(self) -> None:
        self._backend.close()

    def __call__(self, index: int) -> dict[str, Any]:
        entry, episode = self._dataset.index[index], self._dataset.episode(index)
        row = {"index": index, "name": entry.name}
        planner, config = self._planner(entry.source), self._configs[entry.source]
        return row | self._rehearsal(planner, config, episode)

    def _planner(self, source: int) -> SegmentPlanner:
        if source not in self._planners:
            found, config = self._dataset.sources[source], self._configs[source]
            world = world_of(found.demonstration, self._backend.robot, self._backend.scene, config)
            self._planners[source] = SegmentPlanner(world, found.annotation, config, found.number)
        return self._planners[source]
