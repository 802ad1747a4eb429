"""A scene as data: bodies of primitives and meshes, joints between them, light, what is held."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from sart_toolkit.errors import InvalidInput, unknown_name
from sart_toolkit.poses import (
    Array,
    check_array,
    check_pose,
    check_positive,
    frozen,
    inverse,
    log_rotation,
    pose,
)
from sart_toolkit.robots.spec import Attachment, BodyShape, CameraSpec, MeshShape, check_gripper

_LIMIT_TOLERANCE = 1e-6
_POSE_TOLERANCE = 1e-6


@dataclass(frozen=True)
class Detent:
    """A catch that a joint snaps into at `position`, effective within `width` ([rad] or [m]) of it.

    At a distance x from the catch, |x| < width, it acts with -effort sin(2 pi x / width) ([N m] or
    [N]): the nearer half draws in, the farther half keeps out.
    """

    position: float
    width: float
    effort: float

    def __post_init__(self) -> None:
        check_positive("width of a detent", self.width)
        check_positive("effort of a detent", self.effort)


@dataclass(frozen=True)
class Joint:
    """How a body moves on a body that never does: a hinge (`revolute`) or a slide (`prismatic`).

    At position 0 the body stands at `T_parent_body (4, 4)`; it turns about, or slides along, the
    line through its own origin in direction `axis (3,)`. Positions from `lower` to `upper` are
    [rad] or [m], efforts [N m] or [N]. `friction` is the dry friction that holds the joint;
    a spring of `stiffness` (effort per position) pulls towards `rest`; `detent` is a catch.
    """

    parent: str
    T_parent_body: Array
    axis: Array
    lower: float
    upper: float
    kind: Literal["revolute", "prismatic"] = "revolute"
    friction: float = 0.0
    stiffness: float = 0.0
    rest: float = 0.0
    detent: Detent | None = None

    def __post_init__(self) -> None:
        if self.kind not in ("revolute", "prismatic"):
            raise InvalidInput(f"joint kind: expected 'revolute' or 'prismatic', got {self.kind!r}")
        T = check_pose("T_parent_body", self.T_parent_body)
        object.__setattr__(self, "T_parent_body", frozen(T))
        axis = check_array("axis", self.axis, (3,))
        if abs(float(np.linalg.norm(axis)) - 1.0) > 1e-6:
            raise InvalidInput(f"joint axis: expected a unit vector, got {axis}")
        object.__setattr__(self, "axis", frozen(axis))
        for name in ("lower", "upper", "friction", "stiffness", "rest"):
            check_array(name, getattr(self, name), ())
        if not self.lower < self.upper:
            raise InvalidInput(
                f"joint limits: expected lower < upper, got {self.lower} and {self.upper}"
            )
        if self.friction < 0 or self.stiffness < 0:
            raise InvalidInput(
                f"joint: expected friction and stiffness >= 0, got {self.friction} and "
                f"{self.stiffness}"
            )

    def effort(self, position: float) -> float:
        """What spring and catch act with at a position ([N m] or [N]); friction not counted."""
        effort = self.stiffness * (self.rest - position)
        if self.detent is not None:
            x = position - self.detent.position
            if abs(x) < self.detent.width:
                effort -= self.detent.effort * float(np.sin(2 * np.pi * x / self.detent.width))
        return effort

    def T_parent_moved(self, position: float) -> Array:
        """The body's pose `(4, 4)` in its parent at a joint position."""
        offset = self.axis * position
        return self.T_parent_body @ (
            pose(rotvec=offset) if self.kind == "revolute" else pose(offset)
        )

    def position(self, T_parent_moved: Array) -> float:
        """The joint position at which the body has a pose `(4, 4)` in its parent."""
        T = inverse(self.T_parent_body) @ T_parent_moved
        if self.kind == "prismatic":
            return float(self.axis @ T[:3, 3])
        angle = float(self.axis @ log_rotation(T[:3, :3]))
        # A rotation is known up to whole turns: take the one nearest to the joint's range.
        turns = round(((self.lower + self.upper) / 2 - angle) / (2 * np.pi))
        return angle + 2 * np.pi * turns


@dataclass(frozen=True)
class Body:
    """A rigid body standing in the world; its pose is part of the `SceneState`.

    `mass` [kg], or `None` for one that never moves; `friction` is the Coulomb coefficient. A body
    with a `joint` moves on another one only; `T_world_body` is then ignored.
    """

    name: str
    shapes: tuple[BodyShape, ...]
    T_world_body: Array = field(default_factory=lambda: np.eye(4))
    mass: float | None = None
    friction: float = 0.5
    joint: Joint | None = None

    def __post_init__(self) -> None:
        if self.mass is not None:
            check_positive(f"mass of {self.name}", self.mass, "kg")
        elif self.joint is not None:
            raise InvalidInput(f"body {self.name!r}: has a joint but no mass; give it one")
        if not self.shapes:
            raise InvalidInput(f"body {self.name!r}: has no shape; give it at least one")
        T = check_pose(f"T_world_body of {self.name}", self.T_world_body)
        object.__setattr__(self, "T_world_body", frozen(T))


@dataclass(frozen=True)
class Light:
    """A distant light: `direction (3,)` from the scene towards it, world frame.

    `intensity`: what a face turned to it reflects of its colour; `ambient`: what any face does.
    `shadows`: whether bodies keep it from what is behind them. An arm's shadow in the wrist
    camera's images tells where the robot stands, which a policy learns instead of the task.
    """

    direction: Array = field(default_factory=lambda: np.array([0.3, 0.4, 1.0]))
    intensity: float = 0.35
    ambient: float = 0.6
    shadows: bool = False

    def __post_init__(self) -> None:
        direction = check_array("direction of the light", self.direction, (3,))
        if not np.linalg.norm(direction) > 0:
            raise InvalidInput("direction of the light: expected a vector of some length, got 0")
        object.__setattr__(self, "direction", frozen(direction / np.linalg.norm(direction)))
        for name in ("intensity", "ambient"):
            value = getattr(self, name)
            if not (np.isfinite(value) and value >= 0):
                raise InvalidInput(
                    f"{name} of the light: expected a finite number >= 0, got {value}"
                )


@dataclass(frozen=True)
class SceneSpec:
    """Bodies in the world, bodies fixed to the robot (`held`), cameras beside the robot's own.

    World frame: the robot's base frame, z up; `gravity (3,)` [m/s²].
    """

    bodies: tuple[Body, ...]
    held: tuple[Attachment, ...] = ()
    cameras: tuple[CameraSpec, ...] = ()
    gravity: Array = field(default_factory=lambda: np.array([0.0, 0.0, -9.81]))
    light: Light = field(default_factory=Light)

    def __post_init__(self) -> None:
        names = [body.name for body in self.bodies] + [body.name for body in self.held]
        twice = sorted({name for name in names if names.count(name) > 1})
        if twice:
            raise InvalidInput(f"scene: two bodies are called {twice[0]!r}; rename one")
        cameras = [camera.name for camera in self.cameras]
        twice = sorted({name for name in cameras if cameras.count(name) > 1})
        if twice:
            raise InvalidInput(f"scene: two cameras are called {twice[0]!r}; rename one")
        still = [body.name for body in self.bodies if body.mass is None]
        for body in self.bodies:
            if body.joint is not None and body.joint.parent not in still:
                raise unknown_name(
                    f"body without mass, which {body.name!r} moves on,", body.joint.parent, still
                )
        object.__setattr__(self, "gravity", frozen(check_array("gravity", self.gravity, (3,))))

    @property
    def meshes(self) -> dict[str, list[MeshShape]]:
        """The meshes of each body that has some, standing or held, by its name."""
        bodies: list[Body | Attachment] = [*self.bodies, *self.held]
        found = {
            body.name: [shape for shape in body.shapes if isinstance(shape, MeshShape)]
            for body in bodies
        }
        return {name: shapes for name, shapes in found.items() if shapes}

    @property
    def mesh_digests(self) -> dict[str, list[str]]:
        """What tells the meshes from others, by their files' content, by the body's name."""
        return {name: [s.digest for s in shapes] for name, shapes in self.meshes.items()}

    @property
    def jointed(self) -> dict[str, Body]:
        """The bodies that move on others, by name."""
        return {body.name: body for body in self.bodies if body.joint is not None}

    def initial_state(
        self,
        q: Array,
        gripper: float,
        Ts_world_body: Mapping[str, Array] | None = None,
        joint_positions: Mapping[str, float] | None = None,
        gripper_target: float | None = None,
    ) -> SceneState:
        """The state with the robot at `q`, bodies where the scene has them or where given.

        Args:
            q: robot joints `(n,)` [rad].
            gripper: where the gripper is, in [0, 1].
            Ts_world_body: poses `(4, 4)` of bodies that stand by themselves.
            joint_positions: of bodies that move on others, by the body's name; 0 where left out.
            gripper_target: command in force, where it differs from `gripper`.

        Raises:
            UnknownName: a given body isn't in the scene, or isn't of that sort.
        """
        poses = {body.name: body.T_world_body for body in self.bodies if body.joint is None}
        for name, T in (Ts_world_body or {}).items():
            if name not in poses:
                raise unknown_name("body", name, poses)
            poses[name] = T
        positions = dict.fromkeys(self.jointed, 0.0)
        for name, position in (joint_positions or {}).items():
            if name not in positions:
                raise unknown_name("body with a joint", name, positions)
            positions[name] = float(position)
        for name, body in self.jointed.items():
            assert body.joint is not None
            poses[name] = poses[body.joint.parent] @ body.joint.T_parent_moved(positions[name])
        return SceneState(q, gripper, poses, positions, gripper_target)

    def seen_state(
        self, q: Array, gripper: float, Ts_world_body: Mapping[str, Array]
    ) -> SceneState:
        """The state with the robot and all bodies where they were measured.

        Args:
            q: robot joints `(n,)` [rad].
            gripper: where the gripper is; a measured one may be a little outside [0, 1].
            Ts_world_body: poses `(4, 4)` of at least the scene's bodies.

        Raises:
            UnknownName: a body's pose is missing.
        """
        for body in self.bodies:
            if body.name not in Ts_world_body:
                raise unknown_name("body", body.name, Ts_world_body)
        joints = {}
        for name, body in self.jointed.items():
            assert body.joint is not None
            at = self.joint_position(name, Ts_world_body)
            joints[name] = float(np.clip(at, body.joint.lower, body.joint.upper))
        free = {b.name: Ts_world_body[b.name] for b in self.bodies if b.joint is None}
        return self.initial_state(q, float(np.clip(gripper, 0.0, 1.0)), free, joints)

    def joint_position(self, name: str, Ts_world_body: Mapping[str, Array]) -> float:
        """The position [rad or m] of the joint that body `name` moves on, from all bodies' poses.

        Raises:
            UnknownName: the body has no joint, or a pose is missing.
        """
        if name not in self.jointed:
            raise unknown_name("body with a joint", name, self.jointed)
        joint = self.jointed[name].joint
        assert joint is not None
        for each in (name, joint.parent):
            if each not in Ts_world_body:
                raise unknown_name("body", each, Ts_world_body)
        return joint.position(inverse(Ts_world_body[joint.parent]) @ Ts_world_body[name])

    def grasped(
        self, touching: Iterable[tuple[str, str]], finger_links: Sequence[str]
    ) -> frozenset[str]:
        """The bodies in a grasp: those free to move that two or more of the fingers touch.

        Args:
            touching: pairs of names that touch.
            finger_links: the gripper's.
        """
        free = {b.name for b in self.bodies if b.mass is not None and b.joint is None}
        pairs = {pair for a, b in touching for pair in ((a, b), (b, a))}
        fingers = Counter(b for a, b in pairs if a in finger_links and b in free)
        return frozenset(name for name, count in fingers.items() if count >= 2)

    def outer_contacts(
        self, touching: Iterable[tuple[str, str]], grasped: Collection[str]
    ) -> frozenset[tuple[str, str]]:
        """Those pairs in which the robot, or what it grasps, touches what it doesn't grasp.

        Args:
            touching: pairs of names that touch.
            grasped: names of bodies in the gripper's grasp.
        """
        standing = {body.name for body in self.bodies}.difference(grasped)
        return frozenset(pair for pair in touching if len(standing.intersection(pair)) == 1)

    def check_state(self, state: SceneState) -> None:
        """Refuse a state that isn't one of this scene; the robot's joints are not checked.

        Raises:
            UnknownName: it has a body that the scene hasn't, or lacks one.
            InvalidInput: a joint is outside its limits, or a body isn't where its joint has it.
        """
        known = [body.name for body in self.bodies]
        for kind, names, wanted in (
            ("body in the state", state.Ts_world_body, known),
            ("joint in the state", state.joint_positions, self.jointed),
        ):
            odd = sorted(set(names) ^ set(wanted))
            if odd:
                raise unknown_name(kind, odd[0], wanted)
        for name, body in self.jointed.items():
            joint, position = body.joint, state.joint_positions[name]
            assert joint is not None
            if not joint.lower - _LIMIT_TOLERANCE <= position <= joint.upper + _LIMIT_TOLERANCE:
                raise InvalidInput(
                    f"joint of {name!r}: {position:.3f} is outside its limits "
                    f"[{joint.lower:.3f}, {joint.upper:.3f}]"
                )
            T = state.Ts_world_body[joint.parent] @ joint.T_parent_moved(position)
            if np.abs(T - state.Ts_world_body[name]).max() > _POSE_TOLERANCE:
                raise InvalidInput(
                    f"pose of {name!r}: isn't where its joint at {position:.3f} has it; make "
                    "states with SceneSpec.initial_state"
                )


@dataclass(frozen=True)
class SceneState:
    """Where all is at rest: joints `q (n,)` [rad], gripper in [0, 1], body poses `(4, 4)`.

    `joint_positions` ([rad] or [m]) are those of the bodies that move on others, whose poses
    follow. `gripper_target` is the command in force where it isn't `gripper`: beyond it where
    something is grasped.
    """

    q: Array
    gripper: float
    Ts_world_body: Mapping[str, Array]
    joint_positions: Mapping[str, float] = field(default_factory=dict)
    gripper_target: float | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "q", frozen(check_array("q", self.q, (None,))))
        for value in (self.gripper, self.commanded_gripper):
            check_gripper(value)
        poses = {k: frozen(check_pose(k, T)) for k, T in self.Ts_world_body.items()}
        object.__setattr__(self, "Ts_world_body", poses)
        positions = {
            k: float(check_array(f"joint of {k}", v, ())) for k, v in self.joint_positions.items()
        }
        object.__setattr__(self, "joint_positions", positions)

    @property
    def commanded_gripper(self) -> float:
        """The gripper command in force, in [0, 1]."""
        return self.gripper if self.gripper_target is None else self.gripper_target
