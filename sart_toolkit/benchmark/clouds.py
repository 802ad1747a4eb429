"""How radii from the recorded images compare with those from the true scene, task by task."""

from __future__ import annotations

import dataclasses
import functools
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from sart_toolkit.annotate.suggest import SuggestConfig, suggest_annotation, suggest_radius
from sart_toolkit.benchmark.cells import Cell
from sart_toolkit.benchmark.noise import as_measured
from sart_toolkit.collision.cloud import fuse_cloud, surface_errors
from sart_toolkit.collision.cloud_world import CloudWorld
from sart_toolkit.collision.exact import ExactWorld
from sart_toolkit.collision.hull import Hull
from sart_toolkit.collision.parts import ConvexPart
from sart_toolkit.collision.sensor import CloudConfig, SensorErrors, sensor_errors
from sart_toolkit.collision.world import CollisionWorld
from sart_toolkit.data.records import Demonstration, PrecisionSphere, library_versions
from sart_toolkit.data.result_log import ResultLog
from sart_toolkit.poses import Array, check_positive
from sart_toolkit.record.scripted import ScriptedOperator
from sart_toolkit.record.session import record_demonstration
from sart_toolkit.robots.model import RobotModel
from sart_toolkit.robots.spec import RobotSpec
from sart_toolkit.tasks.task import Placement
from sart_toolkit.workers import Workers, worker_map

# Where the two are compared, small radii count too.
_LEAST_RADIUS = 0.0005
_NOTHING: Mapping[str, Any] = MappingProxyType({})
# More than rounding [m].
_LARGER = 1e-6
# The hand-eye calibration's error in the noise table [m, deg].
_HAND_EYE = (0.002, 0.3)


@dataclasses.dataclass(frozen=True)
class Recording:
    """Images as a sensor with errors records them, read as one with `declared` errors.

    `holes`: the share of pixels without depth.
    """

    errors: SensorErrors
    declared: SensorErrors
    holes: float = 0.0

    @staticmethod
    def honest(name: str, holes: float = 0.0) -> Recording:
        """A named sensor's, its hand-eye calibration off, everything declared."""
        errors = sensor_errors(name, _HAND_EYE)
        return Recording(errors, errors, holes)


RECORDINGS: Mapping[str, Recording] = {
    "none": Recording.honest("exact"),
    "D405-like": Recording.honest("d405"),
    "D435-like": Recording.honest("d435", holes=0.05),
}


def benchmark_clouds(
    cells: Sequence[Cell],
    seed: int,
    out: Path,
    overwrite: bool = False,
    progress: Callable[[int, int], None] | None = None,
    about: Mapping[str, Any] = _NOTHING,
) -> dict[str, Any]:
    """For each cell, the radii of all suggested spheres from the scene and from the cloud.

    Spheres are where the exact suggestion has them. Also the seconds that either suggestion takes,
    the cloud's fusion included, models of robot and scene built before; and how far the cloud's
    seen points are from the true surfaces until the first contact, and how many of them lie in
    the robot's moving parts, or what it holds, at any waypoint until then. Finished cells are kept
    beside `out` until all are done: interrupted, it resumes there.

    Args:
        cells: tasks and backends; the backends draw images.
        seed: of the scripted operator.
        out: JSON file to write.
        overwrite: replace `out`, and forget finished cells.
        progress: called with (cells done, cells in all).
        about: what else is to stand in the file, such as the command.

    Raises:
        OutputExists: `out` is there and `overwrite` is false.
        Mismatch: it was interrupted with another seed.
        CannotWrite: the disk refuses.
    """
    with ResultLog(out, {"benchmark": "cloud", "seed": seed}, overwrite) as log:
        found = {row["cell"]: row["compared"] for row in log.rows}
        done = sum(cell.name in found for cell in cells)
        for cell in cells:
            if cell.name in found:
                continue
            found[cell.name] = _compared(cell, seed)
            log.add({"cell": cell.name, "compared": found[cell.name]})
            done += 1
            if progress is not None:
                progress(done, len(cells))
        rows = {cell.name: found[cell.name] for cell in cells}
        spheres = [sphere for row in rows.values() for sphere in row["spheres"]]
        return log.finish({
            **about,
            "total": {
                "n_spheres": len(spheres),
                "median_share": float(np.median([s["cloud"] / s["exact"] for s in spheres])),
                "largest_excess_mm": max(1e3 * (s["cloud"] - s["exact"]) for s in spheres),
            },
            "cells": rows,
            "versions": library_versions(),
        })  # fmt: skip


def _on_robot(points: Array, world: ExactWorld, waypoints: Sequence[int]) -> int:
    """How many points `(n, 3)` the robot or what it holds covers at one of the waypoints."""
    covered = np.zeros(len(points), dtype=bool)
    hulls: dict[ConvexPart, Hull] = {}
    for t in waypoints:
        placed = world.placed(t)
        Ts = placed.joint_poses(world.demonstration.steps.joint_positions[t])
        for part in placed.parts:
            if part.joint > 0:
                if part not in hulls:
                    hulls[part] = Hull(part.points)
                T = Ts[part.joint]
                covered |= hulls[part].near((points - T[:3, 3]) @ T[:3, :3], 0.0)
    return int(covered.sum())


def benchmark_noise(
    cells: Sequence[Cell],
    draws: int,
    out: Path,
    seed: int = 0,
    recordings: Mapping[str, Recording] = RECORDINGS,
    workers: int | Workers = 1,
    overwrite: bool = False,
    progress: Callable[[int, int], None] | None = None,
    about: Mapping[str, Any] = _NOTHING,
) -> dict[str, Any]:
    """For each cell and sensor, radii from noisy images against those from the true scene.

    A demonstration is recorded once; its images are replaced, `draws` times for each sensor, by
    what the sensor would have recorded. Spheres are where the exact suggestion has them. A radius
    is too large if it exceeds the exact one there and doesn't pass the exact suggestion's own
    tests either; a sphere is lost if its radius is less than a suggestion's smallest.

    Args:
        cells: tasks and backends; the backends draw images.
        draws: of the noise.
        out: JSON file to write; finished cells are kept beside it until all are done.
        seed: of the scripted operator and of the noise.
        recordings: the sensors by name.
        workers: how many processes, or `Workers` elsewhere.
        overwrite: replace `out`, and forget finished cells.
        progress: called with (cells done, cells in all).
        about: what else is to stand in the file, such as the command.

    Raises:
        OutputExists: `out` is there and `overwrite` is false.
        Mismatch: it was interrupted with other settings.
        CannotWrite: the disk refuses.
    """
    check_positive("draws", draws)
    described = {name: dataclasses.asdict(each) for name, each in recordings.items()}
    asked = {"benchmark": "noise", "seed": seed, "draws": draws, "recordings": described}
    names = [cell.name for cell in cells]
    with ResultLog(out, asked, overwrite) as log:
        done = {row["cell"]: row for row in log.rows}
        missing = [name for name in names if name not in done]
        work = functools.partial(_NoiseCell, cells, draws, seed, recordings)
        with worker_map(work, workers) as run:
            for name, (size, found) in zip(missing, run(missing), strict=True):
                done[name] = {"cell": name, "size": size, "found": found}
                log.add(done[name])
                if progress is not None:
                    progress(sum(name in done for name in names), len(cells))
        rows = {name: done[name]["found"] for name in names}
        return log.finish({
            **about,
            "draws": draws,
            "seed": seed,
            "image_size": {name: done[name]["size"] for name in names},
            "recordings": described,
            "total": {
                name: _noise_totals([row for cell in rows.values() for row in cell[name]])
                for name in recordings
            },
            "cells": {
                cell: {name: _noise_totals(of) | {"draws": of} for name, of in by_name.items()}
                for cell, by_name in rows.items()
            },
            "versions": library_versions(),
        })  # fmt: skip


class _NoiseCell:
    """Radii from all noisy images of a cell."""

    def __init__(
        self,
        cells: Sequence[Cell],
        draws: int,
        seed: int,
        recordings: Mapping[str, Recording],
    ) -> None:
        self._cells = {cell.name: cell for cell in cells}
        self._draws, self._seed, self._recordings = draws, seed, recordings

    def __call__(self, name: str) -> tuple[list[int], dict[str, list[dict[str, Any]]]]:
        """The images' size, and for each sensor the radii of each draw."""
        cell = self._cells[name]
        demonstration, robot = _demonstrated(cell, self._seed)
        size = next(iter(demonstration.steps.cameras.values())).depth.shape[1:]
        exact = ExactWorld(demonstration, robot, cell.task.scene)
        spheres = suggest_annotation(demonstration, exact).spheres
        radii = _radii(exact, spheres)
        rows: dict[str, list[dict[str, Any]]] = {of: [] for of in self._recordings}
        for of, recording in self._recordings.items():
            for draw in range(self._draws):
                rng = np.random.default_rng([self._seed, draw, 7])
                noisy = as_measured(demonstration, recording.errors, recording.holes, rng)
                config = CloudConfig(sensor=recording.declared)
                started = time.perf_counter()
                cloud = CloudWorld(noisy, robot, cell.task.scene, config=config)
                found = _radii(cloud, spheres)
                seconds = time.perf_counter() - started
                allowed = _allowed(exact, spheres, radii, found)
                rows[of].append(
                    {"exact": radii, "allowed": allowed, "cloud": found, "seconds": seconds}
                )
        return [int(pixels) for pixels in size], rows

    def close(self) -> None:
        """Nothing is held."""


def _radii(world: CollisionWorld, spheres: Sequence[PrecisionSphere]) -> list[float]:
    """The largest radius [m] at each sphere's waypoint."""
    config = SuggestConfig(min_radius=_LEAST_RADIUS)
    return [
        suggest_radius(world, world.demonstration, sphere.waypoint, config).radius
        for sphere in spheres
    ]


def _allowed(
    exact: CollisionWorld,
    spheres: Sequence[PrecisionSphere],
    radii: Sequence[float],
    found: Sequence[float],
) -> list[float]:
    """The largest radii [m] known to be right: the exact ones, or larger ones that pass as well.

    Where what limits a radius is only probed, the arm itself, the exact one is shrunk in steps of a
    tenth until it passes, so that one in between may pass the same tests.
    """
    allowed = []
    for sphere, radius, other in zip(spheres, radii, found, strict=True):
        if other > radius + _LARGER:
            config = SuggestConfig(min_radius=_LEAST_RADIUS, max_radius=other)
            at = suggest_radius(exact, exact.demonstration, sphere.waypoint, config)
            radius = max(radius, at.radius)
        allowed.append(radius)
    return allowed


def _noise_totals(draws: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    exact, allowed, cloud = (
        np.concatenate([draw[of] for draw in draws]) for of in ("exact", "allowed", "cloud")
    )
    share, kept = cloud / exact, cloud >= SuggestConfig().min_radius
    return {
        "n_radii": len(share),
        "n_larger": int((cloud > allowed + _LARGER).sum()),
        "n_larger_but_passing": int((allowed > exact + _LARGER).sum()),
        "largest_excess_mm": float(1e3 * (cloud - allowed).max()),
        "median_share": float(np.median(share)),
        "median_share_kept": float(np.median(share[kept])) if kept.any() else None,
        "n_lost": int((~kept).sum()),
        "seconds": float(np.median([draw["seconds"] for draw in draws])),
    }


def _demonstrated(cell: Cell, seed: int) -> tuple[Demonstration, RobotSpec]:
    """The scripted operator's demonstration of a cell, with images, and the robot."""
    task = cell.task
    with closing(cell.make_backend()) as backend:
        robot = backend.robot
        model = RobotModel(robot, task.scene.held)
        plan = task.plan(task.initial_state(model, Placement()))
        operator = ScriptedOperator(plan, np.random.default_rng(seed))
        return record_demonstration(backend, task, model, operator, seed=seed), robot


def _compared(cell: Cell, seed: int) -> dict[str, Any]:
    task = cell.task
    demonstration, robot = _demonstrated(cell, seed)
    exact = ExactWorld(demonstration, robot, task.scene)
    started = time.perf_counter()
    annotation = suggest_annotation(demonstration, exact)
    seconds_exact = time.perf_counter() - started
    cloud = CloudWorld(demonstration, robot, task.scene)
    started = time.perf_counter()
    tiled = suggest_annotation(demonstration, cloud)
    seconds_cloud = time.perf_counter() - started
    config = SuggestConfig(min_radius=_LEAST_RADIUS)
    spheres: list[dict[str, Any]] = []
    for sphere in annotation.spheres:
        of = {
            name: suggest_radius(world, demonstration, sphere.waypoint, config)
            for name, world in (("exact", exact), ("cloud", cloud))
        }
        spheres.append(
            {"waypoint": sphere.waypoint}
            | {name: found.radius for name, found in of.items()}
            | {f"{name}_limited_by": found.limited_by for name, found in of.items()}
        )
    still = next(
        (t for t, phase in enumerate(exact.phases) if phase.contacts or phase.grasped),
        len(demonstration),
    )
    errors = None
    if still > 1:
        fused = fuse_cloud(demonstration, robot, task.scene.held, range(still))
        bodies = {name: Ts[0] for name, Ts in demonstration.body_Ts_world.items()}
        seen = fused.where(~fused.behind)
        distances = 1e3 * surface_errors(seen, task.scene, bodies)
        errors = {
            "points": len(seen),
            "median_mm": float(np.median(distances)),
            "p95_mm": float(np.percentile(distances, 95)),
            "max_mm": float(distances.max()),
            "on_robot": _on_robot(seen.points, exact, range(still)),
        }
    return {
        "waypoints": len(demonstration),
        "seconds_exact": seconds_exact,
        "seconds_cloud": seconds_cloud,
        "n_spheres_exact": len(annotation.spheres),
        "n_spheres_cloud": len(tiled.spheres),
        "median_share": float(np.median([s["cloud"] / s["exact"] for s in spheres])),
        "largest_excess_mm": max(1e3 * (s["cloud"] - s["exact"]) for s in spheres),
        "surface_errors": errors,
        "spheres": spheres,
    }
