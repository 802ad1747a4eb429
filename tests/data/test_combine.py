"""Datasets merge and split without an episode being made again, lost or counted twice."""

from __future__ import annotations

import dataclasses
import os
from collections import Counter

import pytest

from sart_toolkit.data import combine, writer
from sart_toolkit.data.combine import (
    merge_datasets,
    shorten_dataset,
    split_dataset,
    split_sources,
)
from sart_toolkit.data.dataset import load_dataset
from sart_toolkit.data.manifest import AttemptKey, Rejection
from sart_toolkit.data.records import Rates
from sart_toolkit.data.writer import DatasetWriter, write_dataset
from sart_toolkit.errors import (
    BrokenFile,
    CannotWrite,
    InvalidInput,
    Mismatch,
    OutputExists,
)


@pytest.fixture
def made(source_of, episode_of, tmp_path):
    """Makes a dataset of some demonstrations, `k` episodes of each sphere by sphere."""

    def made(name, seeds=(0,), ks=(8, 4), config=None, edit=lambda d: d, rejected=()):
        sources = [source_of(seed) for seed in seeds]
        sources = [(edit(d), a) for d, a in sources]
        with DatasetWriter(tmp_path / name, sources, {"config": config or {}}) as writer:
            for source, (demonstration, _) in enumerate(sources):
                for sphere, count in enumerate(ks):
                    for k in range(count):
                        episode = episode_of(demonstration, sphere, k, source)
                        writer.keep(writer.files.write(episode))
            for key in rejected:
                writer.reject(AttemptKey(*key), Rejection("joint jump", "at 1"))
            return writer.finish({"task": "nothing", "robot": "none", "config": config or {}})

    return made


def hashes(dataset):
    return Counter(entry.content_hash for entry in dataset.index)


# --- merging ------------------------------------------------------------------------------------


def test_merged_datasets_stand_side_by_side_and_keep_their_bytes(made, tmp_path):
    a = made("a", (0,), config={"seed": 0, "n": 13, "margin": 1}, rejected=[(0, 0, 9)])
    b = made("b", (1, 2), config={"seed": 5, "n": 25, "margin": 1})
    both = merge_datasets([a, b], tmp_path / "both")
    assert len(both) == len(a) + len(b) and hashes(both) == hashes(a) + hashes(b)
    assert [source.demonstration_hash for source in both.sources] == [
        source.demonstration_hash for source in (*a.sources, *b.sources)
    ]
    assert [source.number for source in both.sources] == [0, 0, 1]
    assert [source.request["config"]["seed"] for source in both.sources] == [0, 5, 5]
    assert both.info["config"] == {"margin": 1}
    assert both.info["made_of"] == {"merged": [a.content_hash, b.content_hash]}
    assert both.info["n_trajectories"] == len(both) + 3
    assert both.info["rejections"] == {"joint jump": 1}
    assert [row["kept"] for row in both.info["by_sphere"]] == [8, 4] * 3
    for i, entry in enumerate(both.index):
        p = both.episode(i).provenance
        assert (p.source, p.sphere, p.k) == (both.sources[entry.source].number, *entry.key[1:])
        first = a if entry.source == 0 else b
        name = dataclasses.replace(entry, source=p.source).name
        assert os.path.samefile(both.path / entry.name, first.path / name)


def test_the_same_datasets_give_the_same_content_and_one_alone_its_own(made, tmp_path):
    a, b = made("a"), made("b", (1,))
    first = merge_datasets([a, b], tmp_path / "first")
    second = merge_datasets([load_dataset(a.path), load_dataset(b.path)], tmp_path / "second")
    assert first.content_hash == second.content_hash
    assert merge_datasets([a], tmp_path / "alone").content_hash == a.content_hash
    again = merge_datasets([merge_datasets([a], tmp_path / "x"), b], tmp_path / "y")
    assert again.content_hash == first.content_hash


def test_equal_sources_are_one_and_what_both_hold_is_there_once(made, tmp_path):
    small = made("small", (0, 1), (2, 1), {"seed": 0, "n": 8})
    large = made("large", (1, 0), (8, 4), {"seed": 0, "n": 26})
    # A number decides what is drawn: as another one the same demonstration is another source.
    assert len(merge_datasets([small, large], tmp_path / "other").sources) == 4
    large = made("larger", (0, 1), (8, 4), {"seed": 0, "n": 26})
    both = merge_datasets([small, large], tmp_path / "both")
    assert len(both.sources) == 2 and hashes(both) == hashes(large)
    other = made("seed", (0, 1), (1, 1), {"seed": 1, "n": 5})
    three = merge_datasets([both, other], tmp_path / "three")
    assert len(three.sources) == 4 and three.info["n_trajectories"] == len(three) + 2


def test_different_episodes_of_one_attempt_are_refused(made, source_of, episode_of, tmp_path):
    a, source = made("a"), source_of(0)
    episode = episode_of(source[0])
    other = dataclasses.replace(episode, joint_path=episode.steps.joint_positions)
    with DatasetWriter(tmp_path / "b", [source], {"config": {}}) as writer:
        writer.keep(writer.files.write(other))
        b = writer.finish({})
    with pytest.raises(Mismatch, match="same attempt and differ; generate one .* another --seed"):
        merge_datasets([a, b], tmp_path / "both")
    assert not (tmp_path / "both").exists()


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"task": "other"}, "task is 'other', that of .* is 'nothing'"),
        ({"robot": "other"}, "robot is 'other'"),
        ({"rates": Rates(120)}, "rates is Rates"),
    ],
)
def test_what_can_not_stand_in_one_dataset_is_refused(made, source_of, tmp_path, changes, message):
    a = made("a")
    demonstration = dataclasses.replace(source_of(1)[0], **changes)
    annotation = dataclasses.replace(
        source_of(1)[1], demonstration_hash=demonstration.content_hash()
    )
    b = write_dataset(tmp_path / "b", [(demonstration, annotation)], [], {})
    with pytest.raises(Mismatch, match=message):
        merge_datasets([a, b], tmp_path / "both")
    assert not (tmp_path / "both").exists()


def test_other_cameras_are_refused(peg_dataset, tmp_path):
    source = peg_dataset.sources[0]
    camera = source.demonstration.steps.cameras["wrist"]
    for changed, message in (
        ({}, r"has images of \[\], .* of \['wrist'\]"),
        ({"wrist": dataclasses.replace(camera, rgb=camera.rgb[:, :8], depth=camera.depth[:, :8])},
         "camera 'wrist' has another size"),
        ({"wrist": dataclasses.replace(camera, intrinsics=camera.intrinsics + 1)}, "intrinsics"),
    ):  # fmt: skip
        steps = dataclasses.replace(source.demonstration.steps, cameras=changed)
        other = dataclasses.replace(source.demonstration, steps=steps)
        out = tmp_path / f"{len(list(tmp_path.iterdir()))}"
        dataset = write_dataset(out, [(other, None)], [], {})
        with pytest.raises(Mismatch, match=message):
            merge_datasets([peg_dataset, dataset], tmp_path / "both")


def test_nothing_or_itself_is_refused(made, tmp_path):
    a = made("a")
    with pytest.raises(InvalidInput, match="datasets: expected at least one, got none"):
        merge_datasets([], tmp_path / "both")
    for out in (a.path, a.path / "inside", tmp_path / "." / "a"):
        with pytest.raises(OutputExists, match="is in the dataset that is read; choose another"):
            merge_datasets([made("b", (1,)), a], out, overwrite=True)
    assert load_dataset(a.path).content_hash == a.content_hash


@pytest.mark.parametrize("stop", [0, 1, 5, 11])
def test_an_interrupted_merge_resumes(made, tmp_path, monkeypatch, stop):
    monkeypatch.setattr(combine, "_ROWS_AT_ONCE", 3)
    datasets = [made("a", rejected=[(0, 1, 7)]), made("b", (1,))]
    whole = merge_datasets(datasets, tmp_path / "whole")

    def interrupt(done, total):
        if done == stop + 1:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        merge_datasets(datasets, tmp_path / "both", progress=interrupt)
    with pytest.raises(BrokenFile, match="interrupted while it was made"):
        load_dataset(tmp_path / "both")
    resumed = merge_datasets(datasets, tmp_path / "both")
    assert resumed.content_hash == whole.content_hash and resumed.info == whole.info
    assert merge_datasets(datasets, tmp_path / "both").content_hash == whole.content_hash
    with pytest.raises(OutputExists, match="made with other settings"):
        merge_datasets(datasets[:1], tmp_path / "both")


def test_files_are_copied_where_the_disk_can_not_link_them(made, tmp_path, monkeypatch):
    def refuse(*_):
        raise OSError(18, "Invalid cross-device link")

    monkeypatch.setattr(os, "link", refuse)
    a = made("a")
    copy = merge_datasets([a], tmp_path / "copy")
    assert copy.content_hash == a.content_hash
    name = copy.index[0].name
    assert not os.path.samefile(copy.path / name, a.path / name)
    assert (copy.path / name).read_bytes() == (a.path / name).read_bytes()


def test_a_damaged_episode_is_not_merged(made, tmp_path):
    a = made("a")
    path = a.path / a.index[3].name
    path.write_bytes(path.read_bytes()[:-1])
    with pytest.raises(BrokenFile, match="truncated or not a episode file"):
        merge_datasets([a], tmp_path / "copy")


# --- splitting ----------------------------------------------------------------------------------


def test_parts_have_each_sphere_s_share_and_no_episode_in_common(made, tmp_path):
    dataset = made("a", (0, 1), (20, 10))
    parts = split_dataset(dataset, tmp_path / "parts", {"train": 0.8, "validation": 0.2}, seed=3)
    assert [part.path.name for part in parts.values()] == list(parts) == ["train", "validation"]
    assert sum((hashes(part) for part in parts.values()), Counter()) == hashes(dataset)
    for name, expected in (("train", (16, 8)), ("validation", (4, 2))):
        kept = Counter(entry.key[:2] for entry in parts[name].index)
        assert all(kept[source, sphere] == expected[sphere] for source, sphere in kept)
    again = split_dataset(dataset, tmp_path / "again", {"train": 0.8, "validation": 0.2}, seed=3)
    other = split_dataset(dataset, tmp_path / "other", {"train": 0.8, "validation": 0.2}, seed=4)
    assert again["train"].content_hash == parts["train"].content_hash
    assert other["train"].content_hash != parts["train"].content_hash
    assert parts["train"].info["n_kept"] == 48 and parts["train"].info["n_trajectories"] == 50


def test_merged_again_the_parts_are_the_whole(made, tmp_path):
    dataset = made("a", (0, 1), (20, 10))
    parts = split_dataset(dataset, tmp_path / "parts", {"a": 0.5, "b": 0.25, "c": 0.25})
    whole = merge_datasets(list(parts.values()), tmp_path / "whole")
    assert whole.content_hash == dataset.content_hash


def test_a_shorter_dataset_has_the_first_attempts_of_each_sphere(made, tmp_path):
    dataset = made("a", (0,), (20, 10))
    short = shorten_dataset(dataset, tmp_path / "short", 10)
    assert short.info["n_trajectories"] == 10 and len(short) == 9
    for sphere, expected in ((0, 6), (1, 3)):
        assert [e.k for e in short.index if e.sphere == sphere] == list(range(expected))
    for n in (1, 32):
        with pytest.raises(InvalidInput, match=f"n: expected 2 to 31 .*, got {n}"):
            shorten_dataset(dataset, tmp_path / "other", n)


def test_by_source_each_demonstration_has_its_own(made, tmp_path):
    dataset = made("a", (0, 1), rejected=[(1, 0, 9)])
    parts = split_sources(dataset, tmp_path / "each")
    assert list(parts) == ["demo00", "demo01"]
    assert sum((hashes(part) for part in parts.values()), Counter()) == hashes(dataset)
    for i, part in enumerate(parts.values()):
        assert part.sources[0].demonstration_hash == dataset.sources[i].demonstration_hash
        assert part.sources[0].number == i and len(part.sources) == 1
    assert [part.info["n_attempted"] for part in parts.values()] == [12, 13]


@pytest.mark.parametrize(
    ("parts", "message"),
    [
        ({}, "expected fractions > 0"),
        ({"a": 0.0}, "expected fractions > 0"),
        ({"a": 0.7, "b": 0.4}, "at most 1 in all"),
        ({"a": float("nan")}, "expected fractions > 0"),
        ({"a": 0.9, "b": 0.01}, "part 'b': gets none of 12 episodes"),
        ({"../x": 0.5}, "part '../x': expected the name of a folder"),
        ({"": 0.5}, "part '': expected the name of a folder"),
    ],
)
def test_parts_that_can_not_be_are_refused(made, tmp_path, parts, message):
    with pytest.raises(InvalidInput, match=message):
        split_dataset(made("a"), tmp_path / "parts", parts)
    assert not (tmp_path / "parts").exists()


def test_a_disk_that_fills_up_keeps_what_was_taken_and_resumes(made, tmp_path, monkeypatch):
    dataset, link, left = made("a"), writer.link_file, [5]

    def full(*paths):
        if not left[0]:
            raise CannotWrite("no space left")
        left[0] -= 1
        link(*paths)

    monkeypatch.setattr(writer, "link_file", full)
    with pytest.raises(CannotWrite, match="no space left"):
        shorten_dataset(dataset, tmp_path / "short", 10)
    left[0] = 99
    assert len(shorten_dataset(dataset, tmp_path / "short", 10)) == 9
