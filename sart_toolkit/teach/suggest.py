"""Radii from the scene's geometry instead of from a person's eye."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.stats import qmc

from sart_toolkit.errors import InvalidInput, Unreachable
from sart_toolkit.poses import Array, check_positive, pose
from sart_toolkit.records import (
    ROTATION_PER_METRE,
    Annotation,
    Demonstration,
    PrecisionSphere,
    convergence_waypoint,
)
from sart_toolkit.robots.model import RobotModel
from sart_toolkit.robots.spec import RobotSpec
from sart_toolkit.scene.clearance import ClearanceModel
from sart_toolkit.scene.spec import SceneSpec

_BISECTIONS = 40
_SHRINK = 0.9


@dataclass(frozen=True)
class SuggestConfig:
    """How radii are suggested.

    `margin` [m] stays free everywhere; no radius is below `min_radius` or above `max_radius` [m];
    `rotation_per_metre` [rad/m] is the augmentation's nu_r; `probes` is the number of poses at
    which reach and the arm's own clearance are tried.
    """

    margin: float = 0.002
    min_radius: float = 0.004
    max_radius: float = 0.15
    rotation_per_metre: float = ROTATION_PER_METRE
    probes: int = 64

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
        if self.probes < 1:
            raise InvalidInput(f"probes: expected at least 1, got {self.probes}")


@dataclass(frozen=True)
class Suggestion:
    """A suggested radius [m] (0: no room), the clearance behind it, and what limits it.

    `clearance` [m] is `None` where it was not needed: the demonstration's phase leaves no room.
    """

    radius: float
    clearance: float | None
    limited_by: str


def certified_radius(
    clearance: float, reach: float, margin: float, rotation_per_metre: float, largest: float
) -> float:
    """The largest r [m] for which a body stays clear at every pose drawn within r.

    A pose within r and angle nu r of the waypoint moves no point of a body whose farthest point is
    rho from the tool centre by more than r + 2 rho sin(min(nu r, pi) / 2); the body is clear if
    that plus the margin is at most its clearance (shared/reference, section 4).

    Args:
        clearance: distance d [m] of the body to the scene at the waypoint.
        reach: rho [m].
        margin: distance [m] that stays free.
        rotation_per_metre: nu [rad/m].
        largest: upper bound [m] of the answer.
    """

    def fits(r: float) -> bool:
        swing = 2 * reach * np.sin(min(rotation_per_metre * r, np.pi) / 2)
        return bool(r + swing + margin <= clearance)

    if not fits(0.0):
        return 0.0
    if fits(largest):
        return largest
    low, high = 0.0, largest
    for _ in range(_BISECTIONS):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if fits(middle) else (low, middle)
    return low


def suggest_radius(
    clearances: ClearanceModel,
    q: Array,
    T_world_key: Array,
    Ts_world_body: Mapping[str, Array],
    config: SuggestConfig,
    carried: Collection[str] = (),
) -> Suggestion:
    """The largest radius around one waypoint that keeps the robot clear.

    Tool bodies are proved clear of the scene for every pose that can be drawn. Reach, and the arm's
    clearance from the scene and from the tool, are tried at `probes` extreme poses and the radius
    shrunk until all pass; the executed motion is checked later in any case.

    Args:
        clearances: robot and scene.
        q: joint configuration `(n,)` at the waypoint.
        T_world_key: tool pose `(4, 4)` there.
        Ts_world_body: where the scene's bodies were.
        config: margins and limits.
        carried: names of bodies in the gripper's grasp.
    """
    bodies = clearances.tool_clearances(q, Ts_world_body, carried)
    nearest = min(body.nearest.distance for body in bodies)
    best = Suggestion(config.max_radius, nearest, "max_radius")
    for body in bodies:
        pair = body.nearest
        r = certified_radius(
            pair.distance,
            body.reach,
            config.margin,
            config.rotation_per_metre,
            config.max_radius,
        )
        if r < best.radius:
            best = Suggestion(r, pair.distance, f"{pair.a} / {pair.b}")
    while best.radius >= config.min_radius:
        problem = _probe(clearances, q, T_world_key, Ts_world_body, best.radius, config, carried)
        if problem is None:
            return best
        best = Suggestion(best.radius * _SHRINK, best.clearance, problem)
    return Suggestion(0.0, best.clearance, best.limited_by)


def _probe(
    clearances: ClearanceModel,
    q: Array,
    T_world_key: Array,
    Ts_world_body: Mapping[str, Array],
    radius: float,
    config: SuggestConfig,
    carried: Collection[str],
) -> str | None:
    """What goes wrong at one of the extreme poses of a radius, or None."""
    # Halton points of the four-dimensional square: direction of the offset, axis of the turn.
    points = qmc.Halton(4, scramble=False).random(config.probes)
    directions, axes = _sphere_points(points[:, :2]), _sphere_points(points[:, 2:])
    angle = config.rotation_per_metre * radius
    for direction, axis in zip(directions, axes, strict=True):
        T = T_world_key @ pose(rotvec=angle * axis)
        T[:3, 3] = T_world_key[:3, 3] + radius * direction
        try:
            q_probe = clearances.model.ik(T, q)
        except Unreachable:
            return "reach"
        pair = clearances.arm_distance(q_probe, Ts_world_body, carried)
        if pair.distance < config.margin:
            return f"{pair.a} / {pair.b}"
    return None


def _sphere_points(uv: Array) -> Array:
    """Unit vectors `(n, 3)`, area-uniform for uniform `uv (n, 2)`."""
    z, psi = 1 - 2 * uv[:, 0], 2 * np.pi * uv[:, 1]
    flat = np.sqrt(np.maximum(0.0, 1 - z**2))
    return np.stack([flat * np.cos(psi), flat * np.sin(psi), z], axis=1)


@dataclass(frozen=True)
class _Phase:
    """What a waypoint has in common with its neighbours until the gripper or a contact changes."""

    gripper: float
    carried: frozenset[str]
    contacts: frozenset[tuple[str, str]]

    def change(self, after: _Phase) -> str:
        """What is other in the phase after this one."""
        if self.gripper != after.gripper:
            return "gripper command"
        if self.carried != after.carried:
            return "grasp of " + ", ".join(sorted(self.carried ^ after.carried))
        return "contact " + " / ".join(min(self.contacts ^ after.contacts))


def _phases(demonstration: Demonstration, robot: RobotSpec, scene: SceneSpec) -> list[_Phase]:
    commands = demonstration.steps.commanded_gripper
    phases = []
    for command, touching in zip(commands, demonstration.touching, strict=True):
        carried = scene.grasped(touching, robot.gripper.finger_links)
        contacts = scene.outer_contacts(touching, carried)
        phases.append(_Phase(round(float(command), 2), carried, contacts))
    # Before the first step nothing has been felt yet.
    return [dataclasses.replace(phases[1], gripper=phases[0].gripper), *phases[1:]]


def _room_before_event(
    demonstration: Demonstration, phases: Sequence[_Phase], t: int
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


def suggest_annotation(
    demonstration: Demonstration,
    robot: RobotSpec,
    scene: SceneSpec,
    waypoints: Sequence[int] | None = None,
    config: SuggestConfig | None = None,
    progress: Callable[[int], None] | None = None,
) -> Annotation:
    """Precision spheres for a demonstration, their radii from the scene.

    Without `waypoints`, spheres tile the free part: the first at the start, each next one at the
    convergence waypoint of the one before, or at the first later waypoint with room for
    `min_radius`. A sphere is no larger than lets the tool rejoin the demonstration before the next
    grasp, release or contact; an object in the grasp counts as part of the tool.

    Args:
        demonstration: what was shown; it must hold the poses of the scene's bodies.
        robot: the robot that was steered.
        scene: the task's scene.
        waypoints: key waypoints, or `None` to choose them.
        config: margins and limits.
        progress: called with the waypoint reached.

    Raises:
        InvalidInput: a waypoint is out of range or has no room, or no waypoint has room.
    """
    config = config or SuggestConfig()

    @functools.cache
    def clearances(gripper: float) -> ClearanceModel:
        return ClearanceModel(RobotModel(robot, scene.held, gripper), scene)

    steps = demonstration.steps
    last = len(demonstration) - 1
    phases = _phases(demonstration, robot, scene)

    def sphere_at(t: int) -> tuple[Suggestion, PrecisionSphere | None]:
        T_key = steps.measured_Ts_world_tool[t]
        room = _room_before_event(demonstration, phases, t)
        if room is not None and room.radius < config.min_radius:
            found = room
        else:
            bodies = {name: Ts[t] for name, Ts in demonstration.body_Ts_world.items()}
            opening = clearances(round(float(steps.measured_gripper[t]), 2))
            found = suggest_radius(
                opening, steps.joint_positions[t], T_key, bodies, config, phases[t].carried
            )
            if room is not None and room.radius < found.radius:
                found = dataclasses.replace(room, clearance=found.clearance)
        if progress is not None:
            progress(t)
        if found.radius < config.min_radius or found.clearance is None:
            return found, None
        # Whole micrometres, rounded down: coal's last digits depend on what it computed before.
        radius, clearance = (np.floor(x * 1e6) / 1e6 for x in (found.radius, found.clearance))
        return found, PrecisionSphere(
            t, T_key, float(radius), "ball", "suggested", float(clearance), found.limited_by
        )

    spheres = []
    if waypoints is not None:
        for t in sorted(set(waypoints)):
            if not 0 <= t < last:
                raise InvalidInput(f"waypoint {t}: expected 0 to {last - 1}; choose another")
            found, sphere = sphere_at(t)
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
            if sphere is None:
                t += 1
                continue
            spheres.append(sphere)
            ahead = convergence_waypoint(demonstration, sphere)
            if ahead >= last:
                break
            t = ahead
    if not spheres:
        raise InvalidInput(
            f"no waypoint has room for a sphere of {config.min_radius * 1e3:.1f} mm; start the "
            "demonstration farther from the scene, or lower min_radius"
        )
    return Annotation(
        tuple(spheres), demonstration.content_hash(), settings=dataclasses.asdict(config)
    )
