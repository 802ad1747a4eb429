"""UR5e with a Robotiq 2F-85, from airo-models' URDFs."""

from __future__ import annotations

from sart_toolkit.poses import pose
from sart_toolkit.robots.spec import GripperSpec
from sart_toolkit.robots.ur5e import DARK, PAD, ur5e_with

SPEC = ur5e_with(
    "ur5e_2f85",
    GripperSpec(
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
        closed_position=0.8,
        finger_links=("gripper_left_inner_finger_pad", "gripper_right_inner_finger_pad"),
        # 50 N at each pad and 106 mm/s; the data sheet has 20 to 235 N, 20 to 150 mm/s.
        force=6.0,
        speed=1.0,
        armature=1e-3,
    ),
    T_gripper_tool=pose([0, 0, 0.145]),
    link_colours={
        "gripper_base_link_inertia": DARK,
        "gripper_left_inner_finger_pad": PAD,
        "gripper_right_inner_finger_pad": PAD,
    },
)
