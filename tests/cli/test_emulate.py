"""`sart emulate`: a cell that every command takes as it takes a real one's."""

from __future__ import annotations

import dataclasses
import re
import sys

import numpy as np
import pytest

from sart_toolkit.backends import get_backend
from sart_toolkit.backends.interface import Attended, Guides, SensesForce
from sart_toolkit.data.storage import load_demonstration, save_demonstration
from sart_toolkit.errors import InvalidInput, Mismatch
from sart_toolkit.hardware.cell import Control, load_cell
from sart_toolkit.robots import get_robot
from sart_toolkit.tasks import get_task
from sart_toolkit.tasks.task import Placement
from sart_toolkit.testing.emulated import TaskWorld


@pytest.fixture
def cell(tmp_path, said):
    """Where the file of an emulated cell is, written with the flags given."""

    def write(*flags, task="peg_in_hole", name="cell.toml"):
        out = tmp_path / name
        said("emulate", task, "--out", out, "--image-height", 48, *flags)
        return out

    return write


@pytest.fixture
def made(request):
    """Backends of emulated cells, closed at the end."""

    def make(path, task="peg_in_hole"):
        kind, found = get_backend(str(path)), get_task(task)
        backend = kind(get_robot(load_cell(path).robot), found.scene, 32)
        request.addfinalizer(backend.close)
        return backend

    return make


def test_what_is_given_is_what_its_file_says_and_its_world_does(cell, made):
    path = cell(
        "--latency", 0.2, "--lag", 0.1, "--hand-eye-error", "4,0.5", "--seed", 3,
        "--speed-scale", 0.5, "--placement", "0.02,-0.03,10", "--sensor", "d435",
    )  # fmt: skip
    found = load_cell(path)
    assert found.limits.speed_scale == 0.5 and found.cameras["wrist"].hand_eye_mm == 4.0
    backend = made(path)
    it = backend._parts.world.emulation
    assert (it.latency, it.lag, it.seed, it.sensor.hand_eye) == (0.2, 0.1, 3, 0.004)
    assert it.sensor.flying == 0.02
    for ability in (SensesForce, Guides, Attended):
        assert isinstance(backend, ability)
    backend.command(backend.observe().q, 0.67)
    for _ in range(30):
        backend.step()
    backend.observe(("wrist",))
    assert 0.18 < backend.delays["wrist"] < 0.3
    task = get_task("peg_in_hole")
    middle = task.initial_state(backend._model, Placement()).Ts_world_body[task.report_body]
    there = backend._parts.world.observe().Ts_world_body[task.report_body]
    np.testing.assert_allclose((there - middle)[:2, 3], [0.02, -0.03], atol=1e-6)


def test_the_comments_of_its_file_are_in_one_column(cell):
    lines = cell().read_text().splitlines()
    settings = [line for line in lines if re.search(r"\S +# ", line) and line[:3] != "# A"]
    assert len(settings) > 15 and {line.rindex("# ") for line in settings} == {32}


def test_a_world_goes_with_the_backend_that_made_it(cell, made):
    path = cell()
    backend = made(path)
    with pytest.raises(InvalidInput, match="world 'emulated': is open already"):
        made(path)
    backend.close()
    assert "rtde_control" not in sys.modules or sys.modules["rtde_control"].__file__
    made(path)


def test_what_a_person_is_asked_to_is_done_by_itself(cell, made):
    """Bodies go back to the start; the robot stays where it is."""
    path = cell(task="toolbox_picking")
    backend = made(path, "toolbox_picking")
    world = backend._parts.world
    before = world.observe()
    moved = {name: T.copy() for name, T in before.Ts_world_body.items()}
    moved["toolbox"][0, 3] += 0.05
    world.put_back(dataclasses.replace(world._start, Ts_world_body=moved))
    assert world.observe().Ts_world_body["toolbox"][0, 3] > moved["toolbox"][0, 3] - 0.01
    q = world.q.copy()
    backend.ask("Put the scene back")
    np.testing.assert_allclose(
        world.observe().Ts_world_body["toolbox"], before.Ts_world_body["toolbox"], atol=2e-3
    )
    np.testing.assert_array_equal(world.q, q)


@pytest.mark.render
def test_sapien_simulates_it_as_well(cell, made):
    pytest.importorskip("sapien")
    backend = made(cell("--simulator", "sapien"))
    q = backend.observe().q
    for _ in range(10):
        backend.command(q, 0.67)
        backend.step()
    assert backend.observe(("wrist",)).cameras["wrist"].rgb.any()


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        (["--placement", "1,2"], "placement: expected shape"),
        (["--placement", "a,b,c"], "--placement: expected X,Y,DEG as in"),
        (["--hand-eye-error", "2"], "--hand-eye-error: expected millimetres and degrees"),
        (["--hand-eye-error", "2000,0"], "hand_eye: expected a number from 0"),
        (["--lag", "0"], "lag: expected a finite number > 0"),
        (["--robot", "ur55"], "unknown robot 'ur55'"),
        (["--hand", "nowhere.h5"], "nowhere.h5: no such file"),
    ],
)
def test_what_can_t_be_emulated_is_refused_and_nothing_written(refused, tmp_path, flags, message):
    out = tmp_path / "cell.toml"
    assert message in refused("emulate", "peg_in_hole", "--out", out, *flags)
    assert not out.exists()


def test_its_file_is_a_toml_file_and_not_replaced_unasked(refused, tmp_path, cell):
    said = refused("emulate", "peg_in_hole", "--out", tmp_path / "cell.json")
    assert "expected a file that ends with .toml" in said
    path = cell()
    assert "pass --overwrite" in refused("emulate", "peg_in_hole", "--out", path)


def test_a_cell_in_a_world_is_moved_by_this_process(cell):
    found = load_cell(cell())
    with pytest.raises(InvalidInput, match=r"\[control\] process: expected false"):
        dataclasses.replace(found, control=Control(125))


def test_a_hand_of_another_robot_is_refused(tmp_path, peg_demonstration):
    path = tmp_path / "demo.h5"
    save_demonstration(path, dataclasses.replace(peg_demonstration, robot="panda"))
    with pytest.raises(Mismatch, match="is of robot 'panda', expected 'ur5e_2f85'"):
        TaskWorld("ur5e_2f85", 125, "peg_in_hole", hand=str(path))


@pytest.mark.slow
def test_the_whole_chain_is_typed_with_nobody_at_the_terminal(cell, said, tmp_path, monkeypatch):
    """As `sart emulate --help` and docs/real_robot.md have it, in small."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys.stdin, "isatty", lambda: False, raising=False)
    path = cell()
    assert said("doctor", "--cell", path)["usable"]
    said("record", "peg_in_hole", "--backend", path, "--image-size", 32, "--out", "demo.h5")
    assert load_demonstration(tmp_path / "demo.h5").backend == "hardware"
    cloud = ("--source", "cloud", "--sensor", "d405")
    said("suggest", "demo.h5", *cloud, "--out", "annotation.json")
    found = said("augment", "demo.h5", "annotation.json", *cloud, "--out", "dataset", "--n", 2)
    assert found["n_trajectories"] == 2
    said("train", "dataset", "--out", "skill", "--epochs", 1)
    done = said("deploy", "skill", "--backend", path, "--unattended", "--max-seconds", 1)
    assert done["steps"] == 10 and done["farthest_mm"] > 0
    guided = cell("--hand", "demo.h5", name="guided.toml")
    assert said("doctor", "--cell", guided)["usable"]
