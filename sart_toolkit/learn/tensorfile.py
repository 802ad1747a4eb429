"""Tensors and one JSON object in a `.safetensors` file, written whole or not at all."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor

from sart_toolkit.data.storage import SCHEMA_VERSION, replacing
from sart_toolkit.errors import BrokenFile, CannotWrite, MissingFile

_KEY = "sart_toolkit"


def save_tensors(path: Path, tensors: Mapping[str, Tensor], about: Mapping[str, Any]) -> None:
    """Write tensors by name, and `about` as JSON in the file's header.

    Raises:
        CannotWrite: the disk refuses; `path` is as it was.
    """
    header = json.dumps({"schema_version": SCHEMA_VERSION, **about}, allow_nan=False)
    with replacing(path) as temporary:
        try:
            save_file(
                {name: tensor.detach().cpu().contiguous() for name, tensor in tensors.items()},
                temporary,
                metadata={_KEY: header},
            )
        except SafetensorError as error:
            raise CannotWrite(
                f"{path}: {error}; nothing was replaced, make room or choose another --out"
            ) from error


def load_tensors(path: Path) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """The tensors by name, on the CPU, and the JSON object that was saved with them.

    Raises:
        MissingFile: no such file.
        BrokenFile: truncated, not ours, or of a schema that this version doesn't know.
    """
    path = Path(path)
    if not path.is_file():
        raise MissingFile(f"{path}: no such file; check the path, or train again")
    try:
        with safe_open(path, "pt") as file:
            about = json.loads((file.metadata() or {})[_KEY])
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    except (SafetensorError, KeyError, ValueError, OSError) as error:
        raise BrokenFile(
            f"{path}: truncated or not a tensor file of ours ({error}); restore a copy or "
            "train again"
        ) from error
    version = about.pop("schema_version", None)
    if version != SCHEMA_VERSION:
        raise BrokenFile(
            f"{path}: schema_version is {version!r}, this version reads {SCHEMA_VERSION}; train "
            "again or use the toolkit version that wrote it"
        )
    return tensors, about
