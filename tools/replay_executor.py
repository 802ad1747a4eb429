"""Compares the executors: `python tools/replay_executor.py DIR --out replay_executor.json`.

For each task on each backend a demonstration's segments are generated twice, without images: from
restored states, and by a robot that can't restore any, which follows the demonstration instead.
Says how many of how many attempts were kept, how many resets that took, and how far the measured
tool poses of the same attempts are apart. Interrupted, it resumes. Prints one JSON object.
"""

from __future__ import annotations

import argparse
import dataclasses
import functools
import itertools
import json
import sys
from collections.abc import Sequence
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np

from sart_toolkit import doctor
from sart_toolkit.annotate.suggest import suggest_annotation
from sart_toolkit.augment.config import AugmentConfig
from sart_toolkit.augment.engine import augment_demonstration
from sart_toolkit.backends import make_backend
from sart_toolkit.backends.interface import (
    Backend,
    BackendFactory,
    CommandSent,
    Contact,
    KnowsBodies,
    Observation,
    Resets,
    SensesContacts,
    Simulator,
)
from sart_toolkit.benchmark.cells import WITHOUT_IMAGES, Cell, recorded
from sart_toolkit.collision.exact import ExactWorld
from sart_toolkit.data.dataset import Dataset
from sart_toolkit.data.records import library_versions
from sart_toolkit.data.storage import load_demonstration, save_demonstration, write_json
from sart_toolkit.poses import Array, distance
from sart_toolkit.robots import get_robot
from sart_toolkit.scenes.spec import SceneState
from sart_toolkit.tasks import TASKS, get_task


class NoStates(Backend, Resets, SensesContacts, KnowsBodies):
    """A simulator that can save and restore no state."""

    def __init__(self, make: BackendFactory) -> None:
        inner = make()
        assert isinstance(inner, Simulator)
        self.inner, self.name, self.tracking_error = inner, inner.name, inner.tracking_error
        super().__init__(inner.robot, inner.scene, inner.image_size, inner.rates)

    def observe(self, *args: Any) -> Observation:
        return self.inner.observe(*args)

    def command(self, q: Array, gripper: float) -> CommandSent:
        return self.inner.command(q, gripper)

    def step(self) -> None:
        self.inner.step()

    def reset(self, state: SceneState) -> None:
        self.inner.reset(state)

    def contacts(self) -> list[Contact]:
        return self.inner.contacts()

    def body_poses(self) -> dict[str, Array]:
        return self.inner.body_poses()

    def close(self) -> None:
        self.inner.close()


def main(arguments: Sequence[str] | None = None) -> int:
    """Generate with both executors and write what came of it."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("directory", type=Path, help="where the datasets are")
    parser.add_argument("--tasks", default=",".join(TASKS))
    parser.add_argument("--backends", default="pybullet,sapien")
    parser.add_argument("--n", type=int, default=40, help="trajectories")
    parser.add_argument("--seed", type=int, default=101, help="of demonstrations and draws")
    parser.add_argument("--recording", default="reversed", help="reversed or return")
    parser.add_argument("--out", type=Path, help="JSON file to write")
    options = parser.parse_args(arguments)
    rows = []
    for name, backend in itertools.product(options.tasks.split(","), options.backends.split(",")):
        config = AugmentConfig(
            options.n, cameras=(), seed=options.seed, recording=options.recording
        )
        rows.append(compare(name, backend, config, options.directory / f"{name}-{backend}"))
        print(rows[-1], file=sys.stderr, flush=True)
    words = {k: str(v) for k, v in vars(options).items() if k not in ("directory", "out")}
    result = {
        "cells": rows,
        "arguments": words,
        "machine": doctor.machine(),
        "versions": library_versions(),
    }
    if options.out is not None:
        write_json(options.out, result)
    print(json.dumps(result))
    return 0


def compare(name: str, backend: str, config: AugmentConfig, directory: Path) -> dict[str, Any]:
    """What both executors made of one demonstration, whose files go into a directory."""
    task = get_task(name)
    robot = get_robot(task.robot)
    make = functools.partial(make_backend, backend, robot, task.scene)
    path = directory / "demo.h5"
    if not path.exists():
        with closing(make()) as made:
            cell = Cell(task, backend, make)
            save_demonstration(path, recorded(cell, made, config.seed, WITHOUT_IMAGES))
    demonstration = load_demonstration(path)
    spheres = suggest_annotation(demonstration, ExactWorld(demonstration, robot, task.scene))
    restored, replayed = (
        augment_demonstration(
            demonstration,
            spheres,
            maker,
            directory / execution,
            dataclasses.replace(config, execution=execution),
        )
        for execution, maker in (
            ("restore", make),
            ("replay", functools.partial(NoStates, make)),
        )
    )
    far, turn, common = differences(restored, replayed)
    return {
        "task": name,
        "backend": backend,
        "restored": [restored.info["n_kept"], restored.info["n_attempted"]],
        "replayed": [replayed.info["n_kept"], replayed.info["n_attempted"]],
        "rejections": replayed.info["rejections"],
        "resets": replayed.info["resets"],
        "compared": common,
        "largest_difference_mm": 1e3 * far,
        "largest_difference_deg": float(np.rad2deg(turn)),
    }


def differences(a: Dataset, b: Dataset) -> tuple[float, float, int]:
    """How far measured tool poses of the same attempts are apart: [m], [rad], how many attempts."""
    numbers = {entry.key: i for i, entry in enumerate(b.index)}
    far = turn = 0.0
    common = [(i, numbers[entry.key]) for i, entry in enumerate(a.index) if entry.key in numbers]
    for i, j in common:
        poses = (d.episode(n).steps.measured_Ts_world_tool for d, n in ((a, i), (b, j)))
        for T_a, T_b in zip(*poses, strict=True):
            found = distance(T_a, T_b)
            far, turn = max(far, found[0]), max(turn, found[1])
    return far, turn, len(common)


if __name__ == "__main__":
    raise SystemExit(main())
