"""LeRobot dataset v3.0: parquet tables, MP4 videos and JSON, without importing lerobot.

A policy of LeRobot takes `observation.state` and the images. As in SART's own policies, the state
is the gripper and how the tool is tilted; joints and poses are there under names that such a policy
leaves aside.
"""

from __future__ import annotations

import contextlib
import json
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sart_toolkit.data.formats.format import (
    ACTION_NAMES,
    CONVENTIONS,
    POSE_NAMES,
    About,
    Given,
    Reads,
    Trajectory,
    pose_rows,
)
from sart_toolkit.data.formats.statistics import LevelStatistics, RowStatistics
from sart_toolkit.data.formats.video import Codec, VideoWriter, best_codec, required
from sart_toolkit.data.records import Demonstration
from sart_toolkit.errors import InvalidInput
from sart_toolkit.poses import Array, up_in_tool

VERSION = "v3.0"
INFO, STATS, TASKS, SIDE = (
    "meta/info.json",
    "meta/stats.json",
    "meta/tasks.parquet",
    "meta/sart.json",
)
_FILE = "chunk-{chunk_index:03d}/file-{file_index:03d}"
EPISODES = f"meta/episodes/{_FILE}.parquet"
DATA = f"data/{_FILE}.parquet"
VIDEOS = f"videos/{{video_key}}/{_FILE}.mp4"
_FILES_IN_CHUNK = 1000
# Rows of the table of episodes that are written at once.
_EPISODES_AT_ONCE = 50

# Every second frame can be jumped to, as readers draw single frames.
_GOP = {"g": "2"}
RGB_CODECS = (
    Codec(
        "libsvtav1", "av1", "yuv420p", "rgb24",
        {**_GOP, "crf": "30", "preset": "8", "svtav1-params": "lp=1"},
    ),
    Codec("libx264", "h264", "yuv420p", "rgb24", {**_GOP, "crf": "23", "bf": "0"}),
)  # fmt: skip
DEPTH_CODECS = (
    Codec(
        "libx265", "hevc", "gray12le", "gray12le",
        {**_GOP, "preset": "fast", "x265-params": "lossless=1:bframes=0:log-level=none:pools=none"},
    ),
)  # fmt: skip
# Depth is stored as one of 4096 levels that are even in log(depth + shift), all in metres.
DEPTH_LEVELS = 4096
DEPTH_MIN, DEPTH_MAX, DEPTH_SHIFT = 0.01, 10.0, 3.5

# The table's own columns and their types.
INDEX_COLUMNS = {
    "timestamp": "float32",
    "frame_index": "int64",
    "episode_index": "int64",
    "index": "int64",
    "task_index": "int64",
}


def depth_levels(depth: NDArray[Any]) -> NDArray[np.uint16]:
    """The levels that stand for depths [m]; 0, nothing hit, becomes the lowest as all below it."""
    low, high = np.log(DEPTH_MIN + DEPTH_SHIFT), np.log(DEPTH_MAX + DEPTH_SHIFT)
    share = (np.log(np.asarray(depth, np.float64) + DEPTH_SHIFT) - low) / (high - low)
    return np.rint(np.clip(share, 0, 1) * (DEPTH_LEVELS - 1)).astype(np.uint16)


def depth_of_levels(levels: NDArray[Any]) -> Array:
    """The depths [m] that levels stand for."""
    low, high = np.log(DEPTH_MIN + DEPTH_SHIFT), np.log(DEPTH_MAX + DEPTH_SHIFT)
    depth: Array = np.exp(levels / (DEPTH_LEVELS - 1) * (high - low) + low) - DEPTH_SHIFT
    return depth


class LeRobot(Reads):
    """LeRobot dataset v3.0, a directory."""

    name = "lerobot"
    mark = INFO

    def __init__(self, data_file_mb: int = 100, video_file_mb: int = 200) -> None:
        """Begin a new file where one has grown beyond so many MB."""
        self.data_file_mb, self.video_file_mb = data_file_mb, video_file_mb

    def write(self, path: Path, trajectories: Iterable[Trajectory], about: About) -> None:
        with contextlib.closing(_Writer(path, about, self)) as writer:
            for trajectory in trajectories:
                writer.add(trajectory)
            writer.finish()

    def problems(self, path: Path) -> Sequence[str]:
        from sart_toolkit.data.formats.lerobot_check import problems

        return problems(path)

    def recordings(self, path: Path) -> Sequence[Path]:
        from sart_toolkit.data.formats.lerobot_read import recordings

        return recordings(Path(path))

    def read(self, path: Path, given: Given) -> Demonstration:
        from sart_toolkit.data.formats.lerobot_read import read

        return read(Path(path), given)


def rows_of(trajectory: Trajectory, hz: int, with_force: bool) -> dict[str, NDArray[Any]]:
    """A trajectory's features by name, each float32 `(n, k)`."""
    steps = trajectory.steps
    gripper = steps.measured_gripper
    rate = np.diff(gripper, prepend=gripper[:1]) * hz
    features = {
        "action": trajectory.actions,
        "observation.state": np.column_stack(
            [gripper, rate, up_in_tool(steps.measured_Ts_world_tool)]
        ),
        "observation.joint_positions": steps.joint_positions,
        "observation.joint_velocities": steps.joint_velocities,
        "observation.tool_pose": pose_rows(steps.measured_Ts_world_tool),
        "commanded.joint_positions": steps.commanded_joint_positions,
        "commanded.tool_pose": pose_rows(steps.commanded_Ts_world_tool),
        "commanded.gripper": steps.commanded_gripper[:, None],
    }
    if with_force:
        features["observation.contact_force"] = steps.contact_force[:, None]
    return {name: np.asarray(rows, dtype=np.float32) for name, rows in features.items()}


def _describe_features(
    trajectory: Trajectory, about: About, with_force: bool
) -> dict[str, dict[str, Any]]:
    """`features` of `info.json`, without those of videos."""
    joints = list(about.joint_names)
    told: dict[str, tuple[list[str], dict[str, str]]] = {
        "action": (list(ACTION_NAMES), {"convention": CONVENTIONS["action"], "frame": "tool"}),
        "observation.state": (
            ["gripper", "gripper_rate", "up_x", "up_y", "up_z"],
            {
                "convention": f"measured gripper, {CONVENTIONS['gripper']}, its rate [1/s], and "
                "the world's upward direction in the tool frame"
            },
        ),
        "observation.joint_positions": (joints, {"unit": "rad"}),
        "observation.joint_velocities": (joints, {"unit": "rad/s"}),
        "observation.tool_pose": (
            list(POSE_NAMES),
            {"convention": f"measured, {CONVENTIONS['pose']}", "frame": "world"},
        ),
        "commanded.joint_positions": (joints, {"unit": "rad"}),
        "commanded.tool_pose": (
            list(POSE_NAMES),
            {"convention": f"commanded, {CONVENTIONS['pose']}", "frame": "world"},
        ),
        "commanded.gripper": (["gripper"], {"convention": CONVENTIONS["gripper"]}),
        "observation.contact_force": (["force"], {"convention": CONVENTIONS["contact_force"]}),
    }
    features = {
        name: {
            "dtype": "float32",
            "shape": [rows.shape[1]],
            "names": told[name][0],
            "info": told[name][1],
        }
        for name, rows in rows_of(trajectory, about.hz, with_force).items()
    }
    index = {
        name: {"dtype": dtype, "shape": [1], "names": None} for name, dtype in INDEX_COLUMNS.items()
    }
    return features | index


class _Video:
    """A camera's videos: a file after the other, and how its pixels are distributed."""

    def __init__(
        self, root: Path, key: str, codec: Codec, size: tuple[int, int], hz: int, limit: float
    ) -> None:
        self._root, self.key, self.codec = root, key, codec
        self.height, self.width = size
        self._hz, self._limit = hz, limit
        self._writer: VideoWriter | None = None
        self.file = -1
        self.is_depth = codec.given == "gray12le"
        self.statistics = self.levels()

    def levels(self) -> LevelStatistics:
        """Counts of nothing yet."""
        if self.is_depth:
            return LevelStatistics(depth_of_levels(np.arange(DEPTH_LEVELS)), 1)
        return LevelStatistics(np.arange(256) / 255, 3)

    def add(self, frames: NDArray[Any]) -> tuple[dict[str, Any], dict[str, Array]]:
        """Where an episode's frames stand in the files, and their statistics."""
        writer = self._writer
        if writer is None or writer.n_bytes >= self._limit:
            self._close()
            self.file += 1
            path = self._root / VIDEOS.format(video_key=self.key, **place(self.file))
            writer = VideoWriter(path, self.codec, self.width, self.height, self._hz)
            self._writer = writer
        first = writer.frames
        for frame in frames:
            writer.add(frame)
        where = {
            **{f"videos/{self.key}/{name}": value for name, value in place(self.file).items()},
            f"videos/{self.key}/from_timestamp": first / self._hz,
            f"videos/{self.key}/to_timestamp": writer.frames / self._hz,
        }
        statistics = self.levels()
        statistics.add(frames if frames.ndim == 4 else frames[..., None])
        self.statistics.merge(statistics)
        return where, statistics.result()

    def _close(self) -> None:
        if self._writer is not None:
            self._writer.close()
        self._writer = None

    finish = _close

    def abandon(self) -> None:
        if self._writer is not None:
            self._writer.abandon()

    def feature(self) -> dict[str, Any]:
        """What `info.json` says of it."""
        depth = {
            "depth_unit": "m",
            "video.depth_min": DEPTH_MIN,
            "video.depth_max": DEPTH_MAX,
            "video.shift": DEPTH_SHIFT,
            "video.use_log": True,
        }
        return {
            "dtype": "video",
            "shape": [self.height, self.width, 1 if self.is_depth else 3],
            "names": ["height", "width", "channels"],
            "info": {
                "video.height": self.height,
                "video.width": self.width,
                "video.codec": self.codec.canonical,
                "video.pix_fmt": self.codec.pix_fmt,
                "video.is_depth_map": self.is_depth,
                "is_depth_map": self.is_depth,
                "video.fps": self._hz,
                "video.channels": 1 if self.is_depth else 3,
                "has_audio": False,
                **(depth if self.is_depth else {}),
            },
        }


def place(number: int) -> dict[str, int]:
    """Chunk and file of the file with a number."""
    return {"chunk_index": number // _FILES_IN_CHUNK, "file_index": number % _FILES_IN_CHUNK}


class _Table:
    """Parquet files, one after the other, of the same columns."""

    def __init__(self, root: Path, template: str, limit: float) -> None:
        self._root, self._template, self._limit = root, template, limit
        self._writer: Any = None
        self._bytes = 0
        self.file = -1

    def next_place(self) -> dict[str, int]:
        """The chunk and file that the next table goes to, begun if the last one is full."""
        if self.file < 0 or self._bytes > self._limit:
            self.close()
            self.file += 1
            self._bytes = 0
        return place(self.file)

    def add(self, table: Any) -> None:
        """Write a table as a row group of its own."""
        parquet = required("pyarrow.parquet")
        path = self._root / self._template.format(**self.next_place())
        if self._writer is None:
            path.parent.mkdir(parents=True, exist_ok=True)
            self._writer = parquet.ParquetWriter(path, table.schema, compression="snappy")
        self._writer.write_table(table)
        self._bytes += table.nbytes

    def close(self) -> None:
        if self._writer is not None:
            self._writer.close()
        self._writer = None


class _Writer:
    """Writes a dataset, an episode at a time."""

    def __init__(self, root: Path, about: About, options: LeRobot) -> None:
        self._arrow = required("pyarrow")
        self._root, self._about = root, about
        self._limit = options.video_file_mb * 2**20
        self._data = _Table(root, DATA, options.data_file_mb * 2**20)
        self._episodes = _Table(root, EPISODES, options.data_file_mb * 2**20)
        self._waiting: list[dict[str, Any]] = []
        self._videos: dict[str, _Video] = {}
        self._features: dict[str, dict[str, Any]] = {}
        self._statistics: dict[str, RowStatistics] = {}
        self._with_force = False
        self._n_episodes = self._n_frames = 0
        self._options = options

    def _begin(self, trajectory: Trajectory) -> None:
        """Settle the features by the first trajectory."""
        about = self._about
        self._with_force = bool(np.isfinite(trajectory.steps.contact_force).all())
        self._features = _describe_features(trajectory, about, self._with_force)
        self._statistics = {name: RowStatistics() for name in self._features}
        rgb = best_codec(RGB_CODECS)
        for name, camera in trajectory.steps.cameras.items():
            height, width = camera.rgb.shape[1:3]
            if height % 2 or width % 2:
                raise InvalidInput(
                    f"camera {name!r}: LeRobot's videos need an even width and height, got "
                    f"{width}x{height}; record with another --image-size"
                )
            kinds = {f"observation.images.{name}": rgb}
            if about.depth:
                kinds[f"observation.images.{name}_depth"] = best_codec(DEPTH_CODECS)
            for key, codec in kinds.items():
                self._videos[key] = _Video(
                    self._root, key, codec, (height, width), about.hz, self._limit
                )

    def add(self, trajectory: Trajectory) -> None:
        """Write an episode."""
        if not self._features:
            self._begin(trajectory)
        n, first = len(trajectory), self._n_frames
        rows = rows_of(trajectory, self._about.hz, self._with_force)
        for name, values in rows.items():
            if not np.isfinite(values).all():
                raise InvalidInput(
                    f"{trajectory.name}: {name} has NaN or infinite values; leave it out"
                )
        frame = np.arange(n)
        rows["timestamp"] = (frame / self._about.hz).astype(np.float32)[:, None]
        for name, value in (
            ("frame_index", frame),
            ("episode_index", np.full(n, self._n_episodes)),
            ("index", first + frame),
            ("task_index", np.zeros(n)),
        ):
            rows[name] = value.astype(np.int64)[:, None]
        where = {f"data/{name}": value for name, value in self._data.next_place().items()}
        self._data.add(self._table(rows))
        statistics = {}
        for name, values in rows.items():
            self._statistics[name].add(values)
            own = RowStatistics()
            own.add(values)
            statistics[name] = own.result()
        for name, camera in trajectory.steps.cameras.items():
            pictures: dict[str, NDArray[Any]] = {f"observation.images.{name}": camera.rgb}
            if self._about.depth:
                pictures[f"observation.images.{name}_depth"] = depth_levels(camera.depth)
            for key, frames in pictures.items():
                found, statistics[key] = self._videos[key].add(frames)
                where |= found
        even = np.arange(n) / self._about.hz
        off = float(np.abs(trajectory.timestamps - trajectory.timestamps[0] - even).max())
        provenance = {
            "name": trajectory.name,
            **trajectory.provenance,
            "largest_timestamp_shift_s": off,
        }
        self._waiting.append(
            {
                "episode_index": self._n_episodes,
                "tasks": [self._about.instruction],
                "length": n,
                "dataset_from_index": first,
                "dataset_to_index": first + n,
                **where,
                **{
                    f"stats/{key}/{name}": value.tolist()
                    for key, values in statistics.items()
                    for name, value in values.items()
                },
                "sart/success": bool(trajectory.success[-1]),
                "sart/provenance": json.dumps(provenance, allow_nan=False),
            }
        )
        self._n_episodes += 1
        self._n_frames += n
        if len(self._waiting) >= _EPISODES_AT_ONCE:
            self._flush()

    def _table(self, rows: Mapping[str, NDArray[Any]]) -> Any:
        arrow = self._arrow
        columns = {}
        for name, values in rows.items():
            flat = arrow.array(values.reshape(-1))
            k = values.shape[1]
            columns[name] = flat if k == 1 else arrow.FixedSizeListArray.from_arrays(flat, k)
        return arrow.table(columns)

    def _flush(self) -> None:
        if not self._waiting:
            return
        for name, value in self._episodes.next_place().items():
            for row in self._waiting:
                row[f"meta/episodes/{name}"] = value
        columns = {key: [row[key] for row in self._waiting] for key in self._waiting[0]}
        self._episodes.add(self._arrow.table(columns))
        self._waiting = []

    def finish(self) -> None:
        """Write what is known at the end."""
        self._flush()
        self._data.close()
        self._episodes.close()
        for video in self._videos.values():
            video.finish()
        about, n = self._about, self._n_episodes
        features = {
            **{name: f for name, f in self._features.items() if name not in INDEX_COLUMNS},
            **{key: video.feature() for key, video in self._videos.items()},
            **{name: self._features[name] for name in INDEX_COLUMNS},
        }
        statistics = {name: found.result() for name, found in self._statistics.items()} | {
            key: video.statistics.result() for key, video in self._videos.items()
        }
        self._write_tasks()
        self._write(
            STATS,
            {
                key: {name: value.tolist() for name, value in values.items()}
                for key, values in statistics.items()
            },
        )
        self._write(SIDE, about.sart)
        self._write(
            INFO,
            {
                "codebase_version": VERSION,
                "robot_type": about.robot,
                "total_episodes": n,
                "total_frames": self._n_frames,
                "total_tasks": 1,
                "chunks_size": _FILES_IN_CHUNK,
                "data_files_size_in_mb": self._options.data_file_mb,
                "video_files_size_in_mb": self._options.video_file_mb,
                "fps": about.hz,
                "splits": {"train": f"0:{n}"},
                "data_path": DATA,
                "video_path": VIDEOS if self._videos else None,
                "features": features,
            },
        )

    def _write(self, name: str, value: Mapping[str, Any]) -> None:
        (self._root / name).write_text(json.dumps(value, indent=4, allow_nan=False) + "\n")

    def _write_tasks(self) -> None:
        """The table of tasks, whose index pandas takes from the column `task`."""
        arrow = self._arrow

        def told(name: str | None, kind: str, dtype: str) -> dict[str, Any]:
            return {
                "name": name,
                "field_name": name,
                "pandas_type": kind,
                "numpy_type": dtype,
                "metadata": None,
            }

        pandas = {
            "index_columns": ["task"],
            "column_indexes": [
                told(None, "unicode", "object") | {"metadata": {"encoding": "UTF-8"}}
            ],
            "columns": [told("task_index", "int64", "int64"), told("task", "unicode", "object")],
            "creator": {"library": "pyarrow", "version": arrow.__version__},
            "pandas_version": "2.0.0",
        }
        table = arrow.table(
            {"task_index": arrow.array([0], arrow.int64()), "task": [self._about.instruction]}
        ).replace_schema_metadata({"pandas": json.dumps(pandas)})
        required("pyarrow.parquet").write_table(table, self._root / TASKS)

    def close(self) -> None:
        """Let go of all files."""
        for table in (self._data, self._episodes):
            with contextlib.suppress(OSError, self._arrow.ArrowException):
                table.close()
        for video in self._videos.values():
            video.abandon()
