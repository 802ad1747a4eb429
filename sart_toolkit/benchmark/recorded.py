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
    plan, hz = task.plan(task.initial_state(model, placement)), backend.rates.control_hz
    operator = ScriptedOperator(plan, rng, control_hz=hz)
    shown = record_demonstration(backend, task, model, operator, placement, config=_BLIND)
    if not task.achieved(shown.success, shown.rates.record_hz):
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
