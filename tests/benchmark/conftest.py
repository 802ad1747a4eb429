"""Tasks on a backend with tiny pictures."""

from __future__ import annotations

import functools
from collections.abc import Callable

import pytest

from sart_toolkit.backends import make_backend
from sart_toolkit.benchmark.operator import Cell
from sart_toolkit.robots import get_robot
from sart_toolkit.tasks.task import Task


@pytest.fixture(scope="session")
def make_cell() -> Callable[[Task], Cell]:
    """A task on PyBullet, its pictures tiny."""

    def make(task: Task) -> Cell:
        robot = get_robot(task.robot)
        return Cell(
            task, "pybullet", functools.partial(make_backend, "pybullet", robot, task.scene, 16)
        )

    return make


@pytest.fixture(scope="session")
def peg_cell(make_cell: Callable[[Task], Cell], peg_task: Task) -> Cell:
    return make_cell(peg_task)
