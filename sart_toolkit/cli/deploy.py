"""`sart deploy`: a skill on a real robot, once, or several times and judged by a person."""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING, Any, Literal

from sart_toolkit import pipeline
from sart_toolkit.cli.arguments import Deploy
from sart_toolkit.cli.console import ProgressDisplay, say
from sart_toolkit.errors import InvalidInput

if TYPE_CHECKING:
    from sart_toolkit.cli.keys import Keys
    from sart_toolkit.evaluate.deploy import Verdict

_VERDICTS: dict[str, Verdict] = {" ": "success", "\x7f": "failure", "\b": "failure", "x": "again"}
_WAYS: dict[str, Literal["closed", "open", "stay"]] = {"b": "closed", "o": "open", "s": "stay"}


def deploy_verb(args: Deploy) -> dict[str, Any]:
    """`sart deploy`."""
    terminal = sys.stdin.isatty()
    if args.out is not None or args.episodes is not None:
        return _judged(args, terminal)
    if args.overwrite:
        raise InvalidInput("--overwrite: nothing is written without --out; leave it out")
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


def _judged(args: Deploy, terminal: bool) -> dict[str, Any]:
    """Several times, a person saying of each what it was."""
    if args.out is None:
        raise InvalidInput("--episodes: add --out FILE.json, where verdicts are kept")
    if args.dry_run or args.unattended:
        given = "--dry-run" if args.dry_run else "--unattended"
        raise InvalidInput(f"{given}: leaves nobody anything to judge; leave out --out")
    if not terminal:
        raise InvalidInput(
            "deploy: --out asks a person for verdicts, by keys; type it at a terminal"
        )
    from sart_toolkit.cli.keys import single_keys

    with single_keys() as key, ProgressDisplay() as progress:
        found = pipeline.judge(
            args.skill,
            args.out,
            _Person(key),
            trials=20 if args.episodes is None else args.episodes,
            backend=args.backend,
            task=args.task,
            robot=args.robot,
            max_seconds=args.max_seconds,
            device=args.device,
            overwrite=args.overwrite,
            progress=progress,
        )
    names = ("n_success", "n_episodes", "success_rate", "ci95")
    return {"evaluation": str(args.out), **{name: found[name] for name in names}}


class _Person:
    """Who judges, by keys."""

    def __init__(self, key: Keys) -> None:
        self._key = key

    def begin(self, trial: int, trials: int, successes: int) -> None:
        so_far = f", {successes} of {trial} succeeded so far" if trial else ""
        say(
            f"Trial {trial + 1} of {trials}{so_far}. Set up the scene, and stay clear of the "
            "robot. Enter: it acts; then space: success, backspace: failure, x: doesn't count; "
            "Ctrl-C stops it, and verdicts are kept."
        )
        while self._key(None) not in ("\n", "\r"):
            pass

    def pressed(self) -> Verdict | None:
        return _VERDICTS.get(self._key(0.0))

    def verdict(self, ended: str) -> Verdict:
        say(f"It ended: {ended}. Space: success, backspace: failure, x: doesn't count.")
        while (verdict := _VERDICTS.get(self._key(None))) is None:
            pass
        return verdict

    def back(self) -> Literal["closed", "open", "stay"]:
        say(
            "b: the robot goes back the way it came, o: it opens its gripper first, s: it stays, "
            "and you bring it to where the skill begins."
        )
        while (way := _WAYS.get(self._key(None))) is None:
            pass
        return way
