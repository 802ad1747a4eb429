"""Work is mapped in order, here or in processes, and a lost process is an error of ours."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from sart_toolkit.errors import InvalidInput, SartError
from sart_toolkit.workers import worker_map


class Squares:
    closed = False

    def __call__(self, item: int) -> tuple[int, int]:
        return os.getpid(), item**2

    def close(self) -> None:
        Squares.closed = True


class Deserter:
    def __init__(self) -> None:
        os._exit(3)

    def __call__(self, item: int) -> int:
        return item

    def close(self) -> None:
        """Never called."""


class Threads:
    """How many threads torch has, and numpy's BLAS would have."""

    def __call__(self, item: int) -> tuple[int, str | None]:
        import torch

        return torch.get_num_threads(), os.environ.get("OPENBLAS_NUM_THREADS")

    def close(self) -> None:
        """Nothing is held."""


class Sleeper:
    """Says where it is at work, and that it has done it."""

    def __call__(self, path: Path) -> int:
        (path / f"{os.getpid()}.begun").write_text("")
        time.sleep(5.0 if path.name == "short" else 600.0)
        (path / f"{os.getpid()}.done").write_text("")
        return 0

    def close(self) -> None:
        """Nothing is held."""


@pytest.mark.parametrize("processes", [1, 2])
def test_results_come_in_order_from_as_many_processes(processes: int) -> None:
    with worker_map(Squares, processes) as run:
        rows = list(run(range(20)))
    assert [square for _, square in rows] == [i**2 for i in range(20)]
    assert ({pid for pid, _ in rows} == {os.getpid()}) == (processes == 1)


def test_a_worker_here_is_closed_even_after_an_error() -> None:
    Squares.closed = False
    with pytest.raises(ZeroDivisionError), worker_map(Squares, 1) as run:
        next(run(range(3)))
        raise ZeroDivisionError
    assert Squares.closed


def test_no_worker_is_refused() -> None:
    with pytest.raises(InvalidInput, match="workers: expected at least 1, got 0"):
        worker_map(Squares, 0).__enter__()


def test_a_process_that_dies_is_one_error_with_a_remedy() -> None:
    with (
        pytest.raises(SartError, match="ended before its work was done.*use fewer workers"),
        worker_map(Deserter, 2) as run,
    ):
        list(run(range(3)))


# --- threads ------------------------------------------------------------------------------------


@pytest.mark.parametrize("given", [None, "2"])
def test_each_process_computes_with_one_thread_unless_the_user_says_otherwise(
    given: str | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    names = ("MKL_NUM_THREADS", "NUMEXPR_NUM_THREADS", "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS")
    for name in names:
        monkeypatch.delenv(name, raising=False)
        if given is not None:
            monkeypatch.setenv(name, given)
    before = dict(os.environ)
    with worker_map(Threads, 2) as run:
        assert list(run(range(2))) == [(int(given or 1), given or "1")] * 2
    assert dict(os.environ) == before


# --- the end ------------------------------------------------------------------------------------

_PARENT = """
import ctypes, sys
from pathlib import Path
from sart_toolkit.workers import worker_map
sys.path.insert(0, sys.argv[1])
from test_processes import Sleeper

class Unbound(Sleeper):
    def __init__(self):
        ctypes.CDLL(None).prctl(1, 0, 0, 0, 0)

if __name__ == "__main__":
    with worker_map({"kernel": Sleeper, "watch": Unbound}[sys.argv[3]], 2) as run:
        list(run([Path(sys.argv[2])] * 2))
"""


def _alive(pid: int) -> bool:
    try:
        # After the program's name in parentheses: its state.
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] not in "ZX"
    except OSError:
        return False


@pytest.mark.parametrize("by", ["kernel", "watch"])
def test_workers_end_with_a_parent_that_was_killed(
    by: str, tmp_path: Path, wait_until: Callable[..., None]
) -> None:
    """The kernel sees to it; without its help (undone by the worker) a thread does."""
    script = tmp_path / "parent.py"
    script.write_text(_PARENT)
    (tmp_path / "long").mkdir()
    words = [sys.executable, str(script), str(Path(__file__).parent), str(tmp_path / "long"), by]
    with subprocess.Popen(words) as parent:
        wait_until(lambda: len(list((tmp_path / "long").glob("*.begun"))) == 2, 60.0)
        workers = [int(path.stem) for path in (tmp_path / "long").iterdir()]
        assert all(map(_alive, workers))
        parent.kill()
    wait_until(lambda: not any(map(_alive, workers)), 5.0)


def test_an_interruption_ends_workers_in_the_middle_of_their_work(tmp_path: Path) -> None:
    path = tmp_path / "short"
    path.mkdir()
    with pytest.raises(KeyboardInterrupt), worker_map(Sleeper, 2) as run:
        run([path] * 2)
        while len(list(path.glob("*.begun"))) < 2:
            time.sleep(0.01)
        raise KeyboardInterrupt
    workers = [int(found.stem) for found in path.iterdir()]
    assert len(workers) == 2 and not any(map(_alive, workers))
    assert not list(path.glob("*.done"))
