"""PyBullet's closest points between robot and scene: a check of distances that coal has no part in.

What proves that a motion stays clear takes distances from coal and kinematics from Pinocchio. Here
both come from PyBullet, so that an error in either shows. Nothing is simulated.

As a simulation loads them, PyBullet's shapes differ from what they stand for by up to 2 mm a pair:
hulls of meshes are 1 mm larger all around, cylinders are prisms of 32 sides, boxes have rounded
edges. Here all collision margins are 0, cylinders are round, and lengths are scaled (see `_SCALE`).
What is left, measured against exact distances:

- boxes, spheres and cylinders: less than 0.001 mm;
- meshes: 0 to 0.06 mm too far, never too near by more than 0.005 mm: Bullet moves the corners of a
  hull inwards, to a grid of 1/10216 of its extent. So what overlaps by more than that is found.

A mesh of a standing body is no hull here but all of its triangles, as they are in its file, so that
convex parts which leave some of it out show as well. It is hollow: what is wholly inside is clear.
In the grasp its convex parts stand for it.
"""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

# PyBullet as imported there: without the greetings that it prints.
from sart_toolkit.backends.pybullet import p
from sart_toolkit.errors import unknown_name
from sart_toolkit.poses import Array, check_array, check_pose, inverse, rpy_pose
from sart_toolkit.robots.spec import ConvexShape, MeshShape, RobotSpec, Shape, check_gripper
from sart_toolkit.robots.urdf import composed_urdf
from sart_toolkit.scenes.spec import SceneSpec

# Configurations whose bounds are computed at once: as many as the processor's cache holds.
_CHUNK = 32
# PyBullet's lengths per metre. Its search takes a tetrahedron of some mm³ for a flat one and then
# ends early. Where lengths are metres that leaves cylinders and fine hulls up to 0.14 mm too far.
_SCALE = 100.0
# Slices that a part as long as it is wide is cut into, rounded.
_SLICES = 1.5
_ROUNDING = 1e-6


class Nearest(NamedTuple):
    """Two bodies by name and their distance [m], negative where they overlap.

    `a` is a link of the robot or a grasped body. Where nothing is within reach of what was asked
    for, the names are empty and the distance is infinite.
    """

    a: str
    b: str
    distance: float


_NOTHING = Nearest("", "", np.inf)


@dataclass(frozen=True)
class _Part:
    """One convex part: a link's, or a shape of a body of the scene; or the triangles of a mesh.

    Attributes:
        name: of the link or body.
        index: PyBullet's number.
        T_owner_part: its pose `(4, 4)` in the link or body.
        spheres: `(n, 4)` centre and radius [m], in the part's frame, that together enclose it;
            none of triangles, which only stand.
        half: half edges `(3,)` [m] of a box around it, at its origin; grown by `radius` [m].
    """

    name: str
    index: int
    T_owner_part: Array
    spheres: Array
    half: Array
    radius: float


@dataclass(frozen=True)
class _Carrier:
    """What moves a part: PyBullet's link, and the part's position and quaternion in it."""

    link: int
    T_link_part: tuple[Sequence[float], Sequence[float]]


@dataclass(frozen=True)
class _Bounds:
    """All pairs of parts that may be considered, and what bounds their distances from below.

    Attributes:
        pairs: the two parts of each pair; first moving parts with standing ones, then moving ones
            among themselves.
        ignored: the indices of pairs that may touch.
        spheres: of each rank, from 0 on, the centres `(4, n)` in the frame of the arm's link.
        radii: `(n,)` of all of them.
        starts: where each moving part's spheres begin.
        W_shape_world: `(3 s, 4)`, the standing parts' world-to-shape transforms, stacked.
        half, shape_radii: of the standing parts, `(s, 3, 1)` and `(s, 1)`.
        own_a, own_b: indices of spheres to compare among themselves.
        own_starts: where each own pair's begin.
    """

    pairs: list[tuple[_Part, _Part]]
    ignored: NDArray[np.intp]
    spheres: list[Array]
    radii: Array
    starts: NDArray[np.intp]
    W_shape_world: Array
    half: Array
    shape_radii: Array
    own_a: NDArray[np.intp]
    own_b: NDArray[np.intp]
    own_starts: NDArray[np.intp]

    def __call__(self, Ts_world_link: list[Array]) -> Array:
        """Lower bounds `(m, pairs)` [m] of the distances, negative where they may overlap.

        Args:
            Ts_world_link: of each rank, poses `(m, 4, 4)` of the arm's link.
        """
        m, n = len(Ts_world_link[0]), len(self.radii)
        centres = np.empty((m, 4, n))
        at = 0
        for T, spheres in zip(Ts_world_link, self.spheres, strict=True):
            centres[:, :, at : at + spheres.shape[1]] = T @ spheres
            at += spheres.shape[1]
        s = len(self.half)
        local = (self.W_shape_world @ centres).reshape(m, s, 3, n)
        np.abs(local, out=local)
        local -= self.half
        np.maximum(local, 0.0, out=local)
        np.square(local, out=local)
        outside = np.sqrt(local.sum(2))
        outside -= self.radii
        outside -= self.shape_radii
        scene = np.minimum.reduceat(outside, self.starts, axis=2)
        apart = centres[:, :3, self.own_a] - centres[:, :3, self.own_b]
        own = np.sqrt(np.square(apart).sum(1))
        own -= self.radii[self.own_a] + self.radii[self.own_b]
        own = np.minimum.reduceat(own, self.own_starts, axis=1)
        bounds = np.concatenate([scene.transpose(0, 2, 1).reshape(m, -1), own], axis=1)
        bounds[:, self.ignored] = np.inf
        return bounds


class ClosestPoints:
    """PyBullet's closest points between a robot and a scene at joint configurations.

    Pairs that are considered: every link that an arm joint moves, what is fixed to it, and every
    grasped body, each with every body that is not grasped; links among themselves, and grasped
    bodies with links, where at least `joints_apart` arm joints are between them. Shapes that don't
    collide are left out.
    """

    def __init__(self, robot: RobotSpec, scene: SceneSpec, joints_apart: int = 3) -> None:
        """Load robot and scene, the gripper open, the bodies where the scene has them.

        Args:
            robot: its base stands at the world's origin.
            scene: bodies and what the robot holds.
            joints_apart: 3 leaves out the links of one wrist, which are neighbours.
        """
        self.robot = robot
        self.scene = scene
        self.joints_apart = joints_apart
        self._client: int | None = p.connect(p.DIRECT)
        urdf = composed_urdf(robot, scene.held)
        self._load_joints(urdf)
        # Every part is a body of its own: PyBullet sets no margin of a link's shape, nor of a
        # compound's.
        self._parts = [self._load_part(*element) for element in collision_geometry(urdf)]
        # What stands for a body in the grasp, and for one that stands.
        self._in_grasp: list[_Part] = []
        self._standing: list[_Part] = []
        for body in scene.bodies:
            for shape in filter(lambda shape: shape.collides, body.shapes):
                parts = [
                    self._load_part(body.name, part, shape.T_body_shape)
                    for part in shape.convex_parts()
                ]
                self._in_grasp += parts
                if isinstance(shape, MeshShape):
                    parts = [self._load_surface(body.name, shape)]
                self._standing += parts
        self._shapes = self._standing
        self._carriers: dict[int, _Carrier] = {}
        self._placed: set[int] = set()
        self.place(scene.initial_state(robot.home, 0.0).Ts_world_body, 0.0)

    # --- loading --------------------------------------------------------------------------------

    def _load_joints(self, urdf: Path) -> None:
        """Load the robot for its kinematics."""
        c = self._client
        self._robot = p.loadURDF(str(urdf), useFixedBase=True, physicsClientId=c)
        joints = {}
        self._links = {p.getBodyInfo(self._robot, physicsClientId=c)[0].decode(): -1}
        parents = {-1: -1}
        for i in range(p.getNumJoints(self._robot, physicsClientId=c)):
            info = p.getJointInfo(self._robot, i, physicsClientId=c)
            joints[info[1].decode()] = i
            self._links[info[12].decode()] = i
            parents[i] = info[16]
        self._arm = [joints[name] for name in self.robot.arm_joints]
        self._gripper = {n: joints[n] for n in self.robot.gripper.joint_positions(0.0)}
        # How many arm joints carry each link.
        self._ranks = {-1: 0}
        for i in sorted(set(parents) - {-1}):
            self._ranks[i] = self._ranks[parents[i]] + (i in self._arm)
        # How PyBullet moves each arm link in the one before, to bound many configurations at once:
        # by A + B q + C sin q + D cos q, whether the joint turns or slides.
        angles = np.array([0.0, 0.5, np.pi / 2, np.pi])
        rows = np.stack([np.ones(4), angles, np.sin(angles), np.cos(angles)], axis=1)
        motion = []
        for j, link in enumerate(self._arm):
            seen = []
            for q in angles[:, None] * np.eye(len(self._arm))[j]:
                self._set_arm(q)
                seen.append(inverse(self._pose(self._arm[j - 1] if j else -1)) @ self._pose(link))
            motion.append(np.linalg.solve(rows, np.reshape(seen, (4, 16))).reshape(4, 4, 4))
        self._motion = np.stack(motion, axis=1)

    def _load_part(self, name: str, geometry: ConvexShape, T_owner_part: Array) -> _Part:
        """Load a primitive, or the convex hull of points `(n, 3)`, as a body without margin."""
        c, radius = self._client, 0.0
        sizes: dict[str, Any]
        if not isinstance(geometry, Shape):
            points, kind = geometry, p.GEOM_MESH
            sizes = {"vertices": (_SCALE * points).tolist()}
        else:
            points = geometry.corners()
            scaled = [_SCALE * v for v in geometry.size]
            if geometry.kind == "box":
                kind, sizes = p.GEOM_BOX, {"halfExtents": [v / 2 for v in scaled]}
            elif geometry.kind == "cylinder":
                kind, sizes = p.GEOM_CYLINDER, {"radius": scaled[0], "height": scaled[1]}
            else:
                points, radius = np.zeros((1, 3)), geometry.size[0]
                kind, sizes = p.GEOM_SPHERE, {"radius": scaled[0]}
        index = p.createCollisionShape(kind, **sizes, physicsClientId=c)
        body = p.createMultiBody(0.0, index, physicsClientId=c)
        p.changeDynamics(body, -1, collisionMargin=0.0, physicsClientId=c)
        half = np.abs(points).max(0)
        return _Part(name, body, T_owner_part, cover_spheres(points, radius), half, radius)

    def _load_surface(self, name: str, shape: MeshShape) -> _Part:
        """Load all triangles of a mesh as a body without margin."""
        c, mesh = self._client, shape.mesh()
        index = p.createCollisionShape(
            p.GEOM_MESH,
            vertices=(_SCALE * mesh.vertices).tolist(),
            indices=mesh.faces.ravel().tolist(),
            flags=p.GEOM_FORCE_CONCAVE_TRIMESH,
            physicsClientId=c,
        )
        body = p.createMultiBody(0.0, index, physicsClientId=c)
        p.changeDynamics(body, -1, collisionMargin=0.0, physicsClientId=c)
        half = np.abs(mesh.vertices).max(0)
        return _Part(name, body, shape.T_body_shape, np.zeros((0, 4)), half, 0.0)

    # --- placing --------------------------------------------------------------------------------

    def place(
        self,
        Ts_world_body: Mapping[str, Array],
        gripper: float,
        T_tool_grasped: Mapping[str, Array] = MappingProxyType({}),
        allowed: Collection[tuple[str, str]] = (),
    ) -> None:
        """Put the bodies and the gripper where they are in what is asked next.

        Args:
            Ts_world_body: poses `(4, 4)` of all bodies; those of grasped ones are ignored.
            gripper: where the gripper is, 0 open to 1 closed.
            T_tool_grasped: poses `(4, 4)` in the tool frame of the bodies that move with it.
            allowed: pairs of names that may touch; they are not considered.

        Raises:
            InvalidInput: not a pose, or a gripper position out of range.
            UnknownName: a grasped body isn't in the scene, a body's pose is missing, or there is no
                link or body of an allowed pair's name.
        """
        c = self._client
        names = [body.name for body in self.scene.bodies]
        for name in T_tool_grasped:
            if name not in names:
                raise unknown_name("body", name, names)
        for name in names:
            if name not in T_tool_grasped and name not in Ts_world_body:
                raise unknown_name("body", name, Ts_world_body)
        for name in (name for pair in allowed for name in pair):
            self._of(name)
        Ts_tool = {n: check_pose(f"T_tool_{n}", T) for n, T in T_tool_grasped.items()}
        Ts_world = {
            n: check_pose(f"T_world_{n}", Ts_world_body[n]) for n in names if n not in Ts_tool
        }
        for name, at in self.robot.gripper.joint_positions(check_gripper(gripper)).items():
            p.resetJointState(self._robot, self._gripper[name], at, physicsClientId=c)
        tool = self._links[self.robot.tool_frame]
        moving = [(part, self._links[part.name], part.T_owner_part) for part in self._parts]
        grasped = [part for part in self._in_grasp if part.name in Ts_tool]
        still = [part for part in self._standing if part.name in Ts_world]
        self._shapes = [*grasped, *still]
        moving += [(part, tool, Ts_tool[part.name] @ part.T_owner_part) for part in grasped]
        standing = [(part, Ts_world[part.name] @ part.T_owner_part) for part in still]
        for part, T in standing:
            self._put(part, *_position_and_quaternion(T))
        self._set_arm(np.zeros(len(self._arm)))
        Ts_world_arm = [self._pose(link) for link in (-1, *self._arm)]
        self._carriers = {}
        ranked = []
        for part, link, T_link_part in moving:
            rank = self._ranks[link]
            self._carriers[part.index] = _Carrier(link, _position_and_quaternion(T_link_part))
            T_arm_part = inverse(Ts_world_arm[rank]) @ self._pose(link) @ T_link_part
            ranked.append((part, rank, T_arm_part))
        self._bounds = _make_bounds(
            ranked,
            standing,
            len(self._arm),
            self.joints_apart,
            {frozenset(pair) for pair in allowed},
        )

    def _set_arm(self, q: Array) -> None:
        p.resetJointStatesMultiDof(
            self._robot, self._arm, q[:, None].tolist(), physicsClientId=self._client
        )

    def _pose(self, link: int) -> Array:
        T = np.eye(4)
        # The base stands at the world's origin.
        if link >= 0:
            state = p.getLinkState(self._robot, link, 0, 1, physicsClientId=self._client)
            T[:3, :3] = Rotation.from_quat(state[5]).as_matrix()
            T[:3, 3] = state[4]
        return T

    def _configure(self, q: Array) -> None:
        """Put the arm at `q`; its parts follow when they are asked for."""
        self._set_arm(q)
        self._placed.clear()

    def _follow(self, part: _Part) -> None:
        """Put a part where its link is."""
        carrier = self._carriers.get(part.index)
        if carrier is None or part.index in self._placed:
            return
        self._placed.add(part.index)
        position, quaternion = carrier.T_link_part
        if carrier.link >= 0:
            state = p.getLinkState(self._robot, carrier.link, 0, 1, physicsClientId=self._client)
            position, quaternion = p.multiplyTransforms(state[4], state[5], position, quaternion)
        self._put(part, position, quaternion)

    def _put(self, part: _Part, position: Sequence[float], quaternion: Sequence[float]) -> None:
        p.resetBasePositionAndOrientation(
            part.index, [_SCALE * x for x in position], quaternion, physicsClientId=self._client
        )

    # --- asking ---------------------------------------------------------------------------------

    def nearest(self, q: Array, within: float = 0.1) -> Nearest:
        """The nearest pair at joints `q (n,)` [rad] that is less than `within` [m] apart.

        Raises:
            InvalidInput: `q` has the wrong shape or isn't finite.
        """
        return self.nearest_along(check_array("q", q, (len(self._arm),))[None], within)[1]

    def nearest_along(self, qs: Array, within: float = 0.1) -> tuple[int, Nearest]:
        """Which of the configurations `qs (m, n)` [rad] has the nearest pair, and that pair.

        The same as the smallest of `nearest` of each, but faster: whatever spheres around the parts
        show to be farther apart than the nearest pair isn't considered. The index is -1 where
        nothing is less than `within` [m] apart.

        Raises:
            InvalidInput: `qs` has the wrong shape or isn't finite.
        """
        qs = check_array("qs", qs, (None, len(self._arm)))
        found = [(np.zeros(0, np.intp), np.zeros(0, np.intp), np.zeros(0))]
        for first, bounds in self._chunks(qs):
            rows, columns = np.nonzero(bounds < within)
            found.append((rows + first, columns, bounds[rows, columns]))
        rows, columns, values = (np.concatenate(each) for each in zip(*found, strict=True))
        best, at, row = _NOTHING, -1, -1
        # Where two may overlap nothing is known of how deep: all of these are considered, by
        # configuration, which saves moving the arm; of the others the nearest first.
        for k in np.argsort(np.maximum(values, 0.0), kind="stable"):
            reach = min(within, best.distance)
            if values[k] >= max(0.0, reach):
                break
            if rows[k] != row:
                row = int(rows[k])
                self._configure(qs[row])
            a, b = self._bounds.pairs[columns[k]]
            distance = self._distance(a, b, max(0.0, reach))
            if distance < reach:
                best, at = Nearest(a.name, b.name, distance), row
        return at, best

    def first_collision(self, qs: Array) -> int | None:
        """The index of the first of the configurations `qs (m, n)` [rad] in which a pair overlaps.

        Raises:
            InvalidInput: `qs` has the wrong shape or isn't finite.
        """
        qs = check_array("qs", qs, (None, len(self._arm)))
        for first, bounds in self._chunks(qs):
            for row in np.flatnonzero((bounds < 0.0).any(1)):
                self._configure(qs[first + row])
                columns = np.flatnonzero(bounds[row] < 0.0)
                for k in columns[np.argsort(bounds[row, columns])]:
                    a, b = self._bounds.pairs[k]
                    if self._distance(a, b, 0.0) < 0.0:
                        return first + int(row)
        return None

    def collides(self, q: Array) -> bool:
        """Whether any pair overlaps at joints `q (n,)` [rad].

        Raises:
            InvalidInput: `q` has the wrong shape or isn't finite.
        """
        return self.first_collision(check_array("q", q, (len(self._arm),))[None]) is not None

    def pair(self, q: Array, a: str, b: str, within: float = np.inf) -> float:
        """The distance [m] of two links or bodies at `q (n,)` [rad]; infinite beyond `within`.

        Any two may be asked for, also those that `nearest` ignores, but for two standing bodies
        with meshes. No part is left out.

        Raises:
            InvalidInput: `q` has the wrong shape or isn't finite.
            UnknownName: no link or body of that name collides.
        """
        self._configure(check_array("q", q, (len(self._arm),)))
        # PyBullet takes no infinite distance.
        reach = min(within, 100.0)
        smallest = min(self._distance(x, y, reach) for x in self._of(a) for y in self._of(b))
        return smallest if smallest < within else np.inf

    def _of(self, name: str) -> list[_Part]:
        """The parts of a link or body."""
        parts = [*self._parts, *self._shapes]
        found = [part for part in parts if part.name == name]
        if not found:
            raise unknown_name("link or body", name, {part.name for part in parts})
        return found

    def _distance(self, a: _Part, b: _Part, within: float) -> float:
        self._follow(a)
        self._follow(b)
        points = p.getClosestPoints(a.index, b.index, _SCALE * within, physicsClientId=self._client)
        return min((point[8] for point in points), default=np.inf) / _SCALE

    def _chunks(self, qs: Array) -> Iterator[tuple[int, Array]]:
        """Some configurations at a time: the first one's index, and bounds on their pairs."""
        A, B, C, D = self._motion
        for first in range(0, len(qs), _CHUNK):
            chunk = qs[first : first + _CHUNK]
            q = chunk[:, :, None, None]
            steps = A + B * q + C * np.sin(q) + D * np.cos(q)
            Ts = [np.broadcast_to(np.eye(4), (len(chunk), 4, 4))]
            for j in range(len(self._arm)):
                Ts.append(Ts[-1] @ steps[:, j])
            yield first, self._bounds(Ts)

    def close(self) -> None:
        """Free what PyBullet holds; nothing can be asked afterwards."""
        if self._client is not None:
            with suppress(p.error):
                p.disconnect(physicsClientId=self._client)
            self._client = None


def cover_spheres(points: Array, radius: float = 0.0) -> Array:
    """Spheres `(n, 4)`, centre and radius [m], that together enclose a convex part.

    The part is the convex hull of `points (k, 3)` grown by `radius`. It is cut across its longest
    side into slices, each of which gets a sphere.
    """
    if len(points) == 1:
        return np.array([[*points[0], radius]])
    hull = ConvexHull(points)
    size = np.ptp(points, axis=0)
    axis = int(np.argmax(size))
    across = float(np.linalg.norm(np.delete(size, axis)))
    n = int(np.clip(round(_SLICES * size[axis] / across), 1, 8))
    edges = np.concatenate([hull.simplices[:, [i, (i + 1) % 3]] for i in range(3)])
    ends = points[edges]
    cuts = np.linspace(points[:, axis].min(), points[:, axis].max(), n + 1)
    spheres = []
    for low, high in zip(cuts[:-1], cuts[1:], strict=True):
        inside = points[(points[:, axis] >= low) & (points[:, axis] <= high)]
        slice_ = np.concatenate([inside, _crossings(ends, axis, low), _crossings(ends, axis, high)])
        centre = (slice_.min(0) + slice_.max(0)) / 2
        reach = np.linalg.norm(slice_ - centre, axis=1).max()
        spheres.append([*centre, reach + radius + _ROUNDING])
    return np.array(spheres)


def _crossings(ends: Array, axis: int, at: float) -> Array:
    """Where lines between `ends (k, 2, 3)` cross the plane at a coordinate."""
    a, b = ends[:, 0, axis] - at, ends[:, 1, axis] - at
    cross = ends[a * b < 0]
    share = (a / np.where(a == b, 1.0, a - b))[a * b < 0]
    return cross[:, 0] + share[:, None] * (cross[:, 1] - cross[:, 0])


def _make_bounds(
    moving: list[tuple[_Part, int, Array]],
    standing: list[tuple[_Part, Array]],
    n_joints: int,
    joints_apart: int,
    allowed: set[frozenset[str]],
) -> _Bounds:
    """Bounds for parts that move, with rank and pose in the arm's link, and parts that stand."""
    moving = sorted(moving, key=lambda item: item[1])
    spheres: list[list[Array]] = [[np.zeros((4, 0))] for _ in range(n_joints + 1)]
    starts, radii = [0], []
    for part, rank, T_link_part in moving:
        centres = np.concatenate([part.spheres[:, :3].T, np.ones((1, len(part.spheres)))])
        spheres[rank].append(T_link_part @ centres)
        radii.append(part.spheres[:, 3])
        starts.append(starts[-1] + len(part.spheres))
    moved = [i for i, (_, rank, _) in enumerate(moving) if rank > 0]
    pairs = [(moving[i][0], shape) for i in moved for shape, _ in standing]
    considered = np.array([frozenset((a.name, b.name)) not in allowed for a, b in pairs], bool)
    own = [
        (j, i)
        for i, (a, rank_a, _) in enumerate(moving)
        for j, (b, rank_b, _) in enumerate(moving)
        if rank_b - rank_a >= joints_apart and frozenset((a.name, b.name)) not in allowed
    ]
    sets = [
        np.meshgrid(range(starts[j], starts[j + 1]), range(starts[i], starts[i + 1]))
        for j, i in own
    ]
    counts = [grid[0].size for grid in sets]
    return _Bounds(
        pairs=pairs + [(moving[j][0], moving[i][0]) for j, i in own],
        ignored=np.flatnonzero(~considered),
        spheres=[np.concatenate(group, axis=1) for group in spheres],
        radii=np.concatenate(radii),
        starts=np.array([starts[i] for i in moved], np.intp),
        W_shape_world=np.concatenate([np.zeros((0, 4)), *(inverse(T)[:3] for _, T in standing)]),
        half=np.array([shape.half for shape, _ in standing]).reshape(-1, 3, 1),
        shape_radii=np.array([shape.radius for shape, _ in standing]).reshape(-1, 1),
        own_a=np.concatenate([np.zeros(0, np.intp), *(grid[0].ravel() for grid in sets)]),
        own_b=np.concatenate([np.zeros(0, np.intp), *(grid[1].ravel() for grid in sets)]),
        own_starts=np.cumsum([0, *counts])[:-1].astype(np.intp),
    )


def collision_geometry(urdf: Path) -> Iterator[tuple[str, Shape | Array, Array]]:
    """Each collision element of a URDF: its link, its primitive or mesh corners, its pose there.

    Corners are `(n, 3)` [m], poses `(4, 4)`.
    """
    for link in ET.parse(urdf).getroot().findall("link"):
        for collision in link.findall("collision"):
            origin = collision.find("origin")
            T = np.eye(4)
            if origin is not None:
                T = rpy_pose(*(_floats(origin.get(key, "0 0 0")) for key in ("xyz", "rpy")))
            (element,) = collision.findall("geometry/*")
            geometry: Shape | Array
            if element.tag == "box":
                x, y, z = _floats(element.get("size", ""))
                geometry = Shape("box", (x, y, z))
            elif element.tag == "cylinder":
                radius, length = (float(element.get(key, "")) for key in ("radius", "length"))
                geometry = Shape("cylinder", (radius, length))
            elif element.tag == "sphere":
                geometry = Shape("sphere", (float(element.get("radius", "")),))
            else:
                mesh = trimesh.load(urdf.parent / element.get("filename", ""), force="mesh")
                assert isinstance(mesh, trimesh.Trimesh)
                geometry = np.asarray(mesh.vertices, np.float64)
            yield link.get("name", ""), geometry, T


def _floats(text: str) -> list[float]:
    return [float(word) for word in text.split()]


def _position_and_quaternion(T: Array) -> tuple[list[float], list[float]]:
    """A pose as PyBullet takes it, its quaternion xyzw."""
    return T[:3, 3].tolist(), Rotation.from_matrix(T[:3, :3]).as_quat().tolist()
