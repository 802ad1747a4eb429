from __future__ import annotations

import importlib.util
import json
from pathlib import Path

TOOL = Path(__file__).parents[2] / "tools" / "faults.py"


def test_a_fault_of_each_of_two_kinds_is_dealt_with(tmp_path, capsys):
    spec = importlib.util.spec_from_file_location("faults", TOOL)
    assert spec is not None and spec.loader is not None
    tool = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(tool)
    assert tool.main(["--n", "2", "--out", str(tmp_path / "faults.json")]) == 0
    said = json.loads(capsys.readouterr().out)
    assert (said["n"], said["stopped"], said["within_a_period"], said["resumed"]) == (2, 2, 2, 2)
    assert said["steps_lost"] == 0 and set(said["latest_target_ms"]) == {
        "protective_stop", "emergency_stop",
    }  # fmt: skip
    assert len(json.loads((tmp_path / "faults.json").read_text())["faults"]) == 2
