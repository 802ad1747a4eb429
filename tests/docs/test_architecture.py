"""The map of the code names what is there, and all of it, in order of dependence."""

from __future__ import annotations

import re
from pathlib import Path

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs" / "architecture.md").read_text()
PACKAGE = ROOT / "sart_toolkit"


def names() -> list[str]:
    """What is written as code and looks like a path, in order."""
    return [name for name in re.findall(r"`([\w./-]+)`", PAGE) if "/" in name or ".py" in name]


def test_every_path_that_it_names_exists() -> None:
    named = names()
    assert len(named) > 50
    for name in named:
        if name == "sart_toolkit/assets/":
            continue  # In a wheel only.
        roots = (ROOT, PACKAGE)
        assert any((root / name).exists() for root in roots), name


def test_every_package_is_on_the_map() -> None:
    for path in PACKAGE.iterdir():
        if (path / "__init__.py").exists():
            assert f"| `sart_toolkit/{path.name}/` |" in PAGE, path.name


def test_the_map_is_in_order_of_dependence() -> None:
    layers = re.findall(r'^    "(\w+)",$', (ROOT / "tests" / "test_layers.py").read_text(), re.M)
    mapped = re.findall(r"^\| `sart_toolkit/(\w+)", PAGE.split("## To change")[0], re.M)
    assert len(mapped) > 15
    assert mapped == [layer for layer in layers if layer in mapped]
