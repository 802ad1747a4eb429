"""The UR5e with its gripper, and a two-joint robot of a few boxes for whatever need not be real."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from sart_toolkit.poses import pose
from sart_toolkit.robots import get_robot, urdf
from sart_toolkit.robots.model import RobotModel
from sart_toolkit.robots.spec import CameraSpec, GripperSpec, RobotSpec

_LINK = """<link name="{name}"><inertial><mass value="1"/><origin xyz="0 0 0" rpy="0 0 0"/>
  <inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/></inertial>
  <collision><geometry><box size="0.1 0.1 0.1"/></geometry></collision></link>"""
_JOINT = """<joint name="{name}" type="{type}"><parent link="{parent}"/><child link="{child}"/>
  <origin xyz="0 0 0.3" rpy="0 0 0"/><axis xyz="{axis}"/>
  <limit lower="-2" upper="2" effort="10" velocity="1"/></joint>"""


def _urdf(links: list[str], joints: list[tuple[str, str, str, str, str]]) -> str:
    names = ("name", "type", "parent", "child", "axis")
    parts = [_LINK.format(name=name) for name in links]
    parts += [_JOINT.format(**dict(zip(names, joint, strict=True))) for joint in joints]
    return f'<robot name="tiny">{"".join(parts)}</robot>'


@pytest.fixture(scope="session")
def spec() -> RobotSpec:
    return get_robot("ur5e_2f85")


@pytest.fixture(scope="session")
def model(spec: RobotSpec) -> RobotModel:
    return RobotModel(spec)


@pytest.fixture
def own_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Derived files of this test go here; nothing made before is reused."""
    monkeypatch.setenv("SART_CACHE", str(tmp_path / "cache"))
    monkeypatch.setattr(urdf, "_prepared", {})
    return tmp_path / "cache"


@pytest.fixture
def make_tiny(tmp_path: Path, own_cache: Path) -> Callable[..., RobotSpec]:
    """Makes the specification of a robot with two joints and one finger, with some fields changed.

    A change of `gripper` is a mapping of the gripper's own fields.
    """
    arm = _urdf(
        ["base_link", "upper", "flange"],
        [
            ("shoulder", "revolute", "base_link", "upper", "0 0 1"),
            ("wrist", "revolute", "upper", "flange", "0 1 0"),
        ],
    )
    hand = _urdf(
        ["base_link", "finger"], [("finger_joint", "revolute", "base_link", "finger", "1 0 0")]
    )
    (tmp_path / "arm.urdf").write_text(arm)
    (tmp_path / "hand.urdf").write_text(hand)

    def make(**changes: object) -> RobotSpec:
        gripper = GripperSpec(
            urdf=str(tmp_path / "hand.urdf"),
            parent_frame="flange",
            driver="gripper_finger_joint",
            followers={},
            closed_position=1.0,
            finger_links=("gripper_finger",),
        )
        inside = changes.pop("gripper", {})
        assert isinstance(inside, dict)
        fields: dict[str, object] = {
            "name": "tiny",
            "urdf": str(tmp_path / "arm.urdf"),
            "arm_joints": ("shoulder", "wrist"),
            "home": np.zeros(2),
            "velocity_limits": np.ones(2),
            "acceleration_limits": np.ones(2),
            "jerk_limits": np.ones(2),
            "gripper": dataclasses.replace(gripper, **inside),
            "gripper_base": "gripper_base_link",
            "T_gripper_tool": pose([0, 0, 0.1]),
            "cameras": (CameraSpec("wrist", "gripper_base_link", np.eye(4)),),
        }
        return RobotSpec(**{**fields, **changes})

    return make
