"""`sart train` and `sart evaluate`."""

from __future__ import annotations

from typing import Any

from sart_toolkit import pipeline
from sart_toolkit.cli.arguments import Evaluate, Train
from sart_toolkit.cli.console import ProgressDisplay
from sart_toolkit.cli.info import describe_skill, without_rows


def train_verb(args: Train) -> dict[str, Any]:
    """`sart train`."""
    with ProgressDisplay() as progress:
        pipeline.train_policy(
            args.dataset,
            args.out,
            args.policy,
            overwrite=args.overwrite,
            progress=progress,
            epochs=args.epochs,
            lr=args.lr,
            batch_size=args.batch_size,
            image_size=args.image_size,
            image_shift=args.image_shift,
            schedule=args.schedule,
            norm=args.norm,
            cameras=tuple(args.cameras.split(",")),
            backbone_weights=args.backbone_weights and str(args.backbone_weights),
            seed=args.seed,
            device=args.device,
        )
    return {"skill": str(args.out), **describe_skill(args.out)}


def evaluate_verb(args: Evaluate) -> dict[str, Any]:
    """`sart evaluate`."""
    with ProgressDisplay() as progress:
        result = pipeline.evaluate(
            args.skill,
            args.out,
            episodes=args.episodes,
            eval_seed=args.eval_seed,
            videos=args.videos,
            yaw_deg=args.yaw_deg,
            vary_appearance=args.vary_appearance,
            task=args.task,
            robot=args.robot,
            backend=args.backend,
            workers=args.workers,
            device=args.device,
            overwrite=args.overwrite,
            progress=progress,
        )
    return {"evaluation": str(args.out), **without_rows(result)}
