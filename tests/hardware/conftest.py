"""An emulated UR5e with a 2F-85 in an empty scene."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from sart_toolkit.hardware.cell import Limits, Workspace
from sart_toolkit.robots import get_robot
from sart_toolkit.robots.model import RobotModel
from sart_toolkit.robots.spec import RobotSpec
from sart_toolkit.scenes.spec import SceneSpec
from sart_toolkit.testing.emulated import EmulatedWorld, Emulation

EMPTY = SceneSpec(())


@pytest.fixture(scope="session")
def robot() -> RobotSpec:
    return get_robot("ur5e_2f85")


@pytest.fixture(scope="session")
def model(robot: RobotSpec) -> RobotModel:
    return RobotModel(robot)


def limits(model: RobotModel, half: float = 0.6, **given: float) -> Limits:
    """A workspace around the tool at home, at full speed unless given otherwise."""
    p = model.fk(model.spec.home)[:3, 3]
    return Limits(Workspace(p - half, p + half), **{"speed_scale": 1.0, **given})


@pytest.fixture(scope="module")
def shared_world(robot: RobotSpec) -> Iterator[EmulatedWorld]:
    world = EmulatedWorld(robot, EMPTY, 32, Emulation(seed=1))
    yield world
    world.close()


@pytest.fixture
def world(shared_world: EmulatedWorld, robot: RobotSpec) -> EmulatedWorld:
    """The arm at home, all being well, nothing noted yet."""
    shared_world.forget_faults()
    shared_world.reset(EMPTY.initial_state(robot.home, 0.0))
    shared_world.calls.clear()
    shared_world.sent.clear()
    return shared_world
