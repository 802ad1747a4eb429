"""Tasks on a backend with tiny images."""

from __future__ import annotations

import functools
from collections.abc import Callable

import pytest

from sart_toolkit.backends import make_backend
from sart_toolkit.benchmark.cells import Cell
from sart_toolkit.robots import get_robot
from sart_toolkit.tasks.task import Task


@pytest.fixture(scope="session")
def make_cell() -> Callable[..., Cell]:
    """A task on a backend, by default PyBullet, its images tiny."""

    def make(task: Task, backend: str = "pybullet") -> Cell:
        robot = get_robot(task.robot)
        return Cell(task, backend, functools.partial(make_backend, backend, robot, task.scene, 16))

    return make


@pytest.fixture(scope="session")
def peg_cell(make_cell: Callable[..., Cell], peg_task: Task) -> Cell:
    return make_cell(peg_task)
