"""Each backend with each robot in each scene, or each task, as asked for on the command line."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from sart_toolkit.backends import BACKENDS, DEFAULT_BACKEND, get_backend
from sart_toolkit.backends.interface import KnowsBodies, Resets, SensesContacts
from sart_toolkit.errors import MissingExtra
from sart_toolkit.robots import USUAL_ROBOTS
from sart_toolkit.scenes.spec import SceneSpec
from sart_toolkit.tasks import TASKS
from sart_toolkit.testing.bench import Bench, make_bench
from sart_toolkit.testing.task_bench import TaskBench, make_task_bench

Make = Callable[..., Bench]

_OF_TASKS = "test_tasks.py"


def pytest_ignore_collect(collection_path: Path, config: pytest.Config) -> bool | None:
    """Leave out the tests of backends where tasks are asked for, and the other way round."""
    if not collection_path.name.startswith("test_"):
        return None
    tasks, backends, robots = (
        config.getoption(f"--sart-{kind}") for kind in ("task", "backend", "robot")
    )
    of_tasks = collection_path.name == _OF_TASKS
    wanted = of_tasks == bool(tasks) or not (tasks or backends or robots)
    return None if wanted else True


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    """Run a test with each backend and robot, or each task, named on the command line."""
    tasks, backends, robots = (
        metafunc.config.getoption(f"--sart-{kind}") for kind in ("task", "backend", "robot")
    )
    if "target" in metafunc.fixturenames:
        name = "target"
        targets = [
            (backend, robot) for backend in backends or BACKENDS for robot in robots or USUAL_ROBOTS
        ]
    elif "trial" in metafunc.fixturenames:
        name = "trial"
        targets = [
            (task, backend, *robot)
            for task in tasks or TASKS
            for backend in backends or (DEFAULT_BACKEND,)
            for robot in ([(robot,) for robot in robots] if robots else [()])
        ]
    else:
        return
    ids = ["-".join(target) for target in targets]
    metafunc.parametrize(name, targets, indirect=True, scope="session", ids=ids)


def _skip_what_is_not_installed(backend: str) -> None:
    try:
        get_backend(backend)
    except MissingExtra as error:
        pytest.skip(str(error))


@pytest.fixture(scope="session")
def target(request: pytest.FixtureRequest) -> tuple[str, str]:
    """The names of backend and robot."""
    backend, robot = request.param
    _skip_what_is_not_installed(backend)
    return backend, robot


@pytest.fixture(scope="session")
def trial(request: pytest.FixtureRequest) -> Iterator[TaskBench]:
    """A task on a backend, with its own robot or another."""
    task, backend, *robot = request.param
    _skip_what_is_not_installed(backend)
    trial = make_task_bench(task, backend, *robot)
    yield trial
    trial.backend.close()


@pytest.fixture(scope="session")
def _in_scene(target: tuple[str, str]) -> Iterator[Callable[[str], Bench]]:
    """Makes the bench in a scene when first asked for, and returns it reset."""
    made: dict[str, Bench] = {}

    def bench_in(scene: str) -> Bench:
        if scene not in made:
            made[scene] = make_bench(*target, scene)
        made[scene].reset()
        return made[scene]

    yield bench_in
    for bench in made.values():
        bench.backend.close()


@pytest.fixture
def bench(_in_scene: Callable[[str], Bench]) -> Bench:
    """A block that never moves under the tool, a stick in the gripper."""
    return _in_scene("plain")


@pytest.fixture
def loose(_in_scene: Callable[[str], Bench]) -> Bench:
    """A peg between the fingers and a brick, both free to move."""
    bench = _in_scene("loose")
    bench.needs(Resets, SensesContacts, KnowsBodies)
    return bench


@pytest.fixture
def jointed(_in_scene: Callable[[str], Bench]) -> Bench:
    """Hinges and slides of all sorts."""
    bench = _in_scene("jointed")
    bench.needs(Resets, SensesContacts, KnowsBodies)
    return bench


@pytest.fixture
def view(_in_scene: Callable[[str], Bench]) -> Bench:
    """Things to see."""
    bench = _in_scene("view")
    bench.needs_images()
    return bench


@pytest.fixture
def another(bench: Bench) -> Iterator[Make]:
    """Makes fresh benches of the same backend and robot, in the same scene or in a given one."""
    made: list[Bench] = []

    def make(scene: SceneSpec | None = None) -> Bench:
        made.append(make_bench(bench.backend_name, bench.robot_name, scene=scene))
        return made[-1]

    yield make
    for each in made:
        each.backend.close()
