from __future__ import annotations

from pathlib import Path

import pytest

from sart_toolkit.benchmark.plans import PLANS, Plan, PlanCell, read_plan
from sart_toolkit.errors import BrokenFile, InvalidInput, MissingFile, UnknownName


@pytest.fixture
def written(tmp_path):
    """Writes a plan's file."""

    def write(text: str) -> Path:
        (tmp_path / "mine.toml").write_text(text)
        return tmp_path / "mine.toml"

    return write


@pytest.mark.parametrize("name", PLANS)
def test_every_plan_has_cells_with_enough_rollouts_on_several_seeds(name):
    plan = read_plan(name)
    assert plan.name == name and plan.about
    assert all(cell.episodes >= 40 for cell in plan.cells)
    assert len({cell.demonstration_seed for cell in plan.cells}) >= 2
    assert len({cell.shown(plan.columns) for cell in plan.cells}) > 1


def test_table1_is_six_tasks_by_four_methods_and_three_seeds():
    cells = read_plan("table1").cells
    assert len(cells) == 72
    assert {cell.strategy for cell in cells} == {"sart", "bc", "miles", "replay"}
    assert all(cell.n == (None if cell.strategy == "replay" else 40) for cell in cells)


def test_a_grid_is_every_combination_of_its_lists(written):
    plan = read_plan(
        written(
            'about = "x"\n[[grid]]\ntask = ["peg_in_hole", "door_opening"]\nn = [20, 40]\n'
            'variation = [{label = "late", latency = 0.1}, {yaw_deg = 15.0}]\n'
            '[[grid]]\ntask = "lid_opening"\n'
        )
    )
    assert len(plan.cells) == 9 and plan.name == "mine"
    assert plan.cells[0] == PlanCell(
        "peg_in_hole", n=20, variation={"label": "late", "latency": 0.1}
    )
    assert [cell.name for cell in plan.cells][:2] == [
        "peg_in_hole-pybullet-sart-n20-d0-t0-late",
        "peg_in_hole-pybullet-sart-n20-d0-t0-yaw_deg_15.0",
    ]


def test_changes_replace_what_grids_give_and_add_what_none_does():
    changes = {"task": "peg_in_hole", "n": [20, 40], "training_seed": [0, 1]}
    cells = read_plan("table1", changes).cells
    assert {cell.task for cell in cells} == {"peg_in_hole"}
    # The grid of the strategy that only replays gives no n, and gets none.
    assert {(cell.strategy == "replay", cell.n) for cell in cells} == {
        (True, None), (False, 20), (False, 40),
    }  # fmt: skip
    assert {cell.training_seed for cell in cells} == {0, 1}


def test_only_some_cells_can_be_chosen():
    plan = read_plan("table1")
    chosen = plan.only("peg*-d101-*")
    assert [cell.strategy for cell in chosen.cells] == ["sart", "bc", "miles", "replay"]
    assert chosen.reference == "sart" and plan.only("*-bc-*").reference is None
    with pytest.raises(UnknownName, match="unknown cell 'peg_in_hole'"):
        plan.only("peg_in_hole")


@pytest.mark.parametrize(
    ("text", "error", "complaint"),
    [
        ("grid = [", BrokenFile, "not readable as TOML"),
        ("", InvalidInput, "has no cell"),
        ('[[grid]]\ntask = "a"\nseed = 3', UnknownName, "field of a cell 'seed'"),
        ("[[grid]]\nn = 3", InvalidInput, "missing required field `task`"),
        ('[[grid]]\ntask = "a"\nn = "many"', InvalidInput, "Expected `int | null`, got `str`"),
        ('[[grid]]\ntask = "a"\nuntil = "train"', InvalidInput, "Invalid enum value 'train'"),
        ('row = "task"\n[[grid]]\ntask = "a"', UnknownName, "entry 'row': did you mean 'rows'"),
        ('rows = "seed"\n[[grid]]\ntask = "a"', UnknownName, "field of a cell 'seed'"),
        ('columns = "task"\n[[grid]]\ntask = "a"', InvalidInput, "another field than rows"),
        ('reference = "bc"\n[[grid]]\ntask = "a"', UnknownName, "reference among strategy 'bc'"),
        ("about = 3\n[[grid]]\ntask = 'a'", InvalidInput, "expected text for about"),
        ("grid = 3", InvalidInput, "expected \\[\\[grid\\]\\] tables"),
        (
            '[[grid]]\ntask = "a"\ntraining = [{label = "x", lr = 1.0}, {label = "x"}]',
            InvalidInput,
            "two cells are called 'a-pybullet-sart-d0-t0-x'",
        ),
    ],
)
def test_what_is_wrong_with_a_plan_is_said(written, text, error, complaint):
    with pytest.raises(error, match=complaint):
        read_plan(written(text))


def test_a_plan_that_is_not_there_is_said(tmp_path):
    with pytest.raises(MissingFile, match="no such plan"):
        read_plan(tmp_path / "none.toml")
    with pytest.raises(UnknownName, match="unknown benchmark 'tabel1': did you mean 'table1'"):
        read_plan("tabel1")


def test_a_plan_may_be_made_without_a_file():
    plan = Plan("own", "", (PlanCell("peg_in_hole"), PlanCell("peg_in_hole", strategy="bc")))
    assert [cell.shown("evaluate_on") for cell in plan.cells] == ["pybullet", "pybullet"]
    assert PlanCell("a/b.py:Task").name == "Task-pybullet-sart-d0-t0"
