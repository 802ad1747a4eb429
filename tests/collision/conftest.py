"""Robots in scenes, every body in its place: peg-in-hole's start, and generated clutter."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import pytest

from sart_toolkit.backends import make_backend
from sart_toolkit.collision.exact import ExactWorld
from sart_toolkit.collision.model import CollisionModel, PlacedModel
from sart_toolkit.data.records import Demonstration
from sart_toolkit.poses import Array
from sart_toolkit.record.scripted import ScriptedOperator
from sart_toolkit.record.session import record_demonstration
from sart_toolkit.robots import get_robot
from sart_toolkit.robots.model import RobotModel
from sart_toolkit.scenes.spec import SceneSpec, SceneState
from sart_toolkit.tasks import get_task
from sart_toolkit.tasks.task import Placement, Task
from sart_toolkit.testing.clutter import CLUTTER


class Start(NamedTuple):
    """Peg-in-hole's start: the peg's tip 12.5 cm above the middle of the hole."""

    collision: CollisionModel
    placed: PlacedModel
    state: SceneState


@pytest.fixture(scope="session")
def start(peg_task: Task, peg_model: RobotModel) -> Start:
    state = peg_task.initial_state(peg_model, Placement())
    collision = CollisionModel(get_robot(peg_task.robot), peg_task.scene)
    return Start(collision, collision.placed(state.Ts_world_body, state.gripper), state)


@pytest.fixture(scope="session")
def recorded() -> Callable[[str], Demonstration]:
    """A demonstration of a task by its scripted operator, without wrist images worth the name."""

    @functools.cache
    def recorded(name: str) -> Demonstration:
        task = get_task(name)
        model = RobotModel(get_robot(task.robot), task.scene.held)
        backend = make_backend("pybullet", model.spec, task.scene, 16)
        plan = task.plan(task.initial_state(model, Placement()))
        operator = ScriptedOperator(plan, np.random.default_rng(0))
        demonstration = record_demonstration(backend, task, model, operator, seed=0)
        backend.close()
        return demonstration

    return recorded


@pytest.fixture(scope="session")
def toolbox() -> Task:
    return get_task("toolbox_picking")


@pytest.fixture(scope="session")
def picked(recorded: Callable[[str], Demonstration], toolbox: Task) -> ExactWorld:
    """A toolbox, approached, grasped and lifted off a table."""
    return ExactWorld(recorded(toolbox.name), get_robot(toolbox.robot), toolbox.scene)


@pytest.fixture(scope="session")
def first_grasp(picked: ExactWorld) -> int:
    """The waypoint at which the toolbox is first in the grasp."""
    return [bool(phase.grasped) for phase in picked.phases].index(True)


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(3)


class Cluttered(NamedTuple):
    """A robot's name, a scene of clutter around it, how far its gripper is closed."""

    robot: str
    scene: SceneSpec
    gripper: float

    @property
    def Ts_world_body(self) -> dict[str, Array]:
        """Where the scene has its bodies."""
        return {body.name: body.T_world_body for body in self.scene.bodies}


@pytest.fixture(scope="session")
def clutter() -> dict[str, Cluttered]:
    """A scene of each kind of clutter."""
    rng = np.random.default_rng(7)
    return {
        kind: Cluttered(("ur5e_2f85", "ur5e_hande")[i % 2], make(rng), float(rng.uniform()))
        for i, (kind, make) in enumerate(CLUTTER.items())
    }


@pytest.fixture(scope="session")
def cluttered(clutter: dict[str, Cluttered]) -> dict[str, PlacedModel]:
    """Robot and scene of each kind of clutter."""
    return {
        kind: CollisionModel(get_robot(it.robot), it.scene).placed(it.Ts_world_body, it.gripper)
        for kind, it in clutter.items()
    }
