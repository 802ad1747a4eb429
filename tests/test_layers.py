"""The packages import in one direction, as the design's data flow says."""

from __future__ import annotations

import ast
import re
from pathlib import Path

import pytest

PACKAGE = Path(__file__).parents[1] / "sart_toolkit"

# Lowest first: each may import from those before it, and from itself.
LAYERS = (
    "errors",
    "poses",
    "userfiles",
    "registry",
    "data",
    "workers",
    "robots",
    "calibrate",
    "scenes",
    "collision",
    "motion",
    "hardware",
    "backends",
    "tasks",
    "record",
    "annotate",
    "augment",
    "learn",
    "evaluate",
    "gym",
    "report",
    "benchmark",
    "testing",
    "doctor",
    "bringup",
    "pipeline",
    "cli",
    "__main__",
)

# What the lazy tables hold: "sart_toolkit.tasks.peg_in_hole:PegInHole".
LAZY_TARGET = re.compile(r"(sart_toolkit(?:\.\w+)+):\w+")


def upward_imports(package: Path) -> list[str]:
    """One line for each import of a module under `package` that the layers forbid.

    The package's own `__init__.py` is exempt, since it re-exports lazily.
    """
    wrong = []
    for path in sorted(package.rglob("*.py")):
        inside = path.relative_to(package).with_suffix("").parts
        if inside == ("__init__",):
            continue
        tree = ast.parse(path.read_text(), str(path))
        where = path.relative_to(package.parent)
        if inside[0] not in LAYERS:
            wrong.append(f"{where}: {inside[0]} is no layer")
            continue
        for line, module in _imported_modules(tree, (package.name, *inside)):
            layer = (*module.split("."), "")[1]
            if layer not in LAYERS:
                wrong.append(f"{where}:{line}: imports {module}, which is in no layer")
            elif LAYERS.index(layer) > LAYERS.index(inside[0]):
                wrong.append(f"{where}:{line}: {inside[0]} imports {module} from above it")
    return wrong


def _imported_modules(tree: ast.Module, importer: tuple[str, ...]) -> list[tuple[int, str]]:
    """Line and full name of every module of our package that a module imports, lazily too."""
    found = []
    for node in ast.walk(tree):
        names: list[str] = []
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            # In `a/b.py` and in `a/__init__.py` alike, one dot means `a`.
            start = importer[: -node.level] if node.level else ()
            base = ".".join((*start, *filter(None, [node.module])))
            # `from sart_toolkit import poses` names the layer only in what is imported.
            whole = base == importer[0]
            names = [f"{base}.{alias.name}" for alias in node.names] if whole else [base]
        elif isinstance(node, ast.Constant) and isinstance(node.value, str):
            match = LAZY_TARGET.fullmatch(node.value)
            names = [match.group(1)] if match else []
        found += [(node.lineno, name) for name in names if name.split(".")[0] == importer[0]]
    return found


def test_no_module_imports_from_a_layer_above_it() -> None:
    assert upward_imports(PACKAGE) == []


@pytest.mark.parametrize(
    ("file", "source", "complaint"),
    [
        ("poses.py", "import sart_toolkit.data.records", "poses imports sart_toolkit.data"),
        ("poses.py", "from sart_toolkit.cli import main", "poses imports sart_toolkit.cli"),
        ("poses.py", "from sart_toolkit import data", "poses imports sart_toolkit.data"),
        ("poses.py", "from . import data", "poses imports sart_toolkit.data"),
        ("poses.py", "def f():\n    import sart_toolkit.learn.loop", "poses.py:2: poses imports"),
        ("robots/ur5e.py", "from ..scenes import SceneSpec", "robots imports sart_toolkit.scenes"),
        ("robots/__init__.py", "from ..tasks.lid import Lid", "robots imports sart_toolkit.tasks"),
        ("tasks/__init__.py", "T = 'sart_toolkit.learn.loop:train'", "tasks imports"),
        ("poses.py", "from sart_toolkit import Demonstration", "which is in no layer"),
        ("poses.py", "import sart_toolkit", "which is in no layer"),
        ("helpers.py", "", "helpers is no layer"),
    ],
)
def test_an_upward_import_is_caught(tmp_path: Path, file: str, source: str, complaint: str) -> None:
    path = tmp_path / "sart_toolkit" / file
    path.parent.mkdir(parents=True)
    path.write_text(source)
    (line,) = upward_imports(tmp_path / "sart_toolkit")
    assert complaint in line


@pytest.mark.parametrize(
    ("file", "source"),
    [
        ("__init__.py", "from sart_toolkit.cli import main"),
        (
            "data/storage.py",
            "from sart_toolkit.data.records import Episode\nfrom ..errors import SartError",
        ),
        ("learn/loop.py", "from . import windows\nfrom .windows import Window\nimport torch"),
        ("learn/__init__.py", "from .loop import train\nfrom sart_toolkit import poses"),
        ("cli/run.py", "from ..doctor import diagnose\nimport sart_toolkit.evaluate"),
    ],
)
def test_a_downward_import_is_no_complaint(tmp_path: Path, file: str, source: str) -> None:
    path = tmp_path / "sart_toolkit" / file
    path.parent.mkdir(parents=True)
    path.write_text(source)
    assert upward_imports(tmp_path / "sart_toolkit") == []
