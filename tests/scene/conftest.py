"""Peg-in-hole's start: the peg's tip 12.5 cm above the middle of the hole."""

from __future__ import annotations

from typing import NamedTuple

import pytest

from sart_toolkit.robots.model import RobotModel
from sart_toolkit.scene.clearance import ClearanceModel
from sart_toolkit.scene.spec import SceneState
from sart_toolkit.tasks.task import Placement, Task


class Start(NamedTuple):
    clearances: ClearanceModel
    state: SceneState


@pytest.fixture(scope="session")
def start(peg_task: Task, peg_model: RobotModel) -> Start:
    state = peg_task.initial_state(peg_model, Placement())
    return Start(ClearanceModel(peg_model, peg_task.scene), state)
