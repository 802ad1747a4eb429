"""The scene as a wrist camera saw it: a coloured point cloud, and distances from it to the robot.

A real cell has no scene description. What a demonstration recorded stands in for one: depth
images, fused into points with the camera's pose known from the arm, the robot's own pixels taken
out, and a rule for the space that no image shows.
"""

from __future__ import annotations

import dataclasses
import itertools
import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
import pinocchio as pin
from numpy.typing import ArrayLike, NDArray
from scipy.ndimage import minimum_filter, uniform_filter
from scipy.spatial import cKDTree
from scipy.stats import binom

from sart_toolkit.collision.hull import Hull
from sart_toolkit.collision.parts import robot_parts
from sart_toolkit.collision.phases import IN_GRASP_SLIP
from sart_toolkit.collision.sensor import CloudConfig, SensorErrors
from sart_toolkit.data.records import Demonstration, Image, summary
from sart_toolkit.errors import InvalidInput, Mismatch, unknown_name
from sart_toolkit.poses import (
    Array,
    angle_between,
    check_array,
    frozen,
    inverse,
)
from sart_toolkit.robots.meshes import nearest_on
from sart_toolkit.robots.model import RobotModel
from sart_toolkit.robots.spec import Attachment, BodyShape, MeshShape, RobotSpec
from sart_toolkit.scenes.spec import SceneSpec

_log = logging.getLogger(__name__)
# An image sees through a point when everything around it is farther by this.
_THROUGH_VOXELS, _THROUGH_SHARE = 2.0, 0.03
# Between two images used the camera has moved or turned by at least this [m, rad].
_STEP, _TURN = 0.02, np.deg2rad(6.0)
_MAX_IMAGES = 14
# What is seen through is known: so many of nine pixels, within so many of them at most.
_KNOWN_SHARE, _WIDEST = 6.5 / 9, 5
# A pixel continues what is beside it to so many standard deviations and so much more [m], and is
# believed by itself if it does so in so many of twelve ways.
_ODD_DEVIATIONS, _ODD_LEAST, _CONTINUES = 2.5, 0.001, 5
# It isn't alone if so many of its neighbours are as far away, to this fraction.
_ALIKE, _ALIKE_SHARE, _IN_LINE = 2, 0.02, 3
# Images are compared at every third pixel of each row and column, where they share so many; so
# many pairs say something of the camera. What moved once splits them in two: at most 2 / 3 differ.
_SPARSE, _FEWEST, _FEWEST_PAIRS, _MOST = 3, 100, 6, 0.75
# No image is more certain than this [m].
_LEAST_OFF = 0.0001
# So likely is it at most that as many images agree by chance with a pixel that shows nothing.
_CHANCE = 0.001
# The robot's own pixels are at least so near to its parts [m], but for what they are off.
_OWN_LEAST = 0.001
# How far from the tool what it took away may reach, and how far it must have moved [m].
_GRASPED_REACH, _GRASPED_AWAY = 0.15, 0.03


@dataclass(frozen=True)
class SceneCloud:
    """Points of a scene `(n, 3)` [m] in the world, their `colours (n, 3)` uint8.

    `behind (n,)`: the point was not seen but filled in by the rule for unknown space; of such
    points only the outer layer is kept. `config` says how the cloud was made. `inflation (n,)`
    [m]: the radius of the ball that each point stands for, the config's where it is left out.
    """

    points: Array
    colours: Image
    behind: NDArray[np.bool_]
    config: CloudConfig = field(default_factory=CloudConfig)
    inflation: Array = field(default_factory=lambda: np.empty(0))

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
        inflation = self.inflation
        if not len(inflation):
            inflation = np.full(len(points), self.config.inflation)
        inflation = check_array("inflation", inflation, points.shape[:1])
        if not (inflation > 0).all():
            raise InvalidInput(f"inflation: expected more than 0 m, got {inflation.min()}")
        object.__setattr__(self, "points", frozen(points))
        object.__setattr__(self, "colours", frozen(colours))
        object.__setattr__(self, "behind", frozen(behind))
        object.__setattr__(self, "inflation", frozen(inflation))

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
        return self.where(~hull.near(self.points, grown))

    def where(self, keep: NDArray[np.bool_]) -> SceneCloud:
        """The points for which `keep (n,)` is true."""
        return SceneCloud(
            self.points[keep],
            self.colours[keep],
            self.behind[keep],
            self.config,
            self.inflation[keep],
        )


@dataclass(frozen=True)
class GraspedObject:
    """What was in the grasp at some `waypoints`: points `(m, 3)` [m] of it in the tool frame.

    Its convex hull counts as the object, and reaches out of that by `error` [m] at most.
    """

    points: Array
    waypoints: tuple[int, ...]
    error: float = 0.0

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

    def covers(
        self, p_world: Array, t: int, margin: float | Array, unsure: float = 0.0
    ) -> NDArray[np.bool_]:
        """Which points `(n, 3)` the robot covers at waypoint `t`, grown by a margin [m].

        There may be a margin `(n,)` for each point. What is grasped is grown by `unsure` times its
        error and what it may slip in the grasp too.
        """
        model = self._model(float(self._steps.measured_gripper[t]))
        Ts_link = model.link_poses(self._steps.joint_positions[t])
        hulls = [(hull, Ts_link[link], 0.0) for link, hull in self._parts]
        T_tool = self._steps.measured_Ts_world_tool[t]
        hulls += [
            (hull, T_tool, unsure * (each.error + IN_GRASP_SLIP))
            for each, hull in self._grasped
            if t in each.waypoints
        ]
        margins = np.broadcast_to(margin, p_world.shape[:1])
        centres = np.stack([T[:3, :3] @ hull.centre + T[:3, 3] for hull, T, _ in hulls])
        radii = np.array([hull.radius + more for hull, _, more in hulls])
        radii = np.maximum(radii + margins.max(initial=-np.inf), 0.0)
        # |p - c|^2 = |p|^2 - 2 p.c + |c|^2: one product for all.
        squares = np.einsum("ij,ij->i", p_world, p_world)
        limits = radii**2 - np.einsum("ij,ij->i", centres, centres)
        candidates = squares - 2 * centres @ p_world.T <= limits[:, None]
        covered = np.zeros(len(p_world), dtype=bool)
        for (hull, T, more), candidate in zip(hulls, candidates, strict=True):
            rows = np.flatnonzero(candidate & ~covered)
            if len(rows):
                p = (p_world[rows] - T[:3, 3]) @ T[:3, :3]
                covered[rows] = hull.near(p, margins[rows] + more)
        return covered


def _joint_frames(model: RobotModel, q: Array) -> list[Array]:
    """The poses `(4, 4)` of all joints in the world at `q`."""
    data = model.pinocchio_model.createData()
    pin.forwardKinematics(model.pinocchio_model, data, model.check_q(q))
    return [np.array(T.homogeneous) for T in data.oMi]


class _Shown(NamedTuple):
    """Where an image shows some points, the `rows (k,)` of all, of another image.

    By how much `moved (k, 3)` [m] they are there, and what that is off, as `_Pixels` has it.
    """

    rows: NDArray[np.intp]
    moved: Array
    systematic: Array
    deviation: Array


class _View:
    """One depth image: its waypoint, where its camera was, what it says.

    Attributes:
        waypoint, camera: when and by which camera it was taken.
        T_world_camera, intrinsics, rgb, depth: where that was, and its pixels.
        own: `(H, W)` the robot's own pixels, once these are known.
        disagreement: by how much another image may misplace what this one shows, see `_related`.
    """

    def __init__(
        self, demonstration: Demonstration, name: str, t: int, sensor: SensorErrors
    ) -> None:
        camera = demonstration.steps.cameras[name]
        depth = camera.depth[t].astype(np.float64)
        depth[~np.isfinite(depth) | (depth < 0)] = 0.0
        self.waypoint, self.camera = t, name
        self.T_world_camera = camera.Ts_world_camera(demonstration.steps.measured_Ts_world_tool[t])
        self.intrinsics, self.rgb, self.depth = camera.intrinsics, camera.rgb[t], depth
        self.sensor = sensor
        self.own = np.zeros(depth.shape, bool)
        self.disagreement: Callable[[Array], Array] = np.zeros_like
        self._nearest: dict[int, Array] = {}

    def nearest(self, reach: int) -> Array:
        """The smallest depth `(H, W)` within some pixels of each, 0 where too little is known.

        That is where more than two of the nine pixels about any of them have no depth, or where
        the pixel has none itself.
        """
        if reach not in self._nearest:
            known = self.depth > 0
            smallest = minimum_filter(
                np.where(known, self.depth, np.inf), 2 * reach + 1, mode="nearest"
            )
            share = uniform_filter(known.astype(np.float64), 3, mode="nearest")
            if reach > 1:
                share = minimum_filter(share, 2 * reach - 1, mode="nearest")
            smallest[(share < _KNOWN_SHARE) | ~known] = 0.0
            self._nearest[reach] = smallest
        return self._nearest[reach]

    def forget(self) -> None:
        """Forget what was worked out from the depth: it has changed."""
        self._nearest.clear()

    def points(self, chosen: NDArray[np.bool_]) -> tuple[Array, Image, Array, Array]:
        """What chosen pixels `(H, W)` show.

        Returns:
            Points `(n, 3)` in the world, colours `(n, 3)`, depths `(n,)` and distances `(n,)` [m]
            from the camera.
        """
        v, u = np.nonzero(chosen)
        z = self.depth[v, u]
        pixels = np.stack([u, v, np.ones(len(u))], axis=1)
        p = np.asarray(pixels @ np.linalg.inv(self.intrinsics).T * z[:, None], dtype=np.float64)
        T = self.T_world_camera
        distances = np.linalg.norm(p, axis=1)
        return p @ T[:3, :3].T + T[:3, 3], self.rgb[v, u], z, distances

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
        off = self.disagreement(z)
        behind = z + _tolerance(z, voxel) + off + self.sensor.noise_bound(z)
        # The edge of a thing may be a pixel from where it is drawn, and so much more.
        focal = float(self.intrinsics[0, 0])
        reach = 1 + np.ceil(focal * off / z - 1e-9).astype(np.int64)
        seen = np.zeros(len(rows))
        for each in range(1, _WIDEST + 1):
            at = reach == each
            if at.any():
                seen[at] = self.nearest(each).ravel()[pixels[at]]
        result = np.zeros(len(p_world), dtype=bool)
        result[rows] = seen > behind
        return result

    def off(self, z: Array, deviation: Array, deviations: float) -> Array:
        """How far `(n,)` [m] depths `z (n,)` of another image's points may be from what it shows.

        That is by so many standard deviations, `deviation (n,)` [m] being that of the points, and
        for a surface at 45 degrees that a pixel shows beside them.
        """
        noise = deviations * np.hypot(self.sensor.deviation(z), deviation)
        return np.asarray(self.disagreement(z) + noise + 0.5 * z / self.intrinsics[0, 0])

    def confirms(
        self, p_world: Array, deviation: Array
    ) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
        """Of which points `(n, 3)` of another image it says something, and which it shows.

        It shows those whose depth one of nine pixels has, and denies those behind which all nine
        are.

        Args:
            p_world: the points.
            deviation: the standard deviation `(n,)` [m] of their depths.
        """
        rows, pixels, z = self.project(p_world)
        off = self.off(z, deviation[rows], 2.0)
        looks, agrees = np.zeros((2, len(p_world)), dtype=bool)
        v, u = np.divmod(pixels, self.depth.shape[1])
        # What the robot hides is not confirmed by the robot.
        padded = np.pad(np.where(self.own, 0.0, self.depth), 1)
        for i, j in itertools.product(range(3), repeat=2):
            there = padded[v + i, u + j]
            agrees[rows] |= (there > 0) & (np.abs(there - z) <= off)
        # The edge of a thing may be a pixel from where it is drawn: beside one nothing is denied.
        looks[rows] = agrees[rows] | (self.nearest(1).ravel()[pixels] > z + off)
        return looks, agrees

    def where_shown(self, p_world: Array, deviation: Array) -> _Shown:
        """Where it shows points `(n, 3)` of another image; `deviation` as in `confirms`."""
        T = self.T_world_camera
        rows, pixels, z = self.project(p_world)
        depth = np.where(self.own, 0.0, self.depth).ravel()[pixels]
        same = (depth > 0) & (np.abs(depth - z) <= self.off(z, deviation[rows], 3.0))
        rows, depth, z = rows[same], depth[same], z[same]
        rays = p_world[rows] - T[:3, 3]
        far = np.linalg.norm(rays, axis=1)
        moved = rays * (depth / z - 1)[:, None]
        noise = self.sensor.deviation(z) * far / z
        return _Shown(rows, moved, self.sensor.systematic(far), noise)

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


def _continuity(depth: Array, sensor: SensorErrors) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """In how many of twelve ways pixels `(H, W)` continue what is beside them, and how many of
    their eight neighbours are about as far away.

    On a plane the inverse depth is linear in the pixels: it is compared with the mean of any two
    opposite neighbours (four ways), and with what any two in a line beside it lead to (eight).
    """
    known = depth > 0
    inverse_depth = np.pad(np.where(known, 1 / np.where(known, depth, 1.0), np.nan), 2)
    inverse_depth[inverse_depth == 0] = np.nan
    height, width = depth.shape
    within = _ODD_DEVIATIONS * sensor.deviation(depth) + _ODD_LEAST
    limit = within / np.maximum(depth, 1e-6) ** 2
    similar = (within + _ALIKE_SHARE * depth) / np.maximum(depth, 1e-6) ** 2
    here = inverse_depth[2:-2, 2:-2]

    def at(dv: int, du: int) -> Array:
        return np.asarray(inverse_depth[2 + dv : 2 + dv + height, 2 + du : 2 + du + width])

    ways, alike = np.zeros((2, *depth.shape), dtype=np.int64)
    with np.errstate(invalid="ignore"):
        for dv, du in ((0, 1), (1, 0), (1, 1), (1, -1)):
            one, other = at(dv, du), at(-dv, -du)
            ways += np.abs((one + other) / 2 - here) <= limit
            for near, sign in ((one, 1), (other, -1)):
                ways += np.abs(2 * near - at(2 * sign * dv, 2 * sign * du) - here) <= limit
                alike += np.abs(near - here) <= similar
    return ways, alike


def _related(views: Sequence[_View], sensor: SensorErrors) -> None:
    """Tell each image by how much others of the same scene may misplace what it shows.

    An error E of a camera in its frame moves a point that it sees from pose A by e_A = R_A dt +
    (R_A w) x (p - c_A) + s (p - c_A), so that two images of one camera disagree by
    |e_A - e_B| <= 2 sin(phi / 2) (|dt| + |w| d) + (|w| + s) |c_A - c_B|, phi being the angle
    between their poses and d the distance from camera A; those of two cameras by the sum of both.
    """
    scale = sensor.depth_scale / (1 - sensor.depth_scale)
    for view in views:
        turn = base = 0.0
        alone = True
        for other in views:
            if other.camera != view.camera:
                alone = False
                continue
            R, R_other = view.T_world_camera[:3, :3], other.T_world_camera[:3, :3]
            turn = max(turn, 2 * np.sin(angle_between(R, R_other) / 2))
            moved = view.T_world_camera[:3, 3] - other.T_world_camera[:3, 3]
            base = max(base, float(np.linalg.norm(moved)))

        height, width = view.depth.shape
        corners = np.array([[u, v, 1.0] for u in (0, width) for v in (0, height)])
        # Rays are at most so much longer than their depth.
        slant = np.linalg.norm(corners @ np.linalg.inv(view.intrinsics).T, axis=1).max()

        def disagreement(
            z: Array, turn: float = turn, base: float = base, alone: bool = alone,
            slant: float = slant,
        ) -> Array:  # fmt: skip
            # A point is no farther from the other camera than its ray here and the base.
            far = slant * z + base
            if not alone:
                return 2 * sensor.systematic(far)
            rotated = turn * (sensor.hand_eye + sensor.hand_eye_angle * far)
            return np.asarray(rotated + (sensor.hand_eye_angle + scale) * base)

        view.disagreement = disagreement


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
    views = _views(demonstration, robot, waypoints, config)
    own = _OwnBody(demonstration, robot, held, grasped)
    _prepare(views, own, config)
    _check_agreement(views, config)
    pixels = _scene_pixels(views, config)
    cells = _merged(pixels, views, config)
    reached = cKDTree(demonstration.steps.measured_Ts_world_tool[:, :3, 3])
    near = reached.query(cells.points, distance_upper_bound=config.reach)[0] <= config.reach
    keep = near & ~_moved_away(cells, views, config)
    for each in grasped:
        T = demonstration.steps.measured_Ts_world_tool[each.waypoints[0]]
        p_tool = (cells.points - T[:3, 3]) @ T[:3, :3]
        before = cells.last < each.waypoints[0]
        margin = np.maximum(config.self_margin, cells.errors + each.error + _OWN_LEAST)
        keep &= ~(before & Hull(each.points).near(p_tool, margin))
    if not keep.any():
        raise InvalidInput(
            f"cloud: expected something {config.near} to {config.far} m before the camera and "
            f"within {config.reach} m of the tool besides the robot, got nothing; look at the "
            "images, or change near, far or reach"
        )
    points, colours, errors = cells.points[keep], cells.colours[keep], cells.errors[keep]
    behind = np.zeros(len(points), dtype=bool)
    if config.unknown == "behind":
        filled, source = _filled(pixels, cells, keep, views, own, config)
        points = np.concatenate([points, filled])
        colours = np.concatenate([colours, cells.colours[source]])
        behind = np.append(behind, np.ones(len(filled), dtype=bool))
        errors = np.concatenate([errors, cells.errors[source]])
    return SceneCloud(points, colours, behind, config, config.inflation + errors)


def _views(
    demonstration: Demonstration,
    robot: RobotSpec,
    waypoints: Sequence[int] | None,
    config: CloudConfig,
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
    views = [_View(demonstration, name, t, config.sensor) for t in keys for name in cameras]
    _related(views, config.sensor)
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

    `systematic`, `deviation (n,)` [m]: how far they are off at most by what is the same in every
    image, and the standard deviation of their noise. `image (n,)` is the index of the image,
    `cell (n,)` the number of the cell.
    """

    points: Array
    colours: Image
    systematic: Array
    deviation: Array
    image: NDArray[np.int64]
    cell: NDArray[np.int64]


@dataclass(frozen=True)
class _Cells:
    """The cells that pixels fell into, by increasing number `(n,)`: mean point, mean colour.

    `errors (n,)` [m]: how far the mean is off at most. `last (n,)` is the last waypoint at which an
    image saw something in it.
    """

    numbers: NDArray[np.int64]
    points: Array
    colours: Image
    errors: Array
    last: NDArray[np.int64]


def _prepare(views: Sequence[_View], own: _OwnBody, config: CloudConfig) -> None:
    """Find each image's pixels of the robot itself, and drop those that show no surface."""
    sensor = config.sensor
    for view in views:
        shown = (view.depth > config.near) & (view.depth < config.far)
        p, _, z, far = view.points(shown)
        # The robot's own pixels are off as well.
        off = sensor.systematic(far) + sensor.noise_bound(z) * far / z
        margin = np.maximum(config.self_margin, _OWN_LEAST + off)
        view.own[shown] = own.covers(p, view.waypoint, margin, unsure=1.0)
    if sensor.flying:
        _drop_unreal(views, sensor)


def _check_agreement(views: Sequence[_View], config: CloudConfig) -> None:
    """Return if the images of each camera show the same surfaces, or warn if not quite.

    What counts is the median by which depths differ from those that another image leads to, and
    what is declared of the sensor explains. It finds only what differs between two poses; what
    moved before the camera differs as well, but not between most images.

    Raises:
        Mismatch: most don't: the camera isn't where it is recorded to be.
    """
    worst, explained, camera = 0.0, 0.0, ""
    pairs, contradicting = 0, 0
    for a, b in itertools.combinations(views, 2):
        if a.camera != b.camera:
            continue
        some = np.zeros(a.depth.shape, dtype=bool)
        some[::_SPARSE, ::_SPARSE] = True
        some &= (a.depth > config.near) & (a.depth < config.far) & ~a.own
        p, _, _, _ = a.points(some)
        rows, pixels, z = b.project(p)
        depth = np.where(b.own, 0.0, b.depth).ravel()[pixels]
        shown = depth > 0
        if shown.sum() < _FEWEST:
            continue
        z = z[shown]
        found = float(np.median(np.abs(depth[shown] - z)))
        expected = float(np.median(b.off(z, config.sensor.deviation(z), 1.0)))
        if found - expected > worst - explained:
            worst, explained, camera = found, expected, a.camera
        pairs += 1
        contradicting += found > expected + float(np.median(_tolerance(z, config.voxel)))
    if pairs >= _FEWEST_PAIRS and contradicting > _MOST * pairs:
        raise Mismatch(
            f"camera {camera!r}: {contradicting} of {pairs} pairs of its images contradict each "
            f"other from where they are said to be taken, by up to {worst * 1e3:.0f} mm; calibrate "
            "the camera, and see whether it is recorded on what it is mounted on, tool or world"
        )
    if worst > explained:
        _log.warning(
            "camera %r: images differ by %.1f mm, what is declared explains %.1f mm; if nothing "
            "moved, calibrate it or declare more (--hand-eye-error, --depth-scale-error)",
            camera, worst * 1e3, explained * 1e3,
        )  # fmt: skip


def _scene_pixels(views: Sequence[_View], config: CloudConfig) -> _Pixels:
    """What images show besides the robot, once they are prepared."""
    sensor = config.sensor
    found = []
    for index, view in enumerate(views):
        shown = (view.depth > config.near) & (view.depth < config.far) & ~view.own
        p, colours, z, far = view.points(shown)
        systematic, deviation = sensor.systematic(far), sensor.deviation(z) * far / z
        if sensor != SensorErrors():
            others = [other for other in views if other is not view]
            p, systematic, deviation = _agreed(p, systematic, deviation, others)
        found.append((p, colours, systematic, deviation, np.full(len(p), index)))
    p, colours, systematic, deviation, image = (
        np.concatenate(arrays) for arrays in zip(*found, strict=True)
    )
    cell = _cell_numbers(p, config.voxel)
    return _Pixels(p, colours, systematic, deviation, image, cell)


def _agreed(
    p: Array, systematic: Array, deviation: Array, others: Sequence[_View]
) -> tuple[Array, Array, Array]:
    """Points `(n, 3)` of an image at the mean of where it and other images show them.

    What is off by least counts most. As the points go what they are off, as `_Pixels` has it: a
    mean is off by no more than the mean of the systematic errors, and noise is independent.
    """
    weight = 1 / (systematic**2 + deviation**2 + _LEAST_OFF**2)
    total, moved = weight.copy(), np.zeros_like(p)
    means, squares = weight * systematic, (weight * deviation) ** 2
    for other in others:
        found = other.where_shown(p, deviation)
        weight = 1 / (found.systematic**2 + found.deviation**2 + _LEAST_OFF**2)
        total[found.rows] += weight
        moved[found.rows] += weight[:, None] * found.moved
        means[found.rows] += weight * found.systematic
        squares[found.rows] += (weight * found.deviation) ** 2
    return p + moved / total[:, None], means / total, np.sqrt(squares) / total


def _drop_unreal(views: Sequence[_View], sensor: SensorErrors) -> None:
    """Take away the depth of pixels that show no surface.

    A pixel that doesn't continue what is beside it goes if other images look there unhindered and
    no more of them show it than don't, or than would by chance; where hardly one looks there, only
    if next to nothing beside it is as far away. A thing thinner than a pixel, seen in most images,
    stays, and so does what is seen once but as a line or a patch.
    """
    unreal = []
    for view in views:
        ways, alike = _continuity(view.depth, sensor)
        odd = (view.depth > 0) & ~view.own & (ways < _CONTINUES)
        p, _, z, far = view.points(odd)
        deviation = sensor.deviation(z) * far / z
        looking, agreeing = np.zeros((2, len(p)), dtype=np.int64)
        for other in views:
            if other is view:
                continue
            looks, agrees = other.confirms(p, deviation)
            looking += looks
            agreeing += agrees
        # A pixel that shows nothing lies anywhere along its ray, as do nine beside it elsewhere.
        chance = np.minimum(9 * sensor.flying * 2 * view.off(z, deviation, 2.0) / z, 1.0)
        lucky = binom.ppf(1 - _CHANCE, np.maximum(looking, 1), chance)
        denied = (agreeing <= lucky) | (2 * agreeing <= looking)
        lone = ((alike < _ALIKE) | (ways < _IN_LINE))[odd] & (agreeing <= lucky)
        mask = np.zeros(view.depth.shape, dtype=bool)
        mask[odd] = np.where(looking > 1, denied, lone)
        unreal.append(mask)
    for view, mask in zip(views, unreal, strict=True):
        view.depth[mask] = 0.0
        view.forget()


def _merged(pixels: _Pixels, views: Sequence[_View], config: CloudConfig) -> _Cells:
    order = np.argsort(pixels.cell, kind="stable")
    numbers, first, counts = np.unique(pixels.cell[order], return_index=True, return_counts=True)
    if not len(numbers):
        none = np.zeros(0)
        return _Cells(numbers, pixels.points, pixels.colours, none, numbers)
    points = np.add.reduceat(pixels.points[order], first) / counts[:, None]
    colours = np.add.reduceat(pixels.colours[order].astype(np.int64), first) // counts[:, None]
    waypoints = np.array([view.waypoint for view in views])
    last = np.maximum.reduceat(waypoints[pixels.image[order]], first)
    errors = np.zeros(len(numbers))
    if config.sensor != SensorErrors():
        # A mean is off by no more than the mean error; what was agreed on is no more certain for
        # being said by several images.
        off = pixels.systematic + 3 * pixels.deviation
        errors = np.add.reduceat(off[order], first) / counts
    return _Cells(numbers, points, colours.astype(np.uint8), errors, last)


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
    views = _views(demonstration, robot, held_at, config)
    _prepare(views, own, config)
    Ts = demonstration.steps.measured_Ts_world_tool
    T_grasp = Ts[held_at[0]]
    if before is None:
        # In other images it is elsewhere.
        pixels = _scene_pixels(views[:1], config)
        candidates, errors = pixels.points, pixels.systematic + 3 * pixels.deviation
        if config.sensor.flying:
            # Its corners are elsewhere in other images, which is taken for a pixel that flies.
            far = np.linalg.norm(candidates - views[0].T_world_camera[:3, 3], axis=1)
            errors = errors + far / views[0].intrinsics[0, 0]
    else:
        seen = fuse_cloud(
            demonstration, robot, held, before, dataclasses.replace(config, unknown="free")
        )
        candidates, errors = seen.points, seen.inflation - config.inflation
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
    # It may have slipped in the grasp on the way.
    mine = gone | ((rode.mean() <= config.voxel + IN_GRASP_SLIP) & better)
    if not mine.any():
        return None
    points = p_tool[mine]
    if before is None and config.unknown == "behind":
        p_camera = (inverse(T_grasp) @ views[0].T_world_camera)[:3, 3]
        # Across the tool's axis: along the rays themselves it would get a deeper bottom too.
        across = (points - p_camera) * [1.0, 1.0, 0.0]
        across *= config.behind / np.maximum(np.linalg.norm(across, axis=1, keepdims=True), 1e-6)
        points = np.concatenate([points, points + across])
    return GraspedObject(points, held_at, float(errors[near][mine].max()))


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


def _surface_distance(shape: BodyShape, p: Array) -> Array:
    """The distance `(n,)` [m] of points in a shape's frame to its surface, from either side."""
    if isinstance(shape, MeshShape):
        return np.linalg.norm(nearest_on(np.array(shape.mesh().triangles), p) - p, axis=1)
    if shape.kind == "sphere":
        return np.abs(np.linalg.norm(p, axis=1) - shape.size[0])
    if shape.kind == "box":
        over = np.abs(p) - np.array(shape.size) / 2
    else:
        radius, length = shape.size
        over = np.stack([np.hypot(p[:, 0], p[:, 1]) - radius, np.abs(p[:, 2]) - length / 2], axis=1)
    outside = np.linalg.norm(np.maximum(over, 0.0), axis=1)
    return np.where(outside > 0, outside, -over.max(axis=1))
