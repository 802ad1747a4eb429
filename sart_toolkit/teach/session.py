"""Teleoperation: a device steers the tool at 30 Hz, the session records at 10 Hz."""

from __future__ import annotations

import abc
import logging
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from sart_toolkit.backends.interface import Backend, Contact, Observation
from sart_toolkit.errors import InvalidInput, MotionRejected, Unreachable
from sart_toolkit.motion.controller import ControllerConfig, ToolController
from sart_toolkit.poses import Array, apply_motion, check_array, check_positive, frozen
from sart_toolkit.records import (
    CONTROL_HZ,
    CONTROL_PER_RECORD,
    RECORD_HZ,
    Demonstration,
    library_versions,
)
from sart_toolkit.robots.model import RobotModel
from sart_toolkit.robots.spec import check_gripper
from sart_toolkit.tasks.task import Placement, Task
from sart_toolkit.teach.recorder import StepRecorder

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class TeleopCommand:
    """What a device asks for over the next 1/30 s.

    `velocity (6,)`: of the tool in the tool's frame, xyz [m/s] and rotation [rad/s]; `gripper` in
    [0, 1]; `stop` ends the recording before the command is carried out.
    """

    velocity: Array
    gripper: float
    stop: bool = False

    def __post_init__(self) -> None:
        object.__setattr__(self, "velocity", frozen(check_array("velocity", self.velocity, (6,))))
        check_gripper(self.gripper)


class Device(abc.ABC):
    """What a person, or a script in a person's place, steers with.

    Attributes:
        name: kept with the demonstration.
        operator: who steers.
    """

    name: str
    operator: str

    @abc.abstractmethod
    def read(self, observation: Observation) -> TeleopCommand:
        """The command for the next 1/30 s, having seen what the robot measures now."""


@dataclass(frozen=True)
class SessionConfig:
    """How a demonstration is recorded: cameras, and the longest it may last [s].

    Without `keep_states` no generated trajectory can start from it, and recording is faster.
    """

    cameras: tuple[str, ...] = ("wrist",)
    max_seconds: float = 120.0
    keep_states: bool = True

    def __post_init__(self) -> None:
        check_positive("max_seconds", self.max_seconds, "s")


def record_demonstration(
    backend: Backend,
    task: Task,
    model: RobotModel,
    device: Device,
    placement: Placement | None = None,
    seed: int | None = None,
    config: SessionConfig | None = None,
    progress: Callable[[float], None] | None = None,
) -> Demonstration:
    """One demonstration of a task, steered by a device until it says stop.

    A command that leads out of reach is not carried out: the tool stays where it is.

    Args:
        backend: the robot in the task's scene.
        task: what is demonstrated.
        model: the robot's kinematics.
        device: what steers.
        placement: where the object stands; in the middle of its range if left out.
        seed: the device's seed, kept with the demonstration.
        config: cameras and limits.
        progress: called with the seconds recorded so far.

    Raises:
        InvalidInput: the device did not stop within `max_seconds`.
    """
    config = config or SessionConfig()
    placement = placement or Placement()
    controller = ToolController(model, ControllerConfig())
    state = task.initial_state(model, placement)
    backend.reset(state)
    controller.reset(state.q)
    recorder = StepRecorder(backend, config.cameras)
    gripper = state.commanded_gripper
    can_save = backend.capabilities.can_restore and config.keep_states
    feels = backend.capabilities.has_contacts
    observation = recorder.add(controller, gripper, 0.0 if feels else np.nan)
    states = [backend.save()] if can_save else []
    success, raw = [task.success(observation)], []
    touching: list[tuple[tuple[str, str], ...]] = [()]
    stop = False
    while not stop:
        if len(success) > config.max_seconds * RECORD_HZ:
            raise InvalidInput(
                f"the demonstration did not end within {config.max_seconds:.0f} s: "
                f"{task.shortfall(observation)}; steer on, or allow more with max_seconds"
            )
        contacts: list[Contact] = []
        for _ in range(CONTROL_PER_RECORD):
            now = backend.observe()
            velocity = np.zeros(6)
            if not stop:
                command = device.read(now)
                stop = command.stop
                if not stop:
                    velocity, gripper = command.velocity, command.gripper
            raw.append(np.append(velocity, gripper))
            backend.command(_steered(controller, velocity, now.T_world_tool), gripper)
            backend.step()
            if feels:
                contacts += backend.contacts()
        force = max([0.0, *(contact.force for contact in contacts)]) if feels else np.nan
        observation = recorder.add(controller, gripper, force)
        touching.append(tuple(sorted({(contact.a, contact.b) for contact in contacts})))
        if can_save:
            states.append(backend.save())
        success.append(task.success(observation))
        if progress is not None:
            progress(len(success) / RECORD_HZ)
    steps = recorder.steps()
    rows = recorder.observations
    return Demonstration(
        task=task.name,
        task_parameters={"placement": placement.to_json()},
        robot=model.spec.name,
        backend=backend.name,
        steps=steps,
        timestamps=np.arange(len(steps)) / RECORD_HZ,
        body_Ts_world={
            name: np.stack([row.Ts_world_body[name] for row in rows])
            for name in rows[0].Ts_world_body
        },
        success=np.array(success),
        touching=tuple(touching),
        raw_commands=np.stack(raw),
        states=tuple(states),
        operator=device.operator,
        device=device.name,
        seconds=len(steps) / RECORD_HZ,
        seed=seed,
        versions=library_versions(),
    )


def _steered(controller: ToolController, velocity: Array, measured_T_world_tool: Array) -> Array:
    """Joint targets `(n,)` after one control period of a tool velocity; where it can't go, stay."""
    desired = apply_motion(controller.commanded_T_world_tool, velocity / CONTROL_HZ)
    try:
        return controller.move(desired, measured_T_world_tool, 1)[0]
    except (Unreachable, MotionRejected) as error:
        _log.warning("command not carried out: %s", error)
        return controller.commanded_q
