"""The scene as a wrist camera saw it: a coloured point cloud, and distances from it to the robot.

A real cell has no scene description. What a demonstration recorded stands in for one: depth
images, fused into points with the camera's pose known from the arm, the robot's own pixels taken
out, and a rule for the space that no image shows.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
import pinocchio as pin
from numpy.typing import ArrayLike, NDArray
from scipy.ndimage import minimum_filter
from scipy.spatial import cKDTree

from sart_toolkit.collision.hull import Hull
from sart_toolkit.collision.parts import robot_parts
from sart_toolkit.data.records import CameraRecord, Demonstration, Image, summary
from sart_toolkit.errors import InvalidInput, Mismatch, unknown_name
from sart_toolkit.poses import (
    Array,
    angle_between,
    check_array,
    check_positive,
    frozen,
    inverse,
)
from sart_toolkit.robots.model import RobotModel
from sart_toolkit.robots.spec import Attachment, RobotSpec, Shape
from sart_toolkit.scenes.spec import SceneSpec

# An image sees through a point when everything around it is farther by this.
_THROUGH_VOXELS, _THROUGH_SHARE = 2.0, 0.03
# Between two images used the camera has moved or turned by at least this [m, rad].
_STEP, _TURN = 0.02, np.deg2rad(6.0)
_MAX_IMAGES = 14
# How far from the tool what it took away may reach, and how far it must have moved [m].
_GRASPED_REACH, _GRASPED_AWAY = 0.15, 0.03


@dataclass(frozen=True)
class CloudConfig:
    """How images become a cloud; lengths in [m].

    `voxel`: points in one cell of this grid are merged into their mean. `near`, `far`: depth that
    is used. `reach`: points farther than this from every tool position shown are left out: no
    radius and no tool is large enough to get there. `self_margin`: points nearer than this to the
    robot's convex parts are its own pixels.

    `unknown` is the rule for space that no image shows: "free", or "behind": solid to a depth of
    `behind` along the ray behind what was seen, except where an image sees through it or the
    robot itself was.

    `inflation`: every point stands for a ball of this radius, for what lies between pixels. It is
    by how much a tool body within 5 cm of the scene may be nearer to the scene than to the points
    seen, measured against the true scenes: demonstrations of the six tasks on PyBullet and of
    peg-in-hole on SAPIEN, 128 x 128 pixels, until the first contact; tool bodies at 8 waypoints,
    there and strayed by up to 4 cm in each axis and some 7 deg. The 95th percentile was 1.14 mm in
    the worst task, the largest 1.8 mm. The points themselves are far better in simulation (by
    `surface_errors` 0.01 mm at the 95th percentile, 2.5 mm at most): a real camera needs its own
    figure.
    """

    voxel: float = 0.004
    near: float = 0.05
    far: float = 0.8
    reach: float = 0.35
    self_margin: float = 0.008
    unknown: Literal["behind", "free"] = "behind"
    behind: float = 0.03
    inflation: float = 0.0012

    def __post_init__(self) -> None:
        for name in ("voxel", "near", "far", "reach", "self_margin", "behind", "inflation"):
            check_positive(name, getattr(self, name), "m")
        if self.far <= self.near:
            raise InvalidInput(f"far: expected more than near ({self.near} m), got {self.far} m")
        if self.unknown not in ("behind", "free"):
            raise InvalidInput(f"unknown: expected 'behind' or 'free', got {self.unknown!r}")


@dataclass(frozen=True)
class SceneCloud:
    """Points of a scene `(n, 3)` [m] in the world, their `colours (n, 3)` uint8.

    `behind (n,)`: the point was not seen but filled in by the rule for unknown space; of such
    points only the outer layer is kept. `config` says how the cloud was made.
    """

    points: Array
    colours: Image
    behind: NDArray[np.bool_]
    config: CloudConfig = field(default_factory=CloudConfig)

    def __post_init__(self) -> None:
        points = check_array("points", self.points, (None, 3))
        colours, behind = np.asarray(self.colours), np.asarray(self.behind)
        if colours.shape != points.shape or colours.dtype != np.uint8:
            raise InvalidInput(
                f"colours: expected uint8 of shape {points.shape}, got {colours.dtype} "
                f"{colours.shape}"
            )
        if behind.shape != points.shape[:1] or behind.dtype != np.bool_:
            raise InvalidInput(
                f"behind: expected bool of shape {points.shape[:1]}, got {behind.dtype} "
                f"{behind.shape}"
            )
        object.__setattr__(self, "points", frozen(points))
        object.__setattr__(self, "colours", frozen(colours))
        object.__setattr__(self, "behind", frozen(behind))

    def __len__(self) -> int:
        return len(self.points)

    def __repr__(self) -> str:
        return summary(self, points=len(self), behind=int(self.behind.sum()))

    def without(self, p_world: ArrayLike, margin: float | None = None) -> SceneCloud:
        """The cloud less what lies in the convex hull of some points: an object taken away, say.

        Args:
            p_world: `(m, 3)` [m].
            margin: the hull is grown by this [m]; by two voxels if left out.

        Raises:
            InvalidInput: fewer than four points, or all in one plane.
        """
        hull = Hull(check_array("p_world", p_world, (None, 3)))
        grown = 2 * self.config.voxel if margin is None else margin
        keep = ~hull.near(self.points, grown)
        return SceneCloud(self.points[keep], self.colours[keep], self.behind[keep], self.config)


@dataclass(frozen=True)
class GraspedObject:
    """What was in the grasp at some `waypoints`: points `(m, 3)` [m] of it in the tool frame.

    Its convex hull counts as the object.
    """

    points: Array
    waypoints: tuple[int, ...]

    def __post_init__(self) -> None:
        object.__setattr__(self, "points", frozen(check_array("points", self.points, (None, 3))))
        object.__setattr__(self, "waypoints", tuple(self.waypoints))
        if not self.waypoints:
            raise InvalidInput(
                "waypoints of a grasped object: expected at least one, got none; name some"
            )


class _OwnBody:
    """The robot's convex parts and what it has grasped, wherever its joints and its gripper are."""

    def __init__(
        self,
        demonstration: Demonstration,
        robot: RobotSpec,
        held: Sequence[Attachment],
        grasped: Sequence[GraspedObject],
    ) -> None:
        self._steps = demonstration.steps
        self._robot, self._held = robot, tuple(held)
        self._grasped = [(each, Hull(each.points)) for each in grasped]
        self._models: dict[float, RobotModel] = {}
        model = self._model(0.0)
        Ts_link = model.link_poses(robot.home)
        Ts_joint = _joint_frames(model, robot.home)
        # Parts are loaded once, in their links' frames: only links move when the gripper does.
        self._parts = []
        for part in robot_parts(model):
            T = inverse(Ts_link[part.body]) @ Ts_joint[part.joint]
            self._parts.append((part.body, Hull(part.points @ T[:3, :3].T + T[:3, 3])))

    def _model(self, gripper: float) -> RobotModel:
        opening = round(float(np.clip(gripper, 0.0, 1.0)), 2)
        if opening not in self._models:
            self._models[opening] = RobotModel(self._robot, self._held, opening)
        return self._models[opening]

    def covers(self, p_world: Array, t: int, margin: float) -> NDArray[np.bool_]:
        """Which points `(n, 3)` the robot, grown by a margin [m], covers at waypoint `t`."""
        model = self._model(float(self._steps.measured_gripper[t]))
        Ts_link = model.link_poses(self._steps.joint_positions[t])
        hulls = [(hull, Ts_link[link]) for link, hull in self._parts]
        T_tool = self._steps.measured_Ts_world_tool[t]
        hulls += [(hull, T_tool) for each, hull in self._grasped if t in each.waypoints]
        centres = np.stack([T[:3, :3] @ hull.centre + T[:3, 3] for hull, T in hulls])
        radii = np.array([hull.radius for hull, _ in hulls]) + margin
        # |p - c|^2 = |p|^2 - 2 p.c + |c|^2: one product for all.
        squares = np.einsum("ij,ij->i", p_world, p_world)
        limits = radii**2 - np.einsum("ij,ij->i", centres, centres)
        candidates = squares - 2 * centres @ p_world.T <= limits[:, None]
        covered = np.zeros(len(p_world), dtype=bool)
        for (hull, T), candidate in zip(hulls, candidates, strict=True):
            rows = np.flatnonzero(candidate & ~covered)
            if len(rows):
                covered[rows] = hull.near((p_world[rows] - T[:3, 3]) @ T[:3, :3], margin)
        return covered


def _joint_frames(model: RobotModel, q: Array) -> list[Array]:
    """The poses `(4, 4)` of all joints in the world at `q`."""
    data = model.pinocchio_model.createData()
    pin.forwardKinematics(model.pinocchio_model, data, model.check_q(q))
    return [np.array(T.homogeneous) for T in data.oMi]


@dataclass(frozen=True)
class _View:
    """One depth image: its waypoint, where its camera was, what it says."""

    waypoint: int
    T_world_camera: Array
    intrinsics: Array
    rgb: Image
    depth: Array
    # The smallest depth of each pixel and its neighbours, 0 where one of them has none: the edge
    # of a thing may be a pixel from where it is drawn.
    nearest: Array

    @staticmethod
    def of(demonstration: Demonstration, camera: CameraRecord, t: int) -> _View:
        depth = camera.depth[t].astype(np.float64)
        depth[~np.isfinite(depth) | (depth < 0)] = 0.0
        return _View(
            t,
            camera.Ts_world_camera(demonstration.steps.measured_Ts_world_tool[t]),
            camera.intrinsics,
            camera.rgb[t],
            depth,
            minimum_filter(depth, 3, mode="nearest"),
        )

    def points(self, near: float, far: float) -> tuple[Array, Image]:
        """What it shows between two depths [m]: points `(n, 3)` in the world, colours `(n, 3)`."""
        v, u = np.nonzero((self.depth > near) & (self.depth < far))
        z = self.depth[v, u]
        pixels = np.stack([u, v, np.ones(len(u))], axis=1)
        p = np.asarray(pixels @ np.linalg.inv(self.intrinsics).T * z[:, None], dtype=np.float64)
        T = self.T_world_camera
        return p @ T[:3, :3].T + T[:3, 3], self.rgb[v, u]

    def project(self, p_world: Array) -> tuple[NDArray[np.intp], NDArray[np.intp], Array]:
        """Rows of those points that fall into the image; their pixels' index and their depth."""
        T = self.T_world_camera
        p = (p_world - T[:3, 3]) @ T[:3, :3]
        ahead = np.flatnonzero(p[:, 2] > 1e-6)
        p = p[ahead]
        uv = np.rint((p @ self.intrinsics[:2].T) / p[:, 2:]).astype(np.int64)
        height, width = self.depth.shape
        inside = ((uv >= 0) & (uv < [width, height])).all(axis=1)
        return ahead[inside], uv[inside, 1] * width + uv[inside, 0], p[inside, 2]

    def through(self, p_world: Array, voxel: float) -> NDArray[np.bool_]:
        """Which points `(n, 3)` the image sees through: all it sees there lies behind them."""
        rows, pixels, z = self.project(p_world)
        result = np.zeros(len(p_world), dtype=bool)
        result[rows] = self.nearest.ravel()[pixels] > z + _tolerance(z, voxel)
        return result

    def misfit(self, p_world: Array, voxel: float) -> Array:
        """How far `(n,)` [m] points are from what the image shows at their pixels.

        It is the tolerance at most, and NaN where the image shows nothing: outside of it, where
        it has no depth, and behind something nearer.
        """
        rows, pixels, z = self.project(p_world)
        behind, tolerance = self.depth.ravel()[pixels] - z, _tolerance(z, voxel)
        misfits = np.full(len(p_world), np.nan)
        misfits[rows] = np.where(behind < -tolerance, np.nan, np.minimum(np.abs(behind), tolerance))
        return misfits


def _tolerance(z: Array, voxel: float) -> Array:
    """By how much [m] depths may differ from `z (n,)` and still mean the same surface."""
    return np.maximum(_THROUGH_VOXELS * voxel, _THROUGH_SHARE * z)


def fuse_cloud(
    demonstration: Demonstration,
    robot: RobotSpec,
    held: Sequence[Attachment],
    waypoints: Sequence[int] | None = None,
    config: CloudConfig | None = None,
    grasped: Sequence[GraspedObject] = (),
) -> SceneCloud:
    """The coloured point cloud of the scene that the wrist images at some waypoints show.

    Images are chosen by how far the camera has moved. The robot's own pixels and those of what
    it grasped are dropped, and points that a later image sees through: what was there has
    moved, or was noise.

    Args:
        demonstration: what was recorded, with depth.
        robot: the robot that recorded it.
        held: bodies fixed to it.
        waypoints: whose images are used, all if left out. What isn't grasped should stand still.
        config: grid, ranges and rules.
        grasped: what the gripper grasped; it is no part of the scene, neither in its grasp nor
            where it was taken from.

    Raises:
        InvalidInput: no camera or no depth was recorded, a waypoint is out of range, or the
            images show nothing within range and reach.
        Mismatch: another robot recorded it.
    """
    config = config or CloudConfig()
    views = _views(demonstration, robot, waypoints)
    own = _OwnBody(demonstration, robot, held, grasped)
    pixels = _scene_pixels(views, own, config)
    cells = _merged(pixels, views, config)
    reached = cKDTree(demonstration.steps.measured_Ts_world_tool[:, :3, 3])
    near = reached.query(cells.points, distance_upper_bound=config.reach)[0] <= config.reach
    keep = near & ~_moved_away(cells, views, config)
    for each in grasped:
        T = demonstration.steps.measured_Ts_world_tool[each.waypoints[0]]
        p_tool = (cells.points - T[:3, 3]) @ T[:3, :3]
        before = cells.last < each.waypoints[0]
        keep &= ~(before & Hull(each.points).near(p_tool, config.self_margin))
    if not keep.any():
        raise InvalidInput(
            f"cloud: expected something {config.near} to {config.far} m before the camera and "
            f"within {config.reach} m of the tool besides the robot, got nothing; look at the "
            "images, or change near, far or reach"
        )
    points, colours = cells.points[keep], cells.colours[keep]
    behind = np.zeros(len(points), dtype=bool)
    if config.unknown == "behind":
        filled, source = _filled(pixels, cells, keep, views, own, config)
        points = np.concatenate([points, filled])
        colours = np.concatenate([colours, cells.colours[source]])
        behind = np.append(behind, np.ones(len(filled), dtype=bool))
    return SceneCloud(points, colours, behind, config)


def _views(
    demonstration: Demonstration, robot: RobotSpec, waypoints: Sequence[int] | None
) -> list[_View]:
    """The images at those of the waypoints between which the camera has moved."""
    if demonstration.robot != robot.name:
        raise Mismatch(
            f"cloud: the demonstration was recorded by {demonstration.robot!r}, got "
            f"{robot.name!r}; pass the robot that recorded it"
        )
    cameras = demonstration.steps.cameras
    if not cameras:
        raise InvalidInput(
            "cloud: expected a demonstration with a wrist camera, got none; record it with one"
        )
    chosen = _checked_waypoints(demonstration, waypoints)
    Ts = demonstration.steps.measured_Ts_world_tool
    keys = chosen[:1]
    for t in chosen[1:]:
        T, T_last = Ts[t], Ts[keys[-1]]
        moved = np.linalg.norm(T[:3, 3] - T_last[:3, 3]) >= _STEP
        if moved or angle_between(T[:3, :3], T_last[:3, :3]) >= _TURN:
            keys.append(t)
    if keys[-1] != chosen[-1]:
        keys.append(chosen[-1])
    if len(keys) > _MAX_IMAGES:
        keys = [keys[i] for i in np.linspace(0, len(keys) - 1, _MAX_IMAGES).round().astype(int)]
    views = [_View.of(demonstration, camera, t) for t in keys for camera in cameras.values()]
    if not any(view.depth.any() for view in views):
        raise InvalidInput(
            "cloud: expected depth [m] > 0 in some pixels, got 0 in all; record with a depth camera"
        )
    return views


def _checked_waypoints(demonstration: Demonstration, waypoints: Sequence[int] | None) -> list[int]:
    n = len(demonstration)
    chosen = sorted({int(t) for t in (range(n) if waypoints is None else waypoints)})
    if not chosen:
        raise InvalidInput("waypoints: expected at least one, got none; name some")
    for t in (chosen[0], chosen[-1]):
        if not 0 <= t < n:
            raise InvalidInput(f"waypoint {t}: expected 0 to {n - 1}; choose another")
    return chosen


@dataclass(frozen=True)
class _Pixels:
    """Points `(n, 3)` of the images that aren't the robot, their colours and grid cells.

    `image (n,)` is the index of the image, `cell (n,)` the number of the cell.
    """

    points: Array
    colours: Image
    image: NDArray[np.int64]
    cell: NDArray[np.int64]


@dataclass(frozen=True)
class _Cells:
    """The cells that pixels fell into, by increasing number `(n,)`: mean point, mean colour.

    `last (n,)` is the last waypoint at which an image saw something in it.
    """

    numbers: NDArray[np.int64]
    points: Array
    colours: Image
    last: NDArray[np.int64]


def _scene_pixels(views: Sequence[_View], own: _OwnBody, config: CloudConfig) -> _Pixels:
    points, colours = [], []
    for view in views:
        p, colour = view.points(config.near, config.far)
        other = ~own.covers(p, view.waypoint, config.self_margin)
        points.append(p[other])
        colours.append(colour[other])
    image = np.repeat(np.arange(len(views)), [len(p) for p in points])
    p = np.concatenate(points)
    return _Pixels(p, np.concatenate(colours), image, _cell_numbers(p, config.voxel))


def _merged(pixels: _Pixels, views: Sequence[_View], config: CloudConfig) -> _Cells:
    order = np.argsort(pixels.cell, kind="stable")
    numbers, first, counts = np.unique(pixels.cell[order], return_index=True, return_counts=True)
    if not len(numbers):
        return _Cells(numbers, pixels.points, pixels.colours, numbers)
    points = np.add.reduceat(pixels.points[order], first) / counts[:, None]
    colours = np.add.reduceat(pixels.colours[order].astype(np.int64), first) // counts[:, None]
    waypoints = np.array([view.waypoint for view in views])
    last = np.maximum.reduceat(waypoints[pixels.image[order]], first)
    return _Cells(numbers, points, colours.astype(np.uint8), last)


def _moved_away(cells: _Cells, views: Sequence[_View], config: CloudConfig) -> NDArray[np.bool_]:
    """Which cells `(n,)` a later image sees through."""
    gone = np.zeros(len(cells.points), dtype=bool)
    for view in views:
        rows = np.flatnonzero(~gone & (cells.last < view.waypoint))
        gone[rows] = view.through(cells.points[rows], config.voxel)
    return gone


def _filled(
    pixels: _Pixels,
    cells: _Cells,
    keep: NDArray[np.bool_],
    views: Sequence[_View],
    own: _OwnBody,
    config: CloudConfig,
) -> tuple[Array, NDArray[np.int64]]:
    """The outer layer of what lies hidden behind the kept cells, and which cell each is behind.

    Cells that an image sees through, or where the robot was itself, aren't hidden.
    """
    seen = cells.numbers[keep]
    row = np.searchsorted(cells.numbers, pixels.cell)
    depths = np.append(np.arange(config.voxel, config.behind, config.voxel), config.behind)
    numbers, sources = [], []
    for index, view in enumerate(views):
        mine = np.flatnonzero((pixels.image == index) & keep[row])
        # One ray a cell and image.
        mine = mine[np.unique(row[mine], return_index=True)[1]]
        rays = pixels.points[mine] - view.T_world_camera[:3, 3]
        rays /= np.linalg.norm(rays, axis=1, keepdims=True)
        samples = pixels.points[mine][:, None] + depths[:, None] * rays[:, None]
        numbers.append(_cell_numbers(samples.reshape(-1, 3), config.voxel))
        sources.append(np.repeat(row[mine], len(depths)))
    number, first = np.unique(np.concatenate(numbers), return_index=True)
    source = np.concatenate(sources)[first]
    hidden = ~np.isin(number, seen, assume_unique=True)
    p = _cell_centres(number, config.voxel)
    for view in views:
        rows = np.flatnonzero(hidden)
        hidden[rows] = ~view.through(p[rows], config.voxel)
    for t in sorted({view.waypoint for view in views}):
        rows = np.flatnonzero(hidden)
        hidden[rows] = ~own.covers(p[rows], t, 0.0)
    solid = np.sort(np.concatenate([number[hidden], seen]))
    rows = np.flatnonzero(hidden)
    outer = np.zeros(len(rows), dtype=bool)
    for step in (1, 1 << _BITS, 1 << 2 * _BITS):
        for neighbour in (number[rows] - step, number[rows] + step):
            at = np.minimum(np.searchsorted(solid, neighbour), len(solid) - 1)
            outer |= solid[at] != neighbour
    return p[rows[outer]], source[rows[outer]]


# Cells are numbered by three coordinates of so many bits, counted from the middle.
_BITS = 21
_MIDDLE = 1 << _BITS - 1


def _cell_numbers(p: Array, voxel: float) -> NDArray[np.int64]:
    """The numbers `(n,)` of the grid cells that points `(n, 3)` lie in.

    Cells lie about multiples of their size, so that no cell ends at the table's top.
    """
    x, y, z = (np.rint(p / voxel).astype(np.int64) + _MIDDLE).T
    return (x << 2 * _BITS) | (y << _BITS) | z


def _cell_centres(numbers: NDArray[np.int64], voxel: float) -> Array:
    """The middle points `(n, 3)` of numbered cells."""
    mask = (1 << _BITS) - 1
    cells = np.stack([numbers >> 2 * _BITS, numbers >> _BITS & mask, numbers & mask], axis=1)
    return (cells - _MIDDLE) * voxel


class _MeanMisfit:
    """The mean of points' misfits over the images that show them."""

    def __init__(self, n: int) -> None:
        self._sum, self._count = np.zeros(n), np.zeros(n)

    def add(self, misfits: Array) -> None:
        measured = np.isfinite(misfits)
        self._sum[measured] += misfits[measured]
        self._count[measured] += 1

    def mean(self) -> Array:
        """The means `(n,)` [m], infinite where no image shows them."""
        return np.where(self._count > 0, self._sum / np.maximum(self._count, 1), np.inf)


def grasped_object(
    demonstration: Demonstration,
    robot: RobotSpec,
    held: Sequence[Attachment],
    after: Sequence[int],
    before: Sequence[int] | None = None,
    config: CloudConfig | None = None,
) -> GraspedObject | None:
    """What the gripper took away, as points in the tool frame; None if it took nothing.

    Of the points near the tool those belong to it that rode along with the tool in the images of
    `after`, and those seen in `before` that images of `after` see through. Without `before`
    only the side towards the camera is known; it is then taken to be `config.behind` deep, away
    from the camera and across the tool's axis (unless `config.unknown` is "free").

    Args:
        demonstration: what was recorded, with depth.
        robot: the robot that recorded it.
        held: bodies fixed to it.
        after: waypoints at which the object was in the grasp; the tool must move by 3 cm.
        before: waypoints at which it stood where it was then grasped; None if the demonstration
            began with the object in the grasp.
        config: grid, ranges and rules.

    Raises:
        InvalidInput: no camera or no depth was recorded, or a waypoint is out of range.
        Mismatch: another robot recorded it.
    """
    config = config or CloudConfig()
    held_at = tuple(_checked_waypoints(demonstration, after))
    own = _OwnBody(demonstration, robot, held, ())
    views = _views(demonstration, robot, held_at)
    Ts = demonstration.steps.measured_Ts_world_tool
    T_grasp = Ts[held_at[0]]
    if before is None:
        candidates = _scene_pixels(views[:1], own, config).points
    else:
        seen = fuse_cloud(
            demonstration, robot, held, before, dataclasses.replace(config, unknown="free")
        )
        candidates = seen.points
    near = np.linalg.norm(candidates - T_grasp[:3, 3], axis=1) <= _GRASPED_REACH
    p_world = candidates[near]
    p_tool = (p_world - T_grasp[:3, 3]) @ T_grasp[:3, :3]
    rode, stayed = _MeanMisfit(len(p_world)), _MeanMisfit(len(p_world))
    gone = np.zeros(len(p_world), dtype=bool)
    for view in views:
        T = Ts[view.waypoint]
        if np.linalg.norm(T[:3, 3] - T_grasp[:3, 3]) >= _GRASPED_AWAY:
            rode.add(view.misfit(p_tool @ T[:3, :3].T + T[:3, 3], config.voxel))
            stayed.add(view.misfit(p_world, config.voxel))
            gone |= view.through(p_world, config.voxel)
    # A floor that the tool moves along would look as well as if it came with it.
    better = rode.mean() < stayed.mean() - config.voxel / 4
    mine = gone | ((rode.mean() <= config.voxel) & better)
    if not mine.any():
        return None
    points = p_tool[mine]
    if before is None and config.unknown == "behind":
        p_camera = (inverse(T_grasp) @ views[0].T_world_camera)[:3, 3]
        # Across the tool's axis: along the rays themselves it would get a deeper bottom too.
        across = (points - p_camera) * [1.0, 1.0, 0.0]
        across *= config.behind / np.maximum(np.linalg.norm(across, axis=1, keepdims=True), 1e-6)
        points = np.concatenate([points, points + across])
    return GraspedObject(points, held_at)


def surface_errors(
    cloud: SceneCloud, scene: SceneSpec, Ts_world_body: Mapping[str, Array]
) -> Array:
    """How far `(n,)` [m] each point of a cloud is from the nearest true surface of a scene.

    For measuring how good clouds are, where the scene is known: in simulation, or with a gauge.

    Args:
        cloud: the cloud.
        scene: bodies with their shapes, those that are only drawn included.
        Ts_world_body: their poses `(4, 4)` when the images were taken.

    Raises:
        UnknownName: a body's pose is missing.
    """
    errors = np.full(len(cloud), np.inf)
    for body in scene.bodies:
        if body.name not in Ts_world_body:
            raise unknown_name("body", body.name, Ts_world_body)
        for shape in body.shapes:
            T = inverse(Ts_world_body[body.name] @ shape.T_body_shape)
            p = cloud.points @ T[:3, :3].T + T[:3, 3]
            errors = np.minimum(errors, _surface_distance(shape, p))
    return errors


def _surface_distance(shape: Shape, p: Array) -> Array:
    """The distance `(n,)` [m] of points in a shape's frame to its surface, from either side."""
    if shape.kind == "sphere":
        return np.abs(np.linalg.norm(p, axis=1) - shape.size[0])
    if shape.kind == "box":
        over = np.abs(p) - np.array(shape.size) / 2
    else:
        radius, length = shape.size
        over = np.stack([np.hypot(p[:, 0], p[:, 1]) - radius, np.abs(p[:, 2]) - length / 2], axis=1)
    outside = np.linalg.norm(np.maximum(over, 0.0), axis=1)
    return np.where(outside > 0, outside, -over.max(axis=1))
