"""Arms from packages' own files, unmodified, for `python tools/robots.py` and as examples.

They need `pip install 'sart_toolkit[robots]'` and the packages that their URDFs name.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from sart_toolkit.poses import pose
from sart_toolkit.robots import get_robot
from sart_toolkit.robots.spec import CameraSpec, GripperSpec, RobotSpec, look_at

_ERD = "example-robot-data:cmeel.prefix/share/example-robot-data/robots"
_TURNED = pose((0, 0, 0), (0, 0, -np.pi / 2))
_OUT_OF_X = pose((0, 0, 0), (0, np.pi / 2, 0))


def _arm(
    name: str,
    urdf: str,
    joints: list[str],
    home: list[float],
    base: str,
    T_base_tool: Any,
    gripper: GripperSpec | None = None,
    **more: Any,
) -> RobotSpec:
    """An arm with a camera beside its tool; without a gripper, with a fixed tool."""
    n = len(joints)
    p, up = T_base_tool @ [0.0, 0.09, -0.1, 1], -T_base_tool[:3, 1]
    T_base_camera = look_at(p[:3], (T_base_tool @ [0, 0, 0.1, 1])[:3], up)
    limits: dict[str, Any] = {
        "velocity_limits": np.full(n, 1.3),
        "acceleration_limits": np.full(n, 10.0),
        "jerk_limits": np.full(n, 400.0),
    }
    return RobotSpec(
        name,
        urdf,
        tuple(joints),
        np.array(home),
        gripper=gripper or GripperSpec(),
        gripper_base=base,
        T_gripper_tool=T_base_tool,
        cameras=(CameraSpec("wrist", base, T_base_camera),),
        **{**limits, **more},
    )


_PANDA, _XARM7 = get_robot("panda"), [f"joint{i}" for i in range(1, 8)]
_PANDA_HOME = _PANDA.home.tolist()

# The Panda of two more sources, its gripper closed at 0 in all.
PANDA_ERD, PANDA_MS = (
    _arm(
        name,
        urdf,
        list(_PANDA.arm_joints),
        _PANDA_HOME,
        "panda_hand",
        _PANDA.T_gripper_tool,
        _PANDA.gripper,
    )  # fmt: skip
    for name, urdf in (
        ("panda_erd", f"{_ERD}/panda_description/urdf/panda.urdf"),
        ("panda_ms", "mani_skill:assets/robots/panda/panda_v2.urdf"),
    )
)
# A fixed tool.
PANDA_STICK = _arm(
    "panda_stick", "mani_skill:assets/robots/panda/panda_stick.urdf", list(_PANDA.arm_joints),
    _PANDA_HOME, "panda_link8", pose([0, 0, 0.2], [0, 0, np.pi / 4]),
)  # fmt: skip
XARM7_MS = _arm(
    "xarm7_ms", "mani_skill:assets/robots/xarm7/xarm7.urdf", _XARM7,
    [0, -0.4, 0, 0.9, 0, 1.3, 0], "link7", pose([0, 0, 0.12], [0, 0, np.pi / 2]),
)  # fmt: skip
UR3 = _arm(
    "ur3", f"{_ERD}/ur_description/urdf/ur3_robot.urdf",
    list(get_robot("ur5e_2f85").arm_joints), [0, -1.7, 1.9, -1.77, -np.pi / 2, 0], "tool0",
    pose([0, 0, 0.1]), T_world_base=pose([0.18, 0, 0]),
)  # fmt: skip
IIWA14 = _arm(
    "iiwa14", "rtbdata:xacro/kuka_description/kuka_lbr_iiwa/urdf/lbr_iiwa_14_r820.urdf",
    [f"joint_a{i}" for i in range(1, 8)], [0, 0.45, 0, -1.77, 0, 0.92, 0], "tool0",
    pose([0, 0, 0.1], [0, 0, -np.pi / 2]),
)  # fmt: skip
Z1 = _arm(
    "z1", f"{_ERD}/z1_description/urdf/z1.urdf", _XARM7[:6], [0, 1.7, -1.2, 1.07, 0, 0],
    "gripperStator", pose([0.17, 0, 0]) @ _OUT_OF_X @ _TURNED,
    GripperSpec(
        driver="jointGripper",
        open_position=-0.8,
        closed_position=0.0,
        finger_links=("gripperMover", "gripperStator"),
    ),
    T_world_base=pose([0.24, 0, 0.17]),
)  # fmt: skip
KINOVA = _arm(
    "kinova", f"{_ERD}/kinova_description/robots/kinova.urdf",
    [f"j2s6s200_joint_{i}" for i in range(1, 7)], [-1.022, 3.991, 1.606, 1.989, 1.204, 2.464],
    "j2s6s200_end_effector", pose(), velocity_limits=np.full(6, 0.62),
)  # fmt: skip
# Five joints.
SO101 = _arm(
    "so101", f"{_ERD}/so_arm_description/urdf/so101.urdf",
    ["shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll"],
    [0, 0.4, 0.1, 1.07, 0], "gripper_frame_link", _TURNED,
    GripperSpec(
        driver="gripper",
        open_position=1.0,
        closed_position=-0.17,
        finger_links=("moving_jaw_so101_v1_link", "gripper_link"),
    ),
    T_world_base=pose([0.25, 0, 0.235]),
)  # fmt: skip
# Eight joints, the first of which slides.
FETCH = _arm(
    "fetch", "mani_skill:assets/robots/fetch/fetch.urdf",
    [
        "torso_lift_joint", "shoulder_pan_joint", "shoulder_lift_joint", "upperarm_roll_joint",
        "elbow_flex_joint", "forearm_roll_joint", "wrist_flex_joint", "wrist_roll_joint",
    ],
    [0.2, 0, -0.5, 0, 1.3, 0, 0.77, 0], "gripper_link", _OUT_OF_X @ _TURNED,
    GripperSpec(
        driver="r_gripper_finger_joint",
        followers={"l_gripper_finger_joint": 1.0},
        open_position=0.05,
        closed_position=0.0,
        finger_links=("r_gripper_finger_link", "l_gripper_finger_link"),
        force=60.0,
        speed=0.05,
        armature=0.3,
    ),
    T_world_base=pose([-0.2, 0, -0.35]),
    velocity_limits=np.array([0.1, 1.25, 1.3, 1.3, 1.3, 1.3, 1.3, 1.3]),
    held_joints=dict.fromkeys(
        (
            "root_x_axis_joint", "root_y_axis_joint", "root_z_rotation_joint", "head_pan_joint",
            "head_tilt_joint",
        ),
        0.0,
    ),
)  # fmt: skip

ARMS = (
    PANDA_ERD, PANDA_MS, PANDA_STICK, XARM7_MS, UR3, IIWA14, Z1, KINOVA, SO101, FETCH,
)  # fmt: skip
