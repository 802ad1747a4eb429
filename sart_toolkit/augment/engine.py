"""Generates datasets: tries segments until enough are kept, counts the others, and resumes."""

from __future__ import annotations

import collections
import dataclasses
import functools
import json
import logging
import time
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import Any

from sart_toolkit.augment.config import AugmentConfig
from sart_toolkit.augment.executors import KEPT, SegmentMaker
from sart_toolkit.backends.interface import BackendFactory
from sart_toolkit.data.records import (
    Annotation,
    Dataset,
    Demonstration,
    library_versions,
)
from sart_toolkit.data.storage import (
    annotation_to_json,
    append_json_line,
    clear_directory,
    episode_name,
    load_annotation,
    load_dataset,
    load_demonstration,
    load_episode,
    read_json,
    read_json_lines,
    save_annotation,
    save_demonstration,
    save_episode,
    write_json,
    write_text,
)
from sart_toolkit.errors import (
    BrokenFile,
    InvalidInput,
    Mismatch,
    MissingCapability,
    OutputExists,
    unknown_name,
)
from sart_toolkit.workers import worker_map

_log = logging.getLogger(__name__)
_LOG = "attempts.jsonl"
_LEAST_ATTEMPTS = 20
_ATTEMPTS_PER_EPISODE = 10


class _Worker:
    """Makes tries (sphere, k) and writes the kept episodes of one dataset directory."""

    def __init__(
        self, make_backend: BackendFactory, directory: Path, config: AugmentConfig
    ) -> None:
        self._directory = directory
        self._backend = make_backend()
        self._try = SegmentMaker(
            self._backend,
            load_demonstration(directory / "demo.h5"),
            load_annotation(directory / "annotation.json"),
            config,
        )

    def __call__(self, at: tuple[int, int]) -> tuple[int, int, str, str]:
        sphere, k = at
        attempt = self._try(sphere, k)
        if attempt.episode is not None:
            save_episode(self._directory / "episodes" / episode_name(sphere, k), attempt.episode)
        return sphere, k, attempt.outcome, attempt.detail

    def close(self) -> None:
        self._backend.close()


def augment_demonstration(
    demonstration: Demonstration,
    annotation: Annotation,
    make_backend: BackendFactory,
    out: Path,
    config: AugmentConfig | None = None,
    workers: int = 1,
    overwrite: bool = False,
    progress: Callable[[int, int, int], None] | None = None,
) -> Dataset:
    """Generate a dataset directory from a demonstration and its annotation.

    Neither the number of workers nor an interruption changes what is generated: called again with
    the same arguments it goes on where it was.

    Args:
        demonstration: what was shown.
        annotation: its precision spheres.
        make_backend: makes the robot in the demonstration's scene; picklable if `workers` > 1.
        out: directory to write.
        config: what to generate.
        workers: processes.
        overwrite: replace what is in `out`.
        progress: called with (kept, wanted, rejected) after each try.

    Raises:
        Mismatch: the annotation belongs to another demonstration.
        MissingCapability: the backend can't restore states or render.
        OutputExists: `out` holds something else and `overwrite` is false.
        CannotWrite: the disk refuses.
        InvalidInput: no try from any sphere was kept, or `workers` is not positive.
    """
    config = config or AugmentConfig()
    out = Path(out)
    annotation.check_matches(demonstration)
    if not demonstration.states:
        raise Mismatch(
            "the demonstration holds no saved states; record it on a backend that can restore"
        )
    started = time.perf_counter()
    request = {
        "config": dataclasses.asdict(config),
        "demonstration": demonstration.content_hash(),
        "annotation": annotation_to_json(annotation),
    }
    # All that can be refused is refused before anything is replaced.
    if workers < 1:
        raise InvalidInput(f"workers: expected at least 1, got {workers}")
    _check_capable(make_backend, config.camera)
    finished = _prepare(out, request, demonstration, annotation, overwrite)
    if finished is not None:
        return finished
    outcomes = _read_attempts(out)
    quotas = config.quotas([sphere.radius for sphere in annotation.spheres])
    last = ""
    with worker_map(functools.partial(_Worker, make_backend, out, config), workers) as run:
        while batch := _next_batch(outcomes, quotas):
            for sphere, k, outcome, detail in run(batch):
                outcomes[sphere, k] = outcome
                row = {"sphere": sphere, "k": k, "outcome": outcome}
                append_json_line(out / _LOG, row | ({"detail": detail} if detail else {}))
                last = detail or last
                if progress is not None:
                    kept = sum(o == KEPT for o in outcomes.values())
                    progress(kept, config.n - 1, len(outcomes) - kept)
    return _finish(out, outcomes, request, time.perf_counter() - started, last)


def _prepare(
    out: Path,
    request: dict[str, Any],
    demonstration: Demonstration,
    annotation: Annotation,
    overwrite: bool,
) -> Dataset | None:
    """Set the directory up; the dataset itself if it is already whole."""
    if (out / "request.json").exists() and not overwrite:
        if read_json(out / "request.json") != json.loads(json.dumps(request)):
            raise OutputExists(
                f"{out}: holds a dataset made with other settings; add --overwrite or choose "
                "another --out"
            )
        if (out / "dataset.json").exists():
            return load_dataset(out)
    else:
        clear_directory(out, "request.json", overwrite)
        # First of all, so that an interruption from here on leaves a directory to go on in.
        write_json(out / "request.json", request)
    save_demonstration(out / "demo.h5", demonstration)
    save_annotation(out / "annotation.json", annotation)
    (out / "episodes").mkdir(exist_ok=True)
    return None


def _read_attempts(out: Path) -> dict[tuple[int, int], str]:
    """Outcomes noted before an interruption; a try whose line or file was cut is made again."""
    outcomes: dict[tuple[int, int], str] = {}
    for row in read_json_lines(out / _LOG):
        at = row["sphere"], row["k"]
        if row["outcome"] == KEPT:
            try:
                load_episode(out / "episodes" / episode_name(*at))
            except (BrokenFile, FileNotFoundError):
                continue
        outcomes[at] = row["outcome"]
    # Written anew: a further line must not join one that was cut.
    rows = [{"sphere": s, "k": k, "outcome": o} for (s, k), o in outcomes.items()]
    write_text(out / _LOG, "".join(json.dumps(row) + "\n" for row in rows))
    return outcomes


def _next_batch(outcomes: dict[tuple[int, int], str], quotas: list[int]) -> list[tuple[int, int]]:
    """The tries still needed, no more than can all be kept; spheres that give up are left out."""
    batch = []
    for sphere, quota in enumerate(quotas):
        tried = {k: o for (s, k), o in outcomes.items() if s == sphere}
        kept = sum(o == KEPT for o in tried.values())
        limit = max(_LEAST_ATTEMPTS, _ATTEMPTS_PER_EPISODE * quota)
        missing = [k for k in range(limit) if k not in tried]
        batch += [(sphere, k) for k in missing[: quota - kept]]
    return sorted(batch, key=lambda at: (at[1], at[0]))


def _check_capable(make_backend: BackendFactory, camera: str | None) -> None:
    with closing(make_backend()) as backend:
        can = backend.capabilities
        if camera is not None and camera not in backend.cameras:
            raise unknown_name("camera", camera, backend.cameras)
        if not (can.can_restore and (camera is None or can.renders)):
            raise MissingCapability(
                f"backend {backend.name!r} can't restore states and render, which augmentation "
                "needs; use another backend"
            )


def _finish(
    out: Path,
    outcomes: dict[tuple[int, int], str],
    request: dict[str, Any],
    seconds: float,
    last: str,
) -> Dataset:
    kept = sorted((k, s) for (s, k), outcome in outcomes.items() if outcome == KEPT)
    reasons = collections.Counter(o for o in outcomes.values() if o != KEPT)
    if not kept:
        raise InvalidInput(
            f"none of {len(outcomes)} tries was kept ({_counted(reasons)}); use smaller radii or "
            "other waypoints" + (f"; the last: {last}" if last else "")
        )
    wanted = request["config"]["n"] - 1
    if len(kept) < wanted:
        _log.warning(
            "only %d of %d trajectories were kept (%s)", len(kept), wanted, _counted(reasons)
        )
    names = [episode_name(s, k) for k, s in kept]
    demonstration = load_demonstration(out / "demo.h5")
    annotation = load_annotation(out / "annotation.json")
    episodes = tuple(load_episode(out / "episodes" / name) for name in names)
    dataset = Dataset(demonstration, annotation, episodes)
    info = {
        "n_trajectories": len(kept) + 1,
        "n_kept": len(kept),
        "n_attempted": len(outcomes),
        "rejections": dict(sorted(reasons.items())),
        "by_sphere": [
            _tally(sphere.waypoint, [o for (s, _), o in outcomes.items() if s == i])
            for i, sphere in enumerate(annotation.spheres)
        ],
        "least_clearance_m": min(
            float((episode.provenance.certificate or {})["commanded"]["clearance"])
            for episode in episodes
        ),
        "seconds": seconds,
        "simulated_seconds": len(outcomes) * request["config"]["duration"],
        "config": request["config"],
        "references": dict(demonstration.references),
        "content_hash": dataset.content_hash(),
        "versions": library_versions(),
        "episodes": names,
    }
    write_json(out / "dataset.json", info)
    return dataclasses.replace(dataset, info=info)


def _tally(waypoint: int, outcomes: list[str]) -> dict[str, Any]:
    """How the tries from one sphere ended."""
    reasons = collections.Counter(outcome for outcome in outcomes if outcome != KEPT)
    return {
        "waypoint": waypoint,
        "kept": len(outcomes) - reasons.total(),
        "rejections": dict(sorted(reasons.items())),
    }


def _counted(reasons: collections.Counter[str]) -> str:
    return ", ".join(f"{reason}: {count}" for reason, count in reasons.items())
