"""UFACTORY xArm7 with a Robotiq 2F-85; the arm is of the extra `robots`."""

from __future__ import annotations

import numpy as np

from sart_toolkit.poses import pose
from sart_toolkit.robots.robotiq import COLOURS, LIGHT, two_finger_85
from sart_toolkit.robots.spec import RobotSpec

SPEC = RobotSpec(
    name="xarm7_2f85",
    urdf=(
        "example-robot-data:cmeel.prefix/share/example-robot-data/robots/xarm_description/urdf/"
        "xarm7.urdf"
    ),
    arm_joints=tuple(f"joint{i}" for i in range(1, 8)),
    home=np.array([0.0, -0.4, 0.0, 0.9, 0.0, 1.3, 0.0]),
    velocity_limits=np.full(7, 3.14),
    acceleration_limits=np.full(7, 15.0),
    jerk_limits=np.full(7, 500.0),
    **two_finger_85("link7", pose([0, 0, 0.003], [0, 0, np.pi / 2])),
    link_colours={**COLOURS, "link_base": LIGHT, **{f"link{i}": LIGHT for i in range(1, 8)}},
)
