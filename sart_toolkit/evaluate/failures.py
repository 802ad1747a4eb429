"""Failures of one kind: the same words with other numbers."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

_NUMBER = re.compile(r"[-+]?\d+(?:\.\d+)?")


@dataclass(frozen=True)
class FailureKind:
    """Failures whose reasons differ in numbers alone.

    `reason` has the median of each number, `episodes` are those of the rows that failed so.
    `waypoint` and `seconds` are the medians of the furthest waypoint of the demonstration that
    these rollouts reached and of when they did; None where none of them says.
    """

    reason: str
    episodes: tuple[Any, ...]
    waypoint: float | None
    seconds: float | None


def group_failures(rows: Sequence[Mapping[str, Any]]) -> list[FailureKind]:
    """The kinds of failure among rollouts, as `evaluation.json` has them; the commonest first.

    Args:
        rows: of all rollouts; successes are left aside.
    """
    kinds: dict[str, list[Mapping[str, Any]]] = {}
    for row in rows:
        if row["outcome"] == "failure":
            reason = str(row.get("reason") or "no reason given")
            kinds.setdefault(_NUMBER.sub("0", reason), []).append(row)
    found = [_kind(members) for members in kinds.values()]
    return sorted(found, key=lambda kind: (-len(kind.episodes), kind.episodes))


def _kind(members: Sequence[Mapping[str, Any]]) -> FailureKind:
    reasons = [str(row.get("reason") or "no reason given") for row in members]
    columns = zip(*(_NUMBER.findall(reason) for reason in reasons), strict=True)
    medians = iter([_median(column) for column in columns])
    progress = [row["progress"] for row in members if row.get("progress")]
    return FailureKind(
        _NUMBER.sub(lambda _: next(medians), reasons[0]),
        tuple(row["episode"] for row in members),
        float(np.median([p["waypoint"] for p in progress])) if progress else None,
        float(np.median([p["seconds"] for p in progress])) if progress else None,
    )


def _median(words: Sequence[str]) -> str:
    """The median of numbers, written as they are: with as many decimals, and signs if any."""
    places = max(len(word.partition(".")[2]) for word in words)
    sign = "+" if any(word[0] in "+-" for word in words) else ""
    return f"{np.median([float(word) for word in words]):{sign}.{places}f}"
