"""The manifest of a dataset: what it was asked for, and how each attempt ended.

A file of JSON lines that only grows. The first says what was asked for and of which demonstrations;
each further one how an attempt ended. Where two are of one attempt the later counts.
"""

from __future__ import annotations

import collections
import itertools
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

from sart_toolkit.data.records import Episode, digest
from sart_toolkit.data.schemas import ManifestHead, ManifestOrigin, ManifestRow
from sart_toolkit.data.storage import SCHEMA_VERSION, check_schema, check_values
from sart_toolkit.errors import BrokenFile

KEPT = "kept"
Origin = tuple[int, Mapping[str, Any]]


class AttemptKey(NamedTuple):
    """The k-th attempt from a sphere of a source: the numbers that decide all that is random."""

    source: int
    sphere: int
    k: int


@dataclass(frozen=True)
class EpisodeEntry:
    """A kept episode in a dataset's index.

    `steps`: of its segment; `clearance` [m]: what the certificate of its commanded path proves,
    `None` without one; `seconds`: for how long the robot moved, `None` where nobody noted it.
    """

    source: int
    sphere: int
    k: int
    steps: int
    content_hash: str
    clearance: float | None = None
    seconds: float | None = None

    @property
    def key(self) -> AttemptKey:
        """The attempt that gave the episode."""
        return AttemptKey(self.source, self.sphere, self.k)

    @property
    def name(self) -> str:
        """The episode's file in the dataset directory."""
        return episode_name(self.key)


class AttemptTally:
    """How many attempts from each sphere were made and kept, and which are to be made next."""

    def __init__(self) -> None:
        self._made: dict[tuple[int, int], set[int]] = collections.defaultdict(set)
        self._kept: dict[tuple[int, int], int] = collections.Counter()

    def add(self, key: AttemptKey, kept: bool) -> None:
        """Count an attempt that was made."""
        self._made[key[:2]].add(key.k)
        self._kept[key[:2]] += kept

    def has(self, key: AttemptKey) -> bool:
        """Whether an attempt was made."""
        return key.k in self._made[key[:2]]

    def count(self, source: int, sphere: int) -> tuple[int, int]:
        """How many attempts from a sphere were kept so far, and how many were made."""
        return self._kept[source, sphere], len(self._made[source, sphere])

    def missing(self, source: int, sphere: int, wanted: int, limit: int) -> list[AttemptKey]:
        """The attempts from a sphere by which `wanted` could be kept, no k beyond `limit`."""
        made = self._made[source, sphere]
        new = (AttemptKey(source, sphere, k) for k in range(limit) if k not in made)
        return list(itertools.islice(new, max(0, wanted - self._kept[source, sphere])))


class Rejection(NamedTuple):
    """Why an attempt gave no episode: `outcome` is the same for all that fail alike.

    `seconds`: for how long the robot moved, `None` where nobody noted it.
    """

    outcome: str
    detail: str
    seconds: float | None = None


def source_name(source: int) -> str:
    """The folder of a dataset's demonstration, by its number."""
    return f"demo{source:02d}"


def episode_name(key: AttemptKey) -> str:
    """The file of an attempt's episode in a dataset directory."""
    return f"episodes/{source_name(key.source)}/sphere{key.sphere:02d}_k{key.k:05d}.h5"


def entry_of(episode: Episode, content_hash: str) -> EpisodeEntry:
    """What the index says of an episode that has this hash.

    Raises:
        BrokenFile: its certificate doesn't say what it proves.
    """
    p = episode.provenance
    try:
        clearance = float(p.certificate["commanded"]["clearance"]) if p.certificate else None
    except (KeyError, TypeError, ValueError) as error:
        raise BrokenFile(
            f"certificate of the episode {episode_name(AttemptKey(p.source, p.sphere, p.k))}: "
            f"{error!r} is missing or wrong; generate it again"
        ) from error
    return EpisodeEntry(p.source, p.sphere, p.k, len(episode), content_hash, clearance)


@dataclass
class Manifest:
    """What a dataset was asked for, and how its attempts ended.

    `sources` has for each demonstration its content hash and its annotation's, `None` without one;
    `request` is whatever else decides what is generated. A dataset that is made of others has
    `origins`: for each source the number that it had in the dataset that it was generated in, and
    that one's request.
    """

    sources: tuple[tuple[str, str | None], ...]
    request: Mapping[str, Any]
    origins: tuple[Origin, ...] = ()
    kept: dict[AttemptKey, EpisodeEntry] = field(default_factory=dict)
    rejected: dict[AttemptKey, Rejection] = field(default_factory=dict)

    @classmethod
    def from_rows(cls, path: Path, rows: Iterable[Mapping[str, Any]]) -> Manifest:
        """The manifest in the rows of the file `path`.

        Raises:
            BrokenFile: a schema that this version doesn't know, or a field is missing or wrong.
        """
        head, *attempts = rows or [{}]
        check_schema(path, head.get("schema_version"))
        found: ManifestHead = check_values(head, ManifestHead, str(path))
        manifest = cls(
            tuple((source.demonstration, source.annotation) for source in found.sources),
            found.request,
            tuple(
                (source.origin.number, source.origin.request)
                for source in found.sources
                if isinstance(source.origin, ManifestOrigin)
            ),
        )
        if len(manifest.origins) not in (0, len(manifest.sources)):
            raise BrokenFile(
                f"{path}: some sources have an origin and some have none: a field is missing or "
                "wrong; restore a copy or make it again"
            )
        for i, row in enumerate(attempts, 2):
            manifest._add(check_values(row, ManifestRow, f"{path}, line {i}"), f"{path}, line {i}")
        return manifest

    def head(self) -> dict[str, Any]:
        """The manifest's first row."""
        return {
            "schema_version": SCHEMA_VERSION,
            "sources": [
                {"demonstration": demonstration, "annotation": annotation}
                | ({"origin": {"number": o[0], "request": dict(o[1])}} if o else {})
                for (demonstration, annotation), o in zip(
                    self.sources, self.origins or [None] * len(self.sources), strict=True
                )
            ],
            "request": dict(self.request),
        }

    def origin(self, source: int) -> Origin:
        """The number of a source where it was generated, and what was asked for there."""
        return self.origins[source] if self.origins else (source, self.request)

    def add(self, row: Mapping[str, Any]) -> None:
        """Take a row of `kept_row` or `rejected_row` in.

        Raises:
            BrokenFile: it is no such row.
        """
        self._add(check_values(row, ManifestRow, "manifest"), "manifest")

    def _add(self, row: ManifestRow, what: str) -> None:
        key = AttemptKey(row.source, row.sphere, row.k)
        self.kept.pop(key, None)
        self.rejected.pop(key, None)
        if row.source >= len(self.sources):
            raise BrokenFile(
                f"{what}: source {row.source} of {len(self.sources)}: a field is missing or wrong; "
                "restore a copy or generate again"
            )
        if row.outcome != KEPT:
            self.rejected[key] = Rejection(row.outcome, row.detail, row.seconds)
            return
        if row.steps is None or row.content_hash is None:
            raise BrokenFile(
                f"{what}: a kept episode has steps and content_hash, a field is missing or wrong; "
                "restore a copy or generate again"
            )
        self.kept[key] = EpisodeEntry(
            *key, row.steps, row.content_hash, row.clearance_m, row.seconds
        )

    @property
    def attempted(self) -> int:
        """How many attempts were made."""
        return len(self.kept) + len(self.rejected)

    def index(self) -> tuple[EpisodeEntry, ...]:
        """The kept episodes, first attempts first: an order that no interruption changes."""
        return tuple(sorted(self.kept.values(), key=lambda e: (e.k, e.source, e.sphere)))

    def content_hash(self) -> str:
        """SHA-256 over the hashes of the sources and of the episodes in order."""
        return digest(
            {
                "sources": self.sources,
                "episodes": [entry.content_hash for entry in self.index()],
            }
        )

    def whole_hash(self) -> str:
        """SHA-256 over everything in it, each attempt's last row, whatever their order."""
        kept = [kept_row(self.kept[key]) for key in sorted(self.kept)]
        rejected = [rejected_row(key, self.rejected[key]) for key in sorted(self.rejected)]
        return digest({"head": self.head(), "kept": kept, "rejected": rejected})


def kept_row(entry: EpisodeEntry) -> dict[str, Any]:
    """The manifest's row of an episode."""
    row = {
        **entry.key._asdict(),
        "outcome": KEPT,
        "steps": entry.steps,
        "content_hash": entry.content_hash,
    }
    return row | _noted(clearance_m=entry.clearance, seconds=entry.seconds)


def rejected_row(key: AttemptKey, rejection: Rejection) -> dict[str, Any]:
    """The manifest's row of an attempt that gave no episode."""
    row = {**key._asdict(), "outcome": rejection.outcome}
    return row | _noted(detail=rejection.detail or None, seconds=rejection.seconds)


def _noted(**fields: Any) -> dict[str, Any]:
    return {name: value for name, value in fields.items() if value is not None}
