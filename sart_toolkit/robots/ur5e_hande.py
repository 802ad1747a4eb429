"""UR5e with a Robotiq Hand-E: parallel jaws of 50 mm stroke, its shape made of primitives."""

from __future__ import annotations

from sart_toolkit.poses import pose
from sart_toolkit.robots.spec import GripperSpec
from sart_toolkit.robots.ur5e import DARK, PAD, ur5e_with

SPEC = ur5e_with(
    "ur5e_hande",
    GripperSpec(
        urdf="sart_toolkit:robots/urdfs/hande.urdf",
        parent_frame="tool0",
        driver="gripper_left_jaw_joint",
        followers={"gripper_right_jaw_joint": 1.0},
        closed_position=0.025,
        finger_links=("gripper_left_jaw", "gripper_right_jaw"),
        # The data sheet: 20 to 185 N, 20 to 150 mm/s between the jaws.
        force=60.0,
        speed=0.075,
    ),
    T_gripper_tool=pose([0, 0, 0.145]),
    link_colours={"gripper_base_link": DARK, "gripper_left_jaw": PAD, "gripper_right_jaw": PAD},
)
