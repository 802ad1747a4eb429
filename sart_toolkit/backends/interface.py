"""The interface between the toolkit and a simulator or robot: a small core, and abilities.

The core, `Backend`, is what a hardware arm has. All else is an ability: a class of one or two
methods that a backend also inherits and that code asks for by type. `require` returns a backend
that has one, or says which is missing and what for:

    require(backend, Resets, "a rollout starts from the task's initial state").reset(state)
"""

from __future__ import annotations

import abc
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, TypeVar

import numpy as np

from sart_toolkit.data.records import DEFAULT_RATES, DepthImage, Image, Rates
from sart_toolkit.errors import MissingCapability, unknown_name
from sart_toolkit.poses import Array, up_in_tool
from sart_toolkit.robots.spec import CameraSpec, ImageSize, RobotSpec, check_image_size
from sart_toolkit.scenes.spec import SceneSpec, SceneState


@dataclass(frozen=True)
class CameraView:
    """One image: `rgb (H,W,3)` uint8, `depth (H,W)` float32 [m] along z, 0 where nothing was hit.

    `T_world_camera (4,4)`: where it was taken from, z forward, x right, y down.
    """

    rgb: Image
    depth: DepthImage
    T_world_camera: Array


@dataclass(frozen=True)
class Observation:
    """What the robot measures now.

    `q`, `dq (n,)` [rad, rad/s]; `gripper` in [0, 1]; `T_world_tool (4,4)`; `time` [s] since the
    start or the last reset; `cameras` holds the images asked for; `Ts_world_body` where the
    bodies are, held ones too, as `KnowsBodies.body_poses` has them (empty without that ability).
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

    @property
    def up(self) -> Array:
        """How the tool is tilted: the world's upward direction `(3,)` in the tool frame."""
        return up_in_tool(self.T_world_tool)

    def __post_init__(self) -> None:
        if len(self.joint_path) == 0:
            object.__setattr__(self, "joint_path", np.empty((0, len(self.q))))


@dataclass(frozen=True)
class CommandSent:
    """The last joint targets `q (n,)` [rad] and the gripper target in [0, 1] really sent."""

    q: Array
    gripper: float


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


class Backend(abc.ABC):
    """A robot in its scene, moved one control period at a time: what every backend implements.

    Attributes:
        robot: the robot's specification.
        scene: what surrounds it.
        image_size: width and height of images [pixels].
        rates: how often it is commanded, measured and recorded.
        no_images: why `observe` takes no images (here); empty where it does.
        tracking_error: how far [m] any point of the robot may be from the path of joints that it is
            commanded, as long as nothing touches it. Augmented segments are proved clear with that
            much more room, and one on which it was exceeded is rejected.
    """

    name: str
    no_images: str = ""
    tracking_error: float = 1e-3

    def __init__(
        self,
        robot: RobotSpec,
        scene: SceneSpec,
        image_size: ImageSize = 128,
        rates: Rates = DEFAULT_RATES,
    ) -> None:
        self.robot = robot
        self.scene = scene
        self.image_size = check_image_size(image_size)
        self.rates = rates

    @property
    def cameras(self) -> dict[str, CameraSpec]:
        """The cameras by name: the robot's and the scene's."""
        return {c.name: c for c in (*self.robot.cameras, *self.scene.cameras)}

    @property
    def delays(self) -> dict[str, float]:
        """How old [s] each camera's images were, on average, when they arrived, by its name.

        Empty where images are of the moment at which they are asked for.
        """
        return {}

    def check_cameras(self, names: Sequence[str]) -> None:
        """Return if images of the named cameras can be taken.

        Raises:
            UnknownName: there is no such camera.
            MissingCapability: this backend takes no images.
        """
        known = self.cameras
        for name in names:
            if name not in known:
                raise unknown_name("camera", name, known)
        if names and self.no_images:
            raise MissingCapability(
                f"backend {self.name!r} takes no images: {self.no_images}; use another backend"
            )

    @abc.abstractmethod
    def observe(
        self, cameras: Sequence[str] = (), image_size: ImageSize | None = None
    ) -> Observation:
        """Measure joints, gripper and tool, with images of the named cameras.

        Args:
            cameras: names of the cameras whose images are wanted.
            image_size: width and height of the images, where not the backend's own.

        Raises:
            UnknownName: no such camera.
            MissingCapability: images are asked for where it takes none.
        """

    @abc.abstractmethod
    def command(self, q: Array, gripper: float) -> CommandSent:
        """Set the joint targets and the gripper target of the next step.

        The toolkit sends targets for each physics step, smooth and within the robot's limits of
        velocity, acceleration and jerk (`JointInterpolator`), so that they can be passed on as they
        are. Where the robot can't go so far in one step, less may be sent.

        Args:
            q: targets [rad] `(m, n)` at m even steps up to the end of the control period, or one
                `(n,)` for its end; in between they are joined linearly.
            gripper: target in [0, 1], 0 open, 1 closed, reached linearly.

        Returns:
            The last targets `(n,)` that were really sent.

        Raises:
            InvalidInput: wrong shape, not finite, outside limits.
        """

    @abc.abstractmethod
    def step(self) -> None:
        """Advance, or wait for, one control period."""

    @abc.abstractmethod
    def close(self) -> None:
        """Free the simulator or connection; calling it again does nothing."""


class Resets(abc.ABC):
    """Can put robot and bodies into a state."""

    @abc.abstractmethod
    def reset(self, state: SceneState) -> None:
        """Put robot and bodies at rest in a state; time becomes 0.

        The joint targets become the state's own, the gripper's target its `commanded_gripper`.

        Raises:
            InvalidInput: joints of the wrong number or outside their limits, or a body that isn't
                where its joint has it.
            UnknownName: the state has a body that the scene hasn't, or lacks one.
        """


class SavesStates(abc.ABC):
    """Can return to where it was.

    Attributes:
        drift, drift_deg: how far [m], [deg] robot and resting bodies may be, a second after a
            restore, from where they would have been without; 0 where it makes no difference at all.
    """

    drift: float = 1e-3
    drift_deg: float = 0.2

    @abc.abstractmethod
    def save(self) -> bytes:
        """The state as bytes that `restore` takes, in this process or another."""

    @abc.abstractmethod
    def restore(self, state: bytes) -> None:
        """Return to a saved state exactly.

        Raises:
            BrokenFile: the bytes are damaged or of another robot or scene.
        """


class SensesForce(abc.ABC):
    """Senses the contact force."""

    @abc.abstractmethod
    def force(self) -> float:
        """The greatest contact force [N] during the last `step`; 0 after `reset` or `restore`."""


class SensesContacts(SensesForce):
    """Knows which bodies touch, and so how hard."""

    @abc.abstractmethod
    def contacts(self) -> list[Contact]:
        """Which bodies touched during the last `step`, in order of their names.

        Every pair with a robot link, a held body or a scene body that can move counts. Left out are
        pairs that never move, links of the robot that neighbour each other, and a body with a joint
        against the one that it moves on. None have touched after `reset` or `restore`.
        """

    def force(self) -> float:
        return max((contact.force for contact in self.contacts()), default=0.0)


class Attended(abc.ABC):
    """Has somebody, or something, beside it that does what a person there is asked to."""

    @abc.abstractmethod
    def ask(self, text: str) -> None:
        """Have done what a text says; returns when it is done."""


class Guides(abc.ABC):
    """Can have its arm moved by a person's hand."""

    @abc.abstractmethod
    def guide(self) -> None:
        """Leave the arm to a person's hand: targets of joints have no effect until `hold`.

        The gripper goes where it is commanded, and time passes as it does for the person.

        Raises:
            RobotStopped: something is wrong.
        """

    @abc.abstractmethod
    def hold(self) -> None:
        """Take the arm back, at rest where it is; without `guide` nothing happens.

        Raises:
            RobotStopped: something is wrong; the hand can't move it any more either.
        """


class KnowsBodies(abc.ABC):
    """Knows where the bodies are: those of the scene and those that the robot holds."""

    @abc.abstractmethod
    def body_poses(self) -> dict[str, Array]:
        """The poses `(4, 4)` of all bodies in the world now, by name.

        `observe` gives the same as `Observation.Ts_world_body`, which is where to read them.
        """


class Draws(abc.ABC):
    """Can draw robot and scene in any state."""

    @abc.abstractmethod
    def draw(self, state: SceneState, camera: CameraSpec, width: int, height: int) -> CameraView:
        """An image of a state by a camera, which need not be one of the backend's.

        Nothing else changes: robot and bodies stay as they are.

        Raises:
            MissingCapability: nothing can be drawn on this machine.
        """


class Simulator(Backend, Resets, SavesStates, SensesContacts, KnowsBodies, Draws):
    """A backend with all abilities, as simulators have them."""


A = TypeVar("A")


def require(backend: Backend, ability: type[A], purpose: str) -> A:
    """The backend itself, as one that has an ability.

    Args:
        backend: any backend.
        ability: one of the classes above.
        purpose: what needs it, as a clause: "segments start from saved states".

    Raises:
        MissingCapability: it lacks the ability.
    """
    if not isinstance(backend, ability):
        raise MissingCapability(
            f"backend {backend.name!r} lacks the ability {ability.__name__}, but {purpose}; use "
            "another backend"
        )
    return backend


def missing_abilities(backend: Backend, abilities: Sequence[type[Any]]) -> list[str]:
    """The names of those abilities that a backend lacks."""
    return [ability.__name__ for ability in abilities if not isinstance(backend, ability)]


# Makes a robot in its scene; picklable where it goes to other processes.
BackendFactory = Callable[[], Backend]
