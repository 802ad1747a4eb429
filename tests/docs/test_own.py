"""A robot, task, strategy and backend of one's own work from another folder, by verbs."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from sart_toolkit.cli import main
from sart_toolkit.data.dataset import MANIFEST, load_dataset
from sart_toolkit.data.storage import load_demonstration, read_json

EXAMPLES = Path(__file__).parents[2] / "docs" / "examples"
# The file, the task, and the options of `record` and `augment`.
OWN = {
    "robot": ("04_own_robot.py", "peg_in_hole", ["--robot", "04_own_robot.py:IIWA"], []),
    "task": ("05_own_task.py", "05_own_task.py:Drawer", [], []),
    "strategy": (
        "06_own_strategy.py", "peg_in_hole", [], ["--strategy", "06_own_strategy.py:ABOVE"],
    ),
    "backend": (
        "07_own_backend.py", "peg_in_hole", ["--backend", "07_own_backend.py:Kinematic"], [],
    ),
}  # fmt: skip


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty current folder."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", list(sys.path))
    return tmp_path


def interrupted(argv: list[str], manifest: Path, wait_until: Callable[..., None]) -> None:
    """Run `sart` until its first segment is kept, then press Ctrl-C."""
    command = [sys.executable, "-m", "sart_toolkit", *argv]
    with subprocess.Popen(command, stderr=subprocess.PIPE, start_new_session=True) as process:
        wait_until(
            lambda: (
                process.poll() is not None
                or (manifest.exists() and '"kept"' in manifest.read_text())
            ),
            120.0,
        )
        os.killpg(process.pid, signal.SIGINT)
        stderr = process.communicate(timeout=60)[1].decode()
    assert process.returncode == 130 and "to resume type: sart augment" in stderr, stderr


@pytest.mark.parametrize("kind", OWN)
def test_what_is_one_s_own_goes_through_all_verbs(
    folder: Path, wait_until: Callable[..., None], kind: str
) -> None:
    file, task, recording, augmenting = OWN[kind]
    shutil.copy(EXAMPLES / file, folder)
    main(["record", task, "--out", "demo.h5", "--image-size", "48", *recording])
    references = load_demonstration(folder / "demo.h5").references
    main(["suggest", "demo.h5", "--out", "annotation.json"])
    argv = ["augment", "demo.h5", "annotation.json", "--out", "dataset", "--n", "10"]
    argv += ["--workers", "2", *augmenting]
    interrupted(argv, folder / "dataset" / MANIFEST, wait_until)
    main(argv)
    assert len(load_dataset(folder / "dataset")) == 9
    main(["validate", "dataset"])
    main(["train", "dataset", "--out", "skill", "--epochs", "1"])
    main(["evaluate", "skill", "--out", "evaluation.json", "--episodes", "1"])
    main(["play", "demo.h5", "--out", "film.mp4"])
    main(["report", "."])
    assert (folder / "film.mp4").exists() and (folder / "report.html").exists()
    noted = {**references, **read_json(folder / "dataset" / "dataset.json", dict)["config"]}
    assert file in json.dumps(noted) and file in f"{noted[kind]}"
