"""Robots in scenes, every body in its place: peg-in-hole's start, and generated clutter."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import pytest

from sart_toolkit.poses import Array
from sart_toolkit.robots import get_robot
from sart_toolkit.robots.model import RobotModel
from sart_toolkit.scene.collision import CollisionModel, PlacedModel
from sart_toolkit.scene.spec import Body, SceneSpec, SceneState
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
def among() -> Callable[..., PlacedModel]:
    """Makes a robot among bodies that stand where they are said to, but for what it carries."""

    def make(
        *bodies: Body,
        robot: str = "ur5e_2f85",
        gripper: float = 0.0,
        carried: dict[str, Array] | None = None,
        allowed: tuple[tuple[str, str], ...] = (),
    ) -> PlacedModel:
        Ts = {body.name: body.T_world_body for body in bodies}
        collision = CollisionModel(get_robot(robot), SceneSpec(bodies))
        return collision.placed(Ts, gripper, carried, allowed)

    return make


@pytest.fixture(scope="session")
def cluttered() -> dict[str, PlacedModel]:
    """A robot in a scene of each kind of clutter."""
    rng = np.random.default_rng(7)
    found = {}
    for i, (kind, make) in enumerate(CLUTTER.items()):
        scene = make(rng)
        collision = CollisionModel(get_robot(("ur5e_2f85", "ur5e_hande")[i % 2]), scene)
        Ts = {body.name: body.T_world_body for body in scene.bodies}
        found[kind] = collision.placed(Ts, float(rng.uniform()))
    return found
