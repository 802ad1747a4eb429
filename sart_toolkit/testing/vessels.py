"""A mug with a handle and a funnel as meshes, made by code, for scenes that test meshes."""

from __future__ import annotations

import hashlib
import os
import tempfile
from functools import cache
from pathlib import Path

import numpy as np
import trimesh

from sart_toolkit.poses import Array
from sart_toolkit.robots.references import cache_dir

# All lengths in metres; both stand on z = 0.
VESSEL_HEIGHT = 0.10
_SIDES = 24
_RADIUS, _WALL, _FLOOR = 0.04, 0.004, 0.006
# The handle: part of a ring in the x-z plane, of square section.
_HANDLE_RADIUS, _HANDLE_WIDTH, _HANDLE_PIECES = 0.03, 0.008, 8
_FUNNEL_NECK, _FUNNEL_MOUTH, _FUNNEL_WALL = 0.008, 0.05, 0.003
# Where the funnel's neck ends and its cone begins.
_FUNNEL_THROAT = 0.04


@cache
def mug() -> trimesh.Trimesh:
    """A mug with a handle at +x: a cup and a handle that begins and ends in its wall."""
    profile = [
        [0, 0], [_RADIUS, 0], [_RADIUS, VESSEL_HEIGHT], [_RADIUS - _WALL, VESSEL_HEIGHT],
        [_RADIUS - _WALL, _FLOOR], [0, _FLOOR],
    ]  # fmt: skip
    cup = trimesh.creation.revolve(np.array(profile), sections=_SIDES)
    cuts = _handle_cuts()
    made = trimesh.util.concatenate([cup, _tube(cuts)])
    assert isinstance(made, trimesh.Trimesh)
    return made


@cache
def mug_parts() -> tuple[trimesh.Trimesh, ...]:
    """Convex meshes that a mug is made of: floor, staves of the wall, pieces of the handle."""
    ring = _ring()
    hulls = [np.concatenate([_RADIUS * ring, _RADIUS * ring + [0, 0, _FLOOR]])]
    for a, b in zip(ring, np.roll(ring, -1, axis=0), strict=True):
        foot = np.array([r * corner for corner in (a, b) for r in (_RADIUS - _WALL, _RADIUS)])
        hulls.append(np.concatenate([foot, foot + [0, 0, VESSEL_HEIGHT]]))
    cuts = _handle_cuts()
    hulls += [np.concatenate(ends) for ends in zip(cuts[:-1], cuts[1:], strict=True)]
    return tuple(trimesh.convex.convex_hull(points) for points in hulls)


@cache
def funnel() -> trimesh.Trimesh:
    """A funnel standing on its neck, open at both ends."""
    outer = [
        [_FUNNEL_NECK, 0], [_FUNNEL_NECK, _FUNNEL_THROAT], [_FUNNEL_MOUTH, VESSEL_HEIGHT],
    ]  # fmt: skip
    inner = [[r - _FUNNEL_WALL, z] for r, z in reversed(outer)]
    profile = np.array([*outer, *inner, outer[0]])
    return trimesh.creation.revolve(profile, sections=_SIDES)


def written(mesh: trimesh.Trimesh) -> Path:
    """A file of a mesh, in the cache by its content."""
    content = mesh.export(file_type="stl")
    assert isinstance(content, bytes)
    path = cache_dir() / f"mesh-{hashlib.sha256(content).hexdigest()[:16]}.stl"
    if not path.exists():
        path.parent.mkdir(parents=True, exist_ok=True)
        handle, temporary = tempfile.mkstemp(dir=path.parent)
        with os.fdopen(handle, "wb") as file:
            file.write(content)
        os.replace(temporary, path)
    return path


def _ring() -> Array:
    """Directions `(n, 3)` of the cup's corners, as trimesh turns a profile about z."""
    angles = 2 * np.pi * np.arange(_SIDES) / _SIDES
    return np.stack([np.cos(angles), np.sin(angles), np.zeros(_SIDES)], axis=1)


def _handle_cuts() -> list[Array]:
    """The corners `(4, 3)` of cuts across the handle, half a ring whose ends are in the wall."""
    middle = np.array([_RADIUS - _WALL / 2, 0, VESSEL_HEIGHT / 2])
    half = _HANDLE_WIDTH / 2
    cuts = []
    for angle in np.linspace(-np.pi / 2, np.pi / 2, _HANDLE_PIECES + 1):
        out = np.array([np.cos(angle), 0, np.sin(angle)])
        square = [(-half, -half), (half, -half), (half, half), (-half, half)]
        cuts.append(np.array([middle + (_HANDLE_RADIUS + r) * out + [0, y, 0] for r, y in square]))
    return cuts


def _tube(cuts: list[Array]) -> trimesh.Trimesh:
    """A closed mesh along cuts of four corners each."""
    faces = [[0, 1, 2], [0, 2, 3]]
    for first in range(0, 4 * (len(cuts) - 1), 4):
        for i in range(4):
            a, b = first + i, first + (i + 1) % 4
            faces += [[a, a + 4, b], [b, a + 4, b + 4]]
    last = 4 * (len(cuts) - 1)
    faces += [[last, last + 2, last + 1], [last, last + 3, last + 2]]
    return trimesh.Trimesh(np.concatenate(cuts), faces, process=False)
