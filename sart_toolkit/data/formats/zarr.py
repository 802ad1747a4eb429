"""A replay buffer as Diffusion Policy and UMI read it: a Zarr directory of format version 2.

`data/` holds every array, all trajectories one after the other, `meta/episode_ends` where each
ends. The format is plain enough to be written without the library.
"""

from __future__ import annotations

import itertools
import json
import math
import zlib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from isal import isal_zlib
from numpy.typing import NDArray

from sart_toolkit.data.formats.format import (
    ACTION_NAMES,
    POSE_NAMES,
    About,
    Format,
    Trajectory,
    all_problems,
    pose_rows,
)
from sart_toolkit.data.storage import parse_json
from sart_toolkit.errors import BrokenFile

# So large are the chunks that Diffusion Policy writes itself, uncompressed.
_CHUNK_BYTES = 2 * 2**20
_LEVEL = 1
_COMPRESSOR = {"id": "zlib", "level": _LEVEL}
_ENDS = "meta/episode_ends"


class ZarrReplayBuffer(Format):
    """Diffusion Policy's replay buffer, a directory."""

    name = "zarr"
    suffix = ".zarr"
    mark = ".zgroup"

    def write(self, path: Path, trajectories: Iterable[Trajectory], about: About) -> None:
        arrays: dict[str, _Array] = {}
        ends: list[int] = []
        told = []
        for trajectory in trajectories:
            for name, rows in _rows_of(trajectory, about).items():
                if name not in arrays:
                    arrays[name] = _Array(path / "data" / name, rows)
                arrays[name].add(rows)
            ends.append((ends[-1] if ends else 0) + len(trajectory))
            told.append({"name": trajectory.name, **trajectory.provenance})
        last = _Array(path / _ENDS, np.array(ends, dtype=np.int64))
        last.add(np.array(ends, dtype=np.int64))
        for array in (*arrays.values(), last):
            array.finish()
        for group in ("data", "meta", "."):
            _write(path / group / ".zgroup", {"zarr_format": 2})
        _write(
            path / ".zattrs",
            {
                "instruction": about.instruction,
                "fps": about.hz,
                "action_names": ACTION_NAMES,
                "pose_names": POSE_NAMES,
                "joint_names": about.joint_names,
                "sart": about.sart,
            },
        )
        # Grows with the trajectories: beside the arrays, where no reader of theirs opens it.
        _write(path / "sart_episodes.json", {"episodes": told})

    def problems(self, path: Path) -> Sequence[str]:
        return all_problems(_problems(Path(path)))


def _rows_of(trajectory: Trajectory, about: About) -> dict[str, NDArray[Any]]:
    """A trajectory's arrays by name, a row for each step."""
    steps = trajectory.steps
    numbers = {
        "action": trajectory.actions,
        "gripper": steps.measured_gripper[:, None],
        "commanded_gripper": steps.commanded_gripper[:, None],
        "joint_positions": steps.joint_positions,
        "joint_velocities": steps.joint_velocities,
        "tool_pose": pose_rows(steps.measured_Ts_world_tool),
        "commanded_tool_pose": pose_rows(steps.commanded_Ts_world_tool),
    }
    found: dict[str, NDArray[Any]] = {
        name: rows.astype(np.float32) for name, rows in numbers.items()
    }
    for name, camera in steps.cameras.items():
        found[f"{name}_rgb"] = camera.rgb
        if about.depth:
            found[f"{name}_depth"] = camera.depth
    return found


class _Array:
    """An array written from its first row to its last; one chunk is in memory."""

    def __init__(self, path: Path, like: NDArray[Any]) -> None:
        """An array of rows as those of `like`."""
        self._path, self._dtype, self._row = path, like.dtype, like.shape[1:]
        row_bytes = like.dtype.itemsize * math.prod(self._row)
        self._rows = max(1, _CHUNK_BYTES // row_bytes)
        self._waiting: list[NDArray[Any]] = []
        self._n = self._n_written = 0
        path.mkdir(parents=True)

    def add(self, rows: NDArray[Any]) -> None:
        """Add rows at the end."""
        self._waiting.append(rows)
        self._n += len(rows)
        while self._n - self._n_written >= self._rows:
            self._write_chunk()

    def _write_chunk(self) -> None:
        """Write a whole chunk; what is beyond the last row is zeros."""
        rows = np.concatenate(self._waiting)
        now, rest = rows[: self._rows], rows[self._rows :]
        chunk = np.zeros((self._rows, *self._row), self._dtype)
        chunk[: len(now)] = now
        number = self._n_written // self._rows
        key = ".".join(map(str, (number, *(0 for _ in self._row))))
        packed = isal_zlib.compress(chunk, _LEVEL)
        (self._path / key).write_bytes(packed)
        self._n_written += len(now)
        # A copy, so that what is written goes from memory.
        self._waiting = [rest.copy()]

    def finish(self) -> None:
        """Write what is left, and the description."""
        if self._n > self._n_written:
            self._write_chunk()
        _write(
            self._path / ".zarray",
            {
                "zarr_format": 2,
                "shape": [self._n, *self._row],
                "chunks": [self._rows, *self._row],
                "dtype": self._dtype.str,
                "compressor": _COMPRESSOR,
                "fill_value": 0,
                "filters": None,
                "order": "C",
            },
        )


def _write(path: Path, value: Mapping[str, Any]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(value, indent=4, allow_nan=False) + "\n")


# --- checking -----------------------------------------------------------------------------------


def _problems(root: Path) -> Iterator[str]:
    for group in (".", "data", "meta"):
        about = Path(group) / ".zgroup"
        if not (root / about).exists():
            yield f"{about}: no such file"
        elif (version := _json(root, about).get("zarr_format")) != 2:
            yield f"{about}: zarr_format is {version!r}, expected 2"
    if not (root / _ENDS / ".zarray").exists():
        yield f"{_ENDS}: no such array"
        return
    ends_about = _json(root, Path(_ENDS) / ".zarray")
    wrong = list(_array_problems(root, _ENDS, ends_about))
    yield from wrong
    if wrong:
        return
    ends = _read(root, _ENDS, ends_about)
    if ends.ndim != 1 or ends.dtype.kind not in "iu" or not len(ends):
        yield f"{_ENDS}: expected whole numbers, one for each trajectory"
        return
    if (np.diff(ends, prepend=0) <= 0).any():
        yield f"{_ENDS}: expected numbers > 0 that increase, got {ends[:5].tolist()}"
        return
    names = sorted(path.parent.name for path in root.glob("data/*/.zarray"))
    if not names:
        yield "data: has no array"
    for name in names:
        described = _json(root, Path("data") / name / ".zarray")
        wrong = list(_array_problems(root, f"data/{name}", described))
        yield from wrong
        if not wrong and described["shape"][0] != ends[-1]:
            n = described["shape"][0]
            yield f"data/{name}: has {n} rows, the last of {_ENDS} is {int(ends[-1])}"
        if not wrong and np.dtype(described["dtype"]).kind == "f":
            for key, chunk in _chunks(root, f"data/{name}", described):
                if not np.isfinite(chunk).all():
                    yield f"data/{name}/{key}: has NaN or infinite values"
                    break


def _json(root: Path, name: Path) -> dict[str, Any]:
    try:
        value = parse_json((root / name).read_bytes(), str(name))
    except OSError as error:
        raise BrokenFile(f"{name}: {error.strerror}") from error
    if not isinstance(value, dict):
        raise BrokenFile(f"{name}: expected a JSON object")
    return value


def _array_problems(root: Path, name: str, about: Mapping[str, Any]) -> Iterator[str]:
    try:
        dtype = np.dtype(about["dtype"])
        shape, chunks = (list(map(int, about[key])) for key in ("shape", "chunks"))
    except (KeyError, TypeError, ValueError) as error:
        yield f"{name}/.zarray: dtype, shape or chunks are missing or wrong ({error})"
        return
    if about.get("zarr_format") != 2 or len(shape) != len(chunks) or min(chunks, default=0) < 1:
        yield f"{name}/.zarray: expected zarr_format 2 and as many chunk sizes > 0 as axes"
        return
    if about.get("compressor") not in (None, _COMPRESSOR) or about.get("filters"):
        # Others' compressors are theirs to check.
        return
    wanted = dtype.itemsize * math.prod(chunks)
    for key in _chunk_keys(shape, chunks):
        path = root / name / key
        if not path.exists():
            yield f"{name}/{key}: no such chunk"
            continue
        packed = path.read_bytes()
        try:
            content = packed if about["compressor"] is None else zlib.decompress(packed)
        except zlib.error as error:
            yield f"{name}/{key}: can't be unpacked ({error})"
            continue
        if len(content) != wanted:
            yield f"{name}/{key}: has {len(content)} bytes, expected {wanted}"


def _chunk_keys(shape: Sequence[int], chunks: Sequence[int]) -> Iterator[str]:
    counts = [math.ceil(n / chunk) for n, chunk in zip(shape, chunks, strict=True)]
    for index in itertools.product(*map(range, counts)):
        yield ".".join(map(str, index))


def _chunks(root: Path, name: str, about: Mapping[str, Any]) -> Iterator[tuple[str, NDArray[Any]]]:
    """The chunks of an array by their keys; none where it isn't packed as ours are."""
    if about.get("compressor") not in (None, _COMPRESSOR) or about.get("filters"):
        return
    for key in _chunk_keys(about["shape"], about["chunks"]):
        content = (root / name / key).read_bytes()
        if about["compressor"] is not None:
            content = zlib.decompress(content)
        yield key, np.frombuffer(content, about["dtype"]).reshape(about["chunks"])


def _read(root: Path, name: str, about: Mapping[str, Any]) -> NDArray[Any]:
    """An array of one axis."""
    parts = [chunk for _, chunk in _chunks(root, name, about)]
    if not parts:
        raise BrokenFile(f"{name}: packed in a way that isn't read here")
    return np.concatenate(parts)[: about["shape"][0]]
