"""UR3e with a Robotiq 2F-85, from airo-models' URDFs."""

from __future__ import annotations

from sart_toolkit.poses import pose
from sart_toolkit.robots.robotiq import COLOURS, two_finger_85
from sart_toolkit.robots.ur import UR3E, ur_with

SPEC = ur_with(
    "ur3e_2f85",
    UR3E,
    COLOURS,
    **two_finger_85("tool0"),
    # So near that it reaches what the tasks place before it.
    T_world_base=pose([0.18, 0, 0]),
)
