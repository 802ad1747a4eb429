"""Tasks: one file each with its scene, randomisation, success test and operator's plan.

A new task is one file and one line in `TASKS`; one outside the repository needs no line,
`package.module:NAME` or `path/to/file.py:NAME` names it.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from sart_toolkit.errors import UnknownName
from sart_toolkit.registry import expect, resolve

if TYPE_CHECKING:
    from sart_toolkit.tasks.task import Task

TASKS = {
    "peg_in_hole": "sart_toolkit.tasks.peg_in_hole:PegInHole",
    "door_opening": "sart_toolkit.tasks.door_opening:DoorOpening",
    "lid_opening": "sart_toolkit.tasks.lid_opening:LidOpening",
    "toolbox_picking": "sart_toolkit.tasks.toolbox_picking:ToolboxPicking",
    "bottle_placing": "sart_toolkit.tasks.bottle_placing:BottlePlacing",
    "lid_closing": "sart_toolkit.tasks.lid_closing:LidClosing",
}


def get_task(task: str | Task | type[Task]) -> Task:
    """The task that a name, a reference or a class names; a task itself is returned.

    Raises:
        UnknownName: there is none, or its class needs arguments; the message says which part is
            wrong.
    """
    from sart_toolkit.tasks.task import Task

    found = resolve("task", task, TASKS)
    if isinstance(found, type) and issubclass(found, Task):
        try:
            return found()
        except TypeError as error:
            raise UnknownName(
                f"task {found.__name__}: can't be made without arguments ({error}); name an "
                "instance, or give every argument a default"
            ) from error
    return expect("task", task, found, Task)
