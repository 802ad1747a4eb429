from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pybullet
import pytest

from sart_toolkit.backends import make_backend
from sart_toolkit.backends import pybullet as backend_module
from sart_toolkit.errors import BrokenFile
from sart_toolkit.robots import get_robot
from sart_toolkit.robots.model import RobotModel
from sart_toolkit.tasks import get_task
from sart_toolkit.tasks.task import Placement


def _resident_mb():
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 2**20


@pytest.mark.skipif(not Path("/proc/self/statm").exists(), reason="no /proc")
def test_restoring_states_keeps_few_of_them(peg_backend, peg_demonstration):
    """A state is a quarter of a megabyte: 200 that were kept would be 45."""
    states = peg_demonstration.states[:40]
    assert len(set(states)) > 2 * backend_module._MOST_STATES
    for state in states:
        peg_backend.restore(state)
    before = _resident_mb()
    for i in range(200):
        peg_backend.restore(states[i % len(states)])
    assert _resident_mb() - before < 15


def test_a_state_restored_from_memory_is_followed_by_the_same_as_one_read_from_its_bytes():
    """To the bit, with a bottle in the grasp."""
    task = get_task("bottle_placing")
    model = RobotModel(get_robot(task.robot), task.scene.held)
    initial = task.initial_state(model, Placement())
    backend = make_backend("pybullet", model.spec, task.scene, 16)

    def followed(state):
        backend.restore(state)
        rows = []
        for _ in range(10):
            backend.command(initial.q + 0.02, initial.commanded_gripper)
            backend.step()
            seen = backend.observe()
            rows += [seen.joint_path, *seen.Ts_world_body.values()]
        return b"".join(np.ascontiguousarray(row).tobytes() for row in rows), backend.contacts()

    backend.reset(initial)
    states = []
    for _ in range(backend_module._MOST_STATES + 2):
        backend.command(initial.q + 0.02, initial.commanded_gripper)
        backend.step()
        states.append(backend.save())
    read = [followed(state) for state in states]
    assert any(contacts for _, contacts in read) and len({path for path, _ in read}) == len(states)
    last = len(states) - 1
    reads = []
    backend._restore_file = reads.append
    assert followed(states[last]) == read[last]
    assert followed(states[2]) == read[2]
    assert not reads
    backend.close()


def test_a_state_that_bullet_itself_refuses_is_a_broken_file(make_peg_backend, monkeypatch):
    """Another version of PyBullet's, for instance."""
    backend = make_peg_backend()
    state = backend.save()

    def refuse(**_):
        raise pybullet.error("Couldn't restore state.")

    monkeypatch.setattr(backend._client, "restoreState", refuse)
    with pytest.raises(BrokenFile, match="PyBullet refuses it"):
        backend.restore(state)
    backend.close()
