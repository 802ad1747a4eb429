"""Distances from the robot's convex parts to a point cloud."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import coal
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from sart_toolkit.collision.cloud import SceneCloud
from sart_toolkit.collision.hull import Hull
from sart_toolkit.collision.model import ConvexPart, coal_transform
from sart_toolkit.poses import Array, check_array

# So many points at a time are held against all faces of a part.
_BLOCK = 256


@dataclass(frozen=True)
class CloudSeparation:
    """How far a part of the robot is from one point of a cloud.

    `distance` [m] to the ball about `p_cloud (3,)`, negative where they overlap; `p_part (3,)` is
    the part's point nearest to it, `normal (3,)` the unit vector from cloud to part; world frame.
    """

    body: str
    distance: float
    p_part: Array
    p_cloud: Array
    normal: Array


class CloudObstacles:
    """Distances from the robot's convex parts to the balls about a cloud's points."""

    def __init__(self, cloud: SceneCloud) -> None:
        """Index the points of `cloud`; seen or filled in, all count."""
        self._points = cloud.points
        self._tree = cKDTree(cloud.points, balanced_tree=False, compact_nodes=False)
        self._inflation = cloud.config.inflation
        self._ball = coal.Sphere(cloud.config.inflation)
        # Parts are the same only if they are one object: a gripper's move with its opening.
        self._hulls: dict[ConvexPart, Hull] = {}

    def _hull(self, part: ConvexPart) -> Hull:
        if part not in self._hulls:
            self._hulls[part] = Hull(part.points)
        return self._hulls[part]

    def _separation(
        self, part: ConvexPart, placed: coal.Transform3s, index: int
    ) -> CloudSeparation:
        p_cloud = self._points[index]
        # A result that is not new keeps the smallest distance it has seen.
        result = coal.DistanceResult()
        distance = coal.distance(
            self._ball,
            coal.Transform3s(np.eye(3), p_cloud),
            part.geometry,
            placed,
            coal.DistanceRequest(),
            result,
        )
        return CloudSeparation(
            part.body,
            float(distance),
            np.array(result.getNearestPoint2()),
            p_cloud,
            np.array(result.normal),
        )

    def _candidates(
        self, hull: Hull, T_world_joint: Array, within: float
    ) -> tuple[NDArray[np.intp], Array, Array]:
        """Points whose ball may be within a distance [m] of a hull, most likely first.

        Their rows `(m,)`, their places `(m, 3)` in the joint's frame, and a lower bound `(m,)`.
        """
        centre = T_world_joint[:3, :3] @ hull.centre + T_world_joint[:3, 3]
        # Where balls overlap with a part `within` may be negative.
        reach = max(hull.radius + within + self._inflation, 0.0)
        rows = np.array(self._tree.query_ball_point(centre, reach), dtype=np.intp)
        p = (self._points[rows] - T_world_joint[:3, 3]) @ T_world_joint[:3, :3]
        bounds = hull.coarse_bound(p) - self._inflation
        order = np.flatnonzero(bounds <= within)
        order = order[np.argsort(bounds[order], kind="stable")]
        return rows[order], p[order], bounds[order]

    def distances(
        self, part: ConvexPart, T_world_joint: Array, within: float
    ) -> list[CloudSeparation]:
        """The part's distance from each point, up to its smallest one plus `within`; nearest first.

        Args:
            part: convex part of the robot.
            T_world_joint: the pose `(4, 4)` of the joint that carries it.
            within: [m].
        """
        if not len(self._points):
            return []
        hull = self._hull(part)
        placed = coal_transform(T_world_joint @ part.T_joint_part)
        centre = T_world_joint[:3, :3] @ hull.centre + T_world_joint[:3, 3]
        first = int(self._tree.query(centre)[1])
        found = [self._separation(part, placed, first)]
        smallest = found[0].distance
        rows, p, coarse = self._candidates(hull, T_world_joint, smallest + within)
        for start in range(0, len(rows), _BLOCK):
            if coarse[start] > smallest + within:
                break
            bounds = hull.bound(p[start : start + _BLOCK]) - self._inflation
            for at in np.argsort(bounds, kind="stable"):
                if bounds[at] > smallest + within:
                    break
                row = int(rows[start + at])
                if row == first:
                    continue
                found.append(self._separation(part, placed, row))
                smallest = min(smallest, found[-1].distance)
        found = [each for each in found if each.distance <= smallest + within]
        return sorted(found, key=lambda each: each.distance)

    def nearest(self, parts: Iterable[tuple[ConvexPart, Array]]) -> CloudSeparation | None:
        """The smallest distance of some parts, each with its joint's pose; None without points."""
        found = [each for part, T in parts for each in self.distances(part, T, 0.0)[:1]]
        return min(found, key=lambda each: each.distance, default=None)

    def any_within(self, parts: Iterable[tuple[ConvexPart, Array]], margin: float) -> str | None:
        """The body of a part that is nearer than `margin` [m] to the cloud, or None.

        Args:
            parts: convex parts, each with the pose `(4, 4)` of the joint that carries it.
            margin: [m].
        """
        for part, T in parts:
            hull = self._hull(part)
            rows, p, _ = self._candidates(hull, T, margin)
            placed = coal_transform(T @ part.T_joint_part)
            for start in range(0, len(rows), _BLOCK):
                bounds = hull.bound(p[start : start + _BLOCK]) - self._inflation
                for at in np.flatnonzero(bounds < margin):
                    row = int(rows[start + at])
                    if self._separation(part, placed, row).distance < margin:
                        return part.body
        return None


def hull_part(name: str, joint: int, points: Array) -> ConvexPart:
    """The convex hull of points `(m, 3)` [m] in a joint's frame, as a part that the joint carries.

    Raises:
        InvalidInput: fewer than four points, or all in one plane.
    """
    points = check_array(f"points of {name}", points, (None, 3))
    corners = points[Hull(points).corners]
    listed = coal.StdVec_Vec3s()
    for corner in corners:
        listed.append(corner)
    geometry = coal.ConvexBase.convexHull(listed, False, "Qt")
    return ConvexPart(name, joint, geometry, np.eye(4), corners)
