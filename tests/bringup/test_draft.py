"""A robot drafted from its URDF passes its examination, or is said to need what it lacks."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from sart_toolkit.bringup.draft import draft_robot
from sart_toolkit.bringup.examine import examine
from sart_toolkit.bringup.skeleton import write_source
from sart_toolkit.errors import InvalidInput, MissingFile, OutputExists
from sart_toolkit.robots import get_robot
from sart_toolkit.robots.model import RobotModel
from sart_toolkit.robots.spec import RobotSpec

Make = Callable[..., RobotSpec]


@pytest.fixture
def drafted(toy: Make, tmp_path: Path) -> RobotSpec:
    """The robot that the file of a draft of the toy makes."""
    toy()
    draft = draft_robot(str(tmp_path / "toy.urdf"))
    write_source(draft.text, tmp_path / "drafted.py")
    return get_robot(f"{tmp_path / 'drafted.py'}:TOY")


def test_arm_gripper_and_its_polarity_are_read_from_the_urdf(toy: Make, drafted: RobotSpec) -> None:
    by_hand = toy()
    assert drafted.arm_joints == by_hand.arm_joints
    assert drafted.gripper.driver == "grip"
    assert drafted.gripper.followers == {"grip2": 1.0}
    assert (drafted.gripper.open_position, drafted.gripper.closed_position) == (0.0, 0.04)
    assert set(drafted.gripper.finger_links) == {"left", "right"}
    assert np.array_equal(drafted.velocity_limits, np.full(6, 2.0))


def test_a_gripper_that_is_closed_at_zero_is_seen_to_be(toy: Make, tmp_path: Path) -> None:
    toy()
    urdf = tmp_path / "toy.urdf"
    text = urdf.read_text().replace('axis xyz="-1 0 0"', 'axis xyz="9 0 0"')
    text = text.replace('axis xyz="1 0 0"/><limit lower="0"', 'axis xyz="-1 0 0"/><limit lower="0"')
    urdf.write_text(text.replace("0.05 0 0.08", "0.01 0 0.08"))
    gripper = draft_robot(str(urdf)).robot.gripper
    assert (gripper.open_position, gripper.closed_position) == (0.04, 0.0)


def test_the_tool_points_out_between_the_fingers_and_down_at_home(drafted: RobotSpec) -> None:
    T = drafted.T_gripper_tool
    assert np.allclose(np.abs(T[:3, 0]), [1, 0, 0], atol=1e-5)
    assert np.allclose(T[:3, 2], [0, 0, 1], atol=1e-5)
    assert np.allclose(T[:3, 3], [0, 0, 0.13], atol=0.02)
    assert np.allclose(RobotModel(drafted).fk(drafted.home)[:3, 2], [0, 0, -1], atol=1e-2)


def test_a_drafted_robot_passes_its_examination(drafted: RobotSpec) -> None:
    assert [f for f in examine(drafted) if f.required and not f.ok] == []


def test_a_draft_says_what_to_complete_and_does_not_replace_a_file(
    toy: Make, tmp_path: Path
) -> None:
    toy()
    draft = draft_robot(str(tmp_path / "toy.urdf"), "my arm")
    assert "MY_ARM = sart.RobotSpec(" in draft.text
    assert draft.text.count("# complete:") >= 3
    write_source(draft.text, tmp_path / "a.py")
    with pytest.raises(OutputExists, match="pass --overwrite"):
        write_source(draft.text, tmp_path / "a.py")


def test_an_arm_without_fingers_gets_a_fixed_tool(toy: Make, tmp_path: Path) -> None:
    toy()
    urdf = tmp_path / "toy.urdf"
    urdf.write_text(urdf.read_text().replace('type="prismatic"', 'type="fixed"'))
    robot = draft_robot(str(urdf)).robot
    assert robot.gripper.driver is None
    assert len(robot.arm_joints) == 6


def test_a_urdf_without_joints_is_no_robot(tmp_path: Path) -> None:
    urdf = tmp_path / "block.urdf"
    urdf.write_text('<robot name="block"><link name="block"/></robot>')
    with pytest.raises(InvalidInput, match=r"block.urdf: no joint moves, expected those of an arm"):
        draft_robot(str(urdf))
    with pytest.raises(MissingFile, match="no such file"):
        draft_robot(str(tmp_path / "none.urdf"))
