"""`sart deploy`: a skill on a real robot."""

from __future__ import annotations

import sys
from typing import Any

from sart_toolkit import pipeline
from sart_toolkit.cli.arguments import Deploy
from sart_toolkit.cli.console import ProgressDisplay, say
from sart_toolkit.errors import InvalidInput


def deploy_verb(args: Deploy) -> dict[str, Any]:
    """`sart deploy`."""
    terminal = sys.stdin.isatty()
    if not (terminal or args.dry_run or args.unattended):
        raise InvalidInput(
            "deploy: a person beside the robot says when it may move; type it at a terminal, or "
            "add --unattended or --dry-run"
        )

    def ready(text: str) -> None:
        say(f"{text}.")
        if terminal and not args.dry_run:
            input("Press Enter to begin, Ctrl-C to leave it; Ctrl-C stops it at any time: ")

    with ProgressDisplay() as progress:
        done = pipeline.deploy(
            args.skill,
            backend=args.backend,
            task=args.task,
            robot=args.robot,
            max_seconds=args.max_seconds,
            dry_run=args.dry_run,
            device=args.device,
            ready=ready,
            progress=progress,
        )
    return {
        "ended": done.ended,
        "steps": done.steps,
        "seconds": done.seconds,
        "farthest_mm": round(done.farthest * 1e3, 1),
        "decision_ms": round(done.decision * 1e3, 1),
        "slowest_decision_ms": round(done.slowest_decision * 1e3, 1),
        "image_delay_ms": {name: round(delay * 1e3, 1) for name, delay in done.delays.items()},
    }
