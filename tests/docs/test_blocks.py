"""What the documentation shows can be typed: its programs run, its commands are understood.

A block of `python` or `sh` is run as it stands, those of a page one after the other in one empty
folder (with `docs` and `assets`, as in a checkout). Of other blocks each line that begins with
`sart` is parsed.
"""

from __future__ import annotations

import contextlib
import io
import re
import shlex
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from sart_toolkit.cli import main
from sart_toolkit.cli.verbs import VERBS, find_verb

ROOT = Path(__file__).parents[2]
PAGES = {
    str(path.relative_to(ROOT)): path
    for path in (ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md")))
}
# Their programs are run by `test_own.py`, in an empty folder.
COPIED = {"04_own_robot.md", "05_own_task.md", "06_own_strategy.md", "07_own_backend.md"}
# These learn a skill by all verbs.
LONG = {"README.md", "docs/tutorials/01_first_skill.md"}
_FENCE = re.compile(r"^```(\w*)\n(.*?)^```$", re.M | re.S)


def blocks(page: str, *languages: str) -> list[tuple[str, str]]:
    """The page's blocks in these languages, each with its language; "" is none."""
    found = _FENCE.findall(PAGES[page].read_text())
    return [(language, code) for language, code in found if language in languages]


def runnable(page: str) -> list[tuple[str, str]]:
    """Its blocks of `python` and `sh`, but for programs: a block after them runs those by name."""
    if Path(page).name in COPIED:
        return []
    return [block for block in blocks(page, "python", "sh") if not block[1].startswith("--8<--")]


def commands(code: str) -> list[str]:
    """The commands in a block, without comments, continued lines put together."""
    lines = re.sub(r"\\\n", " ", code).splitlines()
    return [line.partition(" #")[0].strip() for line in lines if line.strip()]


@pytest.mark.parametrize(
    "page",
    [
        pytest.param(page, marks=[pytest.mark.slow] if page in LONG else [])
        for page in PAGES
        if runnable(page)
    ],
)
def test_every_block_of_python_and_sh_runs(
    page: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("docs", "assets"):
        (tmp_path / name).symlink_to(ROOT / name)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", list(sys.path))
    made: dict[str, Any] = {"__name__": "a_page"}
    with contextlib.redirect_stdout(io.StringIO()) as printed:
        for language, code in runnable(page):
            if language == "python":
                exec(compile(code, page, "exec"), made)
            else:
                for command in commands(code):
                    type_command(command, monkeypatch)
    shown = re.findall(r"^prints\n\n```\n(.*?)^```$", PAGES[page].read_text(), re.M | re.S)
    for output in shown:
        assert output in printed.getvalue()
    for report in re.findall(r"succeeded; the page: (\S+)", printed.getvalue()):
        assert (tmp_path / report).exists()


def type_command(command: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Do what a shell would: `sart` in this process, programs in one of their own."""
    piped, _, command = command.rpartition(" | ")
    words = shlex.split(command)
    if words[0] == "sart":
        if piped:
            monkeypatch.setattr("sys.stdin", io.StringIO(" ".join(shlex.split(piped)[1:])))
        main(words[1:])
        return
    assert words[0] == "python", command
    done = subprocess.run([sys.executable, *words[1:]], capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    sys.stdout.write(done.stdout)


def test_every_command_that_is_shown_can_be_parsed() -> None:
    parsed = 0
    for page in PAGES:
        for _, code in blocks(page, "", "sh"):
            for line in commands(code):
                command = line.rpartition(" | ")[2]
                if not command.startswith("sart ") or "…" in command:
                    continue
                name, words = find_verb(shlex.split(command)[1:])
                try:
                    VERBS[name].parse(name, words)
                except SystemExit as ended:
                    raise AssertionError(f"{page}: {command}") from ended
                parsed += 1
    assert parsed > 70


def test_every_tutorial_shows_its_program_and_every_program_has_a_tutorial() -> None:
    programs = sorted(path.stem for path in (ROOT / "docs" / "examples").glob("*.py"))
    assert [name[:2] for name in programs] == [f"{i:02d}" for i in range(1, len(programs) + 1)]
    for name in programs:
        text = PAGES[f"docs/tutorials/{name}.md"].read_text()
        assert f'--8<-- "examples/{name}.py"' in text and f"docs/examples/{name}.py" in text
