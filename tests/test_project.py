"""What the checkout promises: nothing in it is bound to one machine, and torch is pinned."""

from __future__ import annotations

import re
import subprocess
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]

# Put together from pieces, so that this file keeps its own promise.
FORBIDDEN = {
    "an absolute path of one machine": re.compile(r"(?<![\w./~-])/(?:work|root|home)" + r"/\w"),
    "the address of a package registry": re.compile(
        r"(?:py" + r"pi\.(?:org|io)|python" + r"hosted\.org|download\.py" + r"torch\.org"
        r"|(?:deb|security|snapshot|ftp)\.deb" + r"ian\.org|registry\.np" + r"mjs\.org)"
    ),
}


def forbidden_lines(text: str) -> list[str]:
    """One entry for each line of `text` that only one machine or registry can make use of."""
    return [
        f"{number}: {what}: {line.strip()[:100]}"
        for number, line in enumerate(text.splitlines(), 1)
        for what, pattern in FORBIDDEN.items()
        if pattern.search(line)
    ]


def test_no_tracked_file_names_a_machine_path_or_a_registry() -> None:
    if not (ROOT / ".git").exists():
        pytest.skip("not a git checkout")
    listing = subprocess.run(
        ["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, text=True, check=True
    )
    wrong = {}
    for name in filter(None, listing.stdout.split("\0")):
        path = ROOT / name
        if path.is_file() and (lines := forbidden_lines(path.read_text(errors="replace"))):
            wrong[name] = lines
    assert wrong == {}


@pytest.mark.parametrize(
    "line",
    [
        "cd /" + "work/main",
        'Path("/' + 'root/data")',
        "see /" + "home/me/notes",
        "https://py" + "pi.org/simple",
        "deb http://deb.deb" + "ian.org/debian bookworm main",
    ],
)
def test_a_machine_path_or_registry_is_caught(line: str) -> None:
    assert len(forbidden_lines(f"fine\n{line}\n")) == 1


@pytest.mark.parametrize("line", ["docs/home/index", "net/root/x", "https://a.example/home/x"])
def test_a_relative_path_is_no_complaint(line: str) -> None:
    assert forbidden_lines(line) == []


def test_torch_is_pinned() -> None:
    assert "torch==2.13.0" in (ROOT / "constraints.txt").read_text().splitlines()


def test_every_declared_dependency_is_pinned() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    declared = sum(project["optional-dependencies"].values(), project["dependencies"])
    pinned = re.findall(r"^([\w-]+)==", (ROOT / "constraints.txt").read_text(), re.MULTILINE)
    assert {re.split(r"[=<>~!;]", name)[0] for name in declared} - set(pinned) == set()
