"""What the benchmarks share: tasks on backends, their demonstrations, and checks of counts."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from sart_toolkit.backends.interface import Backend, BackendFactory
from sart_toolkit.data.records import Demonstration
from sart_toolkit.errors import InvalidInput, Mismatch
from sart_toolkit.record.scripted import ScriptedOperator
from sart_toolkit.record.session import SessionConfig, record_demonstration
from sart_toolkit.robots.model import RobotModel
from sart_toolkit.tasks.task import Placement, Task

# Where only the outcome is asked for, neither images nor states are kept.
BLIND = SessionConfig(cameras=(), keep_states=False)
WITHOUT_IMAGES = SessionConfig(cameras=())


@dataclass(frozen=True)
class Cell:
    """A task on a backend."""

    task: Task
    backend: str
    make_backend: BackendFactory

    @property
    def name(self) -> str:
        """Both names, as the results have them."""
        return f"{self.task.name}/{self.backend}"


def demonstrate(
    task: Task,
    backend: Backend,
    model: RobotModel,
    placement: Placement,
    rng: np.random.Generator,
    config: SessionConfig,
) -> Demonstration:
    """The scripted operator's demonstration of a task, whether it reached the goal or not."""
    plan = task.plan(task.initial_state(model, placement))
    operator = ScriptedOperator(plan, rng, control_hz=backend.rates.control_hz)
    return record_demonstration(backend, task, model, operator, placement, config=config)


def recorded(
    cell: Cell, backend: Backend, seed: int, config: SessionConfig = WITHOUT_IMAGES
) -> Demonstration:
    """The scripted operator's demonstration of a cell's task, without images if not asked for.

    Raises:
        Mismatch: it did not reach the goal.
    """
    rng = np.random.default_rng([seed, 0])
    placement = cell.task.sample_placement(rng)
    model = RobotModel(backend.robot, backend.scene.held)
    demonstration = demonstrate(cell.task, backend, model, placement, rng, config)
    if not cell.task.achieved(demonstration.success, demonstration.rates.record_hz):
        raise Mismatch(f"{cell.name}: the demonstration did not reach the goal; try another --seed")
    return demonstration


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
