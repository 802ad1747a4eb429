"""A robot of your own: a KUKA iiwa with seven joints, a Robotiq 2F-85 and a wrist camera.

In Python: python docs/examples/04_own_robot.py OUT_DIR [N_TRAJECTORIES EPOCHS ROLLOUTS]
By verbs:  sart run peg_in_hole --robot docs/examples/04_own_robot.py:IIWA --out OUT_DIR
"""

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np

import sart_toolkit as sart

# The gripper of a robot that is known already, on this arm's flange.
UR5E = sart.get_robot("ur5e_2f85")
GRIPPER = replace(
    UR5E.gripper,
    parent_frame="lbr_iiwa_link_7",
    T_parent_gripper=sart.pose([0.0, 0.0, 0.045], [0.0, 0.0, -np.pi / 2]),
)
BASE = "gripper_base_link"
T_BASE_CAMERA = sart.look_at(
    np.array([0.0, 0.095, 0.02]), np.array([0.0, -0.012, 0.25]), up=np.array([0.0, -1.0, 0.0])
)
HOUSING = sart.Attachment(
    "camera_housing",
    BASE,
    (
        sart.Shape("box", (0.09, 0.025, 0.025), sart.pose([0.0, 0.0, -0.0175])),
        sart.Shape("box", (0.02, 0.05, 0.01), sart.pose([0.0, -0.03, -0.03])),
    ),
    T_BASE_CAMERA,
)

IIWA = sart.RobotSpec(
    name="iiwa_2f85",
    # Of the package pybullet_data; a plain path will do as well.
    urdf="pybullet_data:kuka_iiwa/model.urdf",
    arm_joints=tuple(f"lbr_iiwa_joint_{i}" for i in range(1, 8)),
    home=np.array([0.0, 0.45, 0.0, -1.77, 0.0, 0.92, 0.0]),
    velocity_limits=np.full(7, 1.7),
    acceleration_limits=np.full(7, 10.0),
    jerk_limits=np.full(7, 400.0),
    gripper=GRIPPER,
    gripper_base=BASE,
    T_gripper_tool=UR5E.T_gripper_tool,
    cameras=(sart.CameraSpec("wrist", BASE, T_BASE_CAMERA, fov_y_deg=60.0),),
    attachments=(HOUSING,),
)


def main(out: Path, n: int = 40, epochs: int = 60, rollouts: int = 20) -> None:
    result = sart.run("peg_in_hole", out, robot=IIWA, n=n, epochs=epochs, episodes=rollouts)
    print(f"{result['success']} succeeded; the page: {result['report']}")


if __name__ == "__main__":
    main(Path(sys.argv[1]), *map(int, sys.argv[2:]))
