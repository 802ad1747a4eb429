"""Benchmarks over tasks and backends: resumable, independent of processes, counted honestly."""

import json

import pytest

from sart_toolkit.benchmark.operator import BenchmarkConfig, benchmark_operator
from sart_toolkit.errors import InvalidInput, Mismatch, OutputExists
from sart_toolkit.tasks.peg_in_hole import PegInHole
from sart_toolkit.tasks.task import PlanStep


class LazyPeg(PegInHole):
    """An operator that never goes down."""

    def plan(self, state):
        T = super().plan(state)[0].T_world_tool
        return [PlanStep(T, state.gripper, 0.1)]


class FarPeg(PegInHole):
    """An operator that is sent where no start can be."""

    def initial_state(self, model, placement):
        raise InvalidInput("nowhere to start")


def plain(result):
    """The figures that don't depend on the machine's speed."""
    rows = {k: dict(v) for k, v in result["cells"].items()}
    for row in rows.values():
        row.pop("simulated_over_wall")
    return rows


def test_successes_are_counted_over_random_placements(peg_cell, tmp_path):
    calls = []
    result = benchmark_operator(
        [peg_cell], BenchmarkConfig(3, seed=5), tmp_path / "out.json",
        progress=lambda *args: calls.append(args),
    )  # fmt: skip
    row = result["cells"]["peg_in_hole/pybullet"]
    assert (row["n_success"], row["n_episodes"]) == (3, 3)
    assert row["ci95"][0] < 1.0 == row["success_rate"]
    assert 2 < row["median_seconds"] < 15
    assert calls == [(1, 3, 1), (2, 3, 2), (3, 3, 3)]
    assert json.loads((tmp_path / "out.json").read_text())["cells"] == result["cells"]
    assert [path.name for path in tmp_path.iterdir()] == ["out.json"]


def test_failures_are_reported_with_placement_and_reason(make_cell, tmp_path):
    for task, reason in ((LazyPeg(), "above the rim"), (FarPeg(), "nowhere to start")):
        result = benchmark_operator(
            [make_cell(task)], BenchmarkConfig(2), tmp_path / f"{type(task).__name__}.json"
        )
        row = result["cells"]["peg_in_hole/pybullet"]
        assert row["n_success"] == 0
        assert [f["episode"] for f in row["failures"]] == [0, 1]
        assert all(reason in f["reason"] for f in row["failures"])


def test_an_interrupted_benchmark_resumes(peg_cell, tmp_path):
    class Interrupted(Exception):
        pass

    def stop(done, wanted, successes):
        if done == 2:
            raise Interrupted

    out, config = tmp_path / "out.json", BenchmarkConfig(3)
    with pytest.raises(Interrupted):
        benchmark_operator([peg_cell], config, out, progress=stop)
    with pytest.raises(Mismatch, match="add --overwrite"):
        benchmark_operator([peg_cell], BenchmarkConfig(3, seed=1), out)
    calls = []
    again = benchmark_operator(
        [peg_cell], config, out, progress=lambda done, *_: calls.append(done)
    )
    assert calls == [3]
    whole = benchmark_operator([peg_cell], config, tmp_path / "whole.json", workers=2)
    assert plain(again) == plain(whole)
    with pytest.raises(OutputExists):
        benchmark_operator([peg_cell], config, out)


def test_what_cannot_be_is_refused_before_anything_is_written(peg_cell, tmp_path):
    with pytest.raises(InvalidInput, match="can be turned by 0 to"):
        benchmark_operator([peg_cell], BenchmarkConfig(1, yaw_deg=90.0), tmp_path / "out.json")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(("episodes", "seed"), [(0, 0), (1, -1)])
def test_bad_numbers_are_refused(episodes, seed):
    with pytest.raises(InvalidInput, match="expected"):
        BenchmarkConfig(episodes, seed)
