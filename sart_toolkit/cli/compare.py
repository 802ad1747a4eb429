"""`sart compare`."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from sart_toolkit.cli.arguments import Compare
from sart_toolkit.data.schemas import CellFile, EvaluationFile
from sart_toolkit.data.storage import read_json
from sart_toolkit.errors import InvalidInput, MissingFile


def compare_verb(args: Compare) -> dict[str, Any]:
    """`sart compare A B`."""
    a, b = (_rollouts(path) for path in (args.a, args.b))
    from sart_toolkit.evaluate.compare import compare_rollouts, rate_of
    from sart_toolkit.evaluate.failures import group_failures

    found = compare_rollouts(a, b)
    rates = {name: rate_of([rows]) for name, rows in (("a", a), ("b", b))}
    if args.json:
        return {**rates, **found}
    lines: dict[str, Any] = {}
    for name, path, rows in (("a", args.a, a), ("b", args.b, b)):
        rate = rates[name]
        low, high = (100 * end for end in rate["ci95"])
        lines[name] = (
            f"{rate['n_success']}/{rate['n_episodes']} at the end (95 % interval {low:.0f} to "
            f"{high:.0f} %), {rate['n_success_any']} at any time: {path}"
        )
        if rate["warning"]:
            lines[f"{name}, warning"] = rate["warning"]
        lines |= {
            f"{name}, failures {i}": f"{len(kind.episodes)} x {kind.reason}"
            for i, kind in enumerate(group_failures(rows), 1)
        }
    pairs = found["pairs"]
    counted = (
        f"McNemar over {pairs['n']} pairs: only a succeeded {pairs['only_a']} times, only b "
        f"{pairs['only_b']}"
        if pairs
        else "Barnard, as seeds or placements differ"
    )
    lines["b minus a"] = f"{100 * found['difference']:+.0f} points"
    lines["p"] = f"{found['p']:.2g} ({counted})"
    return lines


def _rollouts(path: Path) -> list[dict[str, Any]]:
    """The rollouts of an evaluation, of a benchmark's cell, or of a run's or skill's directory.

    Raises:
        MissingFile, BrokenFile: there is none, or it can't be read.
        InvalidInput: the cell was not evaluated.
    """
    if path.is_dir():
        beside = (path / "evaluation.json", path.parent / "evaluation.json")
        places = beside if (path / "model.safetensors").exists() else beside[:1]
        found = next((place for place in places if place.exists()), None)
        if found is None:
            raise MissingFile(
                f"{path}: has no evaluation.json, nor lies one beside the skill; make it with "
                "`sart evaluate`"
            )
        path = found
    value = read_json(path, dict)
    if "keys" not in value:
        episodes: list[dict[str, Any]] = read_json(path, EvaluationFile)["episodes"]
        return episodes
    evaluation = read_json(path, CellFile)["evaluation"]
    if evaluation is None:
        raise InvalidInput(f"{path}: that cell was not evaluated, only its effort measured")
    episodes = evaluation["episodes"]
    return episodes
