"""What the suite tests is given on the command line; given wrongly, it says how."""

from __future__ import annotations

import importlib
import sys
import tomllib
from pathlib import Path

import pytest

from sart_toolkit.backends import DEFAULT_BACKEND
from sart_toolkit.errors import MissingExtra
from sart_toolkit.robots import USUAL_ROBOTS, get_robot
from sart_toolkit.robots.model import RobotModel
from sart_toolkit.tasks import TASKS
from sart_toolkit.testing import bench as bench_module
from sart_toolkit.testing import options, scenes
from sart_toolkit.testing.bench import make_bench

ROOT = Path(__file__).parents[2]


@pytest.mark.parametrize(
    ("kind", "wrong", "right"),
    [("backend", "pybulet", "pybullet"), ("task", "peg_in_whole", "peg_in_hole")],
)
def test_a_wrong_name_on_the_command_line_is_a_usage_error(
    run_pytest, tmp_path, kind, wrong, right
):
    result = run_pytest(tmp_path, f"--sart-{kind}", wrong)
    assert result.returncode == 4
    assert f"did you mean {right!r}" in result.stderr


def test_a_module_in_the_working_folder_is_found(run_pytest, tmp_path):
    (tmp_path / "mine.py").write_text(
        "from sart_toolkit.backends.pybullet import PyBulletBackend\n"
        "class Mine(PyBulletBackend):\n    pass\n"
    )
    words = [
        "--sart-backend",
        "mine:Mine",
        "--sart-robot",
        "ur5e_hande",
        "-q",
        "-k",
        "abilities_are_known",
    ]
    result = run_pytest(tmp_path, *words)
    assert "1 passed" in result.stdout, result.stdout + result.stderr


def test_by_default_all_our_backends_are_tested_with_the_usual_robots(run_pytest, tmp_path):
    result = run_pytest(tmp_path, "--collect-only", "-q", "-k", "abilities_are_known")
    found = [line for line in result.stdout.splitlines() if "::" in line]
    targets = {line.partition("[")[2].rstrip("]") for line in found}
    assert targets == {f"{b}-{r}" for b in ("pybullet", "sapien") for r in USUAL_ROBOTS}


def _collected(run_pytest, folder, *words):
    """The file and the parameters of each test that would be run."""
    result = run_pytest(folder, "--collect-only", "-q", *words)
    found = [line for line in result.stdout.splitlines() if "::" in line]
    return {(Path(f.partition("::")[0]).name, f.partition("[")[2].rstrip("]")) for f in found}


def test_tasks_are_tested_where_they_are_named_and_on_the_backends_and_robots_named(
    run_pytest, tmp_path
):
    task = ("--sart-task", "lid_closing", "-k", "at_rest")
    found = _collected(run_pytest, tmp_path, *task)
    assert found == {("test_tasks.py", f"lid_closing-{DEFAULT_BACKEND}")}
    found = _collected(
        run_pytest, tmp_path, *task, "--sart-backend", "sapien", "--sart-robot", "panda"
    )
    assert found == {("test_tasks.py", "lid_closing-sapien-panda")}


def test_of_tasks_none_is_tested_where_backends_are_named_and_all_by_default(run_pytest, tmp_path):
    named = _collected(run_pytest, tmp_path, "--sart-backend", "pybullet")
    assert len(named) > 10 and "test_tasks.py" not in dict(named)
    found = _collected(run_pytest, tmp_path, "-k", "at_rest")
    assert found == {("test_tasks.py", f"{task}-{DEFAULT_BACKEND}") for task in TASKS}


def test_pytest_finds_the_options_by_the_module_s_own_name():
    """So that `-p sart_toolkit.testing.options` does no harm."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    assert project["entry-points"]["pytest11"] == {options.__name__: options.__name__}


def test_without_pytest_the_extra_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "pytest", None)
    monkeypatch.delitem(sys.modules, bench_module.__name__)
    with pytest.raises(MissingExtra, match=r"pip install 'sart_toolkit\[testing\]'"):
        importlib.import_module(bench_module.__name__)


@pytest.mark.parametrize("name", USUAL_ROBOTS)
def test_scenes_are_laid_out_under_a_tool_that_points_down(name):
    robot = get_robot(name)
    T = RobotModel(robot).fk(scenes.ready_joints(robot))
    assert T[2, 2] == pytest.approx(-1)
    assert T[:2, 3] == pytest.approx(scenes.site(robot)[:2, 3])


@pytest.mark.parametrize("name", USUAL_ROBOTS)
def test_the_fingers_of_a_closed_gripper_meet_and_those_of_an_open_one_do_not(name):
    bench = make_bench("pybullet", name)
    widths = {"ur5e_2f85": 0.085, "ur5e_hande": 0.05}
    assert bench.expected_opening(0.0) == pytest.approx(widths[name], abs=0.002)
    assert bench.expected_opening(1.0) == pytest.approx(0.0, abs=0.002)
    bench.backend.close()
