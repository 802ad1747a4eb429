"""Joints of any URDF come to one form, and the tool is where the source has it."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest

from sart_toolkit.errors import InvalidInput, UnknownName
from sart_toolkit.poses import pose
from sart_toolkit.robots.model import RobotModel
from sart_toolkit.robots.spec import GripperSpec, RobotSpec
from sart_toolkit.robots.urdf import assumptions

Make = Callable[..., RobotSpec]
AXES = ["0 0 1", "0 0 -1", "1 0 0", "0 -1 0", "1 1 0", "0.3 -0.4 0.5"]


@pytest.mark.parametrize("kind", ["revolute", "prismatic"])
@pytest.mark.parametrize("axis", AXES)
def test_a_joint_about_any_axis_moves_the_tool_as_in_the_source(
    make_tiny: Make, tmp_path: Path, axis: str, kind: str
) -> None:
    arm = tmp_path / "arm.urdf"
    text = arm.read_text().replace('xyz="0 1 0"', f'xyz="{axis}"')
    arm.write_text(text.replace('name="wrist" type="revolute"', f'name="wrist" type="{kind}"'))
    model = RobotModel(make_tiny())
    source = pin.buildModelFromUrdf(str(arm))
    data = source.createData()
    for q in np.random.default_rng(0).uniform(-1, 1, (5, 2)):
        pin.framesForwardKinematics(source, data, q)
        expected = data.oMf[source.getFrameId("flange")].homogeneous
        assert np.allclose(model.fk(q, "flange"), expected, rtol=0, atol=1e-9)
    assert model.slides.tolist() == [False, kind == "prismatic"]


def test_the_base_stands_where_it_is_put(make_tiny: Make) -> None:
    T = pose([0.5, -0.2, 0.7], [0.1, 0.2, 1.3])
    q = np.array([0.3, -0.4])
    moved = RobotModel(make_tiny(T_world_base=T))
    assert np.allclose(moved.fk(q), T @ RobotModel(make_tiny()).fk(q), rtol=0, atol=1e-9)


def test_arm_and_gripper_may_be_one_urdf_and_no_gripper_will_do(make_tiny: Make) -> None:
    spec = make_tiny()
    bare = dataclasses.replace(
        spec, gripper=GripperSpec(), gripper_base="flange", cameras=(), T_gripper_tool=np.eye(4)
    )
    assert spec.sources != bare.sources == (spec.urdf,)
    model = RobotModel(bare)
    assert np.array_equal(model.fk(spec.home), model.fk(spec.home, "flange"))
    one = dataclasses.replace(
        bare,
        arm_joints=("shoulder",),
        **dict.fromkeys(("home", "velocity_limits", "acceleration_limits"), np.ones(1)),
        jerk_limits=np.ones(1),
        gripper=GripperSpec(driver="wrist", open_position=1.0, finger_links=("flange",)),
        gripper_base="upper",
    )
    opened, closed = (RobotModel(one, gripper=g).fk(np.zeros(1), "flange") for g in (0.0, 1.0))
    assert np.allclose(opened[:3, :3], pose((0, 0, 0), (0, 1.0, 0))[:3, :3])
    assert np.allclose(closed[:3, :3], np.eye(3))


def test_a_joint_of_neither_arm_nor_gripper_is_held_where_it_is_told_to(
    make_tiny: Make, tmp_path: Path
) -> None:
    hand = tmp_path / "hand.urdf"
    hand.write_text(
        hand.read_text().replace(
            "</robot>",
            '<link name="extra"/><joint name="turn" type="revolute"><parent link="finger"/>'
            '<child link="extra"/><axis xyz="0 0 1"/><limit lower="0.1" upper="1"/></joint>'
            "</robot>",
        )
    )
    model = RobotModel(make_tiny())
    assert assumptions(model.urdf) == [
        "joint 'gripper_turn' is of neither arm nor gripper: held at 0.1"
    ]
    held = RobotModel(make_tiny(held_joints={"gripper_turn": 0.6}))
    assert not assumptions(held.urdf)
    q = np.zeros(2)
    turned = np.linalg.inv(model.fk(q, "gripper_extra")) @ held.fk(q, "gripper_extra")
    assert np.allclose(turned, pose((0, 0, 0), (0, 0, 0.5)))
    with pytest.raises(InvalidInput, match=r"'gripper_turn' at 2 is outside its limits \[0.1, 1"):
        RobotModel(make_tiny(held_joints={"gripper_turn": 2.0}))
    with pytest.raises(UnknownName, match="unknown joint of held_joints 'gripper_trun': did you"):
        RobotModel(make_tiny(held_joints={"gripper_trun": 2.0}))


def test_a_mimic_joint_that_the_gripper_lacks_is_named_with_its_ratio(
    make_tiny: Make, tmp_path: Path
) -> None:
    hand = tmp_path / "hand.urdf"
    hand.write_text(
        hand.read_text().replace(
            "</robot>",
            '<link name="tip"/><joint name="tip_joint" type="revolute"><parent link="finger"/>'
            '<child link="tip"/><axis xyz="0 0 1"/><limit lower="-1" upper="1"/>'
            '<mimic joint="finger_joint" multiplier="-0.5" offset="0.2"/></joint></robot>',
        )
    )
    with pytest.raises(
        InvalidInput, match="add 'gripper_tip_joint': -0.5 to the gripper's followers"
    ):
        RobotModel(make_tiny())
    spec = make_tiny(gripper={"followers": {"gripper_tip_joint": -0.5}})
    q = np.zeros(2)
    for command in (0.0, 1.0):
        model = RobotModel(spec, gripper=command)
        turn = np.linalg.inv(model.fk(q, "gripper_finger")) @ model.fk(q, "gripper_tip")
        assert np.allclose(turn, pose((0, 0, 0), (0, 0, 0.2 - 0.5 * command)), atol=1e-9)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"gripper": {"closed_position": 2.5}}, "closed_position 2.5 of the gripper's driver"),
        ({"gripper": {"open_position": -3.0}}, r"open_position -3 .* outside its limits \[-2, 2"),
        ({"arm_joints": ("wrist", "shoulder")}, "arm_joints must be in the URDF's order, a chain"),
        ({"arm_joints": ("shoulder", "gripper_finger_joint")}, "arm_joints|not carried"),
        ({"gripper_base": "gripper_finger"}, "is the child of two joints"),
    ],
)
def test_joints_that_are_not_as_the_robot_has_them_are_refused(
    make_tiny: Make, changes: dict[str, object], message: str
) -> None:
    with pytest.raises(InvalidInput, match=message):
        RobotModel(make_tiny(**changes))


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('lower="-2" upper="2"', "", "joint 'shoulder' has no range"),
        ('lower="-2" upper="2"', 'lower="-180" upper="180"', "give it in rad, not degrees"),
        ('name="shoulder" type="revolute"', 'name="shoulder" type="fixed"', "is fixed in the URDF"),
        ('type="revolute"', 'type="floating"', "expected one of revolute, continuous, prismatic"),
        ('ixx="1" ixy="0"', 'ixx="1" ixy="5"', "no body has it, its least principal moment"),
    ],
)
def test_what_no_arm_has_is_refused_with_what_to_do(
    make_tiny: Make, tmp_path: Path, old: str, new: str, message: str
) -> None:
    arm = tmp_path / "arm.urdf"
    assert old in arm.read_text()
    arm.write_text(arm.read_text().replace(old, new, 1))
    with pytest.raises(InvalidInput, match=message):
        RobotModel(make_tiny())


@pytest.mark.parametrize(
    ("old", "new", "note"),
    [
        ('effort="10"', 'effort="0"', "joint 'shoulder' has no effort: 100 N m taken"),
        ('effort="10"', "", "joint 'shoulder' has no effort: 100 N m taken"),
        ('ixx="1"', 'ixx="5"', "link 'upper': no body has its inertia, its greatest moment"),
    ],
)
def test_what_is_missing_or_impossible_gets_a_default_that_is_stated_once(
    make_tiny: Make,
    tmp_path: Path,
    caplog: pytest.LogCaptureFixture,
    old: str,
    new: str,
    note: str,
) -> None:
    arm = tmp_path / "arm.urdf"
    head, tail = arm.read_text().split('<link name="upper">')
    arm.write_text(f'{head}<link name="upper">{tail.replace(old, new, 1)}')
    name = re.sub(r"\W", "", f"tiny{note}{new}")
    for _ in range(2):
        model = RobotModel(make_tiny(name=name))
    assert any(each.startswith(note) for each in assumptions(model.urdf))
    assert len([r for r in caplog.records if "lists what was assumed" in r.message]) == 1


def test_a_link_that_moves_without_mass_weighs_what_its_hull_would(
    make_tiny: Make, tmp_path: Path
) -> None:
    arm = tmp_path / "arm.urdf"
    text = re.sub(r'(?s)(<link name="upper">)<inertial>.*?</inertial>', r"\1", arm.read_text())
    arm.write_text(text)
    model = RobotModel(make_tiny())
    assert model.pinocchio_model.inertias[1].mass == pytest.approx(1.0)
    (note,) = assumptions(model.urdf)
    assert note == "link 'upper' has no mass: 1 kg taken, its hull at 1000 kg/m³"


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"urdf": "hand.urdf"}, "expected both or neither of urdf and parent_frame"),
        ({"followers": {"a": 1.0}}, "has followers or positions but no driver"),
        ({"driver": "a"}, "open_position and closed_position are both 0.0"),
        ({"driver": "a", "closed_position": np.nan}, "expected two positions|expected a number"),
        ({"driver": "a", "closed_position": 1.0, "force": 0.0}, "force: expected"),
    ],
)
def test_a_gripper_that_means_nothing_is_refused(fields: dict[str, object], message: str) -> None:
    with pytest.raises(InvalidInput, match=message):
        GripperSpec(**fields)


def test_a_gripper_may_be_closed_at_zero() -> None:
    gripper = GripperSpec(driver="a", followers={"b": -1.0}, open_position=0.04)
    assert gripper.joint_positions(0.0) == {"a": 0.04, "b": -0.04}
    assert gripper.joint_positions(1.0) == {"a": 0.0, "b": 0.0}
    assert gripper.command_at(0.01) == pytest.approx(0.75)
