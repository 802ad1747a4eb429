"""The workers that flags ask for."""

from __future__ import annotations

from typing import Protocol

from sart_toolkit.workers import Executor, Workers


class WorkerFlags(Protocol):
    """Flags of a verb whose work can be shared."""

    @property
    def workers(self) -> int: ...
    @property
    def executor(self) -> Executor: ...
    @property
    def ray_address(self) -> str | None: ...


def chosen_workers(args: WorkerFlags) -> Workers:
    """How many workers, and what runs them.

    Raises:
        InvalidInput: not even one, or an address without Ray.
        MissingExtra: Ray isn't installed.
    """
    return Workers(args.workers, args.executor, args.ray_address)
