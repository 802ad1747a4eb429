"""How radii from the recorded images compare with those from the true scene, task by task."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from sart_toolkit.annotate.suggest import SuggestConfig, suggest_annotation, suggest_radius
from sart_toolkit.benchmark.cells import Cell
from sart_toolkit.collision.cloud import fuse_cloud, surface_errors
from sart_toolkit.collision.cloud_world import CloudWorld
from sart_toolkit.collision.exact import ExactWorld
from sart_toolkit.collision.hull import Hull
from sart_toolkit.collision.parts import ConvexPart
from sart_toolkit.data.records import library_versions
from sart_toolkit.data.result_log import ResultLog
from sart_toolkit.poses import Array
from sart_toolkit.record.scripted import ScriptedOperator
from sart_toolkit.record.session import record_demonstration
from sart_toolkit.robots.model import RobotModel
from sart_toolkit.tasks.task import Placement

# Where the two are compared, small radii count too.
_LEAST_RADIUS = 0.0005
_NOTHING: Mapping[str, Any] = MappingProxyType({})


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


def _compared(cell: Cell, seed: int) -> dict[str, Any]:
    task = cell.task
    with closing(cell.make_backend()) as backend:
        robot = backend.robot
        model = RobotModel(robot, task.scene.held)
        plan = task.plan(task.initial_state(model, Placement()))
        operator = ScriptedOperator(plan, np.random.default_rng(seed))
        demonstration = record_demonstration(backend, task, model, operator, seed=seed)
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
        seen = dataclasses.replace(
            fused,
            points=fused.points[~fused.behind],
            colours=fused.colours[~fused.behind],
            behind=fused.behind[~fused.behind],
        )
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
