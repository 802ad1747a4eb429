from __future__ import annotations

import pybullet
import pytest

from sart_toolkit.errors import BrokenFile


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
