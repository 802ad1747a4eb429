"""An arm of six joints with parallel jaws, made of boxes, in one URDF."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from sart_toolkit.poses import pose
from sart_toolkit.robots.spec import CameraSpec, GripperSpec, RobotSpec, look_at


def _link(name: str, size: str, xyz: str = "0 0 0", mass: float = 1.0) -> str:
    shape = f'<origin xyz="{xyz}"/><geometry><box size="{size}"/></geometry>'
    i = mass * 1e-3
    return (
        f'<link name="{name}"><inertial><origin xyz="{xyz}"/><mass value="{mass}"/>'
        f'<inertia ixx="{i}" iyy="{i}" izz="{i}" ixy="0" ixz="0" iyz="0"/></inertial>'
        f"<visual>{shape}</visual><collision>{shape}</collision></link>\n"
    )


def _joint(
    name: str, parent: str, child: str, xyz: str, axis: str,
    kind: str = "revolute", limits: str = 'lower="-2.9" upper="2.9"', more: str = "",
) -> str:  # fmt: skip
    return (
        f'<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>'
        f'<origin xyz="{xyz}"/><axis xyz="{axis}"/>'
        f'<limit {limits} effort="80" velocity="2"/>{more}</joint>\n'
    )


SLIDE = 'lower="0" upper="0.04"'
URDF = (
    '<robot name="toy">'
    + _link("base", "0.1 0.1 0.1", "0 0 0.05")
    + _link("l1", "0.08 0.08 0.08", "0 0 0.05")
    + _link("l2", "0.06 0.06 0.25", "0 0 0.175")
    + _link("l3", "0.06 0.06 0.25", "0 0 0.175")
    + _link("l4", "0.05 0.05 0.05", "0 0 0.03", 0.5)
    + _link("l5", "0.05 0.05 0.04", "0 0 0.04", 0.5)
    + _link("hand", "0.14 0.05 0.04", "0 0 0.05", 0.5)
    + _link("left", "0.01 0.02 0.06", "0 0 0.03", 0.1)
    + _link("right", "0.01 0.02 0.06", "0 0 0.03", 0.1)
    + _joint("j1", "base", "l1", "0 0 0.1", "0 0 1")
    + _joint("j2", "l1", "l2", "0 0 0.1", "0 1 0")
    + _joint("j3", "l2", "l3", "0 0 0.35", "0 1 0")
    + _joint("j4", "l3", "l4", "0 0 0.35", "0 1 0")
    + _joint("j5", "l4", "l5", "0 0 0.08", "1 0 0")
    + _joint("j6", "l5", "hand", "0 0 0.05", "0 0 1")
    + _joint("grip", "hand", "left", "0.05 0 0.08", "-1 0 0", "prismatic", SLIDE)
    + _joint(
        "grip2",
        "hand",
        "right",
        "-0.05 0 0.08",
        "1 0 0",
        "prismatic",
        SLIDE,
        '<mimic joint="grip"/>',
    )  # fmt: skip
    + "</robot>"
)


@pytest.fixture
def toy(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., RobotSpec]:
    """Makes the robot, some fields changed; its URDF is `toy.urdf` of the test's folder."""
    monkeypatch.setenv("SART_CACHE", str(tmp_path / "cache"))
    urdf = tmp_path / "toy.urdf"
    urdf.write_text(URDF)

    def make(**changes: object) -> RobotSpec:
        gripper = changes.pop("gripper", {})
        assert isinstance(gripper, dict)
        camera = CameraSpec(
            "wrist", "hand",
            look_at(np.array([0, 0.1, 0.05]), np.array([0, 0, 0.2]), np.array([0, -1.0, 0])),
        )  # fmt: skip
        fields: dict[str, object] = {
            "name": "toy",
            "urdf": str(urdf),
            "arm_joints": tuple(f"j{i}" for i in range(1, 7)),
            "home": np.array([0, 0.1, 1.6, 1.44, 0, 0.0]),
            "velocity_limits": np.full(6, 2.0),
            "acceleration_limits": np.full(6, 10.0),
            "jerk_limits": np.full(6, 400.0),
            "gripper": GripperSpec(
                **{
                    "driver": "grip",
                    "followers": {"grip2": 1.0},
                    "closed_position": 0.04,
                    "finger_links": ("left", "right"),
                    "force": 40.0,
                    "speed": 0.1,
                    "armature": 0.3,
                    **gripper,
                }
            ),
            "gripper_base": "hand",
            "T_gripper_tool": pose([0, 0, 0.13]),
            "cameras": (camera,),
        }
        return RobotSpec(**{**fields, **changes})

    return make
