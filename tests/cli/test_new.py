"""`sart new`: what it writes works as it stands, by the commands that it prints."""

from __future__ import annotations

import shlex
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sart_toolkit.data.dataset import load_dataset
from sart_toolkit.data.records import Annotation, Demonstration
from sart_toolkit.data.storage import save_annotation, save_demonstration

KINDS = ("task", "strategy", "backend")
SMALL = ("--n", "4", "--epochs", "1", "--episodes", "1", "--image-size", "48", "--workers", "1")

Said = Callable[..., Any]
Refused = Callable[..., str]


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty current folder."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", list(sys.path))
    return tmp_path


def test_a_new_task_is_learned_by_the_command_that_is_printed(said: Said) -> None:
    printed = said("new", "task", "lift_it")
    assert printed["written"] == "lift_it.py"
    assert printed["next"] == "sart run lift_it.py:LiftIt --out runs/lift_it"
    result = said(*shlex.split(printed["next"])[1:], *SMALL)
    assert result["task"] == "lift_it" and result["kept"] == 3
    assert Path("runs/lift_it/report.html").exists()


def test_a_new_strategy_draws_as_its_comments_say(
    said: Said, peg_demonstration: Demonstration, peg_annotation: Annotation
) -> None:
    save_demonstration(Path("demo.h5"), peg_demonstration)
    save_annotation(Path("annotation.json"), peg_annotation)
    printed = said("new", "strategy", "keep_turn")
    assert printed["next"].endswith(" --strategy keep_turn.py:KEEP_TURN")
    said(*shlex.split(printed["next"])[1:], "--n", "9")
    dataset = load_dataset(Path("dataset"))
    assert len(dataset) == 8
    for episode in dataset:
        sphere = peg_annotation.spheres[episode.provenance.sphere]
        T = episode.provenance.T_world_sampled
        np.testing.assert_allclose(T[:3, :3], sphere.T_world_key[:3, :3], atol=1e-9)
        assert 0 < np.linalg.norm(T[:3, 3] - sphere.T_world_key[:3, 3]) <= sphere.radius + 1e-9


def test_a_new_backend_runs_a_task_by_the_command_that_is_printed(said: Said) -> None:
    printed = said("new", "backend", "my_arm", "--out", "mine.py")
    assert printed["next"] == "sart run peg_in_hole --backend mine.py:MyArm --out runs/my_arm"
    result = said(*shlex.split(printed["next"])[1:], *SMALL)
    assert result["kept"] == 3


@pytest.mark.parametrize("kind", KINDS)
def test_a_name_is_one_of_python_s(refused: Refused, folder: Path, kind: str) -> None:
    for name in ("push block", "2nd", "class", "__", "a-b"):
        assert f"got {name!r}; such as push_block" in refused("new", kind, name)
    assert not list(folder.iterdir())


@pytest.mark.parametrize("kind", KINDS)
def test_a_file_is_replaced_only_where_that_is_asked_for(
    said: Said, refused: Refused, kind: str
) -> None:
    Path("mine.py").write_text("precious")
    assert "mine.py exists; pass --overwrite" in refused("new", kind, "mine")
    assert Path("mine.py").read_text() == "precious"
    said("new", kind, "mine", "--overwrite")
    assert "import sart_toolkit as sart" in Path("mine.py").read_text()


@pytest.mark.parametrize(
    ("out", "message"),
    [
        ("nowhere/a.py", "there is no folder nowhere; create it"),
        ("a.txt", "expected a file that ends with .py, got a.txt"),
        ("random.py", "would be imported instead of Python's own 'random'"),
    ],
)
@pytest.mark.parametrize("kind", KINDS)
def test_a_file_that_can_not_be_used_is_refused(
    refused: Refused, folder: Path, kind: str, out: str, message: str
) -> None:
    assert message in refused("new", kind, "mine", "--out", out)
    assert not list(folder.iterdir())


def test_a_new_file_can_lie_in_another_folder_and_its_comments_say_so(
    said: Said, folder: Path
) -> None:
    (folder / "cell").mkdir()
    said("new", "task", "lift_it", "--out", "cell/lift.py")
    assert "sart run cell/lift.py:LiftIt --out runs/lift_it" in Path("cell/lift.py").read_text()
