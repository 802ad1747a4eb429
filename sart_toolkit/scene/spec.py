"""A scene as data: bodies made of convex shapes, and what the gripper holds."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from sart_toolkit.errors import InvalidInput, unknown_name
from sart_toolkit.poses import Array, check_array, check_pose, check_positive, frozen
from sart_toolkit.robots.spec import Attachment, CameraSpec, Shape


@dataclass(frozen=True)
class Body:
    """A rigid body standing in the world; its pose is part of the `SceneState`.

    `mass` [kg], or `None` for one that never moves; `friction` is the Coulomb coefficient.
    """

    name: str
    shapes: tuple[Shape, ...]
    T_world_body: Array = field(default_factory=lambda: np.eye(4))
    mass: float | None = None
    friction: float = 0.5

    def __post_init__(self) -> None:
        if self.mass is not None:
            check_positive(f"mass of {self.name}", self.mass, "kg")
        if not self.shapes:
            raise InvalidInput(f"body {self.name!r}: has no shape; give it at least one")
        T = check_pose(f"T_world_body of {self.name}", self.T_world_body)
        object.__setattr__(self, "T_world_body", frozen(T))


@dataclass(frozen=True)
class SceneSpec:
    """Bodies in the world, bodies fixed to the robot (`held`), cameras beside the robot's own.

    World frame: the robot's base frame, z up; `gravity (3,)` [m/s²].
    """

    bodies: tuple[Body, ...]
    held: tuple[Attachment, ...] = ()
    cameras: tuple[CameraSpec, ...] = ()
    gravity: Array = field(default_factory=lambda: np.array([0.0, 0.0, -9.81]))

    def __post_init__(self) -> None:
        names = [body.name for body in self.bodies] + [body.name for body in self.held]
        twice = sorted({name for name in names if names.count(name) > 1})
        if twice:
            raise InvalidInput(f"scene: two bodies are called {twice[0]!r}; rename one")
        cameras = [camera.name for camera in self.cameras]
        twice = sorted({name for name in cameras if cameras.count(name) > 1})
        if twice:
            raise InvalidInput(f"scene: two cameras are called {twice[0]!r}; rename one")
        object.__setattr__(self, "gravity", frozen(check_array("gravity", self.gravity, (3,))))

    def initial_state(
        self, q: Array, gripper: float, Ts_world_body: Mapping[str, Array] | None = None
    ) -> SceneState:
        """The state with the robot at `q`, bodies where the scene has them or where told.

        Raises:
            UnknownName: a body in `Ts_world_body` isn't in the scene.
        """
        poses = {body.name: body.T_world_body for body in self.bodies}
        for name, T in (Ts_world_body or {}).items():
            if name not in poses:
                raise unknown_name("body", name, poses)
            poses[name] = T
        return SceneState(q, gripper, poses)


@dataclass(frozen=True)
class SceneState:
    """Where all is at rest: joints `q (n,)` [rad], gripper in [0, 1], body poses `(4, 4)`."""

    q: Array
    gripper: float
    Ts_world_body: Mapping[str, Array]

    def __post_init__(self) -> None:
        object.__setattr__(self, "q", frozen(check_array("q", self.q, (None,))))
        if not 0.0 <= self.gripper <= 1.0:
            raise InvalidInput(f"gripper: expected 0 (open) to 1 (closed), got {self.gripper}")
        poses = {k: frozen(check_pose(k, T)) for k, T in self.Ts_world_body.items()}
        object.__setattr__(self, "Ts_world_body", poses)
