"""Synthetic records of a small peg-in-hole run."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sart_toolkit.data import storage
from sart_toolkit.data.dataset import Dataset
from sart_toolkit.data.manifest import AttemptKey, Rejection
from sart_toolkit.data.records import (
    Annotation,
    CameraRecord,
    Demonstration,
    Episode,
    Image,
    PrecisionSphere,
    Provenance,
    Steps,
)
from sart_toolkit.data.writer import DatasetWriter
from sart_toolkit.poses import Array, pose
from sart_toolkit.report.video import caption, write_video

KEYS = (0, 18, 30)
RADII = (0.08, 0.045, 0.02)
PAIRS = ("gripper - table", "peg - block", "peg - block")


def wrist_images(p_world_tool: Array, size: int = 48) -> Image:
    """What a camera above a table with a dark square hole might see from `p_world_tool (n, 3)`."""
    y, x = np.mgrid[:size, :size] / size - 0.5
    images = np.empty((len(p_world_tool), size, size, 3), np.uint8)
    for image, p in zip(images, p_world_tool, strict=True):
        half = 0.012 / max(p[2], 0.05)
        image[:] = (np.array([176, 150, 118]) + 30 * (x + y)[..., None]).astype(np.uint8)
        hole = (np.abs(x + 1.5 * p[0] - 0.75) < half) & (np.abs(y + 1.5 * p[1]) < half)
        image[hole] = (38, 36, 40)
        image[size - size // 6 :, size // 3 : -size // 3] = (200, 60, 50)
    return images


def make_steps(p_world_tool: Array, size: int = 48) -> Steps:
    """Steps of a tool that points down along positions `(n, 3)` [m]."""
    n = len(p_world_tool)
    Ts = np.array([pose(p, (np.pi, 0, 0)) for p in p_world_tool])
    camera = CameraRecord(
        rgb=wrist_images(p_world_tool, size),
        depth=np.full((n, size, size), 0.2, np.float32),
        intrinsics=np.diag([50.0, 50.0, 1.0]),
        frame="tool",
        T_frame_camera=pose((0.0, -0.1, -0.1)),
    )
    return Steps(
        joint_positions=np.zeros((n, 6)),
        joint_velocities=np.zeros((n, 6)),
        commanded_joint_positions=np.zeros((n, 6)),
        measured_Ts_world_tool=Ts,
        commanded_Ts_world_tool=Ts @ pose((0.001, 0, 0)),
        measured_gripper=np.ones(n),
        commanded_gripper=np.ones(n),
        contact_force=np.zeros(n),
        cameras={"wrist": camera},
    )


def make_dataset(path: Path, task: str = "peg_in_hole", n_episodes: int = 12) -> Dataset:
    """A demonstration of 41 steps, three spheres, and straight segments round-robin over them."""
    rng = np.random.default_rng(0)
    s = np.linspace(0, 1, 41)
    ramp = 3 * s**2 - 2 * s**3
    p = np.stack(
        [0.38 + 0.12 * ramp, 0.1 - 0.1 * ramp + 0.02 * np.sin(6 * s), 0.28 - 0.2 * ramp**2], axis=1
    )
    demonstration = Demonstration(
        task=task,
        task_parameters={"placement": {"x": 0.0, "y": 0.0, "yaw_deg": 0.0}},
        robot="ur5e_2f85",
        backend="pybullet",
        steps=make_steps(p),
        timestamps=0.1 * np.arange(41),
        body_Ts_world={"block": np.tile(pose((0.5, 0.0, 0.0)), (41, 1, 1))},
        success=s > 0.9,
        touching=((),) * len(s),
        raw_commands=np.zeros((123, 7)),
        states=(),
        operator="scripted operator",
        device="scripted",
        seconds=4.2,
    )
    key_poses = demonstration.steps.measured_Ts_world_tool
    annotation = Annotation(
        tuple(
            PrecisionSphere(key, key_poses[key], radius, "ball", "suggested", radius + 0.01, pair)
            for key, radius, pair in zip(KEYS, RADII, PAIRS, strict=True)
        ),
        demonstration.content_hash(),
        seconds=0.3,
    )
    episodes = []
    for k in range(n_episodes):
        i = k % len(KEYS)
        direction = rng.normal(size=3)
        t_star = next(
            t for t in range(KEYS[i], 41)
            if t == 40 or np.linalg.norm(p[t] - p[KEYS[i]]) > RADII[i]
        )  # fmt: skip
        sampled = p[KEYS[i]] + RADII[i] * direction / np.linalg.norm(direction)
        line = sampled + np.linspace(0, 1, 10)[:, None] * (p[t_star] - sampled)
        certificate = {
            "commanded": {"clearance": 0.00125 + 0.001 * k},
            "measured": {"clearance": 0.0006249 + 0.001 * k},
            "deviation": 0.000401 - 0.00001 * k,
        }
        provenance = Provenance(
            demonstration.content_hash(),
            0,
            i,
            k // 3,
            t_star,
            pose(sampled),
            0,
            "sart",
            "paper",
            certificate,
        )
        episodes.append(Episode(make_steps(line, 16), provenance))
    with DatasetWriter(path, [(demonstration, annotation)], {}) as writer:
        for episode in episodes:
            writer.keep(writer.files.write(episode))
        reasons = ["path too close peg / block"] * 2 + ["joint jump"]
        for k, reason in enumerate(reasons, n_episodes):
            writer.reject(AttemptKey(0, 0, k), Rejection(reason, ""))
        return writer.finish({"config": {"strategy": "sart", "n": n_episodes + 1}, "seconds": 9.6})


def make_evaluation(n: int = 20, task: str = "peg_in_hole") -> dict[str, Any]:
    """The content of an evaluation.json with every seventh episode a failure."""
    rng = np.random.default_rng(1)
    rows = []
    for k in range(n):
        failed = k % 7 == 6
        x, y = rng.uniform(-0.05, 0.05, 2)
        rows.append(
            {
                "episode": k,
                "seed": [1000, k],
                "placement": {"block": {"x": x, "y": y, "yaw_deg": 0.0}},
                "outcome": "failure" if failed else "success",
                "success_any": not failed or k == 6,
                "steps": 120 if failed else 43 + k,
                "reason": "time limit: peg beside the hole" if failed else None,
            }
        )
    n_success = sum(row["outcome"] == "success" for row in rows)
    n_any = sum(row["success_any"] for row in rows)
    return {
        "task": task,
        "backend": "pybullet",
        "robot": "ur5e_2f85",
        "policy": "compact_mlp",
        "n_episodes": n,
        "n_success": n_success,
        "success_rate": n_success / n,
        "ci95": [0.64, 0.95],
        "n_success_any": n_any,
        "success_rate_any": n_any / n,
        "ci95_any": [0.7, 0.97],
        "seeds": {"eval_seed": 1000, "episodes": [[1000, k] for k in range(n)]},
        "seconds": 61.5,
        "episodes": rows,
        "videos": [
            {"path": "videos/success_000.mp4", "episode": 0, "outcome": "success"},
            {"path": "videos/failure_000.mp4", "episode": 6, "outcome": "failure"},
        ],
        "versions": {"sart_toolkit": "0.1.0", "pybullet": "3.2.7"},
    }


def make_run(path: Path) -> Path:
    """A run directory as `sart run peg_in_hole --out path` leaves it, without its report."""
    (source,) = make_dataset(path / "dataset").sources
    storage.save_demonstration(path / "demo.h5", source.demonstration)
    storage.save_annotation(path / "annotation.json", source.annotation)
    epochs = range(1, 13)
    storage.write_json(
        path / "skill" / "training.json",
        {
            "curve": [{"epoch": e, "loss": 0.9 * 0.7**e + 0.004, "seconds": 3.0} for e in epochs],
            "images_per_second": 1830.4,
            "config": {"policy": "compact_mlp", "epochs": 12, "batch_size": 64},
        },
    )
    storage.write_json(path / "evaluation.json", make_evaluation())
    for outcome, episode in (("success", 0), ("failure", 6)):
        images = wrist_images(source.demonstration.steps.measured_Ts_world_tool[:, :3, 3], 120)
        frames = (
            caption(image, episode, t / 10, outcome)  # type: ignore[arg-type]
            for t, image in enumerate(images[:8])
        )
        write_video(path / "videos" / f"{outcome}_000.mp4", frames, 10)
    storage.write_json(
        path / "run.json",
        {
            "stages": {
                "record": 6.1,
                "suggest": 1.2,
                "augment": 9.6,
                "train": 212.0,
                "evaluate": 61.5,
            },
            "command": "sart run peg_in_hole --out run",
            "config": {
                "task": "peg_in_hole",
                "seed": 0,
                "augment": {"n": 40, "distribution": "paper"},
            },
            "versions": {"sart_toolkit": "0.1.0", "python": "3.11.7", "torch": "2.13.0"},
            "machine": {"cores": 2, "memory_gib": 24},
        },
    )
    return path


@pytest.fixture(scope="session")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    return make_dataset(tmp_path_factory.mktemp("dataset"))


@pytest.fixture(scope="session")
def demonstration(dataset: Dataset) -> Demonstration:
    return dataset.sources[0].demonstration


@pytest.fixture(scope="session")
def _finished_run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_run(tmp_path_factory.mktemp("finished") / "run")


@pytest.fixture
def run_dir(_finished_run: Path, tmp_path: Path) -> Path:
    """A run directory of the test's own."""
    return Path(shutil.copytree(_finished_run, tmp_path / "run"))


@pytest.fixture
def edit_json() -> Callable[[Path, dict[str, Any]], None]:
    """Replace top-level keys of a JSON file."""

    def edit(path: Path, changes: dict[str, Any]) -> None:
        value = {**json.loads(path.read_text()), **changes}
        path.write_text(json.dumps(storage.with_seal(value) if "sha256" in value else value))

    return edit
