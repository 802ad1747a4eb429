"""The replay benchmark compares what the same commands do on two backends."""

import numpy as np
import pytest

from sart_toolkit.backends import BACKENDS
from sart_toolkit.benchmark import replay
from sart_toolkit.benchmark.replay import benchmark_replay
from sart_toolkit.errors import InvalidInput, Mismatch


def test_a_replay_on_another_backend_is_compared_with_what_was_recorded(
    make_cell, peg_task, tmp_path
):
    cells = [make_cell(peg_task, name) for name in BACKENDS]
    calls = []
    result = benchmark_replay(
        cells, 2, tmp_path / "r.json", progress=lambda *args: calls.append(args)
    )
    n = len(BACKENDS) * (len(BACKENDS) - 1)
    assert len(result["replays"]) == n == len(calls)
    for row in result["replays"]:
        assert row["recorded_on"] != row["replayed_on"]
        assert row["recorded_success"] and row["replayed_success"]
        assert 0 < row["tool_difference_mm"] <= 2.0
        assert row["tool_difference_deg"] <= 0.5
        assert row["steps_compared"] > 0.5 * row["steps"]
        assert np.abs([row["placement"]["x"], row["placement"]["y"]]).max() <= 0.05


def test_an_interrupted_replay_keeps_what_was_finished(make_cell, peg_task, tmp_path, monkeypatch):
    cells = [make_cell(peg_task, name) for name in BACKENDS]
    ran = []

    def replayed(original, source, target, seed):
        ran.append(target.backend)
        if len(ran) == 2:
            raise KeyboardInterrupt
        return {"task": "peg_in_hole", "recorded_on": source.backend,
                "replayed_on": target.backend, "seed": seed}  # fmt: skip

    monkeypatch.setattr(replay, "_demonstrated", lambda cell, seed: None)
    monkeypatch.setattr(replay, "_replayed", replayed)
    with pytest.raises(KeyboardInterrupt):
        benchmark_replay(cells, 2, tmp_path / "r.json")
    with pytest.raises(Mismatch, match="add --overwrite"):
        benchmark_replay(cells, 3, tmp_path / "r.json")
    again = benchmark_replay(cells, 2, tmp_path / "r.json")
    assert len(ran) == len(again["replays"]) + 1
    assert again == benchmark_replay(cells, 2, tmp_path / "whole.json")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["r.json", "whole.json"]


def test_one_backend_is_nothing_to_compare(peg_cell, tmp_path):
    with pytest.raises(InvalidInput, match="needs two backends"):
        benchmark_replay([peg_cell], 0, tmp_path / "r.json")
