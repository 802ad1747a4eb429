"""`sart deploy` and `sart doctor --cell`, as far as they refuse or find something wrong."""

from __future__ import annotations

import json
import sys

import pytest

from sart_toolkit.bringup.cell import examine_cell
from sart_toolkit.cli import main
from sart_toolkit.cli.deploy import _Person
from sart_toolkit.hardware.cell import Limits, Workspace
from sart_toolkit.robots import get_robot
from sart_toolkit.scenes.spec import SceneSpec
from sart_toolkit.testing.emulated import EmulatedWorld

CELL = """
robot = "ur5e_2f85"
[arm]
driver = "ur_rtde"
host = "localhost"
[gripper]
driver = "robotiq_socket"
host = "127.0.0.1"
port = 1
[limits]
workspace = { low = [0, 0, 0], high = [1, 1, 1] }
"""


@pytest.fixture
def cell(tmp_path):
    path = tmp_path / "cell.toml"
    path.write_text(CELL)
    return path


def test_without_a_person_at_a_terminal_nothing_begins(refused, tmp_path, cell, monkeypatch):
    monkeypatch.setattr(sys.stdin, "isatty", lambda: False, raising=False)
    said = refused("deploy", tmp_path, "--backend", cell)
    assert "a person beside the robot says when it may move" in said


def test_a_skill_that_isn_t_there_is_refused(refused, tmp_path, cell):
    said = refused("deploy", tmp_path / "skill", "--backend", cell, "--unattended")
    assert "no such skill directory" in said
    said = refused("deploy", tmp_path, "--backend", tmp_path / "no.toml", "--unattended")
    assert "no such file" in said


def test_doctor_says_of_each_part_what_is_wrong_and_exits_with_1(cell, capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "rtde_receive", None)
    with pytest.raises(SystemExit) as exit_:
        main(["doctor", "--cell", str(cell), "--json"])
    assert exit_.value.code == 1
    found = {row["name"]: row for row in json.loads(capsys.readouterr().out)["findings"]}
    assert "pip install sart_toolkit[ur]" in found["arm"]["detail"]
    assert "refused" in found["gripper"]["detail"] and "cable" in found["gripper"]["remedy"]


def test_doctor_takes_a_cell_or_a_robot(refused, cell):
    assert "--robot: is not about a cell" in refused("doctor", "--cell", cell, "--robot", "xarm6")


def test_parts_that_answer_are_read_and_nothing_moves():
    robot, scene = get_robot("ur5e_2f85"), SceneSpec(())
    world = EmulatedWorld(robot, scene, 48)
    found = examine_cell(world.cell(), world.now)
    assert [(row.name, row.ok) for row in found] == [
        ("arm", True), ("gripper", True), ("camera wrist", True),
    ]  # fmt: skip
    arm, gripper, camera = (row.detail for row in found)
    assert "joints at 0.0, -97.4" in arm and "0% closed" in gripper and "64x48" in camera
    assert {"RTDEControlInterface", "servoJ"}.isdisjoint(call.name for call in world.calls)
    far = Workspace([5, 5, 5], [6, 6, 6])
    outside = examine_cell(world.cell(Limits(far)), world.now)[0]
    assert not outside.ok and "outside the workspace; move the arm into it" in outside.detail
    world.safety_mode = 3
    world.advance(0.1)
    stopped = examine_cell(world.cell(), world.now)[0]
    assert not stopped.ok and "protective stop" in stopped.detail
    world.close()


# --- judged by a person -------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("flags", "terminal", "said"),
    [
        ("--episodes 3", True, "--episodes: add --out FILE.json"),
        ("--overwrite", True, "--overwrite: nothing is written without --out"),
        ("--out t.json --dry-run", True, "--dry-run: leaves nobody anything to judge"),
        ("--out t.json --unattended", True, "--unattended: leaves nobody anything to judge"),
        ("--out t.json", False, "--out asks a person for verdicts, by keys"),
    ],
)
def test_what_leaves_nothing_to_judge_is_refused(
    refused, tmp_path, cell, monkeypatch, flags, terminal, said
):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys.stdin, "isatty", lambda: terminal, raising=False)
    assert said in refused("deploy", tmp_path, "--backend", cell, *flags.split())
    assert not (tmp_path / "t.json").exists()


def test_a_person_judges_by_keys_and_others_are_passed_over(capsys):
    typed = iter(["q", "\n", "", "z", " ", "?", "\x7f", "\t", "o"])
    person = _Person(lambda seconds: next(typed))
    person.begin(2, 20, 1)
    assert "Trial 3 of 20, 1 of 2 succeeded so far" in capsys.readouterr().err
    assert [person.pressed() for _ in range(3)] == [None, None, "success"]
    assert person.verdict("time is up") == "failure"
    assert "It ended: time is up" in capsys.readouterr().err
    assert person.back() == "open"
