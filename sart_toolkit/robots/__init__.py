"""Robots as data (`RobotSpec`) and their kinematics (`RobotModel`).

A new robot is one file with a `SPEC` and one line in `ROBOTS`; one outside the repository needs no
line, `package.module:NAME` or `path/to/file.py:NAME` names it.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from sart_toolkit.registry import expect, resolve

if TYPE_CHECKING:
    from sart_toolkit.robots.spec import RobotSpec

ROBOTS = {
    "ur5e_2f85": "sart_toolkit.robots.ur5e_2f85:SPEC",
    "ur5e_hande": "sart_toolkit.robots.ur5e_hande:SPEC",
    "ur3e_2f85": "sart_toolkit.robots.ur3e_2f85:SPEC",
    "ur10_2f85": "sart_toolkit.robots.ur10_2f85:SPEC",
    "panda": "sart_toolkit.robots.panda:SPEC",
    "xarm6": "sart_toolkit.robots.xarm6:SPEC",
    "xarm7_2f85": "sart_toolkit.robots.xarm7_2f85:SPEC",
    "iiwa_2f85": "sart_toolkit.robots.iiwa_2f85:SPEC",
}

# What backends are tested with: a gripper with a linkage, and one with parallel jaws.
USUAL_ROBOTS = ("ur5e_2f85", "ur5e_hande")


def get_robot(robot: str | RobotSpec) -> RobotSpec:
    """The robot that a name or reference names; a robot itself is returned.

    Raises:
        UnknownName: there is none; the message says which part is wrong.
    """
    # Here and in the other tables' modules: looking a name up should cost no import.
    from sart_toolkit.robots.spec import RobotSpec

    return expect("robot", robot, resolve("robot", robot, ROBOTS), RobotSpec)
