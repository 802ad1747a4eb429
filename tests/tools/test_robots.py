"""The table of robots has a row for each that is asked for, and keeps those that it has."""

from __future__ import annotations

import importlib
import json
import sys
from pathlib import Path

import pytest

TOOLS = Path(__file__).parents[2] / "tools"


@pytest.mark.slow
def test_a_robot_is_examined_and_put_to_work_once(monkeypatch, tmp_path):
    monkeypatch.syspath_prepend(str(TOOLS))
    monkeypatch.delitem(sys.modules, "arms", raising=False)
    table = importlib.import_module("robots")
    out = tmp_path / "robots.json"
    words = ["--out", str(out), "--episodes", "1", "-n", "3", "--robots", "panda"]
    assert table.main(words) == 0
    content = out.read_bytes()
    row = json.loads(content)["robots"]["panda"]
    assert row["doctor"]["usable"] and row["joints"] == 7
    assert row["operator_pybullet"]["succeeded"] == 1
    assert 0 < row["pipeline"]["kept"] <= row["pipeline"]["attempted"]
    assert table.main(words) == 0
    assert out.read_bytes() == content
