"""Whether generated motions and suggested radii keep what is promised of them, by the thousand."""

from __future__ import annotations

import collections
import functools
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from dataclasses import asdict, dataclass, field
from pathlib import Path
from types import MappingProxyType
from typing import Any, Protocol

import numpy as np
from scipy.spatial import cKDTree

from sart_toolkit.augment.config import AugmentConfig
from sart_toolkit.augment.segments import KEPT, SegmentMaker, SegmentPlanner
from sart_toolkit.backends.interface import Backend
from sart_toolkit.errors import InvalidInput, Mismatch, MotionRejected, Unreachable
from sart_toolkit.evaluate.benchmark import Cell
from sart_toolkit.evaluate.statistics import wilson_interval
from sart_toolkit.motion.timing import Motion
from sart_toolkit.poses import Array, exp_rotation, inverse
from sart_toolkit.records import (
    CONTROL_HZ,
    PHYSICS_HZ,
    Annotation,
    Demonstration,
    PrecisionSphere,
    library_versions,
)
from sart_toolkit.robots.model import RobotModel
from sart_toolkit.robots.spec import RobotSpec
from sart_toolkit.sampling import sample_direction, sample_rotation
from sart_toolkit.scene.collision import PlacedModel, coal_transform, convex_distance
from sart_toolkit.scene.demonstrated import DemonstratedScene
from sart_toolkit.scene.spec import SceneSpec
from sart_toolkit.storage import (
    append_json_line,
    check_writable,
    read_json_lines,
    remove,
    write_json,
)
from sart_toolkit.teach.scripted import ScriptedOperator
from sart_toolkit.teach.session import SessionConfig, record_demonstration
from sart_toolkit.teach.suggest import ExactSurroundings, SuggestConfig, suggest_annotation
from sart_toolkit.workers import worker_map

_NOTHING: Mapping[str, Any] = MappingProxyType({})
_BLIND = SessionConfig(cameras=())
# Rounding lets a law that just fills a limit exceed it by less than this share.
_ROUNDING = 1e-9
_LARGEST_STEP = 1.5
_SUGGESTIONS = 5
# Directed draws: part pairs looked at, draws before the best is refined, and how much deeper [m] a
# collision must be than the last one that did not hold before the whole robot is tried again.
_PAIRS = 12
_EXPLORED = 200
_DEEPER = 2e-5


def _recorded(cell: Cell, backend: Backend, seed: int) -> Demonstration:
    """The scripted operator's demonstration of a cell's task, without pictures.

    Raises:
        Mismatch: it did not reach the goal.
    """
    task = cell.task
    rng = np.random.default_rng([seed, 0])
    placement = task.sample_placement(rng)
    model = RobotModel(backend.robot, backend.scene.held)
    operator = ScriptedOperator(task.plan(task.initial_state(model, placement)), rng)
    shown = record_demonstration(backend, task, model, operator, placement, config=_BLIND)
    if not task.achieved(shown.success):
        raise Mismatch(f"{cell.name}: the demonstration did not reach the goal; try another --seed")
    return shown


# --- segments -----------------------------------------------------------------------------------


@dataclass(frozen=True)
class SegmentsConfig:
    """How many segments are tried in all, and from which seed."""

    count: int = 10_000
    seed: int = 0

    def __post_init__(self) -> None:
        _check_counts(self, "count")


@dataclass(frozen=True)
class LimitCheck:
    """How a motion fares against the robot's limits, and what is commanded against its path.

    `ratios`: the greatest joint velocity, acceleration and jerk over their limits, at 240 Hz;
    `violations`: how many of these samples, joints counted singly, exceed theirs. `off` [m]: how
    far the tool is at most from the path at what the backend commands at 240 Hz.
    """

    ratios: tuple[float, float, float]
    violations: int
    off: float


def check_motion(model: RobotModel, motion: Motion, q_start: Array) -> LimitCheck:
    """A motion's joint velocities, accelerations and jerks, and its commands, looked at at 240 Hz.

    Args:
        model: the robot.
        motion: what is commanded, its joints at 30 Hz and straight between.
        q_start: joints `(n,)` commanded before.
    """
    spec = model.spec
    limits = np.array([spec.velocity_limits, spec.acceleration_limits, spec.jerk_limits])
    times = np.concatenate([[0.0], motion.times(PHYSICS_HZ)])
    ratios = np.abs(motion.derivatives(times)) / limits[:, None]
    targets = np.concatenate([q_start[None], motion.joints(motion.times(CONTROL_HZ))])
    per_target = PHYSICS_HZ // CONTROL_HZ
    fraction = np.arange(1, per_target + 1)[:, None] / per_target
    commanded = targets[:-1, None] + fraction * np.diff(targets, axis=0)[:, None]
    commanded = commanded.reshape(-1, len(q_start))
    v, a, j = (float(ratio) for ratio in ratios.max((1, 2)))
    violations = int((ratios > 1.0 + _ROUNDING).sum())
    return LimitCheck((v, a, j), violations, tool_off_path(model, motion, commanded))


def tool_off_path(model: RobotModel, motion: Motion, configurations: Array) -> float:
    """How far [m] the tool is at most from a motion's path, at configurations `(k, n)`."""
    on_path = motion.joints(np.concatenate([[0.0], motion.times(PHYSICS_HZ)]))
    line = _tool_points(model, on_path)
    return float(_distances_to_polyline(_tool_points(model, configurations), line).max())


def _tool_points(model: RobotModel, configurations: Array) -> Array:
    return np.array([model.fk(q)[:3, 3] for q in configurations])


def _distances_to_polyline(points: Array, line: Array) -> Array:
    """Distances `(k,)` of points `(k, 3)` from a line through many points `(m, 3)`.

    Only the two pieces at the nearest of these points are looked at.
    """
    _, nearest = cKDTree(line).query(points)
    distances = np.full(len(points), np.inf)
    for first in (np.maximum(nearest - 1, 0), np.minimum(nearest, len(line) - 2)):
        a, b = line[first], line[first + 1]
        along = ((points - a) * (b - a)).sum(1) / np.maximum(((b - a) ** 2).sum(1), 1e-300)
        foot = a + np.clip(along, 0.0, 1.0)[:, None] * (b - a)
        distances = np.minimum(distances, np.linalg.norm(points - foot, axis=1))
    return distances


class _Segments:
    """Makes tries of a cell; keeps the last cell's backend, demonstration and spheres."""

    def __init__(self, cells: Sequence[Cell], config: SegmentsConfig) -> None:
        self._cells = {cell.name: cell for cell in cells}
        self._augment = AugmentConfig(seed=config.seed, camera=None)
        self._open: tuple[str, Backend, Annotation, SegmentPlanner, SegmentMaker] | None = None

    def _opened(self, name: str) -> tuple[Annotation, SegmentPlanner, SegmentMaker]:
        if self._open is None or self._open[0] != name:
            self.close()
            cell = self._cells[name]
            backend = cell.make_backend()
            try:
                shown = _recorded(cell, backend, self._augment.seed)
                scene = DemonstratedScene(shown, backend.robot, backend.scene)
                annotation = suggest_annotation(shown, ExactSurroundings(scene))
                planner = SegmentPlanner(
                    backend.robot, backend.scene, shown, annotation, self._augment
                )
                maker = SegmentMaker(backend, shown, annotation, self._augment)
            except BaseException:
                backend.close()
                raise
            self._open = name, backend, annotation, planner, maker
        return self._open[2:]

    def __call__(self, item: tuple[str, int]) -> dict[str, Any]:
        name, number = item
        annotation, planner, make = self._opened(name)
        k, at = divmod(number, len(annotation.spheres))
        sphere = annotation.spheres[at]
        started = time.perf_counter()
        proposal, rng = planner.proposal(at, k)
        model = planner.scene.collision.kinematics
        motion: Motion | None = None
        row: dict[str, Any] = {
            "cell": name,
            "try": number,
            "sphere": at,
            "k": k,
            "waypoint": sphere.waypoint,
            "radius": sphere.radius,
            "limited_by": sphere.limited_by,
            "planned": None,
            "measured": None,
        }
        try:
            motion, certificate = planner.plan(proposal, rng)
        except (Unreachable, MotionRejected):
            pass
        else:
            commanded = planner.scene.demonstration.steps.commanded_joint_positions
            found = check_motion(model, motion, commanded[proposal.t_star])
            row["planned"] = {
                "clearance": certificate.clearance,
                "duration": motion.duration,
                "lengthened": motion.duration > self._augment.duration,
                **asdict(found),
            }
        attempt = make(at, k)
        row["outcome"] = attempt.outcome
        if attempt.episode is not None and motion is not None:
            proof = attempt.episode.provenance.certificate or {}
            row["measured"] = {
                "clearance": proof["measured"]["clearance"],
                "deviation": proof["deviation"],
                "off": tool_off_path(model, motion, attempt.episode.joint_path),
            }
        return row | {"wall": time.perf_counter() - started}

    def close(self) -> None:
        if self._open is not None:
            self._open[1].close()
            self._open = None


def benchmark_segments(
    cells: Sequence[Cell],
    config: SegmentsConfig,
    out: Path,
    workers: int = 1,
    overwrite: bool = False,
    progress: Callable[[int, int, int], None] | None = None,
    about: Mapping[str, Any] = _NOTHING,
) -> dict[str, Any]:
    """How augmentation's segments fare in simulation, and whether they keep what they promise.

    For each cell a demonstration of the scripted operator is recorded and spheres are suggested;
    the tries are shared evenly among the cells, and go round-robin over a cell's spheres. No
    pictures are taken. Finished tries are kept beside `out` until all are done: interrupted, it
    goes on there.

    Args:
        cells: tasks on backends.
        config: how many tries.
        out: JSON file to write.
        workers: processes.
        overwrite: replace `out`, and forget finished tries.
        progress: called with (done, wanted, kept) after each try.
        about: what else is to stand in the file, such as the command.

    Raises:
        OutputExists: `out` is there and `overwrite` is false.
        Mismatch: it was interrupted with another seed, or a demonstration failed.
        InvalidInput: there are fewer tries than cells.
        MissingCapability: a backend can't restore states.
        CannotWrite: the disk refuses.
    """
    if config.count < len(cells):
        raise InvalidInput(f"count: expected at least {len(cells)}, got {config.count}")
    share, rest = divmod(config.count, len(cells))
    wanted = [(cell.name, i) for n, cell in enumerate(cells) for i in range(share + (n < rest))]
    log = _Log(out, {"benchmark": "segments", "seed": config.seed}, overwrite)
    rows = {(row["cell"], row["try"]): row for row in log.rows}
    missing = [item for item in wanted if item not in rows]
    done = len(wanted) - len(missing)
    kept = sum(rows[item]["outcome"] == KEPT for item in wanted if item in rows)
    with worker_map(functools.partial(_Segments, cells, config), workers) as run:
        for item, row in zip(missing, run(missing), strict=True):
            rows[item] = row
            log.add(row)
            done += 1
            kept += row["outcome"] == KEPT
            if progress is not None:
                progress(done, len(wanted), kept)
    table = {
        cell.name: _segments_summary([rows[item] for item in wanted if item[0] == cell.name])
        for cell in cells
    }
    return log.finish({
        **about,
        "config": asdict(config),
        "total": _segments_totals([rows[item] for item in wanted]),
        "cells": table,
        "versions": library_versions(),
    })  # fmt: skip


def _segments_summary(rows: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """A cell's totals, the same for each of its spheres in short, and what should not have been."""
    spheres = []
    for at in sorted({row["sphere"] for row in rows}):
        here = [row for row in rows if row["sphere"] == at]
        spheres.append({key: here[0][key] for key in ("waypoint", "radius", "limited_by")} | {
            "attempted": len(here),
            "kept": sum(row["outcome"] == KEPT for row in here),
            "rejections": _rejections(here),
        })  # fmt: skip
    alarms = [
        {key: row[key] for key in ("sphere", "k", "waypoint", "outcome")}
        for row in rows
        if _touched(row) or _left(row) or (row["planned"] or {}).get("violations")
    ]
    return _segments_totals(rows) | {"spheres": spheres, "alarms": alarms}


def _segments_totals(rows: Sequence[dict[str, Any]]) -> dict[str, Any]:
    kept = sum(row["outcome"] == KEPT for row in rows)
    planned = [row["planned"] for row in rows if row["planned"] is not None]
    measured = [row["measured"] for row in rows if row["measured"] is not None]
    return {
        "attempted": len(rows),
        "certified": len(planned),
        "kept": kept,
        "kept_rate": kept / len(rows),
        "ci95": list(wilson_interval(kept, len(rows))),
        "rejections": _rejections(rows),
        "contacts": sum(map(_touched, rows)),
        "left_path": sum(map(_left, rows)),
        "least_clearance_mm": _least_mm(planned, "clearance"),
        "least_measured_clearance_mm": _least_mm(measured, "clearance"),
        "deviation_mm": _spread_mm(measured, "deviation"),
        "limits": {
            "motions_that_violate": sum(each["violations"] > 0 for each in planned),
            "greatest_ratio": {
                name: max((each["ratios"][i] for each in planned), default=None)
                for i, name in enumerate(("velocity", "acceleration", "jerk"))
            },
        },
        "commands_off_path_mm": _spread_mm(planned, "off"),
        "measured_off_path_mm": _spread_mm(measured, "off"),
        "lengthened": sum(each["lengthened"] for each in planned),
        "longest_seconds": max((each["duration"] for each in planned), default=None),
        "tries_per_second_and_process": len(rows) / sum(row["wall"] for row in rows),
    }


def _touched(row: Mapping[str, Any]) -> bool:
    return str(row["outcome"]).startswith("contact ")


def _left(row: Mapping[str, Any]) -> bool:
    """Whether the measured path could not be proved clear."""
    return str(row["outcome"]).startswith("left its path")


def _rejections(rows: Sequence[dict[str, Any]]) -> dict[str, int]:
    outcomes = collections.Counter(row["outcome"] for row in rows if row["outcome"] != KEPT)
    return dict(outcomes.most_common())


def _least_mm(rows: Sequence[Mapping[str, float]], key: str) -> float | None:
    return min((row[key] * 1e3 for row in rows), default=None)


def _spread_mm(rows: Sequence[Mapping[str, float]], key: str) -> dict[str, float | None]:
    lengths = [row[key] * 1e3 for row in rows]
    return {
        "median": float(np.median(lengths)) if lengths else None,
        "max": max(lengths, default=None),
    }


# --- radii --------------------------------------------------------------------------------------


class Nearest(Protocol):
    """Two bodies by name and their distance [m], negative where they overlap."""

    @property
    def a(self) -> str:
        """The first body's name."""

    @property
    def b(self) -> str:
        """The second body's name."""

    @property
    def distance(self) -> float:
        """Their distance [m]."""


class Checker(Protocol):
    """A second opinion on the distances between robot and scene."""

    def place(
        self,
        Ts_world_body: Mapping[str, Array],
        gripper: float,
        T_tool_carried: Mapping[str, Array] = ...,
    ) -> None:
        """Put bodies and gripper where they are; what is carried moves with the tool."""

    def nearest(self, q: Array, within: float = ...) -> Nearest:
        """The nearest pair of the whole robot at joints `q (n,)`, if nearer than `within` [m]."""

    def close(self) -> None:
        """Free what is held."""


MakeChecker = Callable[[RobotSpec, SceneSpec], Checker]


@dataclass(frozen=True)
class RadiiConfig:
    """How suggested radii are tried.

    `draws`: random poses in each sphere; `directed`: draws that aim at the pair of bodies that
    limits a sphere, in one of `growth` times the radius; `suggest`: how radii are suggested.
    """

    draws: int = 2000
    directed: int = 20_000
    growth: float = 1.15
    seed: int = 0
    suggest: SuggestConfig = field(default_factory=SuggestConfig)

    def __post_init__(self) -> None:
        _check_counts(self, "draws", "directed")
        if not 1.0 <= self.growth <= 10.0:
            raise InvalidInput(f"growth: expected 1 to 10, got {self.growth}")


class SphereTrial:
    """Tries spheres of a demonstration: random poses within, directed ones in a larger one."""

    def __init__(self, scene: DemonstratedScene, checker: Checker, config: RadiiConfig) -> None:
        """Try spheres in a scene; `checker` is asked as well as the scene's own model."""
        self._scene, self._checker, self._config = scene, checker, config

    def __call__(self, sphere: PrecisionSphere, rng: np.random.Generator) -> dict[str, Any]:
        """What became of a sphere's draws, as JSON values; distances in millimetres.

        `collisions` counts poses at which one of the two models of the whole robot overlaps, with
        what is carried where it was in the grasp. `within_margin` tells whether a directed draw
        came nearer than the margin, and the play in the grasp, that a suggested radius leaves.
        """
        t = sphere.waypoint
        self._place(t)
        return {
            "waypoint": t,
            "radius": sphere.radius,
            "clearance": sphere.clearance,
            "limited_by": sphere.limited_by,
            **self._random(sphere, rng),
            "grown": self._directed(sphere, rng),
        }

    def _place(self, t: int) -> None:
        demonstration = self._scene.demonstration
        steps = demonstration.steps
        Ts = {name: poses[t] for name, poses in demonstration.body_Ts_world.items()}
        T_tool_world = inverse(steps.measured_Ts_world_tool[t])
        carried = {name: T_tool_world @ Ts[name] for name in self._scene.phases[t].carried}
        self._checker.place(Ts, float(np.clip(steps.measured_gripper[t], 0.0, 1.0)), carried)

    def _joints(self, t: int, T_world_tool: Array) -> Array | None:
        """Joints `(n,)` near waypoint `t`'s for a tool pose; None where there are none."""
        near = self._scene.demonstration.steps.joint_positions[t]
        try:
            return self._scene.collision.kinematics.ik(T_world_tool, near, _LARGEST_STEP)
        except (Unreachable, MotionRejected):
            return None

    def _random(self, sphere: PrecisionSphere, rng: np.random.Generator) -> dict[str, Any]:
        """Poses in the ball, half of them on its surface, turned as augmentation turns them."""
        t = sphere.waypoint
        placed = self._scene.placed(t)
        most = self._config.suggest.rotation_per_metre * sphere.radius
        unreachable, collisions = 0, []
        least, least_checked, pair = np.inf, np.inf, ("", "")
        for i in range(self._config.draws):
            far = sphere.radius * (float(np.cbrt(rng.uniform())) if i % 2 else 1.0)
            T = np.array(sphere.T_world_key)
            T[:3, 3] += far * sample_direction(rng, "area")
            T[:3, :3] = T[:3, :3] @ sample_rotation(rng, most)
            q = self._joints(t, T)
            if q is None:
                unreachable += 1
                continue
            distances = placed.distances(q) + placed.play
            nearest = int(np.argmin(distances))
            seen = self._checker.nearest(q)
            if distances[nearest] < least:
                least, pair = float(distances[nearest]), placed.names(nearest)
            least_checked = min(least_checked, seen.distance)
            if min(distances[nearest], seen.distance) < 0:
                collisions.append(
                    {
                        "draw": i,
                        "pair": [*placed.names(nearest)],
                        "mm": float(distances[nearest]) * 1e3,
                        "checked_pair": [seen.a, seen.b],
                        "checked_mm": _finite(seen.distance),
                    }
                )
        return {
            "draws": self._config.draws,
            "unreachable": unreachable,
            "collisions": len(collisions),
            "least_mm": _finite(least),
            "least_pair": [*pair],
            "least_checked_mm": _finite(least_checked),
            "first_collisions": collisions[:5],
        }

    def _directed(self, sphere: PrecisionSphere, rng: np.random.Generator) -> dict[str, Any] | None:
        """What an aimed search finds in the grown sphere; None if no pair of bodies limits it.

        Only tool bodies and the scene are looked at, until some overlap; the whole robot, by both
        models, has to agree.
        """
        t = sphere.waypoint
        placed = self._scene.placed(t)
        limiting = tuple((sphere.limited_by or "").split(" / "))
        if limiting not in {placed.names(pair) for pair in placed.tool_pairs()}:
            return None
        radius = self._config.growth * sphere.radius
        angle = self._config.suggest.rotation_per_metre * radius
        q_key = self._scene.demonstration.steps.joint_positions[t]
        search = _Search(placed, q_key, limiting, radius, angle, rng)
        tried, found = 0.0, False
        while search.draws < self._config.directed and not found:
            d, T = search.draw()
            if d < tried:
                tried = d - _DEEPER
                q = self._joints(t, T)
                found = (
                    q is not None
                    and bool((placed.distances(q) + placed.play).min() < 0)
                    and self._checker.nearest(q).distance < 0
                )
        return {
            "radius": radius,
            "draws": search.draws,
            "collided": found,
            "least_mm": search.least * 1e3,
            "within_margin": bool(search.least_with_play < self._config.suggest.margin),
        }


class _Search:
    """Draws tool poses in a ball that bring the tool near obstacles, and improves on the nearest.

    Half of the draws aim: the tool moves against the normal of a gap, turned about an axis that
    swings one of the part's nearest points towards the obstacle, more or less exactly. The others
    change the best draw so far a little.
    """

    def __init__(
        self,
        placed: PlacedModel,
        q_key: Array,
        limiting: tuple[str, ...],
        radius: float,
        angle: float,
        rng: np.random.Generator,
    ) -> None:
        self._radius, self._angle, self._rng = radius, angle, rng
        T_world_joint = placed.joint_poses(q_key)[-1]
        self._T_key = T_world_joint @ placed.T_joint_tool
        T_tool_joint = inverse(placed.T_joint_tool)
        pairs = placed.tool_pairs()
        distances = dict(zip(pairs, placed.pair_distances(q_key, pairs), strict=True))
        order = sorted(pairs, key=lambda k: (placed.names(k) != limiting, distances[k]))
        self._pairs = []
        self._aims = []
        for k in order[:_PAIRS]:
            part, obstacle = (placed.parts[i] for i in placed.pairs[k])
            self._pairs.append(
                (
                    part.geometry,
                    T_tool_joint @ part.T_joint_part,
                    obstacle.geometry,
                    coal_transform(obstacle.T_joint_part),
                    float(placed.play[k]),
                )
            )
            witness = placed.witness(q_key, k)
            gap = witness.p_a - witness.p_b
            if (length := float(np.linalg.norm(gap))) > 1e-9:
                points = part.points @ T_world_joint[:3, :3].T + T_world_joint[:3, 3]
                points = points - self._T_key[:3, 3]
                heights = points @ gap / length
                # A point as much higher than the lowest as the ball is wide hardly ever counts.
                weights = np.exp(-(heights - heights.min()) / radius)
                self._aims.append((gap / length, points, weights / weights.sum()))
        self.draws = 0
        self._best = np.zeros(3), np.zeros(3)
        self.least = self.least_with_play = float("inf")

    def draw(self) -> tuple[float, Array]:
        """The next draw: how far [m] the tool is from the scene there, and its pose `(4, 4)`."""
        self.draws += 1
        improves = self.draws > _EXPLORED and self._rng.random() < 0.5
        p, w = self._near_best() if improves else self._aimed()
        T = np.array(self._T_key)
        T[:3, :3] = exp_rotation(w) @ T[:3, :3]
        T[:3, 3] += p
        distances = [
            (convex_distance(a, coal_transform(T @ T_tool_part), b, T_b), play)
            for a, T_tool_part, b, T_b, play in self._pairs
        ]
        least = min(distance for distance, _ in distances)
        self.least_with_play = min(
            self.least_with_play, *(distance - play for distance, play in distances)
        )
        if least < self.least:
            self.least, self._best = least, (p, w)
        return least, T

    def _aimed(self) -> tuple[Array, Array]:
        rng = self._rng
        # The first gap is that of the pair which limits the radius.
        normal, points, weights = self._aims[
            0 if rng.random() < 0.5 else int(rng.integers(len(self._aims)))
        ]
        point = points[rng.choice(len(points), p=weights)]
        spread = 10 ** rng.uniform(-2, 0.5)
        swing = np.cross(normal, point)
        axis = _unit(_unit(swing) + spread * rng.normal(size=3))
        towards = _unit(-normal + spread * rng.normal(size=3))
        share = 1.0 if rng.random() < 0.5 else rng.uniform()
        far = 1.0 if rng.random() < 0.7 else float(np.cbrt(rng.uniform()))
        return far * self._radius * towards, share * self._angle * axis

    def _near_best(self) -> tuple[Array, Array]:
        step = 10 ** self._rng.uniform(-3, 0)
        p, w = self._best
        p = p + step * self._radius * self._rng.normal(size=3)
        w = w + step * self._angle * self._rng.normal(size=3)
        return _within(p, self._radius), _within(w, self._angle)


def _unit(vector: Array) -> Array:
    return vector / max(float(np.linalg.norm(vector)), 1e-12)


def _within(vector: Array, most: float) -> Array:
    return vector * min(1.0, most / max(float(np.linalg.norm(vector)), 1e-12))


class _Radii:
    """Tries all spheres of a cell."""

    def __init__(
        self, cells: Sequence[Cell], make_checker: MakeChecker, config: RadiiConfig
    ) -> None:
        self._cells = {cell.name: cell for cell in cells}
        self._make_checker, self._config = make_checker, config

    def __call__(self, name: str) -> dict[str, Any]:
        cell, config = self._cells[name], self._config
        with closing(cell.make_backend()) as backend:
            shown = _recorded(cell, backend, config.seed)
            robot, bodies = backend.robot, backend.scene
        started = time.perf_counter()
        scene = DemonstratedScene(shown, robot, bodies)
        surroundings = ExactSurroundings(scene)
        for t in range(len(shown)):
            scene.placed(t)
        built = time.perf_counter() - started
        seconds = []
        for _ in range(1 + _SUGGESTIONS):
            started = time.perf_counter()
            annotation = suggest_annotation(shown, surroundings, config=config.suggest)
            seconds.append(time.perf_counter() - started)
        rows = []
        with closing(self._make_checker(robot, bodies)) as checker:
            attempt = SphereTrial(scene, checker, config)
            for i, sphere in enumerate(annotation.spheres):
                rows.append(attempt(sphere, np.random.default_rng([config.seed, i])))
        return {
            "cell": name,
            "waypoints": len(shown),
            "seconds_build": built,
            "seconds_suggest_first": seconds[0],
            "seconds_suggest": float(np.median(seconds[1:])),
            "spheres": rows,
        }

    def close(self) -> None:
        """Nothing is held."""


def benchmark_radii(
    cells: Sequence[Cell],
    make_checker: MakeChecker,
    config: RadiiConfig,
    out: Path,
    workers: int = 1,
    overwrite: bool = False,
    progress: Callable[[int, int], None] | None = None,
    about: Mapping[str, Any] = _NOTHING,
) -> dict[str, Any]:
    """Whether suggested radii are safe and tight, and how long suggesting them takes.

    For each cell a demonstration of the scripted operator is recorded and spheres are suggested.
    Safe: random poses in each sphere, as augmentation draws them and within the ball too, are free
    of collisions of the whole robot, by our own model and by another. Tight: in a somewhat larger
    sphere a search that aims finds one, where a pair of bodies limits the radius. Finished cells
    are kept beside `out` until all are done: interrupted, it goes on there.

    Args:
        cells: tasks on backends.
        make_checker: makes the other model; picklable if `workers` > 1.
        config: how many draws.
        out: JSON file to write.
        workers: processes.
        overwrite: replace `out`, and forget finished cells.
        progress: called with (done, wanted) after each cell.
        about: what else is to stand in the file, such as the command.

    Raises:
        OutputExists: `out` is there and `overwrite` is false.
        Mismatch: it was interrupted with other numbers, or a demonstration failed.
        CannotWrite: the disk refuses.
    """
    log = _Log(out, {"benchmark": "radii", **asdict(config)}, overwrite)
    rows = {row["cell"]: row for row in log.rows}
    missing = [cell.name for cell in cells if cell.name not in rows]
    done = len(cells) - len(missing)
    work = functools.partial(_Radii, cells, make_checker, config)
    with worker_map(work, workers) as run:
        for name, row in zip(missing, run(missing), strict=True):
            rows[name] = row
            log.add(row)
            done += 1
            if progress is not None:
                progress(done, len(cells))
    table = {}
    for cell in cells:
        row = {key: value for key, value in rows[cell.name].items() if key != "cell"}
        table[cell.name] = _radii_totals(row["spheres"]) | row
    every = [sphere for row in table.values() for sphere in row["spheres"]]
    return log.finish({
        **about,
        "config": asdict(config),
        "total": _radii_totals(every),
        "cells": table,
        "versions": library_versions(),
    })  # fmt: skip


def _radii_totals(spheres: Sequence[dict[str, Any]]) -> dict[str, Any]:
    grown = [sphere["grown"] for sphere in spheres if sphere["grown"] is not None]
    reached = sum(sphere["draws"] - sphere["unreachable"] for sphere in spheres)
    least = [sphere["least_mm"] for sphere in spheres if sphere["least_mm"] is not None]
    collisions = sum(sphere["collisions"] for sphere in spheres)
    return {
        "n_spheres": len(spheres),
        "n_draws": sum(sphere["draws"] for sphere in spheres),
        "n_unreachable": sum(sphere["unreachable"] for sphere in spheres),
        "n_collisions": collisions,
        "collisions": _rate(collisions, reached),
        "least_mm": min(least, default=None),
        "n_limited_by_pair": len(grown),
        "n_collided_when_grown": sum(each["collided"] for each in grown),
        "collided_when_grown": _rate(sum(each["collided"] for each in grown), len(grown)),
        "n_within_margin_when_grown": sum(each["within_margin"] for each in grown),
    }


def _rate(n: int, of: int) -> dict[str, Any] | None:
    return {"rate": n / of, "ci95": list(wilson_interval(n, of))} if of else None


# --- shared -------------------------------------------------------------------------------------


class _Log:
    """What a benchmark has done so far, in a file of lines beside its result."""

    def __init__(self, out: Path, request: Mapping[str, Any], overwrite: bool) -> None:
        check_writable(out, overwrite)
        self._out, self._path = out, out.with_suffix(".partial.jsonl")
        if overwrite:
            remove(self._path)
        lines = read_json_lines(self._path)
        if lines and lines[0] != request:
            raise Mismatch(
                f"{self._path}: holds results of {lines[0]}, not {dict(request)}; add --overwrite "
                "or choose another --out"
            )
        if not lines:
            out.parent.mkdir(parents=True, exist_ok=True)
            append_json_line(self._path, request)
        self.rows = lines[1:]

    def add(self, row: Mapping[str, Any]) -> None:
        append_json_line(self._path, row)

    def finish(self, result: dict[str, Any]) -> dict[str, Any]:
        """`result`, written."""
        write_json(self._out, result)
        remove(self._path)
        return result


def _finite(length: float) -> float | None:
    """A length in millimetres, None where it is infinite: JSON has no such number."""
    return length * 1e3 if np.isfinite(length) else None


def _check_counts(config: Any, *names: str) -> None:
    for name in names:
        if getattr(config, name) < 1:
            raise InvalidInput(f"{name}: expected at least 1, got {getattr(config, name)}")
    if config.seed < 0:
        raise InvalidInput(f"seed: expected a whole number >= 0, got {config.seed}")
