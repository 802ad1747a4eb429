"""Convex parts that robots and bodies are made of, and the distance between two of them."""

from __future__ import annotations

import functools
import xml.etree.ElementTree as ET
from collections import Counter
from dataclasses import dataclass

import coal
import numpy as np
import pinocchio as pin

from sart_toolkit.errors import BrokenFile, InvalidInput
from sart_toolkit.poses import Array
from sart_toolkit.robots.model import RobotModel
from sart_toolkit.robots.spec import ConvexShape, Shape


@dataclass(frozen=True, eq=False)
class ConvexPart:
    """A convex part of a body: its geometry and its pose `T_joint_part (4, 4)` on joint `joint`.

    `joint` counts the arm's joints from 1; what no joint moves is on joint 0, the world. The hull
    of `points (n, 3)`, in the joint's frame, encloses the part.
    """

    body: str
    joint: int
    geometry: coal.CollisionGeometry
    T_joint_part: Array
    points: Array

    @functools.cached_property
    def sphere(self) -> tuple[Array, float]:
        """Centre `(3,)` and radius [m] of a sphere about the part, in the joint's frame."""
        centre = (self.points.min(0) + self.points.max(0)) / 2
        return centre, float(np.linalg.norm(self.points - centre, axis=1).max())

    @functools.cached_property
    def box(self) -> tuple[Array, Array, Array]:
        """Axes `(3, 3)`, centre `(3,)` and half edges `(3,)` of a box about it, joint's frame."""
        R = self.T_joint_part[:3, :3]
        local = self.points @ R
        low, high = local.min(0), local.max(0)
        return R, R @ (low + high) / 2, (high - low) / 2

    @functools.cached_property
    def reach(self) -> float:
        """How far [m] any point of the part is from the joint's origin."""
        return float(np.linalg.norm(self.points, axis=1).max())


def robot_parts(model: RobotModel) -> list[ConvexPart]:
    """The convex parts of a robot's links and of what it holds, as its URDF has them.

    Raises:
        InvalidInput: a part is neither a mesh nor a box, sphere or cylinder.
        BrokenFile: the URDF's shapes can't be read, or not all of them were.
    """
    pinocchio_model = model.pinocchio_model
    try:
        loaded = pin.buildGeomFromUrdf(
            pinocchio_model,
            str(model.urdf),
            pin.GeometryType.COLLISION,
            package_dirs=str(model.urdf.parent),
        )
    except (ValueError, RuntimeError) as error:
        raise BrokenFile(
            f"{model.spec.name}: Pinocchio can't read its collision shapes ({error}); check the "
            "source URDFs"
        ) from error
    _check_count(model, loaded)
    parts = []
    for item in loaded.geometryObjects:
        geometry = item.geometry
        if isinstance(geometry, coal.BVHModelBase):
            geometry.buildConvexHull(True, "Qt")
            geometry = geometry.convex
        frame = pinocchio_model.frames[item.parentFrame]
        T = np.array(item.placement.homogeneous)
        points = _points(geometry) @ T[:3, :3].T + T[:3, 3]
        parts.append(ConvexPart(frame.name, int(item.parentJoint), geometry, T, points))
    return parts


def _check_count(model: RobotModel, loaded: pin.GeometryModel) -> None:
    """Return if each link has as many shapes as its URDF says; readers drop what they can't read.

    Raises:
        BrokenFile: a link has more or fewer.
    """
    frames = model.pinocchio_model.frames
    found = Counter(frames[item.parentFrame].name for item in loaded.geometryObjects)
    for link in ET.parse(model.urdf).getroot().findall("link"):
        name = link.get("name", "")
        expected = len(link.findall("collision"))
        if found[name] != expected:
            raise BrokenFile(
                f"{model.spec.name}: link {name!r} has {expected} collision shapes, but "
                f"{found[name]} were read; check its <collision> elements"
            )


def _points(geometry: coal.CollisionGeometry) -> Array:
    """Points `(n, 3)` whose convex hull encloses a convex geometry."""
    if isinstance(geometry, coal.ConvexBase):
        return np.array(geometry.points()).reshape(-1, 3)
    return primitive(geometry).corners()


def primitive(geometry: coal.CollisionGeometry) -> Shape:
    """A box, sphere or cylinder of a URDF as a shape at its body's origin.

    Raises:
        InvalidInput: it is none of these.
    """
    if isinstance(geometry, coal.Box):
        x, y, z = (2 * float(half) for half in geometry.halfSide)
        return Shape("box", (x, y, z))
    if isinstance(geometry, coal.Sphere):
        return Shape("sphere", (float(geometry.radius),))
    if isinstance(geometry, coal.Cylinder):
        return Shape("cylinder", (float(geometry.radius), 2 * float(geometry.halfLength)))
    raise InvalidInput(
        f"geometry {type(geometry).__name__} is neither a mesh nor a box, sphere or cylinder; use "
        "these in the URDF"
    )


def coal_geometry(shape: ConvexShape) -> coal.CollisionGeometry:
    """A primitive, or the hull of corners, as coal takes it, in its own frame."""
    if not isinstance(shape, Shape):
        listed = coal.StdVec_Vec3s()
        for corner in shape:
            listed.append(corner)
        return coal.ConvexBase.convexHull(listed, False, "Qt")
    if shape.kind == "box":
        return coal.Box(*shape.size)
    if shape.kind == "sphere":
        return coal.Sphere(*shape.size)
    return coal.Cylinder(*shape.size)


def corners_of(shape: ConvexShape, T_body_shape: Array) -> Array:
    """Points `(n, 3)` in the body frame whose hull encloses a convex shape in its place."""
    points = shape.corners() if isinstance(shape, Shape) else shape
    return points @ T_body_shape[:3, :3].T + T_body_shape[:3, 3]


def coal_transform(T: Array) -> coal.Transform3s:
    """A pose `(4, 4)` as coal takes it."""
    return coal.Transform3s(T[:3, :3], T[:3, 3])


def convex_distance(
    a: coal.CollisionGeometry,
    T_a: coal.Transform3s,
    b: coal.CollisionGeometry,
    T_b: coal.Transform3s,
) -> float:
    """The distance [m] between two convex geometries; negative where they overlap."""
    # A result that is not new keeps the smallest distance it has seen.
    result = coal.DistanceResult()
    return float(coal.distance(a, T_a, b, T_b, coal.DistanceRequest(), result))
