"""A name, what a module or a file holds, an entry point or the object itself: one lookup."""

from __future__ import annotations

import dataclasses
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from sart_toolkit import registry
from sart_toolkit.augment import STRATEGIES, get_strategy
from sart_toolkit.augment.config import AugmentConfig
from sart_toolkit.augment.strategies import SART, SphereStrategy
from sart_toolkit.backends import BACKENDS, get_backend, make_backend
from sart_toolkit.backends.pybullet import PyBulletBackend
from sart_toolkit.errors import InvalidInput, MissingExtra, UnknownName
from sart_toolkit.learn.policies import POLICIES, get_policy
from sart_toolkit.learn.training import TrainConfig
from sart_toolkit.record.devices import DEVICES, make_device
from sart_toolkit.registry import check_known, lasting_reference, reference_to, resolve
from sart_toolkit.robots import ROBOTS, get_robot
from sart_toolkit.tasks import TASKS, get_task
from sart_toolkit.tasks.peg_in_hole import PegInHole

MINE = """
import dataclasses
from sart_toolkit.backends.pybullet import PyBulletBackend
from sart_toolkit.learn.policies.compact_mlp import CompactMLP
from sart_toolkit.augment.strategies import SphereStrategy
from sart_toolkit.robots import get_robot
from sart_toolkit.tasks.peg_in_hole import PegInHole

class Drawer(PegInHole):
    name = "drawer"

class Deep(PegInHole):
    def __init__(self, depth):
        self.depth = depth

DEEP = Deep(0.2)
PANDA = dataclasses.replace(get_robot("ur5e_2f85"), name="panda")

class Mine(PyBulletBackend):
    name = "mine"

class MyPolicy(CompactMLP):
    pass

INSIDE = SphereStrategy()
NUMBER = 3
"""


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The current folder, with a file and a module of its own that hold one of each kind."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", list(sys.path))
    (tmp_path / "mine.py").write_text(MINE)
    module = f"mine_{tmp_path.name}".replace("-", "_")
    (tmp_path / f"{module}.py").write_text(MINE)
    return tmp_path


def module_of(folder: Path) -> str:
    return next(path.stem for path in folder.glob("mine_*.py"))


LOOKUPS: dict[str, tuple[Callable[[str], object], str]] = {
    "robot": (get_robot, "PANDA"),
    "task": (get_task, "Drawer"),
    "backend": (get_backend, "Mine"),
    "strategy": (get_strategy, "INSIDE"),
    "policy": (get_policy, "MyPolicy"),
}
TABLES = {
    "robot": ROBOTS,
    "task": TASKS,
    "backend": BACKENDS,
    "strategy": STRATEGIES,
    "policy": POLICIES,
    "device": DEVICES,
}


@pytest.mark.parametrize("kind", LOOKUPS)
def test_a_file_s_and_a_module_s_objects_are_found_and_named_again(folder, kind):
    get, name = LOOKUPS[kind]
    for place in ("mine.py", module_of(folder)):
        reference = f"{place}:{name}"
        found = get(reference)
        assert reference_to(kind, found, TABLES[kind]) == reference
        assert get(found) is found
    assert type(get(f"mine.py:{name}")) is type(get(f"mine.py:{name}"))


@pytest.mark.parametrize("kind", TABLES)
def test_what_a_table_names_is_named_so(kind):
    for name in TABLES[kind]:
        found = resolve(kind, name, TABLES[kind])
        assert reference_to(kind, found, TABLES[kind]) == name
    assert reference_to("task", get_task("lid_closing"), TASKS) == "lid_closing"
    assert reference_to(kind, "as it is", TABLES[kind]) == "as it is"


def test_an_instance_with_arguments_is_named_where_a_module_has_it(folder):
    deep = get_task("mine.py:DEEP")
    assert deep.depth == 0.2
    assert reference_to("task", deep, TASKS) == "mine.py:DEEP"
    assert reference_to("task", type(deep)(0.3), TASKS) is None


def test_what_is_inside_a_function_has_no_reference():
    class Local(PegInHole):
        pass

    class LocalStrategy(SphereStrategy):
        pass

    assert reference_to("task", Local(), TASKS) is None
    with pytest.raises(InvalidInput, match="strategy: no file could name this LocalStrategy"):
        lasting_reference("strategy", LocalStrategy(), STRATEGIES)
    with pytest.raises(InvalidInput, match="no file could name"):
        AugmentConfig(strategy=LocalStrategy())


def test_configurations_keep_the_reference_of_an_object(folder):
    assert AugmentConfig(strategy=get_strategy("mine.py:INSIDE")).strategy == "mine.py:INSIDE"
    assert AugmentConfig(strategy=SART).strategy == "sart"
    config = TrainConfig.for_policy(get_policy("mine.py:MyPolicy"))
    assert config.policy == "mine.py:MyPolicy"
    assert TrainConfig.from_json(config.to_json()) == config


def test_a_table_s_module_that_lacks_its_library_is_an_import_error(folder, monkeypatch):
    monkeypatch.syspath_prepend(folder)
    (folder / "lacking.py").write_text("import no_such_library\n")
    with pytest.raises(ImportError, match="no_such_library"):
        resolve("backend", "ours", {"ours": "lacking:Ours"})


@pytest.mark.parametrize(
    ("reference", "message"),
    [
        ("peg_in_hol", "unknown task 'peg_in_hol': did you mean 'peg_in_hole'?.*file.py:NAME"),
        ("mine.py:Drower", "mine.py has no 'Drower'; did you mean 'Drawer'"),
        ("mine.py:zzz", "mine.py has no 'zzz'; check the name after the colon"),
        ("mine.py:Drawer.name.x", "mine.py has no 'Drawer.name.x'"),
        ("nowhere.py:Drawer", "no file nowhere.py from"),
        ("no_such_module:Drawer", "no module 'no_such_module', neither installed nor in"),
        ("json.no_such_module:Drawer", "no module 'json.no_such_module'"),
        (".:Drawer", "no module '.'"),
        ("mine.py", "says no name in the file; add :NAME"),
        (":Drawer", "expected package.module:NAME or path/to/file.py:NAME"),
        ("mine.py:", "expected package.module:NAME or path/to/file.py:NAME"),
        ("mine.py:NUMBER", "task 'mine.py:NUMBER': expected a Task, got int"),
        ("mine.py:PANDA", "expected a Task, got RobotSpec"),
        ("mine.py:Mine", "expected a Task, got the class Mine"),
        ("mine.py:Deep", "task Deep: can't be made without arguments"),
        ("broken.py:X", "running broken.py fails in broken.py, line 2: NameError: .*nothing"),
        ("wanting.py:X", "running wanting.py fails .*ModuleNotFoundError.*no_such_module"),
    ],
)
def test_a_reference_that_leads_nowhere_says_which_part_failed(folder, reference, message):
    (folder / "broken.py").write_text("x = 1\nnothing\n")
    (folder / "wanting.py").write_text("import no_such_module\n")
    with pytest.raises(UnknownName, match=message):
        get_task(reference)


def test_what_is_of_another_kind_is_refused(folder):
    with pytest.raises(UnknownName, match="robot 'mine.py:Drawer': expected a RobotSpec"):
        get_robot("mine.py:Drawer")
    with pytest.raises(UnknownName, match="backend 'mine.py:Drawer': expected a subclass of Back"):
        get_backend("mine.py:Drawer")
    with pytest.raises(UnknownName, match="policy: expected a subclass of Policy, got int"):
        get_policy(3)
    with pytest.raises(UnknownName, match="strategy: expected a Strategy, got the class"):
        get_strategy(PegInHole)
    with pytest.raises(UnknownName, match="device 'mine.py:NUMBER': expected a Device, got int"):
        make_device("mine.py:NUMBER", None)
    with pytest.raises(UnknownName, match="did you mean 'pybullet'"):
        make_backend("pybulet", None, None)
    for kind, table in TABLES.items():
        with pytest.raises(UnknownName, match=f"unknown {kind} 'zzz': choose from"):
            resolve(kind, "zzz", table)


def test_the_toolkit_s_own_errors_pass_through_a_reference(folder):
    (folder / "needy.py").write_text(
        "from sart_toolkit.errors import MissingExtra\nraise MissingExtra('pip install it')\n"
    )
    with pytest.raises(MissingExtra, match="pip install it"):
        get_task("needy.py:X")


def test_an_installed_entry_point_is_found_and_named_again(folder, monkeypatch):
    about = folder / "site" / "robots_of_mine-1.dist-info"
    about.mkdir(parents=True)
    (about / "METADATA").write_text("Metadata-Version: 2.1\nName: robots_of_mine\nVersion: 1\n")
    (about / "entry_points.txt").write_text(
        f"[sart_toolkit.robots]\nmy_panda = {module_of(folder)}:PANDA\n"
        f"[sart_toolkit.policies]\nmy_policy = {module_of(folder)}:MyPolicy\n"
    )
    monkeypatch.syspath_prepend(folder / "site")
    monkeypatch.syspath_prepend(folder)
    check_known("robot", "my_panda", ROBOTS)
    assert get_robot("my_panda").name == "panda"
    assert reference_to("robot", get_robot("my_panda"), ROBOTS) == "my_panda"
    assert get_policy("my_policy").__name__ == "MyPolicy"
    with pytest.raises(UnknownName, match="did you mean 'my_panda'.*ur5e_2f85"):
        get_robot("my_pandas")


def test_checking_a_name_runs_nobody_s_code(folder):
    (folder / "loud.py").write_text("raise SystemExit('loud')")
    check_known("task", "loud.py:Drawer", TASKS)
    check_known("task", "loud:Drawer", TASKS)
    check_known("task", PegInHole, TASKS)
    check_known("task", "peg_in_hole", TASKS)
    assert "loud" not in sys.modules


def test_objects_of_the_running_script_are_named_by_its_file_and_not_made_twice(folder):
    script = folder / "script.py"
    script.write_text(
        "import sys\n"
        "from sart_toolkit.registry import reference_to\n"
        "from sart_toolkit.robots import ROBOTS, get_robot\n"
        "from sart_toolkit.tasks import TASKS, get_task\n"
        f"from {module_of(folder)} import PANDA, PegInHole\n"
        "class Drawer(PegInHole):\n    pass\n"
        "OWN = get_robot('ur5e_hande').__class__(**vars(PANDA))\n"
        "if __name__ == '__main__':\n"
        "    print(reference_to('robot', PANDA, ROBOTS))\n"
        "    print(reference_to('robot', OWN, ROBOTS))\n"
        "    print(reference_to('task', Drawer(), TASKS))\n"
        "    assert type(get_task('script.py:Drawer')) is Drawer\n"
    )
    run = [sys.executable, "script.py"]
    said = subprocess.run(run, cwd=folder, capture_output=True, text=True, check=True).stdout
    assert said.split() == [f"{module_of(folder)}:PANDA", "script.py:OWN", "script.py:Drawer"]
    run = [sys.executable, "-m", "script"]
    said = subprocess.run(run, cwd=folder, capture_output=True, text=True, check=True).stdout
    assert said.split() == [f"{module_of(folder)}:PANDA", "script:OWN", "script:Drawer"]
    run = [sys.executable, "-c", (script.read_text().rpartition("    assert")[0])]
    said = subprocess.run(run, cwd=folder, capture_output=True, text=True, check=True).stdout
    assert said.split() == [f"{module_of(folder)}:PANDA", "None", "None"]


def test_a_changed_copy_of_a_robot_has_no_reference():
    changed = dataclasses.replace(get_robot("ur5e_2f85"), tool_frame="tip")
    assert reference_to("robot", changed, ROBOTS) is None
    assert PyBulletBackend is registry.resolve("backend", PyBulletBackend, BACKENDS)
