"""One collision model of robot and scene: convex parts on Pinocchio's joints, distances by coal."""

from __future__ import annotations

import functools
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass

import coal
import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from sart_toolkit.collision.linkage import Linkage, Sweep
from sart_toolkit.collision.obstacles import CloudObstacles
from sart_toolkit.collision.parts import (
    ConvexPart,
    coal_geometry,
    coal_transform,
    corners_of,
    robot_parts,
)
from sart_toolkit.errors import InvalidInput, unknown_name
from sart_toolkit.poses import Array, check_pose, frozen
from sart_toolkit.robots.model import RobotModel
from sart_toolkit.robots.spec import RobotSpec, check_gripper
from sart_toolkit.scenes.spec import SceneSpec

CLOUD = "cloud"
Index = NDArray[np.intp]
# Links of joints nearer to each other than this meet in the joints between them.
_JOINTS_APART = 2
# coal's own 1e-6 is relative to the distance, and lets normals be off by a milliradian.
_TOLERANCE = 1e-8
# No joint is ever so far [m] beyond its limits, by what is left of an error or of a spline.
_BEYOND = 0.05
_YZX, _ZXY = [1, 2, 0], [2, 0, 1]


@dataclass(frozen=True)
class PairDistance:
    """Distance [m] between two bodies, by name; negative where they overlap.

    `p_a`, `p_b (3,)` are the witness points in the world: the nearest, or where they overlap the
    deepest, point of each.
    """

    a: str
    b: str
    distance: float
    p_a: Array
    p_b: Array

    def __post_init__(self) -> None:
        object.__setattr__(self, "p_a", frozen(self.p_a))
        object.__setattr__(self, "p_b", frozen(self.p_b))

    @property
    def pair(self) -> tuple[str, str]:
        """The two names."""
        return self.a, self.b


class CollisionModel:
    """The convex parts of a robot and of a scene, to be put where their bodies are.

    Robot links are convex parts that enclose their collision shapes and what is drawn of them.

    Attributes:
        overlapping_at_home: pairs of the robot's links, not neighbours, whose parts overlap at its
            home; nothing is said about these.
    """

    def __init__(self, robot: RobotSpec, scene: SceneSpec) -> None:
        """Read the collision geometry of robot and scene.

        Raises:
            InvalidInput: a body has no shape that collides or is called as a frame of the robot, or
                a part of the robot is neither a mesh nor a box, sphere or cylinder.
        """
        self.robot = robot
        self.scene = scene
        self.kinematics = RobotModel(robot, scene.held)
        self._parts = robot_parts(self.kinematics)
        model = self.kinematics.pinocchio_model
        frames = {frame.name for frame in model.frames}
        for body in scene.bodies:
            if body.name in frames:
                raise InvalidInput(
                    f"body {body.name!r}: the robot has a frame of that name; rename the body"
                )
            if not any(shape.collides for shape in body.shapes):
                raise InvalidInput(
                    f"body {body.name!r}: no shape of it collides, so nothing can be proved about "
                    "it; let one collide, or draw it as part of another body"
                )
        self._shapes = [
            (body.name, T_body_shape, coal_geometry(part), corners_of(part, T_body_shape))
            for body in scene.bodies
            for shape in body.shapes
            if shape.collides
            for part in shape.convex_parts()
            for T_body_shape in [shape.T_body_shape]
        ]
        home = _link_poses(self.kinematics)
        self.T_joint_tool = home[robot.tool_frame]
        self._linkage = Linkage(self.kinematics, self._parts)
        parts = self._linkage.at(0.0).parts
        self.overlapping_at_home = self._overlapping_at_home(parts)
        apart = set(self.overlapping_at_home)
        self._self_pairs = [
            (i, j) for i, j in _far_apart(parts) if (parts[i].body, parts[j].body) not in apart
        ]

    def _swept(self, gripper: float | tuple[float, float]) -> Sweep:
        """The robot's parts with its gripper at an opening, or what encloses them over a range."""
        if isinstance(gripper, tuple):
            return self._linkage.over(*gripper)
        return self._linkage.at(round(check_gripper(float(gripper)), 4))

    def placed(
        self,
        Ts_world_body: Mapping[str, Array],
        gripper: float | tuple[float, float],
        Ts_tool_grasped: Mapping[str, Array] | None = None,
        allowed: Collection[tuple[str, str]] = (),
        slip_tolerance: float = 0.0,
        grasped_parts: Sequence[ConvexPart] = (),
        cloud: CloudObstacles | None = None,
        gripper_play: float = 0.0,
    ) -> PlacedModel:
        """The model with the scene's bodies, the gripper and what it grasps put in their places.

        Args:
            Ts_world_body: poses `(4, 4)` of the scene's bodies; a grasped one's is ignored.
            gripper: opening in [0, 1]; or the least and the greatest of a range, which may go
                beyond these ends: distances are then no larger than at any opening in it.
            Ts_tool_grasped: poses `(4, 4)` in the tool frame of the bodies in the grasp.
            allowed: pairs of names that may touch, about which nothing is said.
            slip_tolerance: how far [m] a grasped body may move in the grasp; all distances from it
                are given less by that.
            grasped_parts: parts on the last joint that are in the grasp and no bodies of the scene.
            cloud: points that are obstacles too, by the name `CLOUD`.
            gripper_play: by how much [m] what the gripper moves may stand out of where its opening
                has it; all distances from it are given less by that.

        Raises:
            UnknownName: a body's pose is missing, or a name is of no body or link.
            InvalidInput: gripper out of range, not a pose, or a negative tolerance or play.
        """
        grasped = dict(Ts_tool_grasped or {})
        for what, value in (("slip_tolerance", slip_tolerance), ("gripper_play", gripper_play)):
            if not (np.isfinite(value) and value >= 0):
                raise InvalidInput(f"{what}: expected a finite number >= 0 m, got {value}")
        names = [body.name for body in self.scene.bodies]
        for name in grasped:
            if name not in names:
                raise unknown_name("grasped body", name, names)
        known = {part.body for part in self._parts} | set(names)
        for name in {name for pair in allowed for name in pair}:
            if name not in known:
                raise unknown_name("body or link", name, sorted(known))
        last = len(self.robot.arm_joints)
        sweep = self._swept(gripper)
        parts = list(sweep.parts)
        n_robot = len(parts)
        for name, T_body_shape, geometry, corners in self._shapes:
            if name in grasped:
                T, joint = self.T_joint_tool @ check_pose(name, grasped[name]), last
            elif name in Ts_world_body:
                T, joint = check_pose(name, Ts_world_body[name]), 0
            else:
                raise unknown_name("body", name, Ts_world_body)
            points = corners @ T[:3, :3].T + T[:3, 3]
            parts.append(ConvexPart(name, joint, geometry, T @ T_body_shape, points))
        parts += grasped_parts
        of_part: dict[int, list[int]] = {}
        for i, origin in enumerate(sweep.origins):
            of_part.setdefault(origin, []).append(i)
        pairs = [(i, j) for a, b in self._self_pairs for i in of_part[a] for j in of_part[b]]
        standing = [i for i in range(n_robot, len(parts)) if parts[i].joint == 0]
        moving = [i for i in range(len(parts)) if parts[i].joint > 0]
        pairs += [(i, j) for i in moving for j in standing]
        in_grasp = [i for i in range(n_robot, len(parts)) if parts[i].joint > 0]
        pairs += [
            (i, j)
            for i in in_grasp
            for j in range(n_robot)
            if parts[j].joint <= last - _JOINTS_APART
        ]
        skipped = {frozenset(pair) for pair in allowed}
        pairs = [
            (i, j) for i, j in pairs if frozenset((parts[i].body, parts[j].body)) not in skipped
        ]
        if cloud is not None:
            pairs += [(i, len(parts)) for i in moving]
        excess = dict.fromkeys(in_grasp, slip_tolerance)
        for i, (origin, out) in enumerate(zip(sweep.origins, sweep.excess, strict=True)):
            excess[i] = out + (gripper_play if self._linkage.moves(origin) else 0.0)
        # Of the second of a pair only the robot's own can stand out; what stands has no excess.
        slip = [excess[i] + excess.get(j, 0.0) for i, j in pairs]
        return PlacedModel(self.kinematics, parts, pairs, self.T_joint_tool, slip, cloud)

    def _overlapping_at_home(self, parts: Sequence[ConvexPart]) -> list[tuple[str, str]]:
        """Links that aren't neighbours and overlap at home, the one that more joints move first."""
        pairs = _far_apart(parts)
        model = PlacedModel(self.kinematics, parts, pairs, self.T_joint_tool)
        distances = model.distances(self.robot.home)
        return sorted({
            (parts[i].body, parts[j].body)
            for (i, j), distance in zip(pairs, distances, strict=True)
            if distance <= 0
        })  # fmt: skip


def _far_apart(parts: Sequence[ConvexPart]) -> list[tuple[int, int]]:
    """Pairs of a robot's parts that aren't neighbours; the one that more joints move first."""
    return [
        (i, j)
        for i, a in enumerate(parts)
        for j, b in enumerate(parts)
        if a.joint - b.joint >= _JOINTS_APART
    ]


class PlacedModel:
    """Distances between robot and scene with every body in its place, at any joint configuration.

    The *tool bodies* are what the last arm joint carries: gripper, camera, held objects, and what
    is in the grasp. Where the scene is known as a cloud, it counts as one body that stands.

    Attributes:
        kinematics: the robot's kinematics.
        parts: all convex parts.
        pairs: `(p, 2)` indices of parts; the first of a pair is moved by more joints. The index
            behind the last part stands for the cloud, whose pairs come last.
        slip: `(p,)` [m] by how much each pair may be nearer than the parts as they are placed; it
            is taken off all distances.
        joints: `(parts + 1,)` the parts' joints, and 0 for the cloud.
        cloud: points that are obstacles too.
        convex_pairs: how many pairs, the first ones, are of two convex parts.
    """

    def __init__(
        self,
        kinematics: RobotModel,
        parts: Sequence[ConvexPart],
        pairs: Sequence[tuple[int, int]],
        T_joint_tool: Array,
        slip: Sequence[float] | None = None,
        cloud: CloudObstacles | None = None,
    ) -> None:
        self.kinematics = kinematics
        self.parts = tuple(parts)
        self.pairs: Index = np.array(pairs, dtype=np.intp).reshape(-1, 2)
        self.T_joint_tool = T_joint_tool
        self.slip = np.zeros(len(pairs)) if slip is None else np.array(slip, dtype=np.float64)
        self._slip = self.slip.tolist()
        self.joints: Index = np.array([*(part.joint for part in parts), 0], dtype=np.intp)
        self.cloud = cloud
        self._model = kinematics.pinocchio_model
        self._data = self._model.createData()
        self._geometry = pin.GeometryModel()
        for i, part in enumerate(parts):
            self._geometry.addGeometryObject(
                pin.GeometryObject(str(i), part.joint, pin.SE3(part.T_joint_part), part.geometry)
            )
        self.convex_pairs = sum(j < len(parts) for _, j in pairs)
        for i, j in pairs[: self.convex_pairs]:
            self._geometry.addCollisionPair(pin.CollisionPair(i, j))
        self._placements = self._geometry.createData()
        for request in self._placements.distanceRequests:
            request.gjk_tolerance = _TOLERANCE

    def names(self, pair: int) -> tuple[str, str]:
        """The names of the two bodies of a pair, by its index."""
        i, j = self.pairs[pair]
        return self.parts[i].body, self.parts[j].body if j < len(self.parts) else CLOUD

    def joint_poses(self, q: Array) -> Array:
        """The poses `(n + 1, 4, 4)` of the world and of the arm's joints at `q (n,)`."""
        pin.forwardKinematics(self._model, self._data, q)
        return np.array([T.homogeneous for T in self._data.oMi])

    def joint_twists(self, poses: Array) -> tuple[Array, Array]:
        """How each arm joint moves what it carries, by its pose `(..., n, 4, 4)` in the world.

        Returns:
            For a unit of each joint: the angular velocity, and the velocity of the point at the
            world's origin, `(..., n, 3)` each. A joint turns about its frame's z, which moves the
            origin by p x z, or slides along it.
        """
        z = poses[..., :3, 2]
        slides = self.kinematics.slides[:, None]
        return np.where(slides, 0.0, z), np.where(slides, z, cross(poses[..., :3, 3], z))

    def _place(self, q: Array) -> None:
        pin.updateGeometryPlacements(self._model, self._data, self._geometry, self._placements, q)

    def pair_distances(self, q: Array, pairs: Sequence[int]) -> list[float]:
        """Signed distances [m] of some pairs, by index, at `q (n,)`."""
        self._place(q)
        geometry, data = self._geometry, self._placements
        slip, convex = self._slip, self.convex_pairs
        return [
            (
                pin.computeDistance(geometry, data, i).min_distance
                if i < convex
                else self._cloud_distance(i)
            )
            - slip[i]
            for i in pairs
        ]

    def distances(self, q: Array) -> Array:
        """Signed distances `(p,)` [m] of all pairs at `q (n,)`."""
        self._place(q)
        pin.computeDistances(self._geometry, self._placements)
        found = [result.min_distance for result in self._placements.distanceResults]
        found += [self._cloud_distance(i) for i in range(self.convex_pairs, len(self.pairs))]
        return np.array(found) - self.slip

    def _cloud_distance(self, pair: int) -> float:
        """A part's signed distance [m] from the cloud, where all has been placed."""
        assert self.cloud is not None
        part = self.parts[self.pairs[pair, 0]]
        return self.cloud.distance(part, self._data.oMi[part.joint].homogeneous)

    def witness(self, q: Array, pair: int) -> PairDistance:
        """A pair's distance and witness points, by its index, at `q (n,)`."""
        return self.witnesses(q, pair, 0.0)[0]

    def witnesses(self, q: Array, pair: int, within: float) -> list[PairDistance]:
        """A pair's distance and witness points; of the cloud, those of all points that are near.

        That is up to the pair's smallest distance plus `within` [m], nearest first.
        """
        self._place(q)
        names, slip = self.names(pair), self._slip[pair]
        if pair < self.convex_pairs:
            result = pin.computeDistance(self._geometry, self._placements, pair)
            p_a, p_b = result.getNearestPoint1(), result.getNearestPoint2()
            distance = float(result.min_distance) - slip
            return [PairDistance(*names, distance, np.ravel(p_a), np.ravel(p_b))]
        assert self.cloud is not None
        part = self.parts[self.pairs[pair, 0]]
        T = self._data.oMi[part.joint].homogeneous
        return [
            PairDistance(*names, found.distance - slip, found.p_part, found.p_ball)
            for found in self.cloud.separations(part, T, within)
        ]

    def nearest(self, q: Array) -> PairDistance | None:
        """The nearest pair of the whole robot at `q (n,)`; `None` if there is nothing to hit.

        Raises:
            InvalidInput: `q` has the wrong shape or isn't finite.
        """
        q = self.kinematics.check_q(q)
        if not len(self.pairs):
            return None
        return self.witness(q, int(np.argmin(self.distances(q))))

    def gradient(self, q: Array, pair: int) -> Array:
        """How a pair's distance changes with the joints at `q (n,)`: `(n,)` [m/rad]."""
        found = self.witness(q, pair)
        i, j = self.pairs[pair]
        normal = found.p_a - found.p_b
        length = float(np.linalg.norm(normal))
        if length < 1e-9:
            return np.zeros(len(q))
        if found.distance + self.slip[pair] < 0:
            length = -length
        turns, drifts = self.joint_twists(self.joint_poses(q)[1:])
        moved = (cross(turns, found.p_a) + drifts) @ (normal / length)
        index = np.arange(len(q))
        between = (index >= self.joints[j]) & (index < self.joints[i])
        return np.where(between, moved, 0.0)

    def too_close(self, q: Array, margin: float) -> tuple[str, str] | None:
        """The nearest pair at `q (n,)` if it is nearer than the margin [m].

        Raises:
            InvalidInput: `q` has the wrong shape or isn't finite.
        """
        near = self.near_pairs(self.kinematics.check_q(q), margin)
        if not near:
            return None
        distances = self.pair_distances(q, near)
        least = int(np.argmin(distances))
        return self.names(near[least]) if distances[least] < margin else None

    def near_pairs(self, q: Array, within: float) -> list[int]:
        """All pairs, by index, that are nearer than `within` [m] at `q (n,)`, and perhaps others.

        Those that rough bounds show to be farther away are left out.
        """
        placed = self.bounds.placed(self.joint_poses(q)[None])
        every = np.arange(len(self.pairs))
        rough = self.bounds.rough_distances(placed, np.zeros_like(every), every)
        return [int(k) for k in np.flatnonzero(rough <= within)]

    def tool_pairs(self) -> list[int]:
        """The pairs, by index, of a tool body and what stands: the scene, and the robot's base."""
        last = len(self.kinematics.spec.arm_joints)
        return [
            k
            for k, (i, j) in enumerate(self.pairs)
            if self.joints[i] == last and self.joints[j] == 0
        ]

    def tool_clearances(self, q: Array) -> list[PairDistance]:
        """For each tool body the nearest that stands at `q (n,)`, the nearest pair first.

        What stands is the scene's bodies and the robot's base.

        Raises:
            InvalidInput: `q` has the wrong shape or isn't finite.
        """
        q = self.kinematics.check_q(q)
        best: dict[str, tuple[float, int]] = {}
        pairs = self.tool_pairs()
        for k, distance in zip(pairs, self.pair_distances(q, pairs), strict=True):
            body = self.parts[self.pairs[k][0]].body
            if body not in best or distance < best[body][0]:
                best[body] = distance, k
        return sorted((self.witness(q, k) for _, k in best.values()), key=lambda d: d.distance)

    def sphere_clearance(self, p: Array, radius: float) -> PairDistance | None:
        """The nearest body of the scene to a bare sphere about `p (3,)` [m] in the world.

        What the robot is made of is left out of account: a sphere that is clear says nothing of
        the tool in it.
        """
        sphere, at = coal.Sphere(radius), coal.Transform3s(np.eye(3), np.asarray(p, float))
        best: PairDistance | None = None
        for part in self.parts:
            if part.joint == 0 and part.body not in self._robot_bodies:
                result = coal.DistanceResult()
                distance = coal.distance(
                    sphere, at, part.geometry, coal_transform(part.T_joint_part),
                    coal.DistanceRequest(), result,
                )  # fmt: skip
                if best is None or distance < best.distance:
                    points = (result.getNearestPoint1(), result.getNearestPoint2())
                    best = PairDistance(
                        "sphere", part.body, float(distance), *(np.ravel(x) for x in points)
                    )
        return best

    @functools.cached_property
    def _robot_bodies(self) -> frozenset[str]:
        return frozenset(frame.name for frame in self._model.frames)

    @functools.cached_property
    def bounds(self) -> Bounds:
        """What bounds the pairs' distances and motions from geometry alone."""
        return Bounds(self)


# Of some joint poses and all parts: see `Bounds.placed`.
Enclosures = tuple[Array, Array, Array, Array]


class Bounds:
    """What bounds distances and motions of a model's pairs from geometry alone.

    The first part of each pair is enclosed in a sphere, the second in a box; a cloud is asked for
    its point that is nearest to the sphere's centre.

    Attributes:
        first, second: `(p,)` the parts of each pair.
        joint_a, joint_b: `(p,)` the joints that carry them.
        radii: `(p,)` of the spheres [m], the pairs' slip among them.
        half: `(p, 3)` half edges of the boxes [m].
        reach: `(p, n)` no point of a pair's first part is ever farther [m] from a joint between it
            and the second than this, or 1 where the joint slides; 0 for other joints. So a joint
            moves no point by more than this times its own motion.
    """

    def __init__(self, model: PlacedModel) -> None:
        parts, n = model.parts, len(model.kinematics.spec.arm_joints)
        self._cloud, self._convex_pairs = model.cloud, model.convex_pairs
        self.first: Index = model.pairs[:, 0]
        # What no box encloses has any box here; it is ignored.
        self.second: Index = np.where(model.pairs[:, 1] < len(parts), model.pairs[:, 1], 0)
        self._joints = model.joints[:-1]
        self._centres = np.array([part.sphere[0] for part in parts]).reshape(-1, 3, 1)
        boxes = [part.box for part in parts]
        # Rows are the boxes' axes, so that their product with a vector gives its coordinates.
        self._axes = np.array([R.T for R, _, _ in boxes]).reshape(-1, 3, 3)
        self._middles = np.array([p for _, p, _ in boxes]).reshape(-1, 3, 1)
        self.joint_a: Index = model.joints[self.first]
        self.joint_b: Index = model.joints[model.pairs[:, 1]]
        self.radii = np.array([part.sphere[1] for part in parts])[self.first] + model.slip
        self.half = np.array([half for _, _, half in boxes]).reshape(-1, 3)[self.second]
        # A chain is the joints from behind b up to a.
        index = np.arange(n)
        chain = (index >= self.joint_b[:, None]) & (index < self.joint_a[:, None])
        self.reach = np.where(chain, _axis_distances(model)[self.first], 0.0)

    def placed(self, poses: Array) -> Enclosures:
        """Spheres and boxes of all parts at joint poses `(k, n + 1, 4, 4)`, in the world.

        Returns:
            The spheres' centres `(k, parts, 3)`, the boxes' axes `(k, parts, 3, 3)`, a row each,
            their middles `(k, parts, 3)`, and how far [m] the spheres' centres are from the cloud
            `(k, parts)`, or without one `(k, 0)`.
        """
        T = poses[:, self._joints]
        R, p = T[..., :3, :3], T[..., :3, 3]
        centres = (R @ self._centres)[..., 0] + p
        middles = (R @ self._middles)[..., 0] + p
        axes = self._axes @ np.swapaxes(R, -1, -2)
        if self._cloud is None:
            return centres, axes, middles, np.empty((len(poses), 0))
        return centres, axes, middles, self._cloud.clearances(centres)

    def rough_distances(self, placed: Enclosures, at: Index, pair: Index) -> Array:
        """Distances `(..., k)` [m] of pairs from below, without coal.

        Args:
            placed: spheres and boxes at some joint poses.
            at: `(..., k)` which of these.
            pair: `(k,)` pairs by index.
        """
        centres, axes, middles, beside = placed
        # Rows of arrays laid flat are taken several times as fast as by several indices.
        of = at * centres.shape[1]
        first, second = of + self.first.take(pair), of + self.second.take(pair)
        apart = centres.reshape(-1, 3).take(first, 0) - middles.reshape(-1, 3).take(second, 0)
        turned = axes.reshape(-1, 9).take(second, 0).reshape(*second.shape, 3, 3)
        local = np.einsum("...ij,...j->...i", turned, apart)
        out = norms(np.maximum(np.abs(local) - self.half.take(pair, 0), 0.0))
        if self._cloud is not None:
            out = np.where(pair < self._convex_pairs, out, beside.take(first))
        return np.asarray(out - self.radii.take(pair))


def cross(a: Array, b: Array) -> Array:
    """The cross products `(..., 3)`; NumPy's own takes five times as long."""
    return np.asarray(a[..., _YZX] * b[..., _ZXY] - a[..., _ZXY] * b[..., _YZX])


def norms(vectors: Array) -> Array:
    """The lengths `(...)` of vectors `(..., 3)`; NumPy's own takes three times as long."""
    x, y, z = vectors[..., 0], vectors[..., 1], vectors[..., 2]
    return np.asarray(np.sqrt(x * x + y * y + z * z))


def _link_poses(model: RobotModel) -> dict[str, Array]:
    """The pose `(4, 4)` of each frame on the joint that carries it."""
    return {
        frame.name: np.array(frame.placement.homogeneous) for frame in model.pinocchio_model.frames
    }


def _axis_distances(model: PlacedModel) -> Array:
    """For each part and joint `(parts, n)`: how far [m] a point of the part can be from the joint.

    That is in any configuration, for the joints that carry the part; 1 if they slide; 0 for others.
    """
    kinematics = model.kinematics
    joints = kinematics.pinocchio_model.jointPlacements
    # How far a joint that slides may take what it carries, with some room beyond its limits.
    farthest = np.maximum(np.abs(kinematics.lower), np.abs(kinematics.upper)) + _BEYOND
    slid = np.where(kinematics.slides, farthest, 0.0)
    distances = np.zeros((len(model.parts), len(joints) - 1))
    links = [float(np.linalg.norm(T.translation)) for T in joints]
    for row, part in zip(distances, model.parts, strict=True):
        reach = part.reach
        for j in range(part.joint, 0, -1):
            row[j - 1] = 1.0 if kinematics.slides[j - 1] else reach
            reach += links[j] + slid[j - 1]
    return distances


def gap_text(distance: float, margin: float) -> str:
    """How two bodies at a distance [m] that is less than the margin [m] stand, for a message."""
    if distance < 0:
        return f"they overlap by {-distance * 1e3:.1f} mm"
    return f"{distance * 1e3:.1f} mm apart, {margin * 1e3:.1f} mm are asked for"
