"""Generated datasets, read from their directories as they are asked for.

A directory holds `sources/demoNN/` (each demonstration and its annotation), `episodes/demoNN/`
(what was generated from it), `manifest.jsonl` and, once it is whole, `dataset.json`.
"""

from __future__ import annotations

import functools
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from sart_toolkit.data.manifest import AttemptKey, Manifest, Rejection, source_name
from sart_toolkit.data.records import Annotation, Demonstration, Episode
from sart_toolkit.data.schemas import DatasetFile
from sart_toolkit.data.storage import (
    load_annotation,
    load_demonstration,
    load_episode,
    read_json,
    read_json_lines,
)
from sart_toolkit.errors import BrokenFile, Mismatch, MissingFile

SUMMARY = "dataset.json"
# What came of executing the trajectories.
REPLAY = "replay.json"
MANIFEST = "manifest.jsonl"


class Source:
    """One demonstration of a dataset with its annotation, each read when first asked for.

    Attributes:
        path: directory of both.
        demonstration_hash, annotation_hash: the content hashes that they must have; the latter is
            `None` where there is no annotation.
        number, request: which source it was in the dataset that it was generated in, and what was
            asked for there.
    """

    def __init__(
        self,
        path: Path,
        demonstration_hash: str,
        annotation_hash: str | None,
        number: int,
        request: Mapping[str, Any],
    ) -> None:
        self.path = path
        self.demonstration_hash, self.annotation_hash = demonstration_hash, annotation_hash
        self.number, self.request = number, request

    def __repr__(self) -> str:
        return f"Source({str(self.path)!r})"

    @property
    def name(self) -> str:
        """The source's name in its dataset."""
        return self.path.name

    @functools.cached_property
    def demonstration(self) -> Demonstration:
        """What was shown.

        Raises:
            MissingFile, BrokenFile: it can't be read.
            Mismatch: it isn't the one that the dataset was made from.
        """
        path = self.path / "demo.h5"
        demonstration = load_demonstration(path)
        _check_same(path, demonstration.content_hash(), self.demonstration_hash)
        return demonstration

    @functools.cached_property
    def annotation(self) -> Annotation | None:
        """The precision spheres, or `None` where the dataset was made without.

        Raises:
            MissingFile, BrokenFile, InvalidInput: it can't be read.
            Mismatch: it isn't the one that the dataset was made with.
        """
        if self.annotation_hash is None:
            return None
        path = self.path / "annotation.json"
        annotation = load_annotation(path)
        _check_same(path, annotation.content_hash(), self.annotation_hash)
        return annotation


def _check_same(path: Path, found: str, expected: str) -> None:
    if found != expected:
        raise Mismatch(
            f"{path}: isn't the one that the dataset was made from (hash {found[:12]}, expected "
            f"{expected[:12]}); restore a copy or generate again"
        )


class Dataset:
    """A finished dataset directory: an index, and episodes that are read one at a time.

    Iterating yields its episodes in the index's order and keeps none of them.

    Attributes:
        path: the directory.
        info: what `dataset.json` says.
        sources: the demonstrations with their annotations.
        index: what is known of each episode without reading it.
        rejected: the attempts that gave no episode, and why.
        content_hash: SHA-256 over the hashes of the sources and of the episodes in order.
    """

    def __init__(self, path: Path, info: Mapping[str, Any], manifest: Manifest) -> None:
        self.path, self.info = path, info
        self.sources = manifest_sources(path, manifest)
        self.index = manifest.index()
        self.rejected: Mapping[AttemptKey, Rejection] = manifest.rejected
        self.content_hash = manifest.content_hash()

    def __repr__(self) -> str:
        return (
            f"Dataset({str(self.path)!r}: {len(self.sources)} demonstration(s), "
            f"{len(self)} generated episodes)"
        )

    def __len__(self) -> int:
        return len(self.index)

    def __iter__(self) -> Iterator[Episode]:
        return (self.episode(i) for i in range(len(self)))

    def episode(self, i: int) -> Episode:
        """The i-th episode of the index, read now.

        Raises:
            MissingFile: its file isn't there.
            BrokenFile: its file is damaged, or not the one that the index lists.
            Mismatch: it was generated from another demonstration than its source.
        """
        entry = self.index[i]
        episode = load_episode(self.path / entry.name, entry.content_hash)
        if episode.provenance.demonstration_hash != self.sources[entry.source].demonstration_hash:
            raise Mismatch(
                f"{self.path}: {entry.name} was generated from another demonstration; "
                "generate it again"
            )
        return episode


def count_demonstrations(sources: Sequence[Source]) -> int:
    """How many different demonstrations sources are of: some may share one."""
    return len({source.demonstration_hash for source in sources})


def manifest_sources(path: Path, manifest: Manifest) -> tuple[Source, ...]:
    """The sources that a manifest lists, in the dataset directory `path`."""
    return tuple(
        Source(path / "sources" / source_name(i), *hashes, *manifest.origin(i))
        for i, hashes in enumerate(manifest.sources)
    )


def load_dataset(path: Path) -> Dataset:
    """The dataset in a directory that `sart augment` made; its episodes are read when asked for.

    Raises:
        MissingFile: no such directory, or it holds no dataset.
        BrokenFile: it was interrupted while it was made (the same command again resumes), or a file
            is damaged.
    """
    path = Path(path)
    if not path.is_dir():
        raise MissingFile(f"{path}: no such dataset directory; make it with `sart augment`")
    if not (path / SUMMARY).exists() and (path / MANIFEST).exists():
        raise BrokenFile(
            f"{path}: interrupted while it was made; run the same command again to resume"
        )
    info = read_json(path / SUMMARY, DatasetFile)
    if not (path / MANIFEST).exists():
        raise MissingFile(f"{path / MANIFEST}: no such file; restore a copy or generate again")
    manifest = Manifest.from_rows(path / MANIFEST, read_json_lines(path / MANIFEST))
    hashes = (manifest.content_hash(), manifest.whole_hash())
    if (info["content_hash"], info.pop("manifest_hash")) != hashes:
        raise BrokenFile(f"{path}: content differs from its hash; generate it again")
    return Dataset(path, info, manifest)
