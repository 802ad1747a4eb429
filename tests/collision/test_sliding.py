"""Certificates of an arm whose joints slide and turn about any axis are as sound as the others'."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from sart_toolkit.collision.certificate import certify
from sart_toolkit.collision.model import CollisionModel, PlacedModel
from sart_toolkit.motion.path import SplinePath
from sart_toolkit.poses import pose
from sart_toolkit.robots.spec import GripperSpec, RobotSpec, Shape
from sart_toolkit.scenes.spec import Body, SceneSpec

KINDS = ("prismatic", "revolute", "prismatic", "revolute", "revolute")
AXES = ("0 0 1", "1 0 0", "0.6 0.8 0", "0 1 0", "1 1 1")


@pytest.fixture(scope="module")
def placed(tmp_path_factory: pytest.TempPathFactory) -> PlacedModel:
    """An arm of five joints, two of which slide, among boxes."""
    folder: Path = tmp_path_factory.mktemp("sliding")
    box = '<geometry><box size="0.06 0.08 0.25"/></geometry>'
    text = ""
    for i in range(len(KINDS) + 1):
        text += (
            f'<link name="l{i}"><inertial><mass value="1"/></inertial>'
            f'<collision><origin xyz="0 0 0.1"/>{box}</collision></link>'
        )
    for i, (kind, axis) in enumerate(zip(KINDS, AXES, strict=True)):
        text += (
            f'<joint name="j{i}" type="{kind}"><parent link="l{i}"/><child link="l{i + 1}"/>'
            f'<origin xyz="0.02 0 0.2" rpy="0.1 0.2 0"/><axis xyz="{axis}"/>'
            '<limit lower="-0.6" upper="0.8"/></joint>'
        )
    urdf = folder / "sliding.urdf"
    urdf.write_text(f'<robot name="sliding">{text}</robot>')
    n = len(KINDS)
    robot = RobotSpec(
        "sliding", str(urdf), tuple(f"j{i}" for i in range(n)), np.zeros(n), np.ones(n), np.ones(n),
        np.ones(n), GripperSpec(), "l5", pose([0, 0, 0.2]),
    )  # fmt: skip
    rng = np.random.default_rng(1)
    bodies = []
    for i in range(10):
        p = rng.uniform([-0.9, -0.9, 0.2], [0.9, 0.9, 1.6])
        if np.linalg.norm(p[:2]) > 0.3:
            bodies.append(Body(f"box{i}", (Shape("box", (0.1, 0.2, 0.15)),), pose(p)))
    model = CollisionModel(robot, SceneSpec(tuple(bodies)))
    return model.placed({body.name: body.T_world_body for body in bodies}, 0.0)


def paths(n: int) -> list[SplinePath]:
    """Joint paths within limits that bend and turn back."""
    rng = np.random.default_rng(0)
    u = np.linspace(0, 1, 13)[:, None]
    found = []
    for _ in range(n):
        start, way = rng.uniform(-0.3, 0.4, 5), rng.uniform(-0.3, 0.3, 5)
        waves = np.sin(np.pi * u * rng.integers(1, 5, 5)) * rng.uniform(-0.1, 0.1, 5)
        found.append(SplinePath.through(np.clip(start + u * way + waves, -0.6, 0.8)))
    return found


def test_what_is_called_free_is_free_and_its_clearance_is_no_larger_than_sampled(
    placed: PlacedModel,
) -> None:
    verdicts = []
    for path in paths(150):
        certificate = certify(placed, path, margin=0.005)
        verdicts.append(certificate.verdict)
        least = min(placed.distances(q).min() for q in path.positions(np.linspace(0, 1, 120)))
        if certificate.verdict == "free":
            assert 0.005 <= certificate.clearance <= least + 3e-6
        elif certificate.verdict == "collision":
            assert certificate.clearance < 0.005
    assert verdicts.count("free") > 20
    assert verdicts.count("collision") > 20
    assert verdicts.count("undecided") < 5


def test_a_distances_gradient_is_what_it_changes_by(placed: PlacedModel) -> None:
    rng, step, checked = np.random.default_rng(2), 1e-5, 0
    for q in rng.uniform(-0.4, 0.4, (20, 5)):
        distances = placed.distances(q)
        pair = int(np.argmin(np.where(distances > 0.01, distances, np.inf)))
        gradient = placed.gradient(q, pair)
        numeric = [
            (placed.distances(q + d)[pair] - placed.distances(q - d)[pair]) / (2 * step)
            for d in step * np.eye(5)
        ]
        # At edges and corners the nearest points jump.
        checked += bool(np.allclose(gradient, numeric, rtol=0, atol=2e-3))
    assert checked >= 17
