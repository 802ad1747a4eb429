"""Work is mapped in order, here or in processes, and a lost process is an error of ours."""

from __future__ import annotations

import os

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
