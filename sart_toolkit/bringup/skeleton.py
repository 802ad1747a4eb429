"""Files to begin with: a task, a strategy or a backend that works as it stands."""

from __future__ import annotations

import keyword
import string
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from sart_toolkit.errors import CannotWrite, InvalidInput, OutputExists

Kind = Literal["task", "strategy", "backend"]

_TEMPLATES = Path(__file__).with_name("templates")


@dataclass(frozen=True)
class Skeleton:
    """The text of a file, and what its object is called wherever one is named."""

    text: str
    reference: str


def make_skeleton(kind: Kind, name: str, out: Path) -> Skeleton:
    """A commented Python file with a task, a strategy or a backend, to be changed.

    Args:
        kind: what it holds.
        name: what it is called in files and reports, such as `push_block`; a class's name is made
            from it.
        out: where the file is going to be; its comments say so.

    Raises:
        InvalidInput: the name is no identifier of Python, or the file isn't one that can be named.
    """
    # Of underscores alone no class's name can be made.
    if not name.isidentifier() or keyword.iskeyword(name) or not name.strip("_"):
        raise InvalidInput(
            f"name: expected letters, digits and underscores, not beginning with a digit and no "
            f"word of Python's own, got {name!r}; such as push_block"
        )
    if out.suffix != ".py":
        raise InvalidInput(f"out: expected a file that ends with .py, got {out}")
    if out.stem in sys.stdlib_module_names:
        raise InvalidInput(
            f"out: in its folder {out.name} would be imported instead of Python's own "
            f"{out.stem!r}; choose another name or --out"
        )
    names = {
        "name": name,
        "Name": "".join(part[:1].upper() + part[1:] for part in name.split("_")),
        "NAME": name.upper(),
        "file": str(out),
    }
    template = (_TEMPLATES / f"{kind}.py.txt").read_text(encoding="utf-8")
    named = names["NAME" if kind == "strategy" else "Name"]
    return Skeleton(string.Template(template).substitute(names), f"{out}:{named}")


def write_source(text: str, out: Path, overwrite: bool = False) -> None:
    """Write a file to begin with.

    Raises:
        OutputExists: it is there, and not to be overwritten.
        CannotWrite: it can't be written.
    """
    if out.exists() and not overwrite:
        raise OutputExists(f"{out} exists; pass --overwrite to replace it, or another --out")
    if not out.parent.is_dir():
        raise CannotWrite(
            f"{out}: there is no folder {out.parent}; create it, or choose another --out"
        )
    try:
        out.write_text(text, encoding="utf-8")
    except OSError as error:
        raise CannotWrite(f"{out}: {error.strerror or error}; choose another --out") from error
