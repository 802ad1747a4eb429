"""UR5e with a Robotiq Hand-E: parallel jaws of 50 mm stroke, its shape made of primitives."""

from __future__ import annotations

import numpy as np

from sart_toolkit.poses import pose
from sart_toolkit.robots.robotiq import BASE, DARK, PAD, wrist_camera
from sart_toolkit.robots.spec import GripperSpec, look_at
from sart_toolkit.robots.ur import UR5E, ur_with

_STEEL = (0.60, 0.62, 0.65, 1.0)
# Steeper than beside the 2F-85, 10 deg from the tool's axis: it looks past what hangs in the jaws
# at what is below.
_CAMERA, _HOUSING = wrist_camera(
    look_at(
        np.array([0.0, 0.095, 0.02]), np.array([0.0, 0.0544, 0.25]), up=np.array([0.0, -1.0, 0.0])
    )
)

SPEC = ur_with(
    "ur5e_hande",
    UR5E,
    {
        "gripper_coupling": _STEEL,
        "gripper_base_link": DARK,
        "gripper_rail": _STEEL,
        "gripper_left_jaw": PAD,
        "gripper_right_jaw": PAD,
    },
    gripper=GripperSpec(
        urdf="sart_toolkit:robots/hande.urdf",
        parent_frame="tool0",
        driver="gripper_left_jaw_joint",
        followers={"gripper_right_jaw_joint": 1.0},
        closed_position=0.025,
        finger_links=("gripper_left_jaw", "gripper_right_jaw"),
        # The data sheet: 20 to 185 N, 20 to 150 mm/s between the jaws.
        force=60.0,
        speed=0.075,
        armature=0.5,
    ),
    gripper_base=BASE,
    T_gripper_tool=pose([0, 0, 0.145]),
    cameras=(_CAMERA,),
    attachments=(_HOUSING,),
)
