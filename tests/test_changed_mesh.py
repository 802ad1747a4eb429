"""A recording notes what meshes its scene had; a task whose files have changed is refused."""

from __future__ import annotations

import dataclasses

import pytest
import trimesh

from sart_toolkit import pipeline
from sart_toolkit.errors import Mismatch
from sart_toolkit.poses import pose
from sart_toolkit.robots.spec import MeshShape
from sart_toolkit.scenes.spec import Body
from sart_toolkit.tasks import get_task
from sart_toolkit.workers.parcels import pack


def with_mesh(task, file):
    """The task with a mesh beside what its scene has."""
    body = Body("thing", (MeshShape(str(file)),), pose([0.9, 0, 0.5]))
    task.scene = dataclasses.replace(task.scene, bodies=(*task.scene.bodies, body))
    return task


def test_a_demonstration_whose_mesh_has_changed_is_refused(peg_demonstration, tmp_path):
    file = tmp_path / "thing.stl"
    trimesh.creation.box((0.1, 0.1, 0.1)).export(file)
    task = with_mesh(get_task("peg_in_hole"), file)
    noted = {**peg_demonstration.task_parameters, "meshes": task.scene.mesh_digests}
    recorded = dataclasses.replace(peg_demonstration, task_parameters=noted)
    assert pipeline.task_of(recorded, task) is task
    trimesh.creation.box((0.1, 0.1, 0.2)).export(file)
    changed = with_mesh(get_task("peg_in_hole"), file)
    for demonstration, other in ((recorded, changed), (peg_demonstration, task)):
        with pytest.raises(Mismatch, match="body 'thing' of peg_in_hole: its mesh is another"):
            pipeline.task_of(demonstration, other)
    assert set(pack(changed).files) == {str(file)}
