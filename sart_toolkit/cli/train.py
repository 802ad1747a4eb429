"""`sart train` and `sart evaluate`."""

from __future__ import annotations

from typing import Any

from sart_toolkit import pipeline
from sart_toolkit.cli.arguments import Evaluate, Train, whole_numbers
from sart_toolkit.cli.console import ProgressDisplay
from sart_toolkit.cli.info import describe_skill, without_rows
from sart_toolkit.cli.workers import chosen_workers
from sart_toolkit.errors import InvalidInput
from sart_toolkit.scenes.appearance import AppearanceConfig
from sart_toolkit.workers import Workers


def train_verb(args: Train) -> dict[str, Any]:
    """`sart train`."""
    workers = chosen_workers(args)
    options: dict[str, Any] = {
        "epochs": args.epochs,
        "lr": args.lr,
        "batch_size": args.batch_size,
        "image_size": args.image_size,
        "image_shift": args.image_shift,
        "schedule": args.schedule,
        "norm": args.norm,
        "weighting": args.weighting,
        "cameras": tuple(args.cameras.split(",")),
        "backbone_weights": args.backbone_weights and str(args.backbone_weights),
        "device": args.device,
    }
    if args.seeds is not None:
        return _sweep(args, workers, options)
    if not workers.here:
        raise InvalidInput("--workers: a single training takes one process; add --seeds")
    with ProgressDisplay() as progress:
        pipeline.train_policy(
            args.dataset,
            args.out,
            args.policy,
            overwrite=args.overwrite,
            progress=progress,
            seed=args.seed,
            **options,
        )
    return {"skill": str(args.out), **describe_skill(args.out)}


def _sweep(args: Train, workers: Workers, options: dict[str, Any]) -> dict[str, Any]:
    seeds = whole_numbers("seeds", args.seeds or "")
    if args.seed is not None:
        raise InvalidInput("--seed: is for a single training; leave it out, or --seeds")
    with ProgressDisplay() as progress:
        table = pipeline.train_seeds(
            args.dataset,
            args.out,
            seeds,
            args.policy,
            workers=workers,
            overwrite=args.overwrite,
            progress=progress,
            **options,
        )
    rows = {str(args.out / row["skill"]): row for row in table["skills"]}
    return {"table": str(args.out / "sweep.json")} | {
        name: f"loss {row['final_loss']:.4g} after {row['seconds']:.1f} s on {row['device']}"
        for name, row in rows.items()
    }


def _appearance(args: Evaluate) -> AppearanceConfig | None:
    """How far the appearance varies, by flags.

    Raises:
        InvalidInput: both flags are given, or the one can't be read.
        UnknownName: there is no such part of the appearance.
    """
    if args.appearance is None:
        return AppearanceConfig() if args.vary_appearance else None
    if args.vary_appearance:
        raise InvalidInput("--vary-appearance: varies everything; leave it out, or --appearance")
    values = {}
    for word in args.appearance.split(","):
        name, _, amount = word.partition("=")
        try:
            values[name] = float(amount)
        except ValueError as error:
            raise InvalidInput(
                f"--appearance: expected NAME=NUMBER,..., got {args.appearance!r}"
            ) from error
    return AppearanceConfig.only(**values)


def evaluate_verb(args: Evaluate) -> dict[str, Any]:
    """`sart evaluate`."""
    with ProgressDisplay() as progress:
        result = pipeline.evaluate(
            args.skill,
            args.out,
            episodes=args.episodes,
            eval_seed=args.eval_seed,
            videos=args.videos,
            final_images=args.final_images,
            yaw_deg=args.yaw_deg,
            placement_range=args.placement_range,
            appearance=_appearance(args),
            latency=args.latency,
            task=args.task,
            robot=args.robot,
            backend=args.backend,
            workers=chosen_workers(args),
            device=args.device,
            overwrite=args.overwrite,
            progress=progress,
        )
    return {"evaluation": str(args.out), **without_rows(result)}
