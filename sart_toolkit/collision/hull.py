"""Convex hulls of points, as half-spaces: what lies in them, and how far points are at least."""

from __future__ import annotations

import itertools

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull, HalfspaceIntersection, QhullError

from sart_toolkit.errors import InvalidInput
from sart_toolkit.poses import Array

# The 13 axes through the corners, edges and faces of a cube.
_AXES = np.array(
    [a for a in itertools.product((-1, 0, 1), repeat=3) if a > (0, 0, 0)], dtype=np.float64
)
_AXES /= np.linalg.norm(_AXES, axis=1, keepdims=True)


class Hull:
    """The convex hull of points, as half-spaces and a bounding sphere in their frame."""

    def __init__(self, points: Array) -> None:
        """Take the hull of points `(n, 3)` [m].

        Raises:
            InvalidInput: fewer than four points, or all in one plane.
        """
        try:
            hull = ConvexHull(points)
        except (QhullError, ValueError) as error:
            raise InvalidInput(
                f"hull of {len(points)} points: expected at least 4 that are not in one plane"
            ) from error
        equations = hull.equations
        # A flat face comes as many triangles; one half-space serves.
        _, first = np.unique(np.round(equations, 6), axis=0, return_index=True)
        self._normals, self._offsets = equations[first, :3], equations[first, 3]
        self.corners = hull.vertices
        corners = points[self.corners]
        self.centre = (corners.min(0) + corners.max(0)) / 2
        self.radius = float(np.linalg.norm(corners - self.centre, axis=1).max())
        along = corners @ _AXES.T
        self._low, self._high = along.min(0), along.max(0)

    def coarse_bound(self, p: Array) -> Array:
        """A lower bound `(n,)` of the distances of points to the hull, quickly computed."""
        along = _AXES @ p.T
        return np.maximum(along - self._high[:, None], self._low[:, None] - along).max(axis=0)

    def bound(self, p: Array) -> Array:
        """A lower bound `(n,)` of the signed distances of points to the hull.

        It is the distance where the nearest point of the hull is on a face, and inside.
        """
        return (self._normals @ p.T + self._offsets[:, None]).max(axis=0)

    def near(self, p: Array, margin: float | Array) -> NDArray[np.bool_]:
        """Which points `(n, 3)` are inside the hull, its half-spaces grown by a margin [m].

        There may be a margin `(n,)` for each point. The coarse axes cut off the far corners that a
        sharp edge's half-spaces grow.
        """
        inside = self.coarse_bound(p) <= margin
        found = np.flatnonzero(inside)
        inside[found] = self.bound(p[found]) <= np.broadcast_to(margin, inside.shape)[found]
        return inside


def polyhedron_about(points: Array) -> Array:
    """Corners `(k, 3)` of a polyhedron of 26 faces, at fixed angles, that encloses points `(n, 3)`.

    The points aren't all in one plane.
    """
    normals = np.concatenate([_AXES, -_AXES])
    farthest = (points @ normals.T).max(axis=0)
    planes = np.column_stack([normals, -farthest])
    return np.asarray(HalfspaceIntersection(planes, points.mean(axis=0)).intersections)
