"""From nothing to a dataset on the emulated cell, through the hardware path alone."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from sart_toolkit.annotate.suggest import suggest_annotation
from sart_toolkit.augment.config import AugmentConfig
from sart_toolkit.augment.engine import augment_demonstration
from sart_toolkit.augment.planner import world_of
from sart_toolkit.augment.validate import validate_dataset
from sart_toolkit.collision.model import CLOUD
from sart_toolkit.collision.sensor import CloudConfig
from sart_toolkit.errors import MissingCapability, RobotStopped
from sart_toolkit.record.checks import check_recording
from sart_toolkit.record.scripted import ScriptedOperator
from sart_toolkit.record.session import record_demonstration
from sart_toolkit.tasks.task import Placement
from sart_toolkit.testing.emulated import EmulatedBackend, EmulatedWorld, Emulation

SENSOR = Emulation().sensor


@pytest.fixture
def cells(peg_task, peg_model, monkeypatch):
    """Makes emulated cells at the task's start; notes each, and what touched in them."""
    start = peg_task.initial_state(peg_model, Placement())
    kind = type("Cell", (EmulatedBackend,), {"start": start})
    press = EmulatedWorld._press

    class Cells(list):
        touched: list[object] = []

        def __call__(self):
            self.append(kind(peg_model.spec, peg_task.scene, 48))
            return self[-1]

    cells = Cells()
    cells.touched = []

    def noting(world):
        press(world)
        cells.touched += world.contacts

    monkeypatch.setattr(EmulatedWorld, "_press", noting)
    return cells


@pytest.mark.slow
def test_peg_in_hole_is_recorded_suggested_from_the_cloud_and_augmented_with_one_reset(
    cells, peg_task, peg_model, tmp_path
):
    """With 2 mm and 0.3 deg of miscalibration declared, and a fault on the way."""
    backend = cells()
    operator = ScriptedOperator(peg_task.plan(backend.start), np.random.default_rng(0))
    demo = record_demonstration(backend, peg_task, peg_model, operator)
    assert peg_task.success(backend.world.observe())
    backend.close()
    check_recording(demo, peg_model.spec)
    assert demo.judged_by == "nobody" and not demo.states and not demo.body_Ts_world
    assert 0.03 < demo.task_parameters["image_delays"]["wrist"] < 0.1

    config = AugmentConfig(n=4, obstacles="cloud", cloud=CloudConfig(sensor=SENSOR), cameras=())
    world = world_of(demo, backend.robot, peg_task.scene, config)
    # One sphere: where a later one can't give its share, the robot has to come by again.
    found = suggest_annotation(demo, world)
    annotation = dataclasses.replace(found, spheres=found.spheres[:1])

    def augment(ask):
        return augment_demonstration(
            demo, annotation, cells, tmp_path / "dataset", config, progress=watch, ask=ask
        )

    asked, kept = [], []

    def watch(n, wanted, rejected):
        kept.append(n)
        if n == 1 and len(asked) == 1:
            cells[-1].world.inject("protective_stop", cells[-1].world.time + 0.5)

    with pytest.raises(MissingCapability, match="nobody can be asked"):
        augment(None)
    cells.touched.clear()
    with pytest.raises(RobotStopped, match="protective stop"):
        augment(asked.append)
    assert len(asked) == 1 and kept[-1] == 1
    # The same command resumes, and keeps the first.
    dataset = augment(asked.append)
    assert len(asked) == 2 and kept[-1] == 3
    assert cells.touched == []
    proofs = [dataset.episode(i).provenance.certificate for i in range(len(dataset))]
    assert all(proof["tracking_error"] == backend.tracking_error for proof in proofs)
    assert any(CLOUD in proof["commanded"]["pair"] for proof in proofs)
    bare = dataclasses.replace(peg_task.scene, bodies=())
    assert not validate_dataset(tmp_path / "dataset", backend.robot, bare).problems
