"""Episodes of LeRobot dataset v3.0 as demonstrations; of others', a person says what is where.

LeRobot names no columns for tool poses, joints or the gripper, has no intrinsics and no mounting:
what the toolkit's own exports say in `meta/sart.json`, of others' is given.
"""

from __future__ import annotations

import io
import itertools
import json
import logging
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image as PillowImage

from sart_toolkit.data.formats.format import (
    ROTATIONS,
    SAID_BY_OURS,
    Given,
    imported_demonstration,
    poses_of,
)
from sart_toolkit.data.formats.lerobot import INFO, SIDE, VERSION
from sart_toolkit.data.formats.video import read_video, required
from sart_toolkit.data.records import CameraRecord, Demonstration, Steps
from sart_toolkit.data.storage import parse_json
from sart_toolkit.errors import BrokenFile, InvalidInput, Unreachable, unknown_name
from sart_toolkit.poses import Array

_EPISODE = "episode_{:06d}"
_IMAGES = "observation.images."
_DEPTH = "_depth"
# Where the toolkit's own exports have what.
_OUR_COLUMNS = {
    "joints": "observation.joint_positions",
    "joint_velocities": "observation.joint_velocities",
    "tool_pose": "observation.tool_pose",
    "gripper": "observation.state[0]",
    "commanded_joints": "commanded.joint_positions",
    "commanded_tool_pose": "commanded.tool_pose",
    "commanded_gripper": "commanded.gripper",
}
COLUMNS = tuple(_OUR_COLUMNS)
_log = logging.getLogger(__name__)


def recordings(path: Path) -> list[Path]:
    """A path for each episode of a dataset, or the path alone if it is one of these."""
    root = _root(path)
    if root is None:
        return []
    if root != path:
        return [path]
    count = _json(root / INFO).get("total_episodes", 0)
    return [root / _EPISODE.format(i) for i in range(count)]


def read(path: Path, given: Given) -> Demonstration:
    """An episode, by one of `recordings`, as a demonstration.

    Raises:
        BrokenFile: it can't be read.
        InvalidInput: something is neither in the file nor given; the message says how to.
        MissingExtra: PyAV or pyarrow isn't installed.
    """
    root = _root(path)
    if root is None or root == path:
        raise BrokenFile(f"{path}: is no episode of a LeRobot dataset")
    try:
        return _Episode(root, int(path.name.rpartition("_")[2]), given).demonstration()
    except InvalidInput as error:
        raise InvalidInput(f"{path}: {error}") from error


def _root(path: Path) -> Path | None:
    """The dataset that a path is, or is an episode of."""
    if (path / INFO).is_file():
        return path
    named = re.fullmatch(r"episode_\d+", path.name)
    return path.parent if named and (path.parent / INFO).is_file() else None


def _json(path: Path) -> dict[str, Any]:
    try:
        value = parse_json(path.read_bytes(), str(path))
    except OSError as error:
        raise BrokenFile(f"{path}: can't be read ({error})") from error
    if not isinstance(value, dict):
        raise BrokenFile(f"{path}: expected a JSON object")
    return value


class _Episode:
    """An episode that is being read."""

    def __init__(self, root: Path, number: int, given: Given) -> None:
        self._root, self._number, self._given = root, number, given
        self._arrow, self._parquet = required("pyarrow"), required("pyarrow.parquet")
        self._info = _json(root / INFO)
        if (version := self._info.get("codebase_version")) != VERSION:
            raise BrokenFile(
                f"{root}: is of LeRobot {version}, {VERSION} is read; convert it with LeRobot"
            )
        self._features: Mapping[str, Any] = self._info.get("features", {})
        self._ours = _json(root / SIDE) if (root / SIDE).is_file() else {}
        if self._ours:
            given.check_unsaid(SAID_BY_OURS, "says itself what this would")
        self._columns = {**(_OUR_COLUMNS if self._ours else {}), **given.columns}
        for name in given.columns:
            if name not in COLUMNS:
                raise unknown_name("column", name, COLUMNS)
        self._row = self._episode_row()
        self._provenance = json.loads(self._row.get("sart/provenance", "{}"))
        self._table = self._data()

    def _read(self, path: Path) -> Any:
        try:
            return self._parquet.read_table(path)
        except (OSError, self._arrow.ArrowException) as error:
            raise BrokenFile(f"{path}: can't be read as parquet ({error})") from error

    def _episode_row(self) -> dict[str, Any]:
        for path in sorted(self._root.glob("meta/episodes/*/*.parquet")):
            table = self._read(path)
            keep = [c for c in table.column_names if not c.startswith("stats/")]
            for row in table.select(keep).to_pylist():
                if row.get("episode_index") == self._number:
                    return dict(row)
        raise BrokenFile(f"{self._root}: meta/episodes has no episode {self._number}")

    def _data(self) -> Any:
        """The episode's rows."""
        place = {key: self._row[f"data/{key}"] for key in ("chunk_index", "file_index")}
        table = self._read(self._root / self._info["data_path"].format(**place))
        compute = required("pyarrow.compute")
        table = table.filter(compute.equal(table["episode_index"], self._number))
        if len(table) != self._row["length"]:
            raise BrokenFile(
                f"{self._root}: episode {self._number} has {len(table)} rows, expected "
                f"{self._row['length']}"
            )
        return table

    def demonstration(self) -> Demonstration:
        """All of it."""
        steps, ours = self._steps(), self._ours
        time = self._numbers("timestamp")[:, 0]
        success = np.zeros(len(steps), bool)
        if ours:
            success[-1] = self._row["sart/success"]
        return imported_demonstration(self._given, ours, self._provenance, steps, time, success)

    # --- columns --------------------------------------------------------------------------------

    def _numbers(self, column: str) -> Array:
        """The rows `(n, k)` of a table's column."""
        values = self._table[column].to_pylist()
        try:
            rows = np.array(values, dtype=np.float64)
        except (TypeError, ValueError) as error:
            raise BrokenFile(f"{self._root}: column {column} isn't numbers ({error})") from error
        if not np.isfinite(rows).all():
            raise BrokenFile(f"{self._root}: column {column} has NaN or infinite values")
        return rows.reshape(len(rows), -1)

    def _column(self, name: str) -> Array | None:
        """What is named, `(n, k)`; None where nobody says where it is."""
        if name not in self._columns:
            return None
        text = self._columns[name]
        match = re.fullmatch(r"(.+?)(?:\[(\d+)(?::(\d+))?\])?", text)
        assert match is not None
        column, first, last = match.groups()
        if column not in self._table.column_names:
            raise unknown_name("column", column, self._table.column_names)
        rows = self._numbers(column)
        if first is None:
            return rows
        part = rows[:, int(first) : int(last) if last else int(first) + 1]
        if part.shape[1] != (int(last) - int(first) if last else 1):
            raise InvalidInput(
                f"column {text}: {column} has {rows.shape[1]} numbers a row; the first is 0"
            )
        return part

    def _lacks(self, what: str, how: str) -> InvalidInput:
        there = []
        for name, feature in self._features.items():
            if feature.get("dtype") in ("float32", "float64") and name != "timestamp":
                names = feature.get("names")
                words = names if isinstance(names, list) else feature.get("shape", [])
                there.append(f"{name} ({', '.join(map(str, words))})")
        return InvalidInput(f"{what} isn't said; add {how}; there are {'; '.join(there)}")

    def _steps(self) -> Steps:
        motion = self._motion("")
        if motion is None:
            raise self._lacks(
                "which columns are the joints or the tool's pose",
                "--columns joints=COLUMN[A:B] or tool_pose=COLUMN[A:B]",
            )
        measured, q = motion
        n = len(q)
        commanded = self._motion("commanded_")
        if commanded is None:
            _log.warning("%s: no commanded motion: as if what was measured", self._root)
            commanded = motion
        gripper = self._column("gripper")
        if gripper is None:
            raise self._lacks("which column is the gripper's", "--columns gripper=COLUMN[I]")
        if gripper.shape[1] != 1:
            raise InvalidInput(f"gripper: {gripper.shape[1]} numbers a row, expected one")
        told = self._column("commanded_gripper")
        if told is None:
            _log.warning("%s: no commanded gripper: as if what was measured", self._root)
            told = gripper
        velocities = self._column("joint_velocities")
        if velocities is None:
            velocities = np.gradient(q, axis=0) * float(self._info["fps"])
        force = (
            self._numbers("observation.contact_force")[:, 0]
            if self._ours and "observation.contact_force" in self._table.column_names
            else np.full(n, np.nan)
        )
        return Steps(
            joint_positions=q,
            joint_velocities=velocities,
            commanded_joint_positions=commanded[1],
            measured_Ts_world_tool=measured,
            commanded_Ts_world_tool=commanded[0],
            measured_gripper=self._gripper(gripper),
            commanded_gripper=self._gripper(told),
            contact_force=force,
            cameras=self._cameras(n),
        )

    def _gripper(self, values: Array) -> Array:
        return values[:, 0] if self._ours else self._given.gripper(values[:, 0])

    def _motion(self, which: str) -> tuple[Array, Array] | None:
        """Tool poses `(n, 4, 4)` and joints `(n, j)`, measured or commanded; None if not said."""
        joints, rows = self._column(f"{which}joints"), self._column(f"{which}tool_pose")
        if self._ours and joints is not None and rows is not None:
            return poses_of(rows, "6d"), joints
        if joints is not None and rows is not None:
            raise InvalidInput(f"columns: {which}joints and {which}tool_pose; give one of them")
        if joints is None and rows is None:
            return None
        arm = self._given.arm
        if arm is None:
            raise InvalidInput("the kinematics are known from the robot alone; add --robot REF")
        if joints is not None:
            if self._given.rotation is not None or arm.T_frame_tool is not None:
                raise InvalidInput(
                    f"{which}joints: have no rotation and no frame; leave --rotation and "
                    "--pose-frame out"
                )
            if joints.shape[1] != len(arm.home):
                raise InvalidInput(
                    f"joints: {joints.shape[1]} numbers a row, the robot has {len(arm.home)} arm "
                    f"joints; add --columns {which}joints=COLUMN[A:B]"
                )
            return np.array([arm.fk(q) for q in joints]), joints
        assert rows is not None
        if self._given.rotation is None:
            raise InvalidInput(
                f"{which}tool_pose: how its rotations are written isn't said; add --rotation "
                f"{' or '.join(ROTATIONS)}"
            )
        if arm.T_frame_tool is None:
            raise InvalidInput(
                f"{which}tool_pose: of which frame of the robot it is isn't said; add --pose-frame "
                "FRAME, a link of its URDF, or tool"
            )
        Ts = arm.T_world_base @ poses_of(rows, self._given.rotation) @ arm.T_frame_tool
        try:
            return Ts, arm.inverse(Ts)
        except Unreachable as error:
            raise InvalidInput(
                f"{which}tool_pose: {error}; check --rotation, --pose-frame, that positions are in "
                "metres and in the frame of the robot's base"
            ) from error

    # --- cameras --------------------------------------------------------------------------------

    def _cameras(self, n: int) -> dict[str, CameraRecord]:
        keys = [name for name in self._features if name.startswith(_IMAGES)]
        there = [
            name.removeprefix(_IMAGES) for name in keys if not self._is_depth(self._features[name])
        ]
        return {
            name: self._camera(name, theirs, n)
            for name, theirs in self._given.chosen_cameras(there).items()
        }

    @staticmethod
    def _is_depth(feature: Mapping[str, Any]) -> bool:
        info = feature.get("info") or {}
        return bool(info.get("is_depth_map") or info.get("video.is_depth_map"))

    def _camera(self, name: str, theirs: str, n: int) -> CameraRecord:
        rgb = self._frames(_IMAGES + theirs, "rgb24", n)
        key = f"{_IMAGES}{theirs}{_DEPTH}"
        if key in self._features and self._is_depth(self._features[key]):
            depth = _depth_of(self._frames(key, "gray12le", n), self._features[key], key)
        else:
            _log.warning("%s: camera %r has no depth: as if nothing was hit", self._root, theirs)
            depth = np.zeros(rgb.shape[:3], np.float32)
        told = self._provenance.get("cameras", {}).get(theirs)
        if told is not None:
            frame, T, K = told["frame"], told["T_frame_camera"], told["intrinsics"]
        else:
            frame, T = self._given.mounting(name)
            K = self._given.intrinsics_of(name, rgb.shape[2], rgb.shape[1])
        return CameraRecord(rgb, depth, np.asarray(K), frame, np.asarray(T))

    def _frames(self, key: str, pix_fmt: str, n: int) -> NDArray[Any]:
        """A camera's images of the episode: of its video, or of the table."""
        if self._features[key].get("dtype") == "image":
            return np.stack([_decoded(value, key) for value in self._table[key].to_pylist()])
        place = {k: self._row[f"videos/{key}/{k}"] for k in ("chunk_index", "file_index")}
        path = self._root / self._info["video_path"].format(video_key=key, **place)
        start = float(self._row[f"videos/{key}/from_timestamp"])
        frames = list(itertools.islice(read_video(path, pix_fmt, start), n))
        if len(frames) != n:
            raise BrokenFile(
                f"{path}: has {len(frames)} frames of episode {self._number}, expected {n}"
            )
        return np.stack(frames)


def _decoded(value: Any, key: str) -> NDArray[np.uint8]:
    try:
        return np.array(PillowImage.open(io.BytesIO(value["bytes"])).convert("RGB"))
    except (OSError, TypeError, KeyError) as error:
        raise BrokenFile(f"{key}: holds something that is no image ({error})") from error


def _depth_of(levels: NDArray[Any], feature: Mapping[str, Any], key: str) -> NDArray[np.float32]:
    """Depths [m] of a video's levels, as its feature says; 0 at the lowest, nothing hit."""
    info = feature["info"]
    try:
        low, high = float(info["video.depth_min"]), float(info["video.depth_max"])
        shift, unit = float(info["video.shift"]), {"m": 1.0, "mm": 1e-3}[info["depth_unit"]]
        share = levels / (2**12 - 1)
        if info["video.use_log"]:
            a, b = np.log(low + shift), np.log(high + shift)
            depth = np.exp(share * (b - a) + a) - shift
        else:
            depth = share * (high - low) + low
    except (KeyError, TypeError, ValueError) as error:
        raise BrokenFile(f"{key}: doesn't say how its depth is written ({error})") from error
    return np.where(levels > 0, unit * depth, 0.0).astype(np.float32)
