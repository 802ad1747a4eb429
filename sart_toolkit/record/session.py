"""Teleoperation: a device steers the tool at the control rate, the session records its steps.

`TeleopSession` is the recording itself, moved on by whoever calls it: `record_demonstration` for a
script, `record.desk` for a person.
"""

from __future__ import annotations

import abc
import enum
import logging
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np

from sart_toolkit.backends import BACKENDS
from sart_toolkit.backends.interface import (
    Backend,
    Contact,
    Guides,
    Observation,
    Resets,
    SavesStates,
    SensesContacts,
    SensesForce,
    missing_abilities,
    require,
)
from sart_toolkit.data.records import Demonstration, Judge, library_versions
from sart_toolkit.errors import InvalidInput, MotionRejected, RobotStopped, Unreachable
from sart_toolkit.motion.config import ControllerConfig
from sart_toolkit.motion.controller import ToolController
from sart_toolkit.poses import (
    Array,
    apply_motion,
    check_array,
    check_positive,
    frozen,
    relative_motion,
)
from sart_toolkit.record.recorder import StepRecorder
from sart_toolkit.registry import reference_to
from sart_toolkit.robots import ROBOTS
from sart_toolkit.robots.model import RobotModel
from sart_toolkit.robots.spec import check_gripper
from sart_toolkit.scenes.appearance import Appearance
from sart_toolkit.scenes.spec import SceneState
from sart_toolkit.tasks import TASKS
from sart_toolkit.tasks.task import Placement, Task

Frame = Literal["world", "tool"]

_log = logging.getLogger(__name__)
# A joint nearer to its limit than this [rad] is what is in the way.
_AT_LIMIT = 0.05


@dataclass(frozen=True)
class TeleopCommand:
    """What a device asks for over the next control period.

    `velocity (6,)`: of the tool in the tool's frame, xyz [m/s] and rotation [rad/s]; `gripper` in
    [0, 1]; `stop` ends the recording before the command is carried out.
    """

    velocity: Array
    gripper: float
    stop: bool = False

    def __post_init__(self) -> None:
        object.__setattr__(self, "velocity", frozen(check_array("velocity", self.velocity, (6,))))
        check_gripper(self.gripper)


@dataclass(frozen=True)
class DeviceSetup:
    """What a device is made for.

    `backend`, `task`, `model`: the robot in its scene, what it is to do there, and its kinematics;
    `state`: the start; `rng`: a script's randomness; `frame`, "world" or "tool": what a person's
    directions are fixed to at first; `operator`: who steers, where it is a person.
    """

    backend: Backend
    task: Task
    model: RobotModel
    state: SceneState
    rng: np.random.Generator
    frame: Frame = "world"
    operator: str = "person"


class Device(abc.ABC):
    """What a person, or a script in a person's place, steers with.

    Attributes:
        name: kept with the demonstration.
        operator: who steers.
        interactive: whether a person holds it, and so needs to see what happens.
        guides: whether a hand moves the arm itself; of its commands the gripper's alone count.
    """

    name: str
    operator: str
    interactive: bool = False
    guides: bool = False

    @abc.abstractmethod
    def read(self, observation: Observation) -> TeleopCommand:
        """The command for the next control period, having seen what the robot measures now."""


@dataclass(frozen=True)
class SessionConfig:
    """How a demonstration is recorded: cameras, and the longest it may last [s].

    Without `keep_states` no generated trajectory can start from it, and recording is faster.
    `end_on_success`: it ends by itself once the goal has been reached for the task's `hold`.
    `references`: what names "robot", "task" or "backend" in the demonstration, where that isn't to
    be found out; `appearance`: that of the backend, where it isn't the task's own, to be kept.
    `guided`: a hand moves the arm while it records, and where it went becomes what is commanded.
    """

    cameras: tuple[str, ...] = ("wrist",)
    max_seconds: float = 120.0
    keep_states: bool = True
    end_on_success: bool = False
    controller: ControllerConfig = field(default_factory=ControllerConfig)
    references: Mapping[str, str] = field(default_factory=dict)
    appearance: Appearance | None = None
    guided: bool = False

    def __post_init__(self) -> None:
        check_positive("max_seconds", self.max_seconds, "s")


class SessionState(enum.Enum):
    """The state of a session; the value is the word that a person reads."""

    READY = "ready"
    RECORDING = "recording"
    PAUSED = "paused"
    ENDED = "ended"
    SAVED = "saved"


class End(enum.Enum):
    """Why a recording ended."""

    STOPPED = "stopped"
    ROBOT_STOPPED = "robot stopped"
    SUCCESS = "goal reached"
    TIME = "time is up"


class TeleopSession:
    """A demonstration in the making: ready, recording, paused, ended, saved.

    It draws nothing, and only the backend makes it wait: each `advance` is one control period.
    While it isn't recording a simulation stands still, and an arm that a hand guides is held.

    A backend that can't be reset is recorded from wherever the robot is, and its placement is the
    one given. One that lacks what the task's success is judged by records no success; a person may
    say that the goal was reached, see `say_reached`.

    Attributes:
        state: what it is at.
        judged_by: who decides whether the goal is reached: the task, a person, or nobody yet.
        end: why it ended, once it has.
        gripper: the gripper command in force, in [0, 1].
        trouble: why the last command was not carried out; empty where it was.
        contacts: what the robot, or what it grasps, touched in the last control period, but for
            what it grasps itself; the firmest first.
    """

    def __init__(
        self,
        backend: Backend,
        task: Task,
        model: RobotModel,
        placement: Placement | None = None,
        config: SessionConfig | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """Ready to record, robot and scene as at the task's start if the backend can be reset.

        Args:
            backend: the robot in the task's scene.
            task: what is demonstrated.
            model: the robot's kinematics.
            placement: where the object stands; in the middle of its range if left out.
            config: cameras and limits.
            clock: returns the wall-clock time [s].

        Raises:
            UnknownName: there is no such camera.
            MissingCapability: the backend takes no images, or no hand can guide it.
        """
        self.backend, self.task, self.model = backend, task, model
        self.placement = placement or Placement()
        self.config = config or SessionConfig()
        self._clock = clock
        self._started_at: float | None = None
        self._seconds_spent = 0.0
        self._controller = ToolController(model, self.config.controller, backend.rates)
        self._touch = backend if isinstance(backend, SensesContacts) else None
        self._force = backend if isinstance(backend, SensesForce) else None
        keeps = self.config.keep_states and isinstance(backend, SavesStates)
        self._saves = backend if keeps and isinstance(backend, SavesStates) else None
        self._judges = not missing_abilities(backend, task.observes)
        self._guides = (
            require(backend, Guides, "a hand is to guide its arm") if self.config.guided else None
        )
        self._prepare()

    def _prepare(self) -> None:
        self._recorder = StepRecorder(self.backend, self.model, self.config.cameras)
        if isinstance(self.backend, Resets):
            state = self.task.initial_state(self.model, self.placement)
            self.backend.reset(state)
            self._controller.reset(state.q)
            self.gripper = state.commanded_gripper
        else:
            here = self.backend.observe()
            self._controller.reset(here.q)
            self.gripper = float(np.clip(here.gripper, 0.0, 1.0))
        self._now = self._recorder.add(self._controller, self.gripper, self._no_force())
        self._states = [self._saves.save()] if self._saves is not None else []
        self.judged_by: Judge = "task" if self._judges else "nobody"
        self._success, self._raw = [self._reached()], list[Array]()
        # The recorded step that comes after each pause, and how long [s] that was.
        self._pauses: list[tuple[int, float]] = []
        self._touching: list[tuple[tuple[str, str], ...]] = [()]
        self._touched: set[tuple[str, str]] = set()
        self._pressed = self._no_force()
        self.state, self.end = SessionState.READY, End.STOPPED
        self.trouble, self.contacts = "", list[Contact]()

    def _no_force(self) -> float:
        return np.nan if self._force is None else 0.0

    def _reached(self) -> bool:
        return self._judges and self.task.success(self._now)

    # --- what a person sees ---------------------------------------------------------------------

    @property
    def observation(self) -> Observation:
        """What the robot measures now."""
        return self._now

    @property
    def recorded(self) -> Observation:
        """What was recorded last, with the images of the session's cameras."""
        return self._recorder.observations[-1]

    @property
    def steps(self) -> int:
        """How many steps are recorded, the start among them."""
        return len(self._success)

    @property
    def seconds(self) -> float:
        """How long the recording is by now [s]."""
        return len(self._raw) / self.backend.rates.control_hz

    @property
    def seconds_spent(self) -> float:
        """Wall-clock time [s] from the first start to the end, or to now: redos, pauses and all."""
        if self._started_at is None or self.state in (SessionState.ENDED, SessionState.SAVED):
            return self._seconds_spent
        return self._clock() - self._started_at

    @property
    def success(self) -> bool:
        """Whether the goal was reached at the step recorded last."""
        return self._success[-1]

    @property
    def success_held(self) -> float:
        """For how long [s] up to now the goal has been reached at every step."""
        misses = [t for t, reached in enumerate(self._success) if not reached]
        return (len(self._success) - 1 - (misses[-1] if misses else -1)) / self._record_hz

    @property
    def achieved(self) -> bool:
        """Whether what is recorded counts as a success of the task."""
        return self.task.achieved(np.array(self._success), self._record_hz)

    @property
    def failure_reason(self) -> str:
        """Why the goal isn't reached now, in a few words."""
        if self._judges:
            return self.task.failure_reason(self._now)
        lacking = ", ".join(missing_abilities(self.backend, self.task.observes))
        return f"backend {self.backend.name!r} can't tell, since it lacks {lacking}"

    @property
    def _record_hz(self) -> int:
        return self.backend.rates.record_hz

    # --- what a person does ---------------------------------------------------------------------

    def start(self) -> None:
        """Begin to record, or resume after a pause.

        Raises:
            InvalidInput: there is nothing to start or resume.
        """
        self._expect("start", SessionState.READY, SessionState.PAUSED)
        # The clock of a robot goes on while it stands.
        self._pauses.append((len(self._success), self.backend.observe().time - self._now.time))
        if self._started_at is None:
            self._started_at = self._clock()
        if self._guides is not None:
            self._guides.guide()
        self.state = SessionState.RECORDING

    def pause(self) -> None:
        """Stand still, recording nothing, until `start`.

        Raises:
            InvalidInput: it isn't recording.
        """
        self._expect("pause", SessionState.RECORDING)
        if self._held():
            self.state = SessionState.PAUSED

    def redo(self) -> None:
        """Forget what was recorded; robot and scene are as at the start again.

        Raises:
            InvalidInput: the recording is saved.
        """
        self._expect(
            "redo",
            SessionState.READY,
            SessionState.RECORDING,
            SessionState.PAUSED,
            SessionState.ENDED,
        )
        self._held()
        self._prepare()

    def stop(self) -> None:
        """End the recording, the robot still to the end of a recorded step.

        Raises:
            InvalidInput: nothing is being recorded.
        """
        self._expect("stop", SessionState.RECORDING, SessionState.PAUSED)
        try:
            self._step(np.zeros(6), self.gripper)
            while len(self._raw) % self.backend.rates.control_per_record:
                self._step(np.zeros(6), self.gripper)
        except RobotStopped as error:
            self._end_stopped(error)
            return
        self._end(End.STOPPED)

    def say_reached(self) -> None:
        """Take a person's word that the goal was reached, where the backend can't tell.

        It counts as reached for the task's `hold` up to the end.

        Raises:
            InvalidInput: the recording hasn't ended, or the task itself has judged it.
        """
        self._expect("say_reached", SessionState.ENDED)
        if self._judges:
            raise InvalidInput(
                "say_reached: this backend itself decides whether the goal is reached"
            )
        held = min(len(self._success), self.task.steps_held(self._record_hz))
        self._success[-held:] = [True] * held
        self.judged_by = "person"

    def mark_saved(self) -> None:
        """Note that the ended recording is safe.

        Raises:
            InvalidInput: it hasn't ended.
        """
        self._expect("mark_saved", SessionState.ENDED)
        self.state = SessionState.SAVED

    def advance(self, command: TeleopCommand) -> None:
        """Carry a command out for one control period; the last of a recorded step ends that.

        A command that leads out of reach is not carried out: the tool stays where it is, and
        `trouble` says why. Where a real robot stops the recording ends, and `trouble` says why; the
        whole steps until then are kept.

        Raises:
            InvalidInput: it isn't recording.
        """
        self._expect("advance", SessionState.RECORDING)
        if command.stop:
            self.stop()
            return
        try:
            self._step(command.velocity, command.gripper)
        except RobotStopped as error:
            self._end_stopped(error)
            return
        if len(self._raw) % self.backend.rates.control_per_record:
            return
        if self.config.end_on_success and self.achieved:
            self._end(End.SUCCESS)
        elif len(self._success) > self.config.max_seconds * self._record_hz:
            self._end(End.TIME)

    def _expect(self, what: str, *states: SessionState) -> None:
        if self.state not in states:
            raise InvalidInput(
                f"{what}: the session is {self.state.value}; expected it to be "
                f"{' or '.join(state.value for state in states)}"
            )

    def _end(self, end: End) -> None:
        if self._held():
            self._seconds_spent = self.seconds_spent
            self.state, self.end = SessionState.ENDED, end

    def _end_stopped(self, error: RobotStopped) -> None:
        """End with the whole steps until a real robot stopped."""
        del self._raw[(self.steps - 1) * self.backend.rates.control_per_record :]
        self.trouble = str(error)
        self._seconds_spent = self.seconds_spent
        self.state, self.end = SessionState.ENDED, End.ROBOT_STOPPED

    def _held(self) -> bool:
        """Whether the arm is held, as it is unless a hand guides it; if it can't be, it ends."""
        try:
            if self._guides is not None:
                self._guides.hold()
        except RobotStopped as error:
            self._end_stopped(error)
            return False
        return True

    # --- one control period ---------------------------------------------------------------------

    def _step(self, velocity: Array, gripper: float) -> None:
        """Steer for one control period and measure; the last of a recorded step is recorded."""
        if self._guides is not None:
            velocity = self._guided(gripper)
        else:
            sent = self.backend.command(self._steered(velocity), gripper)
            self._controller.acknowledge(sent.q)
            self.gripper = sent.gripper
            self.backend.step()
        self._raw.append(np.append(velocity, gripper))
        if self._touch is not None:
            touching = self._touch.contacts()
            self._touched |= {(contact.a, contact.b) for contact in touching}
            self.contacts = self._outer(touching)
        if self._force is not None:
            self._pressed = max(self._pressed, self._force.force())
        if len(self._raw) % self.backend.rates.control_per_record:
            self._now = self.backend.observe()
            return
        self._now = self._recorder.add(self._controller, self.gripper, self._pressed)
        self._touching.append(tuple(sorted(self._touched)))
        self._touched, self._pressed = set(), self._no_force()
        if self._saves is not None:
            self._states.append(self._saves.save())
        self._success.append(self._reached())

    def _guided(self, gripper: float) -> Array:
        """The tool's velocity `(6,)` over a control period in which a hand moved it.

        Where it is then becomes the command.
        """
        self.gripper = self.backend.command(self._controller.commanded_q, gripper).gripper
        self.backend.step()
        before = self._controller.commanded_T_world_tool
        self._controller.reset(self.backend.observe().q)
        moved = relative_motion(before, self._controller.commanded_T_world_tool)
        return moved * self.backend.rates.control_hz

    def _steered(self, velocity: Array) -> Array:
        """Joint targets `(m, n)` of a control period at a tool velocity; else stay, and say."""
        controller = self._controller
        desired = apply_motion(
            controller.commanded_T_world_tool, velocity / self.backend.rates.control_hz
        )
        try:
            (targets,) = controller.move(desired, self._now.T_world_tool, 1)
        except (Unreachable, MotionRejected) as error:
            trouble = self._named_trouble(error)
            if trouble != self.trouble:
                _log.warning("command not carried out: %s", error)
            self.trouble = trouble
            return controller.hold()
        self.trouble = ""
        return targets

    def _named_trouble(self, error: Unreachable | MotionRejected) -> str:
        q = self._controller.commanded_q
        room = np.minimum(q - self.model.lower, self.model.upper - q)
        joint = int(np.argmin(room))
        if room[joint] < _AT_LIMIT:
            return f"joint limit: {self.model.spec.arm_joints[joint]}"
        return "joints would jump" if isinstance(error, MotionRejected) else "out of reach"

    def _outer(self, contacts: list[Contact]) -> list[Contact]:
        scene, pairs = self.task.scene, {(contact.a, contact.b) for contact in contacts}
        grasped = scene.grasped(pairs, self.model.spec.gripper.finger_links)
        outer = scene.outer_contacts(pairs, grasped)
        return sorted((c for c in contacts if (c.a, c.b) in outer), key=lambda c: -c.force)

    # --- the result -----------------------------------------------------------------------------

    def _timestamps(self) -> Array:
        """When each step was measured `(T,)` [s], pauses left out; 0 at the first."""
        times = np.array([row.time for row in self._recorder.observations])
        for step, pause in self._pauses:
            times[step:] -= pause
        # Where a clock counts periods, its rounding errors are not to show.
        return np.round(times - times[0], 9)

    def demonstration(
        self, operator: str, device: str, seconds: float, seed: int | None = None
    ) -> Demonstration:
        """What was recorded, as a record.

        Args:
            operator: who steered.
            device: with what.
            seconds: wall-clock time to put down as spent.
            seed: the device's, if it has one.

        Raises:
            InvalidInput: the recording hasn't ended.
        """
        self._expect("demonstration", SessionState.ENDED, SessionState.SAVED)
        steps = self._recorder.steps()
        rows = self._recorder.observations
        references = {
            "robot": reference_to("robot", self.model.spec, ROBOTS),
            "task": reference_to("task", self.task, TASKS),
            "backend": reference_to("backend", type(self.backend), BACKENDS),
            **self.config.references,
        }
        parameters: dict[str, Any] = {"placement": self.placement.to_json()}
        if digests := self.task.scene.mesh_digests:
            parameters["meshes"] = digests
        if self.backend.delays:
            parameters["image_delays"] = self.backend.delays
        if self.config.appearance is not None:
            parameters["appearance"] = self.config.appearance.to_json()
        return Demonstration(
            task=self.task.name,
            task_parameters=parameters,
            robot=self.model.spec.name,
            backend=self.backend.name,
            steps=steps,
            timestamps=self._timestamps(),
            body_Ts_world={
                name: np.stack([row.Ts_world_body[name] for row in rows])
                for name in rows[0].Ts_world_body
            },
            success=np.array(self._success),
            touching=tuple(self._touching),
            raw_commands=np.stack(self._raw),
            states=tuple(self._states),
            operator=operator,
            device=device,
            seconds=seconds,
            seed=seed,
            versions=library_versions(),
            rates=self.backend.rates,
            judged_by=self.judged_by,
            references={k: v for k, v in references.items() if v is not None},
        )


def record_demonstration(
    backend: Backend,
    task: Task,
    model: RobotModel,
    device: Device,
    placement: Placement | None = None,
    seed: int | None = None,
    config: SessionConfig | None = None,
    progress: Callable[[float], None] | None = None,
    keep: Callable[[Demonstration], None] | None = None,
) -> Demonstration:
    """One demonstration of a task, steered by a device until it says stop, as fast as it goes.

    A command that leads out of reach is not carried out: the tool stays where it is. No person's
    time is spent, so `seconds` is 0.

    Args:
        backend: the robot in the task's scene.
        task: what is demonstrated.
        model: the robot's kinematics.
        device: what steers.
        placement: where the object stands; in the middle of its range if left out.
        seed: the device's seed, kept with the demonstration.
        config: cameras and limits.
        progress: called with the seconds recorded so far.
        keep: called with what was recorded until a real robot stopped, before that is raised.

    Raises:
        InvalidInput: the device did not stop within `max_seconds`.
        RobotStopped: a real robot did.
        UnknownName: there is no such camera.
        MissingCapability: the backend takes no images.
    """
    session = TeleopSession(backend, task, model, placement, config)
    session.start()
    steps = session.steps
    while session.state is SessionState.RECORDING:
        session.advance(device.read(session.observation))
        if progress is not None and session.steps > steps:
            steps = session.steps
            progress(steps / backend.rates.record_hz)
    if session.end is End.ROBOT_STOPPED:
        if keep is not None:
            keep(session.demonstration(device.operator, device.name, 0.0, seed))
        raise RobotStopped(session.trouble)
    if session.end is End.TIME:
        raise InvalidInput(
            f"the demonstration did not end within {session.config.max_seconds:g} s: "
            f"{session.failure_reason}; steer on, or allow more with max_seconds"
        )
    return session.demonstration(device.operator, device.name, 0.0, seed)
