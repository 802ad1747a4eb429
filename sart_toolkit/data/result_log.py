"""Results of many parts, kept as they come in, so that an interruption loses none."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Self

from sart_toolkit.data.storage import Journal, OutputLock, check_writable, linked, write_json
from sart_toolkit.errors import Mismatch


class ResultLog:
    """What is done of a result, in `NAME.journal` beside it; no other process writes either."""

    def __init__(self, out: Path, request: Mapping[str, Any], overwrite: bool) -> None:
        """Resume where the same `request` was interrupted, or start.

        Args:
            out: the JSON file of the result.
            request: whatever decides what a row holds, as JSON values.
            overwrite: whether `out` may be replaced; rows that were finished before are dropped.

        Raises:
            OutputExists: `out` is there and `overwrite` is false.
            Mismatch: another request was interrupted.
            CannotWrite: another process is at work on it, or the disk refuses.
        """
        self._out = Path(out)
        # As JSON gives it back, to be compared.
        wanted = json.loads(json.dumps(dict(request)))
        lock = OutputLock(out)
        try:
            check_writable(out, overwrite)
            real = linked(out)
        except BaseException:
            lock.close()
            raise
        self._journal = Journal(real.with_name(f"{real.name}.journal"), lock)
        try:
            if overwrite:
                self._journal.clear()
            if not self._journal.rows:
                self._journal.append(wanted)
            elif self._journal.rows[0] != wanted:
                raise Mismatch(
                    f"{self._journal.path}: holds results of {self._journal.rows[0]}, not "
                    f"{wanted}; add --overwrite or choose another --out"
                )
        except BaseException:
            self.close()
            raise

    @property
    def rows(self) -> list[dict[str, Any]]:
        """The finished rows."""
        return self._journal.rows[1:]

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Let go of the result; what was finished is kept."""
        self._journal.close()

    def add(self, row: Mapping[str, Any]) -> None:
        """Keep a finished row.

        Raises:
            CannotWrite: the disk refuses.
        """
        self._journal.append(row)

    def finish(self, result: dict[str, Any]) -> dict[str, Any]:
        """`result`, written to its file; the rows are removed.

        Raises:
            CannotWrite: the disk refuses.
        """
        write_json(self._out, result)
        self._journal.close(remove=True)
        return result
