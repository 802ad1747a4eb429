"""A URDF without its frames, for simulators that pay for each of its links."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from pathlib import Path
from typing import NamedTuple

from sart_toolkit.poses import Array
from sart_toolkit.robots.urdf import FRAME_MASS, element_pose, found_element, origin_element


class Bodies(NamedTuple):
    """A robot's links that have a mass or a shape of their own.

    Attributes:
        urdf: their URDF, its meshes named by absolute paths.
        frames: of each link left out, the link that it is fixed on, and its pose `(4, 4)` there.
    """

    urdf: str
    frames: dict[str, tuple[str, Array]]


def without_frames(urdf: Path) -> Bodies:
    """What is left of a composed URDF without the links that only name a place.

    Those are without a collision shape, no heavier than `FRAME_MASS`, and fixed on another link.
    What was joined to one is joined, at the same place, to what that one was fixed on.

    Args:
        urdf: what `composed_urdf` has made.
    """
    robot = ET.parse(urdf).getroot()
    links = {str(link.get("name")): link for link in robot.findall("link")}
    frames: dict[str, tuple[str, Array]] = {}
    for joint in robot.findall("joint"):
        child = _end(joint, "child")
        if joint.get("type") == "fixed" and _is_frame(links[child]):
            frames[child] = _end(joint, "parent"), element_pose(joint)
            robot.remove(joint)
            robot.remove(links[child])
    for child in frames:
        parent, T = frames[child]
        while parent in frames:
            parent, T_parent = frames[parent]
            T = T_parent @ T
        frames[child] = parent, T
    for joint in robot.findall("joint"):
        parent = _end(joint, "parent")
        if parent in frames:
            kept, T = frames[parent]
            found_element(joint, "parent").set("link", kept)
            origin = origin_element(T @ element_pose(joint))
            given = joint.find("origin")
            if given is not None:
                joint.remove(given)
            joint.append(origin)
    for mesh in robot.iter("mesh"):
        mesh.set("filename", str(urdf.parent / str(mesh.get("filename"))))
    return Bodies(ET.tostring(robot, encoding="unicode"), frames)


def _end(joint: ET.Element, tag: str) -> str:
    return str(found_element(joint, tag).get("link"))


def _is_frame(link: ET.Element) -> bool:
    mass = float(str(found_element(link, "inertial/mass").get("value")))
    return link.find("collision") is None and mass <= FRAME_MASS
