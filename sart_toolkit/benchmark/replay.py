"""How alike the backends are: a demonstration's commands replayed on another."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from contextlib import closing
from typing import Any

import numpy as np

from sart_toolkit.benchmark.cells import BLIND, Cell, demonstrate
from sart_toolkit.data.records import Demonstration, library_versions
from sart_toolkit.errors import InvalidInput
from sart_toolkit.record.replay import replay_demonstration, tracking_difference
from sart_toolkit.robots.model import RobotModel


def benchmark_replay(
    cells: Sequence[Cell],
    seed: int = 0,
    progress: Callable[[int, int], None] | None = None,
) -> dict[str, Any]:
    """What a demonstration's commands do on every other backend, object placed the same.

    For each task a demonstration is recorded on each of its backends and replayed on the others.
    Rows give the greatest difference of the measured tool poses over all recorded steps at which
    neither run's robot, or what it grasps, touched anything else.

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
    demonstrations: dict[str, Demonstration] = {}
    rows = []
    for done, (source, target) in enumerate(pairs, 1):
        task = source.task
        rng = np.random.default_rng([seed, 0])
        placement = task.sample_placement(rng)
        if source.name not in demonstrations:
            with closing(source.make_backend()) as backend:
                model = RobotModel(backend.robot, backend.scene.held)
                demonstrations[source.name] = demonstrate(
                    task, backend, model, placement, rng, BLIND
                )
        original = demonstrations[source.name]
        with closing(target.make_backend()) as backend:
            model = RobotModel(backend.robot, backend.scene.held)
            copy = replay_demonstration(original, backend, task, model, BLIND)
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
