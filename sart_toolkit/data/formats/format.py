"""What a dataset format is, and the whole trajectories that it is given to write."""

from __future__ import annotations

import abc
import copy
import dataclasses
import itertools
import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from sart_toolkit.data.dataset import Dataset, Source, count_demonstrations
from sart_toolkit.data.formats import FORMATS, get_format
from sart_toolkit.data.records import (
    DEFAULT_RATES,
    CameraFrame,
    CameraRecord,
    Demonstration,
    Episode,
    Rates,
    Steps,
    actions_from_commands,
    library_versions,
)
from sart_toolkit.errors import BrokenFile, InvalidInput, unknown_name
from sart_toolkit.poses import Array, StraightLine, check_poses, relative_motion

ACTION_NAMES = ("x", "y", "z", "rx", "ry", "rz", "gripper")
# How much a step's time may be off the recording's period, as a fraction of it.
_UNEVEN = 0.5
# Position, then the first two columns of the rotation matrix.
POSE_NAMES = ("x", "y", "z", "r00", "r10", "r20", "r01", "r11", "r21")

CONVENTIONS = {
    "action": (
        "at step t: the tool pose commanded for t+1 relative to the tool pose commanded for t, xyz "
        "[m] and rotation vector [rad], in the tool frame of t; then the gripper target of t+1 in "
        "[0, 1] (0 open, 1 closed); the last action of a trajectory holds still"
    ),
    "world_frame": "the robot's base frame, z up [m]",
    "tool_frame": "between the fingertips, z out of the gripper, x along the closing direction",
    "camera_frame": "z forward, x right, y down; T_frame_camera maps camera to frame coordinates",
    "gripper": "0 open, 1 closed; measured values stay short of 1 where something is grasped",
    "depth": "[m] along the camera's z axis; 0 where nothing was hit",
    "pose": "position [m], then the first and second column of the rotation matrix",
    "contact_force": "greatest force between two bodies during the step before [N]",
    "policy_input": (
        "SART's own policies see images and the gripper alone: with few object placements joints, "
        "absolute poses and time are shortcuts that fail at the next placement"
    ),
}


@dataclass(frozen=True)
class Trajectory:
    """One whole trajectory: a demonstration, or a generated segment joined to its suffix.

    `name` says where it came from; `actions (n, 7)` as `actions_from_commands` has them, also
    across the join; `success (n,)` whether the goal was reached, as far as the demonstration says;
    `timestamps (n,)` [s] as recorded, or even ones for a generated trajectory; `provenance`: JSON
    values that say how it was made.
    """

    name: str
    steps: Steps
    actions: Array
    success: NDArray[np.bool_]
    timestamps: Array
    provenance: Mapping[str, Any]

    def __len__(self) -> int:
        return len(self.steps)


@dataclass(frozen=True)
class About:
    """What holds for all trajectories of an export.

    `instruction`: the task in a sentence; `joint_names`: one for each joint; `depth`: whether depth
    images are written; `sart`: JSON values about conventions, cameras, sources and versions.
    """

    task: str
    instruction: str
    robot: str
    hz: int
    n_trajectories: int
    joint_names: tuple[str, ...]
    depth: bool
    sart: Mapping[str, Any]


class Format(abc.ABC):
    """A dataset format of the field.

    Attributes:
        name: what it is called.
        suffix: what a path of it ends in; empty for any directory.
        mark: the file in it, relative to its directory, by which it is known; empty for a file.
    """

    name: str
    suffix: str = ""
    mark: str = ""

    @abc.abstractmethod
    def write(self, path: Path, trajectories: Iterable[Trajectory], about: About) -> None:
        """Write trajectories, one in memory at a time, to a path that is renamed when all is done.

        Where `mark` is set, `path` is an empty directory, otherwise an empty file.

        Raises:
            InvalidInput: the format can't hold a trajectory.
            OSError: the disk refuses.
        """

    @abc.abstractmethod
    def problems(self, path: Path) -> Sequence[str]:
        """What a reader of this format would fail on, a line each; empty if all is well."""


@dataclass(frozen=True)
class Arm:
    """The kinematics of the robot that made a recording.

    `fk` maps joints `(n,)` to the tool's pose `(4, 4)` in the world; `ik` a pose and joints near it
    to joints, at `home (n,)` at first; `T_world_base (4, 4)`: where its base is. `T_frame_tool`:
    where the tool is in the frame whose poses the file has; None where nobody says which it is.
    """

    fk: Callable[[Array], Array]
    ik: Callable[[Array, Array], Array]
    home: Array
    T_world_base: Array
    T_frame_tool: Array | None = None

    def inverse(self, Ts_world_tool: Array) -> Array:
        """Joints `(n, j)` along tool poses `(n, 4, 4)`, each from those of the pose before.

        Raises:
            Unreachable, InvalidInput: a pose can't be reached, or isn't one.
        """
        q = [self.home]
        for T in Ts_world_tool:
            q.append(self.ik(T, q[-1]))
        return np.array(q[1:])


@dataclass(frozen=True)
class Given:
    """What a person says of a recording that is imported, used only where the file doesn't say it.

    `task`, `robot`: their names; `references` of them, see `Demonstration`; `gripper_range`: what
    the file has for an open and for a closed gripper; `arm`: the robot's kinematics; `cameras`:
    what each is mounted on and where, by name; `intrinsics` maps the width and height of a camera's
    images to its intrinsics `(3, 3)`; `camera_names`: which are read, our name of each with the
    file's own; `columns`: where in the file what the key names is, such as `joints`, as
    `COLUMN[A:B]`; `rotation`: how the file's poses have theirs, a key of `ROTATIONS`. `None` or
    nothing where nobody says it either.
    """

    task: str | None = None
    robot: str | None = None
    references: Mapping[str, str] = dataclasses.field(default_factory=dict)
    gripper_range: tuple[float, float] | None = None
    arm: Arm | None = None
    cameras: Mapping[str, tuple[CameraFrame, Array]] = dataclasses.field(default_factory=dict)
    intrinsics: Mapping[str, Callable[[int, int], Array]] = dataclasses.field(default_factory=dict)
    camera_names: Mapping[str, str] = dataclasses.field(default_factory=dict)
    columns: Mapping[str, str] = dataclasses.field(default_factory=dict)
    rotation: str | None = None

    def check_unsaid(self, fields: Sequence[str], why: str) -> None:
        """Return if nothing is given that the file says itself, or has no use for.

        Raises:
            InvalidInput: something is.
        """
        for name in fields:
            if getattr(self, name):
                flag = _FLAGS.get(name, f"--{name.replace('_', '-')}")
                raise InvalidInput(f"{why}; leave {flag} out")

    def chosen_cameras(self, there: Sequence[str]) -> dict[str, str]:
        """The cameras to read: our name of each, and the file's.

        Raises:
            UnknownName: the file hasn't one that is named.
            InvalidInput: intrinsics are given of one that isn't read.
        """
        for theirs in self.camera_names.values():
            if theirs not in there:
                raise unknown_name("camera", theirs, there)
        chosen = dict(self.camera_names) or {name: name for name in there}
        for name in self.intrinsics:
            if name not in chosen:
                raise InvalidInput(
                    f"camera {name!r}: has a calibration or intrinsics but isn't in the recording, "
                    f"which has {', '.join(there) or 'none'}; add --cameras {name}=THEIRS"
                )
        return chosen

    def mounting(self, name: str) -> tuple[CameraFrame, Array]:
        """What a camera is mounted on, and its pose `(4, 4)` there.

        Raises:
            InvalidInput: nobody says it.
        """
        if name not in self.cameras:
            raise InvalidInput(
                f"camera {name!r}: where it is mounted isn't said; add --calibration FILE, or "
                f"--robot REF of a robot that has a camera {name!r}; or leave it out: --cameras"
            )
        return self.cameras[name]

    def intrinsics_of(self, name: str, width: int, height: int) -> Array:
        """A camera's intrinsics `(3, 3)`.

        Raises:
            InvalidInput: nobody says them.
            Mismatch: they are of images of another shape.
        """
        if name not in self.intrinsics:
            raise InvalidInput(
                f"camera {name!r}: its intrinsics aren't said; add --calibration FILE, or "
                f"--camera-intrinsics {name}=FX,FY,CX,CY"
            )
        return self.intrinsics[name](width, height)

    def gripper(self, values: Array) -> Array:
        """Gripper values as ours, from 0 (open) to 1 (closed).

        Raises:
            InvalidInput: nobody says which of them are open and closed.
        """
        if self.gripper_range is None:
            raise InvalidInput(
                f"gripper values reach from {values.min():g} to {values.max():g}, and which are "
                "open and closed isn't said; add --gripper-range OPEN,CLOSED"
            )
        open_, closed = self.gripper_range
        if open_ == closed:
            raise InvalidInput(f"gripper_range: expected two numbers, got {open_:g} twice")
        return np.clip((values - open_) / (closed - open_), 0.0, 1.0)


# What the toolkit's own exports say themselves.
SAID_BY_OURS = ("task", "robot", "gripper_range", "cameras", "intrinsics", "columns", "rotation")
_FLAGS = {"cameras": "--calibration", "intrinsics": "--calibration or --camera-intrinsics"}

# How many numbers a rotation has in a file, and the rotation that they are.
ROTATIONS: Mapping[str, tuple[int, Callable[[Array], Rotation]]] = {
    "rotvec": (3, Rotation.from_rotvec),
    "rpy": (3, lambda r: Rotation.from_euler("xyz", r)),
    "wxyz": (4, lambda r: Rotation.from_quat(r, scalar_first=True)),
    "xyzw": (4, Rotation.from_quat),
    "6d": (6, lambda r: Rotation.from_matrix(_of_two_columns(r))),
}


def _of_two_columns(r: Array) -> Array:
    """Rotation matrices `(n, 3, 3)` of their first two columns `(n, 6)`, made orthonormal."""
    x = r[:, :3] / np.linalg.norm(r[:, :3], axis=1, keepdims=True)
    y = r[:, 3:] - (x * r[:, 3:]).sum(axis=1, keepdims=True) * x
    y /= np.linalg.norm(y, axis=1, keepdims=True)
    return np.stack([x, y, np.cross(x, y)], axis=2)


def poses_of(rows: Array, rotation: str) -> Array:
    """Poses `(n, 4, 4)` of rows `(n, k)`: position [m], then the rotation.

    Raises:
        InvalidInput: the rows have another width, or a rotation is none.
    """
    width, convert = ROTATIONS[rotation]
    if rows.shape[1] != 3 + width:
        raise InvalidInput(
            f"tool_pose: rows of {rows.shape[1]} numbers, expected 3 and {width} for {rotation}"
        )
    Ts = np.tile(np.eye(4), (len(rows), 1, 1))
    Ts[:, :3, 3] = rows[:, :3]
    with np.errstate(invalid="ignore", divide="ignore"):
        try:
            Ts[:, :3, :3] = convert(rows[:, 3:]).as_matrix()
        except ValueError as error:
            raise InvalidInput(f"tool_pose: a rotation that is none ({error})") from error
    return check_poses("tool_pose", Ts)


def commands_along(Ts_world_tool: Array, gripper: Array, rates: Rates) -> Array:
    """Tool velocities and gripper targets `(m, 7)` that lead along commanded poses.

    One for each control period, as an operator would have given them, straight from a step to the
    next; without them a robot couldn't follow the recording.

    Args:
        Ts_world_tool: the commanded poses `(n, 4, 4)`.
        gripper: the commanded gripper `(n,)`.
        rates: how often it is commanded and recorded.
    """
    parts, rows = rates.control_per_record, []
    for T_from, T_to, target in zip(
        Ts_world_tool[:-1], Ts_world_tool[1:], gripper[1:], strict=True
    ):
        line = StraightLine(T_from, T_to)
        Ts = [line(i / parts) for i in range(parts + 1)]
        for a, b in itertools.pairwise(Ts):
            rows.append([*(relative_motion(a, b) * rates.control_hz), target])
    return np.array(rows).reshape(-1, 7)


def even_rates(time: Array) -> Rates:
    """The rate of a recording by its times `(n,)` [s], with those at which it is executed again.

    How often it was commanded isn't known; a robot that follows it is commanded in as many even
    steps as come to the default rates or more.

    Raises:
        InvalidInput: they are uneven.
    """
    period = float(np.median(np.diff(time))) if len(time) > 1 else 0.0
    hz = round(1 / period) if period > 0 else 0
    if hz < 1 or np.abs(np.diff(time) * hz - 1).max() > _UNEVEN:
        raise InvalidInput(
            "time: steps are missing or uneven, or fewer than one a second; cut the recording"
        )
    control_hz = hz * math.ceil(DEFAULT_RATES.control_hz / hz)
    physics_hz = control_hz * math.ceil(DEFAULT_RATES.physics_hz / control_hz)
    return Rates(physics_hz, control_hz, hz)


def imported_demonstration(
    given: Given,
    ours: Mapping[str, Any],
    provenance: Mapping[str, Any],
    steps: Steps,
    time: Array,
    success: NDArray[np.bool_],
) -> Demonstration:
    """A demonstration of what was read of a file, and of what the file and a person say of it.

    Args:
        given: what a person says.
        ours: what only the toolkit's own exports say; nothing of others.
        provenance: what they say of this recording.
        steps: the recorded steps.
        time: their times `(n,)` [s].
        success: whether the goal was reached at each `(n,)`.

    Raises:
        InvalidInput: nobody says of which task or robot it is, or the times are uneven.
    """

    def said(what: str) -> str:
        found = ours.get(what) or getattr(given, what)
        if found is None:
            raise InvalidInput(f"doesn't say which {what} it is of; add --{what} REF")
        return str(found)

    rates = Rates(**ours["rates"]) if ours else even_rates(time)
    return Demonstration(
        task=said("task"),
        task_parameters=provenance.get("task_parameters", {}),
        robot=said("robot"),
        backend=ours.get("backend", "imported"),
        steps=steps,
        timestamps=time,
        body_Ts_world={},
        success=success,
        touching=((),) * len(steps),
        raw_commands=commands_along(steps.commanded_Ts_world_tool, steps.commanded_gripper, rates),
        states=(),
        operator=provenance.get("operator", "unknown"),
        device="imported",
        seconds=0.0,
        versions=library_versions(),
        rates=rates,
        judged_by="task" if ours else "nobody",
        references=ours.get("references", given.references),
    )


class Reads(Format):
    """A format that can be imported as well."""

    @abc.abstractmethod
    def recordings(self, path: Path) -> Sequence[Path]:
        """The single recordings of this format in a path, or the path alone; none of others.

        Where a file holds several, each has a path that `read` takes, though no file is there.
        """

    @abc.abstractmethod
    def read(self, path: Path, given: Given) -> Demonstration:
        """The recording in a file as a demonstration.

        Args:
            path: one of `recordings`.
            given: stands in for what the file doesn't say.

        Raises:
            BrokenFile: it can't be read.
            InvalidInput: something is neither in the file nor given; the message says how to.
        """


def reader_of(path: Path, format: Format | None) -> tuple[Reads, Sequence[Path]]:
    """What reads a path, and the single recordings in it.

    Args:
        path: a recording, or a directory of several.
        format: what it is; found out if left out.

    Raises:
        InvalidInput: the format isn't read.
        BrokenFile: there is no recording of the format, or of any that is read.
    """
    formats = [format] if format is not None else [get_format(name) for name in FORMATS]
    readers = [each for each in formats if isinstance(each, Reads)]
    if not readers:
        names = ", ".join(n for n in FORMATS if isinstance(get_format(n), Reads))
        raise InvalidInput(f"format {formats[0].name}: isn't imported; those that are: {names}")
    for reader in readers:
        if found := reader.recordings(path):
            return reader, found
    names = ", ".join(reader.name for reader in readers)
    raise BrokenFile(f"{path}: holds no recording of {names}; check the path")


# --- what is exported ---------------------------------------------------------------------------


def trajectories_of(dataset: Dataset | Demonstration) -> Iterator[Trajectory]:
    """Each different demonstration and every episode of a dataset, source by source.

    One trajectory and its demonstration are in memory at a time. Of a demonstration, it alone.

    Raises:
        MissingFile, BrokenFile, Mismatch: as for reading the dataset.
    """
    if isinstance(dataset, Demonstration):
        yield _demonstrated("demo", dataset)
        return
    seen: set[str] = set()
    for number, source in enumerate(dataset.sources):
        # Of a copy, so that the dataset doesn't keep every demonstration in memory.
        demonstration = copy.copy(source).demonstration
        if source.demonstration_hash not in seen:
            seen.add(source.demonstration_hash)
            yield _demonstrated(source.name, demonstration)
        for i, entry in enumerate(dataset.index):
            if entry.source == number:
                yield _generated(entry.name, dataset.episode(i), demonstration)


def _demonstrated(name: str, demonstration: Demonstration) -> Trajectory:
    provenance = {
        "kind": "demonstration",
        "content_hash": demonstration.content_hash(),
        "task_parameters": dict(demonstration.task_parameters),
        "operator": demonstration.operator,
        "device": demonstration.device,
        "seed": demonstration.seed,
        "judged_by": demonstration.judged_by,
        "cameras": _cameras(demonstration.steps),
    }
    return Trajectory(
        name,
        demonstration.steps,
        demonstration.actions,
        demonstration.success,
        demonstration.timestamps,
        provenance,
    )


def _generated(name: str, episode: Episode, demonstration: Demonstration) -> Trajectory:
    at, after = episode.provenance, episode.suffix(demonstration)
    steps = joined(episode.steps, demonstration.steps, after)
    provenance = {
        "kind": "generated",
        "content_hash": episode.content_hash(),
        "segment_steps": len(episode),
        **dataclasses.asdict(at),
        "T_world_sampled": at.T_world_sampled.tolist(),
        "task_parameters": dict(demonstration.task_parameters),
        # With varied appearance, each demonstration has its own mounting.
        "cameras": _cameras(steps),
    }
    success = np.concatenate([np.zeros(len(episode), bool), demonstration.success[after]])
    timestamps = np.arange(len(steps)) / demonstration.rates.record_hz
    actions = actions_from_commands(steps.commanded_Ts_world_tool, steps.commanded_gripper)
    return Trajectory(name, steps, actions, success, timestamps, provenance)


def _cameras(steps: Steps) -> dict[str, Any]:
    return {
        name: {
            "intrinsics": camera.intrinsics.tolist(),
            "frame": camera.frame,
            "T_frame_camera": camera.T_frame_camera.tolist(),
        }
        for name, camera in steps.cameras.items()
    }


def joined(first: Steps, second: Steps, after: slice) -> Steps:
    """The steps of `first`, followed by those of `second` that `after` takes."""
    arrays = {
        field.name: np.concatenate([getattr(first, field.name), getattr(second, field.name)[after]])
        for field in dataclasses.fields(Steps)
        if field.name != "cameras"
    }
    cameras = {
        name: CameraRecord(
            np.concatenate([camera.rgb, second.cameras[name].rgb[after]]),
            np.concatenate([camera.depth, second.cameras[name].depth[after]]),
            camera.intrinsics,
            camera.frame,
            camera.T_frame_camera,
        )
        for name, camera in first.cameras.items()
    }
    return Steps(cameras=cameras, **arrays)


def about_dataset(
    dataset: Dataset | Demonstration,
    instruction: str | None = None,
    joint_names: Sequence[str] = (),
    depth: bool = True,
) -> About:
    """What holds for all trajectories of a dataset, or of one demonstration.

    Args:
        dataset: what is exported.
        instruction: the task in a sentence; its name in words if left out.
        joint_names: one for each joint; numbered if left out.
        depth: whether depth images are written.

    Raises:
        InvalidInput: there is not one name for each joint.
    """
    if isinstance(dataset, Demonstration):
        first, n, identity = dataset, 1, dataset.content_hash()
        sources = []
    else:
        first = copy.copy(dataset.sources[0]).demonstration
        n = len(dataset) + count_demonstrations(dataset.sources)
        identity = dataset.content_hash
        sources = [_source(source) for source in dataset.sources]
    n_joints = first.steps.joint_positions.shape[1]
    names = tuple(joint_names) or tuple(f"joint_{i + 1}" for i in range(n_joints))
    if len(names) != n_joints:
        raise InvalidInput(f"joint_names: expected {n_joints}, got {len(names)}")
    sart = {
        "made_by": "sart_toolkit",
        "conventions": CONVENTIONS,
        "task": first.task,
        "robot": first.robot,
        "backend": first.backend,
        "references": dict(first.references),
        "rates": dataclasses.asdict(first.rates),
        "cameras": _cameras(first.steps),
        "content_hash": identity,
        "sources": sources,
        "versions": library_versions(),
    }
    words = instruction or first.task.replace("_", " ")
    return About(first.task, words, first.robot, first.rates.record_hz, n, names, depth, sart)


def _source(source: Source) -> dict[str, Any]:
    return {
        "name": source.name,
        "demonstration_hash": source.demonstration_hash,
        "annotation_hash": source.annotation_hash,
        "request": dict(source.request),
    }


def pose_rows(Ts: Array) -> Array:
    """Poses `(n, 4, 4)` as rows `(n, 9)`, see `POSE_NAMES`."""
    return np.concatenate([Ts[:, :3, 3], Ts[:, :3, 0], Ts[:, :3, 1]], axis=1)


def poses_of_rows(rows: Array) -> Array:
    """The poses `(n, 4, 4)` of rows `(n, 9)`, rotations made orthonormal."""
    Ts = np.tile(np.eye(4), (len(rows), 1, 1))
    x = rows[:, 3:6] / np.linalg.norm(rows[:, 3:6], axis=1, keepdims=True)
    y = rows[:, 6:9] - np.sum(rows[:, 6:9] * x, axis=1, keepdims=True) * x
    y /= np.linalg.norm(y, axis=1, keepdims=True)
    Ts[:, :3, 0], Ts[:, :3, 1], Ts[:, :3, 2] = x, y, np.cross(x, y)
    Ts[:, :3, 3] = rows[:, :3]
    return Ts


def quaternions(Ts: Array, real: Literal["first", "last"]) -> Array:
    """The rotations of poses `(n, 4, 4)` as unit quaternions `(n, 4)`, without jumps of sign.

    The sign of all is so that the first part of the first that is far from 0 is positive: which one
    is greatest, or whether the real part is above 0, may be a matter of rounding.
    """
    found = Rotation.from_matrix(Ts[:, :3, :3]).as_quat(scalar_first=real == "first")
    flips = np.sum(found[1:] * found[:-1], axis=1) < 0
    found[1:][np.cumsum(flips) % 2 == 1] *= -1
    first = found[0][np.abs(found[0]) > 0.1][0]
    return np.asarray(found * np.sign(first))


def all_problems(lines: Iterator[str]) -> list[str]:
    """The lines, and another where what is checked is so odd that it can't be checked further."""
    found = []
    try:
        for line in lines:
            found.append(line)
    except BrokenFile as error:
        found.append(str(error))
    except (
        OSError, LookupError, ValueError, TypeError, AttributeError, ArithmeticError, RuntimeError,
        MemoryError,
    ) as error:  # fmt: skip
        found.append(f"can't be made sense of ({type(error).__name__}: {error}); write it again")
    return found


# Called with (trajectories done, trajectories in all).
Progress = Callable[[int, int], None]


def counted(
    trajectories: Iterable[Trajectory], about: About, progress: Progress | None
) -> Iterator[Trajectory]:
    """The trajectories themselves; progress is told of each once the next is asked for.

    Raises:
        InvalidInput: one has other cameras, image sizes or joints than the first.
    """
    first: dict[str, Any] | None = None
    for done, trajectory in enumerate(trajectories, 1):
        found: dict[str, Any] = {
            name: camera.rgb.shape[1:3] for name, camera in trajectory.steps.cameras.items()
        } | {"joints": trajectory.steps.joint_positions.shape[1]}
        first = first or found
        if found != first:
            raise InvalidInput(
                f"{trajectory.name}: cameras or joints are {found}, those of the first trajectory "
                f"{first}; export them apart"
            )
        yield trajectory
        if progress is not None:
            progress(done, about.n_trajectories)
