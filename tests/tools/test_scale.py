from __future__ import annotations

import importlib
import json
import sys
from pathlib import Path

import pytest

TOOLS = Path(__file__).parents[2] / "tools"


@pytest.fixture
def scale(monkeypatch):
    monkeypatch.syspath_prepend(str(TOOLS))
    monkeypatch.delitem(sys.modules, "bench", raising=False)
    return importlib.import_module("scale")


@pytest.mark.parametrize("images", [True, False])
def test_it_follows_rate_and_memory_while_the_engine_generates(scale, tmp_path, capsys, images):
    words = ["--episodes", "4", "--image-size", "32", "--out", str(tmp_path / "scale.json")]
    assert scale.main([*words, *(["--images"] if images else [])]) == 0
    out, err = capsys.readouterr()
    report = json.loads(out)
    figures = report["figures"]
    assert json.loads((tmp_path / "scale.json").read_text())["figures"] == figures
    assert figures["kept"] == 4 and figures["images"] is images
    assert [row["kept"] for row in figures["course"]] == [1, 2, 3, 4]
    assert all(row["memory_mb"] > 10 and row["kept_per_second"] > 0 for row in figures["course"])
    assert figures["kilobytes_per_episode"] > 10 and figures["peak_memory_mb"] > 10
    assert 0 < figures["opening_seconds"] < figures["resuming_finished_seconds"]
    assert figures["last_rate_over_tenth"] > 0 and "4/4, 0 rejected" in err


def test_one_episode_is_followed_into_a_folder_that_is_made(scale, tmp_path, capsys):
    words = ["--episodes", "1", "--image-size", "32", "--folder", str(tmp_path / "new" / "folder")]
    assert scale.main(words) == 0
    figures = json.loads(capsys.readouterr().out)["figures"]
    assert [row["kept"] for row in figures["course"]] == [1] and figures["last_rate_over_tenth"] > 0
    assert list((tmp_path / "new" / "folder").iterdir()) == []


def test_bad_arguments_are_one_line_and_exit_code_2(scale, capsys):
    assert scale.main(["--episodes", "0"]) == 2
    assert "--episodes: expected a finite number > 0" in capsys.readouterr().err
