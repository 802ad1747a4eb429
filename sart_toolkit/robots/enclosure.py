"""Convex parts that enclose everything drawn of a link, and are as little larger as they can be.

A proof is about convex parts, so what stands out of them may collide unseen. Because a part is
convex, a triangle whose three corners are in one part lies in it: triangles are assigned to parts,
and a part takes in the corners that it lacks, or another part is added where that is tighter.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import ConvexHull, QhullError

from sart_toolkit.poses import Array, inverse
from sart_toolkit.robots.spec import Shape

Faces = NDArray[np.intp]

# How far [m] a corner may stand out of its part when parts are made, and when they are checked.
_SLACK = 1e-7
TOLERANCE = 1e-5
# What stands out by less than this [m] is skin, and the part that is nearest takes it in.
SKIN = 5e-3
# A part takes in what stands out farther where that adds at most this times its own hull's volume.
_FATTER = 1.0
_MAX_NEW_PARTS = 8
# Of a mesh in more pieces the smaller ones go to whichever part is nearest.
_MAX_PIECES = 32
# Half the thickness [m] given to what is flat, in each direction.
_THICKNESS = 1e-4
# So many points at once that what is computed stays in the processor's cache.
_CHUNK = 64


class HullPart:
    """The convex hull of points `(n, 3)` [m], in the link's frame; flat ones are thickened.

    Attributes:
        points: the hull's corners `(k, 3)` [m].
        volume: of the hull [m³].
    """

    def __init__(self, points: Array) -> None:
        try:
            hull = ConvexHull(points)
        except (QhullError, ValueError):
            signs = np.array(np.meshgrid([-1, 1], [-1, 1], [-1, 1])).reshape(3, -1).T
            points = (points[:, None] + _THICKNESS * signs).reshape(-1, 3)
            hull = ConvexHull(points)
        self.points: Array = points[hull.vertices]
        self.volume = float(hull.volume)
        # A flat face comes as many triangles; one half-space serves.
        planes = hull.equations
        _, first = np.unique(np.round(planes, 12), axis=0, return_index=True)
        self._normals, self._offsets = planes[first, :3], planes[first, 3]

    def outside(self, p: Array) -> Array:
        """How far `(n,)` [m] points stand out of a face's plane; negative inside."""
        found = np.empty(len(p))
        for at in range(0, len(p), _CHUNK):
            out = p[at : at + _CHUNK] @ self._normals.T + self._offsets
            found[at : at + _CHUNK] = out.max(axis=1)
        return found

    def grown(self, points: Array) -> HullPart:
        """The hull of this one and of points `(n, 3)`."""
        return HullPart(np.concatenate([self.points, points]))

    def confined(self, p: Array) -> Array:
        """Points `(n, 3)`, those outside moved to about the nearest place inside."""
        p = p.copy()
        far = np.flatnonzero(self.outside(p) > 0)
        for _ in range(100):
            if not len(far):
                return p
            out = p[far] @ self._normals.T + self._offsets
            worst = out.argmax(axis=1)
            depth = out[np.arange(len(far)), worst]
            p[far] -= (np.maximum(depth, 0) + _SLACK / 10)[:, None] * self._normals[worst]
            far = far[depth > 0]
        # Where planes meet at a sharp angle that takes long: go straight towards the middle.
        centre = self.points.mean(axis=0)
        inside = self._normals @ centre + self._offsets
        out = p[far] @ self._normals.T + self._offsets
        t = np.where(out > 0, -inside / np.maximum(out - inside, 1e-300), 1.0).min(axis=1)
        p[far] = centre + t[:, None] * (p[far] - centre)
        return p


@dataclass(frozen=True)
class ShapePart:
    """A primitive as a part of a link."""

    shape: Shape

    def outside(self, p: Array) -> Array:
        """How far `(n,)` [m] points stand out at least; negative inside."""
        T, size = inverse(self.shape.T_body_shape), self.shape.size
        local = p @ T[:3, :3].T + T[:3, 3]
        if self.shape.kind == "box":
            return (np.abs(local) - np.array(size) / 2).max(axis=1)
        if self.shape.kind == "sphere":
            return np.linalg.norm(local, axis=1) - size[0]
        return np.maximum(
            np.hypot(local[:, 0], local[:, 1]) - size[0], np.abs(local[:, 2]) - size[1] / 2
        )

    def confined(self, p: Array) -> Array:
        """Points `(n, 3)`, those outside moved inside, straight towards the middle."""
        p, centre = p.copy(), self.shape.T_body_shape[:3, 3]
        far = np.flatnonzero(self.outside(p) > 0)
        inside, outside = np.zeros(len(far)), np.ones(len(far))
        for _ in range(40):
            t = (inside + outside) / 2
            within = self.outside(centre + t[:, None] * (p[far] - centre)) <= 0
            inside, outside = np.where(within, t, inside), np.where(within, outside, t)
        p[far] = centre + inside[:, None] * (p[far] - centre)
        return p

    def encloses(self, other: Shape) -> bool:
        """Whether another primitive is the same, in the same place."""
        return (
            self.shape.kind == other.kind
            and bool(np.allclose(self.shape.size, other.size, rtol=0, atol=_SLACK))
            and bool(np.allclose(self.shape.T_body_shape, other.T_body_shape, rtol=0, atol=_SLACK))
        )


Part = HullPart | ShapePart


def standing_out(parts: Sequence[Part], vertices: Array, faces: Faces) -> Array:
    """How far `(n,)` [m] each triangle stands out of the part that encloses it best.

    Args:
        parts: convex parts.
        vertices: corners `(m, 3)` [m].
        faces: the triangles' corners `(n, 3)`, by index.
    """
    return _outs(parts, vertices, faces).min(axis=0)


def shape_stands_out(parts: Sequence[Part], shape: Shape) -> bool:
    """Whether no part alone is known to enclose a primitive."""
    if any(isinstance(part, ShapePart) and part.encloses(shape) for part in parts):
        return False
    if shape.kind == "sphere":
        # A ball is inside where its centre is that deep.
        centre, radius = shape.T_body_shape[None, :3, 3], shape.size[0]
    else:
        centre, radius = shape.corners(), 0.0
    return all(part.outside(centre).max() > _SLACK - radius for part in parts)


def enclose(parts: Sequence[Part], vertices: Array, faces: Faces) -> list[Part]:
    """Parts grown, and joined by others, until each triangle is inside one of them.

    Args:
        parts: those that a link's collision elements give.
        vertices: corners `(m, 3)` [m] of what is drawn of the link, in its frame.
        faces: the triangles' corners `(n, 3)`, by index.
    """
    made = list(parts)
    loose = _take_in(made, vertices, faces, SKIN)
    added = 0
    for piece in _pieces(vertices, loose)[:_MAX_PIECES]:
        piece = piece[standing_out(made, vertices, piece) > _SLACK]
        if not len(piece):
            continue
        points = vertices[np.unique(piece)]
        new = HullPart(points)
        options = [
            (grown.volume - part.volume, i, grown)
            for i, part in enumerate(made)
            if isinstance(part, HullPart)
            for grown in [part.grown(points)]
        ]
        more, i, grown = min(options, key=lambda option: option[0], default=(np.inf, -1, new))
        if options and (
            more <= _FATTER * new.volume
            or made[i].outside(points).max() <= SKIN
            or added >= _MAX_NEW_PARTS
        ):
            made[i] = grown
        else:
            made.append(new)
            added += 1
    _take_in(made, vertices, loose, np.inf)
    return made


def _take_in(parts: list[Part], vertices: Array, faces: Faces, within: float) -> Faces:
    """Grow hulls by the triangles that stand out by up to `within` [m] of the nearest hull.

    Returns the triangles `(k, 3)` that stand out farther.
    """
    loose = faces[standing_out(parts, vertices, faces) > _SLACK]
    hulls = {i: part for i, part in enumerate(parts) if isinstance(part, HullPart)}
    if not hulls or not len(loose):
        return loose
    outs = _outs(list(hulls.values()), vertices, loose)
    nearest, near = outs.argmin(axis=0), outs.min(axis=0) <= within
    for index, (i, part) in enumerate(hulls.items()):
        taken = loose[near & (nearest == index)]
        if len(taken):
            parts[i] = part.grown(vertices[np.unique(taken)])
    return loose[~near]


def _outs(parts: Sequence[Part], vertices: Array, faces: Faces) -> Array:
    """How far `(parts, n)` [m] each triangle stands out of each part; infinite without parts."""
    if not parts or not len(faces):
        return np.full((max(len(parts), 1), len(faces)), np.inf)
    used, index = np.unique(faces, return_inverse=True)
    index = index.reshape(faces.shape)
    return np.stack([part.outside(vertices[used])[index].max(axis=1) for part in parts])


def _pieces(vertices: Array, faces: Faces) -> list[Faces]:
    """Triangles that hang together, each lot `(k, 3)`, the one that extends farthest first."""
    if not len(faces):
        return []
    # Corners in one place may be several vertices, of different normals for instance.
    _, same = np.unique(np.round(vertices, 6), axis=0, return_inverse=True)
    corners = same.reshape(-1)[faces]
    n = int(corners.max()) + 1
    a, b = corners[:, [0, 1]].ravel(), corners[:, [1, 2]].ravel()
    _, label = connected_components(coo_matrix((np.ones(len(a)), (a, b)), (n, n)), directed=False)
    label = label[corners[:, 0]]
    pieces = [faces[label == i] for i in np.unique(label)]
    return sorted(pieces, key=lambda piece: -float(np.ptp(vertices[piece].reshape(-1, 3), 0).max()))
