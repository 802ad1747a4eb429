"""UR10 (of the CB3 series) with a Robotiq 2F-85; the arm is of the extra `robots`."""

from __future__ import annotations

from sart_toolkit.robots.robotiq import COLOURS, two_finger_85
from sart_toolkit.robots.ur import UR10, ur_with

SPEC = ur_with("ur10_2f85", UR10, COLOURS, **two_finger_85("tool0"))
