"""JSON of the right shape with odd values gives a page or an error of ours, never a traceback."""

from __future__ import annotations

import copy
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from sart_toolkit.data.storage import with_seal
from sart_toolkit.errors import SartError
from sart_toolkit.report.page import write_report

ODD: tuple[Any, ...] = ("x", [], {}, None, -1, [[]], 10**400, {"a": "b"}, "\ud800")


def _places(value: Any, at: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    """Where something stands in JSON; of a list only what is first."""
    inner = value.items() if isinstance(value, dict) else list(enumerate(value))[:1]
    for key, each in inner:
        yield (*at, key)
        if isinstance(each, dict | list):
            yield from _places(each, (*at, key))


def _replaced(value: Any, at: tuple[Any, ...], by: Any) -> Any:
    changed = copy.deepcopy(value)
    parent = changed
    for key in at[:-1]:
        parent = parent[key]
    parent[at[-1]] = by
    return changed


@pytest.mark.parametrize("name", ["evaluation.json", "run.json", "skill/training.json"])
def test_a_value_of_another_kind_is_shown_or_refused(
    run_dir: Path, name: str, tmp_path: Path
) -> None:
    file = tmp_path / "odd" / name
    file.parent.mkdir(parents=True)
    whole = json.loads((run_dir / name).read_text())
    outcomes = {True: 0, False: 0}
    for number, at in enumerate(_places(whole)):
        # Not each in each place: the figures take a while.
        file.write_text(json.dumps(with_seal(_replaced(whole, at, ODD[number % len(ODD)]))))
        try:
            write_report(tmp_path / "odd", tmp_path / "page.html")
        except SartError:
            outcomes[False] += 1
        else:
            outcomes[True] += 1
    assert outcomes[True] and outcomes[False]
