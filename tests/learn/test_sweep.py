"""A sweep is the trainings of its seeds, each finished once however often it is interrupted."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any

import pytest

from sart_toolkit.data.dataset import Dataset
from sart_toolkit.errors import InvalidInput, Mismatch, OutputExists
from sart_toolkit.learn.skill import load_skill, save_skill
from sart_toolkit.learn.sweep import train_seeds
from sart_toolkit.learn.training import TrainConfig, train
from sart_toolkit.workers import Workers


def weights(skill: Path) -> bytes:
    return (skill / "model.safetensors").read_bytes()


class Interrupt:
    """Interrupts at a call."""

    def __init__(self, at: int) -> None:
        self.calls, self._at = 0, at

    def __call__(self, *_: Any) -> None:
        self.calls += 1
        if self.calls == self._at:
            raise KeyboardInterrupt


def test_each_skill_is_that_of_a_training_with_its_seed(
    dataset: Dataset, small_config: TrainConfig, tmp_path: Path
) -> None:
    table = train_seeds(dataset, small_config, (3, 0), tmp_path / "sweep")
    assert [(row["seed"], row["skill"]) for row in table["skills"]] == [(3, "seed3"), (0, "seed0")]
    written = json.loads((tmp_path / "sweep" / "sweep.json").read_text())
    assert written["skills"] == table["skills"]
    assert written["dataset_hash"] == dataset.content_hash and "seed" not in written["options"]
    for row in table["skills"]:
        config = dataclasses.replace(small_config, seed=row["seed"])
        result = train(dataset, config, tmp_path / "alone")
        save_skill(tmp_path / "alone", result, dataset, overwrite=True)
        skill = tmp_path / "sweep" / row["skill"]
        assert weights(skill) == weights(tmp_path / "alone")
        assert load_skill(skill).config.training.seed == row["seed"]
        assert row["final_loss"] == result.final_loss and row["trajectories"] == 4
    assert sorted(path.name for path in (tmp_path / "sweep").iterdir()) == [
        "seed0", "seed3", "sweep.json",
    ]  # fmt: skip


def test_interrupted_it_resumes_and_what_is_finished_is_not_trained_again(
    dataset: Dataset, small_config: TrainConfig, tmp_path: Path
) -> None:
    whole = train_seeds(dataset, small_config, (0, 1, 2), tmp_path / "whole")
    out = tmp_path / "sweep"
    with pytest.raises(KeyboardInterrupt):
        train_seeds(dataset, small_config, (0, 1, 2), out, progress=Interrupt(2))
    stamp = (out / "seed0" / "config.json").stat().st_mtime_ns
    again = train_seeds(dataset, small_config, (0, 1, 2), out)
    assert (out / "seed0" / "config.json").stat().st_mtime_ns == stamp
    told = [[row[key] for key in ("seed", "final_loss")] for row in again["skills"]]
    assert told == [[row[key] for key in ("seed", "final_loss")] for row in whole["skills"]]
    assert weights(out / "seed2") == weights(tmp_path / "whole" / "seed2")


def test_a_skill_whose_row_was_lost_is_trained_again(
    dataset: Dataset, small_config: TrainConfig, tmp_path: Path
) -> None:
    out = tmp_path / "sweep"
    with pytest.raises(KeyboardInterrupt):
        train_seeds(dataset, small_config, (0, 1), out, progress=Interrupt(1))
    journal = out / "sweep.json.journal"
    journal.write_bytes(journal.read_bytes().splitlines(keepends=True)[0])
    assert [row["seed"] for row in train_seeds(dataset, small_config, (0, 1), out)["skills"]] == [
        0, 1,
    ]  # fmt: skip


@pytest.mark.slow
def test_two_processes_train_the_same(
    dataset: Dataset, small_config: TrainConfig, tmp_path: Path
) -> None:
    config = dataclasses.replace(small_config, threads=1)
    for name, workers in (("one", Workers(1)), ("two", Workers(2))):
        train_seeds(dataset, config, (0, 1), tmp_path / name, workers)
    for seed in ("seed0", "seed1"):
        assert weights(tmp_path / "one" / seed) == weights(tmp_path / "two" / seed)


@pytest.mark.parametrize("seeds", [(), (0, 0), (1, -1)])
def test_seeds_that_can_not_be_are_refused(
    dataset: Dataset, small_config: TrainConfig, tmp_path: Path, seeds: tuple[int, ...]
) -> None:
    with pytest.raises(InvalidInput, match="seeds: expected different whole numbers >= 0"):
        train_seeds(dataset, small_config, seeds, tmp_path)


def test_neither_a_skill_nor_another_sweep_is_written_over_unasked(
    dataset: Dataset, small_config: TrainConfig, tmp_path: Path
) -> None:
    out = tmp_path / "sweep"
    save_skill(out / "seed1", train(dataset, small_config, out / "seed1"), dataset)
    with pytest.raises(OutputExists, match="seed1"):
        train_seeds(dataset, small_config, (0, 1), out)
    assert not (out / "seed0").exists()
    with pytest.raises(KeyboardInterrupt):
        train_seeds(dataset, small_config, (0,), out, progress=Interrupt(1))
    longer = dataclasses.replace(small_config, epochs=small_config.epochs + 1)
    with pytest.raises(Mismatch, match="holds results of"):
        train_seeds(dataset, longer, (0, 1), out)
    table = train_seeds(dataset, longer, (0, 1), out, overwrite=True)
    assert [row["seed"] for row in table["skills"]] == [0, 1]
    with pytest.raises(OutputExists, match="already exists"):
        train_seeds(dataset, longer, (0, 1), out)
