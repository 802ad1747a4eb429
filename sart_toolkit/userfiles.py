"""What `path/to/file.py:NAME` refers to: a file as a module that every process can import.

The name of such a module is this one's and the file's path. So what was pickled in one process is
found again in another, a worker for instance, which imports the file by that name. On another
machine the file is a copy, see `mirror`.
"""

from __future__ import annotations

import importlib
import importlib.abc
import importlib.util
import os
import sys
from collections.abc import Sequence
from importlib.machinery import ModuleSpec
from pathlib import Path
from types import ModuleType
from urllib.parse import unquote

# What has a `__path__` is a package; its modules are found below.
__path__: list[str] = []

_root: Path | None = None


def mirror(root: Path) -> None:
    """From now on, files of another machine are found under `root`, where they have copies there.

    What names a file, a reference or a module's name, still names it as it does on that machine.
    """
    global _root
    _root = root


def local_file(path: Path | str) -> Path:
    """Where this process finds a file: its copy under the root of `mirror`, or else its path."""
    copy = copy_of(path)
    return copy if copy.exists() else Path(path)


def copy_of(path: Path | str) -> Path:
    """Where under the root of `mirror` a file's copy is, or is to be; without one, its path."""
    return Path(path) if _root is None else _root / original_path(path).relative_to("/")


def original_path(path: Path | str) -> Path:
    """The absolute path of a file; of a copy, that which the file has on its own machine."""
    path = Path(os.path.abspath(path))
    if _root is not None and path.is_relative_to(_root):
        return "/" / path.relative_to(_root)
    return path


def load_file(path: Path) -> ModuleType:
    """The module in a file, run once in each process; the running script is not run again."""
    path = local_file(path).resolve()
    script = getattr(sys.modules["__main__"], "__file__", None)
    if script is not None and Path(script).resolve() == path:
        return sys.modules["__main__"]
    # A dot would end the name of a package.
    name = str(original_path(path)).replace("%", "%25").replace(".", "%2E")
    return importlib.import_module(f"{__name__}.{name}")


def file_of(module: str) -> Path | None:
    """The file that a module was read from by `load_file`; None for any other module."""
    parent, _, name = module.rpartition(".")
    return Path(unquote(name)) if parent == __name__ else None


class _FileFinder(importlib.abc.MetaPathFinder):
    def find_spec(
        self, fullname: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        file = file_of(fullname)
        if file is None:
            return None
        return importlib.util.spec_from_file_location(fullname, local_file(file))


sys.meta_path.append(_FileFinder())
