"""Whether suggested radii are safe and tight."""

from __future__ import annotations

import functools
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from dataclasses import asdict, dataclass, field
from pathlib import Path
from types import MappingProxyType
from typing import Any, Protocol

import numpy as np

from sart_toolkit.annotate.suggest import SuggestConfig, suggest_annotation
from sart_toolkit.benchmark.cells import Cell, check_counts, recorded
from sart_toolkit.collision.exact import ExactWorld
from sart_toolkit.collision.model import PlacedModel
from sart_toolkit.collision.parts import coal_transform, convex_distance
from sart_toolkit.data.records import (
    PrecisionSphere,
    library_versions,
)
from sart_toolkit.data.result_log import ResultLog
from sart_toolkit.data.sampling import sample_direction, sample_rotation
from sart_toolkit.errors import InvalidInput, MotionRejected, Unreachable
from sart_toolkit.evaluate.statistics import wilson_interval
from sart_toolkit.poses import Array, exp_rotation, inverse
from sart_toolkit.robots.spec import RobotSpec
from sart_toolkit.scenes.spec import SceneSpec
from sart_toolkit.workers import Workers, worker_map

_NOTHING: Mapping[str, Any] = MappingProxyType({})
_LARGEST_STEP = 1.5
_SUGGESTIONS = 5
# Directed draws: part pairs considered, draws before the best is refined, and how much deeper [m] a
# collision must be than the last one that did not hold before the whole robot is checked again.
_PAIRS = 12
_EXPLORED = 200
_DEEPER = 2e-5


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
        T_tool_grasped: Mapping[str, Array] = ...,
    ) -> None:
        """Put bodies and gripper where they are; what is grasped moves with the tool."""

    def nearest(self, q: Array, within: float = ...) -> Nearest:
        """The nearest pair of the whole robot at joints `q (n,)`, if nearer than `within` [m]."""

    def close(self) -> None:
        """Free what is held."""


MakeChecker = Callable[[RobotSpec, SceneSpec], Checker]


@dataclass(frozen=True)
class RadiiConfig:
    """How suggested radii are tested.

    `draws`: random poses in each sphere; `directed`: draws that aim at the pair of bodies that
    limits a sphere, in one of `growth` times the radius; `suggest`: how radii are suggested.
    """

    draws: int = 2000
    directed: int = 20_000
    growth: float = 1.15
    seed: int = 0
    suggest: SuggestConfig = field(default_factory=SuggestConfig)

    def __post_init__(self) -> None:
        check_counts(self, "draws", "directed")
        if not 1.0 <= self.growth <= 10.0:
            raise InvalidInput(f"growth: expected 1 to 10, got {self.growth}")


class SphereTrial:
    """Tests spheres of a demonstration: random poses within, directed ones in a larger one."""

    def __init__(self, world: ExactWorld, checker: Checker, config: RadiiConfig) -> None:
        """Test spheres in a world; `checker` is asked as well as the world's own model."""
        self._world, self._checker, self._config = world, checker, config

    def __call__(self, sphere: PrecisionSphere, rng: np.random.Generator) -> dict[str, Any]:
        """What became of a sphere's draws, as JSON values; distances in millimetres.

        `collisions` counts poses at which one of the two models of the whole robot overlaps, with
        what is grasped where it was in the grasp. `within_margin` says whether a directed draw
        came nearer than the margin, and the slip tolerance, that a suggested radius leaves.
        """
        t = sphere.waypoint
        self._checker.place(*self._world.at(t))
        return {
            "waypoint": t,
            "radius": sphere.radius,
            "clearance": sphere.clearance,
            "limited_by": sphere.limited_by,
            **self._random(sphere, rng),
            "grown": self._directed(sphere, rng),
        }

    def _joints(self, t: int, T_world_tool: Array) -> Array | None:
        """Joints `(n,)` near waypoint `t`'s for a tool pose; None where there are none."""
        near = self._world.demonstration.steps.joint_positions[t]
        try:
            return self._world.collision.kinematics.ik(T_world_tool, near, _LARGEST_STEP)
        except (Unreachable, MotionRejected):
            return None

    def _random(self, sphere: PrecisionSphere, rng: np.random.Generator) -> dict[str, Any]:
        """Poses in the ball, half of them on its surface, turned as augmentation turns them."""
        t = sphere.waypoint
        placed = self._world.placed(t)
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
            distances = placed.distances(q) + placed.slip
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

        Only tool bodies and the scene are considered, until some overlap; the whole robot, by both
        models, has to agree.
        """
        t = sphere.waypoint
        placed = self._world.placed(t)
        limiting = tuple((sphere.limited_by or "").split(" / "))
        if limiting not in {placed.names(pair) for pair in placed.tool_pairs()}:
            return None
        radius = self._config.growth * sphere.radius
        angle = self._config.suggest.rotation_per_metre * radius
        q_key = self._world.demonstration.steps.joint_positions[t]
        search = _Search(placed, q_key, limiting, radius, angle, rng)
        checked, found = 0.0, False
        while search.draws < self._config.directed and not found:
            d, T = search.draw()
            if d < checked:
                checked = d - _DEEPER
                q = self._joints(t, T)
                found = (
                    q is not None
                    and bool((placed.distances(q) + placed.slip).min() < 0)
                    and self._checker.nearest(q).distance < 0
                )
        return {
            "radius": radius,
            "draws": search.draws,
            "collided": found,
            "least_mm": search.least * 1e3,
            "within_margin": bool(search.least_with_slip < self._config.suggest.margin),
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
                    float(placed.slip[k]),
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
        self.least = self.least_with_slip = float("inf")

    def draw(self) -> tuple[float, Array]:
        """The next draw: how far [m] the tool is from the scene there, and its pose `(4, 4)`."""
        self.draws += 1
        improves = self.draws > _EXPLORED and self._rng.random() < 0.5
        p, w = self._near_best() if improves else self._aimed()
        T = np.array(self._T_key)
        T[:3, :3] = exp_rotation(w) @ T[:3, :3]
        T[:3, 3] += p
        distances = [
            (convex_distance(a, coal_transform(T @ T_tool_part), b, T_b), slip)
            for a, T_tool_part, b, T_b, slip in self._pairs
        ]
        least = min(distance for distance, _ in distances)
        self.least_with_slip = min(
            self.least_with_slip, *(distance - slip for distance, slip in distances)
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
    """Tests all spheres of a cell."""

    def __init__(
        self, cells: Sequence[Cell], make_checker: MakeChecker, config: RadiiConfig
    ) -> None:
        self._cells = {cell.name: cell for cell in cells}
        self._make_checker, self._config = make_checker, config

    def __call__(self, name: str) -> dict[str, Any]:
        cell, config = self._cells[name], self._config
        with closing(cell.make_backend()) as backend:
            demonstration = recorded(cell, backend, config.seed)
            robot, bodies = backend.robot, backend.scene
        started = time.perf_counter()
        world = ExactWorld(demonstration, robot, bodies)
        for t in range(len(demonstration)):
            world.placed(t)
        built = time.perf_counter() - started
        seconds = []
        for _ in range(1 + _SUGGESTIONS):
            started = time.perf_counter()
            annotation = suggest_annotation(demonstration, world, config=config.suggest)
            seconds.append(time.perf_counter() - started)
        rows = []
        with closing(self._make_checker(robot, bodies)) as checker:
            attempt = SphereTrial(world, checker, config)
            for i, sphere in enumerate(annotation.spheres):
                rows.append(attempt(sphere, np.random.default_rng([config.seed, i])))
        return {
            "cell": name,
            "waypoints": len(demonstration),
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
    workers: int | Workers = 1,
    overwrite: bool = False,
    progress: Callable[[int, int], None] | None = None,
    about: Mapping[str, Any] = _NOTHING,
) -> dict[str, Any]:
    """Whether suggested radii are safe and tight, and how long suggesting them takes.

    For each cell a demonstration of the scripted operator is recorded and spheres are suggested.
    Safe: random poses in each sphere, as augmentation draws them and within the ball too, are free
    of collisions of the whole robot, by our own model and by another. Tight: in a somewhat larger
    sphere a search that aims finds one, where a pair of bodies limits the radius. Finished cells
    are kept beside `out` until all are done: interrupted, it resumes there.

    Args:
        cells: tasks on backends.
        make_checker: makes the other model; picklable if `workers` > 1.
        config: how many draws.
        out: JSON file to write.
        workers: how many processes, or `Workers` elsewhere.
        overwrite: replace `out`, and forget finished cells.
        progress: called with (done, wanted) after each cell.
        about: what else is to stand in the file, such as the command.

    Raises:
        OutputExists: `out` is there and `overwrite` is false.
        Mismatch: it was interrupted with other numbers, or a demonstration failed.
        CannotWrite: the disk refuses.
    """
    with ResultLog(out, {"benchmark": "radii", **asdict(config)}, overwrite) as log:
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


def _finite(length: float) -> float | None:
    """A length in millimetres, None where it is infinite: JSON has no such number."""
    return length * 1e3 if np.isfinite(length) else None
