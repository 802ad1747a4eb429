"""Printing: progress on stderr, results on stdout, errors as one line."""

from __future__ import annotations

import json
import shlex
import sys
import time
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, Self

if TYPE_CHECKING:
    from tqdm import tqdm

_UNITS = {
    "record": "s",
    "play": "image",
    "suggest": "waypoint",
    "augment": "trajectory",
    "plan": "segment",
    "merge": "episode",
    "split": "episode",
    "validate": "episode",
    "export": "trajectory",
    "import": "recording",
    "read": "trajectory",
    "train": "step",
    "sweep": "training",
    "evaluate": "rollout",
    "deploy": "s",
    "judge": "trial",
    "operator": "episode",
    "replay": "replay",
    "segments": "segment",
    "radii": "task",
    "cloud": "task",
    "benchmark": "job",
}
_PLURALS = {"s": "s", "trajectory": "trajectories"}
# Where nobody watches a bar, a line is written so often [s].
_LINE_SECONDS = 10.0


class ProgressDisplay:
    """How far each stage is, on stderr: a bar on a terminal, elsewhere a line now and then."""

    def __init__(self) -> None:
        self._stage = ""
        self._bar: tqdm[Any] | None = None
        self._said = time.monotonic()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._close()

    def __call__(
        self, stage: str, done: float, total: float | None = None, text: str = "", /
    ) -> None:
        """Show that a stage has `done` of `total`, and a few words."""
        if sys.stderr.isatty():
            self._show_bar(stage, done, total, text)
        elif time.monotonic() - self._said >= _LINE_SECONDS:
            self._said = time.monotonic()
            unit = _PLURALS.get(_UNITS[stage], f"{_UNITS[stage]}s")
            amount = f"{done:.0f}" if total is None else f"{done:.0f} of {total:.0f}"
            say(f"{stage}: {amount} {unit}{text and f', {text}'}")

    def _show_bar(self, stage: str, done: float, total: float | None, text: str) -> None:
        if self._bar is None or stage != self._stage:
            self._close()
            from tqdm import tqdm

            self._stage = stage
            self._bar = tqdm(total=total, desc=f"{stage:<9}", unit=_UNITS[stage], file=sys.stderr)
        self._bar.total = total
        if text:
            self._bar.set_postfix_str(text, refresh=False)
        self._bar.update(done - self._bar.n)

    def _close(self) -> None:
        if self._bar is not None:
            self._bar.close()
            self._bar = None


def say(text: str) -> None:
    """A line for the person who waits, on stderr."""
    print(text, file=sys.stderr, flush=True)


def typed() -> str:
    """The command as it was typed."""
    return shlex.join(["sart", *sys.argv[1:]])


def show(result: Mapping[str, Any], as_json: bool) -> None:
    """The result of a command on stdout: one JSON object, or aligned lines to read."""
    if as_json:
        print(json.dumps(result, allow_nan=False))
        return
    width = max(len(key) for key in result)
    for key, value in result.items():
        print(f"{key:<{width}}  {_readable(value)}")


def _readable(value: Any) -> str:
    if isinstance(value, float):
        return f"{value:.4g}"
    if isinstance(value, Mapping):
        return ", ".join(f"{k}: {_readable(v)}" for k, v in value.items()) or "none"
    if isinstance(value, list | tuple):
        apart = "; " if value and isinstance(value[0], Mapping) else ", "
        return apart.join(_readable(v) for v in value) or "none"
    return str(value)
