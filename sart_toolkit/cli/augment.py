"""`sart augment` and `sart validate`."""

from __future__ import annotations

import dataclasses
import math
import sys
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from typing import TYPE_CHECKING, Any

from sart_toolkit import pipeline
from sart_toolkit.cli.arguments import Augment, Validate
from sart_toolkit.cli.console import ProgressDisplay, say
from sart_toolkit.cli.formats import check_verb
from sart_toolkit.cli.info import describe_dataset
from sart_toolkit.cli.sensor import declared_sensor
from sart_toolkit.cli.web import check_web
from sart_toolkit.cli.workers import chosen_workers
from sart_toolkit.data.dataset import REPLAY
from sart_toolkit.data.sampling import SamplingConfig
from sart_toolkit.data.storage import check_writable
from sart_toolkit.errors import InvalidInput, Mismatch

if TYPE_CHECKING:
    from sart_toolkit.augment.config import AugmentConfig
    from sart_toolkit.augment.webview import GenerationView
    from sart_toolkit.data.writer import Sources


def augment_verb(args: Augment) -> dict[str, Any]:
    """`sart augment`."""
    annotations = [path for path in args.files if path.suffix == ".json"]
    demos = [path for path in args.files if path not in annotations]
    if not demos:
        raise InvalidInput("FILE: expected a demonstration, got annotations alone; add its .h5")
    check_web(args, "--dry-run" if args.dry_run else "", needed=False)
    sensor = declared_sensor(args, demos)
    options: dict[str, Any] = {
        "task": args.task,
        "robot": args.robot,
        "backend": args.backend,
        "workers": chosen_workers(args),
        "overwrite": args.overwrite,
        "sensor": sensor,
        **({} if args.n is None else {"n": args.n}),
        "allocation": args.allocation,
        "strategy": args.strategy,
        "sampling": SamplingConfig(args.distribution, args.rotation_per_metre),
        "duration": args.duration,
        "execution": args.execution,
        "recording": args.recording,
        "margin": args.margin,
        "slip_tolerance": args.slip_tolerance,
        "obstacles": args.source,
        "seed": args.seed,
    }
    with ExitStack() as stack, ProgressDisplay() as progress:
        if args.dry_run:
            planned = pipeline.preview(demos, annotations, args.out, progress=progress, **options)
            return {"plan": str(args.out), **dataclasses.asdict(planned)}
        dataset = pipeline.augment(
            demos,
            annotations,
            args.out,
            progress=progress,
            ask=_ask if sys.stdin.isatty() else None,
            watch=_watch_on_page(args, stack) if args.web else None,
            **options,
        )
    return {"dataset": str(args.out), **describe_dataset(dataset)}


def _watch_on_page(
    args: Augment, stack: ExitStack
) -> Callable[[Sources, AugmentConfig], GenerationView]:
    """Opens the page of --web, which is closed with the stack."""

    def opened(sources: Sources, config: AugmentConfig) -> GenerationView:
        from sart_toolkit.augment.webview import GenerationView

        robot, scene = pipeline.setting_of(sources[0][0], args.task, args.robot)
        view = GenerationView(sources, config, robot, scene, args.out, args.host, args.port)
        if view.how_to_open:
            say(view.how_to_open)
        return stack.enter_context(view)

    return opened


def _ask(text: str) -> None:
    """Show a person beside the robot what to do, and wait until it is done."""
    say(text)
    input("Press Enter when that is done: ")


def validate_verb(args: Validate) -> dict[str, Any]:
    """`sart validate`."""
    if args.format is not None:
        return check_verb(args, args.format)
    if not args.replay:
        for flag, given in (
            ("backend", args.backend is not None),
            ("workers", args.workers != 1),
            ("executor", args.executor != "processes"),
            ("ray-address", args.ray_address is not None),
            ("overwrite", args.overwrite),
        ):
            if given:
                raise InvalidInput(f"--{flag}: is about executing the trajectories; add --replay")
    else:
        check_writable(args.dataset / REPLAY, args.overwrite)
    replayed = {}
    with ProgressDisplay() as progress:
        found = pipeline.validate(args.dataset, task=args.task, robot=args.robot, progress=progress)
        if args.replay and not found.problems:
            replayed = pipeline.replay(
                args.dataset,
                task=args.task,
                robot=args.robot,
                backend=args.backend,
                workers=chosen_workers(args),
                overwrite=args.overwrite,
                progress=progress,
            )
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
        "least_commanded_clearance_mm": _rounded_down(found.least_commanded_clearance),
        "least_measured_clearance_mm": _rounded_down(found.least_measured_clearance),
        "largest_deviation_mm": math.ceil(1e6 * found.largest_deviation - 1e-6) / 1e3,
        **(_replay_figures(replayed) if replayed else {}),
    }


def _replay_figures(result: Mapping[str, Any]) -> dict[str, Any]:
    """What came of executing a dataset's trajectories; each that failed is said."""
    for row in result["trajectories"]:
        if row["success"] is False:
            say(f"{row['name']}: failed: {row['reason']}")
    return {
        "succeeded": f"{result['n_success']} of {result['n_judged']}",
        **{
            name: result[name]
            for name in ("failures", "largest_difference_mm", "largest_difference_deg")
        },
    }


def _rounded_down(metres: float) -> float | None:
    """A lower bound in mm, so that it stays one; None where there is nothing that it is of."""
    # Parts per million of a micrometre are what the conversion to mm may take away.
    return math.floor(1e6 * metres + 1e-6) / 1e3 if math.isfinite(metres) else None
