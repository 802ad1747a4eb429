"""The manifest: what was asked for and how attempts ended, in a file that only grows."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sart_toolkit.data.manifest import (
    AttemptKey,
    EpisodeEntry,
    Manifest,
    Rejection,
    kept_row,
    rejected_row,
)
from sart_toolkit.errors import BrokenFile

PATH = Path("manifest.jsonl")
SOURCES = (("demo a", "spheres a"), ("demo b", "spheres b"))

keys = st.builds(AttemptKey, st.integers(0, 1), st.integers(0, 3), st.integers(0, 5))
moved = st.one_of(st.none(), st.floats(0, 60))
entries = st.builds(
    lambda key, *rest: EpisodeEntry(*key, *rest),
    keys,
    st.integers(1, 40),
    st.text("0123456789abcdef", min_size=64, max_size=64),
    st.one_of(st.none(), st.floats(0, 0.1)),
    moved,
)
rejections = st.builds(Rejection, st.just("joint jump"), st.text(), moved)
rows = st.lists(
    st.one_of(
        st.builds(kept_row, entries),
        st.builds(
            rejected_row, keys, st.builds(Rejection, st.just("joint jump"), st.text(), moved)
        ),
    )
)


def manifest_of(rows):
    manifest = Manifest(SOURCES, {"n": 3})
    for row in rows:
        manifest.add(row)
    return manifest


@given(rows)
def test_a_manifest_survives_its_file(rows):
    manifest = manifest_of(rows)
    lines = [json.loads(json.dumps(row)) for row in (manifest.head(), *rows)]
    assert Manifest.from_rows(PATH, lines) == manifest


@given(rows)
def test_the_last_row_of_an_attempt_counts(rows):
    manifest = manifest_of(rows)
    last = {(row["source"], row["sphere"], row["k"]): row["outcome"] for row in rows}
    assert {tuple(key) for key in manifest.kept} == {k for k, o in last.items() if o == "kept"}
    assert {tuple(k): r.outcome for k, r in manifest.rejected.items()} == {
        k: o for k, o in last.items() if o != "kept"
    }
    assert manifest.attempted == len(last)


@given(st.lists(entries, unique_by=lambda entry: entry.key), st.randoms())
def test_index_and_hash_follow_what_was_kept_and_not_the_order_in_which(entries, random):
    shuffled = random.sample(entries, len(entries))
    one, other = (manifest_of(map(kept_row, some)) for some in (entries, shuffled))
    assert one.index() == other.index()
    assert one.content_hash() == other.content_hash()


def test_the_hash_follows_sources_annotations_and_episodes():
    entry = EpisodeEntry(0, 0, 0, 4, "a" * 64)
    hashes = {
        manifest.content_hash()
        for manifest in (
            manifest_of([kept_row(entry)]),
            manifest_of([]),
            manifest_of([kept_row(EpisodeEntry(0, 0, 0, 4, "b" * 64))]),
            Manifest((("demo a", "other spheres"), SOURCES[1]), {}, {entry.key: entry}),
            Manifest((("other demo", "spheres a"), SOURCES[1]), {}, {entry.key: entry}),
        )
    }
    assert len(hashes) == 5


def test_an_entry_s_file_is_named_by_its_attempt():
    entry = EpisodeEntry(1, 2, 34, 4, "a" * 64)
    assert entry.name == "episodes/demo01/sphere02_k00034.h5"


@pytest.mark.parametrize(
    "change",
    [
        {"k": "x"},
        {"k": None},
        {"source": 2},
        {"source": -1},
        {"outcome": None, "sphere": None},
        {"steps": "many"},
        {"clearance_m": "wide"},
        {"steps": None},
        {"k": 10**400},
        {"path": "../../elsewhere.h5"},
    ],
)
def test_a_row_that_makes_no_sense_is_refused(change):
    row = kept_row(EpisodeEntry(0, 0, 0, 4, "a" * 64)) | change
    with pytest.raises(BrokenFile, match="manifest.jsonl.*a field is missing or wrong.*; restore"):
        Manifest.from_rows(PATH, [manifest_of([]).head(), row])


@pytest.mark.parametrize("missing", ["sources", "request"])
def test_a_head_that_lacks_a_field_is_refused(missing):
    head = manifest_of([]).head()
    del head[missing]
    with pytest.raises(BrokenFile, match=f"manifest.jsonl: .*missing or wrong.*`{missing}`"):
        Manifest.from_rows(PATH, [head])


def test_a_file_without_rows_or_of_another_version_is_refused():
    for rows in ([], [manifest_of([]).head() | {"schema_version": 0}]):
        with pytest.raises(BrokenFile, match="manifest.jsonl: schema_version is (None|0), this"):
            Manifest.from_rows(PATH, rows)
