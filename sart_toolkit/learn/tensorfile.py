"""Tensors and one JSON object in a `.safetensors` file, written whole or not at all.

The file's header holds a SHA-256 of all that is in it, compared when it is read: one bit of a
weight that flips is felt late, or never.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor

from sart_toolkit.data.storage import SCHEMA_VERSION, check_schema, parse_json, replacing
from sart_toolkit.errors import BrokenFile, CannotWrite, MissingFile

_KEY = "sart_toolkit"
# The largest header that is read: a hundred thousand tensors.
_MAX_HEADER_BYTES = 16 * 2**20


def tensors_digest(tensors: Mapping[str, Tensor], about: str = "") -> str:
    """A SHA-256 hex digest of tensors by name, with their types and shapes, and of a text."""
    sha = hashlib.sha256(json.dumps(about).encode())
    for name in sorted(tensors):
        tensor = tensors[name].detach().cpu().contiguous()
        sha.update(json.dumps([name, str(tensor.dtype), list(tensor.shape)]).encode())
        # A tensor without dimensions has no view as bytes.
        sha.update(tensor.reshape(-1).view(torch.uint8).numpy().data)
    return sha.hexdigest()


def _sealed(tensors: Mapping[str, Tensor], about: Mapping[str, Any]) -> str:
    return tensors_digest(tensors, json.dumps(dict(about), sort_keys=True, allow_nan=False))


def save_tensors(path: Path, tensors: Mapping[str, Tensor], about: Mapping[str, Any]) -> None:
    """Write tensors by name, and `about` as JSON in the file's header.

    Raises:
        CannotWrite: the disk refuses; `path` is as it was.
    """
    tensors = {name: tensor.detach().cpu().contiguous() for name, tensor in tensors.items()}
    header = {"schema_version": SCHEMA_VERSION, **about, "sha256": _sealed(tensors, about)}
    # One entry: those of several would stand in another order each time.
    metadata = {_KEY: json.dumps(header, allow_nan=False)}
    with replacing(path) as temporary:
        try:
            save_file(tensors, temporary, metadata=metadata)
        except SafetensorError as error:
            raise CannotWrite(
                f"{path}: {error}; nothing was replaced, make room or choose another --out"
            ) from error


def load_tensors(path: Path) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """The tensors by name, on the CPU, and the JSON object that was saved with them.

    Raises:
        MissingFile: no such file.
        BrokenFile: truncated, not ours, changed since it was written, or of a schema that this
            version doesn't know.
    """
    path = Path(path)
    if not path.is_file():
        raise MissingFile(f"{path}: no such file; check the path, or train again")
    try:
        _check_header(path)
        with safe_open(path, "pt") as file:
            about = parse_json((file.metadata() or {})[_KEY].encode(), str(path))
            if not isinstance(about, dict):
                raise ValueError("its header holds no JSON object")
            check_schema(path, about.pop("schema_version", None))
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
        sha256 = about.pop("sha256", None)
        found = _sealed(tensors, about)
    except BrokenFile:
        raise
    except (
        SafetensorError, LookupError, ValueError, TypeError, OSError, RuntimeError, MemoryError
    ) as error:  # fmt: skip
        raise BrokenFile(
            f"{path}: truncated or not a tensor file of ours ({error}); restore a copy or "
            "train again"
        ) from error
    if found != sha256:
        raise BrokenFile(f"{path}: content differs from its hash; restore a copy or train again")
    return tensors, about


def _check_header(path: Path) -> None:
    with open(path, "rb") as file:
        n = int.from_bytes(file.read(8), "little")
    if n > min(_MAX_HEADER_BYTES, path.stat().st_size - 8):
        raise ValueError(f"declares a header of {n} bytes")
