"""The joints of a composed URDF, brought to the one form that everything else relies on.

Arm joints turn about, or slide along, their own z axis within limits and with a force; the
gripper's joints are in proportion to its driver; all others are fixed.
"""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Iterator

import numpy as np

from sart_toolkit.errors import InvalidInput, unknown_name
from sart_toolkit.poses import Array, exp_rotation, inverse, pose
from sart_toolkit.robots.elements import add_joint, child_of, floats, origin_of, pose_of
from sart_toolkit.robots.spec import RobotSpec

# What a joint without limits, or with an effort of 0, gets: [rad], [N m], [N].
TURN = 2 * np.pi
TORQUE, FORCE = 100.0, 500.0
# Positions and limits may be rounded to a thousandth [rad or m].
_ROUNDED = 1.5e-3
_ALONG_Z = np.array([0.0, 0.0, 1.0])


def set_joints(spec: RobotSpec, robot: ET.Element) -> list[str]:
    """Bring the joints of a URDF to their one form, and say what had to be assumed.

    Args:
        spec: which joints are the arm's, and which the gripper's.
        robot: arm, gripper and what is fixed to them; its joints are changed in place.

    Raises:
        UnknownName: a joint of `spec` isn't there.
        InvalidInput: an arm joint is fixed, has no range, or doesn't follow the one before; a joint
            mimics another in a way that `spec` doesn't have; or the gripper goes beyond its limits.
    """
    for joint in robot.findall("joint"):
        # Readers take a fixed joint for a frame, and two of one name for an error.
        if joint.get("type") == "fixed" and joint.get("name") == child_of(joint, "child").get(
            "link"
        ):
            joint.set("name", f"{joint.get('name')}_joint")
    joints = {joint.get("name", ""): joint for joint in robot.findall("joint")}
    linkage = spec.gripper.ratios
    for kind, names in (
        ("joint", (*spec.arm_joints, *linkage)),
        ("joint of held_joints", spec.held_joints),
    ):
        for name in names:
            if name not in joints:
                movable = [n for n, joint in joints.items() if joint.get("type") != "fixed"]
                raise unknown_name(kind, name, movable or joints)
    _check_mimics(spec, joints)
    notes = []
    for name, joint in joints.items():
        if name in spec.arm_joints or name in linkage:
            notes += _limited(spec, name, joint)
        elif joint.get("type") != "fixed":
            notes += _held(spec, name, joint)
    for name in linkage:
        _check_positions(spec, joints[name])
    _check_chain(spec, joints)
    links = {link.get("name"): link for link in robot.findall("link")}
    for name in spec.arm_joints:
        _turn_to_z(robot, joints[name], links)
    return notes


def moving_groups(robot: ET.Element) -> Iterator[tuple[ET.Element, list[ET.Element]]]:
    """For each joint that moves: its child link, and all links that are rigid with it."""
    links = {link.get("name"): link for link in robot.findall("link")}
    fixed: dict[str | None, list[str | None]] = {}
    for joint in robot.findall("joint"):
        if joint.get("type") == "fixed":
            child = child_of(joint, "child").get("link")
            fixed.setdefault(child_of(joint, "parent").get("link"), []).append(child)
    for joint in robot.findall("joint"):
        if joint.get("type") == "fixed":
            continue
        names = [child_of(joint, "child").get("link")]
        for name in names:
            names += fixed.get(name, [])
        yield links[names[0]], [links[name] for name in names]


def _check_mimics(spec: RobotSpec, joints: dict[str, ET.Element]) -> None:
    """Take offsets of mimic joints into their frames, and check that the linkage has them all.

    Raises:
        InvalidInput: an arm joint mimics another, or a joint of the linkage is missing from it.
    """
    ratios = spec.gripper.ratios
    driver = spec.gripper.driver
    for name, joint in joints.items():
        mimic = joint.find("mimic")
        if mimic is None:
            continue
        joint.remove(mimic)
        leader = mimic.get("joint", "")
        ratio, offset = float(mimic.get("multiplier", 1)), float(mimic.get("offset", 0))
        if name in spec.arm_joints:
            raise InvalidInput(
                f"{spec.name}: arm joint {name!r} mimics {leader!r}; leave it out of arm_joints, "
                "or remove its <mimic>"
            )
        if leader in ratios and name not in ratios:
            raise InvalidInput(
                f"{spec.name}: joint {name!r} mimics {leader!r}; add {name!r}: "
                f"{ratio * ratios[leader]:g} to the gripper's followers"
            )
        if name == driver:
            raise InvalidInput(
                f"{spec.name}: the gripper's driver {name!r} mimics {leader!r}; let {leader!r} be "
                "the driver"
            )
        if offset and leader in ratios:
            _shift(joint, offset)


def _motion(joint: ET.Element, at: float) -> Array:
    """What a joint at a position does to its child's frame `(4, 4)`."""
    axis = _axis(joint)
    return pose(axis * at) if joint.get("type") == "prismatic" else pose((0, 0, 0), axis * at)


def _axis(joint: ET.Element) -> Array:
    element = joint.find("axis")
    return np.array([1.0, 0, 0] if element is None else floats(element.get("xyz", "")))


def _shift(joint: ET.Element, offset: float) -> None:
    """Let a joint be at 0 where it was at `offset`."""
    _set_origin(joint, pose_of(joint) @ _motion(joint, offset))
    limit = child_of(joint, "limit") if joint.get("type") != "continuous" else None
    if limit is not None:
        for name in ("lower", "upper"):
            limit.set(name, repr(float(limit.get(name, 0)) - offset))


def _set_origin(joint: ET.Element, T: Array) -> None:
    old = joint.find("origin")
    if old is not None:
        joint.remove(old)
    joint.append(origin_of(T))


def _limited(spec: RobotSpec, name: str, joint: ET.Element) -> list[str]:
    """Give a joint of arm or gripper what it lacks, and say what."""
    kind, notes = joint.get("type"), []
    if kind == "fixed":
        raise InvalidInput(
            f"{spec.name}: joint {name!r} is fixed in the URDF, expected one that moves; leave it "
            "out of the RobotSpec"
        )
    limit = joint.find("limit")
    if limit is None:
        limit = ET.SubElement(joint, "limit")
    if kind == "continuous":
        joint.set("type", "revolute")
        limit.set("lower", repr(-TURN))
        limit.set("upper", repr(TURN))
        notes.append(f"joint {name!r} turns without end: held to one turn to either side")
    lower, upper = (float(limit.get(bound, 0)) for bound in ("lower", "upper"))
    if not upper > lower:
        raise InvalidInput(
            f"{spec.name}: joint {name!r} has no range (lower and upper are {lower:g}); give its "
            "<limit> lower and upper in the URDF"
        )
    if not float(limit.get("effort", 0)) > 0:
        effort, unit = (FORCE, "N") if kind == "prismatic" else (TORQUE, "N m")
        limit.set("effort", repr(effort))
        if name in spec.arm_joints:
            notes.append(f"joint {name!r} has no effort: {effort:g} {unit} taken")
    if "velocity" not in limit.attrib:
        # Nothing uses it, but readers want it.
        limit.set("velocity", "1.0")
    return notes


def _held(spec: RobotSpec, name: str, joint: ET.Element) -> list[str]:
    """Fix a joint of neither arm nor gripper where it is held, and say where, unless told to."""
    limit = joint.find("limit")
    lower, upper = -np.inf, np.inf
    if limit is not None and joint.get("type") != "continuous":
        lower, upper = (float(limit.get(bound, 0)) for bound in ("lower", "upper"))
    at = float(spec.held_joints.get(name, np.clip(0.0, lower, upper)))
    if not lower - _ROUNDED <= at <= upper + _ROUNDED:
        raise InvalidInput(
            f"held_joints of {spec.name}: {name!r} at {at:g} is outside its limits [{lower:g}, "
            f"{upper:g}]; hold it within"
        )
    _set_origin(joint, pose_of(joint) @ _motion(joint, at))
    joint.set("type", "fixed")
    for tag in ("axis", "limit", "dynamics"):
        for child in joint.findall(tag):
            joint.remove(child)
    if name in spec.held_joints:
        return []
    return [f"joint {name!r} is of neither arm nor gripper: held at {at:g}"]


def _check_positions(spec: RobotSpec, joint: ET.Element) -> None:
    """Return if a linkage joint's positions, open and closed, are within its limits.

    A limit a little tight is widened.

    Raises:
        InvalidInput: they are not.
    """
    name, gripper = joint.get("name", ""), spec.gripper
    limit = child_of(joint, "limit")
    lower, upper = (float(limit.get(bound, 0)) for bound in ("lower", "upper"))
    for command, what in ((0.0, "open"), (1.0, "closed")):
        at = gripper.joint_positions(command)[name]
        if not lower - _ROUNDED <= at <= upper + _ROUNDED and name == gripper.driver:
            raise InvalidInput(
                f"{spec.name}: {what}_position {at:g} of the gripper's driver {name!r} is outside "
                f"its limits [{lower:g}, {upper:g}]; give a position within"
            )
        # Of followers many URDFs have limits that don't fit their ratio.
        lower, upper = min(lower, at), max(upper, at)
    limit.set("lower", repr(lower))
    limit.set("upper", repr(upper))


def _check_chain(spec: RobotSpec, joints: dict[str, ET.Element]) -> None:
    """Return if the arm's joints are one chain, in order, that carries the gripper.

    Raises:
        InvalidInput: a joint isn't carried by the one before, or the gripper not by the last.
    """
    by_child = {child_of(joint, "child").get("link", ""): joint for joint in joints.values()}

    def carriers(link: str) -> list[str]:
        """The arm's joints that move a link, the nearest first."""
        names = []
        while link in by_child:
            joint = by_child[link]
            if (name := joint.get("name", "")) in spec.arm_joints:
                names.append(name)
            link = child_of(joint, "parent").get("link", "")
        return names

    expected = list(reversed(spec.arm_joints))
    last = child_of(joints[spec.arm_joints[-1]], "child").get("link", "")
    if (got := carriers(last)) != expected:
        raise InvalidInput(
            f"{spec.name}: arm_joints must be in the URDF's order, a chain from the base to the "
            f"flange: {got[::-1]} move {last!r}, got {list(spec.arm_joints)}"
        )
    for what, link in (("gripper_base", spec.gripper_base), *(
        (f"gripper joint {name!r}", child_of(joints[name], "child").get("link", ""))
        for name in spec.gripper.ratios
    )):  # fmt: skip
        if carriers(link) != expected:
            raise InvalidInput(
                f"{spec.name}: {what} is not carried by the last arm joint "
                f"{spec.arm_joints[-1]!r}; check arm_joints and gripper"
            )


def _turn_to_z(robot: ET.Element, joint: ET.Element, links: dict[str | None, ET.Element]) -> None:
    """Let a joint's axis be its frame's z; a link between keeps its child's frame where it is."""
    axis = _axis(joint)
    if np.allclose(axis, _ALONG_Z, rtol=0, atol=1e-12):
        return
    across = np.cross(_ALONG_Z, axis)
    sine, cosine = float(np.linalg.norm(across)), float(axis[2])
    direction = across / sine if sine > 1e-9 else np.array([1.0, 0, 0])
    T = np.eye(4)
    T[:3, :3] = exp_rotation(direction * np.arctan2(sine, cosine))
    _set_origin(joint, pose_of(joint) @ T)
    element = joint.find("axis")
    if element is None:
        element = ET.SubElement(joint, "axis")
    element.set("xyz", "0 0 1")
    child = child_of(joint, "child")
    name = child.get("link", "")
    between = ET.SubElement(robot, "link", name=f"{name}_axis")
    # What moves should weigh something by itself: readers don't all merge links that are fixed.
    inertial = links[name].find("inertial")
    if inertial is not None:
        links[name].remove(inertial)
        T_link_inertial = pose_of(inertial)
        for old in inertial.findall("origin"):
            inertial.remove(old)
        inertial.insert(0, origin_of(inverse(T) @ T_link_inertial))
        between.append(inertial)
    child.set("link", f"{name}_axis")
    add_joint(robot, f"{name}_on_axis", f"{name}_axis", name, inverse(T), "fixed")
