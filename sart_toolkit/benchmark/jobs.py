"""What a plan's cells need done, each once, and the key under which it is kept."""

from __future__ import annotations

import functools
import hashlib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

from sart_toolkit.augment import STRATEGIES, get_strategy
from sart_toolkit.backends import BACKENDS
from sart_toolkit.backends.states import scene_digest
from sart_toolkit.benchmark.plans import STAGES, PlanCell
from sart_toolkit.data.records import digest, library_versions
from sart_toolkit.learn.policies import POLICIES
from sart_toolkit.robots import get_robot
from sart_toolkit.robots.model import RobotModel
from sart_toolkit.tasks import TASKS, get_task
from sart_toolkit.workers.parcels import own_modules

_PACKAGE = Path(__file__).parents[1]
# In the order in which they import from each other. What a stage computes depends on those up to
# its own, and on the pipeline.
_SOURCES = (
    "errors.py", "poses.py", "userfiles.py", "registry.py", "data", "workers", "robots",
    "calibrate", "scenes", "collision", "motion", "hardware", "backends", "tasks", "record",
    "annotate", "augment", "learn", "evaluate",
)  # fmt: skip
_LAST = {
    "record": "record",
    "suggest": "annotate",
    "augment": "augment",
    "train": "learn",
    "evaluate": "evaluate",
}


@dataclass(frozen=True)
class Job:
    """A stage to carry out with some options on what earlier jobs made.

    `inputs`: the jobs by what they are to this one. `key`: a hash of all that its result depends
    on: stage, options, inputs, the toolkit's sources up to its stage, task, robot, a person's own
    modules, and library versions. `size`: how much there is to do, in the stage's own unit:
    demonstrations, annotations, trajectories, rollouts.
    """

    stage: str
    options: Mapping[str, Any]
    inputs: Mapping[str, Job]
    key: str
    size: int

    @property
    def all(self) -> Iterable[Job]:
        """What must be done before it, and the job itself."""
        for job in self.inputs.values():
            yield from job.all
        yield self


def jobs_of(cell: PlanCell) -> dict[str, Job]:
    """The jobs of a cell by stage, in order; strategies without spheres have no "suggest".

    Raises:
        UnknownName: a reference of the cell leads to nothing.
    """
    strategy = get_strategy(cell.strategy)
    n = strategy.n if cell.n is None else cell.n
    policy = cell.policy or strategy.policy
    where = cell.evaluate_on or cell.backend
    references = (cell.task, cell.backend, where, cell.strategy, policy)
    found: dict[str, Job] = {}

    def add(stage: str, size: int, options: Mapping[str, Any], **inputs: str) -> None:
        given = {name: found[s] for name, s in inputs.items() if s in found}
        about = {"stage": stage, "options": dict(options), "sources": _sources(_LAST[stage])}
        about |= {"inputs": {name: job.key for name, job in given.items()}}
        key = digest(about | {"setting": _setting(*references)})[:24]
        found[stage] = Job(stage, options, given, key, size)

    def without_label(table: Mapping[str, Any]) -> dict[str, Any]:
        return {name: value for name, value in table.items() if name != "label"}

    count = 1 if strategy.draws else n
    add(
        "record",
        count,
        {
            "task": cell.task,
            "count": count,
            "backend": cell.backend,
            "seed": cell.demonstration_seed,
            "image_size": cell.image_size,
            **without_label(cell.recording),
        },
    )
    if strategy.annotated:
        add("suggest", count, without_label(cell.suggestion), demo="record")
    generation: dict[str, Any] = {
        "n": n,
        "strategy": cell.strategy,
        "seed": cell.demonstration_seed,
    }
    generation |= without_label(cell.generation)
    add("augment", n, generation, demo="record", annotation="suggest")
    if cell.until == "augment":
        return found
    # What is learned depends on the number of threads in the last bits: one, everywhere.
    training: dict[str, Any] = {"policy": policy, "seed": cell.training_seed}
    training |= {"device": cell.device, "threads": 1, **without_label(cell.training)}
    add("train", n, training, dataset="augment")
    evaluation: dict[str, Any] = {"backend": where, "device": cell.device}
    evaluation |= {"episodes": cell.episodes, "eval_seed": cell.eval_seed}
    add("evaluate", cell.episodes, evaluation | without_label(cell.variation), skill="train")
    assert list(found) == [stage for stage in STAGES if stage in found]
    return found


@functools.cache
def _sources(last: str) -> str:
    """A hash of the toolkit's sources up to a package."""
    sha = hashlib.sha256()
    folders = [_PACKAGE / name for name in _SOURCES[: _SOURCES.index(last) + 1]]
    for folder in (*folders, _PACKAGE / "pipeline.py"):
        for path in [folder] if folder.is_file() else sorted(folder.rglob("*.py")):
            sha.update(f"{path.relative_to(_PACKAGE)}\n".encode() + path.read_bytes())
    return sha.hexdigest()


@functools.cache
def _setting(*references: str) -> dict[str, Any]:
    """What the toolkit's sources don't say: robot and scene, a person's own modules, libraries.

    Args:
        references: the task's first, then whatever else a cell names.
    """
    task = get_task(references[0])
    model = RobotModel(get_robot(task.robot), task.scene.held)
    known = {*TASKS, *BACKENDS, *POLICIES, *STRATEGIES}
    own: list[str] = []
    if any(ref not in known and not ref.startswith("sart_toolkit.") for ref in references):
        own = [hashlib.sha256(path.read_bytes()).hexdigest() for path in own_modules()]
    return {
        "scene": scene_digest(model, task.scene),
        "own": own,
        "versions": library_versions() | {"airo-models": version("airo-models")},
    }
