"""Work on a Ray cluster gives what it gives here, wherever it is done and whatever node is lost."""

from __future__ import annotations

import functools
import os
import signal
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from sart_toolkit.errors import InvalidInput, Mismatch, SartError
from sart_toolkit.workers import Workers, worker_map
from sart_toolkit.workers.parcels import Output

RAY = Workers(2, "ray")


class Copyist:
    """Writes what it was given, in a file for each item."""

    def __init__(self, given: Path, out: Output) -> None:
        import ray

        self._given, self._out = given, out.path
        self._node = ray.get_runtime_context().get_node_id()

    def __call__(self, item: int) -> tuple[str, Path]:
        path = self._out / f"{item}.txt"
        path.write_text(f"{self._given.read_text()} {item}")
        time.sleep(0.05)
        return self._node, path

    def close(self) -> None:
        """Nothing is held."""


class Deserter:
    """Ends its process at one item; at another it raises."""

    def __call__(self, item: str) -> str:
        if item == "exit":
            os._exit(3)
        if item == "raise":
            raise Mismatch("not that one")
        return item

    def close(self) -> None:
        """Nothing is held."""


def test_results_and_files_come_in_order_from_both_nodes(two_nodes: Any, tmp_path: Path) -> None:
    given, out = tmp_path / "given.txt", tmp_path / "out"
    given.write_text("item")
    nodes = set()
    before = signal.getsignal(signal.SIGTERM)
    with worker_map(functools.partial(Copyist, given, Output(out)), RAY) as run:
        for i, (node, path) in enumerate(run(range(40))):
            assert path == out / f"{i}.txt" and path.read_text() == f"item {i}"
            nodes.add(node)
    assert len(nodes) == 2
    assert signal.getsignal(signal.SIGTERM) is before


def test_a_lost_node_costs_nothing_but_time(
    second_node: Callable[[], None], tmp_path: Path
) -> None:
    given = tmp_path / "given.txt"
    given.write_text("item")
    nodes: list[str] = []
    with worker_map(functools.partial(Copyist, given, Output(tmp_path / "out")), RAY) as run:
        for i, (node, path) in enumerate(run(range(60))):
            assert path.read_text() == f"item {i}"
            nodes.append(node)
            if i == 20:
                assert len(set(nodes)) == 2
                second_node()
    assert len(set(nodes)) == 2 and len(set(nodes[-5:])) == 1
