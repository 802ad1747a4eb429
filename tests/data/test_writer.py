"""One process at a time writes a dataset; killed at any moment it loses nothing that was kept."""

from __future__ import annotations

import contextlib
import dataclasses
import itertools
import multiprocessing
import os
import pickle
import subprocess
import sys

import pytest

from sart_toolkit.data import writer as writer_module
from sart_toolkit.data.dataset import load_dataset
from sart_toolkit.data.manifest import AttemptKey, Rejection
from sart_toolkit.data.storage import append_json_line, read_json_lines
from sart_toolkit.data.writer import DatasetWriter
from sart_toolkit.errors import BrokenFile, CannotWrite, InvalidInput, Mismatch, OutputExists

N = 5


@pytest.fixture
def carry_out(source_of, episode_of):
    """Makes what is missing of `N` episodes from each of two spheres, every fourth rejected."""

    def carry_out(path, stop_after=None, **options):
        sources = [source_of(0)]
        with DatasetWriter(path, sources, {"n": N}, **options) as writer:
            done = 0
            for sphere in (0, 1):
                while keys := writer.tally.missing(0, sphere, N, 99):
                    for key in keys:
                        if done == stop_after:
                            return None
                        if key.k % 4 == 3:
                            writer.reject(key, Rejection("joint jump", f"at {key.k}"))
                        else:
                            writer.keep(writer.files.write(episode_of(sources[0][0], *key[1:])))
                        done += 1
            return writer.finish({"task": "nothing"})

    return carry_out


def test_a_finished_dataset_says_how_its_attempts_ended(carry_out, tmp_path):
    info = carry_out(tmp_path / "d").info
    assert (info["n_kept"], info["n_trajectories"], info["n_attempted"]) == (2 * N, 2 * N + 1, 12)
    assert info["rejections"] == {"joint jump": 2}
    assert info["by_sphere"] == [
        {"source": 0, "waypoint": t, "kept": N, "rejections": {"joint jump": 1}} for t in (0, 2)
    ]
    assert info["least_commanded_clearance_m"] == 0.001 and info["task"] == "nothing"


def test_what_is_missing_are_the_first_attempts_that_could_do(source_of, episode_of, tmp_path):
    demonstration, annotation = source_of(0)
    with DatasetWriter(tmp_path / "d", [(demonstration, annotation)], {}) as writer:
        writer.keep(writer.files.write(episode_of(demonstration, 1, 0)))
        writer.reject(AttemptKey(0, 1, 2), Rejection("joint jump", "detail"))
        assert writer.tally.missing(0, 1, 3, 9) == [AttemptKey(0, 1, 1), AttemptKey(0, 1, 3)]
        assert writer.tally.missing(0, 1, 9, 4) == [AttemptKey(0, 1, 1), AttemptKey(0, 1, 3)]
        assert writer.tally.missing(0, 1, 1, 9) == writer.tally.missing(0, 1, 0, 9) == []
        assert writer.tally.missing(0, 0, 2, 9) == [AttemptKey(0, 0, 0), AttemptKey(0, 0, 1)]
        assert (writer.n_kept, writer.n_rejected) == (1, 1)
        assert writer.last_rejection == Rejection("joint jump", "detail")


@pytest.mark.parametrize("after", [0, 1, 7, 11, 12])
def test_resumed_after_any_attempt_it_becomes_the_same(carry_out, tmp_path, after):
    whole = carry_out(tmp_path / "whole")
    assert carry_out(tmp_path / "d", after) is None or after == 12
    resumed = carry_out(tmp_path / "d")
    assert resumed.content_hash == whole.content_hash
    assert resumed.info == whole.info
    names = [sorted(p.relative_to(d.path) for p in d.path.rglob("*")) for d in (whole, resumed)]
    assert names[0] == names[1]


@pytest.fixture
def small_disk(tmp_path):
    """A directory on a disk of 1 MiB."""
    disk = tmp_path / "disk"
    disk.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", "size=1m", "tmpfs", str(disk)]
    if os.geteuid() or subprocess.run(mount, stderr=subprocess.DEVNULL).returncode:
        pytest.skip("only root can make a small disk, and not in every container")
    yield disk
    subprocess.run(["umount", str(disk)], check=True)


@pytest.mark.parametrize("pages", [0, 1, 3, 12, 20, 31])
def test_on_a_full_disk_it_says_so_and_resumes_once_there_is_room(
    carry_out, small_disk, tmp_path, pages
):
    whole = carry_out(tmp_path / "whole")
    filler = small_disk / "filler"
    page = os.statvfs(small_disk).f_frsize
    with contextlib.suppress(OSError), open(filler, "wb", buffering=0) as file:
        while True:
            file.write(bytes(page))
    os.truncate(filler, filler.stat().st_size - pages * page)
    for _ in range(2):
        with pytest.raises(CannotWrite, match="No space left on device; nothing was replaced, ma"):
            carry_out(small_disk / "d")
    assert len(list((small_disk / "d").rglob("*.h5"))) <= pages
    filler.unlink()
    resumed = carry_out(small_disk / "d")
    assert resumed.content_hash == whole.content_hash and resumed.info == whole.info


def test_a_finished_dataset_is_there_at_once(carry_out, source_of, tmp_path):
    whole = carry_out(tmp_path / "d")
    with DatasetWriter(tmp_path / "d", [source_of(0)], {"n": N}) as writer:
        assert writer.finished is not None
        assert writer.finished.content_hash == whole.content_hash


@pytest.mark.parametrize("finished", [True, False])
@pytest.mark.parametrize(
    "damage",
    [
        pytest.param(lambda path: path.unlink(), id="deleted"),
        pytest.param(lambda path: path.write_bytes(path.read_bytes()[:3000]), id="truncated"),
        pytest.param(lambda path: path.write_bytes(b""), id="empty"),
        pytest.param(
            lambda path: path.write_bytes(path.with_name("sphere00_k00001.h5").read_bytes()),
            id="exchanged",
        ),
    ],
)
def test_an_episode_file_that_is_damaged_or_missing_is_made_again(
    carry_out, tmp_path, damage, finished
):
    whole = carry_out(tmp_path / "whole")
    carry_out(tmp_path / "d", None if finished else 5)
    damage(tmp_path / "d/episodes/demo00/sphere00_k00002.h5")
    again = carry_out(tmp_path / "d")
    assert again.content_hash == whole.content_hash
    assert [e.content_hash() for e in again] == [e.content_hash for e in whole.index]


def test_a_damaged_summary_is_written_again(carry_out, tmp_path):
    whole = carry_out(tmp_path / "d")
    (tmp_path / "d" / "dataset.json").write_text("{")
    assert carry_out(tmp_path / "d").content_hash == whole.content_hash


def test_damaged_sources_of_an_unfinished_dataset_are_written_again(carry_out, tmp_path):
    carry_out(tmp_path / "d", 3)
    (tmp_path / "d/sources/demo00/demo.h5").write_bytes(b"torn")
    (tmp_path / "d/sources/demo00/annotation.json").unlink()
    dataset = carry_out(tmp_path / "d")
    assert len(dataset.sources[0].annotation.spheres) == 2
    assert len(dataset.sources[0].demonstration) == 6


def test_a_row_that_was_cut_short_does_not_count(carry_out, tmp_path):
    whole = carry_out(tmp_path / "whole")
    carry_out(tmp_path / "d", 5)
    manifest = tmp_path / "d" / "manifest.jsonl"
    manifest.write_text(manifest.read_text()[:-20])
    assert carry_out(tmp_path / "d").content_hash == whole.content_hash
    assert len(read_json_lines(manifest)) == 1 + whole.info["n_attempted"]


@pytest.mark.parametrize("change", [{"steps": 9}, {"clearance_m": 0.5}, {"content_hash": "0"}])
def test_a_row_that_says_otherwise_than_its_episode_does_not_count(carry_out, tmp_path, change):
    whole = carry_out(tmp_path / "whole")
    carry_out(tmp_path / "d", 5)
    manifest = tmp_path / "d" / "manifest.jsonl"
    rows = read_json_lines(manifest)
    manifest.unlink()
    for k, row in enumerate(rows):
        append_json_line(manifest, {**row, **change} if k == 2 else row)
    again = carry_out(tmp_path / "d")
    assert again.content_hash == whole.content_hash and again.index == whole.index


def test_files_that_a_killed_process_was_writing_are_removed(carry_out, tmp_path):
    carry_out(tmp_path / "d", 3)
    left = [
        tmp_path / "d/.dataset.x1y_z2w3.json",
        tmp_path / "d/episodes/demo00/.sphere00_k00009.x1y_z2w3.h5",
    ]
    for path in left:
        path.write_text("half")
    carry_out(tmp_path / "d")
    assert not any(path.exists() for path in left)


_OTHER = """
import sys
from pathlib import Path
from sart_toolkit.data.storage import OutputLock
OutputLock(Path(sys.argv[1]))
"""


def test_killed_at_any_moment_it_becomes_the_same(carry_out, tmp_path):
    """The process is killed again and again, a little later each time, until it gets through."""
    whole = carry_out(tmp_path / "whole")
    for turn in itertools.count():
        process = multiprocessing.get_context("fork").Process(
            target=carry_out, args=(tmp_path / "d",)
        )
        process.start()
        process.join(0.01 * 1.3**turn)
        process.kill()
        process.join()
        if process.exitcode == 0:
            break
    assert turn > 3
    dataset = load_dataset(tmp_path / "d")
    assert dataset.content_hash == whole.content_hash
    assert [e.content_hash() for e in dataset] == [e.content_hash for e in whole.index]


def test_a_second_process_is_refused_while_the_first_is_at_work(carry_out, source_of, tmp_path):
    path = tmp_path / "d"
    with DatasetWriter(path, [source_of(0)], {"n": N}):
        found = subprocess.run(
            [sys.executable, "-c", _OTHER, str(path)], capture_output=True, text=True
        )
        assert "CannotWrite" in found.stderr and "another process is using it" in found.stderr
        for overwrite in (True, False):
            with pytest.raises(CannotWrite, match="another process is using it; end that one"):
                carry_out(path, overwrite=overwrite)
    assert carry_out(path) is not None


def test_other_settings_are_refused_and_named(carry_out, source_of, tmp_path):
    path = tmp_path / "d"
    carry_out(path, 3)
    demonstration, annotation = source_of(0)
    wider = (dataclasses.replace(annotation.spheres[0], radius=0.2), *annotation.spheres[1:])
    other = dataclasses.replace(annotation, spheres=wider)
    before = {p: p.stat().st_mtime_ns for p in (path, *path.rglob("*"))}
    for sources, request, named in (
        ([source_of(0)], {"n": 4}, rf"\(request.n {N}, now 4\)"),
        ([source_of(0)], {"n": N, "camera": "wrist"}, r'\(request.camera null, now "wrist"\)'),
        ([(demonstration, other)], {"n": N}, r'\(sources.0.annotation "\w+..., now "\w+...\)'),
        ([source_of(0), source_of(1)], {"n": N}, r"\(1 sources, now 2\)"),
    ):
        with pytest.raises(OutputExists, match=f"made with other settings {named}; add --overw"):
            DatasetWriter(path, sources, request)
    assert {p: p.stat().st_mtime_ns for p in (path, *path.rglob("*"))} == before


def test_overwriting_begins_again_and_leaves_nothing_of_the_old(carry_out, source_of, tmp_path):
    path = tmp_path / "d"
    carry_out(path)
    with DatasetWriter(path, [source_of(3)], {"n": 2}, overwrite=True) as writer:
        assert writer.finished is None and writer.n_kept == writer.n_rejected == 0
        inside = sorted(str(p.relative_to(path)) for p in path.rglob("*.*"))
    assert inside == [
        "manifest.jsonl",
        "sources/demo00/annotation.json",
        "sources/demo00/demo.h5",
    ]


def test_a_directory_or_file_of_someone_else_is_left_alone(carry_out, tmp_path):
    (tmp_path / "notes.txt").write_text("mine")
    with pytest.raises(OutputExists, match="already exists; add --overwrite"):
        carry_out(tmp_path)
    with pytest.raises(OutputExists, match=r"holds other things \(no manifest.jsonl\)"):
        carry_out(tmp_path, overwrite=True)
    with pytest.raises(OutputExists, match="is a file, so it won't be replaced"):
        carry_out(tmp_path / "notes.txt", overwrite=True)
    assert [path.name for path in tmp_path.iterdir()] == ["notes.txt"]


def test_a_manifest_that_can_not_be_read_is_reported_and_may_be_overwritten(carry_out, tmp_path):
    (tmp_path / "manifest.jsonl").write_text('{"schema_version": 1}\n')
    with pytest.raises(BrokenFile, match="schema_version is 1"):
        carry_out(tmp_path)
    assert len(carry_out(tmp_path, overwrite=True)) == 2 * N


def test_an_interruption_before_the_first_row_can_be_resumed(carry_out, tmp_path):
    (tmp_path / "manifest.jsonl").write_text('{"schema_ver')
    assert len(carry_out(tmp_path)) == 2 * N


def test_sources_are_checked(source_of, tmp_path):
    with pytest.raises(InvalidInput, match="sources: expected at least one demonstration"):
        DatasetWriter(tmp_path / "d", [], {})
    with pytest.raises(Mismatch, match="annotation was made for another demonstration"):
        DatasetWriter(tmp_path / "d", [(source_of(0)[0], source_of(1)[1])], {})
    demonstration, annotation = source_of(0)
    for what in ("task", "robot"):
        other = dataclasses.replace(demonstration, **{what: "another"})
        spheres = dataclasses.replace(annotation, demonstration_hash=other.content_hash())
        with pytest.raises(Mismatch, match=rf"of different {what}s \(another, no\w+\); make a"):
            DatasetWriter(tmp_path / "d", [(demonstration, annotation), (other, spheres)], {})
    assert not (tmp_path / "d").exists()


def test_what_writes_episodes_goes_to_other_processes(source_of, episode_of, tmp_path):
    demonstration, annotation = source_of(0)
    with DatasetWriter(tmp_path / "d", [(demonstration, annotation)], {}) as writer:
        files = pickle.loads(pickle.dumps(writer.files))  # noqa: S301 - written here
        entry = files.write(episode_of(demonstration))
        assert files.hold(entry) and writer.files.hold(entry)
        assert not files.hold(dataclasses.replace(entry, k=1))
        writer.keep(entry)
        assert len(writer.finish({})) == 1


def test_a_full_disk_is_reported_and_resumed_from(carry_out, tmp_path, monkeypatch):
    whole = carry_out(tmp_path / "whole")
    save, left = writer_module.save_episode, [5]

    def full(path, episode):
        left[0] -= 1
        if left[0] < 0:
            raise CannotWrite(f"{path}: No space left on device")
        return save(path, episode)

    with monkeypatch.context() as patched, pytest.raises(CannotWrite, match="No space left"):
        patched.setattr(writer_module, "save_episode", full)
        carry_out(tmp_path / "d")
    assert carry_out(tmp_path / "d").content_hash == whole.content_hash
