"""What a reader of LeRobot dataset v3.0 would fail on, often only when it comes to the place."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sart_toolkit.data.formats.format import all_problems
from sart_toolkit.data.formats.lerobot import INFO, STATS, TASKS, VERSION
from sart_toolkit.data.formats.statistics import STATISTICS
from sart_toolkit.data.formats.video import inspect_video, required
from sart_toolkit.data.storage import parse_json
from sart_toolkit.errors import BrokenFile

# A timestamp is compared with its place on the grid to within this [s], as readers do.
TOLERANCE = 1e-4
_REQUIRED = (
    "codebase_version", "fps", "features", "total_episodes", "total_frames", "total_tasks",
    "data_path",
)  # fmt: skip
_TYPES = {"float32", "float64", "int64", "int32", "bool", "string", "video", "image"}


def problems(path: Path) -> list[str]:
    """What is wrong with a dataset directory, a line each, the file named first."""
    return all_problems(_Check(Path(path)).run())


class _Check:
    """Checks one dataset; a file of rows is in memory at a time."""

    def __init__(self, root: Path) -> None:
        self._root = root
        self._arrow, self._parquet = required("pyarrow"), required("pyarrow.parquet")
        self._info: dict[str, Any] = {}
        self._n_tasks = 0
        # The least and greatest value of each column, to be compared with the statistics.
        self._ranges: dict[str, tuple[NDArray[Any], NDArray[Any]]] = {}

    def run(self) -> Iterator[str]:
        info = self._json(INFO)
        if isinstance(info, str):
            yield info
            return
        self._info = info
        head = list(self._head())
        yield from head
        # Without these, nothing else can be made sense of.
        if any(key not in info for key in _REQUIRED) or info["codebase_version"] != VERSION:
            return
        yield from self._tasks()
        episodes = self._rows("meta/episodes/*/*.parquet")
        if isinstance(episodes, str):
            yield episodes
            return
        yield from self._episodes(episodes)
        yield from self._data(episodes)
        yield from self._statistics()
        for key, feature in info["features"].items():
            if feature.get("dtype") == "video":
                yield from self._videos(key, feature, episodes)

    def _json(self, name: str) -> dict[str, Any] | str:
        """A file's JSON object, or what is wrong with it."""
        path = self._root / name
        try:
            value = parse_json(path.read_bytes(), name)
        except FileNotFoundError:
            return f"{name}: no such file"
        except (OSError, BrokenFile) as error:
            return f"{name}: {error}"
        return value if isinstance(value, dict) else f"{name}: expected a JSON object"

    def _rows(self, pattern: str) -> list[dict[str, Any]] | str:
        """The rows of small tables, statistics left out."""
        rows: list[dict[str, Any]] = []
        paths = sorted(self._root.glob(pattern))
        if not paths:
            return f"{pattern}: no such file"
        for path in paths:
            name = path.relative_to(self._root)
            try:
                schema = self._parquet.read_schema(path)
                columns = [c for c in schema.names if not c.startswith(("stats/", "sart/"))]
                rows += self._parquet.read_table(path, columns=columns).to_pylist()
            except (OSError, self._arrow.ArrowException) as error:
                return f"{name}: can't be read as parquet ({error})"
        return rows

    def _head(self) -> Iterator[str]:
        info = self._info
        for key in _REQUIRED:
            if key not in info:
                yield f"{INFO}: {key} is missing"
        if (version := info.get("codebase_version")) != VERSION:
            yield f"{INFO}: codebase_version is {version!r}, expected {VERSION!r}"
        fps = info.get("fps")
        if not isinstance(fps, int | float) or isinstance(fps, bool) or not fps > 0:
            yield f"{INFO}: fps: expected a number > 0, got {fps!r}"
            info.pop("fps", None)
        features = info.get("features")
        if not isinstance(features, dict):
            yield f"{INFO}: features: expected an object, got {type(features).__name__}"
            info.pop("features", None)
            return
        for name, feature in features.items():
            if feature.get("dtype") not in _TYPES:
                yield f"{INFO}: feature {name}: unknown dtype {feature.get('dtype')!r}"
            shape, names = feature.get("shape"), feature.get("names")
            if not isinstance(shape, list) or not all(isinstance(n, int) and n > 0 for n in shape):
                yield f"{INFO}: feature {name}: shape: expected whole numbers > 0, got {shape!r}"
                info.pop("features", None)
            elif isinstance(names, list) and len(shape) == 1 and len(names) != shape[0]:
                yield f"{INFO}: feature {name}: {len(names)} names for {shape[0]} values"
        splits = info.get("splits", {})
        for name, text in splits.items():
            first, _, last = str(text).partition(":")
            if not (first.isdigit() and last.isdigit()) or int(last) > info.get(
                "total_episodes", 0
            ):
                yield (
                    f"{INFO}: split {name} is {text!r}, there are {info.get('total_episodes')} "
                    "episodes"
                )

    def _tasks(self) -> Iterator[str]:
        path = self._root / TASKS
        try:
            table = self._parquet.read_table(path)
        except (OSError, self._arrow.ArrowException) as error:
            yield f"{TASKS}: can't be read ({error})"
            return
        pandas = json.loads((table.schema.metadata or {}).get(b"pandas", b"{}"))
        index = pandas.get("index_columns", [])
        if not index or index[0] not in table.column_names:
            yield f"{TASKS}: has no pandas index of task strings"
        if "task_index" not in table.column_names:
            yield f"{TASKS}: column task_index is missing"
            return
        numbers = table["task_index"].to_pylist()
        self._n_tasks = len(numbers)
        if numbers != list(range(len(numbers))):
            yield f"{TASKS}: task_index: expected 0, 1, ... in order, got {numbers[:5]}"
        if len(numbers) != self._info["total_tasks"]:
            yield f"{INFO}: total_tasks is {self._info['total_tasks']}, {TASKS} has {len(numbers)}"

    def _episodes(self, episodes: Sequence[Mapping[str, Any]]) -> Iterator[str]:
        where = "meta/episodes"
        wanted = ("episode_index", "tasks", "length", "dataset_from_index", "dataset_to_index")
        missing = [key for key in (*wanted, *_PLACE) if episodes and key not in episodes[0]]
        for key in missing:
            yield f"{where}: column {key} is missing"
        if missing:
            return
        if len(episodes) != self._info["total_episodes"]:
            yield (
                f"{INFO}: total_episodes is {self._info['total_episodes']}, {where} has "
                f"{len(episodes)}"
            )
        end = 0
        for i, row in enumerate(episodes):
            if row["episode_index"] != i:
                yield f"{where}: row {i} is of episode {row['episode_index']}"
            span = row["dataset_from_index"], row["dataset_to_index"]
            if span != (end, end + row["length"]):
                yield (
                    f"{where}: episode {i} has frames {span[0]} to {span[1]}, expected {end} to "
                    f"{end + row['length']}"
                )
            end = span[1]
        if end != self._info["total_frames"]:
            yield f"{INFO}: total_frames is {self._info['total_frames']}, {where} has {end}"

    def _data(self, episodes: Sequence[Mapping[str, Any]]) -> Iterator[str]:
        features = {
            name: feature
            for name, feature in self._info["features"].items()
            if feature["dtype"] != "video"
        }
        places: dict[str, list[int]] = {}
        for i, row in enumerate(episodes):
            if "data/chunk_index" in row:
                path = self._info["data_path"].format(
                    chunk_index=row["data/chunk_index"], file_index=row["data/file_index"]
                )
                places.setdefault(path, []).append(i)
        found = {str(path.relative_to(self._root)) for path in self._root.glob("data/*/*.parquet")}
        for name in sorted(found - set(places)):
            yield f"{name}: no episode of meta/episodes is in it"
        end = 0
        for name, inside in sorted(places.items()):
            if name not in found:
                yield f"{name}: no such file, episode {inside[0]} is in it"
                continue
            path = self._root / name
            schema = self._parquet.read_schema(path)
            for column in schema.names:
                if column not in features:
                    yield f"{name}: column {column} is not declared in {INFO}"
            missing = [column for column in features if column not in schema.names]
            for column in missing:
                yield f"{name}: column {column} is missing, {INFO} declares it"
            wrong = list(self._wrong_types(schema, features))
            yield from (f"{name}: {line}" for line in wrong)
            if missing or wrong:
                return
            table = self._parquet.read_table(path, columns=list(features))
            columns = {key: _numbers(table[key]) for key in features}
            wanted = sum(episodes[i]["length"] for i in inside)
            if table.num_rows != wanted:
                yield f"{name}: has {table.num_rows} frames, meta/episodes says {wanted}"
                return
            for key, values in columns.items():
                if values is not None:
                    yield from self._values(name, key, values)
                elif features[key]["dtype"] not in ("string", "image"):
                    yield f"{name}: {key} has rows of unequal length, or no numbers"
            at = 0
            for i in inside:
                part = slice(at, at + episodes[i]["length"])
                yield from self._episode(name, i, end + at, {k: v[part] for k, v in columns.items()
                                                             if v is not None})  # fmt: skip
                at = part.stop
            end += table.num_rows

    def _wrong_types(self, schema: Any, features: Mapping[str, Any]) -> Iterator[str]:
        types = self._arrow.types
        for name, feature in features.items():
            if name not in schema.names or len(feature["shape"]) > 1:
                continue
            kind, shape = schema.field(name).type, feature["shape"][0]
            listed = types.is_list(kind) or types.is_fixed_size_list(kind)
            if listed == (shape == 1):
                yield f"column {name} is {kind}, {INFO} declares {shape} value(s)"
            elif types.is_fixed_size_list(kind) and kind.list_size != shape:
                yield f"column {name} has {kind.list_size} values, {INFO} declares {shape}"
            elif _ARROW.get(str(kind.value_type if listed else kind)) != feature["dtype"]:
                yield f"column {name} is {kind}, {INFO} declares {feature['dtype']}"

    def _values(self, name: str, key: str, values: NDArray[Any]) -> Iterator[str]:
        if not np.isfinite(values).all():
            yield f"{name}: {key} has NaN or infinite values"
            return
        shape = self._info["features"][key]["shape"]
        if list(values.shape[1:]) != shape:
            yield f"{name}: {key} has rows of {list(values.shape[1:])}, {INFO} declares {shape}"
            return
        low, high = values.min(0), values.max(0)
        before = self._ranges.get(key, (low, high))
        self._ranges[key] = np.minimum(low, before[0]), np.maximum(high, before[1])

    def _episode(
        self, name: str, i: int, first: int, columns: Mapping[str, NDArray[Any]]
    ) -> Iterator[str]:
        n = len(next(iter(columns.values())))
        counts = np.arange(n)
        for key, expected in (
            ("frame_index", counts),
            ("index", first + counts),
            ("episode_index", np.full(n, i)),
        ):
            if key in columns and (wrong := np.flatnonzero(columns[key][:, 0] != expected)).size:
                at = int(wrong[0])
                yield (
                    f"{name}: episode {i}, frame {at}: {key} is {int(columns[key][at, 0])}, "
                    f"expected {int(expected[at])}"
                )
        if "timestamp" in columns:
            grid = counts / self._info["fps"]
            far = np.abs(columns["timestamp"][:, 0] - grid)
            if (off := np.flatnonzero(~(far <= TOLERANCE))).size:
                at = int(off[0])
                yield (
                    f"{name}: episode {i}, frame {at}: timestamp is "
                    f"{float(columns['timestamp'][at, 0]):.6g} s, expected {grid[at]:.6g} s (frame "
                    f"index / fps, within {TOLERANCE:g} s)"
                )
        if "task_index" in columns:
            tasks = columns["task_index"][:, 0]
            if (bad := np.flatnonzero((tasks < 0) | (tasks >= self._n_tasks))).size:
                yield (
                    f"{name}: episode {i}, frame {int(bad[0])}: task_index is "
                    f"{int(tasks[bad[0]])}, {TASKS} has {self._n_tasks}"
                )

    def _statistics(self) -> Iterator[str]:
        stats = self._json(STATS)
        if isinstance(stats, str):
            yield stats
            return
        for name, feature in self._info["features"].items():
            if feature["dtype"] == "string":
                continue
            found = stats.get(name)
            if not isinstance(found, dict):
                yield f"{STATS}: {name} is missing"
                continue
            shape = feature["shape"]
            expected = (shape[2], 1, 1) if feature["dtype"] in ("video", "image") else tuple(shape)
            for statistic in STATISTICS:
                yield from self._statistic(name, statistic, found, expected)
            yield from self._covered(name, found)

    def _statistic(
        self, name: str, statistic: str, found: Mapping[str, Any], expected: tuple[int, ...]
    ) -> Iterator[str]:
        if statistic not in found:
            yield f"{STATS}: {name}: {statistic} is missing"
            return
        try:
            value = np.asarray(found[statistic], dtype=np.float64)
        except (TypeError, ValueError):
            yield f"{STATS}: {name}: {statistic} is no array of numbers"
            return
        wanted = (1,) if statistic == "count" else expected
        if value.shape != wanted:
            yield (
                f"{STATS}: {name}: {statistic} has shape {list(value.shape)}, expected "
                f"{list(wanted)}"
            )
        elif not np.isfinite(value).all():
            yield f"{STATS}: {name}: {statistic} has NaN or infinite values"

    def _covered(self, name: str, found: Mapping[str, Any]) -> Iterator[str]:
        """Whether the data is within the statistics, up to rounding."""
        if name not in self._ranges:
            return
        low, high = self._ranges[name]
        try:
            least, most = (np.asarray(found[key], dtype=np.float64) for key in ("min", "max"))
            room = 1e-5 * (1 + np.abs(low) + np.abs(high))
            outside = (low < least - room) | (high > most + room)
        except (KeyError, TypeError, ValueError):
            return
        if outside.any():
            at = int(np.flatnonzero(outside)[0])
            yield (
                f"{STATS}: {name}: values reach from {low[at]:.4g} to {high[at]:.4g}, the "
                f"statistics say {least[at]:.4g} to {most[at]:.4g} (value {at})"
            )

    def _videos(
        self, key: str, feature: Mapping[str, Any], episodes: Sequence[Mapping[str, Any]]
    ) -> Iterator[str]:
        template, fps = self._info.get("video_path"), self._info["fps"]
        if not isinstance(template, str):
            yield f"{INFO}: video_path is missing, feature {key} is a video"
            return
        columns = [f"videos/{key}/{name}" for name in _VIDEO_PLACE]
        missing = [c for c in columns if episodes and c not in episodes[0]]
        if missing:
            yield from (f"meta/episodes: column {column} is missing" for column in missing)
            return
        files: dict[str, list[int]] = {}
        for i, row in enumerate(episodes):
            chunk, file = row[columns[0]], row[columns[1]]
            name = template.format(video_key=key, chunk_index=chunk, file_index=file)
            files.setdefault(name, []).append(i)
            length = row[columns[3]] - row[columns[2]]
            if abs(length - row["length"] / fps) > TOLERANCE:
                yield (
                    f"meta/episodes: episode {i}: {key} lasts {length:.6g} s, {row['length']} "
                    f"frames last {row['length'] / fps:.6g} s"
                )
        for name, inside in sorted(files.items()):
            yield from self._video(name, feature, [episodes[i] for i in inside], inside, columns)

    def _video(
        self,
        name: str,
        feature: Mapping[str, Any],
        rows: Sequence[Mapping[str, Any]],
        numbers: Sequence[int],
        columns: Sequence[str],
    ) -> Iterator[str]:
        path, fps = self._root / name, self._info["fps"]
        if not path.exists():
            yield f"{name}: no such file, episode {numbers[0]} is in it"
            return
        try:
            facts = inspect_video(path)
        except BrokenFile as error:
            yield f"{name}: {str(error).partition(': ')[2]}"
            return
        size = [facts.height, facts.width]
        if size != feature["shape"][:2]:
            yield f"{name}: images are {size}, {INFO} declares {feature['shape'][:2]}"
        info = feature.get("info") or {}
        for what, found in (("codec", facts.codec), ("pix_fmt", facts.pix_fmt)):
            told = info.get(f"video.{what}", found)
            if told != found:
                yield f"{name}: {what} is {found}, {INFO} declares {told}"
        wanted = sum(row["length"] for row in rows)
        if len(facts.times) != wanted:
            yield f"{name}: has {len(facts.times)} frames, meta/episodes says {wanted}"
            return
        at = 0
        for number, row in zip(numbers, rows, strict=True):
            expected = row[columns[2]] + np.arange(row["length"]) / fps
            far = np.abs(facts.times[at : at + row["length"]] - expected)
            if (far > TOLERANCE).any():
                bad = int(np.argmax(far > TOLERANCE))
                yield (
                    f"{name}: episode {number}, frame {bad}: is shown at "
                    f"{facts.times[at + bad]:.6g} s, expected {expected[bad]:.6g} s"
                )
            at += row["length"]


_PLACE = ("data/chunk_index", "data/file_index")
_VIDEO_PLACE = ("chunk_index", "file_index", "from_timestamp", "to_timestamp")
_ARROW = {"float": "float32", "double": "float64", "int64": "int64", "int32": "int32",
          "bool": "bool", "string": "string"}  # fmt: skip


def _numbers(column: Any) -> NDArray[Any] | None:
    """A column's numbers `(n, k)`, NaN where one is missing; None if it holds something else."""
    array = column.combine_chunks()
    while hasattr(array, "flatten") and hasattr(array.type, "value_type"):
        array = array.flatten()
    try:
        values = array.to_numpy(zero_copy_only=False).astype(np.float64)
        return values.reshape(len(column), -1)
    except (TypeError, ValueError):
        return None
