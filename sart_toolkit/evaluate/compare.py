"""Whether two sets of rollouts differ in how often they succeed."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from sart_toolkit.evaluate.statistics import (
    cluster_interval,
    few_rollouts,
    mcnemar_p,
    spread,
    unpaired_p,
    wilson_interval,
)

Row = Mapping[str, Any]


def rate_of(units: Sequence[Sequence[Row]]) -> dict[str, Any]:
    """How often rollouts succeeded, and how sure that is.

    `ci95`: Wilson's interval, as if all rollouts were independent; `ci95_units`: the bootstrap's
    over units, and `sd_units` the standard deviation between them, None for one unit alone.

    Args:
        units: the rollouts of each unit, a demonstration's or a training's, as `evaluation.json`
            has them.
    """
    rows = [row for unit in units for row in unit]
    n, ends = len(rows), [sum(_succeeded(row) for row in unit) for unit in units]
    ever = sum(bool(row.get("success_any")) for row in rows)
    rates = [k / len(unit) for k, unit in zip(ends, units, strict=True)]
    return {
        "n_success": sum(ends),
        "n_episodes": n,
        "success_rate": sum(ends) / n,
        "ci95": list(wilson_interval(sum(ends), n)),
        "n_success_any": ever,
        "ci95_any": list(wilson_interval(ever, n)),
        "units": rates,
        "sd_units": spread(rates),
        "ci95_units": cluster_interval(rates, [len(unit) for unit in units]),
        "warning": few_rollouts(n),
    }


def compare_rollouts(a: Sequence[Row], b: Sequence[Row]) -> dict[str, Any]:
    """The p-value that `a` and `b` succeed equally often, and the test that gave it.

    Rollouts with the same seed and placement are pairs, which McNemar's test counts. Where each
    has its pair that is the test; otherwise Barnard's, which knows no pairs.

    Args:
        a: rollouts as `evaluation.json` has them, of one skill; or of several, a `unit` in each
            row saying which.
        b: the others.
    """
    named = [{_same(row): _succeeded(row) for row in rows} for rows in (a, b)]
    k = [sum(map(_succeeded, rows)) for rows in (a, b)]
    difference = k[1] / len(b) - k[0] / len(a)
    whole = [len(each) == len(rows) for each, rows in zip(named, (a, b), strict=True)]
    if not all(whole) or set(named[0]) != set(named[1]):
        p = unpaired_p((k[0], k[1]), (len(a), len(b)))
        return {"test": "barnard", "p": p, "difference": difference, "pairs": None}
    both = [(named[0][at], named[1][at]) for at in named[0]]
    only_a, only_b = (both.count(pair) for pair in ((True, False), (False, True)))
    return {
        "test": "mcnemar",
        "p": mcnemar_p(only_a, only_b),
        "difference": difference,
        "pairs": {"n": len(both), "only_a": only_a, "only_b": only_b},
    }


def _succeeded(row: Row) -> bool:
    return bool(row["outcome"] == "success")


def _same(row: Row) -> tuple[str, ...]:
    """What two rollouts of a pair have in common."""
    return tuple(repr(row.get(name)) for name in ("unit", "seed", "placement"))
