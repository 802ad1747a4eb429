"""Work on a Ray cluster gives what it gives here, wherever it is done and whatever node is lost."""

from __future__ import annotations

import functools
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from sart_toolkit.augment.config import AugmentConfig
from sart_toolkit.augment.engine import augment_demonstration
from sart_toolkit.backends.interface import Backend
from sart_toolkit.data.dataset import Dataset
from sart_toolkit.data.records import Annotation, Demonstration
from sart_toolkit.errors import InvalidInput, Mismatch, SartError
from sart_toolkit.workers import Workers, cluster, worker_map
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


class Broken:
    """Can't be made."""

    def __init__(self) -> None:
        raise Mismatch("not on this node")


class Surroundings:
    """What a worker is given of an environment variable."""

    def __call__(self, name: str) -> str | None:
        return os.environ.get(name)

    def close(self) -> None:
        """Nothing is held."""


def test_results_and_files_come_in_order_from_both_nodes(
    two_nodes: Any, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    given, out = tmp_path / "given.txt", tmp_path / "out"
    given.write_text("item")
    nodes = set()
    before = signal.getsignal(signal.SIGTERM)
    capfd.readouterr()
    with worker_map(functools.partial(Copyist, given, Output(out)), RAY) as run:
        for i, (node, path) in enumerate(run(range(40))):
            assert path == out / f"{i}.txt" and path.read_text() == f"item {i}"
            nodes.add(node)
    assert len(nodes) == 2
    assert signal.getsignal(signal.SIGTERM) is before
    assert capfd.readouterr() == ("", "")


def test_a_lost_node_costs_only_what_it_was_at(
    second_node: Callable[[], None],
    tmp_path: Path,
    capfd: pytest.CaptureFixture[str],
    caplog: pytest.LogCaptureFixture,
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
                capfd.readouterr()
                second_node()
    assert len(set(nodes[-5:])) == 1
    assert "was lost" in caplog.text and "its part is done again" in caplog.text
    assert capfd.readouterr().out == ""


@pytest.mark.slow
def test_a_dataset_is_the_same_from_processes_and_nodes_and_where_one_is_killed(
    second_node: Callable[[], None],
    peg_dataset: Dataset,
    peg_demonstration: Demonstration,
    peg_annotation: Annotation,
    make_peg_backend: Callable[[], Backend],
    tmp_path: Path,
) -> None:
    augment = functools.partial(
        augment_demonstration, peg_demonstration, peg_annotation, make_peg_backend
    )
    config = AugmentConfig(n=17)
    hashes = {
        workers.executor: augment(tmp_path / workers.executor, config, workers).content_hash
        for workers in (Workers(2), RAY)
    }
    killed = False

    def kill(kept: int, wanted: int, rejected: int) -> None:
        nonlocal killed
        if kept == 5 and not killed:
            second_node()
            killed = True

    dataset = augment(tmp_path / "killed", config, RAY, progress=kill)
    assert killed and len(dataset) == 16
    assert {dataset.content_hash} == set(hashes.values())
    assert augment(tmp_path / "small", AugmentConfig(n=5), RAY).content_hash == (
        peg_dataset.content_hash
    )


@pytest.mark.slow
def test_errors_of_a_worker_come_as_they_are(two_nodes: Any) -> None:
    with pytest.raises(Mismatch) as at_work, worker_map(Deserter, RAY) as run:
        results = run(["a", "raise", "b"])
        assert next(results) == "a"
        next(results)
    assert str(at_work.value) == "not that one" and "__call__" in at_work.value.__notes__[0]
    with pytest.raises(Mismatch) as at_start, worker_map(Broken, RAY) as run:
        list(run(["a"]))
    assert str(at_start.value) == "not on this node"


@pytest.mark.slow
def test_an_item_that_costs_worker_after_worker_is_named(two_nodes: Any) -> None:
    with (
        pytest.raises(SartError, match="lost 3 times at 'exit', last on node .*more than a node"),
        worker_map(Deserter, RAY) as run,
    ):
        list(run(["a", "exit", "b"]))


@pytest.mark.slow
def test_workers_that_are_lost_as_they_start_are_an_error(two_nodes: Any) -> None:
    with (
        pytest.raises(SartError, match="3 workers were lost while they started"),
        worker_map(functools.partial(os._exit, 3), Workers(1, "ray")) as run,
    ):
        list(run(["a"]))


@pytest.mark.slow
def test_a_node_with_another_version_is_refused_and_both_are_named(
    two_nodes: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    def newer(actor: type[Any]) -> dict[str, str]:
        assert "sart_toolkit's code" in found(actor) and "pybullet" in found(actor)
        return {**found(actor), "sart_toolkit": "9.9", "a_package": "1.0"}

    found = cluster.versions_here
    monkeypatch.setattr(cluster, "versions_here", newer)
    said = (
        r"node .* has sart_toolkit [\d.]+ instead of 9\.9, a_package none instead of 1\.0; install"
    )
    with pytest.raises(Mismatch, match=said), worker_map(Deserter, Workers(1, "ray")) as run:
        list(run(["a"]))


@pytest.mark.slow
def test_more_workers_than_the_cluster_has_room_for_are_refused_or_waited_for_in_vain(
    two_nodes: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    with (
        pytest.raises(InvalidInput, match="expected at most 2, the CPUs of the cluster, got 3"),
        worker_map(Deserter, Workers(3, "ray")),
    ):
        pass
    with worker_map(Deserter, RAY) as run:
        assert list(run(["a", "b"])) == ["a", "b"]
        monkeypatch.setattr(cluster, "_START_SECONDS", 0.5)
        with (
            pytest.raises(SartError, match="no worker has started within .* CPUs 0 are free"),
            worker_map(Deserter, Workers(1, "ray")) as another,
        ):
            list(another(["a"]))
        assert list(run(["c"])) == ["c"]


@pytest.mark.slow
def test_a_worker_has_one_thread_and_a_gpu_only_if_it_needs_one(two_nodes: Any) -> None:
    node = two_nodes.add_node(num_cpus=1, num_gpus=1, object_store_memory=100 * 2**20)
    try:
        names = ["OPENBLAS_NUM_THREADS", "CUDA_VISIBLE_DEVICES"]
        with worker_map(Surroundings, Workers(1, "ray"), gpu=True) as run:
            assert list(run(names)) == [os.environ.get(names[0], "1"), "0"]
        with worker_map(Surroundings, Workers(1, "ray")) as run:
            assert list(run(names))[1] != "0"
    finally:
        two_nodes.remove_node(node)


@pytest.mark.parametrize(
    ("address", "error", "message"),
    [
        ("ray://head:10001", InvalidInput, "expected HOST:PORT, auto or local, got 'ray://head"),
        ("head", InvalidInput, "expected HOST:PORT, auto or local, got 'head'"),
        ("127.0.0.1:1", SartError, "can't join that cluster .*ray start --head"),
    ],
)
def test_where_no_cluster_is_an_error_says_what_to_start(
    address: str, error: type[Exception], message: str, two_nodes: Any
) -> None:
    with (
        pytest.raises(error, match=message),
        worker_map(Deserter, Workers(1, "ray", address)),
    ):
        pass


@pytest.mark.slow
def test_a_cluster_that_can_not_be_started_is_an_error_with_a_remedy(tmp_path: Path) -> None:
    long = tmp_path / ("a" * 100)
    long.mkdir()
    words = [sys.executable, "-c", _ALONE, str(Path(__file__).parent)]
    environment = {**os.environ, "RAY_TMPDIR": str(long), "HOME": str(tmp_path)}
    done = subprocess.run(words, env=environment, capture_output=True, text=True)
    assert done.returncode == 1
    last = done.stderr.strip().splitlines()[-1]
    assert "no Ray cluster can be started here (" in last and "set RAY_TMPDIR" in last


_ALONE = """
import sys
from sart_toolkit.workers import Workers, worker_map
sys.path.insert(0, sys.argv[1])
from test_cluster import Deserter

with worker_map(Deserter, Workers(1, "ray", "local")) as run:
    print(list(run(["a"])))
"""
