"""The wheel holds the package and its assets, whole, and nothing else."""

from __future__ import annotations

import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> zipfile.ZipFile:
    """Built from a copy, since setuptools leaves things beside its sources."""
    source = tmp_path_factory.mktemp("source")
    for name in ("pyproject.toml", "setup.py", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, source)
    for name in ("sart_toolkit", "assets"):
        shutil.copytree(ROOT / name, source / name, ignore=shutil.ignore_patterns("__pycache__"))
    words = ["wheel", "--no-deps", "--no-build-isolation", "--no-index", "-q", "-w", "dist", "."]
    done = subprocess.run(
        [sys.executable, "-m", "pip", *words], cwd=source, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    (path,) = (source / "dist").iterdir()
    return zipfile.ZipFile(path)


def files(folder: str) -> set[str]:
    paths = (path for path in (ROOT / folder).rglob("*") if path.is_file())
    return {str(p.relative_to(ROOT)) for p in paths if "__pycache__" not in p.parts}


def test_it_holds_every_file_of_the_package_and_of_the_assets(wheel: zipfile.ZipFile) -> None:
    expected = files("sart_toolkit") | {f"sart_toolkit/{name}" for name in files("assets")}
    held = {name for name in wheel.namelist() if ".dist-info/" not in name}
    assert held == expected
    assert "sart_toolkit/assets/peg_in_hole/demo.h5" in held
    assert "sart_toolkit/report/templates/page.html" in held


def test_it_brings_the_command_and_the_contract_suite_s_plugin(wheel: zipfile.ZipFile) -> None:
    (points,) = (name for name in wheel.namelist() if name.endswith("entry_points.txt"))
    text = wheel.read(points).decode()
    assert "sart = sart_toolkit.cli:main" in text and "[pytest11]" in text
