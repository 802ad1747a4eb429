"""A Robotiq 2F-85 with a wrist camera beside it, for any arm's flange."""

from __future__ import annotations

from typing import Any

import numpy as np

from sart_toolkit.poses import Array, pose
from sart_toolkit.robots.spec import Attachment, CameraSpec, GripperSpec, Shape, look_at

DARK = (0.16, 0.16, 0.18, 1.0)
PAD = (0.30, 0.30, 0.32, 1.0)
LIGHT = (0.78, 0.80, 0.83, 1.0)
BASE = "gripper_base_link"
COLOURS = {
    "gripper_base_link_inertia": DARK,
    "gripper_left_inner_finger_pad": PAD,
    "gripper_right_inner_finger_pad": PAD,
}

# The camera sits beside the gripper's body, across the direction in which the fingers close, and
# looks at a point a little beyond the fingertips.
T_GRIPPER_CAMERA = look_at(
    np.array([0.0, 0.095, 0.02]), np.array([0.0, -0.012, 0.25]), up=np.array([0.0, -1.0, 0.0])
)


def wrist_camera(T_gripper_camera: Array = T_GRIPPER_CAMERA) -> tuple[CameraSpec, Attachment]:
    """A camera on the gripper's base, at a pose `(4, 4)` in it, and the camera's housing."""
    housing = Attachment(
        "wrist_camera",
        BASE,
        # A D435's housing (90 x 25 x 25 mm), its front face just behind the optical centre, and
        # the arm that carries it from the gripper's body.
        (
            Shape("box", (0.09, 0.025, 0.025), pose([0, 0, -0.0175]), DARK),
            Shape("box", (0.02, 0.05, 0.01), pose([0, -0.03, -0.03]), DARK),
        ),
        T_gripper_camera,
        mass=0.1,
    )
    return CameraSpec("wrist", BASE, T_gripper_camera, fov_y_deg=60.0), housing


def two_finger_85(parent_frame: str, T_parent_gripper: Array | None = None) -> dict[str, Any]:
    """What a `RobotSpec` needs of a 2F-85 with a wrist camera, at `(4, 4)` of a frame of the arm.

    Left out, the pose is the frame's own: its z points out.
    """
    camera, housing = wrist_camera()
    return {
        "gripper": GripperSpec(
            urdf="airo_models:grippers/robotiq_2f_85/urdf/robotiq_2f_85.urdf",
            parent_frame=parent_frame,
            T_parent_gripper=np.eye(4) if T_parent_gripper is None else T_parent_gripper,
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
        "gripper_base": BASE,
        "T_gripper_tool": pose([0, 0, 0.145]),
        "cameras": (camera,),
        "attachments": (housing,),
    }
