"""The pages on formats and Gymnasium show what can be typed, and name all there is."""

from __future__ import annotations

import re
import shlex
import textwrap
from pathlib import Path
from typing import Any

import pytest

from sart_toolkit.cli import main
from sart_toolkit.cli.verbs import VERBS, find_verb
from sart_toolkit.data.formats import FORMATS
from sart_toolkit.gym import env_id
from sart_toolkit.tasks import TASKS

DOCS = Path(__file__).parents[2] / "docs"
FORMATS_PAGE, GYM_PAGE = (DOCS / name for name in ("formats.md", "gymnasium.md"))


def blocks(page: Path) -> list[str]:
    return re.findall(r"```python\n(.*?)```", page.read_text(), re.S)


def test_every_command_can_be_parsed() -> None:
    commands = re.findall(r"^sart ([^#\n]*)", FORMATS_PAGE.read_text(), re.M)
    assert len(commands) >= 7
    for command in commands:
        name, words = find_verb(shlex.split(command))
        VERBS[name].parse(name, words)


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


def test_the_environment_on_the_page_runs() -> None:
    (code,) = blocks(GYM_PAGE)
    made: dict[str, Any] = {}
    exec(textwrap.dedent(code).replace("num_envs=4", "num_envs=1"), made)
    try:
        assert made["observation"] in made["env"].observation_space
        assert made["observation"]["pixels"]["wrist"].shape == (128, 128, 3)
        assert not made["info"]["is_success"] and made["envs"].num_envs == 1
    finally:
        made["envs"].close()
