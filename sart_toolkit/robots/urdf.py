"""One URDF from an arm, a gripper and what is fixed to them, with light meshes, made once.

Visual meshes are simplified, collision meshes become their convex hulls (which enclose them), and
names get a prefix, so that any simulator and Pinocchio read the same small file.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import os
import re
import shutil
import tempfile
import xml.etree.ElementTree as ET
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import fast_simplification
import numpy as np
import trimesh

from sart_toolkit.errors import BrokenFile, CannotWrite, InvalidInput, SartError, unknown_name
from sart_toolkit.poses import Array
from sart_toolkit.robots.spec import (
    Attachment,
    RobotSpec,
    Shape,
    mass_properties,
    resource_path,
)

# Bump when the composition changes, so that cached files of an older version are not used.
_RECIPE = 11
_ARM_FACES, _GRIPPER_FACES = 150, 300
_GRIPPER_PREFIX = "gripper_"


def cache_dir() -> Path:
    """Where derived files are kept: `$SART_CACHE`, or the user's cache directory."""
    root = os.environ.get("SART_CACHE") or os.environ.get("XDG_CACHE_HOME")
    return Path(root or Path.home() / ".cache") / "sart_toolkit"


def composed_urdf(spec: RobotSpec, held: Sequence[Attachment] = ()) -> Path:
    """The path of the robot's single URDF, with the held bodies fixed on; made once, then cached.

    Raises:
        MissingExtra, MissingFile: a source URDF isn't there.
        BrokenFile: a source URDF can't be parsed.
        InvalidInput: two links or joints have the same name, a link is drawn but has no collision
            shape, or a collision mesh is empty or not finite.
    """
    sources = [resource_path(spec.urdf), resource_path(spec.gripper.urdf)]
    attachments = [*spec.attachments, *held]
    key = hashlib.sha256(
        json.dumps(
            {
                "recipe": _RECIPE,
                "faces": (_ARM_FACES, _GRIPPER_FACES),
                "sources": [(str(p), p.stat().st_size, p.stat().st_mtime) for p in sources],
                # Cameras are no part of a URDF: one that is moved a little needs no new one.
                "spec": {k: v for k, v in _plain(spec).items() if k != "cameras"},
                "attachments": _plain(attachments),
            },
            sort_keys=True,
        ).encode()
    ).hexdigest()[:16]
    directory = cache_dir() / f"{spec.name}-{key}"
    urdf = directory / "robot.urdf"
    if not urdf.exists():
        try:
            _make(spec, attachments, sources, urdf)
        except SartError:
            raise
        except OSError as error:
            raise CannotWrite(
                f"{directory}: {error.strerror or error}; set SART_CACHE to a folder that can be "
                "written"
            ) from error
    return urdf


def _make(
    spec: RobotSpec, attachments: Sequence[Attachment], sources: list[Path], urdf: Path
) -> None:
    """Compose in a temporary folder, then rename it to the URDF's own."""
    directory = urdf.parent
    directory.parent.mkdir(parents=True, exist_ok=True)
    work = Path(tempfile.mkdtemp(dir=directory.parent, prefix=f".{spec.name}-"))
    try:
        _compose(spec, attachments, sources, work)
        try:
            os.replace(work, directory)
        except OSError:
            # Another process has just put the same files there.
            if not urdf.exists():
                raise
    finally:
        shutil.rmtree(work, ignore_errors=True)


def _plain(value: Any) -> Any:
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {f.name: _plain(getattr(value, f.name)) for f in dataclasses.fields(value)}
    if isinstance(value, np.ndarray):
        return value.tolist()
    if isinstance(value, dict):
        return {k: _plain(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(v) for v in value]
    return value


def _compose(
    spec: RobotSpec, attachments: Sequence[Attachment], sources: list[Path], work: Path
) -> None:
    robot = ET.Element("robot", name=spec.name)
    for source, prefix in zip(sources, ("", _GRIPPER_PREFIX), strict=True):
        for element in _elements(source, prefix):
            robot.append(element)
            if element.tag == "link":
                _lighten(element, source.parent, work, spec)
    for parent, child, T in (
        (spec.gripper.parent_frame, spec.gripper_base, spec.gripper.T_parent_gripper),
        (spec.gripper_base, spec.tool_frame, spec.T_gripper_tool),
        *((body.frame, body.name, body.T_frame_body) for body in attachments),
    ):
        add_joint(robot, f"{child}_fixed", parent, child, T, "fixed")
    robot.append(ET.Element("link", name=spec.tool_frame))
    for body in attachments:
        robot.append(rigid_link(body.name, body.shapes, body.mass))
    _add_armature(robot, spec)
    for kind in ("link", "joint"):
        names = [element.get("name") for element in robot.findall(kind)]
        twice = sorted({str(name) for name in names if names.count(name) > 1})
        if twice:
            raise InvalidInput(f"{spec.name}: two {kind}s are called {twice[0]!r}; rename one")
    links = [str(link.get("name")) for link in robot.findall("link")]
    for end in robot.findall("joint/parent") + robot.findall("joint/child"):
        if end.get("link") not in links:
            raise unknown_name("frame", str(end.get("link")), links)
    for link in robot.findall("link"):
        if link.find("inertial") is None:
            # A simulator would give a link without inertia one kilogram.
            link.append(_inertial(1e-3, np.zeros(3), 1e-6 * np.eye(3)))
    added = {body.name for body in attachments}
    for link in robot.findall("link"):
        # Of what is attached the shapes say themselves which of them collide.
        drawn = link.find("visual") is not None and link.get("name") not in added
        if drawn and link.find("collision") is None:
            raise InvalidInput(
                f"link {link.get('name')!r}: is drawn but has no collision shape, so nothing can "
                "be proved about it; give it one in the URDF"
            )
    ET.indent(robot)
    ET.ElementTree(robot).write(work / "robot.urdf", encoding="utf-8", xml_declaration=True)


def _add_armature(robot: ET.Element, spec: RobotSpec) -> None:
    """Give what the gripper's joints move at least the inertia of the drive behind them."""
    moving = spec.gripper.joint_positions(0.0)
    links = {link.get("name"): link for link in robot.findall("link")}
    for joint in robot.findall("joint"):
        child = joint.find("child")
        if joint.get("name") not in moving or child is None or not spec.gripper.armature:
            continue
        inertial = links[child.get("link")].find("inertial")
        assert inertial is not None
        part, names = (
            ("mass", ["value"])
            if joint.get("type") == "prismatic"
            else ("inertia", ["ixx", "iyy", "izz"])
        )
        element = inertial.find(part)
        assert element is not None
        for name in names:
            element.set(name, f"{max(float(element.get(name, 0)), spec.gripper.armature):.9g}")


def _elements(source: Path, prefix: str) -> list[ET.Element]:
    """Links and joints of a URDF, names prefixed, vendor extensions left out."""
    text = source.read_text(errors="replace")
    # airo-models uses the prefix drake: without declaring it, which no XML parser accepts.
    text = re.sub(r"<(drake:\w+)\b.*?</\1>", "", text, flags=re.DOTALL)
    text = re.sub(r"\sdrake:\w+=\"[^\"]*\"", "", text)
    try:
        root = ET.fromstring(text)
    except ET.ParseError as error:
        raise BrokenFile(f"{source.name}: not a readable URDF ({error}); check the file") from error
    kept = [element for element in root if element.tag in ("link", "joint")]
    for element in kept:
        element.set("name", prefix + element.get("name", ""))
        for tag in ("parent", "child"):
            for child in element.findall(tag):
                child.set("link", prefix + child.get("link", ""))
        # The robot's GripperSpec describes the linkage; readers treat mimic differently.
        for mimic in element.findall("mimic"):
            element.remove(mimic)
    return kept


def _lighten(link: ET.Element, base: Path, work: Path, spec: RobotSpec) -> None:
    """Replace the link's meshes: collisions by their convex hull, visuals by a simplified mesh."""
    name = link.get("name", "")
    colour = spec.link_colours.get(name, (0.6, 0.6, 0.62, 1.0))
    # The wrist camera sees the gripper close by and the arm never.
    target = _GRIPPER_FACES if name.startswith(_GRIPPER_PREFIX) else _ARM_FACES
    solids = _collision_meshes(link, base)
    for kind in ("visual", "collision"):
        for index, element in enumerate(link.findall(kind)):
            for material in element.findall("material"):
                element.remove(material)
            if kind == "visual":
                element.append(_material(f"{name}_{index}", colour))
            mesh = element.find("geometry/mesh")
            if mesh is None:
                continue
            loaded = _loaded(mesh, base)
            if kind == "collision":
                _check_mesh(loaded, name, mesh.get("filename", ""))
                light = loaded.convex_hull
            else:
                light = _simplified(loaded, target, solids.get(_where(element)))
            file = f"{name}_{kind}_{index}.obj"
            light.export(work / file, include_normals=False, include_texture=False)
            mesh.set("filename", file)
            mesh.attrib.pop("scale", None)


def _where(element: ET.Element) -> str:
    origin = element.find("origin")
    return "" if origin is None else f"{origin.get('xyz')} {origin.get('rpy')}"


def _collision_meshes(link: ET.Element, base: Path) -> dict[str, trimesh.Trimesh]:
    """The link's collision meshes by their place, to draw where a visual mesh stays heavy."""
    return {
        _where(element): _loaded(mesh, base)
        for element in link.findall("collision")
        if (mesh := element.find("geometry/mesh")) is not None
    }


def _loaded(element: ET.Element, base: Path) -> trimesh.Trimesh:
    source = (base / element.get("filename", "")).resolve()
    if not source.is_file():
        raise BrokenFile(f"mesh {source.name} is missing; reinstall the package it comes from")
    mesh = trimesh.load(source, force="mesh", process=True)
    assert isinstance(mesh, trimesh.Trimesh)
    mesh.apply_scale(np.array([float(s) for s in element.get("scale", "1 1 1").split()]))
    mesh.merge_vertices(merge_tex=True, merge_norm=True)
    return mesh


def _check_mesh(mesh: trimesh.Trimesh, link: str, file: str) -> None:
    """Return if a collision mesh has a convex hull; holes and flat triangles do it no harm.

    Raises:
        InvalidInput: it has no faces, or numbers that aren't finite.
    """
    what = f"link {link!r}: collision mesh {Path(file).name}"
    if not len(mesh.faces):
        raise InvalidInput(f"{what} has no triangles; export it again")
    if not np.isfinite(mesh.vertices).all():
        raise InvalidInput(f"{what} has NaN or infinite vertices; export it again")


def _simplified(
    mesh: trimesh.Trimesh, target: int, solid: trimesh.Trimesh | None
) -> trimesh.Trimesh:
    """A mesh of about `target` faces that looks like `mesh`.

    Meshes that fall into many pieces don't simplify well; then the closed `solid` is used, or
    corners closer than a millimetre are joined first.
    """
    joined = mesh.copy()
    joined.merge_vertices(digits_vertex=3)
    joined.update_faces(joined.nondegenerate_faces())
    candidates = [_decimated(m, target) for m in (mesh, solid, joined) if m is not None]
    good = [m for m in candidates if len(m.faces) <= 2 * target]
    return good[0] if good else min(candidates, key=lambda m: len(m.faces))


def _decimated(mesh: trimesh.Trimesh, target: int) -> trimesh.Trimesh:
    if len(mesh.faces) <= target:
        return mesh
    vertices, faces = fast_simplification.simplify(
        np.asarray(mesh.vertices, np.float32), np.asarray(mesh.faces, np.int32), target_count=target
    )
    # Where faces meet at a sharp angle the simplified corner may shoot far out.
    vertices = np.clip(vertices, *mesh.bounds)
    return trimesh.Trimesh(vertices, faces, process=False)


def _origin(T: Array) -> ET.Element:
    R = T[:3, :3]
    pitch = np.arctan2(-R[2, 0], np.hypot(R[0, 0], R[1, 0]))
    if np.cos(pitch) > 1e-6:
        roll, yaw = np.arctan2(R[2, 1], R[2, 2]), np.arctan2(R[1, 0], R[0, 0])
    else:
        roll, yaw = np.arctan2(-R[1, 2], R[1, 1]), 0.0
    return ET.Element("origin", xyz=_numbers(T[:3, 3]), rpy=_numbers([roll, pitch, yaw]))


def _numbers(values: Any) -> str:
    return " ".join(f"{float(v):.12g}" for v in values)


def _material(name: str, rgba: tuple[float, ...]) -> ET.Element:
    material = ET.Element("material", name=f"{name}_colour")
    ET.SubElement(material, "color", rgba=_numbers(rgba))
    return material


def _inertial(mass: float, p: Array, inertia: Array) -> ET.Element:
    inertial = ET.Element("inertial")
    ET.SubElement(inertial, "origin", xyz=_numbers(p), rpy="0 0 0")
    ET.SubElement(inertial, "mass", value=f"{mass:.9g}")
    entries = {
        f"i{a}{b}": f"{inertia[i, j]:.9g}"
        for i, a in enumerate("xyz")
        for j, b in enumerate("xyz")
        if i <= j
    }
    ET.SubElement(inertial, "inertia", entries)
    return inertial


def add_joint(
    robot: ET.Element, name: str, parent: str, child: str, T_parent_child: Array, kind: str
) -> ET.Element:
    """A joint of a URDF's `robot` element, by its kind (`fixed`, `revolute` or `prismatic`)."""
    joint = ET.SubElement(robot, "joint", name=name, type=kind)
    joint.append(_origin(T_parent_child))
    ET.SubElement(joint, "parent", link=parent)
    ET.SubElement(joint, "child", link=child)
    return joint


def rigid_link(name: str, shapes: Sequence[Shape], mass: float) -> ET.Element:
    """A URDF link of primitives, its inertia that of an even mass [kg]; 0 for one that is fixed."""
    link = ET.Element("link", name=name)
    link.append(_inertial(mass, *mass_properties(shapes, mass or 1.0)))
    for index, shape in enumerate(shapes):
        for kind in ("visual", "collision") if shape.collides else ("visual",):
            element = ET.SubElement(link, kind)
            element.append(_origin(shape.T_body_shape))
            element.append(_geometry(shape))
            if kind == "visual":
                element.append(_material(f"{name}_{index}", shape.rgba))
    return link


def _geometry(shape: Shape) -> ET.Element:
    geometry = ET.Element("geometry")
    if shape.kind == "box":
        ET.SubElement(geometry, "box", size=_numbers(shape.size))
    elif shape.kind == "cylinder":
        radius, length = (f"{v:.9g}" for v in shape.size)
        ET.SubElement(geometry, "cylinder", radius=radius, length=length)
    else:
        ET.SubElement(geometry, "sphere", radius=f"{shape.size[0]:.9g}")
    return geometry
