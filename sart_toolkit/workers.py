"""Map a worker over items, in this process or in several."""

from __future__ import annotations

import ctypes
import multiprocessing
import os
import pickle
import signal
import sys
import threading
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
# What the pools of threads of numpy, scipy and torch go by when they are loaded.
_THREAD_COUNTS = (
    "MKL_NUM_THREADS",
    "NUMEXPR_NUM_THREADS",
    "OMP_NUM_THREADS",
    "OPENBLAS_NUM_THREADS",
)
# By Linux's <sys/prctl.h>.
_PR_SET_PDEATHSIG = 1


def _start(pickled: bytes) -> None:
    # They reach the whole group; only the parent answers, and it ends its workers.
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)
    _end_with_parent()
    global _worker
    # Not before: what makes the worker may import for seconds, which a dead parent has no use for.
    _worker = pickle.loads(pickled)()  # noqa: S301 - pickled by this process's parent


def _end_with_parent() -> None:
    """See that this process ends when its parent does, even if that was killed."""
    parent = multiprocessing.parent_process()
    if parent is None:
        return
    if sys.platform == "linux":
        # By the kernel, whatever this process is busy with.
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL, 0, 0, 0)

    def watch() -> None:
        parent.join()
        os._exit(1)

    # It also notices a parent that was gone before the kernel was asked.
    threading.Thread(target=watch, name="parent watch", daemon=True).start()


def _work(item: Any) -> Any:
    return _worker(item)


@contextmanager
def _one_thread_each() -> Iterator[None]:
    """Processes started meanwhile have one thread in each pool, unless the user says otherwise.

    They share the cores already. Threads that wait for each other at every step, as OpenMP's do,
    take several times as long where something else uses a core.
    """
    added = [name for name in _THREAD_COUNTS if name not in os.environ]
    os.environ.update(dict.fromkeys(added, "1"))
    try:
        yield
    finally:
        for name in added:
            os.environ.pop(name, None)


@contextmanager
def worker_map(
    make_worker: Callable[[], Worker[Item, Result]], processes: int
) -> Iterator[Callable[[Iterable[Item]], Iterator[Result]]]:
    """A function that maps items to results in order, as they come.

    Several processes compute with one thread each, and end with this one, however it ends. Left by
    an error or an interruption, they are ended at once.

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
    before = set(multiprocessing.active_children())
    pool = ProcessPoolExecutor(processes, context, _start, (pickle.dumps(make_worker),))
    try:
        with _one_thread_each():
            yield lambda items: pool.map(_work, items)
    except BaseException as error:
        # What they are at is done again when this is resumed.
        for process in set(multiprocessing.active_children()) - before:
            process.kill()
        if isinstance(error, BrokenProcessPool):
            raise SartError(
                "a worker process ended before its work was done (out of memory, or its start "
                "failed); use fewer workers, or one to see the reason"
            ) from error
        raise
    finally:
        pool.shutdown(cancel_futures=True)
