"""A Ray cluster of two nodes on this machine."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import pytest

_MIB = 2**20


@pytest.fixture(scope="session")
def two_nodes() -> Iterator[Any]:
    """The cluster, one CPU each; the driver belongs to the first node."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("RAY_USAGE_STATS_ENABLED", "0")
        patch.setenv("RAY_DEDUP_LOGS_SKIP_REGEX", ".")
        cluster = pytest.importorskip("ray.cluster_utils").Cluster()
        try:
            for _ in range(2):
                cluster.add_node(
                    num_cpus=1, object_store_memory=100 * _MIB, include_dashboard=False
                )
            patch.setenv("RAY_ADDRESS", cluster.address)
            yield cluster
        finally:
            cluster.shutdown()


@pytest.fixture
def second_node(two_nodes: Any) -> Iterator[Callable[[], None]]:
    """Kills the second node, as a power cut would; another takes its place after the test."""

    def kill() -> None:
        (node,) = two_nodes.worker_nodes
        two_nodes.remove_node(node, allow_graceful=False)

    yield kill
    if not two_nodes.worker_nodes:
        two_nodes.add_node(num_cpus=1, object_store_memory=100 * _MIB, include_dashboard=False)
