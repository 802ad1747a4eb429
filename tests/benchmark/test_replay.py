"""The replay benchmark compares what the same commands do on two backends."""

import numpy as np
import pytest

from sart_toolkit.backends import BACKENDS
from sart_toolkit.benchmark.replay import benchmark_replay
from sart_toolkit.errors import InvalidInput


def test_a_replay_on_another_backend_is_compared_with_what_was_recorded(make_cell, peg_task):
    cells = [make_cell(peg_task, name) for name in BACKENDS]
    calls = []
    result = benchmark_replay(cells, seed=2, progress=lambda *args: calls.append(args))
    n = len(BACKENDS) * (len(BACKENDS) - 1)
    assert len(result["replays"]) == n == len(calls)
    for row in result["replays"]:
        assert row["recorded_on"] != row["replayed_on"]
        assert row["recorded_success"] and row["replayed_success"]
        assert 0 < row["tool_difference_mm"] <= 2.0
        assert row["tool_difference_deg"] <= 0.5
        assert row["steps_compared"] > 0.5 * row["steps"]
        assert np.abs([row["placement"]["x"], row["placement"]["y"]]).max() <= 0.05


def test_one_backend_is_nothing_to_compare(peg_cell):
    with pytest.raises(InvalidInput, match="needs two backends"):
        benchmark_replay([peg_cell])
