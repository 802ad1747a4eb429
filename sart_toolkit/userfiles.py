"""What `path/to/file.py:NAME` refers to: a file as a module that every process can import.

The name of such a module is this one's and the file's path. So what was pickled in one process is
found again in another, a worker for instance, which imports the file by that name.
"""

from __future__ import annotations

import importlib
import importlib.abc
import importlib.util
import sys
from collections.abc import Sequence
from importlib.machinery import ModuleSpec
from pathlib import Path
from types import ModuleType
from urllib.parse import unquote

# What has a `__path__` is a package; its modules are found below.
__path__: list[str] = []


def load_file(path: Path) -> ModuleType:
    """The module in a file, run once in each process; the running script is not run again."""
    path = Path(path).resolve()
    script = getattr(sys.modules["__main__"], "__file__", None)
    if script is not None and Path(script).resolve() == path:
        return sys.modules["__main__"]
    # A dot would end the name of a package.
    name = str(path).replace("%", "%25").replace(".", "%2E")
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
        return None if file is None else importlib.util.spec_from_file_location(fullname, file)


sys.meta_path.append(_FileFinder())
