"""What benchmarks that last share: a demonstration each, and results kept as they come in."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from sart_toolkit.backends.interface import Backend
from sart_toolkit.errors import InvalidInput, Mismatch
from sart_toolkit.evaluate.benchmark import Cell
from sart_toolkit.records import Demonstration
from sart_toolkit.robots.model import RobotModel
from sart_toolkit.storage import (
    append_json_line,
    check_writable,
    read_json_lines,
    remove,
    write_json,
)
from sart_toolkit.teach.scripted import ScriptedOperator
from sart_toolkit.teach.session import SessionConfig, record_demonstration

_BLIND = SessionConfig(cameras=())


def recorded(cell: Cell, backend: Backend, seed: int) -> Demonstration:
    """The scripted operator's demonstration of a cell's task, without pictures.

    Raises:
        Mismatch: it did not reach the goal.
    """
    task = cell.task
    rng = np.random.default_rng([seed, 0])
    placement = task.sample_placement(rng)
    model = RobotModel(backend.robot, backend.scene.held)
    operator = ScriptedOperator(task.plan(task.initial_state(model, placement)), rng)
    shown = record_demonstration(backend, task, model, operator, placement, config=_BLIND)
    if not task.achieved(shown.success):
        raise Mismatch(f"{cell.name}: the demonstration did not reach the goal; try another --seed")
    return shown


class ResultLog:
    """What a benchmark has done so far, in a file of lines beside its result.

    Attributes:
        rows: those that were finished before.
    """

    def __init__(self, out: Path, request: Mapping[str, Any], overwrite: bool) -> None:
        """Go on where the same `request` was interrupted, or start.

        Raises:
            OutputExists: `out` is there and `overwrite` is false.
            Mismatch: another request was interrupted.
            CannotWrite: the disk refuses.
        """
        check_writable(out, overwrite)
        self._out, self._path = out, out.with_suffix(".partial.jsonl")
        if overwrite:
            remove(self._path)
        lines = read_json_lines(self._path)
        if lines and lines[0] != request:
            raise Mismatch(
                f"{self._path}: holds results of {lines[0]}, not {dict(request)}; add --overwrite "
                "or choose another --out"
            )
        if not lines:
            out.parent.mkdir(parents=True, exist_ok=True)
            append_json_line(self._path, request)
        self.rows = lines[1:]

    def add(self, row: Mapping[str, Any]) -> None:
        """Keep a finished row."""
        append_json_line(self._path, row)

    def finish(self, result: dict[str, Any]) -> dict[str, Any]:
        """`result`, written to `out`; the rows are removed."""
        write_json(self._out, result)
        remove(self._path)
        return result


def check_counts(config: Any, *names: str) -> None:
    """Return if the named fields of a config are at least 1, and its seed at least 0.

    Raises:
        InvalidInput: one isn't.
    """
    for name in names:
        if getattr(config, name) < 1:
            raise InvalidInput(f"{name}: expected at least 1, got {getattr(config, name)}")
    if config.seed < 0:
        raise InvalidInput(f"seed: expected a whole number >= 0, got {config.seed}")
