"""Workers in processes of this machine."""

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
from contextlib import contextmanager
from typing import Any

from sart_toolkit.errors import SartError

_worker: Any = None
# What the pools of threads of numpy, scipy and torch go by when they are loaded.
THREAD_COUNTS = (
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
    added = [name for name in THREAD_COUNTS if name not in os.environ]
    os.environ.update(dict.fromkeys(added, "1"))
    try:
        yield
    finally:
        for name in added:
            os.environ.pop(name, None)


@contextmanager
def process_map(
    make_worker: Callable[[], Any], processes: int
) -> Iterator[Callable[[Iterable[Any]], Iterator[Any]]]:
    """A function that maps items to results in order, in several processes; see `worker_map`.

    Raises:
        SartError: a process ended unexpectedly.
    """
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
