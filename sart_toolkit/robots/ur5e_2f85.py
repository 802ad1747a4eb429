"""Universal Robots UR5e with a Robotiq 2F-85 and a wrist RGB-D camera, from airo-models' URDFs."""

from __future__ import annotations

import numpy as np

from sart_toolkit.poses import pose
from sart_toolkit.robots.spec import (
    Attachment,
    CameraSpec,
    GripperSpec,
    RobotSpec,
    Shape,
    look_at,
)

_DARK = (0.16, 0.16, 0.18, 1.0)
_LIGHT = (0.78, 0.80, 0.83, 1.0)
_BLUE = (0.42, 0.58, 0.72, 1.0)

# The camera sits beside the gripper's body, across the direction in which the fingers close, and
# looks at a point a little beyond the fingertips.
_T_GRIPPER_CAMERA = look_at(
    np.array([0.0, 0.095, 0.02]), np.array([0.0, -0.012, 0.25]), up=np.array([0.0, -1.0, 0.0])
)

SPEC = RobotSpec(
    name="ur5e_2f85",
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
    # 2.5 rad/s² is the URDF's drake:acceleration, a cautious planning figure that a hand-steered
    # stop exceeds; the controller of a real UR5e accepts 40 rad/s².
    acceleration_limits=np.full(6, 15.0),
    jerk_limits=np.full(6, 500.0),
    gripper=GripperSpec(
        urdf="airo_models:grippers/robotiq_2f_85/urdf/robotiq_2f_85.urdf",
        parent_frame="tool0",
        driver="gripper_finger_joint",
        followers={
            "gripper_left_inner_knuckle_joint": 1.0,
            "gripper_left_inner_finger_joint": -1.0,
            "gripper_right_outer_knuckle_joint": 1.0,
            "gripper_right_inner_knuckle_joint": 1.0,
            "gripper_right_inner_finger_joint": -1.0,
        },
        closed_angle=0.8,
        finger_links=("gripper_left_inner_finger_pad", "gripper_right_inner_finger_pad"),
    ),
    gripper_base="gripper_base_link",
    T_gripper_tool=pose([0, 0, 0.145]),
    wrist_camera=CameraSpec("wrist", "gripper_base_link", _T_GRIPPER_CAMERA, fov_y_deg=60.0),
    attachments=(
        Attachment(
            "wrist_camera",
            "gripper_base_link",
            # A D435's housing (90 x 25 x 25 mm), its front face just behind the optical centre,
            # and the arm that carries it from the gripper's body.
            (
                Shape("box", (0.09, 0.025, 0.025), pose([0, 0, -0.0175]), _DARK),
                Shape("box", (0.02, 0.05, 0.01), pose([0, 0.03, -0.03]), _DARK),
            ),
            _T_GRIPPER_CAMERA,
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
        "wrist_3_link": _DARK,
        "gripper_base_link_inertia": _DARK,
        "gripper_left_inner_finger_pad": (0.30, 0.30, 0.32, 1.0),
        "gripper_right_inner_finger_pad": (0.30, 0.30, 0.32, 1.0),
    },
)
