"""Universal Robots UR5e with a wrist RGB-D camera, and the gripper given."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from sart_toolkit.poses import Array, pose
from sart_toolkit.robots.spec import (
    Attachment,
    CameraSpec,
    GripperSpec,
    RobotSpec,
    Shape,
    look_at,
)

DARK = (0.16, 0.16, 0.18, 1.0)
PAD = (0.30, 0.30, 0.32, 1.0)
_LIGHT = (0.78, 0.80, 0.83, 1.0)
_BLUE = (0.42, 0.58, 0.72, 1.0)

# The camera sits beside the gripper's body, across the direction in which the fingers close, and
# looks at a point a little beyond the fingertips.
_T_GRIPPER_CAMERA = look_at(
    np.array([0.0, 0.095, 0.02]), np.array([0.0, -0.012, 0.25]), up=np.array([0.0, -1.0, 0.0])
)


def ur5e_with(
    name: str,
    gripper: GripperSpec,
    T_gripper_tool: Array,
    link_colours: Mapping[str, tuple[float, float, float, float]],
    T_gripper_camera: Array = _T_GRIPPER_CAMERA,
) -> RobotSpec:
    """A UR5e from airo-models' URDF with a gripper and a camera beside it.

    Args:
        name: the robot's name.
        gripper: what its flange carries; its base must be called `base_link`.
        T_gripper_tool: the tool frame `(4, 4)` in the gripper's base.
        link_colours: of the gripper's links.
        T_gripper_camera: the wrist camera `(4, 4)` in the gripper's base.
    """
    base = "gripper_base_link"
    return RobotSpec(
        name=name,
        urdf="airo_models:arms/ur5e/ur5e.urdf",
        arm_joints=(
            "shoulder_pan_joint",
            "shoulder_lift_joint",
            "elbow_joint",
            "wrist_1_joint",
            "wrist_2_joint",
            "wrist_3_joint",
        ),
        home=np.array([0.0, -1.7, 1.9, -1.77, -np.pi / 2, 0.0]),
        velocity_limits=np.full(6, np.pi),
        # 2.5 rad/s² is the URDF's drake:acceleration, a cautious planning figure that a
        # hand-steered stop exceeds; the controller of a real UR5e accepts 40 rad/s².
        acceleration_limits=np.full(6, 15.0),
        jerk_limits=np.full(6, 500.0),
        gripper=gripper,
        gripper_base=base,
        T_gripper_tool=T_gripper_tool,
        cameras=(CameraSpec("wrist", base, T_gripper_camera, fov_y_deg=60.0),),
        attachments=(
            Attachment(
                "wrist_camera",
                base,
                # A D435's housing (90 x 25 x 25 mm), its front face just behind the optical
                # centre, and the arm that carries it from the gripper's body.
                (
                    Shape("box", (0.09, 0.025, 0.025), pose([0, 0, -0.0175]), DARK),
                    Shape("box", (0.02, 0.05, 0.01), pose([0, -0.03, -0.03]), DARK),
                ),
                T_gripper_camera,
                mass=0.1,
            ),
        ),
        link_colours={
            "base_link_inertia": _LIGHT,
            "shoulder_link": _BLUE,
            "upper_arm_link": _LIGHT,
            "forearm_link": _LIGHT,
            "wrist_1_link": _BLUE,
            "wrist_2_link": _BLUE,
            "wrist_3_link": DARK,
            **link_colours,
        },
    )
