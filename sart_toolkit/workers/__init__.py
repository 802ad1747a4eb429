"""Map a worker over items: in this process, in several of this machine, or on a Ray cluster."""

from __future__ import annotations

import importlib.util
from collections.abc import Callable, Iterable, Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass
from typing import Literal, Protocol, TypeVar, get_args

from sart_toolkit.errors import InvalidInput, MissingExtra, unknown_name
from sart_toolkit.workers.processes import process_map

Item = TypeVar("Item", contravariant=True)
Result = TypeVar("Result", covariant=True)
Executor = Literal["processes", "ray"]


class Worker(Protocol[Item, Result]):
    """Does one item at a time and holds what that takes, a simulator for instance."""

    def __call__(self, item: Item, /) -> Result:
        """The result of one item."""

    def close(self) -> None:
        """Free what is held."""


@dataclass(frozen=True)
class Workers:
    """How many workers share the work, and what runs them.

    `executor`: "processes" of this machine, of which a single one is this process; or "ray", the
    nodes of a Ray cluster. `ray_address` of that cluster: "HOST:PORT", "auto" for the one that this
    machine belongs to, "local" for one of this command's own; if left out `$RAY_ADDRESS`, else the
    one that this machine belongs to, else one of its own.
    """

    count: int = 1
    executor: Executor = "processes"
    ray_address: str | None = None

    def __post_init__(self) -> None:
        if self.count < 1:
            raise InvalidInput(f"workers: expected at least 1, got {self.count}")
        if self.executor not in get_args(Executor):
            raise unknown_name("executor", self.executor, get_args(Executor))
        if self.executor != "ray" and self.ray_address is not None:
            raise InvalidInput(
                f"ray_address: is for the executor 'ray', got {self.executor!r}; add --executor ray"
            )
        if self.executor == "ray" and importlib.util.find_spec("ray") is None:
            raise MissingExtra(
                "executor 'ray' needs Ray, which is not installed; pip install 'sart_toolkit[ray]'"
            )

    @classmethod
    def of(cls, workers: int | Workers) -> Workers:
        """The workers themselves, or so many processes."""
        return workers if isinstance(workers, Workers) else cls(workers)

    @property
    def here(self) -> bool:
        """Whether all work is done in this process."""
        return self.executor == "processes" and self.count == 1


@contextmanager
def worker_map(
    make_worker: Callable[[], Worker[Item, Result]], workers: int | Workers, gpu: bool = False
) -> Iterator[Callable[[Iterable[Item]], Iterator[Result]]]:
    """A function that maps items to results in order, as they come.

    Several workers compute with one thread each, and end with this process, however it ends. Left
    by an error or an interruption, they are ended at once. On a Ray cluster a worker that is lost
    is replaced and its item is done again; what travels there and back, see `workers.parcels`.

    Args:
        make_worker: makes a worker; picklable if there are several.
        workers: how many, and what runs them; a number means processes.
        gpu: whether a worker on a cluster that has GPUs is to have one.

    Raises:
        InvalidInput: there are more workers than the cluster has CPUs.
        Mismatch: a node of the cluster has another version of the toolkit.
        SartError: a process ended unexpectedly, an item's worker was lost again and again, or there
            is no such cluster.
    """
    workers = Workers.of(workers)
    if workers.here:
        with closing(make_worker()) as worker:
            yield lambda items: map(worker, items)
    elif workers.executor == "processes":
        with process_map(make_worker, workers.count) as run:
            yield run
    else:
        from sart_toolkit.workers.cluster import ray_map

        with ray_map(make_worker, workers.count, workers.ray_address, gpu) as run:
            yield run
