"""A cell: which arm, gripper and cameras there are, how they are mounted, what the arm may do."""

from __future__ import annotations

import dataclasses
import inspect
import time
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, cast

import msgspec
import numpy as np

from sart_toolkit.errors import BrokenFile, InvalidInput, Mismatch, MissingFile, nearest_name
from sart_toolkit.hardware import DRIVERS
from sart_toolkit.hardware.drivers import Arm, Camera, Clock, Gripper, World
from sart_toolkit.poses import Array, check_array, check_pose, check_positive, frozen
from sart_toolkit.registry import resolve
from sart_toolkit.robots.spec import RobotSpec

Kind = Literal["arm", "gripper", "camera", "world"]


@dataclass(frozen=True)
class Part:
    """One part: its `driver`, a name or reference, and the options that the driver is made with."""

    kind: Kind
    driver: str
    options: Mapping[str, Any] = field(default_factory=dict)

    def made(self, **given: Any) -> Any:
        """The driver, made with the part's options and with what its cell gives it.

        Raises:
            UnknownName: there is no such driver.
            InvalidInput: it has no such option, or lacks one, or a value is not acceptable.
        """
        made = resolve(self.kind, self.driver, DRIVERS[self.kind])
        known = inspect.signature(made).parameters
        for name in self.options:
            if name not in known or name in given:
                options = [option for option in known if option not in given]
                raise InvalidInput(
                    _unknown(f"[{self.kind}] of driver {self.driver!r}", name, options)
                )
        for name, parameter in known.items():
            if parameter.default is parameter.empty and name not in {**self.options, **given}:
                raise InvalidInput(
                    f"[{self.kind}]: driver {self.driver!r} needs {name!r}; add it to the table"
                )
        try:
            return made(**self.options, **given)
        except TypeError as error:
            raise InvalidInput(f"[{self.kind}]: {error}") from error


@dataclass(frozen=True)
class CameraPart:
    """A camera of the cell and where it is, `T_frame_camera (4,4)` on `frame` of the robot.

    `frame` may also be "world". `hand_eye_mm`, `hand_eye_deg`: how far it is from there, at most.
    Images are given as of a camera without distortion of `fov_y_deg`, whose axis goes through their
    middle. What is left out of these is as the `RobotSpec` has the camera of that name.
    """

    part: Part
    frame: str | None = None
    T_frame_camera: Array | None = None
    fov_y_deg: float | None = None
    hand_eye_mm: float = 0.0
    hand_eye_deg: float = 0.0

    def __post_init__(self) -> None:
        if (self.frame is None) != (self.T_frame_camera is None):
            raise InvalidInput("frame, T_frame_camera: expected both or neither; give the other")
        if self.T_frame_camera is not None:
            T = frozen(check_pose("T_frame_camera", self.T_frame_camera))
            object.__setattr__(self, "T_frame_camera", T)
        for name in ("hand_eye_mm", "hand_eye_deg"):
            if not 0 <= getattr(self, name) < np.inf:
                raise InvalidInput(f"{name}: expected a number >= 0, got {getattr(self, name)}")


@dataclass(frozen=True)
class Workspace:
    """The box that the tool's point stays in, `low` to `high (3,)` [m] in the world."""

    low: Array
    high: Array

    def __post_init__(self) -> None:
        for name in ("low", "high"):
            object.__setattr__(self, name, frozen(check_array(name, getattr(self, name), (3,))))
        if not (self.low < self.high).all():
            raise InvalidInput(
                f"workspace: expected low < high, got {self.low.tolist()} and {self.high.tolist()}"
            )

    def outside(self, p: Array) -> float:
        """How far [m] a point `(3,)` is outside; negative: how far inside, to the nearest face."""
        return float(np.maximum(self.low - p, p - self.high).max())


@dataclass(frozen=True)
class Limits:
    """What the arm may do.

    `workspace`: where the tool may be. `speed_scale`: all goes by so much slower than commanded, a
    tenth unless the cell says otherwise. `force` [N]: more than so much at the tool stops the arm.
    `tracking_error` [m]: how far any point of the arm may be from the path that it is commanded,
    its calibration included; augmented segments are proved clear with that much more room.
    `most_lag` [rad]: a joint that is farther behind what it was sent stops the arm.
    """

    workspace: Workspace
    speed_scale: float = 0.1
    force: float = 50.0
    tracking_error: float = 0.003
    most_lag: float = 0.3

    def __post_init__(self) -> None:
        for name in ("force", "tracking_error", "most_lag"):
            check_positive(name, getattr(self, name))
        if not 0 < self.speed_scale <= 1:
            raise InvalidInput(f"speed_scale: expected 0 to 1, got {self.speed_scale}")


@dataclass(frozen=True)
class Control:
    """How the arm is controlled.

    `rate_hz`: how often it is sent targets. `buffer` [s]: so much motion is always sent ahead, so
    that a late command doesn't slow it down; at least one goal's, see `goal_hz`. `silence` [s]: an
    arm whose state is older has lost its connection; `camera_silence` [s]: a camera whose newest
    image is. `process`: whether a process of its own keeps the rate, as it must on hardware.
    """

    rate_hz: int = 500
    buffer: float = 0.04
    silence: float = 0.03
    camera_silence: float = 0.3
    process: bool = True

    def __post_init__(self) -> None:
        if isinstance(self.rate_hz, bool) or not 10 <= self.rate_hz <= 1000:
            raise InvalidInput(f"rate_hz: expected 10 to 1000 Hz, got {self.rate_hz}")
        if not 1 / self.goal_hz <= self.buffer <= 1:
            raise InvalidInput(f"buffer: expected {1 / self.goal_hz:.3f} to 1 s, got {self.buffer}")
        for name in ("silence", "camera_silence"):
            check_positive(name, getattr(self, name), "s")

    @property
    def goal_hz(self) -> int:
        """How often the arm's motion gets a goal: the rate, or a part of it of at most 125 Hz."""
        rate = self.rate_hz
        return next(rate // k for k in range(1, rate + 1) if rate % k == 0 and rate // k <= 125)


@dataclass(frozen=True)
class Cell:
    """An arm, perhaps a gripper, cameras by name, and what the arm may do there.

    `robot`: the robot's name; a backend of the cell moves no other. `world`: where its parts are,
    if not in the real one. That is made before them, in the same process, and tells the time.
    """

    robot: str
    arm: Part
    limits: Limits
    gripper: Part | None = None
    cameras: Mapping[str, CameraPart] = field(default_factory=dict)
    control: Control = field(default_factory=Control)
    world: Part | None = None

    def __post_init__(self) -> None:
        if self.world is not None and self.control.process:
            raise InvalidInput("[control] process: expected false where the cell has a [world]")

    def make_world(self) -> World | None:
        """The world of its parts, or `None` where that is the real one; raises as `Part.made`."""
        if self.world is None:
            return None
        return cast(World, self.world.made(robot=self.robot, rate_hz=self.control.rate_hz))

    def make_arm(self, clock: Clock = time.monotonic) -> Arm:
        """The arm's driver, not connected yet; raises as `Part.made`."""
        return cast(Arm, self.arm.made(rate_hz=self.control.rate_hz, clock=clock))

    def make_gripper(self, clock: Clock = time.monotonic) -> Gripper | None:
        """The gripper's driver, if there is one, not connected yet; raises as `Part.made`."""
        return None if self.gripper is None else cast(Gripper, self.gripper.made(clock=clock))

    def make_cameras(self, clock: Clock = time.monotonic) -> dict[str, Camera]:
        """The cameras' drivers by name, not connected yet; raises as `Part.made`."""
        return {name: camera.part.made(clock=clock) for name, camera in self.cameras.items()}

    def mounted(self, robot: RobotSpec) -> RobotSpec:
        """The robot with its cameras where the cell has them, and without those it hasn't.

        Raises:
            Mismatch: it is another robot.
            InvalidInput: a camera is neither the robot's nor does the cell say where it is.
        """
        if robot.name != self.robot:
            raise Mismatch(
                f"robot: the cell has {self.robot!r}, got {robot.name!r}; add --robot "
                f"{self.robot}, or use another cell"
            )
        known = {camera.name: camera for camera in robot.cameras}
        found = []
        for name, camera in self.cameras.items():
            given = {
                key: getattr(camera, key)
                for key in ("frame", "T_frame_camera", "fov_y_deg")
                if getattr(camera, key) is not None
            }
            if name in known:
                found.append(dataclasses.replace(known[name], **given))
            elif "frame" in given:
                from sart_toolkit.robots.spec import CameraSpec

                found.append(CameraSpec(name, **given))
            else:
                raise InvalidInput(
                    f"[camera.{name}]: robot {robot.name!r} has no such camera; give its frame and "
                    "T_frame_camera"
                )
        return dataclasses.replace(robot, cameras=tuple(found))


def load_cell(path: Path | str) -> Cell:
    """The cell that a TOML file describes, as docs/real_robot.md has it.

    Raises:
        MissingFile: no such file.
        BrokenFile: not TOML.
        InvalidInput: a key is missing or unknown, or a value is not acceptable.
    """
    path = Path(path)
    try:
        tables = tomllib.loads(path.read_text())
    except FileNotFoundError as error:
        raise MissingFile(f"{path}: no such file; check the path") from error
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise BrokenFile(f"{path}: can't be read as TOML ({error}); fix it there") from error
    try:
        return _cell(tables)
    except InvalidInput as error:
        raise InvalidInput(f"{path}: {error}") from error


def _cell(tables: dict[str, Any]) -> Cell:
    known = ("robot", "world", "arm", "gripper", "camera", "limits", "control")
    for name in tables:
        if name not in known:
            raise InvalidInput(_unknown("cell", name, known))
    for name in ("robot", "arm", "limits"):
        if name not in tables:
            raise InvalidInput(f"{name}: is missing; add it")
    limits = dict(_table("limits", tables["limits"]))
    if "workspace" not in limits:
        raise InvalidInput("[limits] workspace: is missing; add its low and high")
    limits["workspace"] = _record("[limits] workspace", limits["workspace"], Workspace)
    cameras = _table("camera", tables.get("camera", {}))
    return Cell(
        robot=_text("robot", tables["robot"]),
        arm=_part("arm", tables["arm"]),
        gripper=_part("gripper", tables["gripper"]) if "gripper" in tables else None,
        cameras={name: _camera(name, table) for name, table in cameras.items()},
        limits=_record("[limits]", limits, Limits),
        control=_record("[control]", tables.get("control", {}), Control),
        world=_part("world", tables["world"]) if "world" in tables else None,
    )


def _part(kind: Kind, table: Any, where: str | None = None) -> Part:
    options = dict(_table(where or kind, table))
    if "driver" not in options:
        choices = ", ".join(DRIVERS[kind]) or "file.py:NAME"
        raise InvalidInput(f"[{where or kind}] driver: is missing; choose from {choices}")
    driver = _text(f"[{where or kind}] driver", options.pop("driver"))
    return Part(kind, driver, options)


def _camera(name: str, table: Any) -> CameraPart:
    where = f"camera.{name}"
    options = dict(_table(where, table))
    own = {f.name for f in dataclasses.fields(CameraPart)} - {"part"}
    placed = {key: options.pop(key) for key in own & options.keys()}
    part = _part("camera", options, where)
    return _record(f"[{where}]", {"part": part, **placed}, CameraPart)


def _record(where: str, values: Any, record: type[Any]) -> Any:
    """A record of ours from a table's values, each of the type that the record says."""
    values = _table(where, values)
    known = {f.name: f for f in dataclasses.fields(record)}
    hints = inspect.get_annotations(record, eval_str=True)
    converted = {}
    for name, value in values.items():
        if name not in known:
            raise InvalidInput(_unknown(where, name, list(known)))
        expected = hints[name]
        try:
            plain = expected in (int, float, bool, str) or str(expected).startswith(
                ("str |", "float |")
            )
            converted[name] = msgspec.convert(value, expected) if plain else value
        except msgspec.ValidationError as error:
            raise InvalidInput(
                f"{where} {name}: {error}".replace("Expected", "expected")
            ) from error
    missing = [
        name
        for name, f in known.items()
        if f.default is f.default_factory is dataclasses.MISSING and name not in converted
    ]
    if missing:
        raise InvalidInput(f"{where} {missing[0]}: is missing; add it")
    try:
        return record(**converted)
    except InvalidInput as error:
        raise InvalidInput(f"{where} {error}") from error


def _table(where: str, value: Any) -> Mapping[str, Any]:
    if not isinstance(value, Mapping):
        raise InvalidInput(f"[{where.strip('[]')}]: expected a table, got {value!r}")
    return value


def _text(where: str, value: Any) -> str:
    if not isinstance(value, str):
        raise InvalidInput(f"{where}: expected text, got {value!r}")
    return value


def _unknown(where: str, name: str, choices: Any) -> str:
    near = nearest_name(name, choices)
    hint = f"did you mean {near!r}? " if near else ""
    return f"{where}: unknown key {name!r}: {hint}expected {', '.join(choices)}"
