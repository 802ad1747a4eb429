"""The robot of a test module's `TASK`, on each backend, and its operator with a changed plan."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np
import pytest

from sart_toolkit.backends import BACKENDS, make_backend
from sart_toolkit.backends.interface import Backend
from sart_toolkit.data.records import Demonstration
from sart_toolkit.record.scripted import ScriptedOperator
from sart_toolkit.record.session import SessionConfig, record_demonstration
from sart_toolkit.robots import get_robot
from sart_toolkit.robots.model import RobotModel
from sart_toolkit.tasks.task import PlanStep


@pytest.fixture(scope="module")
def model(request: pytest.FixtureRequest) -> RobotModel:
    task = request.module.TASK
    return RobotModel(get_robot(task.robot), task.scene.held)


@pytest.fixture(scope="module", params=BACKENDS)
def backend(request: pytest.FixtureRequest, model: RobotModel) -> Iterator[Backend]:
    backend = make_backend(request.param, model.spec, request.module.TASK.scene, 64)
    yield backend
    backend.close()


@pytest.fixture
def demonstrate(
    request: pytest.FixtureRequest, backend: Backend, model: RobotModel
) -> Callable[..., Demonstration]:
    """Lets the operator follow the plan, changed by a function, at the module's `PLACEMENT`."""
    task = request.module.TASK

    def demonstrate(
        change: Callable[[list[PlanStep]], list[PlanStep]] = lambda plan: plan,
        placement: object = None,
        cameras: tuple[str, ...] = (),
    ) -> Demonstration:
        placement = placement or request.module.PLACEMENT
        plan = change(task.plan(task.initial_state(model, placement)))
        operator = ScriptedOperator(plan, np.random.default_rng(5))
        config = SessionConfig(cameras=cameras, keep_states=False)
        return record_demonstration(backend, task, model, operator, placement, config=config)

    return demonstrate
