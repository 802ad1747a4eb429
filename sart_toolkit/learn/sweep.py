"""The same training with several seeds: a skill of each, and a table of how they went."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from sart_toolkit.data import storage
from sart_toolkit.data.dataset import Dataset, load_dataset
from sart_toolkit.data.records import library_versions
from sart_toolkit.data.result_log import ResultLog
from sart_toolkit.data.schemas import TrainingFile
from sart_toolkit.errors import InvalidInput
from sart_toolkit.learn.samples import remove_windows
from sart_toolkit.learn.skill import save_skill
from sart_toolkit.learn.skillfiles import CONFIG, TRAINING
from sart_toolkit.learn.training import CHECKPOINT, TrainConfig, train
from sart_toolkit.workers import Workers, worker_map
from sart_toolkit.workers.parcels import Output

TABLE = "sweep.json"
# Where it ran decides rounding, not what is learned.
_PLACE = ("seed", "device", "threads")
_TOLD = ("final_loss", "seconds", "images_per_second", "windows", "trajectories", "device")


class _Trainer:
    """Trains with a seed; the skill's directory."""

    def __init__(
        self,
        dataset: Path,
        out: Output,
        config: TrainConfig,
        progress: Callable[[int, int, str], None] | None,
    ) -> None:
        self._dataset, self._out = load_dataset(dataset), out.path
        self._config, self._progress = config, progress

    def __call__(self, seed: int) -> Path:
        path = self._out / _name(seed)
        config = dataclasses.replace(self._config, seed=seed)
        with storage.OutputLock(path):
            result = train(self._dataset, config, path, self._progress)
            save_skill(path, result, self._dataset, overwrite=True)
        return path

    def close(self) -> None:
        """Nothing is held."""


def train_seeds(
    dataset: Dataset,
    config: TrainConfig,
    seeds: Sequence[int],
    out: Path,
    workers: int | Workers = 1,
    overwrite: bool = False,
    progress: Callable[[int, int], None] | None = None,
    steps: Callable[[int, int, str], None] | None = None,
) -> dict[str, Any]:
    """The table in `out`/sweep.json of the skills in `out`/seed0 and so on, one for each seed.

    Interrupted, it resumes: finished skills are kept, and a training in a process of this machine
    goes on from its checkpoint. What is learned depends on the number of threads in the last bits:
    several workers compute with one each.

    Args:
        dataset: the demonstration and its episodes.
        config: how to train; its own seed is not used.
        seeds: of the initial weights, the order and the shifts.
        out: directory to write.
        workers: how many processes, or `Workers` elsewhere.
        overwrite: replace the sweep in `out`.
        progress: called with (done, wanted) after each training.
        steps: called in training, as `train` does, if all work is done in this process.

    Raises:
        InvalidInput: no seed, or one twice or negative; or as `train`.
        OutputExists: there is a sweep, or a skill of one of the seeds, and `overwrite` is false.
        Mismatch: another sweep into `out` was interrupted.
        CannotWrite: another process is at work on it, or the disk refuses.
    """
    workers = Workers.of(workers)
    if not seeds or min(seeds) < 0 or len(set(seeds)) < len(seeds):
        raise InvalidInput(
            f"seeds: expected different whole numbers >= 0, at least one, got {list(seeds)}"
        )
    journal = out / f"{TABLE}.journal"
    if overwrite:
        for seed in seeds:
            storage.remove(out / _name(seed))
    elif not journal.exists():
        for seed in seeds:
            storage.check_writable(out / _name(seed) / CONFIG)
    options = {name: value for name, value in config.to_json().items() if name not in _PLACE}
    asked = {"verb": "train", "dataset": dataset.content_hash, "options": options}
    with ResultLog(out / TABLE, asked, overwrite) as log:
        rows = {row["seed"]: row for row in log.rows}
        missing = [seed for seed in seeds if seed not in rows]
        make_worker = functools.partial(
            _Trainer, dataset.path, Output(out), config, steps if workers.here else None
        )
        gpu = config.device != "cpu"
        with worker_map(make_worker, workers, gpu) as run:
            for seed, path in zip(missing, run(missing), strict=True):
                rows[seed] = _row(seed, path)
                log.add(rows[seed])
                if progress is not None:
                    progress(sum(seed in rows for seed in seeds), len(seeds))
        return log.finish({
            "dataset_hash": dataset.content_hash,
            "policy": config.policy,
            "options": options,
            "skills": [rows[seed] for seed in seeds],
            "versions": library_versions(),
        })  # fmt: skip


def _name(seed: int) -> str:
    return f"seed{seed}"


def _row(seed: int, path: Path) -> dict[str, Any]:
    # Of an interrupted training here, where the skill has come from another machine.
    storage.remove(path / CHECKPOINT)
    remove_windows(path)
    training = storage.read_json(path / TRAINING, TrainingFile)
    return {"seed": seed, "skill": path.name, **{key: training[key] for key in _TOLD}}
