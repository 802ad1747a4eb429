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
import json
import logging
import os
import shutil
import tempfile
import xml.etree.ElementTree as ET
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import trimesh

from sart_toolkit.errors import (
    BrokenFile,
    CannotWrite,
    InvalidInput,
    SartError,
    unknown_name,
)
from sart_toolkit.poses import Array, inverse
from sart_toolkit.robots.elements import (
    add_joint,
    child_of,
    file_stem,
    floats,
    geometry_of,
    inertia_of,
    inertial_of,
    material_of,
    origin_of,
    pose_of,
    rigid_link,
    shape_of,
)
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
from sart_toolkit.robots.joints import moving_groups, set_joints
from sart_toolkit.robots.meshes import (
    check_mesh,
    check_type,
    creased,
    file_digest,
    read_mesh,
    write_obj,
)
from sart_toolkit.robots.references import cache_dir, mesh_path, resource_path, where_to_look
from sart_toolkit.robots.source import links_and_joints, parsed
from sart_toolkit.robots.spec import (
    Attachment,
    RobotSpec,
    Shape,
)

_log = logging.getLogger(__name__)
# Robots about which a warning was given: one is enough.
_warned: set[str] = set()
# Bump when the composition changes, so that cached files of an older version are not used.
_RECIPE = 16
# What shades and hulls: another version may make other meshes.
_MADE_WITH = ("trimesh", "scipy", "numpy")
_GRIPPER_PREFIX = "gripper_"
# What a link of no mass of its own gets [kg].
FRAME_MASS = 1e-3
_MANIFEST = "manifest.json"
# A link given a mass but no inertia has that of a ball of this radius [m].
_BALL_RADIUS = 0.05
# A link that moves and has no mass gets that of its hull at this density [kg/m³].
_DENSITY = 1000.0
# So much of an inertia's greatest moment may be rounding.
_ROUNDING = 1e-6
_ORIGIN = "world_origin"
_NOTES = "notes.json"


def composed_urdf(spec: RobotSpec, held: Sequence[Attachment] = ()) -> Path:
    """The path of the robot's single URDF, with the held bodies fixed on; made once, then cached.

    It is made again when anything it was made from has another content, or its folder has.

    Raises:
        MissingExtra, MissingFile: a source URDF isn't there.
        BrokenFile: a source URDF or a mesh can't be parsed, or a mesh is missing.
        InvalidInput: a number, shape or reference in a source isn't acceptable, two links or
            joints have the same name, the links aren't one tree, the joints aren't as the
            robot has them, or a mesh is empty or not finite.
        UnknownName: a joint or a body is to be fixed to a frame that isn't there.
        CannotWrite: the cache can't be written.
    """
    sources = [resource_path(source) for source in spec.sources]
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


def assumptions(urdf: Path) -> list[str]:
    """What had to be assumed for a composed URDF, a line each."""
    notes: list[str] = json.loads((urdf.parent / _NOTES).read_bytes())
    return notes


def _key(spec: RobotSpec, attachments: Sequence[Attachment], sources: Sequence[Path]) -> str:
    """A hash of all that the composed robot is made from: its data and its files' contents."""
    files = []
    for source in sources:
        digest = file_digest(source)
        meshes = {
            name: file_digest(path) if os.path.isfile(path) else None
            for name in _mesh_names(source, digest)
            for path in [mesh_path(name, source, spec.package_dirs)]
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


@functools.lru_cache(maxsize=64)
def _mesh_names(source: Path, digest: str) -> tuple[str, ...]:
    """The mesh files that a URDF of that content names."""
    return tuple(sorted({mesh.get("filename", "") for mesh in parsed(source).iter("mesh")}))


def source_files(source: Path, package_dirs: Sequence[str] = ()) -> list[Path]:
    """A URDF and the existing mesh files that it names, which `package_dirs` help to find.

    Raises:
        BrokenFile: the URDF can't be read.
    """
    names = _mesh_names(source, file_digest(source))
    meshes = [mesh_path(name, source, package_dirs) for name in names]
    return [source, *(path for path in meshes if os.path.isfile(path))]


def extents(source: Path, package_dirs: Sequence[str] = ()) -> list[tuple[str, str, float]]:
    """Each mesh of a URDF: its link, its file's name, and its greatest extent [m], scaled.

    Raises:
        BrokenFile: the URDF or a mesh can't be read, or a mesh is missing.
        InvalidInput: a number, shape or reference in it isn't acceptable.
        MissingExtra: what reads a mesh isn't installed.
    """
    found = []
    for link in source_elements(source, "", package_dirs):
        for element in link.iter("mesh"):
            mesh = _loaded(element, source.parent)
            size = float(np.ptp(mesh.vertices, axis=0).max()) if len(mesh.vertices) else 0.0
            found.append((link.get("name", ""), Path(element.get("filename", "")).name, size))
    return found


def _intact(directory: Path) -> bool:
    """Whether a folder holds the files that were put there, with the same content."""
    try:
        files = json.loads((directory / _MANIFEST).read_bytes())
        there = {path.name for path in directory.iterdir()}
        return there == {*files, _MANIFEST} and all(
            file_digest(directory / name) == digest for name, digest in files.items()
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
        notes = _compose(spec, attachments, sources, made)
        (made / _NOTES).write_text(json.dumps(notes, indent=1))
        files = {path.name: file_digest(path) for path in sorted(made.iterdir())}
        (made / _MANIFEST).write_text(json.dumps(files, indent=1))
        if _key(spec, attachments, sources) != key:
            raise BrokenFile(f"{spec.name}: its files changed while they were read; try again")
        if notes and spec.name not in _warned:
            _warned.add(spec.name)
            _log.warning(
                "%s: %s%s; `sart doctor --robot` lists what was assumed",
                spec.name, notes[0], f", and {len(notes) - 1} more" if notes[1:] else "",
            )  # fmt: skip
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
) -> list[str]:
    """Write the composed URDF and its meshes, and say what had to be assumed."""
    robot = ET.Element("robot", name=spec.name)
    notes: list[str] = []
    for source, prefix in zip(sources, ("", _GRIPPER_PREFIX), strict=False):
        for element in source_elements(source, prefix, spec.package_dirs):
            robot.append(element)
            if element.tag == "link":
                if element.find("visual") is not None and element.find("collision") is None:
                    notes.append(
                        f"link {element.get('name')!r} has no collision shape: hulls of what is "
                        "drawn taken"
                    )
                _prepare(element, source.parent, work, f"{len(robot):03d}", spec)
    mounts = [(spec.gripper_base, spec.tool_frame, spec.T_gripper_tool)]
    if spec.gripper.parent_frame is not None:
        T = spec.gripper.T_parent_gripper
        mounts.insert(0, (spec.gripper.parent_frame, spec.gripper_base, T))
    mounts += [(body.frame, body.name, body.T_frame_body) for body in attachments]
    for parent, child, T in mounts:
        add_joint(robot, f"{child}_fixed", parent, child, T, "fixed")
    robot.append(ET.Element("link", name=spec.tool_frame))
    for body in attachments:
        robot.append(rigid_link(body.name, body.shapes, body.mass, work, f"{len(robot):03d}"))
    for kind in ("link", "joint"):
        names = [element.get("name") for element in robot.findall(kind)]
        twice = sorted({str(name) for name in names if names.count(name) > 1})
        if twice:
            raise InvalidInput(f"{spec.name}: two {kind}s are called {twice[0]!r}; rename one")
    links = [str(link.get("name")) for link in robot.findall("link")]
    for end in robot.findall("joint/parent") + robot.findall("joint/child"):
        if end.get("link") not in links:
            raise unknown_name("frame", str(end.get("link")), links)
    root = _check_tree(spec.name, robot)
    notes += set_joints(spec, robot)
    notes += _weighed(robot, work)
    if not np.array_equal(spec.T_world_base, np.eye(4)):
        robot.append(ET.Element("link", name=_ORIGIN))
        add_joint(robot, f"{root}_fixed", _ORIGIN, root, spec.T_world_base, "fixed")
    for link in robot.findall("link"):
        inertial = link.find("inertial")
        if inertial is None:
            # A simulator would give a link without inertia one kilogram.
            link.append(inertial_of(FRAME_MASS, np.zeros(3), 1e-6 * np.eye(3)))
        elif inertial.find("inertia") is None:
            mass = float(child_of(inertial, "mass").get("value", ""))
            moment = 0.4 * max(mass, 1e-3) * _BALL_RADIUS**2
            inertial.append(inertia_of(moment * np.eye(3)))
        elif _made_real(inertial):
            notes.append(
                f"link {link.get('name')!r}: no body has its inertia, its greatest moment exceeds "
                "the sum of the others: these raised"
            )
    _add_armature(robot, spec)
    ET.indent(robot)
    ET.ElementTree(robot).write(work / "robot.urdf", encoding="utf-8", xml_declaration=True)
    return notes


def _weighed(robot: ET.Element, work: Path) -> list[str]:
    """Give what a joint moves a mass where the URDF has none, and say so."""
    notes = []
    for link, group in moving_groups(robot):
        masses = [
            each.get("value", "0")
            for each_link in group
            for each in each_link.findall("inertial/mass")
        ]
        if any(float(mass) > 0 for mass in masses):
            continue
        points = [
            _moved(part.points if isinstance(part, HullPart) else part.shape.corners(), np.eye(4))
            for part in link_parts(link, work)
        ]
        if not points:
            continue
        hull = trimesh.Trimesh(np.concatenate(points)).convex_hull
        hull.density = _DENSITY
        for old in link.findall("inertial"):
            link.remove(old)
        link.append(inertial_of(hull.mass, hull.center_mass, hull.moment_inertia))
        notes.append(
            f"link {link.get('name')!r} has no mass: {hull.mass:.2g} kg taken, its hull at "
            f"{_DENSITY:g} kg/m³"
        )
    return notes


def _made_real(inertial: ET.Element) -> bool:
    """Whether an inertia had to be raised to one that a body can have."""
    element = child_of(inertial, "inertia")
    rows = [[float(element.get("i" + "".join(sorted(a + b)), 0)) for b in "xyz"] for a in "xyz"]
    moments, axes = np.linalg.eigh(np.array(rows))
    lacking = moments[2] - moments[0] - moments[1]
    # What is only rounded is left as it is.
    if lacking <= _ROUNDING * moments[2]:
        return False
    moments[:2] += lacking / 2 + _ROUNDING * moments[2]
    inertial.remove(element)
    inertial.append(inertia_of(axes @ np.diag(moments) @ axes.T))
    return True


def _check_tree(name: str, robot: ET.Element) -> str:
    """The name of the link that all others hang on, if the joints make one tree of the links.

    Raises:
        InvalidInput: a link hangs on two joints or on none, in a loop, or has a joint's name.
    """
    parent_of: dict[str, str] = {}
    for joint in robot.findall("joint"):
        parent, child = (child_of(joint, tag).get("link", "") for tag in ("parent", "child"))
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
        if joint.get("name") in links and joint.get("name") != child_of(joint, "child").get("link"):
            raise InvalidInput(
                f"{name}: joint {joint.get('name')!r} has the name of a link that isn't its child; "
                "rename it"
            )
    return roots[0]


def _add_armature(robot: ET.Element, spec: RobotSpec) -> None:
    """Give what the gripper's joints move at least the inertia of the drive behind them."""
    moving = spec.gripper.joint_positions(0.0)
    links = {link.get("name"): link for link in robot.findall("link")}
    for joint in robot.findall("joint"):
        if joint.get("name") not in moving or not spec.gripper.armature:
            continue
        inertial = child_of(links[child_of(joint, "child").get("link")], "inertial")
        part, names = (
            ("mass", ["value"])
            if joint.get("type") == "prismatic"
            else ("inertia", ["ixx", "iyy", "izz"])
        )
        element = child_of(inertial, part)
        for name in names:
            element.set(name, f"{max(float(element.get(name, 0)), spec.gripper.armature):.9g}")


def source_elements(
    source: Path, prefix: str = "", package_dirs: Sequence[str] = ()
) -> list[ET.Element]:
    """Links and joints of a URDF, checked, names prefixed, meshes by their paths.

    Raises:
        BrokenFile: it can't be read, or a mesh is missing.
        InvalidInput: a number, shape or reference in it isn't acceptable.
    """
    kept = links_and_joints(source)
    for element in kept:
        element.set("name", prefix + element.get("name", ""))
        for tag, name in (("parent", "link"), ("child", "link"), ("mimic", "joint")):
            for child in element.findall(tag):
                child.set(name, prefix + child.get(name, ""))
        for mesh in element.iter("mesh"):
            reference = mesh.get("filename", "")
            path = mesh_path(reference, source, package_dirs)
            if not os.path.isfile(path):
                raise BrokenFile(
                    f"{source.name}: link {element.get('name')!r}: mesh {reference} is missing; "
                    f"{where_to_look(reference, package_dirs)}"
                )
            mesh.set("filename", str(path.absolute()))
    return kept


def _prepare(link: ET.Element, base: Path, work: Path, number: str, spec: RobotSpec) -> None:
    """Give the link convex parts that enclose it for collisions, and visual meshes with normals.

    Raises:
        BrokenFile: a mesh is missing or can't be read.
        InvalidInput: a mesh is empty or not finite.
    """
    name = link.get("name", "")
    colour = spec.link_colours.get(name, (0.6, 0.6, 0.62, 1.0))
    paths = [base / mesh.get("filename", "") for mesh in link.iter("mesh")]
    digests = tuple(file_digest(path) if os.path.isfile(path) else "" for path in paths)
    key = ET.tostring(link, encoding="unicode"), digests
    if key not in _prepared:
        if len(_prepared) >= _MOST_LINKS:
            _prepared.clear()
        _prepared[key] = _prepared_link(key[0], base)
    text, files = _prepared[key]
    made = ET.fromstring(text)
    link[:] = list(made)
    # Names that no two links share, and that are safe for any file system.
    stem = f"{number}_{file_stem(name)}"
    for mesh in link.iter("mesh"):
        mesh.set("filename", f"{stem}_{mesh.get('filename')}")
    for file, content in files.items():
        (work / f"{stem}_{file}").write_bytes(content)
    for index, element in enumerate(link.findall("visual")):
        element.append(material_of(f"{name}_{index}", colour))


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
    for element in [*visuals, *collisions]:
        mesh = element.find("geometry/mesh")
        if mesh is not None:
            file = Path(mesh.get("filename", "")).name
            what = f"link {name!r}: {element.tag} mesh {file}"
            check_mesh(_loaded(mesh, base), what, 'give its <mesh> scale="0.001 0.001 0.001"')
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
            parts.append(ShapePart(shape_of(element)))
        else:
            parts.append(HullPart(_moved(_loaded(mesh, folder).vertices, pose_of(element))))
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
        corners.append(_moved(loaded.vertices, pose_of(element)))
        triangles.append(np.asarray(loaded.faces, np.intp) + count)
        count += len(loaded.vertices)
    return np.concatenate(corners), np.concatenate(triangles)


def drawn_shapes(link: ET.Element) -> list[Shape]:
    """The primitives that are drawn of a URDF's link, in its frame."""
    return [shape_of(v) for v in link.findall("visual") if v.find("geometry/mesh") is None]


def drawn_elements(
    link: ET.Element, folder: Path
) -> list[tuple[Shape | trimesh.Trimesh, Array, tuple[float, float, float, float]]]:
    """What is drawn of a composed URDF's link, where, and in which colour.

    Shapes are in the link's frame; meshes, whose pose `(4, 4)` in it comes second, in their own.
    """
    found: list[tuple[Shape | trimesh.Trimesh, Array, tuple[float, float, float, float]]] = []
    for visual in link.findall("visual"):
        red, green, blue, alpha = floats(child_of(visual, "material/color").get("rgba", ""))
        mesh = visual.find("geometry/mesh")
        what: Shape | trimesh.Trimesh
        if mesh is None:
            what = dataclasses.replace(shape_of(visual), rgba=(red, green, blue, alpha))
        else:
            path = folder / mesh.get("filename", "")
            loaded = trimesh.load(path, force="mesh", process=False)
            assert isinstance(loaded, trimesh.Trimesh)
            what = loaded
        found.append((what, pose_of(visual), (red, green, blue, alpha)))
    return found


def _enclosed(link: ET.Element, base: Path, vertices: Array, faces: Faces) -> list[Part]:
    """The link's collision parts, grown and joined by others so that all that is drawn is inside.

    A primitive that stands out becomes a part itself.
    """
    parts = link_parts(link, base)
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
            T = inverse(pose_of(element))
            hull = trimesh.Trimesh(_moved(part.points, T)).convex_hull
            _export(hull, mesh, work, f"collision_{index}.obj")
        elif index >= len(own):
            element.append(origin_of(part.shape.T_body_shape))
            element.append(geometry_of(part.shape))


def _export(
    mesh: trimesh.Trimesh, element: ET.Element, work: Path, file: str, normals: bool = False
) -> None:
    write_obj(mesh, work / file, normals)
    element.set("filename", file)
    element.attrib.pop("scale", None)


def _moved(points: Array, T: Array) -> Array:
    return np.asarray(points, np.float64) @ T[:3, :3].T + T[:3, 3]


def _loaded(element: ET.Element, base: Path) -> trimesh.Trimesh:
    """A mesh element's mesh, scaled, in its own frame.

    Raises:
        BrokenFile: it is missing or can't be read.
        InvalidInput: its file is of another type than those that are read.
        MissingExtra: what reads its type isn't installed.
    """
    source = base / element.get("filename", "")
    check_type(source)
    if not os.path.isfile(source):
        raise BrokenFile(f"mesh {source.name} is missing; put it there")
    x, y, z = floats(element.get("scale", "1 1 1"))
    return read_mesh(source, file_digest(source), (x, y, z))
