"""Radii from the scene's geometry instead of a person's judgement."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.stats import qmc

from sart_toolkit.collision.cloud_world import CloudWorld
from sart_toolkit.collision.model import PairDistance, PlacedModel
from sart_toolkit.collision.phases import Phase
from sart_toolkit.collision.world import CollisionWorld
from sart_toolkit.data.records import (
    ROTATION_PER_METRE,
    Annotation,
    Demonstration,
    PrecisionSphere,
    convergence_waypoint,
)
from sart_toolkit.errors import InvalidInput, MotionRejected, Unreachable
from sart_toolkit.poses import Array, check_positive, pose
from sart_toolkit.robots.model import RobotModel

_BISECTIONS = 40
_SHRINK = 0.9
# A pose is within reach if no joint is nearer to its limit than this [rad], and the Jacobian's
# smallest singular value (metres and radians alike) no less: elsewhere small motions of the tool
# take large ones of the joints.
_JOINT_MARGIN = 0.05
_LEAST_SINGULAR_VALUE = 0.03
_LARGEST_STEP = 1.5
# Unproven pairs keep this [m] more at the draws that are aimed at them.
_ARM_MARGIN = 0.005
# By this many radii, at most, two bodies come nearer within a sphere; by half that usually.
_STEEPEST = 5.0
# A sphere of this radius [m] or more is probed in full, the smallest at a quarter of the poses.
_WIDE, _FEWEST_PROBES = 0.06, 0.25
# [m] What augmentation keeps free by default, and bodies' stillness, and 0.1 mm for a path that is
# not quite the line between its ends.
_BESIDES_TRACKING = 0.0004


@dataclass(frozen=True)
class SuggestConfig:
    """How radii are suggested.

    `margin` [m] stays free everywhere: room for augmentation's own margin, the tracking error and
    the stillness of bodies that it proves for (0.7 mm by default on our simulators). No radius is
    below `min_radius` or above `max_radius` [m]; where waypoints are chosen, a radius is no less
    than the previous one divided by `shrink`, if the demonstration allows that.
    `rotation_per_metre` [rad/m] is the augmentation's nu_r; `probes` is the number of poses at
    which the whole robot is checked in a wide sphere.
    """

    margin: float = 0.0008
    min_radius: float = 0.004
    max_radius: float = 0.15
    shrink: float = 2.0
    rotation_per_metre: float = ROTATION_PER_METRE
    probes: int = 24

    def __post_init__(self) -> None:
        for name in ("margin", "min_radius", "max_radius"):
            check_positive(name, getattr(self, name), "m")
        if not (np.isfinite(self.rotation_per_metre) and self.rotation_per_metre >= 0):
            raise InvalidInput(
                f"rotation_per_metre: expected a finite number >= 0, got {self.rotation_per_metre}"
            )
        if self.max_radius < self.min_radius:
            raise InvalidInput(
                f"max_radius {self.max_radius} m is below min_radius {self.min_radius} m"
            )
        if not self.shrink > 1:
            raise InvalidInput(f"shrink: expected a factor above 1, got {self.shrink}")
        if self.probes < 1:
            raise InvalidInput(f"probes: expected at least 1, got {self.probes}")

    @classmethod
    def for_tracking_error(cls, tracking_error: float, **others: Any) -> SuggestConfig:
        """With a margin of what augmentation proves on a robot of a tracking error [m].

        Spheres for a simulator would leave no room on a robot that follows less closely.
        """
        return cls(margin=round(_BESIDES_TRACKING + tracking_error, 9), **others)


@dataclass(frozen=True)
class Suggestion:
    """A suggested radius [m] (0: no room), the clearance behind it, and what limits it.

    `clearance` [m] is that of the pair of bodies that bounds the radius, or of the nearest pair
    where something else does; `None` where it was not needed: the demonstration's phase leaves no
    room.
    """

    radius: float
    clearance: float | None
    limited_by: str


@dataclass(frozen=True)
class Gap:
    """A convex part of the tool and a convex obstacle, their names and distance [m].

    `normal (3,)`: the unit vector from the obstacle's nearest point to the part's, world frame.
    `points (n, 3)`: points whose hull encloses the part, from the tool frame's origin, world axes;
    `support`: how far [m] the obstacle reaches along the normal, from the same origin.
    """

    part: str
    obstacle: str
    distance: float
    normal: Array
    points: Array
    support: float

    @staticmethod
    def of(placed: PlacedModel, pair: int, found: PairDistance, T_world_joint: Array) -> Gap:
        """The gap of a tool body's pair, its last arm joint being at `T_world_joint (4, 4)`."""
        p_tool = (T_world_joint @ placed.T_joint_tool)[:3, 3]
        normal = found.p_a - found.p_b
        length = float(np.linalg.norm(normal))
        # Bodies that touch have no plane between them; nothing fits then.
        normal = normal / length if length > 1e-9 else np.zeros(3)
        part = placed.parts[placed.pairs[pair][0]]
        points = part.points @ T_world_joint[:3, :3].T + T_world_joint[:3, 3] - p_tool
        support = float(normal @ (found.p_b - p_tool)) + float(placed.slip[pair])
        return Gap(found.a, found.b, found.distance, normal, points, support)

    def fits(self, radius: float, margin: float, rotation_per_metre: float) -> bool:
        """Whether the part keeps `margin` [m] at every pose within `radius` and nu radius.

        One of two proofs is enough. No point moves farther than r + 2 rho sin(nu r / 2), rho being
        the farthest point's distance from the tool's origin (shared/reference, section 4). And the
        plane across the gap still separates the two if no point x, turned towards it by up to nu r
        and moved by up to r, comes nearer than the margin:
        |x| cos(alpha + nu r) - r >= support + margin, alpha being the angle from x to the normal.
        """
        return self._distance_fits(radius, margin, rotation_per_metre) or self._plane_fits(
            radius, margin, rotation_per_metre
        )

    def limited(self, best: Suggestion, config: SuggestConfig) -> Suggestion:
        """`best`, or less where this gap allows only that."""
        if self.fits(best.radius, config.margin, config.rotation_per_metre):
            return best
        r = certified_radius(self, config.margin, config.rotation_per_metre, best.radius)
        return Suggestion(r, self.distance, f"{self.part} / {self.obstacle}")

    def _distance_fits(self, radius: float, margin: float, nu: float) -> bool:
        swing = 2 * self._reach * np.sin(min(nu * radius, np.pi) / 2)
        return bool(radius + swing + margin <= self.distance)

    def _plane_fits(self, radius: float, margin: float, nu: float) -> bool:
        lengths, angles = self._polar
        lowest = lengths * np.cos(np.minimum(angles + nu * radius, np.pi))
        return bool(lowest.min() - radius >= self.support + margin)

    @functools.cached_property
    def _reach(self) -> float:
        return float(np.linalg.norm(self.points, axis=1).max())

    @functools.cached_property
    def _polar(self) -> tuple[Array, Array]:
        """Each point's distance from the tool's origin [m] and angle [rad] from the normal."""
        along = self.points @ self.normal
        lengths = np.linalg.norm(self.points, axis=1)
        across = np.sqrt(np.maximum(lengths**2 - along**2, 0.0))
        return lengths, np.arctan2(across, along)


def certified_radius(gap: Gap, margin: float, rotation_per_metre: float, largest: float) -> float:
    """The largest r [m] for which a tool part is proved clear at every pose drawn within r.

    Args:
        gap: part and obstacle at the waypoint.
        margin: distance [m] that stays free.
        rotation_per_metre: nu [rad/m].
        largest: upper bound [m] of the answer.
    """
    if not gap.fits(0.0, margin, rotation_per_metre):
        return 0.0
    if gap.fits(largest, margin, rotation_per_metre):
        return largest
    low, high = 0.0, largest
    for _ in range(_BISECTIONS):
        middle = 0.5 * (low + high)
        if gap.fits(middle, margin, rotation_per_metre):
            low = middle
        else:
            high = middle
    return low


def proved_radius(world: CollisionWorld, t: int, config: SuggestConfig) -> Suggestion:
    """The largest radius about waypoint `t` for which the tool is proved clear of obstacles.

    Args:
        world: where the obstacles are.
        t: the waypoint.
        config: margins and limits.
    """
    placed, nu = world.placed(t), config.rotation_per_metre
    q = world.demonstration.steps.joint_positions[t]
    T_world_joint = placed.joint_poses(q)[-1]
    last = len(world.kinematics.spec.arm_joints)
    tool = [part.points for part in placed.parts if part.joint == last]
    p_tool = placed.T_joint_tool[:3, 3]
    reach = float(np.linalg.norm(np.concatenate(tool) - p_tool, axis=1).max())
    best = Suggestion(config.max_radius, None, "max_radius")
    pairs = placed.tool_pairs()
    distances = np.array(placed.pair_distances(q, pairs))
    for i in np.argsort(distances, kind="stable"):
        if best.clearance is None:
            best = dataclasses.replace(best, clearance=float(distances[i]))
        # No point of the tool comes as far as the pairs from here on.
        swept = best.radius + 2 * reach * np.sin(min(nu * best.radius, np.pi) / 2)
        if distances[i] >= swept + config.margin:
            break
        # Any point of a cloud that is farther away than this leaves more room than the nearest.
        within = nu * reach * max(float(distances[i]), 0.0)
        for found in placed.witnesses(q, pairs[i], within):
            best = Gap.of(placed, pairs[i], found, T_world_joint).limited(best, config)
    return best


def suggest_radius(
    world: CollisionWorld,
    demonstration: Demonstration,
    t: int,
    config: SuggestConfig | None = None,
) -> Suggestion:
    """The largest radius around waypoint `t` that keeps the robot clear.

    Tool bodies are proved clear of the scene for every pose that can be drawn. The whole robot, its
    reach, and the waypoint that a segment of this radius starts from are checked, the robot at
    `probes` extreme poses, and the radius shrunk until all pass.

    Args:
        world: where the obstacles are.
        demonstration: the recorded demonstration.
        t: the key waypoint.
        config: margins and limits.

    Raises:
        InvalidInput: no such waypoint.
    """
    config = config or SuggestConfig()
    if not 0 <= t < len(demonstration) - 1:
        raise InvalidInput(f"waypoint {t}: expected 0 to {len(demonstration) - 2}; choose another")
    room = _room_before_event(demonstration, world.phases, t)
    if room is not None and room.radius < config.min_radius:
        return room
    unfit = _unfit(world, t)
    if unfit is not None:
        return Suggestion(0.0, None, unfit)
    best = proved_radius(world, t, config)
    if room is not None and room.radius < best.radius:
        best = dataclasses.replace(room, clearance=best.clearance)
    if best.radius < config.min_radius:
        return dataclasses.replace(best, radius=0.0)
    q_key = demonstration.steps.joint_positions[t]
    unproven = _unproven_pairs(world.placed(t), q_key, _STEEPEST * best.radius + _ARM_MARGIN)
    while best.radius >= config.min_radius:
        problem = _probe(world, demonstration, t, best.radius, config, unproven)
        if problem is None:
            return best
        best = Suggestion(best.radius * _SHRINK, best.clearance, problem)
    return Suggestion(0.0, best.clearance, best.limited_by)


def _unfit(world: CollisionWorld, t: int) -> str | None:
    """Why nothing can be proved at waypoint `t`, or None."""
    moving = world.moving(t)
    return world.unknown(t) if moving is None else f"{moving} moves"


def _probe(
    world: CollisionWorld,
    demonstration: Demonstration,
    t: int,
    radius: float,
    config: SuggestConfig,
    unproven: Sequence[_UnprovenPair],
) -> str | None:
    """What goes wrong at one of the extreme poses of a radius, or at its t*; or None."""
    steps, model = demonstration.steps, world.kinematics
    T_key, q_key = steps.measured_Ts_world_tool[t], steps.joint_positions[t]
    t_star = convergence_waypoint(demonstration, PrecisionSphere(t, T_key, radius))
    unfit = _unfit(world, t_star)
    if unfit is not None:
        return f"{unfit} at waypoint {t_star}"
    pair = world.too_close(t_star, steps.commanded_joint_positions[t_star], config.margin)
    if pair is not None:
        return f"{pair} at waypoint {t_star}"
    reached = functools.partial(_reached, model, T_key, q_key, radius, config)
    problem = _directed(world.placed(t), unproven, q_key, radius, config, reached)
    if problem is not None:
        return problem
    # The arm hardly moves in a small sphere.
    count = int(np.ceil(config.probes * min(1.0, max(radius / _WIDE, _FEWEST_PROBES))))
    for direction, axis in _directions(count):
        q = reached(direction, axis)
        if isinstance(q, str):
            return q
        pair = world.too_close(t, q, config.margin)
        if pair is not None:
            return pair
    return None


def _reached(
    model: RobotModel,
    T_key: Array,
    q_key: Array,
    radius: float,
    config: SuggestConfig,
    direction: Array,
    axis: Array,
) -> Array | str:
    """Joints `(n,)` for the extreme pose in a direction, turned about an axis; or what forbids it.

    `direction (3,)` is in the world, `axis (3,)` in the tool frame; both are unit vectors.
    """
    T = T_key @ pose(rotvec=config.rotation_per_metre * radius * axis)
    T[:3, 3] = T_key[:3, 3] + radius * direction
    try:
        q = model.ik(T, q_key, _LARGEST_STEP)
    except (Unreachable, MotionRejected):
        return "reach"
    if min((q - model.lower).min(), (model.upper - q).min()) < _JOINT_MARGIN:
        return "joint limit"
    if np.linalg.svd(model.jacobian(q), compute_uv=False)[-1] < _LEAST_SINGULAR_VALUE:
        return "singularity"
    return q


@dataclass(frozen=True)
class _UnprovenPair:
    """Two bodies without a proof: their nearest pair by index, how the tool's motion changes it.

    `distance` [m] is that at the waypoint, `slope (6,)` its gradient by the tool's motion (linear,
    then turning [m/rad]) in the tool frame.
    """

    names: tuple[str, str]
    pair: int
    distance: float
    slope: Array

    @functools.cached_property
    def straight(self) -> float:
        """The greatest slope by moving, metres a metre."""
        return float(np.linalg.norm(self.slope[:3]))

    @functools.cached_property
    def turning(self) -> float:
        """The greatest slope by turning [m/rad]."""
        return float(np.linalg.norm(self.slope[3:]))

    @staticmethod
    def of(placed: PlacedModel, pair: int, distance: float, q: Array) -> _UnprovenPair:
        # The tool's motion is J dq.
        J = placed.kinematics.jacobian(q)
        slope = np.linalg.lstsq(J.T, placed.gradient(q, pair), rcond=None)[0]
        return _UnprovenPair(
            placed.names(pair), pair, distance, np.asarray(slope, dtype=np.float64)
        )


def _unproven_pairs(placed: PlacedModel, q_key: Array, within: float) -> list[_UnprovenPair]:
    """Every two bodies `within` [m] that have no proof, arm against arm, say, as at a waypoint."""
    proved = set(placed.tool_pairs())
    unproven = [k for k in placed.near_pairs(q_key, within) if k not in proved]
    distances = dict(zip(unproven, placed.pair_distances(q_key, unproven), strict=True))
    nearest: dict[tuple[str, str], int] = {}
    for k in sorted(unproven, key=lambda k: distances[k], reverse=True):
        nearest[placed.names(k)] = k
    near = [k for k in nearest.values() if distances[k] <= within]
    return [_UnprovenPair.of(placed, k, distances[k], q_key) for k in near]


def _directed(
    placed: PlacedModel,
    unproven: Sequence[_UnprovenPair],
    q_key: Array,
    radius: float,
    config: SuggestConfig,
    reached: Callable[[Array, Array], Array | str],
) -> str | None:
    """The names of a pair that a draw aimed at it brings too close; None if there is none.

    Checked are the draw that brings a pair nearest by its distance's gradient at the waypoint, and,
    where that came half the way, the one that does so by the gradient found there.
    """
    angle = config.rotation_per_metre * radius

    def approach(each: _UnprovenPair) -> float:
        """By how much [m] the pair comes nearer within the sphere, by its slope."""
        return each.straight * radius + each.turning * angle

    # The likeliest first: a radius that is too large is then soon found to be.
    for each in sorted(unproven, key=lambda each: each.distance - approach(each)):
        aimed, q = each, q_key
        for _ in range(2):
            # Nowhere near, even if it all got twice as steep.
            if each.distance > 2 * approach(aimed) + _ARM_MARGIN:
                break
            R = placed.kinematics.fk(q)[:3, :3]
            found = reached(
                -R @ aimed.slope[:3] / max(aimed.straight, 1e-12),
                -aimed.slope[3:] / max(aimed.turning, 1e-12),
            )
            if isinstance(found, str):
                # What can't be reached can't collide.
                break
            q = found
            distance = placed.pair_distances(q, [each.pair])[0]
            if distance < config.margin + _ARM_MARGIN:
                return " / ".join(each.names)
            if distance > each.distance / 2:
                break
            aimed = _UnprovenPair.of(placed, each.pair, each.distance, q)
    return None


@functools.cache
def _directions(count: int) -> list[tuple[Array, Array]]:
    """Pairs of unit vectors `(3,)` spread evenly: direction of the offset, axis of the turn."""
    # Halton points of the four-dimensional square.
    points = qmc.Halton(4, scramble=False).random(count)
    return list(zip(_sphere_points(points[:, :2]), _sphere_points(points[:, 2:]), strict=True))


def _sphere_points(uv: Array) -> Array:
    """Unit vectors `(n, 3)`, area-uniform for uniform `uv (n, 2)`."""
    z, psi = 1 - 2 * uv[:, 0], 2 * np.pi * uv[:, 1]
    flat = np.sqrt(np.maximum(0.0, 1 - z**2))
    return np.stack([flat * np.cos(psi), flat * np.sin(psi), z], axis=1)


def _room_before_event(
    demonstration: Demonstration, phases: Sequence[Phase], t: int
) -> Suggestion | None:
    """The largest radius that the demonstration leaves before its phase ends; None if it doesn't.

    In a contact there is no room at all.
    """
    if phases[t].contacts:
        return Suggestion(0.0, None, "contact " + " / ".join(min(phases[t].contacts)))
    event = next((s for s in range(t, len(phases)) if phases[s] != phases[t]), None)
    if event is None:
        return None
    p = demonstration.steps.measured_Ts_world_tool[t:event, :3, 3]
    farthest = float(np.linalg.norm(p - p[0], axis=1).max())
    what = phases[t].change(phases[event])
    # A waypoint must lie outside of the sphere: a micrometre is left for that.
    return Suggestion(max(0.0, farthest - 1e-6), None, f"{what} at waypoint {event}")


def suggestion_settings(world: CollisionWorld, config: SuggestConfig) -> dict[str, Any]:
    """How radii are suggested, as JSON values; from a cloud, how that is made too."""
    settings = dataclasses.asdict(config)
    if isinstance(world, CloudWorld):
        settings["cloud"] = world.config.to_json()
    return settings


def suggest_annotation(
    demonstration: Demonstration,
    world: CollisionWorld,
    waypoints: Sequence[int] | None = None,
    config: SuggestConfig | None = None,
    progress: Callable[[int], None] | None = None,
) -> Annotation:
    """Precision spheres for a demonstration, their radii from where its obstacles were.

    Without `waypoints`, spheres tile the free part in a funnel. The first is at the start. Each
    next one is at the last waypoint, up to the convergence waypoint of the previous one, with a
    radius of no less than the previous one's divided by `shrink`; where radii shrink faster than
    that from one waypoint to the next, at that next one. Waypoints without room for `min_radius`
    are left out. A sphere is no larger than lets the tool rejoin the demonstration before the next
    grasp, release or contact; an object in the grasp counts as part of the tool.

    Args:
        demonstration: the recorded demonstration.
        world: where the obstacles were.
        waypoints: key waypoints, or `None` to choose them.
        config: margins and limits.
        progress: called with the waypoint reached.

    Raises:
        InvalidInput: a waypoint is out of range or has no room, or no waypoint has room.
    """
    config = config or SuggestConfig()
    reached = progress or (lambda t: None)
    last = len(demonstration) - 1

    @functools.cache
    def sphere_at(t: int) -> tuple[Suggestion, PrecisionSphere | None]:
        found = suggest_radius(world, demonstration, t, config)
        if found.radius < config.min_radius:
            return found, None
        # Whole micrometres, rounded down: coal's last digits depend on what it computed before.
        radius, clearance = (
            None if x is None else float(np.floor(x * 1e6) / 1e6)
            for x in (found.radius, found.clearance)
        )
        assert radius is not None
        T_key = demonstration.steps.measured_Ts_world_tool[t]
        return found, PrecisionSphere(
            t, T_key, radius, "ball", "suggested", clearance, found.limited_by
        )

    spheres = []
    if waypoints is not None:
        for t in sorted(set(waypoints)):
            found, sphere = sphere_at(t)
            reached(t)
            if sphere is None:
                reason = found.limited_by
                if found.clearance is not None:
                    reason += f", clearance {found.clearance * 1e3:.1f} mm"
                raise InvalidInput(
                    f"waypoint {t}: no room for a sphere of {config.min_radius * 1e3:.1f} mm "
                    f"({reason}); choose another"
                )
            spheres.append(sphere)
    else:
        t = 0
        while t < last:
            _, sphere = sphere_at(t)
            reached(t)
            if sphere is None:
                t += 1
                continue
            spheres.append(sphere)
            ahead = convergence_waypoint(demonstration, sphere)
            if ahead >= last:
                break
            least = sphere.radius / config.shrink
            wide = (u for u in range(ahead, t, -1) if sphere_at(u)[0].radius >= least)
            t = next(wide, t + 1)
    if not spheres:
        raise InvalidInput(
            f"no waypoint has room for a sphere of {config.min_radius * 1e3:.1f} mm; start the "
            "demonstration farther from the scene, or lower min_radius"
        )
    return Annotation(
        tuple(spheres),
        demonstration.content_hash(),
        settings=suggestion_settings(world, config),
    )
