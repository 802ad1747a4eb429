"""What is not ours, named from another folder, goes through every verb and the Python API."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

import sart_toolkit as sart
from sart_toolkit import pipeline
from sart_toolkit.cli import main
from sart_toolkit.data.storage import load_demonstration, read_json, write_json
from sart_toolkit.errors import BrokenFile, InvalidInput, Mismatch, MissingFile, UnknownName

MINE = """
import dataclasses
import sart_toolkit as sart
from sart_toolkit.backends.pybullet import PyBulletBackend
from sart_toolkit.learn.policies.compact_mlp import CompactMLP
from sart_toolkit.tasks.peg_in_hole import PegInHole

ROBOT = dataclasses.replace(sart.get_robot("ur5e_2f85"), name="mine")


class Drawer(PegInHole):
    name = "drawer"
    robot = "my_things.py:ROBOT"


class Simulator(PyBulletBackend):
    name = "simulator"


class Inside(sart.Strategy):
    def propose(self, demonstration, spheres, i, rng, config):
        t_star = sart.convergence_waypoint(demonstration, spheres[i])
        return sart.Proposal(t_star, sart.sample_pose(spheres[i], rng, config))


INSIDE = Inside()


class MyPolicy(CompactMLP):
    pass


def operator(setup):
    return sart.ScriptedOperator(setup.task.plan(setup.state), setup.rng)
"""


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A folder with things of one's own, and what the verbs up to `train` made of them there."""
    folder = tmp_path_factory.mktemp("elsewhere")
    (folder / "my_things.py").write_text(MINE)
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        patch.setattr(sys, "path", list(sys.path))
        for command in (
            "record my_things.py:Drawer --backend my_things.py:Simulator --image-size 32 "
            "--device my_things.py:operator --out demo.h5",
            "suggest demo.h5 --out spheres.json",
            "augment demo.h5 spheres.json --out data --n 4 --workers 2 "
            "--strategy my_things.py:INSIDE",
            "train data --out skill --policy my_things.py:MyPolicy --epochs 1 --device cpu",
        ):
            main([*command.split(), "--json"])
    return folder


@pytest.fixture
def there(made, monkeypatch):
    monkeypatch.chdir(made)
    monkeypatch.setattr(sys, "path", list(sys.path))
    return made


NOTED = {
    "task": "my_things.py:Drawer",
    "robot": "my_things.py:ROBOT",
    "backend": "my_things.py:Simulator",
}


def test_each_file_notes_what_it_was_made_with(there):
    assert load_demonstration(there / "demo.h5").references == NOTED
    assert load_demonstration(there / "data" / "sources" / "demo00" / "demo.h5").references == NOTED
    info = read_json(there / "data" / "dataset.json", dict)
    assert info["references"] == NOTED
    assert info["config"]["strategy"] == "my_things.py:INSIDE"
    config = read_json(there / "skill" / "config.json", dict)
    assert config["references"] == NOTED
    assert config["training"]["policy"] == "my_things.py:MyPolicy"


def test_later_verbs_find_it_again(there, tmp_path, said):
    assert said("validate", "data")["episodes"] == 3
    result = said("evaluate", "skill", "--out", tmp_path / "e.json", "--episodes", 2,
        "--workers", 2, "--videos", 0,
    )  # fmt: skip
    assert (result["task"], result["backend"]) == ("drawer", "simulator")
    argv = ["annotate", "demo.h5", "--suggest-all", "--no-window", "--out", tmp_path / "a.json"]
    assert said(*argv)["saved"]
    film = ["play", "demo.h5", "--out", tmp_path / "film.mp4", "--speed", 4]
    assert said(*film)["kind"] == "demonstration"
    again = "augment demo.h5 spheres.json --out data --n 4 --strategy my_things.py:INSIDE"
    assert said(*again.split())["n_kept"] == 3


def test_elsewhere_it_says_what_is_missing_and_takes_another(
    there, tmp_path, monkeypatch, said, refused
):
    monkeypatch.chdir(tmp_path)
    argv = ["suggest", there / "demo.h5", "--out", tmp_path / "a.json"]
    line = refused(*argv)
    assert "robot 'my_things.py:ROBOT': no file my_things.py from" in line
    assert "it is what the recording notes: name another with --robot REF" in line
    mine = there / "my_things.py"
    argv += ["--robot", f"{mine}:ROBOT"]
    assert "name another with --task REF" in refused(*argv)
    assert said(*argv, "--task", f"{mine}:Drawer")["spheres"]
    line = refused("evaluate", there / "skill", "--out", tmp_path / "e.json")
    assert "policy 'my_things.py:MyPolicy': no file my_things.py from" in line


def test_what_is_given_in_place_of_the_noted_is_noted_from_then_on(there, tmp_path, said):
    argv = "augment demo.h5 spheres.json --n 2 --task peg_in_hole --out"
    said(*argv.split(), tmp_path / "data")
    noted = load_demonstration(tmp_path / "data" / "sources" / "demo00" / "demo.h5").references
    assert noted == {**NOTED, "task": "peg_in_hole"}


def test_a_skill_runs_on_what_it_notes_or_on_what_is_given(there):
    rollout = sart.run_skill("skill", seed=3)
    assert rollout == sart.run_skill(Path("skill"), seed=3, backend="pybullet")
    steps = []
    placed = sart.Placement(0.01, 0.0)
    seen = sart.run_skill(
        "skill", placement=placed, robot="ur5e_2f85", task="peg_in_hole",
        watch=lambda image, step, success: steps.append(step),
    )  # fmt: skip
    assert seen.placement == placed and len(steps) == seen.steps + 1
    with pytest.raises(MissingFile, match="no such skill directory"):
        sart.run_skill("nowhere")


def test_a_whole_run_takes_objects_and_resumes(there, tmp_path, caplog):
    mine = sart.get_task("my_things.py:Drawer")
    given = {
        "robot": sart.get_robot("my_things.py:ROBOT"),
        "backend": sart.get_backend("my_things.py:Simulator"),
        "n": 3, "episodes": 1, "epochs": 1, "image_size": 32, "device": "cpu",
    }  # fmt: skip
    heard = set()
    caplog.set_level("INFO", "sart_toolkit.pipeline")
    result = sart.run(mine, tmp_path / "run", **given, progress=lambda stage, *_: heard.add(stage))
    assert heard == {"record", "suggest", "augment", "read", "train", "evaluate"}
    assert result["task"] == "drawer" and result["kept"] == 2
    config = read_json(tmp_path / "run" / "run.json", dict)["config"]
    assert {kind: config[kind] for kind in NOTED} == NOTED
    (tmp_path / "run" / "evaluation.json").unlink()
    caplog.clear()
    # The same, given by reference.
    given |= {"robot": "my_things.py:ROBOT", "backend": "my_things.py:Simulator"}
    sart.run("my_things.py:Drawer", tmp_path / "run", **given)
    said = [record.message for record in caplog.records if record.levelname == "INFO"]
    assert [message.split()[0] for message in said] == [
        "record", "suggest", "augment", "train", "evaluate",
    ]  # fmt: skip
    assert sum("done before" in record.message for record in caplog.records) == 4
    with pytest.raises(Mismatch, match="holds a run with another n;"):
        sart.run("my_things.py:Drawer", tmp_path / "run", **given | {"n": 4})


@pytest.mark.parametrize(
    "state",
    [
        {},
        {"config": {}},
        {"config": [], "stages": {}},
        {"config": {}, "stages": {"record": "long"}},
        {"config": {}, "stages": [1.0]},
    ],
)
def test_a_run_whose_state_makes_no_sense_is_refused(tmp_path, state):
    write_json(tmp_path / "run.json", state)
    before = (tmp_path / "run.json").read_bytes()
    with pytest.raises(BrokenFile, match=r"run.json: a field is missing or wrong"):
        sart.run("peg_in_hole", tmp_path)
    assert (tmp_path / "run.json").read_bytes() == before


def test_what_cannot_work_is_said_before_anything_is_written(there, tmp_path):
    out = tmp_path / "x"
    for options, error, message in (
        ({"policy": "compact"}, UnknownName, "did you mean 'compact_mlp'"),
        ({"backend": "my_things.py:Drawer"}, UnknownName, "expected a subclass of Backend"),
        ({"image_size": 8}, InvalidInput, "image_size: expected at least 16 pixels, got 8"),
        ({"n": 1}, InvalidInput, "at least 1, and fewer than the 1 trajectories, got 1"),
        ({"episodes": 0}, InvalidInput, "episodes: expected at least 1"),
        ({"distribution": "arae"}, UnknownName, "did you mean 'area'"),
    ):
        with pytest.raises(error, match=message):
            sart.run("peg_in_hole", out, **options)
    with pytest.raises(InvalidInput, match="device 'keyboard': is for a person's hands"):
        pipeline.record("peg_in_hole", out, device="keyboard")
    with pytest.raises(MissingFile, match="pass one that `sart run` wrote"):
        pipeline.report(out)
    assert not out.exists()
