"""`sart augment` and `sart validate`."""

from __future__ import annotations

from typing import Any

from sart_toolkit import pipeline
from sart_toolkit.cli.arguments import Augment, Validate
from sart_toolkit.cli.console import ProgressDisplay, say
from sart_toolkit.cli.info import describe_dataset
from sart_toolkit.cli.sensor import declared_sensor
from sart_toolkit.data.sampling import SamplingConfig
from sart_toolkit.errors import Mismatch


def augment_verb(args: Augment) -> dict[str, Any]:
    """`sart augment`."""
    sensor = declared_sensor(args)
    with ProgressDisplay() as progress:
        dataset = pipeline.augment(
            args.demo,
            args.annotation,
            args.out,
            task=args.task,
            robot=args.robot,
            backend=args.backend,
            workers=args.workers,
            overwrite=args.overwrite,
            progress=progress,
            sensor=sensor,
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
    return {"dataset": str(args.out), **describe_dataset(dataset)}


def validate_verb(args: Validate) -> dict[str, Any]:
    """`sart validate`."""
    with ProgressDisplay() as progress:
        found = pipeline.validate(args.dataset, task=args.task, robot=args.robot, progress=progress)
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
