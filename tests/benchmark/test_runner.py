from __future__ import annotations

import dataclasses
import json

import numpy as np
import pytest
from PIL import Image

from sart_toolkit.benchmark.plans import Plan, PlanCell
from sart_toolkit.benchmark.runner import preview_plan, run_plan
from sart_toolkit.data.schemas import CellFile
from sart_toolkit.data.storage import read_json, write_json
from sart_toolkit.errors import CannotWrite, InvalidInput, Mismatch
from sart_toolkit.evaluate.statistics import wilson_interval

SART = PlanCell("peg_in_hole", n=40, episodes=20)
BC = dataclasses.replace(SART, strategy="bc")
PLAN = Plan(
    "small",
    "Two methods.",
    tuple(
        dataclasses.replace(cell, demonstration_seed=seed) for cell in (SART, BC) for seed in (1, 2)
    ),
    reference="sart",
)


class Stages:
    """Carries out stages without a robot; of each rollout of BC every second one fails."""

    def __init__(self):
        self.done = []
        self.fails = {}

    def __call__(self, stage, out, inputs, options):
        if (error := self.fails.get(stage)) is not None and error[0](options):
            raise error[1]
        self.done.append(stage)
        out.mkdir(parents=True, exist_ok=True)
        if stage == "record":
            (out / "method").write_text("bc" if options["count"] > 1 else "sart")
            return {"demonstrations": options["count"], "demonstrating_seconds": 4.0}
        (given,) = (inputs.get(name) for name in ("demo", "dataset", "skill") if name in inputs)
        method = (given / "method").read_text()
        (out / "method").write_text(method)
        if stage == "augment":
            return {"kept": 39, "attempted": 50, "simulated_seconds": 90.0, "resets": 50}
        if stage == "evaluate":
            write_json(out / "evaluation.json", evaluation(out, method, options))
        return {}


def evaluation(out, method, options):
    rows = []
    for i in range(options["episodes"]):
        bad = method == "bc" and i % 2
        row = {
            "episode": i,
            "seed": [options["eval_seed"], i],
            "placement": {"block": {"x": 0.01 * i, "y": 0.0, "yaw_deg": 0.0}},
            "outcome": "failure" if bad else "success",
            "success_any": True,
            "steps": 50,
            "reason": f"peg {i} mm beside" if bad else None,
            "progress": {"waypoint": 30, "of": 60, "seconds": 3.0},
        }
        if bad:
            row["final_image"] = f"evaluation_failures/{i:03d}.png"
            (out / "evaluation_failures").mkdir(exist_ok=True)
            Image.fromarray(np.full((48, 96, 3), 5 * i, np.uint8)).save(out / row["final_image"])
        rows.append(row)
    n = sum(row["outcome"] == "success" for row in rows)
    return {
        "task": "peg_in_hole", "backend": "pybullet", "robot": "r", "policy": "p",
        "n_episodes": len(rows), "n_success": n, "success_rate": n / len(rows),
        "ci95": wilson_interval(n, len(rows)), "episodes": rows,
    }  # fmt: skip


@pytest.fixture
def stages():
    return Stages()


def test_what_cells_share_is_done_once_and_everything_is_written(stages, tmp_path):
    result = run_plan(PLAN, tmp_path / "out", stages, about={"command": "sart benchmark small"})
    assert {stage: stages.done.count(stage) for stage in set(stages.done)} == {
        "record": 4, "suggest": 2, "augment": 4, "train": 4, "evaluate": 4,
    }  # fmt: skip
    assert result["failed"] == {} and len(result["cells"]) == 4
    for name in result["cells"]:
        cell = read_json(tmp_path / "out" / "cells" / f"{name}.json", CellFile)
        assert cell["command"] == "sart benchmark small"
        assert len(cell["evaluation"]["episodes"]) == 20 and set(cell["seconds"]) >= {"train"}
    again = dataclasses.replace(PLAN.cells[0], variation={"label": "late", "latency": 0.1})
    both = dataclasses.replace(PLAN, cells=(*PLAN.cells, again))
    stages.done.clear()
    run_plan(both, tmp_path / "out", stages)
    assert stages.done == ["evaluate"]
    stages.done.clear()
    run_plan(both, tmp_path / "other", stages, store=tmp_path / "out" / "stages")
    assert stages.done == []


def test_a_table_counts_compares_and_tells_what_it_took(stages, tmp_path):
    (table,) = run_plan(PLAN, tmp_path, stages)["tables"]
    assert table["given"] == {} and table["columns"] == ["sart", "bc"]
    sart, bc = table["entries"]
    assert (sart["rate"]["n_success"], bc["rate"]["n_success"]) == (40, 20)
    assert bc["rate"]["units"] == [0.5, 0.5] and bc["unit"] == "demonstration_seed"
    found = bc["against_reference"]
    assert found["test"] == "mcnemar" and found["pairs"] == {"n": 40, "only_a": 20, "only_b": 0}
    assert found["p"] == found["p_holm"] == pytest.approx(2 / 2**20)
    assert "against_reference" not in sart
    assert (sart["effort"]["demonstrations"], bc["effort"]["demonstrations"]) == (1, 40)
    assert sart["effort"]["robot_seconds"] == 90.0


def test_the_page_shows_rates_failures_images_and_each_command(stages, tmp_path):
    run_plan(PLAN, tmp_path, stages, about={"command": "sart benchmark small --out x"})
    page = (tmp_path / "benchmark.html").read_text()
    assert "40/40 <b>100 %</b>" in page.replace("\xa0", " ")
    assert "20/40 <b>50 %</b> *" in page.replace("\xa0", " ")
    assert "20 × peg_in_hole, bc: peg 10 mm beside" in page
    assert "waypoint 30, after 3.0" in page and page.count("data:image/png") == 3
    assert "sart benchmark small --out x --only peg_in_hole-pybullet-bc-n40-d2-t0" in page
    assert "<script" not in page


def test_a_failed_job_leaves_out_its_cells_and_no_others(stages, tmp_path, caplog):
    stages.fails["augment"] = (lambda o: o["seed"] == 2, Mismatch("no room; move away"))
    result = run_plan(PLAN, tmp_path, stages)
    assert sorted(result["cells"]) == [
        "peg_in_hole-pybullet-bc-n40-d1-t0", "peg_in_hole-pybullet-sart-n40-d1-t0",
    ]  # fmt: skip
    assert set(result["failed"].values()) == {"augment: no room; move away"}
    assert "no room; move away" in (tmp_path / "benchmark.html").read_text()
    assert "no room" in caplog.text
    stages.fails.clear()
    stages.done.clear()
    assert run_plan(PLAN, tmp_path, stages)["failed"] == {}
    assert sorted(stages.done) == ["augment"] * 2 + ["evaluate"] * 2 + ["train"] * 2


def test_an_error_that_nobody_foresaw_fails_a_cell_too(stages, tmp_path):
    stages.fails["train"] = (lambda o: True, ZeroDivisionError("by zero"))
    result = run_plan(PLAN, tmp_path, stages)
    assert result["cells"] == [] and set(result["failed"].values()) == {
        "train: ZeroDivisionError: by zero"
    }


def test_an_interrupted_benchmark_does_only_what_is_left(stages, tmp_path):
    stages.fails["train"] = (lambda o: "train" in stages.done, KeyboardInterrupt())
    with pytest.raises(KeyboardInterrupt):
        run_plan(PLAN, tmp_path, stages)
    assert stages.done.count("train") == 1
    stages.fails.clear()
    stages.done.clear()
    run_plan(PLAN, tmp_path, stages)
    assert stages.done == ["train"] * 3 + ["evaluate"] * 4


def test_two_runs_into_one_directory_at_once_are_refused(stages, tmp_path):
    def meanwhile(*counts):
        with pytest.raises(CannotWrite, match="another process is using it"):
            run_plan(PLAN, tmp_path, stages)

    run_plan(PLAN, tmp_path, stages, progress=meanwhile)


def test_a_preview_counts_shared_jobs_once_and_learns_from_those_done(stages, tmp_path):
    before = preview_plan(PLAN, tmp_path)
    assert before["jobs"] == 18 and before["measured"] == [] and not any(tmp_path.iterdir())
    assert before["cells"][PLAN.cells[0].name]["missing"] == [
        "record", "suggest", "augment", "train", "evaluate",
    ]  # fmt: skip
    assert before["seconds"] == 2 * preview_plan(PLAN, tmp_path, workers=2)["seconds"] > 60
    first = dataclasses.replace(PLAN, cells=PLAN.cells[:1])
    run_plan(first, tmp_path, stages)
    after = preview_plan(PLAN, tmp_path)
    assert after["cells"][first.cells[0].name] == {"missing": [], "seconds": 0}
    assert after["jobs"] == 13 and "train" in after["measured"]
    assert after["seconds"] < 30 < before["seconds"]


def test_cells_without_rollouts_show_effort_alone(stages, tmp_path):
    cells = tuple(dataclasses.replace(cell, until="augment") for cell in PLAN.cells)
    (table,) = run_plan(dataclasses.replace(PLAN, cells=cells), tmp_path, stages)["tables"]
    assert "train" not in stages.done
    assert all("rate" not in entry for entry in table["entries"])
    page = (tmp_path / "benchmark.html").read_text()
    assert "Effort" in page and "39 of 50" in page and "How sure" not in page


def test_what_differs_besides_rows_and_columns_makes_tables_of_their_own(stages, tmp_path):
    cells = [
        dataclasses.replace(SART, backend=backend, n=n)
        for backend in ("pybullet", "sapien")
        for n in (20, 40)
    ]
    plan = Plan("scaling", "", tuple(cells), columns="n")
    tables = run_plan(plan, tmp_path, stages)["tables"]
    assert [table["given"] for table in tables] == [
        {"backend": "pybullet", "evaluate_on": "pybullet"},
        {"backend": "sapien", "evaluate_on": "sapien"},
    ]
    assert all(table["columns"] == ["20", "40"] for table in tables)


def test_an_invalid_option_is_not_hidden_by_what_is_done(stages, tmp_path):
    stages.fails["evaluate"] = (lambda o: True, InvalidInput("episodes: expected at least 1"))
    result = run_plan(PLAN, tmp_path, stages)
    assert json.loads((tmp_path / "benchmark.json").read_text())["failed"] == result["failed"]
    assert len(result["failed"]) == 4
