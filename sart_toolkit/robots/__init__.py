"""Robots as data (`RobotSpec`) and their kinematics (`RobotModel`).

A new robot is one file with a `SPEC` and one line in `ROBOTS`.
"""

from __future__ import annotations

import importlib

from sart_toolkit.errors import unknown_name
from sart_toolkit.robots.spec import RobotSpec

ROBOTS = {
    "ur5e_2f85": "sart_toolkit.robots.ur5e_2f85:SPEC",
}


def get_robot(name: str) -> RobotSpec:
    """The robot called `name`.

    Raises:
        UnknownName: no such robot; the message offers the nearest.
    """
    if name not in ROBOTS:
        raise unknown_name("robot", name, ROBOTS)
    module, attribute = ROBOTS[name].split(":")
    spec = getattr(importlib.import_module(module), attribute)
    assert isinstance(spec, RobotSpec)
    return spec
