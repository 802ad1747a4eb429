"""One URDF from an arm, a gripper and what is fixed to them, made once.

Visual meshes get normals, collision shapes become convex parts that enclose all of the link, what
is drawn and what collides, and names get a prefix, so that any simulator and Pinocchio read the
same file.
"""

from __future__ import annotations

import dataclasses
import functools
import hashlib
import importlib.metadata
import io
import json
import os
import re
import shutil
import tempfile
import time
import xml.etree.ElementTree as ET
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import trimesh

from sart_toolkit.errors import BrokenFile, CannotWrite, InvalidInput, SartError, unknown_name
from sart_toolkit.poses import Array, inverse, rpy_pose
from sart_toolkit.robots.enclosure import (
    TOLERANCE,
    Faces,
    HullPart,
    Part,
    ShapePart,
    enclose,
    shape_stands_out,
    standing_out,
)
from sart_toolkit.robots.source import links_and_joints, parsed, read_bytes
from sart_toolkit.robots.spec import (
    Attachment,
    RobotSpec,
    Shape,
    mass_properties,
    resource_path,
)

# Bump when the composition changes, so that cached files of an older version are not used.
_RECIPE = 13
# What shades and hulls: another version may make other meshes.
_MADE_WITH = ("trimesh", "scipy", "numpy")
# Faces that meet at a sharper angle show an edge.
_CREASE_DEG = 30.0
_GRIPPER_PREFIX = "gripper_"
# What a link of no mass of its own gets [kg].
FRAME_MASS = 1e-3
_MANIFEST = "manifest.json"
_MESH_TYPES = (".dae", ".glb", ".obj", ".off", ".ply", ".stl")
_MAX_MESH_BYTES = 100 << 20
_MAX_EXTENT = 100.0
# A link given a mass but no inertia has that of a ball of this radius [m].
_BALL_RADIUS = 0.05


def cache_dir() -> Path:
    """Where derived files are kept: `$SART_CACHE`, or the user's cache directory."""
    root = os.environ.get("SART_CACHE") or os.environ.get("XDG_CACHE_HOME")
    return Path(root or Path.home() / ".cache") / "sart_toolkit"


def composed_urdf(spec: RobotSpec, held: Sequence[Attachment] = ()) -> Path:
    """The path of the robot's single URDF, with the held bodies fixed on; made once, then cached.

    It is made again when anything it was made from has another content, or its folder has.

    Raises:
        MissingExtra, MissingFile: a source URDF isn't there.
        BrokenFile: a source URDF or a mesh can't be parsed, or a mesh is missing.
        InvalidInput: a number, shape or reference in a source isn't acceptable, two links or
            joints have the same name, the links aren't one tree, a link is drawn but has no
            collision shape, or a mesh is empty or not finite.
        UnknownName: a joint or a body is to be fixed to a frame that isn't there.
        CannotWrite: the cache can't be written.
    """
    sources = [resource_path(spec.urdf), resource_path(spec.gripper.urdf)]
    attachments = [*spec.attachments, *held]
    key = _key(spec, attachments, sources)
    directory = cache_dir() / f"{spec.name}-{key}"
    urdf = directory / "robot.urdf"
    try:
        if not _intact(directory):
            _make(spec, attachments, sources, directory, key)
    except SartError:
        raise
    except OSError as error:
        raise CannotWrite(
            f"{directory}: {error.strerror or error}; set SART_CACHE to a folder that can be "
            "written"
        ) from error
    return urdf


def _key(spec: RobotSpec, attachments: Sequence[Attachment], sources: Sequence[Path]) -> str:
    """A hash of all that the composed robot is made from: its data and its files' contents."""
    files = []
    for source in sources:
        digest = _digest(source)
        meshes = {
            name: _digest(path) if os.path.isfile(path) else None
            for name in _mesh_names(source, digest)
            for path in [_mesh_path(name, source.parent)]
        }
        files.append([source.name, digest, meshes])
    made_from = {
        "recipe": _RECIPE,
        "versions": _versions(),
        "sources": files,
        # Cameras are no part of a URDF: one that is moved a little needs no new one.
        "spec": {k: v for k, v in _plain(spec).items() if k != "cameras"},
        "attachments": _plain(attachments),
    }
    return hashlib.sha256(json.dumps(made_from, sort_keys=True).encode()).hexdigest()[:16]


@functools.cache
def _versions() -> dict[str, str]:
    return {name: importlib.metadata.version(name) for name in _MADE_WITH}


_digests: dict[tuple[str, int, int, int], str] = {}


def _digest(path: Path) -> str:
    """The SHA-256 of a file's content, remembered in this process while the file is untouched.

    Raises:
        BrokenFile: it can't be read.
    """
    try:
        found = path.stat()
    except OSError as error:
        raise BrokenFile(f"{path.name}: can't be read ({error.strerror}); check it") from error
    key = str(path), found.st_size, found.st_mtime_ns, found.st_ino
    if key not in _digests:
        digest = hashlib.sha256(read_bytes(path, _MAX_MESH_BYTES)).hexdigest()
        # A file written just now may be written again within the same tick of its clock.
        if time.time_ns() - found.st_mtime_ns < 2_000_000_000:
            return digest
        _digests[key] = digest
    return _digests[key]


@functools.lru_cache(maxsize=64)
def _mesh_names(source: Path, digest: str) -> tuple[str, ...]:
    """The mesh files that a URDF of that content names."""
    return tuple(sorted({mesh.get("filename", "") for mesh in parsed(source).iter("mesh")}))


def source_files(source: Path) -> list[Path]:
    """A URDF and the existing mesh files that it names.

    Raises:
        BrokenFile: the URDF can't be read.
    """
    names = _mesh_names(source, _digest(source))
    meshes = [_mesh_path(name, source.parent) for name in names]
    return [source, *(path for path in meshes if path.is_file())]


def _intact(directory: Path) -> bool:
    """Whether a folder holds the files that were put there, with the same content."""
    try:
        files = json.loads((directory / _MANIFEST).read_bytes())
        there = {path.name for path in directory.iterdir()}
        return there == {*files, _MANIFEST} and all(
            _digest(directory / name) == digest for name, digest in files.items()
        )
    except (OSError, ValueError, TypeError, AttributeError):
        return False


def _make(
    spec: RobotSpec,
    attachments: Sequence[Attachment],
    sources: Sequence[Path],
    directory: Path,
    key: str,
) -> None:
    """Compose in a temporary folder, then rename it to the robot's own."""
    directory.parent.mkdir(parents=True, exist_ok=True)
    work = Path(tempfile.mkdtemp(dir=directory.parent, prefix=f".{spec.name}-"))
    try:
        made = work / "made"
        made.mkdir()
        _compose(spec, attachments, sources, made)
        files = {path.name: _digest(path) for path in sorted(made.iterdir())}
        (made / _MANIFEST).write_text(json.dumps(files, indent=1))
        if _key(spec, attachments, sources) != key:
            raise BrokenFile(f"{spec.name}: its files changed while they were read; try again")
        try:
            if directory.exists() and not _intact(directory):
                os.replace(directory, work / "damaged")
            os.replace(made, directory)
        except OSError:
            # Another process has just put the same files there.
            if not _intact(directory):
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
    spec: RobotSpec, attachments: Sequence[Attachment], sources: Sequence[Path], work: Path
) -> None:
    robot = ET.Element("robot", name=spec.name)
    for source, prefix in zip(sources, ("", _GRIPPER_PREFIX), strict=True):
        for element in _elements(source, prefix):
            robot.append(element)
            if element.tag == "link":
                _prepare(element, source.parent, work, f"{len(robot):03d}", spec)
    for parent, child, T in (
        (spec.gripper.parent_frame, spec.gripper_base, spec.gripper.T_parent_gripper),
        (spec.gripper_base, spec.tool_frame, spec.T_gripper_tool),
        *((body.frame, body.name, body.T_frame_body) for body in attachments),
    ):
        add_joint(robot, f"{child}_fixed", parent, child, T, "fixed")
    robot.append(ET.Element("link", name=spec.tool_frame))
    for body in attachments:
        robot.append(rigid_link(body.name, body.shapes, body.mass))
    for kind in ("link", "joint"):
        names = [element.get("name") for element in robot.findall(kind)]
        twice = sorted({str(name) for name in names if names.count(name) > 1})
        if twice:
            raise InvalidInput(f"{spec.name}: two {kind}s are called {twice[0]!r}; rename one")
    links = [str(link.get("name")) for link in robot.findall("link")]
    for end in robot.findall("joint/parent") + robot.findall("joint/child"):
        if end.get("link") not in links:
            raise unknown_name("frame", str(end.get("link")), links)
    _check_tree(spec.name, robot)
    for link in robot.findall("link"):
        inertial = link.find("inertial")
        if inertial is None:
            # A simulator would give a link without inertia one kilogram.
            link.append(_inertial(FRAME_MASS, np.zeros(3), 1e-6 * np.eye(3)))
        elif inertial.find("inertia") is None:
            mass = float(found_element(inertial, "mass").get("value", ""))
            moment = 0.4 * max(mass, 1e-3) * _BALL_RADIUS**2
            inertial.append(_inertia(moment * np.eye(3)))
    _add_armature(robot, spec)
    ET.indent(robot)
    ET.ElementTree(robot).write(work / "robot.urdf", encoding="utf-8", xml_declaration=True)


def _check_tree(name: str, robot: ET.Element) -> None:
    """Return if the joints make one tree of the links.

    Raises:
        InvalidInput: a link hangs on two joints or on none, in a loop, or has a joint's name.
    """
    parent_of: dict[str, str] = {}
    for joint in robot.findall("joint"):
        parent, child = (found_element(joint, tag).get("link", "") for tag in ("parent", "child"))
        if child in parent_of:
            raise InvalidInput(
                f"{name}: link {child!r} is the child of two joints, expected one; remove one"
            )
        parent_of[child] = parent
    links = [link.get("name", "") for link in robot.findall("link")]
    roots = [link for link in links if link not in parent_of]
    if len(roots) > 1:
        raise InvalidInput(
            f"{name}: links {roots[0]!r} and {roots[1]!r} are not joined; join them by a joint"
        )
    joined: set[str] = set(roots)
    for link in links:
        chain = []
        while link not in joined and link not in chain:
            chain.append(link)
            link = parent_of[link]
        if link not in joined:
            raise InvalidInput(f"{name}: joints make a loop through link {link!r}; open it")
        joined.update(chain)
    for joint in robot.findall("joint"):
        # A fixed joint is a frame too, at its child's place.
        if joint.get("name") in links and joint.get("name") != found_element(joint, "child").get(
            "link"
        ):
            raise InvalidInput(
                f"{name}: joint {joint.get('name')!r} has the name of a link that isn't its child; "
                "rename it"
            )


def found_element(element: ET.Element, tag: str) -> ET.Element:
    """A child of an element that is there for certain."""
    found = element.find(tag)
    assert found is not None
    return found


def _add_armature(robot: ET.Element, spec: RobotSpec) -> None:
    """Give what the gripper's joints move at least the inertia of the drive behind them."""
    moving = spec.gripper.joint_positions(0.0)
    links = {link.get("name"): link for link in robot.findall("link")}
    for joint in robot.findall("joint"):
        if joint.get("name") not in moving or not spec.gripper.armature:
            continue
        inertial = found_element(links[found_element(joint, "child").get("link")], "inertial")
        part, names = (
            ("mass", ["value"])
            if joint.get("type") == "prismatic"
            else ("inertia", ["ixx", "iyy", "izz"])
        )
        element = found_element(inertial, part)
        for name in names:
            element.set(name, f"{max(float(element.get(name, 0)), spec.gripper.armature):.9g}")


def _elements(source: Path, prefix: str) -> list[ET.Element]:
    """Links and joints of a URDF, checked, names prefixed, vendor extensions left out."""
    kept = links_and_joints(source)
    for element in kept:
        element.set("name", prefix + element.get("name", ""))
        for tag in ("parent", "child"):
            for child in element.findall(tag):
                child.set("link", prefix + child.get("link", ""))
    return kept


def _prepare(link: ET.Element, base: Path, work: Path, number: str, spec: RobotSpec) -> None:
    """Give the link convex parts that enclose it for collisions, and visual meshes with normals.

    Raises:
        BrokenFile: a mesh is missing or can't be read.
        InvalidInput: a mesh is empty or not finite, or the link is drawn but doesn't collide.
    """
    name = link.get("name", "")
    colour = spec.link_colours.get(name, (0.6, 0.6, 0.62, 1.0))
    paths = [_mesh_path(mesh.get("filename", ""), base) for mesh in link.iter("mesh")]
    digests = tuple(_digest(path) if os.path.isfile(path) else "" for path in paths)
    key = ET.tostring(link, encoding="unicode"), digests
    if key not in _prepared:
        if len(_prepared) >= _MOST_LINKS:
            _prepared.clear()
        _prepared[key] = _prepared_link(key[0], base)
    text, files = _prepared[key]
    made = ET.fromstring(text)
    link[:] = list(made)
    # Names that no two links share, and that are safe for any file system.
    stem = f"{number}_{re.sub(r'[^A-Za-z0-9]+', '_', name)[:40]}"
    for mesh in link.iter("mesh"):
        mesh.set("filename", f"{stem}_{mesh.get('filename')}")
    for file, content in files.items():
        (work / f"{stem}_{file}").write_bytes(content)
    for index, element in enumerate(link.findall("visual")):
        element.append(_material(f"{name}_{index}", colour))


# Links are remembered by all that they are made from, since robots share them.
_prepared: dict[tuple[str, tuple[str, ...]], tuple[str, dict[str, bytes]]] = {}
_MOST_LINKS = 256


def _prepared_link(text: str, base: Path) -> tuple[str, dict[str, bytes]]:
    """A link's element with meshes of our own, as text, and these meshes' files.

    Args:
        text: the link's element, checked.
        base: where its meshes' paths start.
    """
    link = ET.fromstring(text)
    with tempfile.TemporaryDirectory(prefix="sart-link-") as folder:
        _prepare_meshes(link, base, Path(folder))
        files = {path.name: path.read_bytes() for path in sorted(Path(folder).iterdir())}
    return ET.tostring(link, encoding="unicode"), files


def _prepare_meshes(link: ET.Element, base: Path, work: Path) -> None:
    name = link.get("name", "")
    visuals, collisions = link.findall("visual"), link.findall("collision")
    if visuals and not collisions:
        raise InvalidInput(
            f"link {name!r}: is drawn but has no collision shape, so nothing can be proved about "
            "it; give it one in the URDF"
        )
    for element in [*visuals, *collisions]:
        mesh = element.find("geometry/mesh")
        if mesh is not None:
            _check_mesh(_loaded(mesh, base), name, element.tag, mesh.get("filename", ""))
    vertices, faces = drawn_triangles(link, base)
    parts = _enclosed(link, base, vertices, faces)
    _write_parts(link, parts, work)
    for index, element in enumerate(visuals):
        mesh = element.find("geometry/mesh")
        if mesh is not None:
            _export(creased(_loaded(mesh, base)), mesh, work, f"visual_{index}.obj", normals=True)
    out = standing_out(link_parts(link, work), vertices, faces)
    if len(out) and out.max() > TOLERANCE:
        raise InvalidInput(
            f"link {name!r}: what is drawn stands {out.max() * 1e3:.3f} mm out of its "
            f"collision parts, expected at most {TOLERANCE * 1e3:g} mm; export its meshes again"
        )


def link_parts(link: ET.Element, folder: Path) -> list[Part]:
    """The convex part of each collision element of a URDF's link, in the link's frame.

    Args:
        link: the element, its numbers checked.
        folder: where its meshes' paths start.
    """
    parts: list[Part] = []
    for element in link.findall("collision"):
        mesh = element.find("geometry/mesh")
        if mesh is None:
            parts.append(ShapePart(_shape(element)))
        else:
            parts.append(HullPart(_moved(_loaded(mesh, folder).vertices, element_pose(element))))
    return parts


def drawn_triangles(link: ET.Element, folder: Path) -> tuple[Array, Faces]:
    """What is drawn of a URDF's link by meshes: corners `(m, 3)` [m] in its frame, and triangles.

    Triangles are `(n, 3)` indices of corners; arguments are those of `link_parts`.
    """
    corners, triangles, count = [np.zeros((0, 3))], [np.zeros((0, 3), np.intp)], 0
    for element in link.findall("visual"):
        mesh = element.find("geometry/mesh")
        if mesh is None:
            continue
        loaded = _loaded(mesh, folder)
        corners.append(_moved(loaded.vertices, element_pose(element)))
        triangles.append(np.asarray(loaded.faces, np.intp) + count)
        count += len(loaded.vertices)
    return np.concatenate(corners), np.concatenate(triangles)


def drawn_shapes(link: ET.Element) -> list[Shape]:
    """The primitives that are drawn of a URDF's link, in its frame."""
    return [_shape(v) for v in link.findall("visual") if v.find("geometry/mesh") is None]


def drawn_elements(
    link: ET.Element, folder: Path
) -> list[tuple[Shape | trimesh.Trimesh, Array, tuple[float, float, float, float]]]:
    """What is drawn of a composed URDF's link, where, and in which colour.

    Shapes are in the link's frame; meshes, whose pose `(4, 4)` in it comes second, in their own.
    """
    found: list[tuple[Shape | trimesh.Trimesh, Array, tuple[float, float, float, float]]] = []
    for visual in link.findall("visual"):
        red, green, blue, alpha = _floats(found_element(visual, "material/color").get("rgba", ""))
        mesh = visual.find("geometry/mesh")
        what: Shape | trimesh.Trimesh
        if mesh is None:
            what = dataclasses.replace(_shape(visual), rgba=(red, green, blue, alpha))
        else:
            path = folder / mesh.get("filename", "")
            loaded = trimesh.load(path, force="mesh", process=False)
            assert isinstance(loaded, trimesh.Trimesh)
            what = loaded
        found.append((what, element_pose(visual), (red, green, blue, alpha)))
    return found


def _enclosed(link: ET.Element, base: Path, vertices: Array, faces: Faces) -> list[Part]:
    """The link's collision parts, grown and joined by others so that all that is drawn is inside.

    A primitive that stands out becomes a part itself.
    """
    parts = link_parts(link, base)
    if not parts:
        return []
    made = enclose(parts, vertices, faces)
    for shape in drawn_shapes(link):
        if shape_stands_out(made, shape):
            made.append(ShapePart(shape))
    return made


def _write_parts(link: ET.Element, parts: Sequence[Part], work: Path) -> None:
    """Let the link's collision elements be these parts; those added come last."""
    own = link.findall("collision")
    for index, part in enumerate(parts):
        element = own[index] if index < len(own) else ET.SubElement(link, "collision")
        if isinstance(part, HullPart):
            mesh = element.find("geometry/mesh")
            if mesh is None:
                mesh = ET.SubElement(ET.SubElement(element, "geometry"), "mesh")
            T = inverse(element_pose(element))
            hull = trimesh.Trimesh(_moved(part.points, T)).convex_hull
            _export(hull, mesh, work, f"collision_{index}.obj")
        elif index >= len(own):
            element.append(origin_element(part.shape.T_body_shape))
            element.append(_geometry(part.shape))


def creased(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    """The mesh with normals at its corners: smooth, but for edges where faces meet sharply."""
    return trimesh.graph.smooth_shade(mesh, angle=np.deg2rad(_CREASE_DEG), facet_minarea=None)


def _export(
    mesh: trimesh.Trimesh, element: ET.Element, work: Path, file: str, normals: bool = False
) -> None:
    mesh.export(work / file, include_normals=normals, include_texture=False, digits=9)
    element.set("filename", file)
    element.attrib.pop("scale", None)


def _moved(points: Array, T: Array) -> Array:
    return np.asarray(points, np.float64) @ T[:3, :3].T + T[:3, 3]


def element_pose(element: ET.Element) -> Array:
    """An element's pose `(4, 4)` in its link."""
    origin = element.find("origin")
    given = {} if origin is None else origin.attrib
    return rpy_pose(*(_floats(given.get(key, "0 0 0")) for key in ("xyz", "rpy")))


def _floats(text: str) -> list[float]:
    return [float(word) for word in text.split()]


def _shape(element: ET.Element) -> Shape:
    """The primitive of a visual or collision element, in the link's frame."""
    T = element_pose(element)
    shape = found_element(element, "geometry")[0]
    if shape.tag == "box":
        x, y, z = _floats(shape.get("size", ""))
        return Shape("box", (x, y, z), T)
    radius = float(shape.get("radius", ""))
    if shape.tag == "sphere":
        return Shape("sphere", (radius,), T)
    return Shape("cylinder", (radius, float(shape.get("length", ""))), T)


def _mesh_path(name: str, base: Path) -> Path:
    return Path(os.path.normpath(base / name))


def _loaded(element: ET.Element, base: Path) -> trimesh.Trimesh:
    """A mesh element's mesh, scaled, in its own frame.

    Raises:
        BrokenFile: it is missing or can't be read.
        InvalidInput: its file is of another type than those that are read.
    """
    source = _mesh_path(element.get("filename", ""), base)
    if source.suffix.lower() not in _MESH_TYPES:
        raise InvalidInput(
            f"mesh {source.name}: expected a file ending in {', '.join(_MESH_TYPES)}; convert it"
        )
    if not os.path.isfile(source):
        raise BrokenFile(f"mesh {source.name} is missing; reinstall the package it comes from")
    return _mesh(source, _digest(source), tuple(_floats(element.get("scale", "1 1 1"))))


@functools.lru_cache(maxsize=16)
def _mesh(source: Path, digest: str, scale: tuple[float, ...]) -> trimesh.Trimesh:
    """The mesh of a file of that content, scaled; not to be changed."""
    content = read_bytes(source, _MAX_MESH_BYTES)
    try:
        # From bytes, so that no other file that it names is read.
        mesh = trimesh.load(
            io.BytesIO(content), file_type=source.suffix[1:].lower(), force="mesh", process=False
        )
        assert isinstance(mesh, trimesh.Trimesh)
        # Processing drops corners that aren't finite, and all triangles at them.
        if mesh.vertices.ndim != 2 or mesh.vertices.shape[1] != 3:
            raise ValueError("corners without three coordinates")
        if not np.isfinite(mesh.vertices).all():
            raise ValueError("NaN or infinite vertices")
        mesh.process()
        mesh.apply_scale(scale)
        mesh.merge_vertices(merge_tex=True, merge_norm=True)
    except Exception as error:
        raise BrokenFile(
            f"mesh {source.name}: can't be read ({type(error).__name__}: {error}); export it again"
        ) from error
    return mesh


def _check_mesh(mesh: trimesh.Trimesh, link: str, kind: str, file: str) -> None:
    """Return if a mesh can be enclosed; holes and flat triangles do that no harm.

    Raises:
        InvalidInput: it has no faces, numbers that aren't finite, or is far too large.
    """
    what = f"link {link!r}: {kind} mesh {Path(file).name}"
    if not len(mesh.faces):
        raise InvalidInput(f"{what} has no triangles; export it again")
    if not np.isfinite(mesh.vertices).all():
        raise InvalidInput(f"{what} has NaN or infinite vertices; export it again")
    if np.abs(mesh.vertices).max() > _MAX_EXTENT:
        raise InvalidInput(
            f"{what} reaches {np.abs(mesh.vertices).max():.4g} m from its origin, expected at most "
            f"{_MAX_EXTENT:g} m; give it a scale"
        )


def origin_element(T: Array) -> ET.Element:
    """An `origin` element of a pose `(4, 4)`."""
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
    inertial.append(_inertia(inertia))
    return inertial


def _inertia(inertia: Array) -> ET.Element:
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
    joint.append(origin_element(T_parent_child))
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
            element.append(origin_element(shape.T_body_shape))
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
