"""How far the robot's bodies are from the scene and from each other, by coal, pair by pair."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass

import coal
import numpy as np
import pinocchio as pin

from sart_toolkit.errors import InvalidInput, unknown_name
from sart_toolkit.poses import Array, inverse
from sart_toolkit.robots.model import RobotModel
from sart_toolkit.robots.spec import Shape
from sart_toolkit.scene.spec import SceneSpec


@dataclass(frozen=True)
class PairDistance:
    """Distance [m] between two bodies, by name; negative where they overlap."""

    a: str
    b: str
    distance: float


@dataclass(frozen=True)
class ToolClearance:
    """A tool body's nearest body of the scene, and its `reach`: the distance [m] of its farthest
    point from the tool frame.
    """

    nearest: PairDistance
    reach: float


@dataclass(frozen=True)
class RobotPart:
    """One convex part of a link: its geometry and its pose in the joint that carries it."""

    link: str
    joint: int
    geometry: coal.CollisionGeometry
    T_joint_part: Array
    points: Array


class ClearanceModel:
    """Distances between the robot's convex parts, and between them and a scene's shapes.

    The *tool bodies* are what the last arm joint carries: gripper, camera, held objects, and the
    bodies of the scene that are in its grasp. The *arm bodies* are the others, those that no joint
    moves left out.
    """

    def __init__(self, model: RobotModel, scene: SceneSpec) -> None:
        """Read the collision geometry of the robot (its gripper as in `model`) and of the scene."""
        self.model = model
        self.scene = scene
        pinocchio_model = model.pinocchio_model
        self._data = pinocchio_model.createData()
        last = pinocchio_model.njoints - 1
        parts = [part for part in robot_parts(model) if part.joint > 0]
        self._tool = [part for part in parts if part.joint == last]
        self._arm = [part for part in parts if part.joint < last]
        # The last three joints of an arm share its wrist, whose links neighbour the tool.
        self._arm_apart = [part for part in self._arm if part.joint <= last - 3]
        self._shapes = [
            (body.name, _geometry(shape), shape)
            for body in scene.bodies
            for shape in body.shapes
            if shape.collides
        ]
        T_joint_tool = inverse(self._joint_poses(model.spec.home)[last]) @ model.fk(model.spec.home)
        p_tool = T_joint_tool[:3, 3]
        self._reach = [
            float(np.linalg.norm(part.points - p_tool, axis=1).max()) for part in self._tool
        ]

    def _joint_poses(self, q: Array) -> list[Array]:
        pin.forwardKinematics(self.model.pinocchio_model, self._data, self.model.check_q(q))
        return [np.array(T.homogeneous) for T in self._data.oMi]

    def _placed_scene(
        self, Ts_world_body: Mapping[str, Array], carried: Collection[str]
    ) -> list[tuple[str, coal.CollisionGeometry, coal.Transform3s]]:
        for name, _, _ in self._shapes:
            if name not in Ts_world_body:
                raise unknown_name("body", name, Ts_world_body)
        return [
            (name, geometry, coal_transform(Ts_world_body[name] @ shape.T_body_shape))
            for name, geometry, shape in self._shapes
            if name not in carried
        ]

    def tool_clearances(
        self, q: Array, Ts_world_body: Mapping[str, Array], carried: Collection[str] = ()
    ) -> list[ToolClearance]:
        """For each tool body its nearest body of the scene at `q (n,)`.

        Args:
            q: joint configuration [rad].
            Ts_world_body: poses `(4, 4)` of the scene's bodies.
            carried: names of those in the gripper's grasp.

        Raises:
            UnknownName: a body's pose is missing.
        """
        joints = self._joint_poses(q)
        scene = self._placed_scene(Ts_world_body, carried)
        bodies = [
            (part.link, part.geometry, joints[part.joint] @ part.T_joint_part, reach)
            for part, reach in zip(self._tool, self._reach, strict=True)
        ]
        p_tool = self.model.fk(q)[:3, 3]
        for name, geometry, shape in self._shapes:
            if name in carried:
                T = Ts_world_body[name]
                points = shape.corners() @ T[:3, :3].T + T[:3, 3]
                reach = float(np.linalg.norm(points - p_tool, axis=1).max())
                bodies.append((name, geometry, T @ shape.T_body_shape, reach))
        clearances = []
        for link, geometry, T, reach in bodies:
            placed = coal_transform(T)
            pairs = [
                PairDistance(link, name, convex_distance(geometry, placed, other, T_other))
                for name, other, T_other in scene
            ]
            nothing = PairDistance(link, "", np.inf)
            nearest = min(pairs, key=lambda pair: pair.distance, default=nothing)
            clearances.append(ToolClearance(nearest, reach))
        return clearances

    def arm_distance(
        self, q: Array, Ts_world_body: Mapping[str, Array], carried: Collection[str] = ()
    ) -> PairDistance:
        """The nearest pair at `q (n,)` among arm against scene and tool against arm.

        Bodies that are `carried` move with the tool and are left out.

        Raises:
            UnknownName: a body's pose is missing.
        """
        joints = self._joint_poses(q)
        scene = self._placed_scene(Ts_world_body, carried)
        placed = {
            id(part): coal_transform(joints[part.joint] @ part.T_joint_part)
            for part in (*self._arm, *self._tool)
        }
        best = PairDistance("", "", np.inf)
        for part in self._arm:
            for name, geometry, T in scene:
                distance = convex_distance(part.geometry, placed[id(part)], geometry, T)
                if distance < best.distance:
                    best = PairDistance(part.link, name, distance)
        for part in self._tool:
            for other in self._arm_apart:
                distance = convex_distance(
                    part.geometry, placed[id(part)], other.geometry, placed[id(other)]
                )
                if distance < best.distance:
                    best = PairDistance(part.link, other.link, distance)
        return best


def robot_parts(model: RobotModel) -> list[RobotPart]:
    """The convex parts of a robot's links and of what it holds, as its URDF has them.

    Raises:
        InvalidInput: a part is neither a mesh nor a box, sphere or cylinder.
    """
    pinocchio_model = model.pinocchio_model
    loaded = pin.buildGeomFromUrdf(
        pinocchio_model,
        str(model.urdf),
        pin.GeometryType.COLLISION,
        package_dirs=str(model.urdf.parent),
    )
    parts = []
    for item in loaded.geometryObjects:
        geometry = item.geometry
        if isinstance(geometry, coal.BVHModelBase):
            geometry.buildConvexHull(True, "Qt")
            geometry = geometry.convex
        frame = pinocchio_model.frames[item.parentFrame]
        T = np.array(item.placement.homogeneous)
        points = _points(geometry) @ T[:3, :3].T + T[:3, 3]
        parts.append(RobotPart(frame.name, int(item.parentJoint), geometry, T, points))
    return parts


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


def _geometry(shape: Shape) -> coal.CollisionGeometry:
    if shape.kind == "box":
        return coal.Box(*shape.size)
    if shape.kind == "sphere":
        return coal.Sphere(*shape.size)
    return coal.Cylinder(*shape.size)


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
