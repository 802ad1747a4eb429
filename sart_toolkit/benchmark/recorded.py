"""What the benchmarks of segments and radii share: a demonstration each, and checks of counts."""

from __future__ import annotations

from typing import Any

import numpy as np

from sart_toolkit.backends.interface import Backend
from sart_toolkit.benchmark.operator import Cell
from sart_toolkit.data.records import Demonstration
from sart_toolkit.errors import InvalidInput, Mismatch
from sart_toolkit.record.scripted import ScriptedOperator
from sart_toolkit.record.session import SessionConfig, record_demonstration
from sart_toolkit.robots.model import RobotModel

BLIND = SessionConfig(cameras=())


def recorded(
    cell: Cell, backend: Backend, seed: int, config: SessionConfig = BLIND
) -> Demonstration:
    """The scripted operator's demonstration of a cell's task, without pictures if not asked for.

    Raises:
        Mismatch: it did not reach the goal.
    """
    task = cell.task
    rng = np.random.default_rng([seed, 0])
    placement = task.sample_placement(rng)
    model = RobotModel(backend.robot, backend.scene.held)
    operator = ScriptedOperator(task.plan(task.initial_state(model, placement)), rng)
    shown = record_demonstration(backend, task, model, operator, placement, config=config)
    if not task.achieved(shown.success):
        raise Mismatch(f"{cell.name}: the demonstration did not reach the goal; try another --seed")
    return shown


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
