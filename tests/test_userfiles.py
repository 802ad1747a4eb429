"""What a file holds is the same in every process."""

from __future__ import annotations

import multiprocessing
import sys

import pytest

from sart_toolkit.userfiles import file_of, load_file


def test_a_file_is_run_once_and_is_found_by_its_path(tmp_path, monkeypatch):
    path = tmp_path / "100% of it.odd.py"
    path.write_text("RUNS = []\nRUNS.append(1)\n")
    module = load_file(path)
    monkeypatch.chdir(tmp_path)
    assert load_file(path.name) is module and module.RUNS == [1]
    assert file_of(module.__name__) == path.resolve()
    assert file_of("json.decoder") is None


def test_files_of_one_name_in_two_folders_are_two_modules(tmp_path):
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "robot.py").write_text(f"NAME = {name!r}\n")
    assert [load_file(tmp_path / n / "robot.py").NAME for n in ("a", "b")] == ["a", "b"]


def test_a_file_that_fails_is_loaded_again_next_time(tmp_path):
    path = tmp_path / "broken.py"
    path.write_text("1 / 0\n")
    with pytest.raises(ZeroDivisionError):
        load_file(path)
    assert not any(file_of(name) == path for name in sys.modules)


def test_what_a_file_defines_reaches_a_process_that_is_started_afresh(tmp_path):
    path = tmp_path / "shape.py"
    path.write_text("class Drawer:\n    def __init__(self, depth):\n        self.depth = depth\n")
    drawer = load_file(path).Drawer(0.3)
    with multiprocessing.get_context("spawn").Pool(1) as pool:
        back = pool.apply(vars, (drawer,))
        same = pool.apply(type, (drawer,))
    assert back == {"depth": 0.3} and same is type(drawer)
