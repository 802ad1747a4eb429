"""`sart benchmark ...`: our own measurements, over tasks and backends."""

from __future__ import annotations

import functools
from typing import TYPE_CHECKING, Any

from sart_toolkit import pipeline
from sart_toolkit.backends import BACKENDS, get_backend, make_backend
from sart_toolkit.cli.arguments import (
    Benchmark,
    BenchmarkCloud,
    BenchmarkOperator,
    BenchmarkRadii,
    BenchmarkReplay,
    BenchmarkSegments,
    BenchmarkSkill,
    whole_numbers,
)
from sart_toolkit.cli.console import ProgressDisplay, say, typed
from sart_toolkit.cli.info import plain
from sart_toolkit.cli.workers import chosen_workers
from sart_toolkit.data.records import library_versions
from sart_toolkit.data.schemas import EvaluationFile
from sart_toolkit.data.storage import OutputLock, check_writable, read_json, write_json
from sart_toolkit.doctor import machine
from sart_toolkit.errors import InvalidInput, SartError
from sart_toolkit.robots import get_robot
from sart_toolkit.tasks import TASKS, get_task
from sart_toolkit.workers import Workers

if TYPE_CHECKING:
    from sart_toolkit.benchmark.cells import Cell

Result = dict[str, Any]


def _pairs(tasks: str, backends: str) -> list[tuple[str, str]]:
    """Every task of one list with every backend of the other, known names all of them."""
    what = list(TASKS) if tasks == "all" else tasks.split(",")
    where = list(BACKENDS) if backends == "all" else backends.split(",")
    for task in what:
        pipeline.check_names(task=task)
    for backend in where:
        pipeline.check_names(backend=backend)
    return [(task, backend) for task in what for backend in where]


def _cells(tasks: str, backends: str) -> list[Cell]:
    pairs = _pairs(tasks, backends)
    from sart_toolkit.benchmark.cells import Cell

    cells = []
    for task_name, backend_name in pairs:
        task, backend = get_task(task_name), get_backend(backend_name)
        make = functools.partial(make_backend, backend, get_robot(task.robot), task.scene, 128)
        cells.append(Cell(task, backend.name, make))
    return cells


def plan_verb(args: Benchmark) -> Result:
    """`sart benchmark PLAN`.

    Raises:
        SartError: a cell failed; the others are done.
    """
    with ProgressDisplay() as progress:
        result = pipeline.run_benchmark(
            args.plan,
            args.out,
            changes=_changes(args.set),
            only=args.only,
            store=args.store,
            workers=chosen_workers(args),
            command=typed(),
            dry_run=args.dry_run,
            progress=progress,
        )
    if args.dry_run:
        return _needed(result)
    if result["failed"]:
        name, reason = next(iter(result["failed"].items()))
        raise SartError(
            f"{len(result['failed'])} of {len(result['failed']) + len(result['cells'])} cells "
            f"failed, the first {name}: {reason}; the others are in {args.out / 'benchmark.html'}"
        )
    lines = {
        " ".join([entry["row"], entry["column"], *table["given"].values()]): _rate(entry["rate"])
        for table in result["tables"]
        for entry in table["entries"]
        if "rate" in entry
    }
    return {"page": str(args.out / "benchmark.html"), "cells": len(result["cells"]), **lines}


def _changes(words: tuple[str, ...]) -> dict[str, Any]:
    """Values of fields by name, each a list where there are several."""
    changes: dict[str, Any] = {}
    for word in words:
        name, equals, text = word.partition("=")
        if not equals:
            raise InvalidInput(f"--set: expected FIELD=VALUE, got {word!r}")
        values = [int(v) if v.lstrip("-").isdecimal() else v for v in text.split(",")]
        changes[name] = values if len(values) > 1 else values[0]
    return changes


def _needed(preview: Result) -> Result:
    """What a dry run says."""
    measured = ", ".join(preview["measured"]) or "none"
    cells = {
        name: f"missing {', '.join(cell['missing'])}: {_time(cell['seconds'])}"
        if cell["missing"]
        else "done"
        for name, cell in preview["cells"].items()
    }
    done = sum(not cell["missing"] for cell in preview["cells"].values())
    return {
        **cells,
        "cells": f"{len(cells)}, {done} of them done",
        "jobs": f"{preview['jobs']} missing, each counted once",
        "time": f"about {_time(preview['seconds'])} (stages measured here: {measured})",
        "disk": f"about {preview['bytes'] / 1e6:.0f} MB more",
    }


def _time(seconds: float) -> str:
    minutes = seconds / 60
    return f"{minutes:.0f} min" if minutes < 120 else f"{minutes / 60:.1f} h"


def operator_verb(args: BenchmarkOperator) -> Result:
    """`sart benchmark operator`."""
    cells = _cells(args.tasks, args.backends)
    from sart_toolkit.benchmark.operator import BenchmarkConfig, benchmark_operator

    config = BenchmarkConfig(args.episodes, args.seed, args.yaw_deg)
    with ProgressDisplay() as progress:
        result = benchmark_operator(
            cells, config, args.out, chosen_workers(args), args.overwrite,
            lambda done, wanted, successes: progress(
                "operator", done, wanted, f"{successes}/{done} succeeded"
            ),
        )  # fmt: skip
    return {"benchmark": str(args.out)} | {
        name: _rate(row) + f", {row['median_seconds']:.1f} s"
        for name, row in result["cells"].items()
    }


def _rate(row: Result) -> str:
    low, high = (100 * end for end in row["ci95"])
    return f"{row['n_success']}/{row['n_episodes']} (95 % interval {low:.0f} to {high:.0f} %)"


def replay_verb(args: BenchmarkReplay) -> Result:
    """`sart benchmark replay`."""
    cells = _cells(args.tasks, args.backends)
    check_writable(args.out, args.overwrite)
    from sart_toolkit.benchmark.replay import benchmark_replay

    with ProgressDisplay() as progress:
        result = benchmark_replay(
            cells, args.seed, args.out, args.overwrite,
            lambda done, wanted: progress("replay", done, wanted),
        )  # fmt: skip
    return {"benchmark": str(args.out)} | {
        f"{row['task']}: {row['recorded_on']} to {row['replayed_on']}": (
            f"{'success' if row['replayed_success'] else row['reason']}, "
            f"{row['tool_difference_mm']:.2f} mm and {row['tool_difference_deg']:.2f} deg apart "
            f"over {row['steps_compared']} of {row['steps']} steps"
        )
        for row in result["replays"]
    }


def segments_verb(args: BenchmarkSegments) -> Result:
    """`sart benchmark segments`."""
    cells = _cells(args.tasks, args.backends)
    from sart_toolkit.benchmark.segments import SegmentsConfig, benchmark_segments

    config = SegmentsConfig(args.count, whole_numbers("seed", args.seed), args.source)
    with ProgressDisplay() as progress:
        result = benchmark_segments(
            cells, config, args.out, chosen_workers(args), args.overwrite,
            lambda done, wanted, kept: progress("segments", done, wanted, f"{kept}/{done} kept"),
            _about(),
        )  # fmt: skip

    def line(row: Result) -> str:
        low, high = (100 * end for end in row["ci95"])
        return (
            f"{row['kept']}/{row['attempted']} kept (95 % interval {low:.1f} to {high:.1f} %), "
            f"{row['contacts']} contacts, {row['left_path']} off their path, "
            f"{row['limits']['motions_that_violate']} beyond limits"
        )

    return {"benchmark": str(args.out)} | {
        name: line(row) for name, row in [*result["cells"].items(), ("all", result["total"])]
    }


def radii_verb(args: BenchmarkRadii) -> Result:
    """`sart benchmark radii`."""
    cells = _cells(args.tasks, args.backends)
    from sart_toolkit.benchmark.radii import RadiiConfig, benchmark_radii
    from sart_toolkit.testing.closest import ClosestPoints

    config = RadiiConfig(args.draws, args.directed, seed=args.seed)
    with ProgressDisplay() as progress:
        result = benchmark_radii(
            cells, ClosestPoints, config, args.out, chosen_workers(args), args.overwrite,
            lambda done, wanted: progress("radii", done, wanted), _about(),
        )  # fmt: skip
    return {"benchmark": str(args.out)} | {
        name: (
            f"{row['n_collisions']} collisions in {row['n_draws']} draws from {row['n_spheres']} "
            f"spheres; grown, {row['n_collided_when_grown']} of {row['n_limited_by_pair']} collide"
        )
        for name, row in [*result["cells"].items(), ("all", result["total"])]
    }


def cloud_verb(args: BenchmarkCloud) -> Result:
    """`sart benchmark cloud`."""
    cells = _cells(args.tasks, args.backends)
    check_writable(args.out, args.overwrite)
    from sart_toolkit.benchmark.clouds import benchmark_clouds, benchmark_noise

    workers = chosen_workers(args)
    if not workers.here and not args.noise:
        raise InvalidInput("--workers: radii without noise take one process; add --noise")
    if args.noise:
        with ProgressDisplay() as progress:
            result = benchmark_noise(
                cells, args.noise, args.out, args.seed, workers=workers,
                overwrite=args.overwrite,
                progress=lambda done, wanted: progress("cloud", done, wanted), about=_about(),
            )  # fmt: skip
        return {"benchmark": str(args.out)} | {
            name: f"{row['n_larger']} of {row['n_radii']} radii too large; "
            f"{row['median_share']:.0%} of the exact radii at the median, "
            f"{row['n_lost']} spheres lost"
            for name, row in result["total"].items()
        }
    with ProgressDisplay() as progress:
        result = benchmark_clouds(
            cells, args.seed, args.out, args.overwrite,
            lambda done, wanted: progress("cloud", done, wanted), _about(),
        )  # fmt: skip
    return {"benchmark": str(args.out)} | {
        name: f"{row['median_share']:.0%} of the exact radii at the median, at most "
        f"{row['largest_excess_mm']:+.1f} mm larger{_surface_line(row.get('surface_errors'))}"
        for name, row in [*result["cells"].items(), ("all", result["total"])]
    }


def _surface_line(errors: Result | None) -> str:
    if errors is None:
        return ""
    return (
        f"; {errors['points']} points, {errors['median_mm']:.2f} mm off the true surfaces at the "
        f"median, {errors['p95_mm']:.2f} at the 95th percentile, {errors['on_robot']} on the robot"
    )


def _about() -> Result:
    """What a benchmark's figures depend on, besides what is in its own config."""
    return {"command": typed(), "machine": machine()}


def skill_verb(args: BenchmarkSkill) -> Result:
    """`sart benchmark skill`: one `sart run` after the other, then their figures."""
    pairs = _pairs(args.tasks, args.backends)
    workers = chosen_workers(args)
    with OutputLock(args.out / "benchmark.json"):
        return _skills(args, pairs, workers)


def _skills(args: BenchmarkSkill, pairs: list[tuple[str, str]], workers: Workers) -> Result:
    rows: Result = {}
    for task, backend in pairs:
        at = get_task(task).name, get_backend(backend).name
        name, out = "/".join(at), args.out / "-".join(at)
        say(f"{name}:")
        with ProgressDisplay() as progress:
            run = pipeline.run(
                task,
                out,
                backend=backend,
                policy=args.policy,
                n=args.n,
                epochs=args.epochs,
                episodes=args.episodes,
                seed=args.seed,
                eval_seed=args.eval_seed,
                workers=workers,
                device=args.device,
                command=typed(),
                progress=progress,
            )
        evaluation = read_json(out / "evaluation.json", EvaluationFile)
        rows[name] = {
            key: evaluation[key] for key in ("n_success", "n_episodes", "success_rate", "ci95")
        } | {key: run[key] for key in ("kept", "attempted", "stages_seconds")}
        write_json(
            args.out / "benchmark.json",
            {"config": plain(args), "cells": rows, "versions": library_versions()},
        )
    return {"benchmark": str(args.out / "benchmark.json")} | {
        name: _rate(row) for name, row in rows.items()
    }
