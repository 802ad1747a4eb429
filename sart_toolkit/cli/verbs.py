"""The verbs of `sart`: turn names into objects, call the package, say what came of it."""

from __future__ import annotations

import dataclasses
import functools
import json
import shlex
import sys
import time
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np

from sart_toolkit import doctor
from sart_toolkit.annotate.suggest import suggest_annotation
from sart_toolkit.augment.config import AugmentConfig
from sart_toolkit.augment.engine import augment_demonstration
from sart_toolkit.augment.validate import validate_dataset
from sart_toolkit.backends import BACKENDS, make_backend
from sart_toolkit.backends.interface import BackendFactory
from sart_toolkit.benchmark.cells import Cell
from sart_toolkit.benchmark.clouds import benchmark_clouds
from sart_toolkit.benchmark.operator import BenchmarkConfig, benchmark_operator
from sart_toolkit.benchmark.radii import RadiiConfig, benchmark_radii
from sart_toolkit.benchmark.replay import benchmark_replay
from sart_toolkit.benchmark.segments import SegmentsConfig, benchmark_segments
from sart_toolkit.cli.annotate import (
    annotate_verb,
    describe_spheres,
    suggest_config,
    world_of,
)
from sart_toolkit.cli.arguments import (
    Annotate,
    Augment,
    BenchmarkCloud,
    BenchmarkOperator,
    BenchmarkRadii,
    BenchmarkReplay,
    BenchmarkSegments,
    BenchmarkSkill,
    Evaluate,
    Info,
    Play,
    Record,
    Run,
    Suggest,
    Train,
    Validate,
)
from sart_toolkit.cli.console import progress_bar, say, show
from sart_toolkit.cli.play import check_play_options, load_playback, play
from sart_toolkit.cli.teleop import check_hand_options, record_by_hand
from sart_toolkit.data.dataset import MANIFEST, Dataset, load_dataset
from sart_toolkit.data.records import DEFAULT_RATES, Demonstration, Rates, library_versions
from sart_toolkit.data.sampling import SamplingConfig
from sart_toolkit.data.storage import (
    check_writable,
    clear_directory,
    load_annotation,
    load_demonstration,
    load_recording,
    read_json,
    save_annotation,
    save_demonstration,
    write_json,
)
from sart_toolkit.errors import BrokenFile, InvalidInput, Mismatch, MissingFile, unknown_name
from sart_toolkit.evaluate.rollout import EvaluateConfig, evaluate_skill
from sart_toolkit.learn.skill import load_skill, save_skill
from sart_toolkit.learn.training import TrainConfig, train
from sart_toolkit.record.devices import make_device
from sart_toolkit.record.devices.manual import ManualDevice
from sart_toolkit.record.session import DeviceSetup, SessionConfig, record_demonstration
from sart_toolkit.report.page import write_report
from sart_toolkit.report.player import SceneView
from sart_toolkit.report.video import film_rollout
from sart_toolkit.robots import get_robot
from sart_toolkit.robots.model import RobotModel
from sart_toolkit.robots.spec import ImageSize, check_image_size
from sart_toolkit.scenes.appearance import vary_appearance
from sart_toolkit.tasks import TASKS, get_task
from sart_toolkit.tasks.task import Placement, Task
from sart_toolkit.testing.closest import ClosestPoints

Result = dict[str, Any]


def run_verb(verb: Any) -> None:
    """Carry out a parsed command and print its result."""
    show(_VERBS[type(verb)](verb), verb.json)


def _backend_factory(
    name: str,
    task: Task,
    robot: str | None,
    image_size: ImageSize,
    rates: Rates = DEFAULT_RATES,
) -> BackendFactory:
    if name not in BACKENDS:
        raise unknown_name("backend", name, BACKENDS)
    size = check_image_size(image_size)
    if min(size) < 16:
        raise InvalidInput(f"image_size: expected at least 16 pixels, got {image_size}")
    return functools.partial(
        make_backend, name, get_robot(robot or task.robot), task.scene, size, rates
    )


def _train_config(policy: str, **given: Any) -> TrainConfig:
    """The policy's own options, with those that were given on the command line."""
    chosen = {name: value for name, value in given.items() if value is not None}
    return TrainConfig.for_policy(policy, **chosen)


def _image_size(demonstration: Demonstration) -> tuple[int, int]:
    """Width and height of a demonstration's pictures."""
    height, width = next(iter(demonstration.steps.cameras.values())).rgb.shape[1:3]
    return width, height


def record_verb(args: Record) -> Result:
    """`sart record`."""
    task = get_task(args.task)
    make = _backend_factory(args.backend, task, args.robot, args.image_size)
    check_writable(args.out, args.overwrite)
    if args.vary_looks:
        looks = np.random.default_rng([args.seed, 1])
        varied = vary_appearance(get_robot(args.robot or task.robot), task.scene, looks)
        make = functools.partial(
            make_backend, args.backend, *varied, check_image_size(args.image_size)
        )
    rng = np.random.default_rng(args.seed)
    placement = Placement()
    if args.placement == "random":
        placement = task.sample_placement(rng, args.yaw_deg)
    elif args.yaw_deg:
        raise InvalidInput("--yaw-deg: turns random placements only; add --placement random")
    with closing(make()) as backend:
        model = RobotModel(backend.robot, backend.scene.held)
        state = task.initial_state(model, placement)
        device = make_device(
            args.device,
            DeviceSetup(
                backend, task, model, state, rng, args.frame or "world", args.operator or "person"
            ),
        )
        check_hand_options(args, device.interactive)
        if isinstance(device, ManualDevice):
            demonstration = record_by_hand(args, backend, task, model, device, placement)
        else:
            config = SessionConfig(tuple(args.cameras.split(",")), args.max_seconds)
            with progress_bar("record", None, "s") as bar:
                demonstration = record_demonstration(
                    backend, task, model, device, placement, args.seed, config,
                    progress=lambda seconds: bar.update(seconds - bar.n),
                )  # fmt: skip
            achieved = task.achieved(demonstration.success, demonstration.rates.record_hz)
            if demonstration.judged_by == "task" and not achieved:
                raise Mismatch(
                    "the demonstration did not reach the goal; record again with another --seed"
                )
            save_demonstration(args.out, demonstration)
    return {"demonstration": str(args.out), **_describe_demonstration(demonstration)}


def play_verb(args: Play) -> Result:
    """`sart play`."""
    check_play_options(args)
    playback = load_playback(args.file)
    shown = playback.demonstration
    if args.camera in shown.steps.cameras:
        playback.camera = args.camera
        return play(args, playback, None)
    make = _backend_factory(
        args.backend or shown.backend, get_task(shown.task), shown.robot, _image_size(shown),
        shown.rates,
    )  # fmt: skip
    with closing(make()) as backend:
        return play(args, playback, SceneView(playback, backend, args.camera))


def suggest_verb(args: Suggest) -> Result:
    """`sart suggest`."""
    demonstration = load_demonstration(args.demo)
    config = suggest_config(args)
    check_writable(args.out, args.overwrite)
    world = world_of(args, demonstration)
    with progress_bar("suggest", len(demonstration), "waypoint") as bar:
        annotation = suggest_annotation(
            demonstration,
            world,
            args.waypoints or None,
            config,
            progress=lambda t: bar.update(t + 1 - bar.n),
        )
        bar.update(len(demonstration) - bar.n)
    save_annotation(args.out, annotation)
    return {"annotation": str(args.out), "spheres": describe_spheres(annotation)}


def augment_verb(args: Augment) -> Result:
    """`sart augment`."""
    demonstration = load_demonstration(args.demo)
    annotation = load_annotation(args.annotation)
    config = AugmentConfig(
        n=args.n,
        allocation=args.allocation,
        strategy=args.strategy,
        sampling=SamplingConfig(args.distribution, args.rotation_per_metre),
        duration=args.duration,
        margin=args.margin,
        slip_tolerance=args.slip_tolerance,
        obstacles=args.source,
        seed=args.seed,
    )
    task = get_task(demonstration.task)
    make = _backend_factory(
        args.backend or demonstration.backend,
        task,
        demonstration.robot,
        _image_size(demonstration),
        demonstration.rates,
    )
    with progress_bar("augment", args.n - 1, "trajectory") as bar:

        def progress(kept: int, wanted: int, rejected: int) -> None:
            bar.set_postfix_str(f"{rejected} rejected", refresh=False)
            bar.update(kept - bar.n)

        dataset = augment_demonstration(
            demonstration,
            annotation,
            make,
            args.out,
            config,
            args.workers,
            args.overwrite,
            progress,
        )
    return {"dataset": str(args.out), **_describe_dataset(dataset)}


def validate_verb(args: Validate) -> Result:
    """`sart validate`."""
    demonstration = load_dataset(args.dataset).sources[0].demonstration
    task = get_task(demonstration.task)
    with progress_bar("validate", None, "episode") as bar:

        def progress(done: int, wanted: int) -> None:
            bar.total = wanted
            bar.update(done - bar.n)

        found = validate_dataset(args.dataset, get_robot(demonstration.robot), task.scene, progress)
    for name, problem in found.problems.items():
        say(f"{name}: {problem}")
    if found.problems:
        raise Mismatch(
            f"{args.dataset}: {len(found.problems)} of {found.episodes} episodes don't hold; "
            "generate them again"
        )
    return {
        "dataset": str(args.dataset),
        "episodes": found.episodes,
        "least_clearance_mm": round(found.least_clearance * 1e3, 3),
        "largest_deviation_mm": round(found.largest_deviation * 1e3, 3),
    }


def train_verb(args: Train) -> Result:
    """`sart train`."""
    config = _train_config(
        args.policy,
        epochs=args.epochs,
        lr=args.lr,
        batch_size=args.batch_size,
        image_size=args.image_size,
        image_shift=args.image_shift,
        schedule=args.schedule,
        norm=args.norm,
        backbone_weights=args.backbone_weights and str(args.backbone_weights),
        cameras=tuple(args.cameras.split(",")),
        seed=args.seed,
        device=args.device,
    )
    dataset = load_dataset(args.dataset)
    check_writable(args.out / "config.json", args.overwrite)
    if args.overwrite and (args.out / "config.json").exists():
        clear_directory(args.out, "config.json", overwrite=True)
    with (
        progress_bar("read", None, "trajectory") as read,
        progress_bar("train", None, "step") as bar,
    ):

        def reading(done: int, total: int) -> None:
            read.total = total
            read.update(done - read.n)

        def progress(done: int, total: int, text: str) -> None:
            bar.total = total
            bar.set_postfix_str(text, refresh=False)
            bar.update(done - bar.n)

        result = train(dataset, config, args.out, progress, reading=reading)
    save_skill(args.out, result, dataset)
    return {"skill": str(args.out), **_describe_skill(args.out)}


def evaluate_verb(args: Evaluate) -> Result:
    """`sart evaluate`."""
    skill = load_skill(args.skill)
    task = get_task(skill.config.task)
    config = EvaluateConfig(
        args.episodes, args.eval_seed, args.videos, args.yaw_deg, args.vary_looks
    )
    make = _backend_factory(
        args.backend or skill.config.backend,
        task,
        skill.config.robot,
        skill.config.cameras[skill.cameras[0]].size[::-1],
        skill.demonstration.rates,
    )
    check_writable(args.out, args.overwrite)
    with progress_bar("evaluate", args.episodes, "rollout") as bar:

        def progress(done: int, wanted: int, successes: int) -> None:
            bar.set_postfix_str(f"{successes}/{done} succeeded", refresh=False)
            bar.update(done - bar.n)

        result = evaluate_skill(
            args.skill, task, make, config, args.out, args.workers, args.device, progress,
            film_rollout if config.videos else None,
        )  # fmt: skip
    return {"evaluation": str(args.out), **_without_rows(result)}


def run_whole(args: Run) -> Result:
    """`sart run`: each step unless its result is there already, then the report."""
    # What can't work should be said before anything is written.
    _backend_factory(args.backend, get_task(args.task), args.robot, args.image_size)
    AugmentConfig(n=args.n, sampling=SamplingConfig(args.distribution), seed=args.seed)
    _train_config(args.policy, epochs=args.epochs, seed=args.seed, device=args.device)
    EvaluateConfig(args.episodes, args.eval_seed)
    out = args.out
    wanted = {
        k: v for k, v in _plain(args).items() if k not in ("out", "overwrite", "json", "workers")
    }
    state_file = out / "run.json"
    state: Result = {"config": wanted, "stages": {}}
    if args.overwrite:
        clear_directory(out, state_file.name, overwrite=True)
    elif state_file.exists():
        state = read_json(state_file)
        if state["config"] != wanted:
            changed = [k for k, v in wanted.items() if state["config"].get(k) != v]
            raise Mismatch(
                f"{out}: holds a run with another {', '.join(changed)}; add --overwrite or choose "
                "another --out"
            )
    else:
        check_writable(out)
    state |= {
        "command": shlex.join(["sart", *sys.argv[1:]]),
        "versions": library_versions(),
        "machine": doctor.machine(),
    }
    write_json(state_file, state)
    demo, annotation, dataset = out / "demo.h5", out / "annotation.json", out / "dataset"
    skill, evaluation = out / "skill", out / "evaluation.json"
    steps: list[tuple[str, Path, Callable[[], Result]]] = [
        ("record", demo, lambda: record_verb(Record(
            args.task, demo, backend=args.backend, robot=args.robot, seed=args.seed,
            image_size=args.image_size,
        ))),
        ("suggest", annotation, lambda: suggest_verb(Suggest(demo, annotation))),
        ("augment", dataset / "dataset.json", lambda: augment_verb(Augment(
            demo, annotation, dataset, args.n, distribution=args.distribution, seed=args.seed,
            workers=args.workers,
        ))),
        ("train", skill / "config.json", lambda: train_verb(Train(
            dataset, skill, args.policy, args.epochs, seed=args.seed, device=args.device
        ))),
        ("evaluate", evaluation, lambda: evaluate_verb(Evaluate(
            skill, evaluation, episodes=args.episodes, eval_seed=args.eval_seed,
            workers=args.workers, device=args.device,
        ))),
    ]  # fmt: skip
    for name, result, carry_out in steps:
        if result.exists():
            say(f"{name:<9} done before: {result}")
            continue
        started = time.perf_counter()
        try:
            carry_out()
        finally:
            # Also what an interrupted stage took, which will be gone on with.
            seconds = state["stages"].get(name, 0.0) + time.perf_counter() - started
            state["stages"][name] = seconds
            write_json(state_file, state)
        say(f"{name:<9} {seconds:6.1f} s  {result}")
    report = out / "report.html"
    write_report(out, report)
    figures = read_json(evaluation)
    generated = read_json(dataset / "dataset.json")
    return {
        "task": args.task,
        "success": f"{figures['n_success']}/{figures['n_episodes']}",
        "success_rate": figures["success_rate"],
        "ci95": figures["ci95"],
        "kept": generated["n_kept"],
        "attempted": generated["n_attempted"],
        "stages_seconds": {k: round(v, 1) for k, v in state["stages"].items()},
        "seconds": round(sum(state["stages"].values()), 1),
        "skill": str(skill),
        "report": str(report),
    }


def _cells(tasks: str, backends: str) -> list[Cell]:
    """Every task of one list on every backend of the other."""
    names = list(TASKS) if tasks == "all" else tasks.split(",")
    where = list(BACKENDS) if backends == "all" else backends.split(",")
    return [
        Cell(task, backend, _backend_factory(backend, task, None, 128))
        for task in map(get_task, names)
        for backend in where
    ]


def benchmark_operator_verb(args: BenchmarkOperator) -> Result:
    """`sart benchmark operator`."""
    cells = _cells(args.tasks, args.backends)
    config = BenchmarkConfig(args.episodes, args.seed, args.yaw_deg)
    with progress_bar("operator", len(cells) * args.episodes, "episode") as bar:

        def progress(done: int, wanted: int, successes: int) -> None:
            bar.set_postfix_str(f"{successes}/{done} succeeded", refresh=False)
            bar.update(done - bar.n)

        result = benchmark_operator(cells, config, args.out, args.workers, args.overwrite, progress)
    return {"benchmark": str(args.out)} | {
        name: _rate(row) + f", {row['median_seconds']:.1f} s"
        for name, row in result["cells"].items()
    }


def _rate(row: Result) -> str:
    low, high = (100 * end for end in row["ci95"])
    return f"{row['n_success']}/{row['n_episodes']} (95 % interval {low:.0f} to {high:.0f} %)"


def benchmark_replay_verb(args: BenchmarkReplay) -> Result:
    """`sart benchmark replay`."""
    cells = _cells(args.tasks, args.backends)
    check_writable(args.out, args.overwrite)
    with progress_bar("replay", None, "replay") as bar:

        def progress(done: int, wanted: int) -> None:
            bar.total = wanted
            bar.update(done - bar.n)

        result = benchmark_replay(cells, args.seed, progress)
    write_json(args.out, result)
    return {"benchmark": str(args.out)} | {
        f"{row['task']}: {row['recorded_on']} to {row['replayed_on']}": (
            f"{'success' if row['replayed_success'] else row['reason']}, "
            f"{row['tool_difference_mm']:.2f} mm and {row['tool_difference_deg']:.2f} deg apart "
            f"over {row['steps_compared']} of {row['steps']} steps"
        )
        for row in result["replays"]
    }


def benchmark_segments_verb(args: BenchmarkSegments) -> Result:
    """`sart benchmark segments`."""
    cells = _cells(args.tasks, args.backends)
    config = SegmentsConfig(args.count, args.seed, args.source)
    with progress_bar("segments", args.count, "segment") as bar:

        def progress(done: int, wanted: int, kept: int) -> None:
            bar.set_postfix_str(f"{kept}/{done} kept", refresh=False)
            bar.update(done - bar.n)

        result = benchmark_segments(
            cells, config, args.out, args.workers, args.overwrite, progress, _about()
        )

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


def benchmark_radii_verb(args: BenchmarkRadii) -> Result:
    """`sart benchmark radii`."""
    cells = _cells(args.tasks, args.backends)
    config = RadiiConfig(args.draws, args.directed, seed=args.seed)
    with progress_bar("radii", len(cells), "task") as bar:

        def progress(done: int, wanted: int) -> None:
            bar.update(done - bar.n)

        result = benchmark_radii(
            cells, ClosestPoints, config, args.out, args.workers, args.overwrite, progress, _about()
        )
    return {"benchmark": str(args.out)} | {
        name: (
            f"{row['n_collisions']} collisions in {row['n_draws']} draws from {row['n_spheres']} "
            f"spheres; grown, {row['n_collided_when_grown']} of {row['n_limited_by_pair']} collide"
        )
        for name, row in [*result["cells"].items(), ("all", result["total"])]
    }


def benchmark_cloud_verb(args: BenchmarkCloud) -> Result:
    """`sart benchmark cloud`."""
    cells = _cells(args.tasks, args.backends)
    check_writable(args.out, args.overwrite)
    with progress_bar("cloud", len(cells), "task") as bar:
        result = benchmark_clouds(cells, args.seed, lambda done, _: bar.update(done - bar.n))
    write_json(args.out, _about() | result)
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
    return {"command": shlex.join(["sart", *sys.argv[1:]]), "machine": doctor.machine()}


def benchmark_skill_verb(args: BenchmarkSkill) -> Result:
    """`sart benchmark skill`: one `sart run` after the other, then their figures."""
    rows: Result = {}
    for cell in _cells(args.tasks, args.backends):
        say(f"{cell.name}:")
        run = run_whole(
            Run(
                cell.task.name, args.out / f"{cell.task.name}-{cell.backend}", cell.backend,
                policy=args.policy, n=args.n, epochs=args.epochs, episodes=args.episodes,
                seed=args.seed, eval_seed=args.eval_seed, workers=args.workers,
                device=args.device,
            )
        )  # fmt: skip
        evaluation = read_json(args.out / f"{cell.task.name}-{cell.backend}" / "evaluation.json")
        rows[cell.name] = {
            key: evaluation[key] for key in ("n_success", "n_episodes", "success_rate", "ci95")
        } | {key: run[key] for key in ("kept", "attempted", "stages_seconds")}
        write_json(
            args.out / "benchmark.json",
            {"config": _plain(args), "cells": rows, "versions": library_versions()},
        )
    return {"benchmark": str(args.out / "benchmark.json")} | {
        name: _rate(row) for name, row in rows.items()
    }


def info_verb(args: Info) -> Result:
    """`sart info`: by what the file or directory holds."""
    path = args.file
    if not path.exists():
        raise MissingFile(f"{path}: no such file or directory; check the path")
    if path.is_dir():
        if (path / "run.json").exists():
            state = read_json(path / "run.json")
            return {"kind": "run", **state["config"], "stages": state["stages"]}
        if (path / "model.safetensors").exists():
            return {"kind": "skill", **_describe_skill(path)}
        if (path / MANIFEST).exists():
            return {"kind": "dataset", **_describe_dataset(load_dataset(path))}
        raise BrokenFile(f"{path}: holds no run, skill or dataset; pass another directory")
    if path.suffix == ".json":
        value = read_json(path)
        if "spheres" in value:
            spheres = load_annotation(path).spheres
            return {
                "kind": "annotation",
                "demonstration": value["demonstration_hash"],
                "spheres": [
                    f"waypoint {s.waypoint}: {s.radius * 1e3:.1f} mm ({s.source})" for s in spheres
                ],
            }
        if "success_rate" in value:
            return {"kind": "evaluation", **_without_rows(value)}
        raise BrokenFile(f"{path}: neither an annotation nor an evaluation; pass another file")
    recording = load_recording(path)
    if isinstance(recording, Demonstration):
        return {"kind": "demonstration", **_describe_demonstration(recording)}
    return {"kind": "episode", "steps": len(recording), **_plain(recording.provenance)}


def _describe_demonstration(demonstration: Demonstration) -> Result:
    d = demonstration
    return {
        "task": d.task,
        "robot": d.robot,
        "backend": d.backend,
        "waypoints": len(d),
        "seconds": float(d.timestamps[-1]),
        "success": bool(d.success[-1]),
        "placement": dict(d.task_parameters.get("placement", {})),
        "cameras": {k: "x".join(map(str, c.rgb.shape[2:0:-1])) for k, c in d.steps.cameras.items()},
        "operator": d.operator,
        "device": d.device,
        "seconds_spent": round(d.seconds, 1),
        "content_hash": d.content_hash(),
    }


def _describe_dataset(dataset: Dataset) -> Result:
    keys = (
        "task",
        "n_trajectories",
        "n_kept",
        "n_attempted",
        "rejections",
        "seconds",
        "content_hash",
    )
    return {k: dataset.info[k] for k in keys}


def _describe_skill(path: Path) -> Result:
    skill = load_skill(path)
    training = skill.training
    return {
        "task": skill.config.task,
        "robot": skill.config.robot,
        "policy": skill.config.training.policy,
        "epochs": skill.config.training.epochs,
        "image_size": skill.config.training.image_size,
        "trajectories": training["trajectories"],
        "final_loss": training["final_loss"],
        "seconds": training["seconds"],
        "images_per_second": training["images_per_second"],
    }


def _without_rows(evaluation: Result) -> Result:
    """The figures of an evaluation, without what it lists for each episode."""
    rows = ("episodes", "versions", "config", "seeds", "videos")
    return {k: v for k, v in evaluation.items() if k not in rows}


def _plain(record: Any) -> Result:
    """A dataclass as JSON values."""

    def simple(value: Any) -> Any:
        return value.tolist() if isinstance(value, np.ndarray) else str(value)

    plain: Result = json.loads(json.dumps(dataclasses.asdict(record), default=simple))
    return plain


_VERBS: dict[type, Callable[[Any], Result]] = {
    Run: run_whole,
    Record: record_verb,
    Play: play_verb,
    Suggest: suggest_verb,
    Annotate: annotate_verb,
    Augment: augment_verb,
    Validate: validate_verb,
    Train: train_verb,
    Evaluate: evaluate_verb,
    BenchmarkOperator: benchmark_operator_verb,
    BenchmarkReplay: benchmark_replay_verb,
    BenchmarkSegments: benchmark_segments_verb,
    BenchmarkCloud: benchmark_cloud_verb,
    BenchmarkRadii: benchmark_radii_verb,
    BenchmarkSkill: benchmark_skill_verb,
    Info: info_verb,
}
