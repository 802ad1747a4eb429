"""What the README says can be done without recording can be."""

from __future__ import annotations

import re
import shlex
from pathlib import Path

import pytest

from sart_toolkit.cli import main
from sart_toolkit.data.dataset import load_dataset

ROOT = Path(__file__).parents[2]


def test_the_recorded_demonstration_is_played_and_augmented(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "assets").symlink_to(ROOT / "assets")
    monkeypatch.chdir(tmp_path)
    commands = re.findall(r"^sart (\w+ assets/.*)$", (ROOT / "README.md").read_text(), re.M)
    assert [command.split()[0] for command in commands] == ["play", "augment"]
    for command in commands:
        main(shlex.split(command))
    assert (tmp_path / "demo.mp4").stat().st_size > 1000
    assert load_dataset(tmp_path / "dataset").info["n_kept"] == 7
