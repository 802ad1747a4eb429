"""Every program in docs/examples runs."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

EXAMPLES = Path(__file__).parents[2] / "docs" / "examples"


def run(name: str, *argv: object) -> str:
    done = subprocess.run(
        [sys.executable, EXAMPLES / name, *map(str, argv)],
        capture_output=True,
        text=True,
        timeout=300,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_first_skill_on_a_small_budget_and_running_it(tmp_path: Path) -> None:
    assert "of 2 succeeded" in run("01_first_skill.py", tmp_path, 5, 2, 2)
    said = run("02_run_a_skill.py", tmp_path / "skill")
    assert "succeeded" in said or "failed: " in said
    assert "of 1 succeeded" in run("08_gymnasium.py", tmp_path / "skill", 1)


def test_examples_are_short_and_import_what_is_public() -> None:
    for path in EXAMPLES.glob("*.py"):
        text = path.read_text()
        assert len(text.splitlines()) <= 80, path.name
        assert not re.search(r"sart_toolkit[.\w]*[. ]_\w|from sart_toolkit\.", text), path.name
