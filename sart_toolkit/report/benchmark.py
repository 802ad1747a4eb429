"""`benchmark.html`: one self-contained page of a benchmark's tables, failures and commands."""

from __future__ import annotations

import shlex
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from sart_toolkit.data.storage import write_text
from sart_toolkit.evaluate.failures import group_failures
from sart_toolkit.report.figures import Rate, Theme, rates_image
from sart_toolkit.report.page import (
    Shown,
    drawn,
    duration,
    last_images,
    percent,
    reached_words,
    templates,
)

Result = Mapping[str, Any]


def write_benchmark_page(
    result: Result, cells: Sequence[Result], evaluations: Mapping[str, Path], out: Path
) -> None:
    """Write the page about a benchmark to `out`, images inside, no request to anywhere.

    Args:
        result: what `benchmark.json` holds.
        cells: what the files of its cells hold.
        evaluations: the directory of each cell's evaluation, where final images are.
        out: the HTML file, written whole or not at all.

    Raises:
        CannotWrite: the disk refuses.
    """
    by_name = {cell["name"]: cell for cell in cells}
    page = templates().get_template("benchmark.html").render(
        plan=result["plan"],
        about=result["about"],
        command=result.get("command", ""),
        tiles=_tiles(result, cells),
        tables=[_table(result, table, by_name, evaluations) for table in result["tables"]],
        failed=result["failed"],
        cells=[_cell(cell, result.get("command", "")) for cell in cells],
        reference=result["reference"],
        machine=result.get("machine", {}),
        versions=result["versions"],
    )  # fmt: skip
    write_text(Path(out), page)


def _tiles(result: Result, cells: Sequence[Result]) -> list[Shown]:
    rollouts = [row for cell in cells for row in (cell["evaluation"] or {}).get("episodes", [])]
    good = sum(row["outcome"] == "success" for row in rollouts)
    # What cells share was done once.
    spent = {key: cell["seconds"][s] for cell in cells for s, key in cell["keys"].items()}
    tiles = [
        {"label": "Cells", "value": str(len(cells)), "notes": [f"{len(result['failed'])} failed"]},
        {
            "label": "Computing",
            "value": duration(sum(spent.values())),
            "notes": [f"in {len(spent)} jobs, each on one core, measured when they ran"],
        },
    ]
    if rollouts:
        notes = [f"{percent(good / len(rollouts))} of all rollouts, at the end"]
        tiles.insert(1, {"label": "Success", "value": f"{good} / {len(rollouts)}", "notes": notes})
    return tiles


def _table(
    result: Result,
    table: Result,
    by_name: Mapping[str, Result],
    evaluations: Mapping[str, Path],
) -> Shown:
    entries = {(entry["row"], entry["column"]): entry for entry in table["entries"]}
    rated = [entry for entry in table["entries"] if "rate" in entry]
    shown: Shown = {
        "title": ", ".join(
            f"{name.replace('_', ' ')} {value}" for name, value in table["given"].items()
        ),
        "rows": table["rows"],
        "columns": table["columns"],
        "axes": [result[axis].replace("_", " ") for axis in ("rows", "columns")],
        "entries": entries,
        "rated": rated,
        "drawing": None,
        "kinds": [kind for entry in rated for kind in _kinds(entry, by_name, evaluations)],
    }
    if rated:
        rates = [
            Rate(
                entry["row"],
                entry["column"],
                entry["rate"]["success_rate"],
                entry["rate"]["ci95"][0],
                entry["rate"]["ci95"][1],
                tuple(entry["rate"]["units"]),
            )
            for entry in rated
        ]

        def draw(theme: Theme) -> bytes:
            return rates_image(rates, result["columns"], theme)

        shown["drawing"] = drawn(draw, f"Success rates of {len(rates)} entries, as in the table")
    return shown


def _kinds(
    entry: Result, by_name: Mapping[str, Result], evaluations: Mapping[str, Path]
) -> Iterable[Shown]:
    """The kinds of failure of an entry, each with the last images of some of its rollouts."""
    rows = [
        (evaluations[name], {**row, "episode": (name, row["episode"])})
        for name in entry["cells"]
        for row in by_name[name]["evaluation"]["episodes"]
    ]
    for kind in group_failures([row for _, row in rows]):
        chosen = [
            (path, {**row, "episode": row["episode"][1]})
            for path, row in rows
            if row["episode"] in kind.episodes
        ]
        yield {
            "reason": f"{entry['row']}, {entry['column']}: {kind.reason}",
            "count": len(kind.episodes),
            "reached": reached_words(kind),
            "drawing": last_images(chosen),
        }


def _cell(cell: Result, command: str) -> Shown:
    evaluation = cell["evaluation"]
    return {
        "name": cell["name"],
        "success": evaluation and f"{evaluation['n_success']}/{evaluation['n_episodes']}",
        "seconds": sum(cell["seconds"].values()),
        "stages": ", ".join(f"{stage} {duration(s)}" for stage, s in cell["seconds"].items()),
        "command": command
        if " --only " in command
        else f"{command} --only {shlex.quote(cell['name'])}",
    }
