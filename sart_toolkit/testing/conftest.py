"""Each backend with each robot in each scene, as asked for on the command line."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import pytest

from sart_toolkit.backends import BACKENDS, get_backend
from sart_toolkit.backends.interface import KnowsBodies, Resets, SensesContacts
from sart_toolkit.errors import MissingExtra
from sart_toolkit.robots import USUAL_ROBOTS
from sart_toolkit.scenes.spec import SceneSpec
from sart_toolkit.testing.bench import Bench, make_bench

Make = Callable[..., Bench]


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    """Run a test that uses a bench with each backend and robot named on the command line."""
    if "target" not in metafunc.fixturenames:
        return
    backends = metafunc.config.getoption("--sart-backend") or list(BACKENDS)
    robots = metafunc.config.getoption("--sart-robot") or list(USUAL_ROBOTS)
    targets = [(backend, robot) for backend in backends for robot in robots]
    metafunc.parametrize(
        "target", targets, indirect=True, scope="session", ids=["-".join(t) for t in targets]
    )


@pytest.fixture(scope="session")
def target(request: pytest.FixtureRequest) -> tuple[str, str]:
    """The names of backend and robot."""
    backend, robot = request.param
    try:
        get_backend(backend)
    except MissingExtra as error:
        pytest.skip(str(error))
    return backend, robot


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
