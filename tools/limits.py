"""Joint limits of all that is sent in demonstrations and rollouts: `python tools/limits.py DIR`.

For each task a skill is learned in DIR/TASK and executed on random placements; besides it, actions
drawn at random, which jump wildly. Whatever is sent to the joints at each physics step is held
against the robot's limits of velocity, acceleration and jerk by finite differences. Resumes.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Mapping, Sequence
from contextlib import closing
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from sart_toolkit import pipeline
from sart_toolkit.backends import make_backend
from sart_toolkit.backends.interface import Backend
from sart_toolkit.benchmark.cells import BLIND, demonstrate
from sart_toolkit.benchmark.limits import LimitCheck, SentTargets
from sart_toolkit.data.records import Image, library_versions
from sart_toolkit.data.storage import load_demonstration, read_json, write_json
from sart_toolkit.errors import SartError
from sart_toolkit.evaluate.rollout import episode_placement, run_rollout
from sart_toolkit.learn.skill import Skill, load_skill
from sart_toolkit.poses import Array
from sart_toolkit.robots import get_robot
from sart_toolkit.robots.model import RobotModel
from sart_toolkit.tasks import TASKS, get_task
from sart_toolkit.tasks.task import Task

# Random actions go as far as this in one step: [m], [rad].
_FAR, _TURN = 0.08, 0.6


def main(arguments: Sequence[str] | None = None) -> int:
    """The exit code of checking the named tasks, or all: 1 if a limit was exceeded."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("directory", type=Path, help="where skills and results go")
    parser.add_argument("--tasks", nargs="*", default=list(TASKS), help="which tasks")
    parser.add_argument("--n", type=int, default=20, help="trajectories to learn from")
    parser.add_argument("--epochs", type=int, default=20, help="training epochs")
    parser.add_argument("--rollouts", type=int, default=50, help="rollouts of each skill")
    parser.add_argument("--wild", type=int, default=10, help="rollouts of random actions")
    parser.add_argument("--seed", type=int, default=0, help="of demonstration and learning")
    parser.add_argument("--eval-seed", type=int, default=1000, help="of the placements")
    parser.add_argument("--backend", default="pybullet", help="which simulator")
    parser.add_argument("--out", type=Path, help="JSON file; DIR/limits.json if left out")
    options = parser.parse_args(arguments)
    out = options.out or options.directory / "limits.json"
    rows: dict[str, dict[str, Any]] = {}
    exceeded = 0
    try:
        for name in options.tasks:
            rows[name] = _resumed(options, name)
            print(name, *(f"{key}: {_text(rows[name][key])}" for key in _PARTS), sep="\n  ")
        exceeded = sum(row[key]["violations"] for row in rows.values() for key in _PARTS)
        write_json(
            out,
            {
                "command": "python tools/limits.py " + " ".join(sys.argv[1:]),
                "tasks": rows,
                "violations": sum(
                    row[key]["violations"] for row in rows.values() for key in _PARTS
                ),
                "versions": library_versions(),
            },
        )
    except SartError as error:
        print(f"limits.py: {error}", file=sys.stderr)
        return 2
    return int(exceeded > 0)


_PARTS = ("demonstration", "rollouts", "random_actions")


def _text(row: Mapping[str, Any]) -> str:
    shares = " ".join(f"{ratio:.1%}" for ratio in row["ratios"])
    return (
        f"{row['runs']} runs, {row['samples']} targets, {row['violations']} violations; at most "
        f"{shares} of velocity, acceleration, jerk limit"
        + (f"; {row['successes']} succeeded" if "successes" in row else "")
    )


def _resumed(options: argparse.Namespace, name: str) -> dict[str, Any]:
    file = options.directory / name / "limits.json"
    asked = {
        key: getattr(options, key) for key in ("n", "epochs", "rollouts", "wild", "seed", "backend")
    } | {"eval_seed": options.eval_seed}
    if file.exists() and (found := read_json(file, dict)).get("asked") == asked:
        return found
    row = _checked(options, name) | {"asked": asked}
    write_json(file, row)
    return row


def _checked(options: argparse.Namespace, name: str) -> dict[str, Any]:
    task, directory = get_task(name), options.directory / name
    skill = load_skill(_learned(options, name, directory))
    robot = get_robot(task.robot)
    size = pipeline.image_size_of(skill.demonstration)
    with closing(make_backend(options.backend, robot, task.scene, size)) as backend:
        model = RobotModel(backend.robot, backend.scene.held)
        sent = SentTargets(backend)
        rng = np.random.default_rng([options.seed, 0])
        placement = task.sample_placement(rng)
        demonstrate(task, backend, model, placement, rng, BLIND)
        start = task.initial_state(model, placement).q
        return {
            "demonstration": _tally([sent.check(start, np.zeros_like(start))]),
            "rollouts": _rollouts(skill, task, backend, model, sent, options, options.rollouts),
            "random_actions": _rollouts(
                _Wild(skill), task, backend, model, sent, options, options.wild
            ),
        }


def _learned(options: argparse.Namespace, name: str, directory: Path) -> Path:
    """The directory of a small skill, learned unless it is there."""
    demo, annotation = directory / "demo.h5", directory / "annotation.json"
    dataset, skill = directory / "dataset", directory / "skill"
    if not demo.exists():
        pipeline.record(name, demo, backend=options.backend, seed=options.seed, image_size=64)
    load_demonstration(demo)
    if not annotation.exists():
        pipeline.suggest(demo, annotation)
    pipeline.augment(demo, annotation, dataset, n=options.n, seed=options.seed)
    if not (skill / "config.json").exists():
        pipeline.train_policy(dataset, skill, epochs=options.epochs, seed=options.seed)
    return skill


class _Wild:
    """In a skill's place: actions drawn at random, held for a few steps."""

    def __init__(self, skill: Skill) -> None:
        self.demonstration, self.cameras = skill.demonstration, ()
        self._rng = np.random.default_rng(0)
        self._steps = 0

    def reset(self) -> None:
        self._steps = 0

    def act(self, images: Mapping[str, Image], gripper: float, up: Array) -> Array:
        if self._steps % 4 == 0:
            far = self._rng.uniform(-_FAR, _FAR, 3)
            turn = self._rng.uniform(-_TURN, _TURN, 3)
            self._action = np.array([*far, *turn, self._rng.integers(2)])
        self._steps += 1
        return self._action


def _rollouts(
    skill: Any,
    task: Task,
    backend: Backend,
    model: RobotModel,
    sent: SentTargets,
    options: argparse.Namespace,
    count: int,
) -> dict[str, Any]:
    checks, successes = [], 0
    for episode in range(count):
        placement = episode_placement(task, options.eval_seed, episode)
        start = task.initial_state(model, placement).q
        successes += run_rollout(skill, task, backend, model, placement).success
        checks.append(sent.check(start, np.zeros_like(start)))
        print(f"  {task.name}: {episode + 1} of {count}", end="\r", file=sys.stderr, flush=True)
    return _tally(checks) | {"successes": successes}


def _tally(checks: Sequence[LimitCheck | None]) -> dict[str, Any]:
    found = [asdict(check) for check in checks if check is not None]
    return {
        "runs": len(checks),
        "samples": sum(row["samples"] for row in found),
        "violations": sum(row["violations"] for row in found),
        "ratios": [max(row["ratios"][i] for row in found) for i in range(3)] if found else [0] * 3,
    }


if __name__ == "__main__":
    sys.exit(main())
