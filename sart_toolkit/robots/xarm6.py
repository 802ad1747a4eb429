"""UFACTORY xArm6 with its own gripper, from pybullet_data's URDF of both."""

from __future__ import annotations

import numpy as np

from sart_toolkit.poses import pose
from sart_toolkit.robots.robotiq import DARK, LIGHT, PAD
from sart_toolkit.robots.spec import Attachment, CameraSpec, GripperSpec, RobotSpec, Shape, look_at

_BASE = "xarm_gripper_base_link"
_FINGERS = ("left_finger", "right_finger")
# Its fingers close along y of its base.
_T_BASE_CAMERA = look_at(
    np.array([-0.095, 0.0, 0.03]), np.array([0.012, 0.0, 0.28]), up=np.array([1.0, 0.0, 0.0])
)

SPEC = RobotSpec(
    name="xarm6",
    urdf="pybullet_data:xarm/xarm6_with_gripper.urdf",
    arm_joints=tuple(f"joint{i}" for i in range(1, 7)),
    home=np.array([0.0, -0.6, -0.9, 0.0, 1.5, 0.0]),
    velocity_limits=np.full(6, 3.14),
    acceleration_limits=np.full(6, 15.0),
    jerk_limits=np.full(6, 500.0),
    gripper=GripperSpec(
        driver="drive_joint",
        followers=dict.fromkeys(
            (
                "left_finger_joint",
                "left_inner_knuckle_joint",
                "right_outer_knuckle_joint",
                "right_finger_joint",
                "right_inner_knuckle_joint",
            ),
            1.0,
        ),
        closed_position=0.85,
        finger_links=_FINGERS,
        # About 30 N at each finger and 100 mm/s, as the data sheet has them.
        force=4.0,
        speed=1.0,
        armature=1e-3,
    ),
    gripper_base=_BASE,
    T_gripper_tool=pose([0, 0, 0.165], [0, 0, np.pi / 2]),
    cameras=(CameraSpec("wrist", _BASE, _T_BASE_CAMERA),),
    attachments=(
        Attachment(
            "wrist_camera",
            _BASE,
            (
                Shape("box", (0.09, 0.025, 0.025), pose([0, 0, -0.0175]), DARK),
                Shape("box", (0.02, 0.05, 0.01), pose([0, -0.03, -0.03]), DARK),
            ),
            _T_BASE_CAMERA,
        ),
    ),
    link_colours={
        **{f"link{i}": LIGHT for i in range(1, 7)},
        "link_base": LIGHT,
        _BASE: DARK,
        **dict.fromkeys(_FINGERS, PAD),
    },
)
