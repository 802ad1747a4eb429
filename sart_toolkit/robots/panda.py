"""Franka Emika Panda with its own hand, from pybullet_data's URDF of both."""

from __future__ import annotations

import numpy as np

from sart_toolkit.poses import pose
from sart_toolkit.robots.robotiq import DARK, LIGHT, PAD
from sart_toolkit.robots.spec import Attachment, CameraSpec, GripperSpec, RobotSpec, Shape, look_at

_HAND = "panda_hand"
_FINGERS = ("panda_leftfinger", "panda_rightfinger")
# Beside the hand's long side, which is across the direction in which the fingers close.
_T_HAND_CAMERA = look_at(
    np.array([0.09, 0.0, 0.0]), np.array([-0.012, 0.0, 0.19]), up=np.array([-1.0, 0.0, 0.0])
)

SPEC = RobotSpec(
    name="panda",
    urdf="pybullet_data:franka_panda/panda.urdf",
    arm_joints=tuple(f"panda_joint{i}" for i in range(1, 8)),
    home=np.array([0.0, -0.3, 0.0, -2.3, 0.0, 2.0, np.pi / 4]),
    velocity_limits=np.array([2.175] * 4 + [2.61] * 3),
    # Franka's data sheet has 15, 7.5, 10, 12.5, 15, 20, 20 rad/s² and 3750 rad/s³ and more.
    acceleration_limits=np.array([15.0, 7.5, 10.0, 12.5, 15.0, 20.0, 20.0]),
    jerk_limits=np.full(7, 500.0),
    gripper=GripperSpec(
        driver="panda_finger_joint1",
        followers={"panda_finger_joint2": 1.0},
        open_position=0.04,
        closed_position=0.0,
        finger_links=_FINGERS,
        # The data sheet: 30 to 70 N, 100 mm/s between the fingers.
        force=50.0,
        speed=0.05,
        armature=0.3,
    ),
    gripper_base=_HAND,
    T_gripper_tool=pose([0, 0, 0.1034], [0, 0, np.pi / 2]),
    cameras=(CameraSpec("wrist", _HAND, _T_HAND_CAMERA),),
    attachments=(
        Attachment(
            "wrist_camera",
            _HAND,
            (
                Shape("box", (0.09, 0.025, 0.025), pose([0, 0, -0.0175]), DARK),
                Shape("box", (0.02, 0.05, 0.01), pose([0, -0.03, -0.03]), DARK),
            ),
            _T_HAND_CAMERA,
        ),
    ),
    link_colours={
        **{f"panda_link{i}": LIGHT for i in range(8)},
        _HAND: LIGHT,
        **dict.fromkeys(_FINGERS, PAD),
    },
)
