"""What comes with the toolkit and is no code: URDFs, and a small recorded demonstration."""

from __future__ import annotations

from pathlib import Path

from sart_toolkit.errors import MissingFile

_PACKAGE = Path(__file__).parents[1]


def assets_folder() -> Path:
    """The toolkit's `assets/`: inside the package in a wheel, beside it in a checkout."""
    inside = _PACKAGE / "assets"
    return inside if inside.is_dir() else _PACKAGE.parent / "assets"


def asset(name: str) -> Path:
    """The file in the toolkit's `assets/`, such as `peg_in_hole/demo.h5`.

    Raises:
        MissingFile: there is no such asset.
    """
    path = assets_folder() / name
    if not path.is_file():
        raise MissingFile(f"{name}: no such asset of sart_toolkit; check the name")
    return path
