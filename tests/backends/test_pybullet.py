from __future__ import annotations

import os
from pathlib import Path

import pybullet
import pytest

from sart_toolkit.errors import BrokenFile


def _resident_mb():
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 2**20


@pytest.mark.skipif(not Path("/proc/self/statm").exists(), reason="no /proc")
def test_restoring_states_keeps_none_of_them(peg_backend, peg_demonstration):
    """A state is a quarter of a megabyte: 200 that were kept would be 45."""
    for state in peg_demonstration.states[:5]:
        peg_backend.restore(state)
    before = _resident_mb()
    for i in range(200):
        peg_backend.restore(peg_demonstration.states[i % 5])
    assert _resident_mb() - before < 15


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
