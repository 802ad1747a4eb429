"""The frozen records that the stages hand to each other; arrays are copied in and read-only."""

from __future__ import annotations

import dataclasses
import functools
import hashlib
import importlib.metadata
import json
import numbers
import platform
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from sart_toolkit.errors import InvalidInput, Mismatch
from sart_toolkit.poses import (
    Array,
    apply_motion,
    check_array,
    check_pose,
    check_poses,
    check_positive,
    frozen,
    relative_motion,
)

Image = NDArray[np.uint8]
DepthImage = NDArray[np.float32]
ACTION_SIZE = 7
CameraFrame = Literal["tool", "world"]
Judge = Literal["task", "person", "nobody"]
Recording = Literal["reversed", "return"]
# nu_r [rad/m]: rotation drawn per metre of radius, the published code's value.
ROTATION_PER_METRE = 2.0


@dataclass(frozen=True)
class Rates:
    """How often things happen [Hz]: physics steps, commands, recorded steps; each divides the last.

    On hardware `physics_hz` is how often the joints can be measured. A policy acts at `record_hz`.
    """

    physics_hz: int = 240
    control_hz: int = 30
    record_hz: int = 10

    def __post_init__(self) -> None:
        for field_ in dataclasses.fields(self):
            value = getattr(self, field_.name)
            if isinstance(value, bool) or not isinstance(value, int) or value < 1:
                raise InvalidInput(f"{field_.name}: expected a whole number >= 1, got {value!r}")
        for fast, slow in (("physics_hz", "control_hz"), ("control_hz", "record_hz")):
            if getattr(self, fast) % getattr(self, slow):
                raise InvalidInput(
                    f"{fast}: expected a multiple of {slow} ({getattr(self, slow)} Hz), got "
                    f"{getattr(self, fast)} Hz"
                )

    @property
    def physics_per_control(self) -> int:
        """Physics steps in a control period."""
        return self.physics_hz // self.control_hz

    @property
    def control_per_record(self) -> int:
        """Control periods in a recorded step."""
        return self.control_hz // self.record_hz


DEFAULT_RATES = Rates()


def actions_from_commands(commanded_Ts_world_tool: Array, commanded_gripper: Array) -> Array:
    """The actions `(n, 7)` that lead along a sequence of commands.

    Action t is the commanded tool pose t+1 relative to commanded tool pose t (xyz [m], rotation
    vector [rad], in the tool frame of t) and the gripper target of t+1 in [0, 1]. The last action
    holds: no motion, same gripper target.

    Args:
        commanded_Ts_world_tool: `(n, 4, 4)`.
        commanded_gripper: `(n,)`.
    """
    n = len(commanded_Ts_world_tool)
    actions = np.zeros((n, ACTION_SIZE))
    for t in range(n - 1):
        actions[t, :6] = relative_motion(commanded_Ts_world_tool[t], commanded_Ts_world_tool[t + 1])
    actions[:-1, 6] = commanded_gripper[1:]
    actions[-1, 6] = commanded_gripper[-1]
    return actions


def apply_action(T_world_tool: Array, action: Array) -> tuple[Array, float]:
    """The next commanded tool pose `(4, 4)` and gripper target after an action `(7,)`."""
    return apply_motion(T_world_tool, action[:6]), float(np.clip(action[6], 0.0, 1.0))


def library_versions() -> dict[str, str]:
    """Versions of Python, the toolkit and the libraries that results depend on."""
    versions = {"python": platform.python_version()}
    for name in (
        "sart_toolkit",
        "numpy",
        "pin",
        "coal",
        "ruckig",
        "ompl",
        "pybullet",
        "embreex",
        "sapien",
        "torch",
        "safetensors",
        "h5py",
    ):
        version = _installed_version(name)
        if version is not None:
            versions[name] = version
    return versions


@functools.cache
def _installed_version(package: str) -> str | None:
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return None


def digest(parts: Mapping[str, Any]) -> str:
    """A SHA-256 hex digest of named arrays and JSON values, independent of file layout."""
    sha = hashlib.sha256()
    for name in sorted(parts):
        value = parts[name]
        # As JSON, a name ends where its quotes end and can't run into the value.
        sha.update(json.dumps(name).encode())
        if isinstance(value, np.ndarray):
            sha.update(f"{value.dtype.str}{value.shape}".encode())
            sha.update(np.ascontiguousarray(value).data)
        else:
            sha.update(json.dumps(value, sort_keys=True).encode())
    return sha.hexdigest()


def summary(record: object, **figures: object) -> str:
    """A record's repr in a line: its class and the figures that matter, without any array."""
    inside = ", ".join(f"{name}={value}" for name, value in figures.items())
    return f"{type(record).__name__}({inside})"


@dataclass(frozen=True)
class CameraRecord:
    """What one camera saw: `rgb (T,H,W,3)` uint8, `depth (T,H,W)` float32 metres (0: nothing hit).

    `intrinsics (3,3)` in pixels; `frame`: what the camera is mounted on, the tool or the world;
    `T_frame_camera (4,4)`: where it is there, camera frame z forward, x right, y down.
    """

    rgb: Image
    depth: DepthImage
    intrinsics: Array
    frame: CameraFrame
    T_frame_camera: Array

    def __post_init__(self) -> None:
        rgb = np.asarray(self.rgb)
        depth = np.asarray(self.depth)
        if rgb.ndim != 4 or rgb.shape[3] != 3 or rgb.dtype != np.uint8:
            raise InvalidInput(
                f"rgb: expected uint8 of shape (T, H, W, 3), got {rgb.dtype} {rgb.shape}"
            )
        if depth.shape != rgb.shape[:3]:
            raise InvalidInput(f"depth: expected shape {rgb.shape[:3]}, got {depth.shape}")
        object.__setattr__(self, "rgb", frozen(rgb))
        object.__setattr__(self, "depth", frozen(depth, np.float32))
        intrinsics = check_array("intrinsics", self.intrinsics, (3, 3))
        object.__setattr__(self, "intrinsics", frozen(intrinsics))
        if self.frame not in get_args(CameraFrame):
            raise InvalidInput(f"frame: expected 'tool' or 'world', got {self.frame!r}")
        T = check_pose("T_frame_camera", self.T_frame_camera)
        object.__setattr__(self, "T_frame_camera", frozen(T))

    def Ts_world_camera(self, Ts_world_tool: Array) -> Array:
        """Where the camera was `(4, 4)` or `(n, 4, 4)` when the tool was at as many poses."""
        if self.frame == "tool":
            return Ts_world_tool @ self.T_frame_camera
        return np.broadcast_to(self.T_frame_camera, np.shape(Ts_world_tool))

    def __repr__(self) -> str:
        n, height, width, _ = self.rgb.shape
        return summary(self, images=n, width=width, height=height)


@dataclass(frozen=True)
class Steps:
    """Recorded steps of a robot: what it measured, what it was commanded, what it saw.

    `joint_positions`, `joint_velocities`, `commanded_joint_positions` are `(T, n)` [rad, rad/s];
    `measured_Ts_world_tool`, `commanded_Ts_world_tool` are `(T, 4, 4)`; `measured_gripper` and
    `commanded_gripper` are `(T,)` in [0, 1] (0 open); `contact_force (T,)` [N] is the greatest
    force between two bodies during the step before, NaN where the backend can't tell; `cameras`
    maps camera names to their records.
    """

    joint_positions: Array
    joint_velocities: Array
    commanded_joint_positions: Array
    measured_Ts_world_tool: Array
    commanded_Ts_world_tool: Array
    measured_gripper: Array
    commanded_gripper: Array
    contact_force: Array
    cameras: Mapping[str, CameraRecord]

    def __post_init__(self) -> None:
        n = len(self.measured_gripper)
        for name in ("joint_positions", "joint_velocities", "commanded_joint_positions"):
            object.__setattr__(
                self, name, frozen(check_array(name, getattr(self, name), (n, None)))
            )
        for name in ("measured_Ts_world_tool", "commanded_Ts_world_tool"):
            poses = check_poses(name, getattr(self, name))
            if len(poses) != n:
                raise InvalidInput(f"{name}: expected {n} poses, got {len(poses)}")
            object.__setattr__(self, name, frozen(poses))
        for name in ("measured_gripper", "commanded_gripper"):
            object.__setattr__(self, name, frozen(check_array(name, getattr(self, name), (n,))))
        force = np.asarray(self.contact_force, dtype=np.float64)
        if force.shape != (n,):
            raise InvalidInput(f"contact_force: expected shape ({n},), got {force.shape}")
        object.__setattr__(self, "contact_force", frozen(force))
        for name, camera in self.cameras.items():
            if len(camera.rgb) != n:
                raise InvalidInput(f"camera {name!r}: expected {n} images, got {len(camera.rgb)}")
        object.__setattr__(self, "cameras", dict(self.cameras))

    def __len__(self) -> int:
        return len(self.measured_gripper)

    def __repr__(self) -> str:
        joints = self.joint_positions.shape[1]
        return summary(self, steps=len(self), joints=joints, cameras=list(self.cameras))

    def content(self) -> dict[str, Any]:
        """The arrays by name, for hashing."""
        parts: dict[str, Any] = {
            f.name: getattr(self, f.name) for f in dataclasses.fields(Steps) if f.name != "cameras"
        }
        for name, camera in self.cameras.items():
            for part in dataclasses.fields(CameraRecord):
                parts[f"cameras/{name}/{part.name}"] = getattr(camera, part.name)
        return parts


class Referring:
    """What was made with a robot, on a task and a backend, and says how to find these again.

    `robot`, `task`, `backend` are their names; `references` may hold for each of these words what
    `registry.resolve` finds it by.
    """

    robot: str
    task: str
    backend: str
    references: Mapping[str, str]

    def reference(self, kind: Literal["robot", "task", "backend"]) -> str:
        """What finds the robot, task or backend: its noted reference, or else its name."""
        name: str = getattr(self, kind)
        return self.references.get(kind, name)


@dataclass(frozen=True)
class Demonstration(Referring):
    """One demonstration: its steps, the bodies, and what it takes to start from any step.

    `rates`: how often it was commanded and recorded; `timestamps (T,)` [s]; `body_Ts_world` maps
    body names to `(T, 4, 4)` (empty on hardware); `success (T,)` bool per step, as `judged_by`
    says: the task's own test, a person, or nobody (then it is false throughout); `touching`: for
    each step the pairs of names of bodies that have touched since the step before (none where the
    backend can't tell); `raw_commands (M, 7)`: the operator's tool velocity in each control period
    (xyz [m/s], rotation [rad/s], tool frame) and gripper target; `states`: the backend's portable
    state at each step (empty where it has none); `seconds`: wall-clock time that a person spent, 0
    where a script steered.
    """

    task: str
    task_parameters: Mapping[str, Any]
    robot: str
    backend: str
    steps: Steps
    timestamps: Array
    body_Ts_world: Mapping[str, Array]
    success: NDArray[np.bool_]
    touching: tuple[tuple[tuple[str, str], ...], ...]
    raw_commands: Array
    states: tuple[bytes, ...]
    operator: str
    device: str
    seconds: float
    seed: int | None = None
    versions: Mapping[str, str] = field(default_factory=dict)
    rates: Rates = DEFAULT_RATES
    judged_by: Judge = "task"
    references: Mapping[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if self.judged_by not in get_args(Judge):
            raise InvalidInput(
                f"judged_by: expected one of {list(get_args(Judge))}, got {self.judged_by!r}"
            )
        n = len(self.steps)
        if n < 2:
            raise InvalidInput(f"demonstration: needs at least 2 steps, got {n}; record it again")
        object.__setattr__(
            self, "timestamps", frozen(check_array("timestamps", self.timestamps, (n,)))
        )
        object.__setattr__(
            self, "raw_commands", frozen(check_array("raw_commands", self.raw_commands, (None, 7)))
        )
        success = np.asarray(self.success, dtype=bool)
        if success.shape != (n,):
            raise InvalidInput(f"success: expected shape ({n},), got {success.shape}")
        object.__setattr__(self, "success", frozen(success))
        touching = tuple(tuple((str(a), str(b)) for a, b in pairs) for pairs in self.touching)
        if len(touching) != n:
            raise InvalidInput(f"touching: expected pairs for {n} steps, got {len(touching)}")
        object.__setattr__(self, "touching", touching)
        bodies = {k: frozen(check_poses(k, v)) for k, v in self.body_Ts_world.items()}
        for name, Ts in bodies.items():
            if len(Ts) != n:
                raise InvalidInput(f"{name}: expected {n} poses, got {len(Ts)}")
            if "/" in name or name in ("", "."):
                raise InvalidInput(f"body {name!r}: a name has letters and no /; rename it")
        object.__setattr__(self, "body_Ts_world", bodies)
        if len(self.states) not in (0, n):
            raise InvalidInput(f"states: expected none or {n}, got {len(self.states)}")

    def __len__(self) -> int:
        return len(self.steps)

    def __repr__(self) -> str:
        return summary(
            self,
            task=self.task,
            robot=self.robot,
            backend=self.backend,
            operator=self.operator,
            waypoints=len(self),
            cameras=list(self.steps.cameras),
        )

    @property
    def steered_by_person(self) -> bool:
        """Whether a person's time was spent; a script or a replay takes none."""
        return self.seconds > 0 and self.device not in ("scripted", "replay")

    @property
    def actions(self) -> Array:
        """Actions `(T, 7)`, see `actions_from_commands`."""
        return actions_from_commands(
            self.steps.commanded_Ts_world_tool, self.steps.commanded_gripper
        )

    def content_hash(self) -> str:
        """SHA-256 over the recording: all that proofs and policies rely on.

        Not over who made it, when, with which versions, and where its robot, task and backend are
        found: what was recorded stays the same. Its file has a hash over these, too.
        """
        return self._content_hash

    @functools.cached_property
    def _content_hash(self) -> str:
        return digest(
            {
                **self.steps.content(),
                **{f"body_Ts_world/{name}": Ts for name, Ts in self.body_Ts_world.items()},
                "timestamps": self.timestamps,
                "raw_commands": self.raw_commands,
                "success": self.success,
                "touching": self.touching,
                "rates": dataclasses.asdict(self.rates),
                "task": self.task,
                "task_parameters": dict(self.task_parameters),
                "robot": self.robot,
                "backend": self.backend,
                "judged_by": self.judged_by,
                "states": [hashlib.sha256(state).hexdigest() for state in self.states],
            }
        )


@dataclass(frozen=True)
class PrecisionSphere:
    """How far the tool may stray around one key waypoint: radius [m] about `T_world_key (4,4)`.

    `waypoint` is the index of the key waypoint in the demonstration. `clearance` [m] and
    `limited_by` say what backed a suggested radius: the distance of the pair of bodies that
    bounds it.
    """

    waypoint: int
    T_world_key: Array
    radius: float
    kind: Literal["ball", "free_space"] = "ball"
    source: Literal["human", "suggested"] = "human"
    clearance: float | None = None
    limited_by: str | None = None

    def __post_init__(self) -> None:
        number = self.waypoint
        whole = isinstance(number, numbers.Real) and not isinstance(number, bool)
        if not whole or not np.isfinite(number) or int(number) != number:
            raise InvalidInput(f"waypoint: expected a whole number, got {number!r}")
        object.__setattr__(self, "waypoint", int(number))
        if self.waypoint < 0:
            raise InvalidInput(f"waypoint: expected an index >= 0, got {self.waypoint}")
        if self.kind not in ("ball", "free_space"):
            raise InvalidInput(f"kind: expected 'ball' or 'free_space', got {self.kind!r}")
        if self.source not in ("human", "suggested"):
            raise InvalidInput(f"source: expected 'human' or 'suggested', got {self.source!r}")
        radius = f"radius of the sphere at waypoint {self.waypoint}"
        object.__setattr__(self, "radius", check_positive(radius, self.radius, "m"))
        if self.clearance is not None:
            clearance = check_array("clearance", self.clearance, ())
            object.__setattr__(self, "clearance", float(clearance))
        if not isinstance(self.limited_by, str | None):
            raise InvalidInput(f"limited_by: expected text, got {self.limited_by!r}")
        object.__setattr__(self, "T_world_key", frozen(check_pose("T_world_key", self.T_world_key)))


@dataclass(frozen=True)
class Annotation:
    """The precision spheres of one demonstration, in order of their waypoints.

    `seconds`: wall-clock time a person spent; `settings`: how suggested radii were found.
    """

    spheres: tuple[PrecisionSphere, ...]
    demonstration_hash: str
    seconds: float = 0.0
    settings: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if not self.spheres:
            raise InvalidInput("annotation: has no sphere; add at least one")
        if not isinstance(self.demonstration_hash, str):
            raise InvalidInput(
                f"demonstration_hash: expected text, got {self.demonstration_hash!r}"
            )
        if not np.isfinite(self.seconds):
            raise InvalidInput(f"seconds: expected a finite number, got {self.seconds}")
        if not isinstance(self.settings, Mapping):
            raise InvalidInput(f"settings: expected names and values, got {self.settings!r}")
        waypoints = [sphere.waypoint for sphere in self.spheres]
        if sorted(set(waypoints)) != waypoints:
            raise InvalidInput(
                f"annotation: waypoints must increase without repeats, got {waypoints}; sort them"
            )

    def content_hash(self) -> str:
        """SHA-256 over the spheres and the demonstration that they belong to."""
        spheres = [
            {**dataclasses.asdict(sphere), "T_world_key": sphere.T_world_key.tolist()}
            for sphere in self.spheres
        ]
        return digest({"demonstration": self.demonstration_hash, "spheres": spheres})

    def check_matches(self, demonstration: Demonstration) -> None:
        """Return if the spheres were made for this demonstration.

        Raises:
            Mismatch: other demonstration, waypoint out of range, or key pose not at its waypoint.
        """
        if self.demonstration_hash != demonstration.content_hash():
            raise Mismatch(
                "annotation was made for another demonstration (hash "
                f"{self.demonstration_hash[:12]}, this one has "
                f"{demonstration.content_hash()[:12]}); annotate this one with `sart suggest`"
            )
        for sphere in self.spheres:
            if sphere.waypoint >= len(demonstration) - 1:
                raise Mismatch(
                    f"sphere at waypoint {sphere.waypoint}: the demonstration's last waypoint to "
                    f"start from is {len(demonstration) - 2}; choose an earlier one"
                )
            at = demonstration.steps.measured_Ts_world_tool[sphere.waypoint]
            if not np.allclose(at, sphere.T_world_key, atol=1e-4):
                raise Mismatch(
                    f"sphere at waypoint {sphere.waypoint}: T_world_key differs from the measured "
                    "tool pose there; keep it, and move the sphere by changing its waypoint"
                )

    def __repr__(self) -> str:
        radii = [f"{sphere.radius * 1e3:.1f} mm" for sphere in self.spheres]
        return summary(self, waypoints=[s.waypoint for s in self.spheres], radii=radii)


def convergence_waypoint(
    demonstration: Demonstration, sphere: PrecisionSphere, factor: float = 1.0
) -> int:
    """t*: the first waypoint after the key waypoint that lies outside its sphere (paper, Eq. t*).

    With a `factor` it is the first that is farther than as many radii from the key pose. Where the
    demonstration never is, the last waypoint is taken, as the published code does.
    """
    positions = demonstration.steps.measured_Ts_world_tool[:, :3, 3]
    distances = np.linalg.norm(positions - sphere.T_world_key[:3, 3], axis=1)
    far = distances > factor * sphere.radius
    outside = np.flatnonzero(far[sphere.waypoint + 1 :])
    return sphere.waypoint + 1 + int(outside[0]) if len(outside) else len(demonstration) - 1


@dataclass(frozen=True)
class Provenance:
    """Where a generated episode comes from: enough to generate it again.

    `source` is the number of its demonstration in the dataset, `sphere` that of its sphere among
    those that its strategy draws from there, `k` that of the attempt from the sphere. `merged`:
    whether the demonstration follows from `t_star` on. `recording`: whether the segment's steps
    were recorded on the way out and reversed, or on the return.
    """

    demonstration_hash: str
    source: int
    sphere: int
    k: int
    t_star: int
    T_world_sampled: Array
    seed: int
    strategy: str
    distribution: str
    certificate: Mapping[str, Any] | None = None
    merged: bool = True
    recording: Recording = "reversed"

    def __post_init__(self) -> None:
        sampled = check_pose("T_world_sampled", self.T_world_sampled)
        object.__setattr__(self, "T_world_sampled", frozen(sampled))


@dataclass(frozen=True)
class Episode:
    """One generated trajectory: the segment's steps to t*, then the demonstration from `t_star`.

    The segment's last step is followed by the demonstration's step `provenance.t_star`; that
    suffix is stored once, in the demonstration. Where `provenance.merged` is false the trajectory
    ends there. `joint_path (m, n)` [rad]: the joints as they were measured while the segment was
    executed, from t* outwards, and back again where the return was recorded, at the backend's own
    rate.
    """

    steps: Steps
    provenance: Provenance
    joint_path: Array = field(default_factory=lambda: np.empty((0, 0)))

    def __post_init__(self) -> None:
        n = self.steps.joint_positions.shape[1]
        path = self.joint_path if len(self.joint_path) else np.empty((0, n))
        object.__setattr__(self, "joint_path", frozen(check_array("joint_path", path, (None, n))))

    def __len__(self) -> int:
        return len(self.steps)

    def __repr__(self) -> str:
        at = self.provenance
        return summary(self, steps=len(self), sphere=at.sphere, k=at.k, t_star=at.t_star)

    def commands(self, demonstration: Demonstration) -> tuple[Array, Array]:
        """Commanded tool poses `(n, 4, 4)` and gripper `(n,)` of the whole joined trajectory."""
        after, suffix = self.suffix(demonstration), demonstration.steps
        return (
            np.concatenate(
                [self.steps.commanded_Ts_world_tool, suffix.commanded_Ts_world_tool[after]]
            ),
            np.concatenate([self.steps.commanded_gripper, suffix.commanded_gripper[after]]),
        )

    def suffix(self, demonstration: Demonstration) -> slice:
        """The demonstration's steps that follow the segment, at least the one that it leads to."""
        t_star = self.provenance.t_star
        return slice(t_star, len(demonstration) if self.provenance.merged else t_star + 1)

    def actions(self, demonstration: Demonstration) -> Array:
        """Actions `(n, 7)` of the whole joined trajectory, see `actions_from_commands`."""
        return actions_from_commands(*self.commands(demonstration))

    def content_hash(self) -> str:
        """SHA-256 over the steps and their provenance."""
        provenance = dataclasses.asdict(self.provenance)
        provenance["T_world_sampled"] = self.provenance.T_world_sampled.tolist()
        return digest(
            {**self.steps.content(), "joint_path": self.joint_path, "provenance": provenance}
        )
