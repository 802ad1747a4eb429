"""Small demonstrations with annotations, and episodes as if generated from them."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from sart_toolkit.data.records import (
    Annotation,
    Demonstration,
    Episode,
    PrecisionSphere,
    Provenance,
    Steps,
)
from sart_toolkit.poses import pose

Source = tuple[Demonstration, Annotation]


def _steps(n: int, rng: np.random.Generator) -> Steps:
    Ts = np.stack([pose(rng.uniform(-1, 1, 3)) for _ in range(n)])
    joints = rng.normal(size=(n, 6))
    return Steps(joints, joints, joints, Ts, Ts, np.zeros(n), np.zeros(n), np.zeros(n), {})


@pytest.fixture(scope="session")
def source_of() -> Callable[[int], Source]:
    """Makes the demonstration with a seed, and two spheres for it."""

    def source_of(seed: int) -> Source:
        n, rng = 6, np.random.default_rng([9, seed])
        demonstration = Demonstration(
            task="nothing",
            task_parameters={},
            robot="none",
            backend="synthetic",
            steps=_steps(n, rng),
            timestamps=np.arange(n) / 10,
            body_Ts_world={"block": np.tile(pose(rng.uniform(-1, 1, 3)), (n, 1, 1))},
            success=np.ones(n, bool),
            touching=((),) * n,
            raw_commands=np.zeros((3 * n, 7)),
            states=(b"state",) * n,
            operator="test",
            device="none",
            seconds=1.0,
        )
        Ts = demonstration.steps.measured_Ts_world_tool
        spheres = tuple(PrecisionSphere(t, Ts[t], 0.01 * (t + 1)) for t in (0, 2))
        return demonstration, Annotation(spheres, demonstration.content_hash())

    return source_of


@pytest.fixture(scope="session")
def episode_of() -> Callable[..., Episode]:
    """Makes the episode of an attempt; the same attempt gives the same episode."""

    def episode_of(
        demonstration: Demonstration, sphere: int = 0, k: int = 0, source: int = 0
    ) -> Episode:
        rng = np.random.default_rng([source, sphere, k])
        sampled = pose(rng.uniform(-1, 1, 3))
        proof = {"commanded": {"clearance": 0.001 * (k + 1)}}
        sha = demonstration.content_hash()
        provenance = Provenance(
            sha, source, sphere, k, 3, sampled, 0, "sart", "paper", certificate=proof
        )
        return Episode(_steps(4, rng), provenance)

    return episode_of
