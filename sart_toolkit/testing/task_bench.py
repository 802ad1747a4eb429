"""A task on a backend, and what came of its scripted operator, for the suite's tests of tasks."""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sart_toolkit.backends import make_backend
from sart_toolkit.backends.interface import (
    Backend,
    KnowsBodies,
    Observation,
    Resets,
    SensesContacts,
    missing_abilities,
    require,
)
from sart_toolkit.errors import MissingExtra, SartError, Unreachable
from sart_toolkit.poses import Array, distance
from sart_toolkit.record.scripted import ScriptedOperator
from sart_toolkit.record.session import SessionConfig, SessionState, TeleopSession
from sart_toolkit.robots import get_robot
from sart_toolkit.robots.model import RobotModel
from sart_toolkit.scenes.spec import SceneState
from sart_toolkit.tasks import get_task
from sart_toolkit.tasks.task import Placement, Task

try:
    import pytest
except ImportError as error:
    raise MissingExtra("pytest is missing; pip install 'sart_toolkit[testing]'") from error

IMAGE_SIZE = 64
_TESTED = "this is to be tested"
# The operator may go on for so much longer than a rollout, to tell what it needs.
_PATIENCE = 2.0
# How long the start is watched [s]; what rests stays within this [m], [deg].
_WATCHED = 0.5
_STILL, _STILL_DEG = 0.003, 2.0

_STARTS = "test_a_start_is_a_state_of_the_scene"
_REACHED = "test_the_robot_can_be_at_every_start"


@dataclass(frozen=True)
class Attempt:
    """What the scripted operator did: what was observed at each recorded step, and judged of it.

    `success (T,)`; `trouble`: why its last command could not be carried out; empty where it was.
    """

    seen: tuple[Observation, ...]
    success: NDArray[np.bool_]
    trouble: str


@dataclass(frozen=True)
class Rest:
    """What came of a start where nothing is commanded but the start itself.

    `touching`: pairs of names that touched; `moved`: how far [m] and [rad] each body did.
    """

    touching: frozenset[tuple[str, str]]
    moved: dict[str, tuple[float, float]]

    @property
    def restless(self) -> list[str]:
        """The bodies that didn't stay, each with how far it moved."""
        return [
            f"{name}: {1e3 * far:.1f} mm, {np.rad2deg(turn):.1f} deg"
            for name, (far, turn) in self.moved.items()
            if far > _STILL or turn > np.deg2rad(_STILL_DEG)
        ]


@dataclass
class TaskBench:
    """A task, its robot on a backend, and placements that it has to cope with.

    Attributes:
        placements: the middle, the corners, and the object turned either way.
    """

    task: Task
    backend: Backend
    model: RobotModel
    placements: tuple[Placement, ...]
    _kept: dict[Any, Any] = field(default_factory=dict, repr=False)

    def needs(self, *abilities: type) -> None:
        """Skip the test where the backend lacks an ability."""
        for name in missing_abilities(self.backend, abilities):
            pytest.skip(f"backend {self.backend.name!r} lacks {name}")

    def relies_on(self, holds: object, test: str) -> None:
        """Skip the test where it means nothing before another one passes."""
        if not holds:
            pytest.skip(f"not judged before {test} passes")

    def relies_on_starts(self) -> None:
        """Skip the test where not every start is one that the backend could be reset to."""
        self.relies_on(all(map(self.is_state, self.placements)), _STARTS)
        self.relies_on(all(map(self.is_reached, self.placements)), _REACHED)

    def start(self, placement: Placement) -> SceneState:
        """The start at a placement."""
        return self.task.initial_state(self.model, placement)

    def is_state(self, placement: Placement) -> bool:
        """Whether the start is a state of the scene; one that the robot can't reach may be."""
        return self._holds(("state", placement), lambda: self.check_state(placement))

    def is_reached(self, placement: Placement) -> bool:
        """Whether the robot can be where it is at the start."""
        return self._holds(("reached", placement), lambda: self.check_reached(placement))

    def check_state(self, placement: Placement) -> None:
        """Return if the start is a state of the scene; one out of the robot's reach isn't judged.

        Raises:
            SartError: it isn't.
        """
        with contextlib.suppress(Unreachable):
            self.task.scene.check_state(self.start(placement))

    def check_reached(self, placement: Placement) -> None:
        """Return if the robot can be where it is at the start; what is no start isn't judged.

        Raises:
            Unreachable: the task itself finds no joints for it.
            InvalidInput: joints of the wrong number or outside their limits.
        """
        try:
            q = self.start(placement).q
        except Unreachable:
            raise
        except SartError:
            return
        self.model.check_limits(q)

    def _holds(self, key: object, check: Callable[[], None]) -> bool:
        if key not in self._kept:
            try:
                check()
                self._kept[key] = True
            except SartError:
                self._kept[key] = False
        return bool(self._kept[key])

    def reset(self, placement: Placement) -> SceneState:
        """Reset the backend to the start, which is returned."""
        state = self.start(placement)
        require(self.backend, Resets, _TESTED).reset(state)
        return state

    def rest(self, placement: Placement) -> Rest:
        """What touches and moves at the start when nothing else is commanded."""
        self.needs(Resets, SensesContacts, KnowsBodies)
        self.relies_on_starts()
        key = ("rest", placement)
        if key not in self._kept:
            state = self.reset(placement)
            first = self.backend.observe().Ts_world_body
            touching: set[tuple[str, str]] = set()
            for _ in range(round(_WATCHED * self.backend.rates.control_hz)):
                self.backend.command(state.q, state.commanded_gripper)
                self.backend.step()
                contacts = require(self.backend, SensesContacts, _TESTED).contacts()
                touching |= {(contact.a, contact.b) for contact in contacts}
            last = self.backend.observe().Ts_world_body
            moved = {name: distance(first[name], T) for name, T in last.items()}
            self._kept[key] = Rest(frozenset(touching), moved)
        rest: Rest = self._kept[key]
        return rest

    def attempt(self, placement: Placement) -> Attempt:
        """What the scripted operator does at a placement."""
        self.needs(Resets, *self.task.observes)
        self.relies_on_starts()
        key = ("attempt", placement)
        if key not in self._kept:
            self._kept[key] = self._attempt(placement)
        attempt: Attempt = self._kept[key]
        return attempt

    def _attempt(self, placement: Placement) -> Attempt:
        plan = self.task.plan(self.start(placement))
        if not plan:
            pytest.skip("its plan has no step: only a person can do it")
        operator = ScriptedOperator(
            plan, np.random.default_rng(0), control_hz=self.backend.rates.control_hz
        )
        config = SessionConfig(
            cameras=(), keep_states=False, max_seconds=_PATIENCE * self.task.horizon + 10.0
        )
        session = TeleopSession(self.backend, self.task, self.model, placement, config)
        session.start()
        seen, success = [session.observation], [session.success]
        while session.state is SessionState.RECORDING:
            session.advance(operator.read(session.observation))
            if session.steps > len(seen):
                seen.append(session.observation)
                success.append(session.success)
        return Attempt(tuple(seen), np.array(success), session.trouble)

    def image(self, state: SceneState) -> Array:
        """What the robot's first camera sees of a state, `(H, W, 3)`."""
        require(self.backend, Resets, _TESTED).reset(state)
        camera = self.backend.robot.cameras[0].name
        return np.asarray(self.backend.observe((camera,)).cameras[camera].rgb, float)


def make_task_bench(task_name: str, backend_name: str, robot_name: str | None = None) -> TaskBench:
    """A task on a backend.

    Args:
        task_name: one of `TASKS` or a reference.
        backend_name: one of `BACKENDS` or a reference.
        robot_name: one of `ROBOTS` or a reference; the task's own if left out.
    """
    task = get_task(task_name)
    robot = get_robot(robot_name or task.robot)
    backend = make_backend(backend_name, robot, task.scene, IMAGE_SIZE)
    r, yaw = task.placement_range, task.yaw_range_deg
    placements = (
        Placement(),
        *(Placement(x, y) for x in (-r, r) for y in (-r, r)),
        *(Placement(0.0, 0.0, turn) for turn in (-yaw, yaw)),
    )
    model = RobotModel(robot, task.scene.held)
    return TaskBench(task, backend, model, tuple(dict.fromkeys(placements)))
