"""The tables of a benchmark: a rate and its uncertainty for each row and column."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from sart_toolkit.benchmark.plans import FIELDS, Plan, PlanCell
from sart_toolkit.evaluate.compare import compare_rollouts, rate_of
from sart_toolkit.evaluate.statistics import holm

_SEEDS = ("demonstration_seed", "training_seed")


def summarise(plan: Plan, cells: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """A table for each combination of what differs besides rows, columns and seeds.

    Each has `given` (that combination), the names of its `rows` and `columns`, and `entries`; an
    entry has its cells' names, how often they succeeded, effort, and how it compares with the
    reference column's entry of its row. p-values are Holm's over a table.

    Args:
        plan: what was asked for.
        cells: the results of its cells that didn't fail, as their files have them.
    """
    by_name = {cell["name"]: cell for cell in cells}
    known = [cell for cell in plan.cells if cell.name in by_name]
    # n goes with the strategy: what only replays takes one trajectory.
    fixed = {plan.rows, plan.columns, *_SEEDS}
    if "strategy" in (plan.rows, plan.columns):
        fixed.add("n")
    others = [
        name for name in FIELDS if name not in fixed and len({c.shown(name) for c in known}) > 1
    ]
    tables: dict[tuple[str, ...], list[PlanCell]] = {}
    for cell in known:
        tables.setdefault(tuple(cell.shown(name) for name in others), []).append(cell)
    return [
        _table(plan, dict(zip(others, values, strict=True)), members, by_name)
        for values, members in tables.items()
    ]


def _table(
    plan: Plan,
    given: dict[str, str],
    members: Sequence[PlanCell],
    by_name: Mapping[str, Mapping[str, Any]],
) -> dict[str, Any]:
    groups: dict[tuple[str, str], list[PlanCell]] = {}
    for cell in members:
        groups.setdefault((cell.shown(plan.rows), cell.shown(plan.columns)), []).append(cell)
    entries = [
        {"row": row, "column": column, **_entry(group, by_name)}
        for (row, column), group in groups.items()
    ]
    compared = []
    for entry in entries:
        reference = groups.get((entry["row"], plan.reference or ""))
        group = groups[entry["row"], entry["column"]]
        if reference is None or entry["column"] == plan.reference or "rate" not in entry:
            continue
        rows = [
            [{**row, "unit": [cell.demonstration_seed, cell.training_seed]}
             for cell in side for row in _rollouts(by_name[cell.name])]
            for side in (reference, group)
        ]  # fmt: skip
        entry["against_reference"] = compare_rollouts(*rows)
        compared.append(entry["against_reference"])
    for result, p in zip(compared, holm([each["p"] for each in compared]), strict=True):
        result["p_holm"] = p
    return {
        "given": given,
        "rows": list(dict.fromkeys(row for row, _ in groups)),
        "columns": list(dict.fromkeys(column for _, column in groups)),
        "entries": entries,
    }


def _entry(group: Sequence[PlanCell], by_name: Mapping[str, Mapping[str, Any]]) -> dict[str, Any]:
    results = [by_name[cell.name] for cell in group]
    entry: dict[str, Any] = {"cells": [cell.name for cell in group], "effort": _effort(results)}
    if any(result["evaluation"] is None for result in results):
        return entry
    unit = "demonstration_seed"
    if len({cell.demonstration_seed for cell in group}) == 1:
        unit = "training_seed"
    units: dict[int, list[Mapping[str, Any]]] = {}
    for cell, result in zip(group, results, strict=True):
        units.setdefault(getattr(cell, unit), []).extend(_rollouts(result))
    return entry | {"unit": unit, "rate": rate_of(list(units.values()))}


def _rollouts(result: Mapping[str, Any]) -> list[Mapping[str, Any]]:
    found: list[Mapping[str, Any]] = result["evaluation"]["episodes"]
    return found


def _effort(results: Sequence[Mapping[str, Any]]) -> dict[str, float | None]:
    """Medians over cells of what a person and the robot spend, and of how long stages took [s].

    `human_seconds`: length of the demonstrations, and what a person spent on annotations;
    `robot_seconds`: that the robot moves by itself, to generate trajectories; `robot_resets`: how
    often it goes back to a state of the demonstration.
    """
    names = {
        "demonstrations": ("record", "demonstrations"),
        "demonstrating_seconds": ("record", "demonstrating_seconds"),
        "annotating_seconds": ("suggest", "annotating_seconds"),
        "robot_seconds": ("augment", "simulated_seconds"),
        "robot_resets": ("augment", "resets"),
        "kept": ("augment", "kept"),
        "attempted": ("augment", "attempted"),
    }
    effort: dict[str, float | None] = {}
    for name, (stage, figure) in names.items():
        values = [r["figures"].get(stage, {}).get(figure) for r in results]
        known = [value for value in values if value is not None]
        effort[name] = float(np.median(known)) if known else None
    totals = [sum(result["seconds"].values()) for result in results]
    return effort | {"computing_seconds": float(np.median(totals))}
