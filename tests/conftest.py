"""One recorded peg-in-hole demonstration, its annotation and a small dataset, shared by all."""

from __future__ import annotations

import contextlib
import functools
import json
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Generator, Iterator
from dataclasses import replace
from importlib.util import find_spec
from typing import Any

import numpy as np
import pytest

from sart_toolkit.annotate.suggest import suggest_annotation
from sart_toolkit.augment.config import AugmentConfig
from sart_toolkit.augment.engine import augment_demonstration
from sart_toolkit.backends import make_backend
from sart_toolkit.backends.interface import Backend, CommandSent, KnowsBodies, Observation
from sart_toolkit.cli import main
from sart_toolkit.collision.exact import ExactWorld
from sart_toolkit.data.dataset import Dataset
from sart_toolkit.data.records import Annotation, Demonstration
from sart_toolkit.errors import MissingExtra
from sart_toolkit.poses import Array
from sart_toolkit.record.scripted import ScriptedOperator
from sart_toolkit.record.session import record_demonstration
from sart_toolkit.robots import get_robot
from sart_toolkit.robots.model import RobotModel
from sart_toolkit.tasks import get_task
from sart_toolkit.tasks.task import Placement, Task
from sart_toolkit.testing.browser import Browser, find_browser

IMAGE_SIZE = 48

# The files that take longest are begun first: at the end, one process would wait for another.
LONGEST = (
    "test_cli.py",
    "test_contract.py",
    "test_faults.py",
    "test_human_path.py",
    "test_task.py",
)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """The longest files first, then the order in which tests were found."""
    items.sort(key=lambda item: item.path.name not in LONGEST)


def _needs_pybullet() -> Generator[None, Any, Any]:
    """Skips where PyBullet has no wheel, as from Python 3.12 on."""
    try:
        return (yield)
    except MissingExtra as error:
        if find_spec("pybullet") is None and "pybullet" in str(error):
            pytest.skip(str(error))
        raise


@pytest.hookimpl(wrapper=True)
def pytest_runtest_setup() -> Generator[None, Any, Any]:
    return (yield from _needs_pybullet())


@pytest.hookimpl(wrapper=True)
def pytest_runtest_call() -> Generator[None, Any, Any]:
    return (yield from _needs_pybullet())


@pytest.fixture(scope="session", autouse=True)
def _interruptible() -> Iterator[None]:
    """Ctrl-C interrupts, also where the tests run in the background of a script."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.fixture(scope="session")
def wait_until() -> Callable[..., None]:
    """Returns once a condition holds; fails after 30 s, or what is given."""

    def wait(condition: Callable[[], bool], timeout_s: float = 30.0) -> None:
        deadline = time.monotonic() + timeout_s
        while not condition():
            assert time.monotonic() < deadline, f"not within {timeout_s:g} s"
            time.sleep(0.05)

    return wait


@pytest.fixture
def said(capsys: pytest.CaptureFixture[str]) -> Callable[..., Any]:
    """Types a `sart` command; the JSON object that it prints."""

    def said(*argv: object) -> Any:
        capsys.readouterr()
        main([*map(str, argv), "--json"])
        return json.loads(capsys.readouterr().out.strip().splitlines()[-1])

    return said


@pytest.fixture
def refused(capsys: pytest.CaptureFixture[str]) -> Callable[..., str]:
    """Types a `sart` command that is refused; the one line that it says."""

    def refused(*argv: object) -> str:
        capsys.readouterr()
        with pytest.raises(SystemExit) as exit_:
            main([str(word) for word in argv])
        assert exit_.value.code == 2
        (line,) = capsys.readouterr().err.strip().splitlines()
        return line

    return refused


@pytest.fixture
def free_port() -> int:
    """A port of this computer that nobody listens at."""
    with socket.create_server(("127.0.0.1", 0)) as found:
        return int(found.getsockname()[1])


@pytest.fixture
def serve(free_port: int) -> Iterator[Callable[..., Any]]:
    """Starts a `sart` command with --web; the program, once it has said where its page is."""
    pytest.importorskip("viser")
    programs = []

    def started(*argv: object) -> Any:
        command = [sys.executable, "-c", "from sart_toolkit.cli import main; main()"]
        command += [*map(str, argv), "--web", "--port", str(free_port), "--json"]
        program: Any = subprocess.Popen(
            command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
        )
        programs.append(program)
        program.said = next(line for line in program.stderr if "ssh" in line)
        program.url = f"http://127.0.0.1:{free_port}"
        return program

    yield started
    for program in programs:
        with contextlib.suppress(ProcessLookupError):
            program.kill()
        program.communicate()


@pytest.fixture
def browser() -> Iterator[Browser]:
    """A browser without a window."""
    try:
        find_browser()
    except MissingExtra as error:
        pytest.skip(str(error))
    pytest.importorskip("viser")
    with Browser(1400, 1200) as browser:
        yield browser


class _Limited(Backend):
    """The core of another backend."""

    def __init__(self, inner: Backend) -> None:
        super().__init__(inner.robot, inner.scene, inner.image_size, inner.rates)
        self.name, self.inner = "limited", inner

    def observe(self, *args: Any) -> Observation:
        seen = self.inner.observe(*args)
        return seen if isinstance(self, KnowsBodies) else replace(seen, Ts_world_body={})

    def command(self, q: Array, gripper: float) -> CommandSent:
        return self.inner.command(q, gripper)

    def step(self) -> None:
        self.inner.step()

    def close(self) -> None:
        self.inner.close()


@pytest.fixture(scope="session")
def limited() -> Callable[..., Backend]:
    """Makes a backend of another with only those abilities that are named."""

    def limit(inner: Backend, *abilities: type) -> Backend:
        def passed_on(name: str) -> Callable[..., Any]:
            return lambda self, *args: getattr(self.inner, name)(*args)

        names = {name for ability in abilities for name in ability.__abstractmethods__}
        return type("Limited", (_Limited, *abilities), {n: passed_on(n) for n in names})(inner)

    return limit


@pytest.fixture(scope="session")
def peg_task() -> Task:
    return get_task("peg_in_hole")


@pytest.fixture(scope="session")
def make_peg_backend(peg_task: Task) -> Callable[[], Backend]:
    """Makes the robot in the peg-in-hole scene; picklable."""
    robot = get_robot(peg_task.robot)
    return functools.partial(make_backend, "pybullet", robot, peg_task.scene, IMAGE_SIZE)


@pytest.fixture(scope="session")
def peg_model(peg_task: Task) -> RobotModel:
    return RobotModel(get_robot(peg_task.robot), peg_task.scene.held)


@pytest.fixture(scope="session")
def peg_backend(make_peg_backend: Callable[[], Backend]) -> Iterator[Backend]:
    """A backend for tests that begin with a reset or a restore."""
    backend = make_peg_backend()
    yield backend
    backend.close()


@pytest.fixture(scope="session")
def peg_demonstration(
    peg_task: Task, peg_model: RobotModel, make_peg_backend: Callable[[], Backend]
) -> Demonstration:
    """The scripted operator's demonstration with seed 0, the hole in the middle."""
    backend = make_peg_backend()
    plan = peg_task.plan(peg_task.initial_state(peg_model, Placement()))
    operator = ScriptedOperator(plan, np.random.default_rng(0))
    demonstration = record_demonstration(backend, peg_task, peg_model, operator, seed=0)
    backend.close()
    return demonstration


@pytest.fixture(scope="session")
def peg_world(peg_task: Task, peg_demonstration: Demonstration) -> ExactWorld:
    """Collision models of `peg_demonstration`'s waypoints."""
    return ExactWorld(peg_demonstration, get_robot(peg_task.robot), peg_task.scene)


@pytest.fixture(scope="session")
def peg_annotation(peg_demonstration: Demonstration, peg_world: ExactWorld) -> Annotation:
    """The spheres suggested for `peg_demonstration`."""
    return suggest_annotation(peg_demonstration, peg_world)


@pytest.fixture(scope="session")
def peg_dataset(
    peg_demonstration: Demonstration,
    peg_annotation: Annotation,
    make_peg_backend: Callable[[], Backend],
    tmp_path_factory: pytest.TempPathFactory,
) -> Dataset:
    """Five trajectories: the demonstration and four generated ones."""
    out = tmp_path_factory.mktemp("peg") / "dataset"
    return augment_demonstration(
        peg_demonstration, peg_annotation, make_peg_backend, out, AugmentConfig(n=5)
    )
