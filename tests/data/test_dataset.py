"""A dataset directory: an index, and parts that are read when asked for and refused when wrong."""

from __future__ import annotations

import dataclasses
import json
import shutil

import pytest

from sart_toolkit.data import dataset as dataset_module
from sart_toolkit.data.dataset import load_dataset
from sart_toolkit.data.records import Annotation
from sart_toolkit.data.storage import (
    append_json_line,
    load_annotation,
    read_json,
    read_json_lines,
    save_annotation,
    save_demonstration,
    save_episode,
    write_json,
)
from sart_toolkit.data.writer import write_dataset
from sart_toolkit.errors import BrokenFile, Mismatch, MissingFile


@pytest.fixture
def made(source_of, episode_of, tmp_path):
    """Two demonstrations, each with episodes from both of its spheres."""
    sources = [source_of(0), source_of(1)]
    episodes = [
        episode_of(sources[source][0], sphere, k, source)
        for source in (0, 1)
        for sphere in (0, 1)
        for k in (0, 1)
    ]
    write_dataset(tmp_path / "d", sources, episodes, {"task": "nothing"})
    return tmp_path / "d", sources, episodes


def test_what_is_written_is_read_back(made):
    path, sources, episodes = made
    dataset = load_dataset(path)
    assert len(dataset) == 8 and dataset.info["n_trajectories"] == 10
    by_key = {(e.provenance.source, e.provenance.sphere, e.provenance.k): e for e in episodes}
    for entry, episode in zip(dataset.index, dataset, strict=True):
        assert episode.content_hash() == entry.content_hash == by_key[entry.key].content_hash()
        assert entry.steps == len(episode) == 4
    assert [entry.k for entry in dataset.index] == [0] * 4 + [1] * 4
    for source, (demonstration, annotation), name in zip(
        dataset.sources, sources, ("demo00", "demo01"), strict=True
    ):
        assert source.name == name
        assert source.demonstration.content_hash() == demonstration.content_hash()
        assert source.annotation.content_hash() == annotation.content_hash()
    assert repr(dataset) == f"Dataset({str(path)!r}: 2 demonstration(s), 8 generated episodes)"
    assert repr(dataset.sources[0]) == f"Source({str(path / 'sources' / 'demo00')!r})"


def test_opening_reads_neither_demonstrations_nor_episodes(made, monkeypatch):
    path, *_ = made
    for name in ("load_demonstration", "load_annotation", "load_episode"):
        monkeypatch.setattr(dataset_module, name, None)
    dataset = load_dataset(path)
    assert len(dataset) == len(dataset.index) == 8


def test_a_source_is_read_once(made, monkeypatch):
    source = load_dataset(made[0]).sources[1]
    first = source.demonstration, source.annotation
    shutil.rmtree(source.path)
    assert (source.demonstration, source.annotation) == first


def test_episodes_are_read_one_at_a_time_and_not_kept(made, monkeypatch):
    read = []
    load = dataset_module.load_episode
    monkeypatch.setattr(
        dataset_module, "load_episode", lambda *args: (read.append(args[0].name), load(*args))[1]
    )
    dataset = load_dataset(made[0])
    for done, _ in enumerate(dataset, 1):
        assert len(read) == done
    assert dataset.episode(0) is not dataset.episode(0)


def test_a_missing_dataset_is_reported(tmp_path):
    with pytest.raises(MissingFile, match="no such dataset directory; make it with `sart augment`"):
        load_dataset(tmp_path / "nowhere")
    with pytest.raises(MissingFile, match="dataset.json: no such file"):
        load_dataset(tmp_path)


def test_a_dataset_whose_generation_was_interrupted_is_reported(made):
    (made[0] / "dataset.json").unlink()
    with pytest.raises(
        BrokenFile, match="interrupted while it was made; run the same command again to resume"
    ):
        load_dataset(made[0])


def test_a_dataset_without_its_manifest_is_reported(made):
    (made[0] / "manifest.jsonl").unlink()
    with pytest.raises(MissingFile, match=r"manifest.jsonl: no such file; restore a copy"):
        load_dataset(made[0])


@pytest.mark.parametrize(
    "change",
    [
        lambda text: text[: text.rindex("{")],
        lambda text: text.replace('"content_hash": "', '"content_hash": "0'),
        lambda text: text.replace('"annotation": "', '"annotation": "0', 1),
    ],
)
def test_a_manifest_that_was_changed_is_reported_by_a_hash(made, change):
    manifest = made[0] / "manifest.jsonl"
    manifest.write_text(change(manifest.read_text()))
    with pytest.raises(BrokenFile, match="differs from its hash; "):
        load_dataset(made[0])


@pytest.mark.parametrize(
    ("i", "change"),
    [
        (0, {"request": {"n": 100}}),
        (2, {"steps": 5}),
        (2, {"clearance_m": 0.5}),
        (2, {"outcome": "joint jump"}),
    ],
)
def test_a_manifest_row_that_was_written_otherwise_is_reported(made, i, change):
    """Its line's hash fits, and what the dataset says of all lines doesn't."""
    manifest = made[0] / "manifest.jsonl"
    rows = read_json_lines(manifest)
    manifest.unlink()
    for k, row in enumerate(rows):
        append_json_line(manifest, {**row, **change} if k == i else row)
    with pytest.raises(BrokenFile, match="content differs from its hash; generate it again"):
        load_dataset(made[0])


@pytest.mark.parametrize("name", ["n_kept", "seconds", "task"])
def test_a_changed_summary_is_reported_by_its_hash(made, name):
    info = json.loads((made[0] / "dataset.json").read_text())
    (made[0] / "dataset.json").write_text(json.dumps({**info, name: 3}))
    with pytest.raises(BrokenFile, match="dataset.json: content differs from its hash"):
        load_dataset(made[0])


def test_a_dataset_s_hash_is_that_of_its_manifest(made):
    info = read_json(made[0] / "dataset.json", dict)
    write_json(made[0] / "dataset.json", {**info, "content_hash": "x"})
    with pytest.raises(BrokenFile, match="content differs from its hash"):
        load_dataset(made[0])


def test_a_missing_or_exchanged_episode_is_reported_when_it_is_read(made, episode_of):
    path, sources, _ = made
    dataset = load_dataset(path)
    (path / dataset.index[2].name).unlink()
    save_episode(path / dataset.index[3].name, episode_of(sources[0][0], k=9))
    with pytest.raises(MissingFile, match=r"sphere00_k00000.h5: no such file"):
        dataset.episode(2)
    with pytest.raises(BrokenFile, match="content differs from its hash; generate it again"):
        dataset.episode(3)


def test_an_episode_of_another_demonstration_is_a_mismatch(source_of, episode_of, tmp_path):
    stranger = episode_of(source_of(5)[0])
    dataset = write_dataset(tmp_path / "d", [source_of(0)], [stranger], {})
    with pytest.raises(Mismatch, match="sphere00_k00000.h5 was generated from another demonst"):
        list(dataset)


def test_another_demonstration_or_annotation_in_a_source_s_place_is_a_mismatch(made, source_of):
    path, *_ = made
    source = load_dataset(path).sources[0]
    save_demonstration(source.path / "demo.h5", source_of(1)[0])
    annotation = load_annotation(source.path / "annotation.json")
    wider = dataclasses.replace(annotation.spheres[0], radius=0.2)
    save_annotation(
        source.path / "annotation.json",
        Annotation((wider, *annotation.spheres[1:]), annotation.demonstration_hash),
    )
    with pytest.raises(Mismatch, match=r"demo.h5: isn't the one that the dataset was made from"):
        _ = source.demonstration
    with pytest.raises(Mismatch, match=r"annotation.json: isn't the one that the dataset was made"):
        _ = source.annotation
