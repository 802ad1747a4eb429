"""The interface between the toolkit and a simulator or robot."""

from __future__ import annotations

import abc
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from sart_toolkit.data.records import DepthImage, Image
from sart_toolkit.errors import InvalidInput, MissingCapability, unknown_name
from sart_toolkit.poses import Array
from sart_toolkit.robots.spec import CameraSpec, RobotSpec
from sart_toolkit.scenes.spec import SceneSpec, SceneState


@dataclass(frozen=True)
class Capabilities:
    """What a backend can do; asking for more raises `MissingCapability`, nothing is silent.

    `drift` [m] and `drift_deg`: how far robot and resting bodies may be, a second after a restore,
    from where they would have been without; 0 where it makes no difference at all.
    """

    can_restore: bool
    has_contacts: bool
    renders: bool
    observes_bodies: bool
    drift: float = 1e-3
    drift_deg: float = 0.2


@dataclass(frozen=True)
class CameraView:
    """One picture: `rgb (H,W,3)` uint8, `depth (H,W)` float32 [m] along z, 0 where nothing was hit.

    `T_world_camera (4,4)`: where it was taken from, z forward, x right, y down.
    """

    rgb: Image
    depth: DepthImage
    T_world_camera: Array


@dataclass(frozen=True)
class Observation:
    """What the robot measures now.

    `q`, `dq (n,)` [rad, rad/s]; `gripper` in [0, 1]; `T_world_tool (4,4)`; `time` [s] since reset;
    `cameras` holds the pictures asked for; `Ts_world_body` the simulated bodies, held ones too.
    `joint_path (m, n)` [rad]: where the joints were during the last control period, measured as
    often as the backend can (our simulators: after each physics step), oldest first, the last row
    being `q`; no rows after `reset` or `restore`, and where the backend doesn't measure it.
    """

    q: Array
    dq: Array
    gripper: float
    T_world_tool: Array
    time: float
    cameras: Mapping[str, CameraView] = field(default_factory=dict)
    Ts_world_body: Mapping[str, Array] = field(default_factory=dict)
    joint_path: Array = field(default_factory=lambda: np.empty((0, 0)))

    def __post_init__(self) -> None:
        if len(self.joint_path) == 0:
            object.__setattr__(self, "joint_path", np.empty((0, len(self.q))))


@dataclass(frozen=True)
class Contact:
    """Two bodies that touched during the last control period, at any of its physics steps.

    `a`, `b`: link or body names, in alphabetical order; `force` [N]: greatest normal force;
    `penetration` [m] >= 0.
    """

    a: str
    b: str
    force: float
    penetration: float


def check_size(image_size: int) -> int:
    """`image_size` if it is a picture's width and height [pixels].

    Raises:
        InvalidInput: it is not positive.
    """
    if image_size < 1:
        raise InvalidInput(f"image_size: expected at least 1 pixel, got {image_size}")
    return image_size


class Backend(abc.ABC):
    """A robot in its scene, stepped at 30 Hz: what every simulator and robot implements.

    Attributes:
        robot: the robot's specification.
        scene: what surrounds it.
        image_size: width and height of pictures [pixels].
        capabilities: what it can do, readable before connecting.
    """

    name: str
    capabilities: Capabilities

    def __init__(self, robot: RobotSpec, scene: SceneSpec, image_size: int = 128) -> None:
        self.robot = robot
        self.scene = scene
        self.image_size = check_size(image_size)

    @property
    def cameras(self) -> dict[str, CameraSpec]:
        """The cameras by name: the robot's wrist camera and the scene's."""
        return {c.name: c for c in (self.robot.wrist_camera, *self.scene.cameras)}

    def _check_cameras(self, names: Sequence[str]) -> None:
        known = self.cameras
        for name in names:
            if name not in known:
                raise unknown_name("camera", name, known)

    @abc.abstractmethod
    def reset(self, state: SceneState) -> None:
        """Put robot and bodies at rest in a state; time becomes 0.

        The joint targets become the state's own, the gripper's target its `commanded_gripper`.

        Raises:
            InvalidInput: joints of the wrong number or outside their limits, or a body that isn't
                where its joint has it.
            UnknownName: the state has a body that the scene hasn't, or lacks one.
        """

    @abc.abstractmethod
    def observe(self, cameras: Sequence[str] = (), image_size: int | None = None) -> Observation:
        """Measure joints, gripper, tool and bodies, with pictures of the named cameras.

        Args:
            cameras: names of the cameras whose pictures are wanted.
            image_size: width and height of the pictures, where not the backend's own.

        Raises:
            UnknownName: no such camera.
        """

    @abc.abstractmethod
    def command(self, q: Array, gripper: float) -> None:
        """Set joint targets `(n,)` [rad] and gripper target in [0, 1], reached over the next step.

        Raises:
            InvalidInput: wrong shape, not finite, outside limits.
        """

    @abc.abstractmethod
    def step(self) -> None:
        """Advance one control period, 1/30 s."""

    @abc.abstractmethod
    def save(self) -> bytes:
        """The state as bytes that `restore` takes, in this process or another.

        Raises:
            MissingCapability: `can_restore` is false.
        """

    @abc.abstractmethod
    def restore(self, state: bytes) -> None:
        """Return to a saved state exactly.

        Raises:
            BrokenFile: the bytes are damaged or of another robot or scene.
            MissingCapability: `can_restore` is false.
        """

    @abc.abstractmethod
    def contacts(self) -> list[Contact]:
        """Which bodies touched during the last `step`, in order of their names.

        Every pair with a robot link, a held body or a scene body that can move counts. Left out are
        pairs that never move, links of the robot that neighbour each other, and a body with a joint
        against the one that it moves on. None have touched after `reset` or `restore`.

        Raises:
            MissingCapability: `has_contacts` is false.
        """

    @abc.abstractmethod
    def close(self) -> None:
        """Free the simulator or connection; calling it again does nothing."""

    def _lacks(self, what: str) -> MissingCapability:
        return MissingCapability(f"backend {self.name!r} can't {what}; use another backend")


# Makes a robot in its scene; picklable where it goes to other processes.
BackendFactory = Callable[[], Backend]
