"""A real cell behind the `Backend` interface: an arm, perhaps a gripper, cameras."""

from __future__ import annotations

import time
import weakref
from collections import deque
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, NoReturn, TypeVar, cast

import numpy as np

from sart_toolkit.backends.interface import (
    Attended,
    Backend,
    CameraView,
    CommandSent,
    Guides,
    Observation,
    SensesForce,
)
from sart_toolkit.data.records import DEFAULT_RATES, Rates
from sart_toolkit.errors import InvalidInput, RobotStopped, SartError
from sart_toolkit.hardware import DRIVERS
from sart_toolkit.hardware.cell import Cell, load_cell
from sart_toolkit.hardware.drivers import ArmState, Camera, Clock, Gripper, World
from sart_toolkit.hardware.images import as_described
from sart_toolkit.hardware.link import Inline, Link, OwnProcess, Watching
from sart_toolkit.hardware.servo import RESUME
from sart_toolkit.poses import Array
from sart_toolkit.registry import resolve
from sart_toolkit.robots.model import RobotModel
from sart_toolkit.robots.spec import (
    CameraSpec,
    ImageSize,
    RobotSpec,
    check_gripper,
    check_image_size,
)
from sart_toolkit.scenes.spec import SceneSpec

# So far [m] inside the workspace commands end, so that the arm can brake before its border.
_BRAKING = 0.02
# A row of targets may lead so much farther than a joint's greatest velocity would.
_JUMP = 1.5
# For so long [s] what the arm measured is remembered, to look up where it was at an image's time.
_REMEMBERED = 3.0

_T = TypeVar("_T")


class HardwareBackend(Backend):
    """The robot of a cell, connected as long as this is open; a subclass names its `cell`.

    What is commanded is followed at the cell's `speed_scale`, and time passes as much slower.
    Joints and tool of an observation with images are those when the first of the images was taken;
    its `time` is when it was asked for. Whatever is
    wrong with arm, gripper or a camera stops the arm and raises `RobotStopped`; nothing moves then
    until a new backend is made.

    Attributes:
        cell: what is connected, and what it may do.
        clock: the time [s] that the drivers tell; that of the cell's world, if it has one.
        moves: whether the robot may move. If not, control isn't even taken over: commands are
            checked and then have no effect.
    """

    name = "hardware"
    cell: Cell
    clock: Clock = staticmethod(time.monotonic)
    moves = True

    def __init_subclass__(cls, **kwargs: Any) -> None:
        super().__init_subclass__(**kwargs)
        if "cell" in vars(cls):
            cls.tracking_error = cls.cell.limits.tracking_error
            cls.no_images = "" if cls.cell.cameras else "its cell has no camera"

    def __init__(
        self,
        robot: RobotSpec,
        scene: SceneSpec,
        image_size: ImageSize = 128,
        rates: Rates = DEFAULT_RATES,
    ) -> None:
        """Connect to all and take over control of the arm; nothing but the gripper moves.

        Raises:
            RobotStopped: the arm can't be moved, or gripper or a camera doesn't answer.
            Mismatch: the cell's robot is another.
            MissingExtra: a driver's library isn't installed.
        """
        super().__init__(self.cell.mounted(robot), scene, image_size, rates)
        self._model = RobotModel(self.robot, scene.held)
        self._parts = _Parts()
        # However the program ends, the arm is stopped.
        self._close = weakref.finalize(self, self._parts.close)
        try:
            self._connect()
        except BaseException:
            self.close()
            raise

    def _connect(self) -> None:
        cell, parts = self.cell, self._parts
        parts.world = cell.make_world()
        if parts.world is not None:
            self.clock = parts.world.now
        for name, camera in cell.make_cameras(self.clock).items():
            parts.cameras[name] = camera
            self._asked(f"camera {name!r}", camera.connect)
        gripper = cell.make_gripper(self.clock)
        if gripper is not None:
            parts.gripper = gripper
            self._asked("gripper", gripper.connect)
        if not self.moves:
            parts.link = Watching(cell, self.clock)
        elif cell.control.process:
            parts.link = OwnProcess(cell, self.robot, self.scene.held)
        else:
            parts.link = Inline(cell, self._model, self.clock)
        if gripper is not None and self.moves:
            self._asked("gripper", gripper.start)
        first = parts.link.first
        self._history = deque([first])
        self._told = first.time
        # Time [s] until the clock was `_since`, and how fast it has passed from then on.
        self._passed, self._since, self._pace = 0.0, first.time, cell.limits.speed_scale
        self._guided = False
        self._force = first.force or 0.0
        self._target = first.q
        self._next: Array | None = None
        self._opening = self._gripper_target = self._gripper_sent = 0.0
        if gripper is not None:
            self._opening = self._asked("gripper", gripper.position)
            # It stays where it is until it is commanded.
            self._gripper_target = self._gripper_sent = float(np.clip(self._opening, 0.0, 1.0))
        self._delays: dict[str, list[float]] = {name: [] for name in parts.cameras}

    @property
    def cameras(self) -> dict[str, CameraSpec]:
        """The cameras of the cell by name; those of the scene are simulators'."""
        return {camera.name: camera for camera in self.robot.cameras}

    @property
    def delays(self) -> dict[str, float]:
        return {name: float(np.mean(ages)) for name, ages in self._delays.items() if ages}

    def observe(
        self, cameras: Sequence[str] = (), image_size: ImageSize | None = None
    ) -> Observation:
        size = self.image_size if image_size is None else check_image_size(image_size)
        self.check_cameras(cameras)
        # Of a robot that was stopped all that was measured is told; the next step says why.
        with suppress(RobotStopped):
            self._remember(self._linked().newest())
        now = at = self._history[-1].time
        views = {}
        for i, name in enumerate(cameras):
            image = self._asked(f"camera {name!r}", self._parts.cameras[name].read)
            self._delays[name].append(self.clock() - image.time)
            at = image.time if i == 0 else at
            spec = self.cameras[name]
            rgb, depth = as_described(image, spec, size)
            T_world_frame = np.eye(4)
            if spec.frame != "world":
                T_world_frame = self._model.fk(self._at(image.time)[0], spec.frame)
            views[name] = CameraView(rgb, depth, T_world_frame @ spec.T_frame_camera)
        q, dq = self._at(at)
        path = [state.q for state in self._history if self._told < state.time < at]
        self._told = at
        return Observation(
            q=q,
            dq=dq / self._pace,
            gripper=self._opening,
            T_world_tool=self._model.fk(q),
            time=self._passed + (now - self._since) * self._pace,
            cameras=views,
            joint_path=np.array([*path, q]),
        )

    def _at(self, time: float) -> tuple[Array, Array]:
        """Joints `(n,)` and their velocities at a time, as far as it is remembered."""
        states = list(self._history)
        times = [state.time for state in states]
        after = min(int(np.searchsorted(times, time)), len(states) - 1)
        a, b = states[max(after - 1, 0)], states[after]
        share = float(np.clip((time - a.time) / max(b.time - a.time, 1e-9), 0.0, 1.0))
        return a.q + share * (b.q - a.q), a.dq + share * (b.dq - a.dq)

    def command(self, q: Array, gripper: float) -> CommandSent:
        """Set the targets of the next step; out of the workspace it stays at the last ones.

        While a hand moves the arm only the gripper's has an effect.

        Raises:
            InvalidInput: wrong shape, not finite, outside limits, or a jump.
        """
        if self._guided:
            self._gripper_target = check_gripper(gripper)
            return CommandSent(self._target.copy(), gripper)
        rows = np.atleast_2d(self._model.check_limits(q))
        gripper = check_gripper(gripper)
        steps = np.abs(np.diff(np.concatenate([self._target[None], rows]), axis=0))
        most = _JUMP * self.robot.velocity_limits / (self.rates.control_hz * len(rows))
        if not (steps <= most).all():
            row, joint = np.unravel_index(int(np.argmax(steps / most)), steps.shape)
            raise InvalidInput(
                f"command: {self.robot.arm_joints[joint]} would jump by {steps[row, joint]:.3f} "
                f"rad, expected at most {most[joint]:.3f}; begin where the robot is"
            )
        if self._leaves_workspace(rows):
            rows = np.repeat(self._target[None], len(rows), axis=0)
        self._next, self._gripper_target = rows, gripper
        return CommandSent(rows[-1].copy(), gripper)

    def _leaves_workspace(self, rows: Array) -> bool:
        """Whether targets lead closer to the border than allowed; farther inwards all may lead."""
        off = [self.cell.limits.workspace.outside(self._model.fk(q)[:3, 3]) for q in rows]
        before = self.cell.limits.workspace.outside(self._model.fk(self._target)[:3, 3])
        return max(off) > max(-_BRAKING, before)

    def step(self) -> None:
        """Wait until all but the cell's `buffer` of what was commanded has been followed.

        Raises:
            RobotStopped: something is wrong; the arm was stopped, now or before.
        """
        rows, self._next = self._next, None
        if rows is None:
            rows = self._target[None]
        gripper = self._parts.gripper
        if gripper is not None and self.moves and self._gripper_target != self._gripper_sent:
            self._asked("gripper", gripper.move, self._gripper_target)
            self._gripper_sent = self._gripper_target
        link = self._linked()
        link.push(rows, 1.0 / self.rates.control_hz)
        self._target = rows[-1]
        # Nothing is sent ahead to an arm that a hand moves.
        states = link.wait(0.0 if self._guided else self.cell.control.buffer)
        self._remember(states)
        self._force = max((state.force or 0.0 for state in states), default=0.0)
        if self._guided:
            self._check_guided()
        if self._guided or not self.moves:
            self._target = self._history[-1].q
        if gripper is not None:
            self._opening = self._asked("gripper", gripper.position)
        else:
            self._opening = self._gripper_target
        for name, camera in self._parts.cameras.items():
            age = self.clock() - self._asked(f"camera {name!r}", camera.newest)
            if not age <= self.cell.control.camera_silence:
                self._fail(
                    f"camera {name!r}",
                    TimeoutError(f"its newest image is {age:.2f} s old; check its cable"),
                )

    def _check_guided(self) -> None:
        """Return if the tool was left where a command may lead it.

        Raises:
            RobotStopped: it wasn't.
        """
        tool = self._model.fk(self._history[-1].q)[:3, 3]
        if (off := self.cell.limits.workspace.outside(tool) + _BRAKING) > 0:
            self._fail(
                "arm",
                ValueError(
                    f"the tool was guided {off * 1e3:.0f} mm past where commands end, "
                    f"{_BRAKING * 1e3:.0f} mm inside the workspace; move the arm back by hand"
                ),
            )

    def _remember(self, states: Sequence[ArmState]) -> None:
        # A state that was lost on its way is told twice.
        for state in states:
            if state.time > self._history[-1].time:
                self._history.append(state)
        while self._history[-1].time - self._history[0].time > _REMEMBERED:
            self._history.popleft()

    def close(self) -> None:
        self._close()

    def _linked(self) -> Link:
        if self._parts.link is None:
            raise RobotStopped("robot stopped: the backend is closed; make it again")
        return self._parts.link

    def _asked(self, what: str, call: Callable[..., _T], *values: Any) -> _T:
        """What a part answers; if it fails, the arm is stopped."""
        try:
            return call(*values)
        except Exception as error:
            self._fail(what, error)

    def _fail(self, what: str, error: Exception) -> NoReturn:
        reason = f"robot stopped: {what}: {error or type(error).__name__}; {RESUME}"
        if self._parts.link is not None:
            self._parts.link.stop(reason)
        if isinstance(error, SartError):
            raise error
        raise RobotStopped(reason) from error


class _Parts:
    """What has to be closed."""

    def __init__(self) -> None:
        self.link: Link | None = None
        self.gripper: Gripper | None = None
        self.cameras: dict[str, Camera] = {}
        self.world: World | None = None

    def close(self) -> None:
        # The arm first: it may be moving.
        link, self.link = self.link, None
        gripper, self.gripper = self.gripper, None
        if link is not None:
            with suppress(Exception):
                link.close()
        for part in (gripper, *self.cameras.values()):
            if part is not None:
                with suppress(Exception):
                    part.disconnect()
        if self.world is not None:
            self.world.close()


class ForceHardwareBackend(HardwareBackend, SensesForce):
    """The robot of a cell whose arm senses the force at its tool."""

    def force(self) -> float:
        return self._force


class GuidedHardwareBackend(HardwareBackend, Guides):
    """The robot of a cell whose arm a person's hand may move.

    Meanwhile time passes as the person's does, whatever the cell's `speed_scale`, and the force is
    the hand's as well: the cell's limit of it has no effect.
    """

    def guide(self) -> None:
        self._linked().guide()
        self._guided = True
        self._go_at(1.0)

    def hold(self) -> None:
        if not self._guided:
            return
        state = self._linked().hold()
        self._guided = False
        self._remember([state])
        self._target = state.q
        self._go_at(self.cell.limits.speed_scale)

    def _go_at(self, pace: float) -> None:
        """Have time pass at another pace from now on."""
        now = self._history[-1].time
        self._passed += (now - self._since) * self._pace
        self._since, self._pace = now, pace


class AttendedHardwareBackend(HardwareBackend, Attended):
    """The robot of a cell in a world that does itself what a person is asked to."""

    def ask(self, text: str) -> None:
        cast(Any, self._parts.world).attend(text)


def without_motion(backend: type[HardwareBackend]) -> type[HardwareBackend]:
    """The backend of the same cell on which nothing moves."""
    return type(backend.__name__, (backend,), {"moves": False})


def cell_backend(cell: Cell | Path | str) -> type[HardwareBackend]:
    """The backend of a cell, or of the file that describes it.

    Raises:
        MissingFile, BrokenFile, InvalidInput: as `load_cell`.
        UnknownName: the driver of its arm or of its world can't be found.
    """
    found = cell if isinstance(cell, Cell) else load_cell(cell)
    arm = resolve("arm", found.arm.driver, DRIVERS["arm"])
    world = found.world and resolve("world", found.world.driver, DRIVERS["world"])
    abilities: dict[type[HardwareBackend], bool] = {
        ForceHardwareBackend: getattr(arm, "senses_force", False),
        GuidedHardwareBackend: hasattr(arm, "guide"),
        AttendedHardwareBackend: hasattr(world, "attend"),
    }
    bases = tuple(ability for ability, has in abilities.items() if has) or (HardwareBackend,)
    return type("CellBackend", bases, {"cell": found, "__doc__": HardwareBackend.__doc__})
