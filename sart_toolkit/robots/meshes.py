"""Meshes in files: read once, checked whole, and convex parts that enclose one."""

from __future__ import annotations

import functools
import hashlib
import importlib.metadata
import importlib.util
import io
import json
import os
import tempfile
import time
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.spatial import HalfspaceIntersection

from sart_toolkit.errors import BrokenFile, InvalidInput, MissingExtra
from sart_toolkit.poses import Array
from sart_toolkit.robots.enclosure import (
    SKIN,
    TOLERANCE,
    Faces,
    HullPart,
    Part,
    enclose,
    standing_out,
)
from sart_toolkit.robots.references import cache_dir
from sart_toolkit.robots.source import read_bytes

_TYPES = (".dae", ".glb", ".obj", ".off", ".ply", ".stl")
_MAX_BYTES = 100 << 20
# No link and no body is larger, none smaller [m].
_MAX_EXTENT, _MIN_EXTENT = 10.0, 1e-4
# Faces that meet at a sharper angle show an edge.
_CREASE_DEG = 30.0
# PhysX takes a hull of at most 255 corners, coal one whose corners meet 255 others; so many planes
# make no more.
_MOST_CORNERS, _MOST_PLANES = 250, 126
# Triangles that lie in no part alone are cut until their edges are this share of the mesh's extent.
_FINE = 1 / 30
# In how many colours a texture is drawn.
_MOST_COLOURS = 32

Rgba = tuple[float, float, float, float]


# --- files ----------------------------------------------------------------------------------------

_digests: dict[tuple[str, int, int, int], str] = {}


def file_digest(path: Path) -> str:
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
        digest = hashlib.sha256(read_bytes(path, _MAX_BYTES)).hexdigest()
        # A file written just now may be written again within the same tick of its clock.
        if time.time_ns() - found.st_mtime_ns < 2_000_000_000:
            return digest
        _digests[key] = digest
    return _digests[key]


def check_type(source: Path) -> None:
    """Return if a mesh of a file's type can be read.

    Raises:
        InvalidInput: its file is of another type than those that are read.
        MissingExtra: what reads its type isn't installed.
    """
    if source.suffix.lower() not in _TYPES:
        raise InvalidInput(
            f"mesh {source.name}: expected a file ending in {', '.join(_TYPES)}; convert it"
        )
    if source.suffix.lower() == ".dae" and importlib.util.find_spec("collada") is None:
        raise MissingExtra(
            f"mesh {source.name}: Collada files need pycollada; pip install 'sart_toolkit[meshes]'"
        )


@functools.lru_cache(maxsize=64)
def read_mesh(source: Path, digest: str, scale: tuple[float, float, float]) -> trimesh.Trimesh:
    """The mesh of a file of that content, scaled; not to be changed.

    Raises:
        BrokenFile: it can't be read, or its content is another by now.
    """
    content = _content(source, digest)
    try:
        mesh = _parsed(source, content)
        mesh.process()
        mesh.apply_scale(scale)
        mesh.merge_vertices(merge_tex=True, merge_norm=True)
    except Exception as error:
        raise BrokenFile(
            f"mesh {source.name}: can't be read ({type(error).__name__}: {error}); export it again"
        ) from error
    return mesh


def _content(source: Path, digest: str) -> bytes:
    content = read_bytes(source, _MAX_BYTES)
    if hashlib.sha256(content).hexdigest() != digest:
        raise BrokenFile(f"{source.name}: has changed since it was first read; start again")
    return content


def _parsed(source: Path, content: bytes) -> trimesh.Trimesh:
    """A file's mesh as it is; what it raises is no error of ours."""
    kind = source.suffix[1:].lower()
    if kind == "stl":
        _check_whole(content)
    # From bytes, so that no other file that it names is read.
    mesh = trimesh.load(io.BytesIO(content), file_type=kind, force="mesh", process=False)
    assert isinstance(mesh, trimesh.Trimesh)
    # Processing drops corners that aren't finite, and all triangles at them.
    if mesh.vertices.ndim != 2 or mesh.vertices.shape[1] != 3:
        raise ValueError("corners without three coordinates")
    if not np.isfinite(mesh.vertices).all():
        raise ValueError("NaN or infinite vertices")
    return mesh


def _check_whole(content: bytes) -> None:
    """Return if an STL file doesn't break off, up to where it would be read.

    Raises:
        ValueError: it does.
    """
    if not content:
        raise ValueError("it is empty")
    if content[:5].lower() == b"solid" and b"facet" in content[:2000]:
        if b"endsolid" not in content[-200:].lower():
            raise ValueError("it breaks off before endsolid")
    elif len(content) < 84 + 50 * (count := int.from_bytes(content[80:84], "little")):
        raise ValueError(f"it breaks off before its {count} triangles end")


def check_mesh(mesh: trimesh.Trimesh, what: str, remedy: str) -> None:
    """Return if a mesh can be enclosed; holes and flat triangles do that no harm.

    Args:
        mesh: the mesh, scaled.
        what: what it is called in the error.
        remedy: what to give where its file is in millimetres.

    Raises:
        InvalidInput: it has no faces, numbers that aren't finite, or is far too large.
    """
    if not len(mesh.faces):
        raise InvalidInput(f"{what} has no triangles; export it again")
    if not np.isfinite(mesh.vertices).all():
        raise InvalidInput(f"{what} has NaN or infinite vertices; export it again")
    if (farthest := np.abs(mesh.vertices).max()) > _MAX_EXTENT:
        raise InvalidInput(
            f"{what} reaches {farthest:.4g} m from its origin, expected at most "
            f"{_MAX_EXTENT:g} m; if its file is in millimetres, {remedy}"
        )


def check_body_mesh(mesh: trimesh.Trimesh, name: str) -> None:
    """Return if a mesh, scaled, can be a body's.

    Raises:
        InvalidInput: it has no faces, or is far too large or too small.
    """
    check_mesh(mesh, f"mesh {name}", "give scale=0.001")
    if (size := np.ptp(mesh.vertices, axis=0).max()) < _MIN_EXTENT:
        raise InvalidInput(
            f"mesh {name} is {size:.2g} m long, expected at least {_MIN_EXTENT:g} m; check its "
            "scale"
        )


def write_obj(mesh: trimesh.Trimesh, path: Path, normals: bool = False) -> None:
    """Write a mesh for any reader of URDFs: an OBJ file without materials, to 1 nm."""
    mesh.export(path, include_normals=normals, include_texture=False, digits=9)


# --- what is drawn --------------------------------------------------------------------------------


def creased(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    """The mesh with normals at its corners: smooth, but for edges where faces meet sharply."""
    return trimesh.graph.smooth_shade(mesh, angle=np.deg2rad(_CREASE_DEG), facet_minarea=None)


@functools.lru_cache(maxsize=64)
def drawn_pieces(
    source: Path,
    digest: str,
    scale: tuple[float, float, float],
    texture: tuple[Path, str] | None,
) -> tuple[tuple[trimesh.Trimesh, Rgba | None], ...]:
    """A mesh as it is drawn: pieces of one colour each, or one without where it has no colours.

    Args:
        source, digest, scale: as of `read_mesh`.
        texture: an image to colour it by instead of what its own file has, and its digest.

    Raises:
        BrokenFile: a file can't be read, or its content is another by now.
        InvalidInput: there is a texture, but the mesh doesn't say where it goes.
    """
    mesh = read_mesh(source, digest, scale)
    colours = _face_colours(source, digest, texture)
    if colours is None or len(colours) != len(mesh.faces):
        return ((creased(mesh), None),)
    of_face = _few(colours)
    pieces = []
    for colour in np.unique(of_face, axis=0):
        faces = np.flatnonzero((of_face == colour).all(axis=1))
        piece = trimesh.Trimesh(mesh.vertices, mesh.faces[faces], process=False)
        piece.remove_unreferenced_vertices()
        red, green, blue, alpha = (float(value) for value in colour)
        pieces.append((creased(piece), (red, green, blue, alpha)))
    return tuple(pieces)


def _face_colours(source: Path, digest: str, texture: tuple[Path, str] | None) -> Array | None:
    """Each triangle's colour `(n, 4)` in [0, 1], in the file's order; None without colours."""
    mesh = _parsed(source, _content(source, digest))
    visual: Any = mesh.visual
    uv = getattr(visual, "uv", None)
    if texture is not None:
        if uv is None or len(uv) != len(mesh.vertices):
            raise InvalidInput(
                f"mesh {source.name}: has no texture coordinates, so {texture[0].name} can't be "
                "laid on it; give rgba, or export it with them"
            )
        colours = trimesh.visual.color.uv_to_color(uv[mesh.faces].mean(axis=1), _image(*texture))
    elif visual.kind == "texture":
        where = np.zeros((len(mesh.faces), 2)) if uv is None else uv[mesh.faces].mean(axis=1)
        material = visual.material
        if getattr(material, "image", None) is None and (
            getattr(material, "baseColorTexture", None) is None
        ):
            # An OBJ file whose material is in another one has no colour of its own.
            if source.suffix.lower() == ".obj":
                return None
            colours = np.tile(material.main_color, (len(mesh.faces), 1))
        else:
            colours = material.to_color(where)
    elif visual.kind in ("face", "vertex"):
        colours = visual.face_colors
    else:
        return None
    found = np.asarray(colours, np.float64).reshape(len(mesh.faces), -1) / 255
    return found if found.shape[1] == 4 else np.column_stack([found, np.ones(len(found))])


def _image(path: Path, digest: str) -> Any:
    from PIL import Image

    content = _content(path, digest)
    try:
        return Image.open(io.BytesIO(content)).convert("RGBA")
    except Exception as error:
        raise BrokenFile(
            f"texture {path.name}: can't be read ({type(error).__name__}: {error}); give a PNG or "
            "JPEG image"
        ) from error


def check_texture(source: Path, digest: str, texture: tuple[Path, str]) -> None:
    """Return if an image can be laid on a mesh.

    Raises:
        BrokenFile: a file can't be read.
        InvalidInput: the mesh doesn't say where the image goes.
    """
    _face_colours(source, digest, texture)


def _few(colours: Array) -> Array:
    """Colours `(n, 4)`, near ones replaced by one, so that there are few."""
    cells = 256
    of_face = np.round(colours * 255).astype(int)
    while len(np.unique(of_face, axis=0)) > _MOST_COLOURS:
        cells //= 2
        of_face = np.minimum((colours * cells).astype(int), cells - 1)
    _, cell = np.unique(of_face, axis=0, return_inverse=True)
    cell = cell.reshape(-1)
    counts = np.bincount(cell)
    means = np.stack([np.bincount(cell, channel) / counts for channel in colours.T], axis=1)
    return np.asarray(np.round(means, 4)[cell])


# --- convex parts ---------------------------------------------------------------------------------


def hull_corners(points: Array) -> Array:
    """Corners `(k, 3)` of a hull that encloses points `(n, 3)`: theirs, if they are not too many.

    Otherwise it is a polyhedron about them, of faces that lie like some of the hull's.
    """
    corners = HullPart(points).points
    if len(corners) <= _MOST_CORNERS:
        return corners
    normals = trimesh.convex.convex_hull(corners).face_normals
    # The box's faces close it; of the others those that differ most.
    chosen = [*np.eye(3), *-np.eye(3)]
    nearness = np.max(normals @ np.array(chosen).T, axis=1)
    while len(chosen) < _MOST_PLANES:
        chosen.append(normals[int(np.argmin(nearness))])
        nearness = np.maximum(nearness, normals @ chosen[-1])
    planes = np.array(chosen)
    farthest = (corners @ planes.T).max(axis=0)
    found = HalfspaceIntersection(np.column_stack([planes, -farthest]), corners.mean(axis=0))
    return HullPart(found.intersections).points


@functools.lru_cache(maxsize=64)
def mesh_hull(source: Path, digest: str, scale: tuple[float, float, float]) -> Array:
    """Corners `(n, 3)` [m] of a convex part that encloses the mesh of a file."""
    return _frozen(hull_corners(read_mesh(source, digest, scale).vertices))


@functools.lru_cache(maxsize=64)
def enclosing_parts(
    source: Path,
    digest: str,
    scale: tuple[float, float, float],
    given: tuple[tuple[Path, str], ...] | None,
) -> tuple[Array, ...]:
    """Convex parts, as corners `(n, 3)` [m] each, in which each triangle's points all lie.

    What is inside of a closed mesh need not be in a part: nothing gets there but through a
    triangle.

    Args:
        source, digest, scale: as of `read_mesh`.
        given: files of meshes whose hulls are the parts, with digests; they are grown by what
            little stands out. Without them the parts are those that CoACD finds.

    Raises:
        BrokenFile: a file can't be read, or its content is another by now.
        InvalidInput: a part is empty, or some of the mesh is in none of them.
        MissingExtra: CoACD isn't installed.
    """
    mesh = read_mesh(source, digest, scale)
    vertices, faces = np.array(mesh.vertices), np.array(mesh.faces, np.intp)
    if given is None:
        found = _decomposition(mesh, digest, scale)
    else:
        for path, known in given:
            check_body_mesh(read_mesh(path, known, scale), path.name)
        found = [np.array(read_mesh(*file, scale).vertices) for file in given]
    parts: list[Part] = [HullPart(hull_corners(points)) for points in found]
    vertices, faces = _cut(parts, vertices, faces)
    if given is not None:
        out = standing_out(parts, vertices, faces)
        if out.max() > SKIN:
            x, y, z = vertices[faces[int(out.argmax())]].mean(axis=0)
            raise InvalidInput(
                f"mesh {source.name}: near ({x:.3f}, {y:.3f}, {z:.3f}) m it stands "
                f"{out.max() * 1e3:.1f} mm out of its parts; add a part there, or take "
                "collision='hull'"
            )
    grown = [part for part in enclose(parts, vertices, faces) if isinstance(part, HullPart)]
    made = [HullPart(hull_corners(part.points)) for part in grown]
    # It is what proofs rest on, so it is not taken for granted.
    if standing_out(made, vertices, faces).max() > TOLERANCE:
        raise InvalidInput(
            f"mesh {source.name}: its convex parts can't be made to enclose it; take "
            "collision='hull'"
        )
    return tuple(_frozen(part.points) for part in made)


def _cut(parts: Sequence[Part], vertices: Array, faces: Faces) -> tuple[Array, Faces]:
    """The mesh with those triangles cut small that lie in no part alone."""
    loose = standing_out(parts, vertices, faces) > TOLERANCE / 10
    if not loose.any():
        return vertices, faces
    edge = float(np.ptp(vertices, axis=0).max()) * _FINE
    cut, pieces = trimesh.remesh.subdivide_to_size(vertices, faces[loose], edge, max_iter=20)
    whole = faces[~loose]
    return np.concatenate([vertices, cut]), np.concatenate([whole, pieces + len(vertices)])


def check_coacd(name: str) -> None:
    """Return if a mesh can be decomposed.

    Raises:
        MissingExtra: CoACD isn't installed.
    """
    if importlib.util.find_spec("coacd") is None:
        raise MissingExtra(
            f"mesh {name}: collision='decomposed' needs CoACD; pip install "
            "'sart_toolkit[decompose]', or give files of convex parts, or take 'hull'"
        )


def _decomposition(
    mesh: trimesh.Trimesh, digest: str, scale: tuple[float, float, float]
) -> list[Array]:
    """The parts that CoACD finds, which takes seconds, so they are kept in the cache."""
    check_coacd(digest[:8])
    version = importlib.metadata.version("coacd")
    key = hashlib.sha256(json.dumps([version, digest, scale]).encode()).hexdigest()[:16]
    path = cache_dir() / f"parts-{key}.npz"
    # Whatever was kept there, the parts are made to enclose the mesh afterwards.
    with suppress(OSError, ValueError, KeyError):
        with np.load(path, allow_pickle=False) as kept:
            found = [np.array(kept[name], np.float64) for name in sorted(kept.files)]
        if found and all(p.ndim == 2 and p.shape[1] == 3 and np.isfinite(p).all() for p in found):
            return found
    import coacd

    coacd.set_log_level("error")
    made = coacd.run_coacd(coacd.Mesh(np.array(mesh.vertices), np.array(mesh.faces)), seed=0)
    found = [np.array(vertices, np.float64) for vertices, _ in made]
    # What can't be kept is found again.
    with suppress(OSError):
        path.parent.mkdir(parents=True, exist_ok=True)
        handle, temporary = tempfile.mkstemp(dir=path.parent)
        with os.fdopen(handle, "wb") as file:
            named: dict[str, Any] = {f"part{i:03d}": points for i, points in enumerate(found)}
            np.savez(file, **named)
        os.replace(temporary, path)
    return found


# --- solids ---------------------------------------------------------------------------------------


def solid(mesh: trimesh.Trimesh) -> tuple[bool, float, Array, Array]:
    """A mesh as a solid of even density.

    Returns:
        Whether it is closed, as otherwise the rest is of its hull; volume [m³]; centre `(3,)` [m];
        inertia per mass `(3, 3)` [m²] about it.
    """
    closed = bool(mesh.is_watertight and mesh.is_winding_consistent and abs(mesh.volume) > 0)
    body = mesh
    if not closed:
        corners = HullPart(mesh.vertices).points
        body = trimesh.convex.convex_hull(corners)
    properties = body.mass_properties
    volume = float(properties.volume)
    # Faces that all look inwards give the same numbers, negative.
    return (
        closed,
        abs(volume),
        np.array(properties.center_mass),
        np.array(properties.inertia) / volume,
    )


def nearest_on(triangles: Array, p: Array) -> Array:
    """The points `(n, 3)` of triangles `(m, 3, 3)` that are nearest to points `p (n, 3)`."""
    found = np.empty_like(p)
    at_once = max(1, 200_000 // len(triangles))
    for first in range(0, len(p), at_once):
        some = p[first : first + at_once]
        pairs = np.repeat(some, len(triangles), axis=0)
        on = trimesh.triangles.closest_point(np.tile(triangles, (len(some), 1, 1)), pairs)
        apart = np.linalg.norm(on - pairs, axis=1).reshape(len(some), -1)
        best = apart.argmin(axis=1)
        found[first : first + at_once] = on.reshape(len(some), -1, 3)[np.arange(len(some)), best]
    return found


def hull_mesh(points: Array) -> trimesh.Trimesh:
    """The convex hull of points `(n, 3)` as a mesh."""
    return trimesh.convex.convex_hull(points)


def _frozen(points: NDArray[np.float64]) -> Array:
    points = np.array(points)
    points.setflags(write=False)
    return points
