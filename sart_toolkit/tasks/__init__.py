"""Tasks: one file each with its scene, randomisation, success test and operator's plan.

A new task is one file and one line in `TASKS`.
"""

from __future__ import annotations

from sart_toolkit.registry import lookup
from sart_toolkit.tasks.task import Task

TASKS = {
    "peg_in_hole": "sart_toolkit.tasks.peg_in_hole:PegInHole",
    "door_opening": "sart_toolkit.tasks.door_opening:DoorOpening",
    "lid_opening": "sart_toolkit.tasks.lid_opening:LidOpening",
    "toolbox_picking": "sart_toolkit.tasks.toolbox_picking:ToolboxPicking",
    "bottle_placing": "sart_toolkit.tasks.bottle_placing:BottlePlacing",
    "lid_closing": "sart_toolkit.tasks.lid_closing:LidClosing",
}


def get_task(name: str) -> Task:
    """The task called `name`.

    Raises:
        UnknownName: no such task; the message offers the nearest.
    """
    task = lookup("task", name, TASKS)()
    assert isinstance(task, Task)
    return task
