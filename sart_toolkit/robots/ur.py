"""Universal Robots arms with a wrist RGB-D camera, and the gripper given."""

from __future__ import annotations

from typing import Any

import numpy as np

from sart_toolkit.robots.robotiq import DARK, LIGHT
from sart_toolkit.robots.spec import RobotSpec

_BLUE = (0.42, 0.58, 0.72, 1.0)
UR3E, UR5E = (f"airo_models:arms/{name}/{name}.urdf" for name in ("ur3e", "ur5e"))
UR10 = (
    "example-robot-data:cmeel.prefix/share/example-robot-data/robots/ur_description/urdf/"
    "ur10_robot.urdf"
)


def ur_with(name: str, urdf: str, colours: dict[str, Any], **tool: Any) -> RobotSpec:
    """A UR arm from its URDF with what it carries.

    Args:
        name: the robot's name.
        urdf: one of those above.
        colours: of the gripper's links.
        tool: the fields of a `RobotSpec` that say what its flange carries.
    """
    return RobotSpec(
        name=name,
        urdf=urdf,
        arm_joints=(
            "shoulder_pan_joint",
            "shoulder_lift_joint",
            "elbow_joint",
            "wrist_1_joint",
            "wrist_2_joint",
            "wrist_3_joint",
        ),
        home=np.array([0.0, -1.7, 1.9, -1.77, -np.pi / 2, 0.0]),
        velocity_limits=np.full(6, np.pi if urdf != UR10 else 2.1),
        # 2.5 rad/s² is the URDF's drake:acceleration, a cautious planning figure that a
        # hand-steered stop exceeds; the controller of a real UR5e accepts 40 rad/s².
        acceleration_limits=np.full(6, 15.0),
        jerk_limits=np.full(6, 500.0),
        link_colours={
            ("base_link_inertia" if urdf != UR10 else "base_link"): LIGHT,
            "shoulder_link": _BLUE,
            "upper_arm_link": LIGHT,
            "forearm_link": LIGHT,
            "wrist_1_link": _BLUE,
            "wrist_2_link": _BLUE,
            "wrist_3_link": DARK,
            **colours,
        },
        **tool,
    )
