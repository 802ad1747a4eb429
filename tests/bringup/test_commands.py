"""`sart new robot` and `sart doctor --robot`, as they are typed."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import pytest

from sart_toolkit.cli import main
from sart_toolkit.robots.spec import RobotSpec

Make = Callable[..., RobotSpec]


def test_a_urdf_becomes_a_robot_that_the_doctor_accepts(
    toy: Make, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    toy()
    monkeypatch.chdir(tmp_path)
    main(["new", "robot", "toy.urdf", "--out", "mine.py", "--json"])
    said = json.loads(capsys.readouterr().out)
    assert said["next"] == "sart doctor --robot mine.py:MINE"
    main([*said["next"].split()[1:], "--image", "seen.png", "--json"])
    found = json.loads(capsys.readouterr().out)
    assert found["usable"]
    assert {"files", "gripper", "pybullet"} <= {finding["name"] for finding in found["findings"]}
    assert (tmp_path / "seen.png").is_file()


def test_the_doctor_exits_with_1_and_says_each_fault_with_its_remedy(
    toy: Make, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    toy()
    monkeypatch.chdir(tmp_path)
    main(["new", "robot", "toy.urdf", "--out", "mine.py"])
    text = Path("mine.py").read_text()
    Path("mine.py").write_text(text.replace("finger_links=('left'", "finger_links=('lett'"))
    capsys.readouterr()
    with pytest.raises(SystemExit) as ended:
        main(["doctor", "--robot", "mine.py:MINE"])
    assert ended.value.code == 1
    out = capsys.readouterr().out
    assert "FAIL frames  finger_links: no frame 'lett'\n      -> did you mean 'left'?" in out


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("doctor --robot arm.urdf", "sart new robot arm.urdf --out arm.py"),
        ("doctor --image a.png", "--image: is of a robot; add --robot REF"),
        ("doctor --full --robot panda", "--full: is about this machine"),
        ("new", "new: of what? add robot, task, strategy, backend"),
        ("new robit", "did you mean 'robot'"),
        ("new robot none.urdf --out a.py", "no such file"),
    ],
)
def test_what_makes_no_sense_is_refused_with_what_to_type(
    capsys: pytest.CaptureFixture[str], words: str, message: str
) -> None:
    with pytest.raises(SystemExit) as ended:
        main(words.split())
    assert ended.value.code == 2
    assert message in capsys.readouterr().err
