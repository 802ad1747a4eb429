"""A backend in one of the suite's scenes, and the ways in which the tests drive it."""

from __future__ import annotations

import functools
import hashlib
import json
import sys
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import coal
import numpy as np

from sart_toolkit.backends import get_backend
from sart_toolkit.backends.interface import (
    Backend,
    Contact,
    Draws,
    KnowsBodies,
    Observation,
    Resets,
    SavesStates,
    SensesContacts,
    SensesForce,
    require,
)
from sart_toolkit.collision.parts import coal_transform, convex_distance, robot_parts
from sart_toolkit.errors import MissingCapability, MissingExtra
from sart_toolkit.poses import Array, interpolate, inverse, pose
from sart_toolkit.robots import get_robot
from sart_toolkit.robots.model import RobotModel
from sart_toolkit.robots.spec import ImageSize
from sart_toolkit.scenes.spec import SceneSpec, SceneState
from sart_toolkit.testing.scenes import BLOCK_TOP, SCENES, STICK_TIP, ready_joints, site

try:
    import pytest
except ImportError as error:
    raise MissingExtra("pytest is missing; pip install 'sart_toolkit[testing]'") from error

GRIPPER = 0.5
ABILITIES: tuple[type, ...] = (Resets, SavesStates, SensesForce, SensesContacts, KnowsBodies, Draws)
# Without `Resets` the robot is driven: so far [rad] in a control period, and then so long [s].
_STRIDE, _SETTLE = 0.02, 1.5
_TESTED = "this is to be tested"
_WORKS = "test_an_ability_that_a_backend_has_works"

# A convex part of a finger: its link, shape, pose in the link, and which side of the tool it is on.
_Part = tuple[str, coal.CollisionGeometry, Array, int]


@dataclass
class Bench:
    """A backend in a scene, and the robot's kinematics.

    Attributes:
        site: the frame `(4, 4)` under the tool that scenes are laid out in.
        ready: the joints `(n,)` with the tool pointing down above it.
        q, gripper: what was commanded last.
    """

    backend_name: str
    robot_name: str
    scene_name: str
    backend: Backend
    scene: SceneSpec
    model: RobotModel
    site: Array
    ready: Array
    q: Array
    gripper: float = GRIPPER
    _found: dict[Any, bool] = field(default_factory=dict)

    # --- what a test needs ----------------------------------------------------------------------

    def needs(self, *abilities: type) -> None:
        """Skip the test where the backend lacks an ability."""
        for ability in abilities:
            if not isinstance(self.backend, ability):
                pytest.skip(f"backend {self.backend.name!r} lacks {ability.__name__}")
            if ability is Draws:
                self.needs_images()
            self.relies_on(self.has(ability), _WORKS)

    def needs_images(self) -> None:
        """Skip the test where the backend takes no images."""
        if self.backend.no_images:
            pytest.skip(f"backend {self.backend.name!r} lacks images: {self.backend.no_images}")
        self.relies_on(self.takes_images(), "test_a_backend_takes_images_or_says_why_not")

    def has(self, ability: type) -> bool:
        """Whether the backend has an ability that works."""
        if ability not in self._found:
            self._found[ability] = isinstance(self.backend, ability) and self.does(ability)
        return self._found[ability]

    def does(self, ability: type) -> bool:
        """Whether an ability that the backend has works."""
        try:
            if ability is Resets:
                self.resets.reset(self.state())
            elif ability is SavesStates:
                self.states.restore(self.states.save())
            elif ability is SensesContacts:
                self.contacts()
            elif ability is SensesForce:
                return bool(np.isfinite(require(self.backend, SensesForce, _TESTED).force()))
            elif ability is KnowsBodies:
                return bool(self.backend.observe().Ts_world_body)
            elif ability is Draws:
                self.stage.draw(self.state(), next(iter(self.backend.cameras.values())), 8, 8)
        except MissingCapability:
            return False
        return True

    def takes_images(self) -> bool:
        """Whether an image comes back that was asked for."""
        if "images" not in self._found:
            name = next(iter(self.backend.cameras))
            try:
                self._found["images"] = name in self.see((name,), 8).cameras
            except MissingCapability:
                self._found["images"] = False
        return self._found["images"]

    @property
    def resets(self) -> Resets:
        """The backend as one that can be reset."""
        return require(self.backend, Resets, _TESTED)

    @property
    def states(self) -> SavesStates:
        """The backend as one that saves states."""
        return require(self.backend, SavesStates, _TESTED)

    @property
    def stage(self) -> Draws:
        """The backend as one that draws."""
        return require(self.backend, Draws, _TESTED)

    @property
    def hz(self) -> int:
        """Control periods a second."""
        return self.backend.rates.control_hz

    def contacts(self) -> list[Contact]:
        """What touched during the last step."""
        return require(self.backend, SensesContacts, _TESTED).contacts()

    def relies_on(self, holds: object, test: str) -> None:
        """Skip the test where it means nothing before another one passes."""
        if not holds:
            pytest.skip(f"not judged before {test} passes")

    def relies_on_repeating(self) -> None:
        """Skip the test where not even the same commands after the same reset do the same."""
        self.needs(Resets)
        if "repeats" not in self._found:
            self.reset()
            first = self.continuation()
            self.reset()
            self._found["repeats"] = self.continuation() == first
            self.reset()
        test = "test_the_same_commands_give_the_same_trajectory"
        if self.scene_name == "loose":
            test = "test_what_happens_to_free_bodies_after_a_reset_depends_on_the_state_alone"
        self.relies_on(self._found["repeats"], test)

    def relies_on_contacts(self) -> None:
        """Skip the test where not even the stick on the block is reported; then reset."""
        if "touch" not in self._found:
            self.reset()
            steps = self.lower_stick(-0.002)
            self._found["touch"] = any(contacts for contacts in steps)
            self.reset()
        self.relies_on(self._found["touch"], "test_contact_is_reported_when_bodies_touch")

    # --- driving --------------------------------------------------------------------------------

    def state(self, q: Array | None = None, gripper: float = GRIPPER, **kwargs: Any) -> SceneState:
        """The scene's state with the robot ready, or at `q`; the rest as for `initial_state`."""
        return self.scene.initial_state(self.ready if q is None else q, gripper, **kwargs)

    def reset(self, q: Array | None = None, gripper: float = GRIPPER, **kwargs: Any) -> SceneState:
        """Reset to `state` of the same arguments, which is returned.

        A backend that can't be reset is driven there; it can't be where bodies are to be moved.
        """
        state = self.state(q, gripper, **kwargs)
        if isinstance(self.backend, Resets):
            self.resets.reset(state)
            self.q, self.gripper = np.array(state.q), state.commanded_gripper
        else:
            if kwargs:
                self.needs(Resets)
            start = self.see().q
            n = max(1, int(np.ceil(np.abs(state.q - start).max() / _STRIDE)))
            for i in range(1, n + 1):
                self.command(start + (i / n) * (state.q - start), state.commanded_gripper)
            self.wait(_SETTLE)
        return state

    def command(self, q: Array, gripper: float | None = None, periods: int = 1) -> None:
        """Command joints and gripper, and step."""
        self.q = np.array(q)
        self.gripper = self.gripper if gripper is None else gripper
        for _ in range(periods):
            self.backend.command(self.q, self.gripper)
            self.backend.step()

    def wait(self, seconds: float) -> None:
        """Step without new commands."""
        for _ in range(round(seconds * self.hz)):
            self.backend.step()

    def see(self, cameras: Sequence[str] = (), size: ImageSize | None = None) -> Observation:
        """What the backend observes."""
        return self.backend.observe(cameras, size)

    def joints_at(self, p: Sequence[float], q_near: Array | None = None) -> Array:
        """The joints with the tool pointing down at `p (3,)` [m] of the site's frame."""
        T = self.site @ pose(p, [np.pi, 0, 0])
        return self.model.ik(T, self.ready if q_near is None else q_near)

    def move_tool(self, p: Sequence[float], periods: int = 20) -> list[list[Contact]]:
        """Move the tool straight to `p (3,)` [m] of the site's frame; the contacts of each step."""
        start = self.model.fk(self.q)
        goal = self.site @ pose(p, [np.pi, 0, 0])
        found = []
        for i in range(periods):
            self.command(self.model.ik(interpolate(start, goal, (i + 1) / periods), self.q))
            found.append(self.contacts() if self.has(SensesContacts) else [])
        return found

    def lower_stick(self, gap: float) -> list[list[Contact]]:
        """Bring the stick's tip to `gap` [m] above the block; the contacts of each step."""
        return self.move_tool([0, 0, BLOCK_TOP + STICK_TIP + gap])

    def positions(self) -> dict[str, float]:
        """The observed joint positions [rad or m] of all jointed bodies."""
        Ts = self.see().Ts_world_body
        return {name: self.scene.joint_position(name, Ts) for name in self.scene.jointed}

    # --- what is compared -----------------------------------------------------------------------

    def digest(self, images: bool = False) -> str:
        """What is observed now but the time, to the bit; the first camera's image if asked for."""
        shown = images and not self.backend.no_images and self.takes_images()
        return _digest(self.see(tuple(self.backend.cameras)[:1] if shown else (), 32))

    def continuation(self, periods: int = 6) -> list[str]:
        """What is observed and touched, to the bit, while all joints move a little."""
        seen = []
        q = self.see().q
        for i in range(1, periods + 1):
            self.command(q + 0.004 * i * np.cos(np.arange(len(q))), GRIPPER + 0.01 * i)
            touched = self.contacts() if self.has(SensesContacts) else []
            seen.append(f"{self.digest(images=i == periods)} {touched}")
        return seen

    def finger_opening(self) -> float:
        """The distance [m] between the facing fingers, by their shapes, as they are observed."""
        Ts = self.see().Ts_world_body
        links = self.model.spec.gripper.finger_links
        Ts_link = {link: Ts[f"speck{i}"] for i, link in enumerate(links)}
        return _opening(_finger_parts(self.robot_name), Ts_link)

    def expected_opening(self, gripper: float) -> float:
        """The distance [m] between the facing fingers by the robot's kinematics at a command."""
        model = RobotModel(self.model.spec, self.scene.held, gripper)
        links = self.model.spec.gripper.finger_links
        Ts_link = {link: model.fk(self.ready, link) for link in links}
        return _opening(_finger_parts(self.robot_name), Ts_link)


def _digest(seen: Observation) -> str:
    parts = [seen.q, seen.dq, np.array(seen.gripper), seen.T_world_tool]
    parts += [T for _, T in sorted(seen.Ts_world_body.items())]
    for _, view in sorted(seen.cameras.items()):
        parts += [view.rgb, view.depth, view.T_world_camera]
    sha = hashlib.sha256()
    for part in parts:
        sha.update(np.ascontiguousarray(part).tobytes())
    return sha.hexdigest()


def _opening(shapes: Sequence[_Part], Ts_world_link: dict[str, Array]) -> float:
    """The least distance [m] between parts of fingers on either side of the tool."""
    sides: tuple[list[Any], list[Any]] = ([], [])
    for link, geometry, T_link_part, side in shapes:
        sides[side].append((geometry, coal_transform(Ts_world_link[link] @ T_link_part)))
    return min(convex_distance(*a, *b) for a in sides[0] for b in sides[1])


@functools.cache
def _finger_parts(robot_name: str) -> list[_Part]:
    """The convex parts of a robot's finger links."""
    robot = get_robot(robot_name)
    model = RobotModel(robot)
    T_tool_world = inverse(model.fk(robot.home))
    found = []
    for part in robot_parts(model):
        if part.body in robot.gripper.finger_links:
            frame = model.pinocchio_model.frames[model.pinocchio_model.getFrameId(part.body)]
            T_link_part = inverse(np.array(frame.placement.homogeneous)) @ part.T_joint_part
            T_tool_part = T_tool_world @ model.fk(robot.home, part.body) @ T_link_part
            found.append((part.body, part.geometry, T_link_part, int(T_tool_part[0, 3] > 0)))
    return found


@functools.cache
def _whereabouts(robot_name: str) -> tuple[Array, Array]:
    robot = get_robot(robot_name)
    return site(robot), ready_joints(robot)


def make_bench(
    backend_name: str, robot_name: str, scene_name: str = "plain", scene: SceneSpec | None = None
) -> Bench:
    """A backend with a robot, in one of `SCENES`, reset.

    Args:
        backend_name: one of `BACKENDS` or a reference.
        robot_name: one of `ROBOTS` or a reference.
        scene_name: one of `SCENES`.
        scene: in place of that scene.
    """
    robot = get_robot(robot_name)
    scene = scene or SCENES[scene_name](robot)
    backend = get_backend(backend_name)(robot, scene, 64)
    model = RobotModel(robot, scene.held)
    here, ready = _whereabouts(robot_name)
    bench = Bench(backend_name, robot_name, scene_name, backend, scene, model, here, ready, ready)
    try:
        bench.reset()
    except BaseException:
        backend.close()
        raise
    return bench


def continue_in_new_process(*words: str) -> None:
    """Print as JSON the continuation of a saved state: backend, robot and file are named."""
    backend_name, robot_name, path = words
    bench = make_bench(backend_name, robot_name)
    bench.states.restore(Path(path).read_bytes())
    sys.stdout.write("\n" + json.dumps(bench.continuation()))
    bench.backend.close()
