"""Results of a benchmark, kept as they come in, so that an interruption loses none."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from sart_toolkit.data.storage import (
    append_json_line,
    check_writable,
    read_json_lines,
    remove,
    write_json,
)
from sart_toolkit.errors import Mismatch


class ResultLog:
    """What a benchmark has done so far, in a file of lines beside its result.

    Attributes:
        rows: those that were finished before.
    """

    def __init__(self, out: Path, request: Mapping[str, Any], overwrite: bool) -> None:
        """Resume where the same `request` was interrupted, or start.

        Raises:
            OutputExists: `out` is there and `overwrite` is false.
            Mismatch: another request was interrupted.
            CannotWrite: the disk refuses.
        """
        check_writable(out, overwrite)
        self._out, self._path = out, out.with_suffix(".partial.jsonl")
        if overwrite:
            remove(self._path)
        lines = read_json_lines(self._path)
        if lines and lines[0] != request:
            raise Mismatch(
                f"{self._path}: holds results of {lines[0]}, not {dict(request)}; add --overwrite "
                "or choose another --out"
            )
        if not lines:
            out.parent.mkdir(parents=True, exist_ok=True)
            append_json_line(self._path, request)
        self.rows = lines[1:]

    def add(self, row: Mapping[str, Any]) -> None:
        """Keep a finished row."""
        append_json_line(self._path, row)

    def finish(self, result: dict[str, Any]) -> dict[str, Any]:
        """`result`, written to `out`; the rows are removed."""
        write_json(self._out, result)
        remove(self._path)
        return result
