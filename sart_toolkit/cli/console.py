"""Printing: progress on stderr, results on stdout, errors as one line."""

from __future__ import annotations

import contextlib
import json
import sys
from collections.abc import Iterator, Mapping
from typing import Any

from tqdm import tqdm


@contextlib.contextmanager
def progress_bar(what: str, total: int | None, unit: str) -> Iterator[tqdm[Any]]:
    """A bar on stderr, left out where stderr isn't a terminal."""
    bar = tqdm(total=total, desc=f"{what:<9}", unit=unit, file=sys.stderr, disable=None, leave=True)
    try:
        yield bar
    finally:
        bar.close()


def say(text: str) -> None:
    """A line for the person who waits, on stderr."""
    print(text, file=sys.stderr, flush=True)


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
