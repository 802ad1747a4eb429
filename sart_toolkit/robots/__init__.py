"""Robots as data (`RobotSpec`) and their kinematics (`RobotModel`).

A new robot is one file with a `SPEC` and one line in `ROBOTS`.
"""

from __future__ import annotations

from sart_toolkit.registry import lookup
from sart_toolkit.robots.spec import RobotSpec

ROBOTS = {
    "ur5e_2f85": "sart_toolkit.robots.ur5e_2f85:SPEC",
    "ur5e_hande": "sart_toolkit.robots.ur5e_hande:SPEC",
}


def get_robot(name: str) -> RobotSpec:
    """The robot called `name`.

    Raises:
        UnknownName: no such robot; the message offers the nearest.
    """
    spec = lookup("robot", name, ROBOTS)
    assert isinstance(spec, RobotSpec)
    return spec
