"""`sart run` and `sart report`."""

from __future__ import annotations

from typing import Any

from sart_toolkit import pipeline
from sart_toolkit.cli.arguments import Report, Run
from sart_toolkit.cli.console import ProgressDisplay, typed
from sart_toolkit.cli.workers import chosen_workers


def run_verb(args: Run) -> dict[str, Any]:
    """`sart run`."""
    with ProgressDisplay() as progress:
        return pipeline.run(
            args.task,
            args.out,
            robot=args.robot,
            backend=args.backend,
            strategy=args.strategy,
            policy=args.policy,
            n=args.n,
            demonstrations=args.demonstrations,
            episodes=args.episodes,
            epochs=args.epochs,
            distribution=args.distribution,
            recording=args.recording,
            cameras=args.cameras.split(","),
            image_size=args.image_size,
            seed=args.seed,
            eval_seed=args.eval_seed,
            workers=chosen_workers(args),
            device=args.device,
            overwrite=args.overwrite,
            command=typed(),
            progress=progress,
        )


def report_verb(args: Report) -> dict[str, Any]:
    """`sart report`."""
    return {"report": str(pipeline.report(args.run, args.out, overwrite=args.overwrite))}
