"""`sart record`: by the scripted operator, or by hand in a window."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

from sart_toolkit import pipeline
from sart_toolkit.cli.arguments import Record
from sart_toolkit.cli.console import ProgressDisplay
from sart_toolkit.cli.info import describe_demonstration


def record_verb(args: Record) -> dict[str, Any]:
    """`sart record`."""
    by_hand = [n for n in ("frame", "operator", "status") if getattr(args, n) is not None]

    def steer(out: Path, *recording: Any) -> Any:
        from sart_toolkit.cli.teleop import record_by_hand

        return record_by_hand(dataclasses.replace(args, out=out), *recording)

    with ProgressDisplay() as progress:
        options: dict[str, Any] = {
            "robot": args.robot,
            "backend": args.backend,
            "device": args.device,
            "steer": steer,
            "by_hand": by_hand,
            "frame": args.frame or "world",
            "operator": args.operator or "person",
            "max_seconds": args.max_seconds,
            "placement": args.placement,
            "yaw_deg": args.yaw_deg,
            "vary_appearance": args.vary_appearance,
            "cameras": args.cameras.split(","),
            "image_size": args.image_size,
            "seed": args.seed,
            "overwrite": args.overwrite,
            "progress": progress,
        }
        if args.count is not None:
            found = pipeline.record_several(args.task, args.out, args.count, **options)
            return {
                "demonstrations": [
                    str(pipeline.demonstration_path(args.out, i)) for i in range(len(found))
                ],
                "waypoints": [len(demonstration) for demonstration in found],
            }
        demonstration = pipeline.record(args.task, args.out, **options)
    task = pipeline.task_of(demonstration, args.task)
    return {"demonstration": str(args.out), **describe_demonstration(demonstration, task)}
