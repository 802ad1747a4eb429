"""LeRobot dataset v3.0: what readers rely on is there, and what they fail on is found."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import av
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from sart_toolkit.data.formats import video
from sart_toolkit.data.formats.format import About, Trajectory, about_dataset
from sart_toolkit.data.formats.lerobot import (
    DEPTH_CODECS,
    DEPTH_LEVELS,
    INFO,
    RGB_CODECS,
    SIDE,
    STATS,
    TASKS,
    LeRobot,
    depth_levels,
    depth_of_levels,
)
from sart_toolkit.data.formats.statistics import QUANTILES, LevelStatistics, RowStatistics
from sart_toolkit.data.formats.transfer import export_dataset
from sart_toolkit.errors import InvalidInput, MissingExtra

DATA = "data/chunk-000/file-000.parquet"
EPISODES = "meta/episodes/chunk-000/file-000.parquet"
RGB, DEPTH = "observation.images.wrist", "observation.images.wrist_depth"
VIDEO = f"videos/{RGB}/chunk-000/file-000.mp4"


@pytest.fixture
def copy(exported: Callable[[str], Path], tmp_path: Path) -> Path:
    """An export that may be damaged."""
    return Path(shutil.copytree(exported("lerobot"), tmp_path / "copy"))


def info_of(root: Path) -> dict[str, Any]:
    value: dict[str, Any] = json.loads((root / INFO).read_text())
    return value


# --- what is written ----------------------------------------------------------------------------


def test_the_tables_say_what_the_trajectories_do(exported, trajectories):
    root = exported("lerobot")
    info = info_of(root)
    table = pq.read_table(root / DATA)
    assert table.column_names == [k for k, f in info["features"].items() if f["dtype"] != "video"]
    assert (info["total_episodes"], info["total_frames"]) == (5, sum(map(len, trajectories)))
    assert info["fps"] == 10 and info["splits"] == {"train": "0:5"}
    for episode, trajectory in zip(pq.read_table(root / EPISODES).to_pylist(), trajectories,
                                   strict=True):  # fmt: skip
        span = slice(episode["dataset_from_index"], episode["dataset_to_index"])
        part = table.slice(span.start, episode["length"])
        actions = np.array(part["action"].to_pylist())
        np.testing.assert_allclose(actions, trajectory.actions, atol=1e-7)
        state = np.array(part["observation.state"].to_pylist())
        np.testing.assert_allclose(state[:, 0], trajectory.steps.measured_gripper, atol=1e-7)
        R = trajectory.steps.measured_Ts_world_tool[:, :3, :3]
        np.testing.assert_allclose(state[:, 2:], R.swapaxes(1, 2) @ [0, 0, 1], atol=1e-7)
        timestamps = np.array(part["timestamp"].to_pylist())
        np.testing.assert_allclose(timestamps, np.arange(len(trajectory)) / 10, atol=1e-6)
        assert part["index"].to_pylist() == list(range(span.start, span.stop))
        assert set(part["episode_index"].to_pylist()) == {episode["episode_index"]}
        assert episode["tasks"] == ["Lower the peg into the hole"]
        provenance = json.loads(episode["sart/provenance"])
        assert provenance["content_hash"] == trajectory.provenance["content_hash"]
        assert episode["sart/success"] is True


def test_the_state_is_no_shortcut_to_the_placement(exported):
    """A policy of LeRobot is given `observation.state` and the images."""
    features = info_of(exported("lerobot"))["features"]
    assert features["observation.state"]["names"] == [
        "gripper", "gripper_rate", "up_x", "up_y", "up_z"
    ]  # fmt: skip
    assert "relative to the tool pose commanded for t" in features["action"]["info"]["convention"]
    side = json.loads((exported("lerobot") / SIDE).read_text())
    assert side["cameras"]["wrist"]["frame"] == "tool" and side["robot"] == "ur5e_2f85"


def test_pandas_would_find_the_tasks_by_their_text(exported):
    table = pq.read_table(exported("lerobot") / TASKS)
    pandas = json.loads(table.schema.metadata[b"pandas"])
    assert pandas["index_columns"] == ["task"]
    assert table.to_pylist() == [{"task_index": 0, "task": "Lower the peg into the hole"}]


def frame_at(path: Path, seconds: float, pix_fmt: str) -> np.ndarray:
    """The frame that a reader draws: the one nearest to a time, from the key frame before it."""
    with av.open(str(path)) as container:
        stream = container.streams.video[0]
        container.seek(round(seconds / stream.time_base), stream=stream, backward=True)
        best = min(
            (
                frame
                for frame, _ in zip(container.decode(stream), range(4), strict=False)
                if frame.pts is not None
            ),
            key=lambda frame: abs(float(frame.pts * stream.time_base) - seconds),
        )
        assert abs(float(best.pts * stream.time_base) - seconds) < 1e-4
        return best.to_ndarray(format=pix_fmt)


def test_the_frame_drawn_for_each_row_is_its_own(exported, trajectories):
    """Depth to the level; colours as near as the codec has them, and nearest to the row's own."""
    root = exported("lerobot")
    for episode, trajectory in zip(pq.read_table(root / EPISODES).to_pylist(), trajectories,
                                   strict=True):  # fmt: skip
        camera = trajectory.steps.cameras["wrist"]
        n = len(trajectory)
        for i in (0, 1, n // 2, n - 1):
            at = {key: episode[f"videos/{key}/from_timestamp"] + i / 10 for key in (RGB, DEPTH)}
            levels = frame_at(root / VIDEO.replace(RGB, DEPTH), at[DEPTH], "gray12le")
            assert np.array_equal(levels, depth_levels(camera.depth[i]))
            image = frame_at(root / VIDEO, at[RGB], "rgb24").astype(float)
            far = np.abs(image - camera.rgb).mean(axis=(1, 2, 3))
            assert far[i] < 6 and far[i] <= far.min() + 0.5


def test_depth_keeps_a_thousandth_of_its_distance_and_3_5_m():
    depth = np.linspace(0.01, 9.9, 2000)
    error = np.abs(depth_of_levels(depth_levels(depth)) - depth)
    assert (error <= 1.7e-4 * (depth + 3.5)).all()
    assert depth_levels(np.array([0.0])) == 0 and depth_levels(np.array([99.0])) == DEPTH_LEVELS - 1


def test_files_are_rotated_and_still_fit_together(peg_dataset, tmp_path):
    out = tmp_path / "small"
    export_dataset(
        peg_dataset, LeRobot(data_file_mb=0, video_file_mb=0), out, about_dataset(peg_dataset)
    )
    assert len(list(out.glob("data/*/*.parquet"))) == 5
    assert len(list(out.glob(f"videos/{RGB}/*/*.mp4"))) == 5
    # Files of no size are nothing that one would ask for, but it is what was asked for here.
    assert LeRobot().problems(out) == []


def test_depth_may_be_left_out(peg_dataset, tmp_path):
    out = tmp_path / "rgb"
    export_dataset(peg_dataset, LeRobot(), out, about_dataset(peg_dataset, depth=False))
    assert DEPTH not in info_of(out)["features"] and LeRobot().problems(out) == []


def test_without_av1_it_is_h264(peg_dataset, tmp_path, monkeypatch):
    monkeypatch.setattr("sart_toolkit.data.formats.lerobot.RGB_CODECS", RGB_CODECS[1:])
    out = tmp_path / "h264"
    export_dataset(peg_dataset, LeRobot(), out, about_dataset(peg_dataset, depth=False))
    assert info_of(out)["features"][RGB]["info"]["video.codec"] == "h264"
    assert LeRobot().problems(out) == []


def test_a_missing_encoder_or_library_says_what_to_install(monkeypatch):
    nothing = video.Codec("nonsense", "nonsense", "rgb24", "rgb24")
    with pytest.raises(MissingExtra, match=r"encodes none of nonsense; pip install 'sart_toolkit"):
        video.best_codec([nothing])
    with pytest.raises(MissingExtra, match=r"needs nonsense.*pip install 'sart_toolkit\[formats\]"):
        video.required("nonsense")
    assert [codec.available for codec in (*RGB_CODECS, *DEPTH_CODECS)] == [True] * 3


def test_odd_images_and_nan_are_refused(trajectories, peg_dataset, tmp_path):
    about = about_dataset(peg_dataset)
    odd, broken = tmp_path / "odd", tmp_path / "broken"
    with pytest.raises(InvalidInput, match="need an even width and height, got 47x48"):
        write(odd, cut(trajectories[0]), about)
    actions = trajectories[0].actions.copy()
    actions[3, 2] = np.nan
    with pytest.raises(InvalidInput, match="demo00: action has NaN or infinite values"):
        write(broken, Trajectory(**{**trajectories[0].__dict__, "actions": actions}), about)


def write(path: Path, trajectory: Trajectory, about: About) -> None:
    path.mkdir()
    LeRobot().write(path, [trajectory], about)


def cut(trajectory: Trajectory) -> Trajectory:
    """With images that lack their last column."""
    steps = trajectory.steps
    camera = steps.cameras["wrist"]
    narrow = type(camera)(
        camera.rgb[:, :, :-1], camera.depth[:, :, :-1], camera.intrinsics, camera.frame,
        camera.T_frame_camera,
    )  # fmt: skip
    narrower = type(steps)(**{**steps.__dict__, "cameras": {"wrist": narrow}})
    return Trajectory(**{**trajectory.__dict__, "steps": narrower})


# --- statistics ---------------------------------------------------------------------------------


def test_statistics_of_rows_are_those_of_all_rows_at_once():
    rng = np.random.default_rng(0)
    rows = rng.normal([0.0, 1e6], [1.0, 0.01], size=(5000, 2))
    found = RowStatistics()
    for part in np.array_split(rows, 13):
        found.add(part)
    result = found.result()
    np.testing.assert_allclose(result["mean"], rows.mean(0), rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(result["std"], rows.std(0), rtol=1e-9)
    for name, q in QUANTILES.items():
        np.testing.assert_allclose(result[name], np.quantile(rows, q, axis=0), rtol=1e-12)
    assert result["count"] == [5000] and result["min"].tolist() == rows.min(0).tolist()


def test_quantiles_of_many_rows_are_near_and_memory_is_bounded():
    rng = np.random.default_rng(1)
    found = RowStatistics()
    parts = [rng.normal(size=(9001, 1)) for _ in range(40)]
    for part in parts:
        found.add(part)
    assert sum(map(len, found._rows)) <= 2**16
    rows = np.concatenate(parts)
    for name, q in QUANTILES.items():
        assert abs(found.result()[name][0] - np.quantile(rows, q)) < 0.05


def test_statistics_of_images_are_exact():
    rng = np.random.default_rng(2)
    images = rng.integers(0, 256, size=(7, 5, 4, 3)).astype(np.uint8)
    found = LevelStatistics(np.arange(256) / 255, 3)
    found.add(images[:3])
    other = LevelStatistics(np.arange(256) / 255, 3)
    other.add(images[3:])
    found.merge(other)
    result = found.result()
    pixels = images.reshape(-1, 3) / 255
    for name, expected in (("mean", pixels.mean(0)), ("std", pixels.std(0)), ("min", pixels.min(0)),
                           ("max", pixels.max(0))):  # fmt: skip
        np.testing.assert_allclose(result[name].ravel(), expected, rtol=1e-12)
    for name, q in QUANTILES.items():
        expected = np.quantile(pixels, q, axis=0, method="inverted_cdf")
        np.testing.assert_allclose(result[name].ravel(), expected)
    assert result["q50"].shape == (3, 1, 1) and result["count"] == [7]


# --- what is found ------------------------------------------------------------------------------


def edit_json(root: Path, name: str, change: Callable[[Any], Any]) -> None:
    value = json.loads((root / name).read_text())
    change(value)
    (root / name).write_text(json.dumps(value))


def edit_column(root: Path, name: str, column: str, change: Callable[[list[Any]], Any]) -> None:
    """Change the values of a column of a table."""
    table = pq.read_table(root / name)
    values = table[column].to_pylist()
    change(values)
    kind = table.schema.field(column).type
    changed = table.set_column(table.column_names.index(column), column, pa.array(values, kind))
    pq.write_table(changed, root / name)


def setting(index: int, value: Any) -> Callable[[Any], None]:
    def change(values: Any) -> None:
        values[index] = value

    return change


def add_column(root: Path) -> None:
    table = pq.read_table(root / DATA)
    pq.write_table(table.append_column("sphere", pa.array([0] * table.num_rows)), root / DATA)


def drop_column(root: Path) -> None:
    pq.write_table(pq.read_table(root / DATA).drop_columns(["action"]), root / DATA)


def shorten_video(root: Path) -> None:
    """The same video without its last two frames."""
    frames = list(video.read_video(root / VIDEO, "rgb24"))[:-2]
    writer = video.VideoWriter(root / VIDEO, RGB_CODECS[0], 48, 48, 10)
    for frame in frames:
        writer.add(frame)
    writer.close()


def drop_rows(root: Path) -> None:
    table = pq.read_table(root / DATA)
    pq.write_table(table.slice(0, table.num_rows - 1), root / DATA)


def without_index(root: Path) -> None:
    pq.write_table(pq.read_table(root / TASKS).replace_schema_metadata({}), root / TASKS)


MUTATIONS: dict[str, tuple[Callable[[Path], object], str]] = {
    "a timestamp off the grid": (
        lambda root: edit_column(root, DATA, "timestamp", setting(3, 0.31)),
        "episode 0, frame 3: timestamp is 0.31 s, expected 0.3 s",
    ),
    "a column that isn't declared": (
        add_column,
        f"{DATA}: column sphere is not declared in {INFO}",
    ),
    "a column that is missing": (
        drop_column,
        f"{DATA}: column action is missing, {INFO} declares it",
    ),
    "a wrong number of frames": (
        lambda root: edit_json(root, INFO, lambda info: info.update(total_frames=7)),
        f"{INFO}: total_frames is 7, meta/episodes has ",
    ),
    "a wrong number of episodes": (
        lambda root: edit_json(
            root, INFO, lambda info: info.update(total_episodes=6, splits={"train": "0:5"})
        ),
        f"{INFO}: total_episodes is 6, meta/episodes has 5",
    ),
    "a missing video": (
        lambda root: (root / VIDEO).unlink(),
        f"{VIDEO}: no such file, episode 0 is in it",
    ),
    "a video that is too short": (shorten_video, f"{VIDEO}: has "),
    "a video that is none": (
        lambda root: (root / VIDEO).write_bytes(b"nothing"),
        f"{VIDEO}: can't be read as a video",
    ),
    "statistics that are missing": (
        lambda root: edit_json(root, STATS, lambda stats: stats.pop("action")),
        f"{STATS}: action is missing",
    ),
    "a quantile that is missing": (
        lambda root: edit_json(root, STATS, lambda stats: stats["action"].pop("q99")),
        f"{STATS}: action: q99 is missing",
    ),
    "statistics of the wrong shape": (
        lambda root: edit_json(root, STATS, lambda stats: stats[RGB].update(mean=[0.1, 0.2, 0.3])),
        f"{STATS}: {RGB}: mean has shape [3], expected [3, 1, 1]",
    ),
    "statistics of other data": (
        lambda root: edit_json(root, STATS, lambda stats: stats["action"].update(max=[1e-9] * 7)),
        f"{STATS}: action: values reach from ",
    ),
    "a task that there isn't": (
        lambda root: edit_column(root, DATA, "task_index", setting(5, 3)),
        f"episode 0, frame 5: task_index is 3, {TASKS} has 1",
    ),
    "tasks without their index": (without_index, f"{TASKS}: has no pandas index of task strings"),
    "an index that skips": (
        lambda root: edit_column(root, DATA, "index", setting(4, 99)),
        "episode 0, frame 4: index is 99, expected 4",
    ),
    "a frame index that skips": (
        lambda root: edit_column(root, DATA, "frame_index", setting(4, 5)),
        "episode 0, frame 4: frame_index is 5, expected 4",
    ),
    "another version": (
        lambda root: edit_json(root, INFO, lambda info: info.update(codebase_version="v2.1")),
        f"{INFO}: codebase_version is 'v2.1', expected 'v3.0'",
    ),
    "an action that is no number": (
        lambda root: edit_column(root, DATA, "action", setting(2, [float("nan")] * 7)),
        f"{DATA}: action has NaN or infinite values",
    ),
    "another size of an array": (
        lambda root: edit_json(
            root, INFO, lambda info: info["features"]["action"].update(shape=[6], names=None)
        ),
        f"{DATA}: column action has 7 values, {INFO} declares 6",
    ),
    "another type of a column": (
        lambda root: edit_json(
            root, INFO, lambda info: info["features"]["action"].update(dtype="float64")
        ),
        f"{DATA}: column action is ",
    ),
    "another size of images": (
        lambda root: edit_json(
            root, INFO, lambda info: info["features"][RGB].update(shape=[64, 48, 3])
        ),
        f"{VIDEO}: images are [48, 48], {INFO} declares [64, 48]",
    ),
    "another rate": (
        lambda root: edit_json(root, INFO, lambda info: info.update(fps=0)),
        f"{INFO}: fps: expected a number > 0, got 0",
    ),
    "episodes that overlap": (
        lambda root: edit_column(root, EPISODES, "dataset_from_index", setting(2, 1)),
        "meta/episodes: episode 2 has frames 1 to ",
    ),
    "an episode at another time in the video": (
        lambda root: edit_column(root, EPISODES, f"videos/{RGB}/from_timestamp", setting(1, 0.0)),
        f"meta/episodes: episode 1: {RGB} lasts ",
    ),
    "rows that are missing": (drop_rows, f"{DATA}: has "),
    "a table that is none": (
        lambda root: (root / EPISODES).write_bytes(b"nothing"),
        f"{EPISODES}: can't be read as parquet",
    ),
    "a description that makes no sense": (
        lambda root: edit_json(root, INFO, lambda info: info.update(data_path=3)),
        "can't be made sense of (AttributeError: ",
    ),
    "no description": (lambda root: (root / INFO).unlink(), f"{INFO}: no such file"),
    "a split of more episodes": (
        lambda root: edit_json(root, INFO, lambda info: info.update(splits={"train": "0:9"})),
        f"{INFO}: split train is '0:9', there are 5 episodes",
    ),
}


@pytest.mark.parametrize("name", MUTATIONS)
def test_what_a_reader_fails_on_is_found(name, copy):
    mutate, complaint = MUTATIONS[name]
    mutate(copy)
    found = LeRobot().problems(copy)
    assert found and complaint in found[0], found
