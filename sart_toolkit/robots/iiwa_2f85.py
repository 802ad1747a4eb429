"""KUKA LBR iiwa 7 R800 with a Robotiq 2F-85, the arm from pybullet_data's URDF."""

from __future__ import annotations

import numpy as np

from sart_toolkit.poses import pose
from sart_toolkit.robots.robotiq import COLOURS, LIGHT, two_finger_85
from sart_toolkit.robots.spec import RobotSpec

SPEC = RobotSpec(
    name="iiwa_2f85",
    urdf="pybullet_data:kuka_iiwa/model.urdf",
    arm_joints=tuple(f"lbr_iiwa_joint_{i}" for i in range(1, 8)),
    home=np.array([0.0, 0.45, 0.0, -1.77, 0.0, 0.92, 0.0]),
    # KUKA's data sheet has 1.71, 1.71, 1.75, 2.27, 2.44, 3.14, 3.14 rad/s.
    velocity_limits=np.full(7, 1.7),
    acceleration_limits=np.full(7, 10.0),
    jerk_limits=np.full(7, 400.0),
    **two_finger_85("lbr_iiwa_link_7", pose([0, 0, 0.045], [0, 0, -np.pi / 2])),
    link_colours={**COLOURS, **{f"lbr_iiwa_link_{i}": LIGHT for i in range(8)}},
)
