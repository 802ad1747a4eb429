"""Distances from the robot's convex parts to a point cloud."""

from __future__ import annotations

from dataclasses import dataclass

import coal
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from sart_toolkit.collision.cloud import SceneCloud
from sart_toolkit.collision.hull import Hull, polyhedron_about
from sart_toolkit.collision.parts import ConvexPart, coal_geometry, coal_transform
from sart_toolkit.errors import InvalidInput
from sart_toolkit.poses import Array, check_array

# So many points at a time are held against all faces of a part.
_BLOCK = 256
# Radii of balls are rounded up to steps of at least this [m], so many at most.
_STEP, _LEVELS = 0.00025, 6


@dataclass(frozen=True)
class CloudSeparation:
    """How far a part of the robot is from one point of a cloud.

    `distance` [m] to the ball about the point, negative where they overlap; `p_part`, `p_ball (3,)`
    are the nearest, or where they overlap the deepest, points of the two in the world.
    """

    distance: float
    p_part: Array
    p_ball: Array


class CloudObstacles:
    """Distances from the robot's convex parts to the balls about a cloud's points."""

    def __init__(self, cloud: SceneCloud) -> None:
        """Index the points of `cloud`; seen or filled in, all count.

        Raises:
            InvalidInput: the cloud has no points.
        """
        if not len(cloud):
            raise InvalidInput("cloud: expected at least one point, got none; look at the images")
        level, radii = _levels(cloud.inflation)
        # Points of one radius stand together, each radius with a tree of its own.
        order = np.argsort(level, kind="stable")
        self._points = cloud.points[order]
        self._radii = radii[level[order]]
        starts = np.searchsorted(level[order], np.arange(len(radii)))
        ends = np.append(starts[1:], len(order))
        self._trees = [
            (cKDTree(self._points[a:b], balanced_tree=False, compact_nodes=False), a, float(r))
            for a, b, r in zip(starts, ends, radii, strict=True)
        ]
        self._balls = {float(r): coal.Sphere(float(r)) for r in radii}
        self._request = coal.DistanceRequest()
        # Parts are the same only if they are one object: a gripper's move with its opening.
        self._hulls: dict[ConvexPart, Hull] = {}

    def _hull(self, part: ConvexPart) -> Hull:
        if part not in self._hulls:
            self._hulls[part] = Hull(part.points)
        return self._hulls[part]

    def clearances(self, p_world: Array) -> Array:
        """How far [m] points `(..., 3)` are from the balls, negative in one: `(...)`."""
        return np.asarray(
            np.minimum.reduce([tree.query(p_world)[0] - radius for tree, _, radius in self._trees])
        )

    def distance(self, part: ConvexPart, T_world_joint: Array) -> float:
        """A part's distance [m] from the ball that is nearest to it, negative where they overlap.

        Args:
            part: convex part of the robot.
            T_world_joint: the pose `(4, 4)` of the joint that carries it.
        """
        return min(distance for distance, _ in self._near(part, T_world_joint, 0.0))

    def separations(
        self, part: ConvexPart, T_world_joint: Array, within: float
    ) -> list[CloudSeparation]:
        """The part's distance from each point, up to its smallest one plus `within`; nearest first.

        Args:
            part: convex part of the robot.
            T_world_joint: the pose `(4, 4)` of the joint that carries it.
            within: [m].
        """
        near = sorted(self._near(part, T_world_joint, within), key=lambda found: found[0])
        return [
            CloudSeparation(
                distance, np.array(found.getNearestPoint2()), np.array(found.getNearestPoint1())
            )
            for distance, found in near
            if distance <= near[0][0] + within
        ]

    def _near(
        self, part: ConvexPart, T_world_joint: Array, within: float
    ) -> list[tuple[float, coal.DistanceResult]]:
        """Coal's results, all of points up to the smallest distance plus `within` among them."""
        hull = self._hull(part)
        placed = coal_transform(T_world_joint @ part.T_joint_part)
        centre = T_world_joint[:3, :3] @ hull.centre + T_world_joint[:3, 3]
        first = self._nearest(centre)
        near = [self._separation(part, placed, first)]
        smallest = near[0][0]
        rows, p, coarse = self._candidates(hull, T_world_joint, smallest + within)
        for start in range(0, len(rows), _BLOCK):
            if coarse[start] > smallest + within:
                break
            block = slice(start, start + _BLOCK)
            bounds = hull.bound(p[block]) - self._radii[rows[block]]
            for at in np.argsort(bounds, kind="stable"):
                if bounds[at] > smallest + within:
                    break
                row = int(rows[start + at])
                if row != first:
                    near.append(self._separation(part, placed, row))
                    smallest = min(smallest, near[-1][0])
        return near

    def _nearest(self, p_world: Array) -> int:
        """The row of the point whose ball is nearest to a point `(3,)`."""
        found = []
        for tree, first, radius in self._trees:
            far, row = tree.query(p_world)
            found.append((float(far) - radius, first + int(row)))
        return min(found)[1]

    def _separation(
        self, part: ConvexPart, placed: coal.Transform3s, row: int
    ) -> tuple[float, coal.DistanceResult]:
        # A result that is not new keeps the smallest distance it has seen.
        result = coal.DistanceResult()
        ball = coal.Transform3s(np.eye(3), self._points[row])
        sphere = self._balls[float(self._radii[row])]
        distance = coal.distance(sphere, ball, part.geometry, placed, self._request, result)
        return float(distance), result

    def _candidates(
        self, hull: Hull, T_world_joint: Array, within: float
    ) -> tuple[NDArray[np.intp], Array, Array]:
        """Points whose ball may be within a distance [m] of a hull, most likely first.

        Their rows `(m,)`, their places `(m, 3)` in the joint's frame, and a lower bound `(m,)`.
        """
        centre = T_world_joint[:3, :3] @ hull.centre + T_world_joint[:3, 3]
        found = []
        for tree, first, radius in self._trees:
            # Where balls overlap with a part `within` may be negative.
            reach = max(hull.radius + within + radius, 0.0)
            found.append(first + np.array(tree.query_ball_point(centre, reach), dtype=np.intp))
        rows = np.concatenate(found)
        p = (self._points[rows] - T_world_joint[:3, 3]) @ T_world_joint[:3, :3]
        bounds = hull.coarse_bound(p) - self._radii[rows]
        order = np.flatnonzero(bounds <= within)
        order = order[np.argsort(bounds[order], kind="stable")]
        return rows[order], p[order], bounds[order]


def _levels(radii: Array) -> tuple[NDArray[np.intp], Array]:
    """Radii `(n,)` rounded up to a few: the index of each's among them, and these `(k,)` [m]."""
    low, high = float(radii.min()), float(radii.max())
    step = max(_STEP, (high - low) / (_LEVELS - 1))
    # What is a step already, but for rounding, stays.
    level = np.ceil((radii - low) / step - 1e-9)
    used, index = np.unique(level, return_inverse=True)
    found = np.maximum(low + step * used, [radii[index == i].max() for i in range(len(used))])
    return index.astype(np.intp), found


def hull_part(name: str, joint: int, points: Array) -> ConvexPart:
    """The convex hull of points `(m, 3)` [m] in a joint's frame, as a part that the joint carries.

    Of points of which too many lie in one plane it is a polyhedron of 26 faces about them.

    Raises:
        InvalidInput: fewer than four points, or all in one plane.
    """
    points = check_array(f"points of {name}", points, (None, 3))
    corners = points[Hull(points).corners]
    try:
        geometry = coal_geometry(corners)
    except RuntimeError:
        # coal has a corner meet 255 others at most.
        corners = polyhedron_about(corners)
        geometry = coal_geometry(corners)
    return ConvexPart(name, joint, geometry, np.eye(4), corners)
