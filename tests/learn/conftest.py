"""Small synthetic datasets: a bright blob whose place in the image decides the action."""

from __future__ import annotations

import dataclasses
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sart_toolkit.data.dataset import Dataset
from sart_toolkit.data.records import (
    Annotation,
    CameraRecord,
    Demonstration,
    Episode,
    PrecisionSphere,
    Provenance,
    Steps,
)
from sart_toolkit.data.writer import write_dataset
from sart_toolkit.learn.samples import WindowConfig, Windows, open_windows
from sart_toolkit.learn.training import TrainConfig
from sart_toolkit.poses import pose

# Blob at (u, v) in [-1, 1]: the next command moves by this much of it [m].
GAIN = 0.01


def blob_image(u: float, v: float, rng: np.random.Generator, size: int) -> np.ndarray:
    at = np.linspace(-1, 1, size)
    blob = np.exp(-((at[None, :] - u) ** 2 + (at[:, None] - v) ** 2) / 0.08)
    image = 60 + 150 * blob[..., None] * [1.0, 0.6, 0.3] + rng.normal(0, 3, (size, size, 3))
    return np.clip(image, 0, 255).astype(np.uint8)


def make_steps(
    n: int, rng: np.random.Generator, T_world_next: np.ndarray | None = None, size: int = 32
) -> Steps:
    """Steps whose action t is GAIN * (u, v) of image t, the last leading to `T_world_next`."""
    places = rng.uniform(-0.8, 0.8, (n, 2))
    commanded = np.tile(pose((0.4, 0.0, 0.3)), (n + 1, 1, 1))
    commanded[1:, :2, 3] += GAIN * np.cumsum(places, 0)
    if T_world_next is not None:
        commanded[:, :3, 3] += T_world_next[:3, 3] - commanded[-1, :3, 3]
    commanded = commanded[:-1]
    gripper = rng.uniform(0, 1, n)
    return Steps(
        joint_positions=rng.normal(size=(n, 6)),
        joint_velocities=rng.normal(size=(n, 6)),
        commanded_joint_positions=rng.normal(size=(n, 6)),
        measured_Ts_world_tool=commanded,
        commanded_Ts_world_tool=commanded,
        measured_gripper=gripper,
        commanded_gripper=np.round(gripper),
        contact_force=np.zeros(n),
        cameras={
            "wrist": CameraRecord(
                rgb=np.stack([blob_image(u, v, rng, size) for u, v in places]),
                depth=np.zeros((n, size, size), np.float32),
                intrinsics=np.diag([size, size, 1.0]),
                frame="tool",
                T_frame_camera=pose((0.05, 0.0, -0.1)),
            )
        },
    )


def make_dataset(
    path: Path,
    t_stars: tuple[int, ...] = (3, 5, 5),
    n: int = 9,
    segment: int = 4,
    seed: int = 0,
    size: int = 32,
) -> Dataset:
    """A demonstration of `n` steps and an episode that rejoins it at each of `t_stars`."""
    rng = np.random.default_rng(seed)
    demonstration = Demonstration(
        task="blob",
        task_parameters={"gain": GAIN},
        robot="none",
        backend="synthetic",
        steps=make_steps(n, rng, size=size),
        timestamps=np.arange(n) / 10,
        body_Ts_world={},
        success=np.zeros(n, bool),
        touching=((),) * n,
        raw_commands=np.zeros((3 * n, 7)),
        states=(),
        operator="test",
        device="none",
        seconds=1.0,
    )
    key = demonstration.steps.measured_Ts_world_tool[0]
    annotation = Annotation((PrecisionSphere(0, key, 0.05),), demonstration.content_hash())
    episodes = tuple(
        Episode(
            make_steps(segment, rng, demonstration.steps.commanded_Ts_world_tool[t_star], size),
            Provenance(demonstration.content_hash(), 0, 0, k, t_star, key, seed, "sart", "paper"),
        )
        for k, t_star in enumerate(t_stars)
    )
    return write_dataset(path, [(demonstration, annotation)], episodes, {})


def perturbed(steps: Steps) -> Steps:
    """The same steps with everything changed that a policy must not see."""
    return dataclasses.replace(
        steps,
        joint_positions=steps.joint_positions + 1.0,
        joint_velocities=-steps.joint_velocities,
        commanded_joint_positions=steps.commanded_joint_positions - 2.0,
        measured_Ts_world_tool=pose((5, 5, 5), (0, 0, 1)) @ steps.measured_Ts_world_tool,
        contact_force=steps.contact_force + 7.0,
    )


def with_steps(path: Path, dataset: Dataset, change: Callable[[Steps], Steps]) -> Dataset:
    """The dataset with all steps changed, and hashes that match again."""
    (source,) = dataset.sources
    demonstration = dataclasses.replace(
        source.demonstration, steps=change(source.demonstration.steps)
    )
    sha = demonstration.content_hash()
    episodes = tuple(
        Episode(
            change(episode.steps),
            dataclasses.replace(episode.provenance, demonstration_hash=sha),
        )
        for episode in dataset
    )
    key = demonstration.steps.measured_Ts_world_tool[0]
    annotation = Annotation((PrecisionSphere(0, key, 0.05),), sha)
    return write_dataset(path, [(demonstration, annotation)], episodes, {})


@pytest.fixture(name="make_dataset")
def _make_dataset(tmp_path_factory: pytest.TempPathFactory) -> Callable[..., Dataset]:
    return lambda *args, **options: make_dataset(
        tmp_path_factory.mktemp("dataset"), *args, **options
    )


@pytest.fixture(name="perturbed")
def _perturbed() -> Callable[[Steps], Steps]:
    return perturbed


@pytest.fixture(name="with_steps")
def _with_steps(
    tmp_path_factory: pytest.TempPathFactory,
) -> Callable[[Dataset, Callable[[Steps], Steps]], Dataset]:
    return lambda dataset, change: with_steps(tmp_path_factory.mktemp("dataset"), dataset, change)


@pytest.fixture(name="open_windows")
def _open_windows(tmp_path: Path) -> Callable[..., Windows]:
    """`open_windows` in an empty directory each time, of the wrist camera unless specified."""

    def opened(dataset: Dataset, image_size: int = 16, history: int = 2, **options: Any) -> Windows:
        config = WindowConfig(options.pop("cameras", ("wrist",)), image_size, history, **options)
        return open_windows(dataset, config, Path(tempfile.mkdtemp(dir=tmp_path)))

    return opened


@pytest.fixture
def dataset(make_dataset: Callable[..., Dataset]) -> Dataset:
    made: Dataset = make_dataset()
    return made


@pytest.fixture
def two_cameras(dataset: Dataset, tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    """The dataset seen by a second camera too, with other, rectangular images."""

    def add(steps: Steps) -> Steps:
        wrist = steps.cameras["wrist"]
        rgb = np.resize(wrist.rgb, (len(wrist.rgb), 24, 36, 3))
        overview = CameraRecord(
            rgb, np.zeros(rgb.shape[:3], np.float32), np.eye(3), "world", pose((0.0, 0.0, 1.0))
        )
        return dataclasses.replace(steps, cameras={**steps.cameras, "overview": overview})

    return with_steps(tmp_path_factory.mktemp("dataset"), dataset, add)


@pytest.fixture
def small_config() -> TrainConfig:
    """A training that takes a fraction of a second."""
    return TrainConfig.for_policy(
        "compact_mlp",
        epochs=3,
        batch_size=8,
        image_size=16,
        image_shift=1,
        hidden=16,
        device="cpu",
        threads=1,
    )
