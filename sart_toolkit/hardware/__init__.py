"""A real robot's parts behind small interfaces, and how its arm is moved.

`drivers` says what an arm, a gripper and a camera promise, and a world that isn't the real one;
each maker's is one file and one line in `DRIVERS`. One outside the repository needs no line,
`package.module:NAME` or `path/to/file.py:NAME` names it. `cell` reads the file that says which of
them a cell has, `servo` moves the arm, one period of its controller at a time.
"""

from __future__ import annotations

ARMS = {
    "ur_rtde": "sart_toolkit.hardware.ur:UrRtdeArm",
    "xarm": "sart_toolkit.hardware.xarm:XArm",
    "franka": "sart_toolkit.hardware.franka:Franka",
    "lerobot": "sart_toolkit.hardware.lerobot:LeRobotArm",
}
GRIPPERS = {
    "robotiq_socket": "sart_toolkit.hardware.robotiq:RobotiqSocket",
    "robotiq_modbus": "sart_toolkit.hardware.robotiq:RobotiqModbus",
}
CAMERAS = {
    "realsense": "sart_toolkit.hardware.realsense:RealSense",
    "opencv": "sart_toolkit.hardware.opencv:OpenCVCamera",
}
# By the kind of part that a cell's file names.
DRIVERS: dict[str, dict[str, str]] = {
    "arm": ARMS,
    "gripper": GRIPPERS,
    "camera": CAMERAS,
    # None is real: they are named by references.
    "world": {},
}
