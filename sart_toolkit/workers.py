"""Map a worker over items, in this process or in several."""

from __future__ import annotations

import multiprocessing
import signal
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import closing, contextmanager
from typing import Any, Protocol, TypeVar

from sart_toolkit.errors import InvalidInput, SartError

Item = TypeVar("Item", contravariant=True)
Result = TypeVar("Result", covariant=True)


class Worker(Protocol[Item, Result]):
    """Does one item at a time and holds what that takes, a simulator for instance."""

    def __call__(self, item: Item, /) -> Result:
        """The result of one item."""

    def close(self) -> None:
        """Free what is held."""


_worker: Any = None


def _start(make_worker: Callable[[], Worker[Any, Any]]) -> None:
    # Ctrl-C reaches the whole group; only the parent answers it.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    global _worker
    _worker = make_worker()


def _work(item: Any) -> Any:
    return _worker(item)


@contextmanager
def worker_map(
    make_worker: Callable[[], Worker[Item, Result]], processes: int
) -> Iterator[Callable[[Iterable[Item]], Iterator[Result]]]:
    """A function that maps items to results in order, as they come.

    Args:
        make_worker: makes a worker; picklable if there are several processes.
        processes: 1 works here; more start as many processes.

    Raises:
        InvalidInput: `processes` is not positive.
        SartError: a process ended unexpectedly.
    """
    if processes < 1:
        raise InvalidInput(f"workers: expected at least 1, got {processes}")
    if processes == 1:
        with closing(make_worker()) as worker:
            yield lambda items: map(worker, items)
        return
    # A forked copy of a process with threads (torch, HDF5) may hang: start afresh.
    context = multiprocessing.get_context("spawn")
    pool = ProcessPoolExecutor(processes, context, _start, (make_worker,))
    try:
        yield lambda items: pool.map(_work, items)
    except BrokenProcessPool as error:
        raise SartError(
            "a worker process ended before its work was done (out of memory, or its start failed); "
            "use fewer workers, or one to see the reason"
        ) from error
    finally:
        pool.shutdown(cancel_futures=True)
