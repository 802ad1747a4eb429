"""The pages on formats and Gymnasium name all there is."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from sart_toolkit.cli import main
from sart_toolkit.data.formats import FORMATS
from sart_toolkit.gym import env_id
from sart_toolkit.tasks import TASKS

DOCS = Path(__file__).parents[2] / "docs"
FORMATS_PAGE, GYM_PAGE = (DOCS / name for name in ("formats.md", "gymnasium.md"))


def blocks(page: Path) -> list[str]:
    return re.findall(r"```python\n(.*?)```", page.read_text(), re.S)


def test_every_format_and_environment_is_named() -> None:
    assert all(f"`{name}`" in FORMATS_PAGE.read_text() for name in FORMATS)
    assert all(f"`{env_id(task)}`" in GYM_PAGE.read_text() for task in TASKS)


def test_the_format_of_one_s_own_works(
    peg_dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (code,) = blocks(FORMATS_PAGE)
    monkeypatch.chdir(tmp_path)
    (tmp_path / "lines.py").write_text(code)
    main(["export", str(peg_dataset.path), "--format", "lines.py:Lines", "--out", "a.jsonl"])
    main(["validate", "a.jsonl", "--format", "lines.py:Lines"])
    assert '"action": [' in (tmp_path / "a.jsonl").read_text().splitlines()[0]
