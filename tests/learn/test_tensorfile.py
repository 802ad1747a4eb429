import json
import resource
import subprocess
import sys

import pytest
import torch
from safetensors.torch import save_file

from sart_toolkit.data.storage import SCHEMA_VERSION
from sart_toolkit.errors import BrokenFile, CannotWrite, MissingFile
from sart_toolkit.learn.tensorfile import load_tensors, save_tensors


def test_tensors_and_header_survive_whatever_their_layout(tmp_path):
    tensors = {
        "weight": torch.randn(4, 3, 5, 5).to(memory_format=torch.channels_last),
        "half": torch.randn(3).bfloat16(),
        "count": torch.tensor(7),
    }
    save_tensors(tmp_path / "a.safetensors", tensors, {"curve": [1.5, 2]})
    found, about = load_tensors(tmp_path / "a.safetensors")
    assert about == {"curve": [1.5, 2]}
    assert found.keys() == tensors.keys()
    assert all(torch.equal(found[name], tensors[name]) for name in tensors)
    assert [path.name for path in tmp_path.iterdir()] == ["a.safetensors"]


def test_a_missing_file_is_refused(tmp_path):
    with pytest.raises(MissingFile, match="no such file; check the path, or train again"):
        load_tensors(tmp_path / "a.safetensors")


@pytest.mark.parametrize("keep", [0, 5, 150, -1])
def test_a_truncated_file_is_refused(tmp_path, keep):
    path = tmp_path / "a.safetensors"
    save_tensors(path, {"weight": torch.zeros(100)}, {})
    path.write_bytes(path.read_bytes()[:keep])
    with pytest.raises(BrokenFile, match="truncated or not a tensor file of ours"):
        load_tensors(path)


def test_someone_elses_file_is_refused(tmp_path):
    save_file({"weight": torch.zeros(3)}, tmp_path / "a.safetensors")
    with pytest.raises(BrokenFile, match="truncated or not a tensor file of ours"):
        load_tensors(tmp_path / "a.safetensors")


def test_another_schema_is_refused(tmp_path):
    header = {"sart_toolkit": json.dumps({"schema_version": 99})}
    save_file({"weight": torch.zeros(3)}, tmp_path / "a.safetensors", metadata=header)
    expected = f"schema_version is 99, this version reads {SCHEMA_VERSION}"
    with pytest.raises(BrokenFile, match=expected):
        load_tensors(tmp_path / "a.safetensors")


def test_a_disk_that_refuses_leaves_what_was_there(tmp_path):
    (tmp_path / "file").write_text("kept")
    with pytest.raises(CannotWrite, match="file"):
        save_tensors(tmp_path / "file" / "a.safetensors", {"a": torch.zeros(1)}, {})
    assert (tmp_path / "file").read_text() == "kept"


def test_a_disk_that_fills_up_is_an_error_of_ours_and_leaves_the_old_file(tmp_path):
    path = tmp_path / "x.safetensors"
    save_tensors(path, {"w": torch.zeros(50_000)}, {"n": 1})
    before = path.read_bytes()
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (len(before) // 2, hard))
    try:
        with pytest.raises(CannotWrite, match=r"x.safetensors: .*; nothing was replaced, make roo"):
            save_tensors(path, {"w": torch.ones(50_000)}, {"n": 2})
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert path.read_bytes() == before and [p.name for p in tmp_path.iterdir()] == [path.name]


def test_the_same_tensors_give_the_same_bytes(tmp_path):
    """In every process: the order of what a header holds must not be left to chance."""
    code = (
        "import sys, torch; from pathlib import Path\n"
        "from sart_toolkit.learn.tensorfile import save_tensors\n"
        "save_tensors(Path(sys.argv[1]), {'a': torch.ones(3), 'b': torch.zeros(2)}, {'n': 1})"
    )
    contents = set()
    for i in range(4):
        path = tmp_path / f"{i}.safetensors"
        subprocess.run([sys.executable, "-c", code, str(path)], check=True)
        contents.add(path.read_bytes())
    assert len(contents) == 1
