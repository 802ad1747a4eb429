"""Elements of a URDF: what they say, and new ones."""

from __future__ import annotations

import re
import xml.etree.ElementTree as ET
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from sart_toolkit.poses import Array, rpy_pose
from sart_toolkit.robots.spec import BodyShape, ConvexShape, MeshShape, Shape, mass_properties

if TYPE_CHECKING:
    import trimesh


def child_of(element: ET.Element, tag: str) -> ET.Element:
    """An element's child of that tag, which is known to be there."""
    found = element.find(tag)
    assert found is not None
    return found


def floats(text: str) -> list[float]:
    """The numbers of an attribute."""
    return [float(word) for word in text.split()]


def as_text(values: Any) -> str:
    """Numbers as an attribute has them."""
    return " ".join(f"{float(v):.12g}" for v in values)


def pose_of(element: ET.Element) -> Array:
    """An element's pose `(4, 4)` in its link."""
    origin = element.find("origin")
    given = {} if origin is None else origin.attrib
    return rpy_pose(*(floats(given.get(key, "0 0 0")) for key in ("xyz", "rpy")))


def origin_of(T: Array) -> ET.Element:
    """The `<origin>` of a pose `(4, 4)`."""
    R = T[:3, :3]
    pitch = np.arctan2(-R[2, 0], np.hypot(R[0, 0], R[1, 0]))
    if np.cos(pitch) > 1e-6:
        roll, yaw = np.arctan2(R[2, 1], R[2, 2]), np.arctan2(R[1, 0], R[0, 0])
    else:
        roll, yaw = np.arctan2(-R[1, 2], R[1, 1]), 0.0
    return ET.Element("origin", xyz=as_text(T[:3, 3]), rpy=as_text([roll, pitch, yaw]))


def shape_of(element: ET.Element) -> Shape:
    """The primitive of a visual or collision element, in the link's frame."""
    T = pose_of(element)
    shape = child_of(element, "geometry")[0]
    if shape.tag == "box":
        x, y, z = floats(shape.get("size", ""))
        return Shape("box", (x, y, z), T)
    radius = float(shape.get("radius", ""))
    if shape.tag == "sphere":
        return Shape("sphere", (radius,), T)
    return Shape("cylinder", (radius, float(shape.get("length", ""))), T)


def geometry_of(shape: Shape) -> ET.Element:
    """The `<geometry>` of a primitive."""
    geometry = ET.Element("geometry")
    if shape.kind == "box":
        ET.SubElement(geometry, "box", size=as_text(shape.size))
    elif shape.kind == "cylinder":
        radius, length = (f"{v:.9g}" for v in shape.size)
        ET.SubElement(geometry, "cylinder", radius=radius, length=length)
    else:
        ET.SubElement(geometry, "sphere", radius=f"{shape.size[0]:.9g}")
    return geometry


def material_of(name: str, rgba: tuple[float, ...]) -> ET.Element:
    """A `<material>` of its own name, of a colour in [0, 1]."""
    material = ET.Element("material", name=f"{name}_colour")
    ET.SubElement(material, "color", rgba=as_text(rgba))
    return material


def inertial_of(mass: float, p: Array, inertia: Array) -> ET.Element:
    """The `<inertial>` of a mass [kg], its centre `(3,)` [m] and inertia `(3, 3)` [kg m²]."""
    inertial = ET.Element("inertial")
    ET.SubElement(inertial, "origin", xyz=as_text(p), rpy="0 0 0")
    ET.SubElement(inertial, "mass", value=f"{mass:.9g}")
    inertial.append(inertia_of(inertia))
    return inertial


def inertia_of(inertia: Array) -> ET.Element:
    """The `<inertia>` of a matrix `(3, 3)` [kg m²]."""
    entries = {
        f"i{a}{b}": f"{inertia[i, j]:.9g}"
        for i, a in enumerate("xyz")
        for j, b in enumerate("xyz")
        if i <= j
    }
    return ET.Element("inertia", entries)


def add_joint(
    robot: ET.Element, name: str, parent: str, child: str, T_parent_child: Array, kind: str
) -> ET.Element:
    """A joint of a URDF's `robot` element, by its kind (`fixed`, `revolute` or `prismatic`)."""
    joint = ET.SubElement(robot, "joint", name=name, type=kind)
    joint.append(origin_of(T_parent_child))
    ET.SubElement(joint, "parent", link=parent)
    ET.SubElement(joint, "child", link=child)
    return joint


def rigid_link(
    name: str, shapes: Sequence[BodyShape], mass: float, folder: Path, number: str = ""
) -> ET.Element:
    """A URDF link of shapes, its inertia that of an even mass [kg]; 0 for one that is fixed.

    Args:
        name: of the link.
        shapes: what it is made of.
        mass: [kg].
        folder: where the meshes are written that it names, beside the URDF.
        number: tells its meshes from those of other links in the folder.
    """
    link = ET.Element("link", name=name)
    link.append(inertial_of(mass, *mass_properties(shapes, mass or 1.0)))
    stem = f"{number}_{file_stem(name)}"
    for index, shape in enumerate(shapes):
        drawn: Sequence[tuple[Shape | trimesh.Trimesh, tuple[float, float, float, float]]]
        drawn = shape.drawn() if isinstance(shape, MeshShape) else [(shape, shape.rgba)]
        for piece, (what, rgba) in enumerate(drawn):
            element = ET.SubElement(link, "visual")
            element.append(origin_of(shape.T_body_shape))
            at = f"{index}" if len(drawn) == 1 else f"{index}_{piece}"
            element.append(_written(what, folder / f"{stem}_visual_{at}.obj"))
            element.append(material_of(f"{name}_{at}", rgba))
        for piece, part in enumerate(shape.convex_parts() if shape.collides else ()):
            element = ET.SubElement(link, "collision")
            element.append(origin_of(shape.T_body_shape))
            element.append(_written(part, folder / f"{stem}_collision_{index}_{piece}.obj"))
    return link


def file_stem(name: str) -> str:
    """A name as part of a file's, safe for any file system."""
    return re.sub(r"[^A-Za-z0-9]+", "_", name)[:40]


def _written(what: ConvexShape | trimesh.Trimesh, path: Path) -> ET.Element:
    """The `<geometry>` of a primitive, or of a mesh or hull, which is written to a file."""
    if isinstance(what, Shape):
        return geometry_of(what)
    from sart_toolkit.robots.meshes import hull_mesh, write_obj

    if isinstance(what, np.ndarray):
        write_obj(hull_mesh(what), path)
    else:
        write_obj(what, path, normals=True)
    geometry = ET.Element("geometry")
    ET.SubElement(geometry, "mesh", filename=path.name)
    return geometry
