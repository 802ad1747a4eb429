"""`sart benchmark PLAN` and `sart compare`, typed."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from sart_toolkit.benchmark.plans import PLANS
from sart_toolkit.cli import main
from sart_toolkit.data.storage import read_json, write_json

RESULTS = Path(__file__).parents[2] / "docs" / "results"
# What only replays learns nothing, so that a cell takes seconds.
REPLAY = """
about = "Replaying."
[[grid]]
task = "peg_in_hole"
strategy = "replay"
demonstration_seed = 101
episodes = 2
eval_seed = 7000001
image_size = 32
"""

Said = Callable[..., Any]
Refused = Callable[..., str]


@pytest.fixture
def plan(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "mine.toml").write_text(REPLAY)
    return Path("mine.toml")


def test_benchmarks_and_plans_are_offered_together(refused: Refused) -> None:
    said = refused("benchmark")
    assert all(name in said for name in (*PLANS, "operator", "radii"))
    assert "did you mean 'table1'" in refused("benchmark", "table", "--out", "x")


def test_a_dry_run_says_cells_time_and_disk_and_writes_nothing(plan: Path, said: Said) -> None:
    result = said("benchmark", plan, "--out", "out", "--dry-run", "--set", "training_seed=0,1")
    assert result["cells"] == "2, 0 of them done"
    assert result["jobs"] == "6 missing, each counted once"
    assert result["time"].startswith("about ") and result["disk"].endswith("MB more")
    assert not Path("out").exists()


def test_the_same_cell_again_has_the_same_outcomes(plan: Path, said: Said) -> None:
    outcomes = []
    for out, workers in (("a", 1), ("b", 2)):
        result = said("benchmark", plan, "--out", out, "--workers", workers)
        assert result["cells"] == 1 and Path(result["page"]).is_file()
        (cell,) = Path(out, "cells").iterdir()
        found = read_json(cell, dict)
        outcomes.append((found["evaluation"]["episodes"], found["keys"]))
    assert outcomes[0] == outcomes[1]
    # Nothing is left to do, so nothing but the tables is made again.
    times = {path: path.stat().st_mtime_ns for path in Path("a", "stages").rglob("*")}
    said("benchmark", plan, "--out", "a")
    assert times == {path: path.stat().st_mtime_ns for path in Path("a", "stages").rglob("*")}


@pytest.mark.slow
def test_a_published_cell_can_be_made_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, said: Said
) -> None:
    """Other processors round otherwise, which may decide a rollout that barely succeeds."""
    monkeypatch.chdir(tmp_path)
    plan, name = RESULTS / "benchmark_peg.toml", "peg_in_hole-pybullet-replay-d101-t0"
    said("benchmark", plan, "--out", "out", "--only", name)
    again, published = (
        read_json(folder / f"{name}.json", dict)["evaluation"]["episodes"]
        for folder in (Path("out", "cells"), RESULTS / "benchmark_peg")
    )
    for a, b in zip(again, published, strict=True):
        assert (a["placement"], a["outcome"]) == (b["placement"], b["outcome"])


def test_a_failed_cell_ends_with_its_reason_and_the_others_are_done(
    plan: Path, refused: Callable[..., str], capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as ended:
        main(["benchmark", str(plan), "--out", "out", "--workers", "1",
              "--set", "task=peg_in_hole,nowhere.py:Task"])  # fmt: skip
    assert ended.value.code == 2
    assert "no file nowhere.py" in capsys.readouterr().err and not Path("out").exists()
    # What can be told only when it is carried out.
    plan.write_text(plan.read_text() + 'recording = [{}, {label = "turned", yaw_deg = 9.0}]\n')
    with pytest.raises(SystemExit) as ended:
        main(["benchmark", str(plan), "--out", "out", "--workers", "1",
              "--set", "episodes=1"])  # fmt: skip
    said = capsys.readouterr().err.strip().splitlines()[-1]
    assert ended.value.code == 2
    assert "1 of 2 cells failed" in said and "turns random placements only" in said
    assert len(list(Path("out", "cells").iterdir())) == 1


@pytest.mark.parametrize(
    ("words", "complaint"),
    [
        (["--set", "episodes"], "--set: expected FIELD=VALUE, got 'episodes'"),
        (["--set", "seed=3"], "unknown mine.toml: field of a cell 'seed'"),
        (["--set", "episodes=0"], "episodes: expected at least 1"),
        (["--set", "strategy=sert"], "did you mean 'sart'"),
        (["--only", "door*"], "unknown cell 'door*'"),
    ],
)
def test_what_can_not_work_is_said_before_anything_is_done(
    plan: Path, refused: Refused, words: list[str], complaint: str
) -> None:
    assert complaint in refused("benchmark", plan, "--out", "out", *words)
    assert not Path("out").exists()


@pytest.mark.parametrize(
    ("table", "complaint"),
    [
        ("training = {learning_rate = 1.0}", "unknown training option 'learning_rate'"),
        ("variation = {yaw = 10}", "unknown option of evaluate 'yaw': did you mean 'yaw_deg'"),
        ("variation = {appearance = {color = 1}}", "part of the appearance 'color'"),
        ("recording = {speed = 2}", "unknown option of record 'speed'"),
        ("generation = {sampling = {law = 'x'}}", "unknown option of sampling 'law'"),
    ],
)
def test_options_that_do_not_exist_are_refused(
    plan: Path, refused: Refused, table: str, complaint: str
) -> None:
    plan.write_text(plan.read_text() + table)
    assert complaint in refused("benchmark", plan, "--out", "out")


# --- compare ------------------------------------------------------------------------------------


def evaluation(outcomes: str) -> dict[str, Any]:
    rows = [
        {
            "episode": i,
            "seed": [7, i],
            "placement": {"block": {"x": 0.0, "y": 0.0, "yaw_deg": 0.0}},
            "outcome": "success" if letter == "+" else "failure",
            "reason": None if letter == "+" else f"peg {i} mm beside",
        }
        for i, letter in enumerate(outcomes)
    ]
    n, k = len(rows), outcomes.count("+")
    return {
        "task": "t", "backend": "b", "robot": "r", "policy": "p", "n_episodes": n, "n_success": k,
        "success_rate": k / n, "ci95": [0.0, 1.0], "episodes": rows,
    }  # fmt: skip


def test_two_evaluations_are_compared_by_their_pairs(
    tmp_path: Path, said: Said, capsys: pytest.CaptureFixture[str]
) -> None:
    a, b = tmp_path / "a.json", tmp_path / "b.json"
    write_json(a, evaluation("+" * 20))
    write_json(b, evaluation("+" * 10 + "-" * 10))
    found = said("compare", a, b)
    assert found["pairs"] == {"n": 20, "only_a": 10, "only_b": 0}
    assert found["p"] == pytest.approx(2 / 2**10) and found["a"]["n_success"] == 20
    main(["compare", str(a), str(b)])
    words = capsys.readouterr().out
    assert "10 x peg 14 mm beside" in words and "-50 points" in words
    assert "McNemar over 20 pairs: only a succeeded 10 times, only b 0" in words


def test_runs_skills_and_cells_are_compared_too(
    tmp_path: Path, said: Said, refused: Refused
) -> None:
    run = tmp_path / "run"
    (run / "skill").mkdir(parents=True)
    (run / "skill" / "model.safetensors").touch()
    write_json(run / "evaluation.json", evaluation("++"))
    cell = {"name": "c", "cell": {}, "keys": {}, "seconds": {}, "figures": {}}
    write_json(tmp_path / "cell.json", cell | {"evaluation": evaluation("+-")})
    for path in (run, run / "skill"):
        found = said("compare", path, tmp_path / "cell.json")
        assert found["difference"] == -0.5 and "only 2 rollouts" in found["a"]["warning"]
    write_json(tmp_path / "effort.json", cell | {"evaluation": None})
    assert "was not evaluated" in refused("compare", run, tmp_path / "effort.json")
    (tmp_path / "empty").mkdir()
    assert "has no evaluation.json" in refused("compare", run, tmp_path / "empty")
    (tmp_path / "odd.json").write_text(json.dumps({"schema_version": 1}))
    assert "odd.json" in refused("compare", run, tmp_path / "odd.json")


# --- evaluate's variations ----------------------------------------------------------------------


@pytest.mark.parametrize(
    ("words", "complaint"),
    [
        (["--appearance", "color=1"], "part of the appearance 'color': did you mean 'colour'"),
        (["--appearance", "colour"], "--appearance: expected NAME=NUMBER,..., got 'colour'"),
        (["--appearance", "colour=1", "--vary-appearance"], "--vary-appearance: varies everything"),
    ],
)
def test_a_mistake_in_how_the_appearance_varies_is_said(
    refused: Refused, words: list[str], complaint: str
) -> None:
    assert complaint in refused("evaluate", "nowhere", "--out", "x", *words)
