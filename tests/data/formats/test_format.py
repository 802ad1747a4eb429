"""What holds for exports of any format."""

from __future__ import annotations

import subprocess
import sys
import textwrap
import tracemalloc
from collections.abc import Iterable
from pathlib import Path

import numpy as np
import pytest

from sart_toolkit.data.dataset import Dataset
from sart_toolkit.data.formats import FORMATS, get_format
from sart_toolkit.data.formats.format import (
    About,
    Format,
    Trajectory,
    about_dataset,
    commands_along,
    counted,
    even_rates,
    pose_rows,
    quaternions,
    reader_of,
    trajectories_of,
)
from sart_toolkit.data.formats.transfer import export_dataset
from sart_toolkit.data.records import apply_action
from sart_toolkit.data.storage import save_demonstration
from sart_toolkit.errors import BrokenFile, InvalidInput, OutputExists, UnknownName
from sart_toolkit.poses import apply_motion, exp_rotation


def written(dataset: Dataset, name: str, out: Path, **options: bool) -> None:
    export_dataset(dataset, get_format(name), out, about_dataset(dataset), **options)


def out_of(name: str, folder: Path) -> Path:
    return folder / f"peg{get_format(name).suffix}"


def test_trajectories_are_whole_and_their_actions_lead_along_the_commands(
    peg_dataset, trajectories
):
    assert [t.provenance["kind"] for t in trajectories] == ["demonstration"] + 4 * ["generated"]
    demonstration = peg_dataset.sources[0].demonstration
    for trajectory, episode in zip(trajectories[1:], peg_dataset, strict=True):
        suffix = len(demonstration) - episode.provenance.t_star
        assert len(trajectory) == len(episode) + suffix
        assert trajectory.provenance["segment_steps"] == len(episode)
        assert trajectory.success[-1] and not trajectory.success[: len(episode)].any()
        steps = trajectory.steps
        for t, T in enumerate(steps.commanded_Ts_world_tool[:-1]):
            found, gripper = apply_action(T, trajectory.actions[t])
            np.testing.assert_allclose(found, steps.commanded_Ts_world_tool[t + 1], atol=1e-9)
            assert gripper == steps.commanded_gripper[t + 1]
        camera = steps.cameras["wrist"]
        wanted = demonstration.steps.cameras["wrist"].rgb[episode.provenance.t_star :]
        assert np.array_equal(camera.rgb[len(episode) :], wanted)


def test_a_dataset_is_read_a_trajectory_at_a_time(peg_dataset):
    """However many there are; its sources aren't kept either."""
    dataset = Dataset.__new__(Dataset)
    dataset.__dict__.update(peg_dataset.__dict__)
    dataset.index = peg_dataset.index * 8
    dataset.sources = tuple(
        type(source)(*(getattr(source, a) for a in (
            "path", "demonstration_hash", "annotation_hash", "number", "request")))
        for source in peg_dataset.sources
    )  # fmt: skip
    peaks = []
    for most in (4, 32):
        tracemalloc.start()
        for _ in zip(range(most), trajectories_of(dataset), strict=False):
            pass
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    assert peaks[1] < 1.2 * peaks[0]
    assert "demonstration" not in dataset.sources[0].__dict__


@pytest.mark.parametrize("name", FORMATS)
def test_an_export_has_no_problems_and_is_not_replaced(name, exported, peg_dataset, tmp_path):
    assert get_format(name).problems(exported(name)) == []
    out = out_of(name, tmp_path)
    written(peg_dataset, name, out)
    with pytest.raises(OutputExists, match="already exists; add --overwrite or choose another"):
        written(peg_dataset, name, out)
    written(peg_dataset, name, out, overwrite=True)
    assert get_format(name).problems(out) == []


@pytest.mark.parametrize("name", [name for name in FORMATS if get_format(name).mark])
def test_what_holds_other_things_is_not_overwritten(name, peg_dataset, tmp_path):
    out = out_of(name, tmp_path)
    out.mkdir()
    (out / "thesis.tex").write_text("mine")
    with pytest.raises(OutputExists, match="holds other things"):
        written(peg_dataset, name, out, overwrite=True)
    assert (out / "thesis.tex").read_text() == "mine"


class _Failing(Format):
    """Writes a trajectory, then fails."""

    name, mark = "failing", "mark"

    def write(self, path: Path, trajectories: Iterable[Trajectory], about: About) -> None:
        for trajectory in trajectories:
            (path / "mark").write_text(trajectory.name)
            raise KeyboardInterrupt

    def problems(self, path: Path) -> list[str]:
        return []


def test_an_interrupted_export_leaves_nothing(peg_dataset, tmp_path):
    with pytest.raises(KeyboardInterrupt):
        export_dataset(peg_dataset, _Failing(), tmp_path / "out", about_dataset(peg_dataset))
    assert list(tmp_path.iterdir()) == []


def test_what_a_killed_export_left_is_removed_by_the_next(peg_dataset, tmp_path):
    (tmp_path / ".peg.abcd1234" / "data").mkdir(parents=True)
    (tmp_path / ".peg_other.abcd1234").mkdir()
    written(peg_dataset, "lerobot", tmp_path / "peg")
    assert sorted(path.name for path in tmp_path.iterdir()) == [".peg_other.abcd1234", "peg"]
    (tmp_path / ".peg.abcd1234.hdf5").write_text("half")
    (tmp_path / ".peg.mine.hdf5").write_text("mine")
    written(peg_dataset, "robomimic", tmp_path / "peg.hdf5")
    assert sorted(path.name for path in tmp_path.iterdir()) == [
        ".peg.mine.hdf5", ".peg_other.abcd1234", "peg", "peg.hdf5",
    ]  # fmt: skip


@pytest.mark.parametrize("name", FORMATS)
def test_on_a_full_disk_it_says_so_and_leaves_nothing(name, peg_dataset, tmp_path):
    """Here a file can't grow beyond 20 kB, in a process of its own as HDF5 might end it."""
    code = f"""
        import resource
        from pathlib import Path
        from sart_toolkit.data.dataset import load_dataset
        from sart_toolkit.data.formats import get_format
        from sart_toolkit.data.formats.format import about_dataset
        from sart_toolkit.data.formats.transfer import export_dataset
        from sart_toolkit.errors import CannotWrite
        dataset = load_dataset(Path({str(peg_dataset.path)!r}))
        about = about_dataset(dataset)
        resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, 20_000))
        try:
            export_dataset(
                dataset, get_format({name!r}), Path({str(out_of(name, tmp_path))!r}), about
            )
        except CannotWrite as error:
            print(error)
    """
    done = subprocess.run(
        [sys.executable, "-c", textwrap.dedent(code)], capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    assert "File too large" in done.stdout and "make room" in done.stdout
    assert list(tmp_path.iterdir()) == []


def test_progress_counts_what_is_written(peg_dataset, tmp_path):
    seen: list[tuple[int, int]] = []
    about = about_dataset(peg_dataset)
    export_dataset(
        peg_dataset, get_format("zarr"), tmp_path / "a.zarr", about,
        progress=lambda *counts: seen.append(counts),
    )  # fmt: skip
    assert seen == [(i + 1, 5) for i in range(5)]


def test_another_suffix_is_refused(peg_dataset, tmp_path):
    with pytest.raises(InvalidInput, match=r"a path of format robomimic ends in \.hdf5"):
        written(peg_dataset, "robomimic", tmp_path / "peg")


def test_trajectories_with_other_cameras_are_refused(trajectories, peg_dataset):
    other = trajectories[1].steps
    without = type(other)(**{**other.__dict__, "cameras": {}})
    mixed = [trajectories[0], Trajectory(**{**trajectories[1].__dict__, "steps": without})]
    with pytest.raises(InvalidInput, match="cameras or joints are .*; export them apart"):
        list(counted(mixed, about_dataset(peg_dataset), None))


def test_joint_names_must_fit(peg_dataset):
    assert about_dataset(peg_dataset).joint_names[0] == "joint_1"
    with pytest.raises(InvalidInput, match="joint_names: expected 6, got 1"):
        about_dataset(peg_dataset, joint_names=["a"])


def test_a_format_of_one_s_own_is_named_by_reference(peg_dataset, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "names.py").write_text(
        textwrap.dedent("""
            from sart_toolkit.data.formats.format import Format

            class Names(Format):
                name, suffix = "names", ".txt"

                def write(self, path, trajectories, about):
                    path.write_text("".join(t.name + chr(10) for t in trajectories))

                def problems(self, path):
                    return []

            class Picky(Names):
                def __init__(self, option):
                    pass
        """)
    )
    written(peg_dataset, "names.py:Names", tmp_path / "a.txt")
    assert (tmp_path / "a.txt").read_text().splitlines()[0] == "demo00"
    with pytest.raises(UnknownName, match="can't be made without arguments"):
        get_format("names.py:Picky")
    with pytest.raises(UnknownName, match="did you mean 'lerobot'"):
        get_format("lerobo")


def test_what_is_read_is_found_out(exported, tmp_path, peg_demonstration):
    reader, found = reader_of(exported("rmb"), None)
    assert reader.name == "rmb" and len(found) == 5
    with pytest.raises(InvalidInput, match="format zarr: isn't imported; those that are: "):
        reader_of(exported("zarr"), get_format("zarr"))
    with pytest.raises(BrokenFile, match="holds no recording of .*rmb"):
        reader_of(exported("robomimic"), None)
    save_demonstration(tmp_path / "demo.h5", peg_demonstration)
    with pytest.raises(BrokenFile, match="holds no recording"):
        reader_of(tmp_path / "demo.h5", None)


def test_quaternions_don_t_jump():
    turns = np.linspace(0, 4 * np.pi, 60)
    Ts = np.tile(np.eye(4), (60, 1, 1))
    Ts[:, :3, :3] = [exp_rotation(np.array([0, 0, turn])) for turn in turns]
    for real in ("first", "last"):
        found = quaternions(Ts, real=real)
        assert np.abs(np.diff(found, axis=0)).max() < 0.2
        assert abs(found[0, 0 if real == "first" else 3]) == pytest.approx(1)
    # Half a turn about an axis between x and y, as it is and rounded another way.
    half = exp_rotation(np.pi / np.sqrt(2) * np.array([1.0, -1.0, 0.0]))
    for R in (half, half @ exp_rotation(np.array([1e-9, 1e-9, -1e-9]))):
        T = np.eye(4)
        T[:3, :3] = R
        expected = [0, np.sqrt(0.5), -np.sqrt(0.5), 0]
        np.testing.assert_allclose(quaternions(T[None], real="first")[0], expected, atol=1e-8)
    assert pose_rows(Ts).shape == (60, 9)


def test_commands_along_a_recording_lead_from_each_of_its_poses_to_the_next(peg_demonstration):
    steps, rates = peg_demonstration.steps, peg_demonstration.rates
    rows = commands_along(steps.commanded_Ts_world_tool, steps.commanded_gripper, rates)
    assert len(rows) == (len(steps) - 1) * rates.control_per_record
    T = steps.commanded_Ts_world_tool[0]
    for t in range(1, len(steps)):
        for row in rows[(t - 1) * rates.control_per_record : t * rates.control_per_record]:
            T = apply_motion(T, row[:6] / rates.control_hz)
            assert row[6] == steps.commanded_gripper[t]
        np.testing.assert_allclose(T, steps.commanded_Ts_world_tool[t], atol=1e-9)


@pytest.mark.parametrize(
    ("hz", "rates"),
    [(10, (240, 30, 10)), (15, (240, 30, 15)), (20, (240, 40, 20)), (50, (250, 50, 50))],
)
def test_a_recording_is_executed_at_the_default_rates_or_more(hz, rates):
    found = even_rates(np.arange(20) / hz)
    assert (found.physics_hz, found.control_hz, found.record_hz) == rates
