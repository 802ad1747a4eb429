"""Every backend with every robot, in a scene laid out around wherever that robot's tool is."""

from __future__ import annotations

import contextlib
import hashlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

import numpy as np
import pytest

from sart_toolkit.backends import BACKENDS, make_backend
from sart_toolkit.backends.interface import Backend, Contact, Observation
from sart_toolkit.errors import MissingExtra
from sart_toolkit.poses import Array, interpolate, pose
from sart_toolkit.robots import ROBOTS, get_robot
from sart_toolkit.robots.model import RobotModel
from sart_toolkit.robots.spec import Attachment, CameraSpec, RobotSpec, Shape, look_at
from sart_toolkit.scene.spec import Body, SceneSpec, SceneState

BLOCK_TOP = 0.04
STICK_TIP = 0.06
GRIPPER = 0.5


def make_scene(robot: RobotSpec) -> SceneSpec:
    """A table, a block under the tool at home, a red ball beside it, a stick in the gripper.

    Specks that collide with nothing sit on the finger pads, so that the linkage can be observed.
    """
    x, y, _ = RobotModel(robot).fk(robot.home)[:3, 3]
    up = np.array([0.0, 0.0, 1.0])
    at = np.array([x, y, 0.0])
    speck = Shape("box", (0.002, 0.002, 0.002), collides=False)
    return SceneSpec(
        bodies=(
            Body("table", (Shape("box", (2.4, 2.4, 0.1), pose([0.5, 0, -0.05]), (0, 0, 0.9, 1)),)),
            Body(
                "block",
                (Shape("box", (0.06, 0.06, BLOCK_TOP), pose([0, 0, BLOCK_TOP / 2])),),
                pose([x, y, 0.0]),
            ),
            Body(
                "ball",
                (Shape("sphere", (0.015,), rgba=(1, 0, 0, 1)),),
                pose([x + 0.06, y - 0.1, 0.02]),
            ),
        ),
        held=(
            Attachment(
                "stick",
                robot.tool_frame,
                (Shape("box", (0.02, 0.02, 0.08)),),
                pose([0, 0, STICK_TIP - 0.04]),
            ),
            *(
                Attachment(f"speck{i}", link, (speck,), mass=0.001)
                for i, link in enumerate(robot.gripper.finger_links)
            ),
        ),
        cameras=(
            CameraSpec("side", "world", look_at(at + [0.3, -0.5, 0.4], at, up), 45.0, 0.05, 5.0),
            CameraSpec("sky", "world", look_at(at + [1.5, 0, 2], at + [1.5, 0.1, 3], up), 45.0),
        ),
    )


@dataclass
class Bench:
    """A backend in its test scene, and the ways in which the tests drive it."""

    backend: Backend
    scene: SceneSpec
    model: RobotModel
    home: SceneState
    q: Array = field(default_factory=lambda: np.zeros(0))

    def needs(self, capability: str) -> None:
        """Skip the test where the backend declares that it lacks a capability."""
        if not getattr(self.backend.capabilities, capability):
            pytest.skip(f"backend {self.backend.name!r} has no {capability}")

    def reset(self, q: Array | None = None, gripper: float = GRIPPER) -> SceneState:
        self.q = np.array(self.home.q if q is None else q)
        state = self.scene.initial_state(self.q, gripper)
        self.backend.reset(state)
        return state

    def command(self, q: Array, gripper: float = GRIPPER) -> list[Contact]:
        self.q = np.array(q)
        self.backend.command(q, gripper)
        self.backend.step()
        return self.backend.contacts()

    def move_tool(self, p: Array, periods: int = 20) -> list[Contact]:
        """All contacts on the tool's straight way to `p (3,)` [m]."""
        start = self.model.fk(self.q)
        goal = start.copy()
        goal[:3, 3] = p
        found = []
        for i in range(periods):
            q = self.model.ik(interpolate(start, goal, (i + 1) / periods), self.q)
            found += self.command(q)
        return found

    def above_block(self, gap: float) -> Array:
        """The tool position `(3,)` at which the stick's tip is `gap` [m] above the block."""
        p = self.model.fk(self.home.q)[:3, 3].copy()
        p[2] = BLOCK_TOP + STICK_TIP + gap
        return p

    def digest(self, cameras: tuple[str, ...] = ("wrist",)) -> str:
        """What is observed now, to the bit."""
        return observation_digest(self.backend.observe(cameras))

    def continuation(self, periods: int = 5) -> list[object]:
        """What is observed and touched, to the bit, while the tool turns a joint and presses on."""
        seen: list[object] = [self.digest()]
        q = self.backend.observe().q
        for i in range(1, periods + 1):
            touched = self.command(q + 0.004 * i * np.cos(np.arange(len(q))), GRIPPER + 0.01 * i)
            seen += [self.digest(("wrist",) if i == periods else ()), touched]
        return seen


def observation_digest(observation: Observation) -> str:
    sha = hashlib.sha256()
    parts = [
        observation.q,
        observation.dq,
        np.array([observation.gripper, observation.time]),
        observation.T_world_tool,
    ]
    parts += [T for _, T in sorted(observation.Ts_world_body.items())]
    for _, view in sorted(observation.cameras.items()):
        parts += [view.rgb, view.depth, view.T_world_camera]
    for part in parts:
        sha.update(np.ascontiguousarray(part).tobytes())
    return sha.hexdigest()


def make_bench(backend_name: str, robot_name: str, image_size: int = 64) -> Bench:
    robot = get_robot(robot_name)
    scene = make_scene(robot)
    try:
        backend = make_backend(backend_name, robot, scene, image_size)
    except MissingExtra as error:
        pytest.skip(str(error))
    home = scene.initial_state(robot.home, GRIPPER)
    return Bench(backend, scene, RobotModel(robot, scene.held), home, np.array(robot.home))


PAIRS = [(backend, robot) for backend in BACKENDS for robot in ROBOTS]


@pytest.fixture(scope="module", params=PAIRS, ids="-".join)
def _bench(request: pytest.FixtureRequest) -> Iterator[Bench]:
    bench = make_bench(*request.param)
    yield bench
    bench.backend.close()


@pytest.fixture
def bench(_bench: Bench) -> Bench:
    """Each backend with each robot, at rest at home."""
    _bench.reset()
    return _bench


@pytest.fixture(scope="module")
def benches() -> Iterator[list[Bench]]:
    """All benches at once: hypothesis wants fixtures that live as long as the whole test."""
    made = []
    for pair in PAIRS:
        with contextlib.suppress(pytest.skip.Exception):
            made.append(make_bench(*pair))
    yield made
    for bench in made:
        bench.backend.close()


@pytest.fixture
def another(bench: Bench) -> Iterator[Callable[[], Bench]]:
    """Makes fresh benches of the same backend and robot."""
    made = []

    def make(image_size: int = 64) -> Bench:
        made.append(make_bench(bench.backend.name, bench.backend.robot.name, image_size))
        return made[-1]

    yield make
    for each in made:
        each.backend.close()
