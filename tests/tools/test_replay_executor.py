from __future__ import annotations

import importlib.util
import json
from pathlib import Path

TOOL = Path(__file__).parents[2] / "tools" / "replay_executor.py"


def test_both_executors_are_compared_attempt_by_attempt(tmp_path, capsys):
    spec = importlib.util.spec_from_file_location("replay_executor", TOOL)
    assert spec is not None and spec.loader is not None
    tool = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(tool)
    words = [str(tmp_path / "data"), "--tasks", "peg_in_hole", "--backends", "pybullet", "--n", "4"]
    for _ in range(2):
        assert tool.main([*words, "--out", str(tmp_path / "found.json")]) == 0
        (cell,) = json.loads(capsys.readouterr().out.splitlines()[-1])["cells"]
        assert cell["restored"] == cell["replayed"] == [3, 3]
        assert (cell["resets"], cell["compared"], cell["rejections"]) == (1, 3, {})
        assert cell["largest_difference_mm"] < 0.4
    assert json.loads((tmp_path / "found.json").read_text())["cells"] == [cell]
