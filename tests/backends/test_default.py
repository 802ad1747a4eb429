"""Which simulator is used where PyBullet isn't there."""

import importlib
import sys

import pytest

from sart_toolkit import backends
from sart_toolkit.errors import MissingExtra


@pytest.fixture
def reloaded(monkeypatch):
    """`backends` as it is where PyBullet can't be found."""
    found = importlib.util.find_spec
    monkeypatch.setattr(
        importlib.util,
        "find_spec",
        lambda name, *a: None if name == "pybullet" else found(name, *a),
    )
    yield importlib.reload(backends)
    monkeypatch.undo()
    importlib.reload(backends)


def test_without_pybullet_sapien_is_the_default(reloaded):
    assert reloaded.DEFAULT_BACKEND == "sapien"


def test_asked_for_what_is_not_there_it_says_where_it_is(monkeypatch):
    monkeypatch.setitem(sys.modules, "pybullet", None)
    monkeypatch.delitem(sys.modules, "sart_toolkit.backends.pybullet", raising=False)
    with pytest.raises(MissingExtra, match="no wheel for Python 3.12 .* use --backend sapien"):
        backends.get_backend("pybullet")
