"""Objects arrive on a machine that has none of the files, and results bring theirs back."""

from __future__ import annotations

import dataclasses
import functools
import os
import pickle
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from sart_toolkit.data.assets import asset
from sart_toolkit.errors import InvalidInput, Mismatch
from sart_toolkit.registry import resolve
from sart_toolkit.robots import get_robot
from sart_toolkit.workers.parcels import Home, Output, Parcel, pack, unpack

# The other machine: a process that unpacks a worker and packs what it makes of the items.
_NODE = """
import pickle, sys
from pathlib import Path
from sart_toolkit.workers.parcels import arrive, pack, unpack
home, work, items = pickle.loads(Path(sys.argv[1]).read_bytes())
arrive(home, Path("copies"), bytes)
worker = unpack(work)()
results = [pack(worker(unpack(item)), outputs=work.outputs) for item in items]
Path(sys.argv[2]).write_bytes(pickle.dumps(results))
"""

Elsewhere = Callable[..., list[Any]]


@pytest.fixture
def home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The current folder of the machine that sends."""
    folder = tmp_path / "home"
    folder.mkdir()
    monkeypatch.chdir(folder)
    monkeypatch.syspath_prepend(str(folder))
    return folder


@pytest.fixture
def elsewhere(home: Path, tmp_path: Path) -> Elsewhere:
    """The parcels of what a worker makes of items where nothing of `home` exists."""

    def carried_out(make_worker: Callable[[], Any], *items: Any) -> list[Any]:
        parcels = pack(Home()), pack(make_worker), [pack(item) for item in items]
        (tmp_path / "there").write_bytes(pickle.dumps(parcels))
        home.rename(tmp_path / "away")
        node = tmp_path / "node"
        node.mkdir()
        try:
            words = [sys.executable, "-c", _NODE, tmp_path / "there", tmp_path / "back"]
            environment = {**os.environ, "PYTHONPATH": str(Path(__file__).parents[2])}
            subprocess.run(words, cwd=node, env=environment, check=True)
        finally:
            (tmp_path / "away").rename(home)
        results: list[Any] = pickle.loads((tmp_path / "back").read_bytes())  # noqa: S301 - ours
        return results

    return carried_out


_OWN = """
from pathlib import Path
from own_helper import shout
from sart_toolkit.registry import resolve

class Reader:
    def __init__(self, folder, out, reference):
        self.folder, self.out = folder, out.path
        self.other = resolve("task", reference, {})

    def __call__(self, name):
        found = self.folder / name
        text = found.read_text()
        (self.out / "sub").mkdir(exist_ok=True)
        (self.out / "sub" / found.name).write_text(shout(text))
        beside = Path(__file__).with_name("beside.txt")
        return self.out / "sub", str(found), self.other.TOLD, beside.exists()
"""


def test_a_persons_modules_and_files_arrive_and_results_bring_files_back(
    home: Path, elsewhere: Elsewhere
) -> None:
    (home / "own_helper.py").write_text("def shout(text):\n    return text.upper()\n")
    (home / "own.py").write_text(_OWN)
    (home / "other.py").write_text("class Other:\n    TOLD = 'other'\n")
    (home / "beside.txt").write_text("not named by anything that is sent")
    (home / "data" / "deep").mkdir(parents=True)
    (home / "data" / "a.txt").write_text("a")
    (home / "data" / "deep" / "b.txt").write_text("b")
    reader = resolve("task", "own.py:Reader", {})
    resolve("task", str(home / "other.py") + ":Other", {})
    for reference in ("other.py:Other", f"{home}/other.py:Other"):
        work = functools.partial(reader, Path("data"), Output(home / "out"), reference)
        parcels = elsewhere(work, "a.txt", Path("deep/b.txt"))
        for parcel, name in zip(parcels, ("a.txt", "b.txt"), strict=True):
            folder, found, told, beside = unpack(parcel, outputs=[home / "out"])
            assert folder == home / "out" / "sub"
            assert (folder / name).read_text() == name[0].upper()
            assert not Path(found).is_relative_to(home) and Path(found).name == name
            assert told == "other" and not beside
        (home.parent / "node").rename(home.parent / f"node{len(reference)}")


_SCRIPT = """
import pickle, sys
from sart_toolkit.workers.parcels import Home, pack

class Doubler:
    def __call__(self, item):
        return 2 * item

if __name__ == "__main__":
    sys.stdout.buffer.write(pickle.dumps((pack(Home()), pack(Doubler))))
"""


def test_a_class_of_the_running_script_arrives(home: Path, tmp_path: Path) -> None:
    (home / "script.py").write_text(_SCRIPT)
    environment = {**os.environ, "PYTHONPATH": str(Path(__file__).parents[2])}
    words = [sys.executable, "script.py"]
    sent = subprocess.run(words, env=environment, check=True, capture_output=True).stdout
    parcels = *pickle.loads(sent), [pack(21)]  # noqa: S301 - ours
    (tmp_path / "there").write_bytes(pickle.dumps(parcels))
    (home / "script.py").unlink()
    words = [sys.executable, "-c", _NODE, str(tmp_path / "there"), str(tmp_path / "back")]
    subprocess.run(words, env=environment, check=True, cwd=tmp_path)
    (parcel,) = pickle.loads((tmp_path / "back").read_bytes())  # noqa: S301 - ours
    assert unpack(parcel) == 42


def test_assets_of_the_toolkit_stay_where_they_are() -> None:
    parcel = pack([asset("peg_in_hole/demo.h5")])
    assert not parcel.files and unpack(parcel) == [asset("peg_in_hole/demo.h5")]


def test_a_robots_own_urdf_and_meshes_go_along(home: Path) -> None:
    robot = home / "robot"
    (robot / "meshes").mkdir(parents=True)
    (robot / "meshes" / "link.stl").write_text("a mesh")
    (robot / "meshes" / "other.stl").write_text("of no link")
    (robot / "arm.urdf").write_text(
        '<robot name="arm"><link name="base"><visual><geometry>'
        '<mesh filename="meshes/link.stl"/></geometry></visual></link></robot>'
    )
    spec = dataclasses.replace(get_robot("ur5e_2f85"), urdf="robot/arm.urdf")
    parcel = pack({"robot": spec})
    assert set(parcel.files) == {str(robot / "arm.urdf"), str(robot / "meshes" / "link.stl")}


def test_the_current_folder_is_not_sent(home: Path) -> None:
    with pytest.raises(InvalidInput, match="holds the current folder, too much to send"):
        pack([home.parent])


def test_a_result_writes_only_where_work_goes_to(home: Path) -> None:
    stray = Parcel(pickle.dumps(None), {str(home / "notes.txt"): b"other words"}, frozenset())
    with pytest.raises(Mismatch, match=r"notes\.txt: a worker sent it"):
        unpack(stray, outputs=[home / "out"])
    assert not (home / "notes.txt").exists()


def test_the_file_that_was_made_last_is_written_last(home: Path) -> None:
    out = home / "out"
    out.mkdir()
    for at, name in enumerate(("weights", "a_table", "config.json")):
        (out / name).write_text(name)
        os.utime(out / name, (1000 + at, 1000 + at))
    parcel = pack(out, outputs=[out])
    assert [Path(name).name for name in parcel.files] == ["weights", "a_table", "config.json"]
