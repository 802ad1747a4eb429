"""What all devices that a person holds have in common: speeds, frames, a smooth hand, the keys."""

from __future__ import annotations

import abc
import enum
from dataclasses import dataclass

import numpy as np

from sart_toolkit.backends.interface import Observation
from sart_toolkit.errors import InvalidInput
from sart_toolkit.poses import Array, inverse
from sart_toolkit.record.session import Device, DeviceSetup, Frame, TeleopCommand
from sart_toolkit.robots.model import RobotModel
from sart_toolkit.scenes.spec import SceneSpec

# Time constant [s] with which the tool's velocity follows the hand: a tap is a small, soft move.
_REACTION = 0.1
# Slower than this [m/s, rad/s] the tool stands, so that the end of a demonstration is still.
_STILL = 5e-4


@dataclass(frozen=True)
class Speed:
    """How fast the tool goes at full deflection: `linear` [m/s], `turn_deg` [deg/s]."""

    name: str
    linear: float
    turn_deg: float


SPEEDS = (Speed("slow", 0.02, 8.0), Speed("normal", 0.06, 25.0), Speed("fast", 0.15, 60.0))


class Control(enum.Enum):
    """What a person asks of the recording, beside steering."""

    NEXT = "next"
    REDO = "redo"
    DISCARD = "discard"


@dataclass(frozen=True)
class Views:
    """Which way is which for a hand that moves right, forward and up by what is on the screen.

    `R_world_hand (3, 3)`: right and away in the scene view, level, and vertically up.
    `R_tool_hand (3, 3)`: right and upwards in the wrist image, and back out along the tool.
    """

    R_world_hand: Array
    R_tool_hand: Array


def views(model: RobotModel, scene: SceneSpec) -> Views:
    """The hand's directions for a robot and its scene.

    Without a camera in the scene the person is taken to stand behind the robot, and without one on
    the tool to see its x axis point right.

    Args:
        model: the robot's kinematics, with the first camera on its tool.
        scene: has the camera of the scene view.
    """
    up = np.array([0.0, 0.0, 1.0])
    right = np.array([0.0, -1.0, 0.0])
    fixed = [camera for camera in scene.cameras if camera.frame == "world"]
    if fixed:
        level = fixed[0].T_frame_camera[:3, 0] * [1.0, 1.0, 0.0]
        # A camera on its side has no level right; the robot's will do.
        if np.linalg.norm(level) > 0.1:
            right = level / np.linalg.norm(level)
    tool_right, home = np.eye(3)[0], model.spec.home
    mounted = [c for c in model.spec.cameras if model.mount_of(c.frame) == "tool"]
    for camera in mounted[:1]:
        T_tool_frame = inverse(model.fk(home)) @ model.fk(home, camera.frame)
        across = (T_tool_frame @ camera.T_frame_camera)[:2, 0]
        # Along an axis of the tool, though the camera be mounted a little askew.
        axis = int(np.argmax(np.abs(across)))
        tool_right = np.eye(3)[axis] * np.sign(across[axis])
    return Views(_axes(right, up), _axes(tool_right, -up))


def _axes(right: Array, up: Array) -> Array:
    return np.stack([right, np.cross(up, right), up], axis=1)


class ManualDevice(Device):
    """A device in a person's hand.

    A subclass returns from `poll` how the hand pushes and turns; speed, frame, smoothness and
    gripper are handled here, as are the keys that work with every device.

    Attributes:
        speed: one of `SPEEDS`.
        frame: what the directions are fixed to.
        gripper: the command, in [0, 1].
    """

    interactive = True
    key_map: tuple[tuple[str, str], ...] = ()

    def __init__(self, setup: DeviceSetup) -> None:
        """Not connected yet; the gripper as at the task's start.

        Raises:
            InvalidInput: no such frame.
        """
        if setup.frame not in ("world", "tool"):
            raise InvalidInput(f"frame: expected 'world' or 'tool', got {setup.frame!r}")
        self.operator = setup.operator
        self.speed = SPEEDS[1]
        self.frame: Frame = setup.frame
        self._views = views(setup.model, setup.backend.scene)
        self._dt = 1.0 / setup.backend.rates.control_hz
        self._start_gripper = setup.state.commanded_gripper
        self._controls: list[Control] = []
        self.rest()

    @abc.abstractmethod
    def connect(self) -> None:
        """Find and open the device, again if it was lost.

        Raises:
            DeviceLost: it isn't there.
            MissingExtra: its library isn't installed.
        """

    @abc.abstractmethod
    def poll(self) -> Array:
        """How far the hand pushes and turns now: `(6,)`, each in [-1, 1].

        Right, forward, up; then turns about these axes by the right-hand rule.

        Raises:
            DeviceLost: it no longer answers.
        """

    def close(self) -> None:
        """Let go of the hardware; calling it again does nothing."""
        return

    def rest(self) -> None:
        """The hand at rest and the gripper as at the start, for another attempt."""
        self.gripper = self._start_gripper
        self.halt()
        self.let_go()

    def halt(self) -> None:
        """Begin again from rest, though something is pressed."""
        self._velocity = np.zeros(6)

    def let_go(self) -> None:
        """Forget what is pressed: the window is no longer notified when keys are released."""
        return

    def key(self, name: str, down: bool) -> bool:
        """Take a key that went down or up; whether it means anything here.

        Args:
            name: pygame's name of the key, such as "w" or "space".
            down: whether it went down.
        """
        if name in ("1", "2", "3"):
            if down:
                self.speed = SPEEDS[int(name) - 1]
        elif name == "f":
            if down:
                self.switch_frame()
        elif name == "space":
            if down:
                self.switch_gripper()
        else:
            return False
        return True

    def switch_frame(self) -> None:
        """Steer in the other frame from now on."""
        self.frame = "tool" if self.frame == "world" else "world"

    def switch_gripper(self) -> None:
        """Open the gripper if it is commanded to hold, close it if it is commanded to open."""
        self.gripper = 0.0 if self.gripper > 0.5 else 1.0

    def change_speed(self, by: int) -> None:
        """Faster or slower by so many of `SPEEDS`."""
        at = SPEEDS.index(self.speed) + by
        self.speed = SPEEDS[min(max(at, 0), len(SPEEDS) - 1)]

    def next_speed(self) -> None:
        """The next faster of `SPEEDS`, and after the fastest the slowest."""
        self.speed = SPEEDS[(SPEEDS.index(self.speed) + 1) % len(SPEEDS)]

    def controls(self) -> list[Control]:
        """What was asked for with the device's own buttons since the last call."""
        taken, self._controls = self._controls, []
        return taken

    def read(self, observation: Observation) -> TeleopCommand:
        axes = np.clip(self.poll(), -1.0, 1.0)
        # Two keys at once shall not be faster than one.
        for part in (slice(0, 3), slice(3, 6)):
            axes[part] /= max(1.0, float(np.linalg.norm(axes[part])))
        wanted = axes * np.repeat([self.speed.linear, np.deg2rad(self.speed.turn_deg)], 3)
        R_tool_hand = self._views.R_tool_hand
        if self.frame == "world":
            R_tool_hand = observation.T_world_tool[:3, :3].T @ self._views.R_world_hand
        wanted = np.concatenate([R_tool_hand @ wanted[:3], R_tool_hand @ wanted[3:]])
        self._velocity = self._velocity + (self._dt / (_REACTION + self._dt)) * (
            wanted - self._velocity
        )
        if not wanted.any() and np.abs(self._velocity).max() < _STILL:
            self._velocity = np.zeros(6)
        return TeleopCommand(self._velocity, self.gripper)
