"""How alike the backends are: a demonstration's commands replayed on another."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np

from sart_toolkit.benchmark.cells import BLIND, Cell, demonstrate
from sart_toolkit.data.records import Demonstration, library_versions
from sart_toolkit.data.result_log import ResultLog
from sart_toolkit.errors import InvalidInput
from sart_toolkit.record.replay import replay_demonstration, tracking_difference
from sart_toolkit.robots.model import RobotModel


def benchmark_replay(
    cells: Sequence[Cell],
    seed: int,
    out: Path,
    overwrite: bool = False,
    progress: Callable[[int, int], None] | None = None,
) -> dict[str, Any]:
    """What a demonstration's commands do on every other backend, object placed the same.

    For each task a demonstration is recorded on each of its backends and replayed on the others.
    Rows give the greatest difference of the measured tool poses over all recorded steps at which
    neither run's robot, or what it grasps, touched anything else. Finished replays are kept beside
    `out` until all are done: interrupted, it resumes there.

    Args:
        cells: tasks on backends.
        seed: of placement and operator.
        out: JSON file to write.
        overwrite: replace `out`, and forget finished replays.
        progress: called with (done, wanted) after each replay.

    Raises:
        InvalidInput: no task has two backends.
        OutputExists: `out` is there and `overwrite` is false.
        Mismatch: it was interrupted with another seed.
        CannotWrite: the disk refuses.
    """
    pairs = [(a, b) for a, b in itertools.permutations(cells, 2) if a.task.name == b.task.name]
    if not pairs:
        raise InvalidInput("replay: needs two backends to compare, got one; name another")
    demonstrations: dict[str, Demonstration] = {}
    with ResultLog(out, {"benchmark": "replay", "seed": seed}, overwrite) as log:
        found = {_key(row): row for row in log.rows}
        wanted = [(a.task.name, a.backend, b.backend) for a, b in pairs]
        done = sum(key in found for key in wanted)
        for key, (source, target) in zip(wanted, pairs, strict=True):
            if key in found:
                continue
            if source.name not in demonstrations:
                demonstrations[source.name] = _demonstrated(source, seed)
            found[key] = _replayed(demonstrations[source.name], source, target, seed)
            log.add(found[key])
            done += 1
            if progress is not None:
                progress(done, len(pairs))
        rows = [found[key] for key in wanted]
        return log.finish({"seed": seed, "replays": rows, "versions": library_versions()})


def _key(row: Mapping[str, Any]) -> tuple[str, str, str]:
    return row["task"], row["recorded_on"], row["replayed_on"]


def _demonstrated(cell: Cell, seed: int) -> Demonstration:
    rng = np.random.default_rng([seed, 0])
    placement = cell.task.sample_placement(rng)
    with closing(cell.make_backend()) as backend:
        model = RobotModel(backend.robot, backend.scene.held)
        return demonstrate(cell.task, backend, model, placement, rng, BLIND)


def _replayed(original: Demonstration, source: Cell, target: Cell, seed: int) -> dict[str, Any]:
    """The row of a demonstration's replay on another backend."""
    task = source.task
    with closing(target.make_backend()) as backend:
        model = RobotModel(backend.robot, backend.scene.held)
        copy = replay_demonstration(original, backend, task, model, BLIND)
        far, turn, compared = tracking_difference(
            original, copy, backend.scene, backend.robot.gripper.finger_links
        )
        reason = task.failure_reason(backend.observe())
    success = task.achieved(copy.success, copy.rates.record_hz)
    return {
        "task": task.name,
        "recorded_on": source.backend,
        "replayed_on": target.backend,
        "placement": task.sample_placement(np.random.default_rng([seed, 0])).to_json(),
        "recorded_success": task.achieved(original.success, original.rates.record_hz),
        "replayed_success": success,
        "reason": None if success else reason,
        "tool_difference_mm": far * 1e3,
        "tool_difference_deg": float(np.rad2deg(turn)),
        "steps": len(original),
        "steps_compared": compared,
    }
