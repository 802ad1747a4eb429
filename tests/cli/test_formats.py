"""`sart export`, `sart import` and `sart validate --format`."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import h5py
import numpy as np
import pytest

from sart_toolkit.data.formats import FORMATS, get_format
from sart_toolkit.data.formats.rmb import MAIN
from sart_toolkit.data.storage import load_demonstration, save_demonstration


@pytest.fixture
def demo(peg_demonstration, tmp_path: Path) -> Path:
    save_demonstration(tmp_path / "demo.h5", peg_demonstration)
    return tmp_path / "demo.h5"


@pytest.mark.parametrize("name", FORMATS)
def test_what_is_exported_validates(name, peg_dataset, tmp_path, said):
    out = tmp_path / f"peg{get_format(name).suffix}"
    written = said("export", peg_dataset.path, "--format", name, "--out", out)
    assert (written["trajectories"], written["format"]) == (5, name)
    assert written["instruction"].startswith("Lower a 3 cm square peg, fixed to the gripper")
    assert written["bytes"] > 10_000
    assert said("validate", out, "--format", name)["problems"] == 0


def test_a_damaged_export_is_refused_with_each_problem(peg_dataset, tmp_path, capsys, said):
    from sart_toolkit.cli import main

    said("export", peg_dataset.path, "--format", "lerobot", "--out", tmp_path / "out")
    info = tmp_path / "out" / "meta" / "info.json"
    info.write_text(json.dumps({**json.loads(info.read_text()), "total_frames": 3}))
    with pytest.raises(SystemExit):
        main(["validate", str(tmp_path / "out"), "--format", "lerobot"])
    lines = capsys.readouterr().err.strip().splitlines()
    assert lines[0].startswith("meta/info.json: total_frames is 3, meta/episodes has ")
    assert lines[-1].endswith("out: 1 problem(s) as lerobot; fix them or write it again")


def test_options_reach_the_export(demo, tmp_path, said):
    out = tmp_path / "a.hdf5"
    words = ("--instruction", "Put it in", "--no-depth")
    said("export", demo, "--format", "robomimic", "--out", out, *words)
    with h5py.File(out) as file:
        assert file["data"].attrs["instruction"] == "Put it in"
        assert "wrist_depth" not in file["data/demo_0/obs"]
    said("export", demo, "--format", "lerobot", "--out", tmp_path / "b")
    features = json.loads((tmp_path / "b/meta/info.json").read_text())["features"]
    assert features["observation.joint_positions"]["names"][0] == "shoulder_pan_joint"


def test_a_task_that_can_not_be_found_is_told_by_its_name(peg_demonstration, tmp_path, said):
    import dataclasses

    other = dataclasses.replace(
        peg_demonstration, task="turn_crank", references={"task": "gone.py:Crank"}
    )
    save_demonstration(tmp_path / "demo.h5", other)
    written = said("export", tmp_path / "demo.h5", "--format", "zarr", "--out", tmp_path / "a.zarr")
    assert written["instruction"] == "turn crank"


def test_what_was_exported_is_imported_again(demo, tmp_path, said, peg_demonstration):
    said("export", demo, "--format", "rmb", "--out", tmp_path / "recordings")
    (made,) = said("import", tmp_path / "recordings", "--out", tmp_path / "demos")["demonstrations"]
    single = said(
        "import", tmp_path / "recordings/peg_in_hole_0000.rmb", "--out", tmp_path / "one.h5"
    )
    assert single["demonstrations"] == [str(tmp_path / "one.h5")]
    for path in (made, tmp_path / "one.h5"):
        found = load_demonstration(Path(path))
        assert np.array_equal(found.steps.joint_positions, peg_demonstration.steps.joint_positions)
        assert (found.task, found.robot) == ("peg_in_hole", "ur5e_2f85") and found.success[-1]


def test_of_others_what_is_missing_is_asked_for_and_given(demo, tmp_path, said, refused):
    said("export", demo, "--format", "rmb", "--out", tmp_path / "recordings")
    recording = tmp_path / "recordings" / "peg_in_hole_0000.rmb"
    with h5py.File(recording / MAIN, "r+") as file:
        del file.attrs["sart"]
    command = ["import", recording, "--out", tmp_path / "a.h5"]
    assert "add --robot REF" in refused(*command)
    command += ["--robot", "ur5e_2f85", "--gripper-range", "0,1"]
    assert "add --task REF" in refused(*command)
    said(*command, "--task", "peg_in_hole")
    assert load_demonstration(tmp_path / "a.h5").references == {
        "task": "peg_in_hole",
        "robot": "ur5e_2f85",
    }


def test_mistakes_are_one_line(demo, tmp_path, refused, said):
    out = tmp_path / "out"
    assert "did you mean 'robomimic'" in refused(
        "export", demo, "--format", "robomimc", "--out", out
    )
    assert "ends in .zarr" in refused("export", demo, "--format", "zarr", "--out", out)
    assert "expected OPEN,CLOSED such as 0,255, got '3'" in refused(
        "import", demo, "--out", out, "--gripper-range", "3"
    )
    assert "holds no recording of" in refused("import", demo, "--out", out)
    assert "isn't imported" in refused("import", demo, "--out", out, "--format", "zarr")
    assert "--replay: is about datasets of ours" in refused(
        "validate", demo, "--format", "rmb", "--replay"
    )
    said("export", demo, "--format", "rmb", "--out", out)
    assert "already exists; add --overwrite" in refused(
        "export", demo, "--format", "rmb", "--out", out
    )
    shutil.copy(demo, tmp_path / "there.h5")
    assert "already exists; add --overwrite" in refused(
        "import", out, "--out", tmp_path / "there.h5"
    )
