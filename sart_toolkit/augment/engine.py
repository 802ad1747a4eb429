"""Generates datasets: attempts segments until enough are kept, counts the others, and resumes."""

from __future__ import annotations

import dataclasses
import functools
import logging
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, closing
from pathlib import Path
from typing import Any, NamedTuple

from sart_toolkit.augment import get_strategy
from sart_toolkit.augment.allocation import Allocation
from sart_toolkit.augment.config import AugmentConfig
from sart_toolkit.augment.executors import Spare, get_executor, no_spare
from sart_toolkit.backends.interface import Backend, BackendFactory
from sart_toolkit.data.dataset import Dataset, Source
from sart_toolkit.data.manifest import AttemptKey, EpisodeEntry, Rejection
from sart_toolkit.data.records import Annotation, Demonstration
from sart_toolkit.data.writer import DatasetWriter, EpisodeFiles, SphereShare, check_sources
from sart_toolkit.errors import InvalidInput
from sart_toolkit.tasks.task import Task
from sart_toolkit.workers import Workers, worker_map
from sart_toolkit.workers.parcels import Output

_log = logging.getLogger(__name__)


Watch = Callable[[AttemptKey, str], None]
"""Called with each attempt's key and outcome, those before an interruption first."""


class _Result(NamedTuple):
    """What came of an attempt, small enough to go from one process to another.

    `file`: where the kept episode is written.
    """

    key: AttemptKey
    entry: EpisodeEntry | None
    rejection: Rejection
    file: Path | None
    resets: int


class _Worker:
    """Makes attempts for one dataset and writes the kept episodes' files."""

    def __init__(
        self,
        backend: Backend,
        sources: Sequence[tuple[Demonstration, Annotation | None]],
        files: EpisodeFiles,
        config: AugmentConfig,
        ask: Callable[[str], None] | None,
        task: Task | None,
    ) -> None:
        self._backend, self._files = backend, files
        demonstrations = [demonstration for demonstration, _ in sources]
        executor = get_executor(config.execution, backend, demonstrations)
        self._executor = executor(backend, sources, config, ask, task)

    def results(self, keys: Iterable[AttemptKey], spare: Spare = no_spare) -> Iterator[_Result]:
        """The results of attempts, one after the other, in the executor's order."""
        for attempt in self._executor.attempts(keys, spare):
            episode = attempt.episode
            entry = file = None
            if episode is not None:
                entry = dataclasses.replace(self._files.write(episode), seconds=attempt.seconds)
                file = self._files.path / entry.name
            rejection = Rejection(attempt.outcome, attempt.detail, attempt.seconds)
            yield _Result(attempt.key, entry, rejection, file, attempt.resets)

    def __call__(self, key: AttemptKey) -> _Result:
        (result,) = self.results([key])
        return result

    def close(self) -> None:
        self._backend.close()


def _worker_elsewhere(
    make_backend: BackendFactory,
    sources: Sequence[Source],
    out: Output,
    config: AugmentConfig,
    ask: Callable[[str], None] | None,
    task: Task | None,
) -> _Worker:
    """A worker that reads its sources from the dataset's folder, in whatever process it is."""
    files = EpisodeFiles(out.path, [source.number for source in sources])
    pairs = [(source.demonstration, source.annotation) for source in sources]
    return _Worker(make_backend(), pairs, files, config, ask, task)


def augment_demonstration(
    demonstration: Demonstration,
    annotation: Annotation | None,
    make_backend: BackendFactory,
    out: Path,
    config: AugmentConfig | None = None,
    workers: int | Workers = 1,
    overwrite: bool = False,
    progress: Callable[[int, int, int], None] | None = None,
    ask: Callable[[str], None] | None = None,
    task: Task | None = None,
    watch: Watch | None = None,
) -> Dataset:
    """Generate a dataset directory from one demonstration: `augment_sources` of that alone."""
    sources = [(demonstration, annotation)]
    return augment_sources(
        sources, make_backend, out, config, workers, overwrite, progress, ask, task, watch
    )


def augment_sources(
    sources: Sequence[tuple[Demonstration, Annotation | None]],
    make_backend: BackendFactory,
    out: Path,
    config: AugmentConfig | None = None,
    workers: int | Workers = 1,
    overwrite: bool = False,
    progress: Callable[[int, int, int], None] | None = None,
    ask: Callable[[str], None] | None = None,
    task: Task | None = None,
    watch: Watch | None = None,
) -> Dataset:
    """Generate a dataset directory from demonstrations of one task and their annotations.

    The trajectories are allocated to the spheres of all demonstrations; what a sphere can't give
    is asked of the others. Neither the number of workers nor an interruption changes what is
    generated: called again with the same arguments it resumes.

    Args:
        sources: demonstrations, each with its precision spheres, `None` where the strategy needs
            none.
        make_backend: makes the robot in the demonstrations' scene; picklable if `workers` > 1.
        out: directory to write.
        config: what to generate.
        workers: how many processes, or `Workers` elsewhere.
        overwrite: replace what is in `out`.
        progress: called with (kept, wanted, rejected) after each attempt.
        ask: where the robot can't be reset: shows a person what to do, returns when it is done.
        task: what the demonstrations show. Given, and where states can be restored, trajectories
            that begin with something grasped are executed to the end and kept if they reach the
            goal.
        watch: called in this process with each attempt's key and its outcome, "kept" or why it was
            rejected; once `out` holds what came of it, and of those before an interruption first.

    Raises:
        Mismatch: an annotation belongs to another demonstration, the demonstrations to different
            tasks or robots, one holds no saved states, or the backend has other rates.
        MissingCapability: the backend can't do what the executor needs, or take the images.
        UnknownName: no such executor or camera.
        OutputExists: `out` holds something else and `overwrite` is false.
        CannotWrite: the disk refuses, or another process is at work on `out`.
        InvalidInput: no attempt from any sphere was kept, `workers` is not positive or more than
            the executor can use, there is no demonstration, or not fewer than trajectories wanted
            (by a strategy that draws nothing: not as many), or no annotation where one is needed.
    """
    config = config or AugmentConfig()
    # All that can be refused is refused before anything is replaced.
    check_sources(sources)
    workers = Workers.of(workers)
    demonstrations = [demonstration for demonstration, _ in sources]
    allocation = Allocation(sources, config)
    with ExitStack() as stack:
        backends = stack.enter_context(ExitStack())
        backend = backends.enter_context(closing(make_backend()))
        executor = get_executor(config.execution, backend, demonstrations)
        if not workers.here and not executor.parallel:
            raise InvalidInput(
                f"workers: execution {config.execution!r} needs 1 process, got {workers.count} of "
                f"executor {workers.executor!r}"
            )
        if allocation.shares:
            executor.check(backend, demonstrations, config, ask)
        started = time.perf_counter()
        request = _request(backend, config, task)
        writer = stack.enter_context(DatasetWriter(out, sources, request, overwrite))
        if writer.finished is not None:
            return writer.finished
        if workers.here:
            # In its executor's own order.
            worker = _Worker(backend, sources, writer.files, config, ask, task)
            make = worker.results
        else:
            backends.close()
            make_worker = functools.partial(
                _worker_elsewhere, make_backend, writer.sources, Output(writer.path), config, ask,
                task,
            )  # fmt: skip
            run = stack.enter_context(worker_map(make_worker, workers))

            def make(keys: Iterable[AttemptKey], spare: Spare = no_spare) -> Iterator[_Result]:
                return run(keys)

        resumed = writer.n_kept + writer.n_rejected > 0
        resets = _generate(writer, allocation, make, progress, watch)
        # How long an interrupted generation took in all, with how many resets, is not known.
        seconds, counted = (None, None) if resumed else (time.perf_counter() - started, resets)
        return _finish(writer, sources[0][0], config, allocation.shares, seconds, counted)


def _generate(
    writer: DatasetWriter,
    allocation: Allocation,
    make: Callable[[Iterable[AttemptKey], Spare], Iterator[_Result]],
    progress: Callable[[int, int, int], None] | None,
    watch: Watch | None,
) -> int:
    """Have attempts made until no more are needed or none are left; how many resets they took."""
    given: set[AttemptKey] = set()

    def spare(source: int, sphere: int) -> AttemptKey | None:
        """One more attempt from a sphere, if those under way can't be enough."""
        for key in allocation.missing(writer.tally):
            if key[:2] == (source, sphere) and key not in given:
                given.add(key)
                return key
        return None

    if watch is not None:
        for key, outcome in writer.outcomes():
            watch(key, outcome)
    resets = 0
    while keys := allocation.missing(writer.tally):
        given.clear()
        given.update(keys)
        for key, entry, rejection, _, reset in make(keys, spare):
            resets += reset
            if entry is None:
                writer.reject(key, rejection)
            else:
                writer.keep(entry)
            if watch is not None:
                watch(key, rejection.outcome)
            if progress is not None:
                progress(writer.n_kept, allocation.wanted, writer.n_rejected)
    return resets


def _request(backend: Backend, config: AugmentConfig, task: Task | None) -> dict[str, Any]:
    """What decides the episodes, besides the demonstrations and their annotations."""
    return {
        "backend": backend.name,
        "judged_by": None if task is None else task.name,
        "image_size": backend.image_size,
        "config": config.to_json(),
    }


def _finish(
    writer: DatasetWriter,
    demonstration: Demonstration,
    config: AugmentConfig,
    shares: Sequence[SphereShare],
    seconds: float | None,
    resets: int | None,
) -> Dataset:
    wanted = sum(share.wanted or 0 for share in shares)
    if wanted and not writer.n_kept:
        last = writer.last_rejection
        raise InvalidInput(
            f"none of {writer.n_rejected} attempts was kept ({_listed(writer.rejections)}); use "
            "smaller radii or other waypoints"
            + (f"; the last: {last.detail}" if last and last.detail else "")
        )
    for tally in writer.by_sphere(shares):
        if tally["kept"] < tally["wanted"]:
            _log.warning(
                "sphere at waypoint %d of demonstration %d gave %d of %d trajectories (%s)",
                tally["waypoint"], tally["source"], tally["kept"], tally["wanted"],
                _listed(tally["rejections"]),
            )  # fmt: skip
    if writer.n_kept < wanted:
        reasons = _listed(writer.rejections)
        _log.warning("only %d of %d trajectories were kept (%s)", writer.n_kept, wanted, reasons)
    return writer.finish(
        {
            "task": demonstration.task,
            "robot": demonstration.robot,
            "policy": get_strategy(config.strategy).policy,
            "seconds": seconds,
            "simulated_seconds": writer.executed_seconds,
            "resets": resets,
            "config": config.to_json(),
            "references": dict(demonstration.references),
        },
        shares,
    )


def _listed(reasons: Mapping[str, int]) -> str:
    return ", ".join(f"{reason}: {count}" for reason, count in reasons.items())
