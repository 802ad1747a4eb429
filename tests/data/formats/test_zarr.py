"""The replay buffer that Diffusion Policy reads."""

from __future__ import annotations

import json
import shutil
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sart_toolkit.data.formats import zarr
from sart_toolkit.data.formats.format import about_dataset
from sart_toolkit.data.formats.zarr import ZarrReplayBuffer


@pytest.fixture
def copy(exported: Callable[[str], Path], tmp_path: Path) -> Path:
    return Path(shutil.copytree(exported("zarr"), tmp_path / "copy.zarr"))


def array(root: Path, name: str) -> np.ndarray:
    """A whole array, by the specification of Zarr's format 2: chunks are filled up beyond its end.

    Written here anew, so that it isn't our own writer that is believed.
    """
    about = json.loads((root / name / ".zarray").read_text())
    assert about["zarr_format"] == 2 and about["order"] == "C" and about["filters"] is None
    assert about["compressor"]["id"] == "zlib"
    n, rows = about["shape"][0], about["chunks"][0]
    assert about["chunks"][1:] == about["shape"][1:]
    parts = []
    for i in range(-(-n // rows)):
        key = ".".join([str(i), *["0"] * (len(about["shape"]) - 1)])
        content = zlib.decompress((root / name / key).read_bytes())
        parts.append(np.frombuffer(content, about["dtype"]).reshape(about["chunks"]))
    return np.concatenate(parts)[:n]


@pytest.mark.parametrize("chunk_bytes", [None, 100_000])
def test_arrays_are_the_trajectories_one_after_the_other(
    chunk_bytes, trajectories, peg_dataset, tmp_path, monkeypatch
):
    if chunk_bytes is not None:
        monkeypatch.setattr(zarr, "_CHUNK_BYTES", chunk_bytes)
    root = tmp_path / "a.zarr"
    ZarrReplayBuffer().write(root, trajectories, about_dataset(peg_dataset))
    lengths = [len(trajectory) for trajectory in trajectories]
    assert array(root, "meta/episode_ends").tolist() == np.cumsum(lengths).tolist()
    for name, parts in {
        "action": [t.actions.astype(np.float32) for t in trajectories],
        "gripper": [t.steps.measured_gripper[:, None].astype(np.float32) for t in trajectories],
        "wrist_rgb": [t.steps.cameras["wrist"].rgb for t in trajectories],
        "wrist_depth": [t.steps.cameras["wrist"].depth for t in trajectories],
    }.items():
        assert np.array_equal(array(root, f"data/{name}"), np.concatenate(parts)), name
    for group in (".", "data", "meta"):
        assert json.loads((root / group / ".zgroup").read_text()) == {"zarr_format": 2}
    attributes = json.loads((root / ".zattrs").read_text())
    assert attributes["fps"] == 10 and attributes["action_names"][6] == "gripper"
    assert "tool pose commanded for t+1" in attributes["sart"]["conventions"]["action"]
    assert ZarrReplayBuffer().problems(root) == []


def change(root: Path, name: str, **values: Any) -> None:
    path = root / name
    path.write_text(json.dumps(json.loads(path.read_text()) | values))


def put_ends(root: Path, ends: list[int]) -> None:
    rows = json.loads((root / "meta/episode_ends/.zarray").read_text())["chunks"][0]
    chunk = np.zeros(rows, np.int64)
    chunk[: len(ends)] = ends
    (root / "meta/episode_ends/0").write_bytes(zlib.compress(chunk.tobytes()))


def put_nan(root: Path) -> None:
    path = root / "data/action/0.0"
    chunk = np.frombuffer(zlib.decompress(path.read_bytes()), np.float32).copy()
    chunk[5] = np.nan
    path.write_bytes(zlib.compress(chunk.tobytes()))


MUTATIONS: dict[str, tuple[Callable[[Path], object], str]] = {
    "no ends": (
        lambda root: shutil.rmtree(root / "meta/episode_ends"),
        "meta/episode_ends: no such array",
    ),
    "ends that don't increase": (
        lambda root: put_ends(root, [40, 30, 90, 120, 160]),
        "meta/episode_ends: expected numbers > 0 that increase, got [40, 30",
    ),
    "ends before the last row": (
        lambda root: put_ends(root, [40, 70, 90, 120, 160]),
        "data/action: has ",
    ),
    "a chunk that is missing": (
        lambda root: (root / "data/action/0.0").unlink(),
        "data/action/0.0: no such chunk",
    ),
    "a chunk that is damaged": (
        lambda root: (root / "data/action/0.0").write_bytes(b"nothing"),
        "data/action/0.0: can't be unpacked",
    ),
    "a chunk that is too small": (
        lambda root: (root / "data/action/0.0").write_bytes(zlib.compress(b"nothing")),
        "data/action/0.0: has 7 bytes, expected ",
    ),
    "another format": (
        lambda root: change(root, ".zgroup", zarr_format=3),
        ".zgroup: zarr_format is 3, expected 2",
    ),
    "a description that is wrong": (
        lambda root: change(root, "data/action/.zarray", dtype="floaty"),
        "data/action/.zarray: dtype, shape or chunks are missing or wrong",
    ),
    "a number that is none": (put_nan, "data/action/0.0: has NaN or infinite values"),
    "no groups": (lambda root: (root / "data/.zgroup").unlink(), "data/.zgroup: no such file"),
}


@pytest.mark.parametrize("name", MUTATIONS)
def test_what_a_reader_fails_on_is_found(name, copy):
    mutate, complaint = MUTATIONS[name]
    mutate(copy)
    found = ZarrReplayBuffer().problems(copy)
    assert found and found[0].startswith(complaint), found


def test_others_compressors_are_theirs_to_check(copy):
    """A buffer of Diffusion Policy's own is packed by Blosc, which isn't unpacked here."""
    change(copy, "data/action/.zarray", compressor={"id": "blosc", "cname": "lz4"})
    assert ZarrReplayBuffer().problems(copy) == []
    change(copy, "meta/episode_ends/.zarray", compressor={"id": "blosc", "cname": "lz4"})
    (line,) = ZarrReplayBuffer().problems(copy)
    assert line == "meta/episode_ends: packed in a way that isn't read here"
