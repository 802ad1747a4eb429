"""Which simulator is used where PyBullet isn't there."""

import subprocess
import sys

import pytest

from sart_toolkit import backends
from sart_toolkit.errors import MissingExtra


def test_without_pybullet_sapien_is_the_default():
    # Elsewhere: a module loaded twice in this process has functions that nothing can pickle.
    code = (
        "import importlib.util as util; found = util.find_spec; "
        "util.find_spec = lambda name, *a: None if name == 'pybullet' else found(name, *a); "
        "from sart_toolkit.backends import DEFAULT_BACKEND; print(DEFAULT_BACKEND)"
    )
    told = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert told.stdout.strip() == "sapien"


def test_asked_for_what_is_not_there_it_says_where_it_is(monkeypatch):
    monkeypatch.setitem(sys.modules, "pybullet", None)
    monkeypatch.delitem(sys.modules, "sart_toolkit.backends.pybullet", raising=False)
    with pytest.raises(MissingExtra, match="no wheel for Python 3.12 .* use --backend sapien"):
        backends.get_backend("pybullet")
