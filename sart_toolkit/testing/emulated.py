"""An emulated cell: an arm, a Robotiq gripper and RGB-D cameras with a simulator as their world.

`sart emulate` writes the file of such a cell, whose world is a `TaskWorld`. `EmulatedBackend` is
the hardware backend over one in any task's scene.

What is real: everything of `sart_toolkit` down to the drivers, and the gripper's socket and its
protocol. What isn't: **RTDE itself is not emulated.** In place of the modules `rtde_control` and
`rtde_receive` there are fakes with the calls that `UrRtdeArm` makes, which move and read the world
directly; no byte of RTDE is sent. The camera is a driver of its own, so `RealSense` isn't tested
here either. Time is the world's own: it passes while the arm's controller is waited for, so that
what happens depends on seeds alone, and not in real time.
"""

from __future__ import annotations

import dataclasses
import itertools
import socket
import socketserver
import sys
import threading
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from sart_toolkit.backends import DEFAULT_BACKEND, make_backend
from sart_toolkit.backends.hardware import ForceHardwareBackend, GuidedHardwareBackend
from sart_toolkit.backends.interface import Backend, Observation, Simulator
from sart_toolkit.benchmark.noise import measured_depth
from sart_toolkit.collision.sensor import SENSORS, SensorErrors, sensor_errors
from sart_toolkit.data.records import DEFAULT_RATES, Rates
from sart_toolkit.data.sampling import sample_direction
from sart_toolkit.data.storage import load_demonstration
from sart_toolkit.errors import InvalidInput, Mismatch
from sart_toolkit.hardware.cell import CameraPart, Cell, Control, Limits, Part, Workspace
from sart_toolkit.hardware.drivers import CameraImage, Clock
from sart_toolkit.hardware.robotiq import RobotiqSocket
from sart_toolkit.poses import Array, check_array, pose
from sart_toolkit.robots import get_robot
from sart_toolkit.robots.model import RobotModel
from sart_toolkit.robots.spec import ImageSize, RobotSpec, check_image_size
from sart_toolkit.scenes.spec import SceneSpec, SceneState
from sart_toolkit.tasks import get_task
from sart_toolkit.tasks.task import Placement

_FPS = 30
# At least so often a second the world's physics advances.
_PHYSICS_HZ = 240
_REMEMBERED = 1.0
_OPEN, _CLOSED = 3, 228
# How the arm brakes when it is stopped [rad/s²].
_BRAKING = 15.0


@dataclass(frozen=True)
class Emulation:
    """What the emulated parts do other than ideal ones.

    `rate_hz`: of the arm's controller. `lag` [s]: time constant with which it follows targets.
    `joint_noise` [rad], `force_noise` [N]: standard deviations. `dropped`: share of states that
    don't arrive. `latency`, `jitter` [s]: how old an image is when it arrives, and how much that
    varies. `sensor`: errors of depth and of the camera's mounting, which the cell declares;
    `holes`: share of pixels without depth. `protective_force` [N]: what makes the arm stop by
    itself. `activated`: whether the gripper has been activated before. `seed`: of all of it.
    """

    rate_hz: int = 125
    lag: float = 0.03
    joint_noise: float = 1e-5
    force_noise: float = 0.3
    dropped: float = 0.01
    latency: float = 0.03
    jitter: float = 0.005
    sensor: SensorErrors = dataclasses.replace(SENSORS["d405"], hand_eye=0.002, hand_eye_deg=0.3)
    holes: float = 0.01
    protective_force: float = 150.0
    activated: bool = True
    seed: int = 0


@dataclass(frozen=True)
class Call:
    """A call that an emulated arm got, and when [s]."""

    name: str
    time: float


@dataclass
class _Fault:
    kind: str
    time: float
    done: bool = False


# What can be made to happen at a moment; "raise:NAME" has the call NAME raise from then on.
FAULTS = (
    "protective_stop",
    "emergency_stop",
    "arm_lost",
    "arm_frozen",
    "camera_lost",
    "camera_frozen",
    "gripper_lost",
    "contact",
)


class EmulatedWorld:
    """Where an emulated arm, gripper and cameras are, in a simulated scene.

    Attributes:
        host: the address that the fakes of `ur-rtde` know it by.
        time: its time [s].
        calls: what the arm was called, the newest last.
        sent: `(time, q)` of each target that the arm was sent.
        q: where the joints really are `(n,)` [rad].
        free: whether a hand may move the arm.
    """

    _numbers = itertools.count()

    def __init__(
        self,
        robot: RobotSpec,
        scene: SceneSpec,
        image_size: ImageSize = 128,
        emulation: Emulation | None = None,
        simulator: str | type[Backend] = DEFAULT_BACKEND,
        host: str | None = None,
    ) -> None:
        """Begin with the robot at home and the bodies where the scene has them.

        Args:
            robot: the robot, its cameras where they are said to be.
            scene: what surrounds it.
            image_size: its height is that of the cameras' images, which are 4:3.
            emulation: what isn't ideal.
            simulator: what simulates it.
            host: what its parts know it by; one of its own if left out.

        Raises:
            InvalidInput: the simulator is none, or there is another world of that name.
        """
        if host in _WORLDS:
            raise InvalidInput(f"world {host!r}: is open already; close it, or name this another")
        self.emulation = it = emulation or Emulation()
        self._rng = np.random.default_rng(it.seed)
        self._robot, self._scene = robot, scene
        self._period = 1.0 / it.rate_hz
        physics = it.rate_hz * max(1, -(-_PHYSICS_HZ // it.rate_hz))
        rates = Rates(physics, it.rate_hz, it.rate_hz)
        made = make_backend(simulator, self._displaced(robot), scene, image_size, rates)
        if not isinstance(made, Simulator):
            made.close()
            raise InvalidInput(f"simulator: expected pybullet or sapien, got {made.name!r}")
        self._sim = made
        _, height = check_image_size(image_size)
        self._size = -(-height * 4 // 3), height
        self.time, self.calls, self.sent = 0.0, list[Call](), list[tuple[float, Array]]()
        self._faults: list[_Fault] = []
        self._hand: Callable[[float], Array] | None = None
        self.gripper_target = 0.0
        self.reset(scene.initial_state(robot.home, 0.0))
        self.host = host or f"emulated-{next(self._numbers)}"
        _WORLDS[self.host] = self
        _install_fakes()
        self._server = _Server(self)

    def _displaced(self, robot: RobotSpec) -> RobotSpec:
        """The robot with its cameras off by the errors of their mounting."""
        errors = self.emulation.sensor
        cameras = []
        for camera in robot.cameras:
            off = pose(
                errors.hand_eye * sample_direction(self._rng, "area"),
                errors.hand_eye_angle * sample_direction(self._rng, "area"),
            )
            T = camera.T_frame_camera @ off
            cameras.append(dataclasses.replace(camera, T_frame_camera=T))
        return dataclasses.replace(robot, cameras=tuple(cameras))

    def cell(self, limits: Limits | None = None, **control: Any) -> Cell:
        """The cell of its parts, as a person would describe it."""
        errors = self.emulation.sensor
        camera = {
            name: CameraPart(
                Part(
                    "camera",
                    "sart_toolkit.testing.emulated:EmulatedCamera",
                    {"world": self.host, "name": name},
                ),
                hand_eye_mm=errors.hand_eye * 1e3,
                hand_eye_deg=errors.hand_eye_deg,
            )
            for name in (camera.name for camera in self._robot.cameras)
        }
        host, port = self._server.address
        gripper = Part("gripper", "robotiq_socket", {"host": host, "port": port})
        return Cell(
            robot=self._robot.name,
            arm=Part("arm", "ur_rtde", {"host": self.host}),
            gripper=gripper if self._robot.gripper.driver is not None else None,
            cameras=camera,
            limits=limits or Limits(Workspace(np.full(3, -2.0), np.full(3, 2.0)), speed_scale=1.0),
            control=Control(
                **{"rate_hz": self.emulation.rate_hz, "process": False, "buffer": 0.02, **control}
            ),
        )

    def now(self) -> float:
        """Its time [s]."""
        return self.time

    # --- what a person beside it does -----------------------------------------------------------

    def reset(self, state: SceneState) -> None:
        """Put robot and bodies into a state, as a person does by hand; whatever was wrong is over.

        Of faults those that haven't happened yet remain.
        """
        self._sim.reset(state)
        self.gripper_target = state.commanded_gripper
        self._faults = [fault for fault in self._faults if not fault.done]
        self.robot_mode, self.safety_mode = 7, 1
        self._lost, self._raising = set[str](), set[str]()
        self._extra_force = 0.0
        self.q, self._velocity = np.array(state.q), np.zeros(len(state.q))
        self._target: Array | None = None
        self.free, self._guided = False, 0.0
        self._watchdog, self._kicked = np.inf, self.time
        self._seen = self._sim.observe()
        self._pressed, self._touching = 0.0, frozenset[tuple[str, str]]()
        self._history = deque([(self.time, self._state())])
        self._measure()

    def put_back(self, state: SceneState) -> None:
        """Put the bodies where a state has them, as a person does; the robot stays where it is."""
        grip = float(np.clip(self._seen.gripper, 0.0, 1.0))
        self._sim.reset(
            dataclasses.replace(state, q=self.q, gripper=grip, gripper_target=self.gripper_target)
        )
        self._seen = self._sim.observe()

    def guide(self, hand: Callable[[float], Array] | None) -> None:
        """Have a hand hold the arm, or none: it moves it as long as the arm lets it.

        Args:
            hand: where it wants the joints `(n,)` [rad] after so long [s] of moving it.
        """
        self._hand = hand

    def inject(self, kind: str, time: float) -> None:
        """Have a fault happen at a time [s]: one of `FAULTS`, or "raise:NAME" of a call."""
        assert kind in FAULTS or kind.startswith("raise:"), kind
        self._faults.append(_Fault(kind, time))

    @property
    def connections(self) -> int:
        """How many are connected to the gripper."""
        return self._server.connections

    def forget_faults(self) -> None:
        """Take back what was injected and hasn't happened yet."""
        self._faults.clear()

    def observe(self) -> Observation:
        """Where robot and bodies really are."""
        return self._sim.observe()

    @property
    def contacts(self) -> frozenset[tuple[str, str]]:
        """Which bodies touched during the last period, of those that should not."""
        return self._touching

    # --- time -----------------------------------------------------------------------------------

    def advance(self, seconds: float) -> None:
        """Let time pass [s]."""
        for _ in range(round(seconds * self.emulation.rate_hz)):
            self._tick()

    def _tick(self) -> None:
        self.time += self._period
        for fault in self._faults:
            if not fault.done and fault.time <= self.time:
                fault.done = True
                self._happen(fault.kind)
        self._move()
        self._sim.command(self.q, self.gripper_target)
        self._sim.step()
        self._seen = self._sim.observe()
        self._press()
        self._history.append((self.time, self._state()))
        while self._history[0][0] < self.time - _REMEMBERED:
            self._history.popleft()
        if self._rng.uniform() >= self.emulation.dropped and "arm_frozen" not in self._lost:
            self._measure()

    def _happen(self, kind: str) -> None:
        if kind == "protective_stop":
            self.safety_mode = 3
        elif kind == "emergency_stop":
            self.safety_mode = 7
        elif kind == "contact":
            self._extra_force = 100.0
        elif kind.startswith("raise:"):
            self._raising.add(kind.removeprefix("raise:"))
        else:
            self._lost.add(kind)
            if kind == "gripper_lost":
                self._server.hang_up()

    def _move(self) -> None:
        """Follow the target or the hand, or brake where there is none or it must not move."""
        silent = self.time - self._kicked > self._watchdog
        if self.safety_mode not in (1, 2) or silent:
            self._target, self.free = None, False
        if self.free:
            # Weightless, it stays where it is where nobody moves it.
            self._guided += self._period
            self._target = self.q if self._hand is None else self._hand(self._guided)
        if self._target is None:
            slower = np.maximum(np.abs(self._velocity) - _BRAKING * self._period, 0.0)
            self._velocity = np.sign(self._velocity) * slower
            self.q = self.q + self._velocity * self._period
            return
        share = -np.expm1(-self._period / self.emulation.lag)
        limit = self._robot.velocity_limits
        self._velocity = np.clip(share * (self._target - self.q) / self._period, -limit, limit)
        self.q = self.q + self._velocity * self._period

    def _press(self) -> None:
        found = self._sim.contacts()
        pairs = {(contact.a, contact.b) for contact in found}
        grasped = self._scene.grasped(pairs, self._robot.gripper.finger_links)
        self._touching = self._scene.outer_contacts(pairs, grasped)
        forces = [c.force for c in found if (c.a, c.b) in self._touching]
        self._pressed = max(forces, default=0.0)
        if self._pressed > self.emulation.protective_force:
            self.safety_mode = 3

    def _measure(self) -> None:
        """What the arm's controller tells from now on."""
        it, rng, n = self.emulation, self._rng, len(self.q)
        force = self._pressed + self._extra_force
        self.stamp = self.time
        self.told_q = self._seen.q + it.joint_noise * rng.standard_normal(n)
        self.told_dq = self._seen.dq
        self.told_force = np.array([0.0, 0.0, force]) + it.force_noise * rng.standard_normal(3)

    def _state(self) -> SceneState:
        seen = self._seen
        return self._scene.seen_state(seen.q, seen.gripper, seen.Ts_world_body)

    # --- what the parts ask for -----------------------------------------------------------------

    def called(self, name: str) -> None:
        """Note a call of the arm's; raises where it is to."""
        self.calls.append(Call(name, self.time))
        if "arm_lost" in self._lost or name in self._raising:
            raise RuntimeError(f"{name}: emulated failure")

    def set_free(self) -> bool:
        """Whether the arm lets a hand move it from now on, as one does that nothing else moves."""
        self.free = self.safety_mode in (1, 2) and self._target is None
        return self.free

    def servo(self, q: Array) -> bool:
        """Whether the arm takes a target."""
        if self.safety_mode not in (1, 2) or self.free:
            return False
        self.sent.append((self.time, q))
        self._target = q
        return True

    def let_go(self) -> None:
        """The arm has no target any more."""
        self._target = None

    def end_free(self) -> None:
        """No hand can move the arm any more."""
        self._target, self.free = None, False

    def kick(self, watchdog: float | None = None) -> None:
        """Its watchdog, of so long [s], is told that all is well."""
        self._watchdog = self._watchdog if watchdog is None else watchdog
        self._kicked = self.time

    @property
    def gripper_address(self) -> tuple[str, int]:
        """Host and port of the gripper's server."""
        return self._server.address

    @property
    def opening(self) -> float:
        """Where the gripper is, in [0, 1]."""
        return float(self._seen.gripper)

    def image_time(self, delay: Callable[[int], float]) -> float:
        """When the newest image was taken that has arrived, the n-th taking `delay(n)` [s]."""
        if "camera_lost" in self._lost:
            raise RuntimeError("emulated camera: device disconnected")
        if "camera_frozen" in self._lost:
            return -np.inf
        n = int(np.floor(self.time * _FPS + 1e-9))
        while n > 0 and n / _FPS + delay(n) > self.time:
            n -= 1
        return n / _FPS

    def image(self, name: str, time: float) -> CameraImage:
        """What a camera saw at a time [s]."""
        state = next((s for t, s in self._history if t >= time - 1e-9), self._history[-1][1])
        spec = self._sim.cameras[name]
        view = self._sim.draw(state, spec, *self._size)
        it = self.emulation
        depth = measured_depth(view.depth, it.sensor, it.holes, self._rng)
        return CameraImage(view.rgb, depth, spec.intrinsics(*self._size), time)

    def close(self) -> None:
        """Free all; calling it again does nothing."""
        if _WORLDS.pop(self.host, None) is not None:
            self._server.close()
            self._sim.close()
            if not _WORLDS:
                _remove_fakes()


class TaskWorld(EmulatedWorld):
    """The emulated world of a task, at the task's start, as the file of a cell describes it."""

    def __init__(
        self,
        robot: str,
        rate_hz: int,
        task: str,
        host: str = "emulated",
        simulator: str = DEFAULT_BACKEND,
        placement: Sequence[float] = (0.0, 0.0, 0.0),
        hand: str | None = None,
        image_height: int = 240,
        sensor: str = "d405",
        hand_eye_mm: float = 2.0,
        hand_eye_deg: float = 0.3,
        holes: float = Emulation.holes,
        latency: float = Emulation.latency,
        jitter: float = Emulation.jitter,
        lag: float = Emulation.lag,
        joint_noise: float = Emulation.joint_noise,
        force_noise: float = Emulation.force_noise,
        dropped: float = Emulation.dropped,
        protective_force: float = Emulation.protective_force,
        seed: int = 0,
    ) -> None:
        """Begin with robot and object at the task's start.

        Args:
            robot: the robot.
            rate_hz: of the arm's controller.
            task: the task.
            host: what its parts know it by.
            simulator: "pybullet" or "sapien".
            placement: where the object stands, x, y [m] and yaw [deg] from its middle.
            hand: a demonstration's file: a hand that holds the arm leads it as the joints went
                there.
            image_height: of the cameras' images [pixels].
            sensor: whose errors the cameras' depth has, one of `SENSORS`.
            hand_eye_mm, hand_eye_deg: how far the cameras really are from where they should be.
            holes, latency, jitter, lag, joint_noise, force_noise, dropped, protective_force,
                seed: as `Emulation` has them.

        Raises:
            UnknownName: robot, task, simulator or sensor can't be found.
            InvalidInput: a value is not acceptable.
            Mismatch: the hand's demonstration is of another robot.
        """
        found, spec = get_task(task), get_robot(robot)
        errors = sensor_errors(sensor, (hand_eye_mm / 1e3, hand_eye_deg))
        at = Placement(*check_array("placement", placement, (3,)).tolist())
        led = None if hand is None else _led(hand, spec)
        self._start = found.initial_state(RobotModel(spec, found.scene.held), at)
        it = Emulation(
            rate_hz, lag, joint_noise, force_noise, dropped, latency, jitter, errors, holes,
            protective_force, seed=seed,
        )  # fmt: skip
        super().__init__(spec, found.scene, image_height, it, simulator, host)
        self.reset(self._start)
        self.guide(led)

    def attend(self, text: str) -> None:
        """Do what a person is asked to, which is to put the object back to the start."""
        self.put_back(self._start)


def _led(path: str, robot: RobotSpec) -> Callable[[float], Array]:
    """Where a hand leads the joints `(n,)` [rad] at a time [s]: as they went in a demonstration."""
    demonstration = load_demonstration(Path(path))
    if demonstration.robot != robot.name:
        raise Mismatch(
            f"hand: {path} is of robot {demonstration.robot!r}, expected {robot.name!r}; record "
            "one of it"
        )
    joints, times = demonstration.steps.joint_positions, demonstration.timestamps
    return lambda t: np.array([np.interp(t, times, q) for q in joints.T])


class EmulatedGripper(RobotiqSocket):
    """The driver of a Robotiq gripper, connected to that of an emulated world."""

    def __init__(self, world: str, clock: Clock) -> None:
        host, port = _world(world).gripper_address
        super().__init__(host, port, clock=clock)


class EmulatedCamera:
    """A camera in an emulated world, by the world's host and the camera's name."""

    def __init__(self, world: str, name: str, clock: Clock) -> None:
        self._world, self._name, self._open = _world(world), name, False
        self._rng = np.random.default_rng([self._world.emulation.seed, 1])
        self._delays: dict[int, float] = {}

    def _delay(self, n: int) -> float:
        it = self._world.emulation
        if n not in self._delays:
            self._delays[n] = max(0.0, it.latency + it.jitter * self._rng.standard_normal())
        return self._delays[n]

    def connect(self) -> None:
        self._open = True

    def newest(self) -> float:
        if not self._open:
            raise RuntimeError("emulated camera: isn't connected")
        return self._world.image_time(self._delay)

    def read(self) -> CameraImage:
        return self._world.image(self._name, self.newest())

    def disconnect(self) -> None:
        self._open = False


class EmulatedBackend(ForceHardwareBackend, GuidedHardwareBackend):
    """The hardware backend over an emulated cell in the scene that it is given.

    Attributes:
        start: robot and bodies when it is made; home, and where the scene has them, if None.
        world: the emulated world; who uses this from Python plays the person beside it.
    """

    name = "emulated"
    emulation = Emulation()
    start: SceneState | None = None
    limits = Limits(Workspace(np.full(3, -2.0), np.full(3, 2.0)), speed_scale=1.0)
    tracking_error = limits.tracking_error

    def __init__(
        self,
        robot: RobotSpec,
        scene: SceneSpec,
        image_size: ImageSize = 128,
        rates: Rates = DEFAULT_RATES,
    ) -> None:
        self.world = EmulatedWorld(robot, scene, image_size, self.emulation)
        self.clock, self.cell = self.world.now, self.world.cell(self.limits)
        try:
            if self.start is not None:
                self.world.reset(self.start)
            super().__init__(robot, scene, image_size, rates)
        except BaseException:
            self.world.close()
            raise

    def close(self) -> None:
        super().close()
        self.world.close()


# --- in place of ur-rtde ------------------------------------------------------------------------

_WORLDS: dict[str, EmulatedWorld] = {}
_REPLACED: dict[str, ModuleType | None] = {}


def _world(host: str) -> EmulatedWorld:
    if host not in _WORLDS:
        raise RuntimeError(f"no emulated world at {host}")
    return _WORLDS[host]


def _install_fakes() -> None:
    for name, made in (
        ("rtde_control", {"RTDEControlInterface": _Control}),
        ("rtde_receive", {"RTDEReceiveInterface": _Receive}),
    ):
        if name not in _REPLACED:
            _REPLACED[name] = sys.modules.get(name)
            module = ModuleType(name)
            vars(module).update(made)
            sys.modules[name] = module


def _remove_fakes() -> None:
    for name, before in _REPLACED.items():
        if before is None:
            del sys.modules[name]
        else:
            sys.modules[name] = before
    _REPLACED.clear()


class _Receive:
    """The calls of `rtde_receive.RTDEReceiveInterface` that are made."""

    def __init__(self, hostname: str, frequency: float = -1.0) -> None:
        self._world = _world(hostname)
        self._world.called("RTDEReceiveInterface")

    def isConnected(self) -> bool:
        self._world.called("isConnected")
        return True

    def getActualQ(self) -> list[float]:
        self._world.called("getActualQ")
        return [float(x) for x in self._world.told_q]

    def getActualQd(self) -> list[float]:
        self._world.called("getActualQd")
        return [float(x) for x in self._world.told_dq]

    def getActualTCPForce(self) -> list[float]:
        self._world.called("getActualTCPForce")
        return [*map(float, self._world.told_force), 0.0, 0.0, 0.0]

    def getTimestamp(self) -> float:
        self._world.called("getTimestamp")
        # Its clock began with the controller.
        return self._world.stamp + 1000.0

    def getRobotMode(self) -> int:
        self._world.called("getRobotMode")
        return self._world.robot_mode

    def getSafetyMode(self) -> int:
        self._world.called("getSafetyMode")
        return self._world.safety_mode

    def disconnect(self) -> None:
        self._world.called("receive.disconnect")


class _Control:
    """The calls of `rtde_control.RTDEControlInterface` that are made."""

    def __init__(self, hostname: str, frequency: float = -1.0) -> None:
        self._world = _world(hostname)
        self._world.called("RTDEControlInterface")
        self._period = 1.0 / frequency

    def setWatchdog(self, min_frequency: float = 10.0) -> bool:
        self._world.called("setWatchdog")
        self._world.kick(1.0 / min_frequency)
        return True

    def kickWatchdog(self) -> bool:
        self._world.called("kickWatchdog")
        self._world.kick()
        return True

    def setPayload(self, mass: float, cog: list[float]) -> bool:
        self._world.called("setPayload")
        return True

    def zeroFtSensor(self) -> bool:
        self._world.called("zeroFtSensor")
        return True

    def servoJ(
        self, q: list[float], speed: float, acceleration: float, time: float,
        lookahead_time: float, gain: float,
    ) -> bool:  # fmt: skip
        self._world.called("servoJ")
        return self._world.servo(np.array(q))

    def initPeriod(self) -> float:
        self._world.called("initPeriod")
        return self._world.time

    def waitPeriod(self, start: float) -> None:
        self._world.called("waitPeriod")
        self._world.advance(start + self._period - self._world.time)

    def servoStop(self, a: float = 10.0) -> bool:
        self._world.called("servoStop")
        self._world.let_go()
        return True

    def teachMode(self) -> bool:
        self._world.called("teachMode")
        return self._world.set_free()

    def endTeachMode(self) -> bool:
        self._world.called("endTeachMode")
        self._world.end_free()
        return True

    def stopScript(self) -> None:
        self._world.called("stopScript")
        self._world.end_free()

    def disconnect(self) -> None:
        self._world.called("control.disconnect")


# --- in place of a gripper ----------------------------------------------------------------------


class _Server:
    """A Robotiq gripper's socket server on loopback."""

    def __init__(self, world: EmulatedWorld) -> None:
        self.gripper = _Robotiq(world)
        gripper, connections = self.gripper, self._connections = self.gripper, set[Any]()

        class Handler(socketserver.StreamRequestHandler):
            def handle(self) -> None:
                connections.add(self.connection)
                # Whoever is connected may end it at any time.
                with suppress(OSError):
                    for line in self.rfile:
                        answer = gripper.answer(line.decode(errors="replace").split())
                        self.wfile.write(answer.encode())
                connections.discard(self.connection)

        self._server = socketserver.ThreadingTCPServer(("127.0.0.1", 0), Handler)
        self._server.daemon_threads = True
        self._thread = threading.Thread(
            target=self._server.serve_forever, args=(0.01,), daemon=True
        )
        self._thread.start()

    @property
    def connections(self) -> int:
        """How many are connected."""
        return len(self._connections)

    @property
    def address(self) -> tuple[str, int]:
        host, port = self._server.server_address[:2]
        return str(host), int(port)

    def hang_up(self) -> None:
        """Close what is connected."""
        for connection in list(self._connections):
            with suppress(OSError):
                connection.shutdown(socket.SHUT_RDWR)

    def close(self) -> None:
        self.hang_up()
        self._server.shutdown()
        self._server.server_close()
        self._thread.join()


@dataclass
class _Robotiq:
    """What a 2F-85 answers over its URCap's socket."""

    world: EmulatedWorld
    values: dict[str, int] = field(
        default_factory=lambda: dict.fromkeys(("ACT", "GTO", "ATR", "ADR", "FOR", "SPE", "POS"), 0)
    )
    status: int = 0
    lock: threading.Lock = field(default_factory=threading.Lock)

    def __post_init__(self) -> None:
        if self.world.emulation.activated:
            self.values["ACT"], self.status = 1, 3

    def answer(self, words: list[str]) -> str:
        """What is sent back for the words of a line."""
        with self.lock:
            if words[:1] == ["SET"] and len(words) % 2 == 1:
                return self._set(dict(zip(words[1::2], words[2::2], strict=True)))
            if words[:1] == ["GET"] and len(words) == 2:
                return f"{words[1]} {self._get(words[1])}\n"
            return "?\n"

    def _set(self, given: Mapping[str, str]) -> str:
        if any(name not in self.values or not text.isdigit() for name, text in given.items()):
            return "?\n"
        self.values |= {name: int(text) for name, text in given.items()}
        if "ACT" in given:
            self.status = 1 if self.values["ACT"] else 0
        if "POS" in given and self.values["GTO"] and self.status == 3:
            wanted = (self.values["POS"] - _OPEN) / (_CLOSED - _OPEN)
            self.world.gripper_target = float(np.clip(wanted, 0.0, 1.0))
        return "ack"

    def _get(self, name: str) -> int | str:
        at = round(_OPEN + self.world.opening * (_CLOSED - _OPEN))
        if name == "POS":
            return int(np.clip(at, 0, 255))
        if name == "PRE":
            return self.values["POS"]
        if name == "STA":
            # It is activating for as long as nobody asks.
            now, self.status = self.status, 3 if self.status == 1 else self.status
            return now
        if name == "OBJ":
            return 3 if abs(at - self.values["POS"]) <= 2 else 0
        if name == "FLT":
            return 0
        return self.values.get(name, "?")
