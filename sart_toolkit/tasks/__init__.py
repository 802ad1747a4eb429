"""Tasks: one file each with its scene, randomisation, success test and operator's plan.

A new task is one file and one line in `TASKS`.
"""

from __future__ import annotations

from sart_toolkit.tables import lookup
from sart_toolkit.tasks.task import Task

TASKS = {
    "peg_in_hole": "sart_toolkit.tasks.peg_in_hole:PegInHole",
}


def get_task(name: str) -> Task:
    """The task called `name`.

    Raises:
        UnknownName: no such task; the message offers the nearest.
    """
    task = lookup("task", name, TASKS)()
    assert isinstance(task, Task)
    return task
