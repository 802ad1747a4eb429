"""The one owner of a dataset directory that is being generated: its lock, manifest and files."""

from __future__ import annotations

import collections
import dataclasses
import json
import math
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from sart_toolkit.data.dataset import (
    MANIFEST,
    SUMMARY,
    Dataset,
    count_demonstrations,
    load_dataset,
    manifest_sources,
)
from sart_toolkit.data.manifest import (
    KEPT,
    AttemptKey,
    AttemptTally,
    EpisodeEntry,
    Manifest,
    Origin,
    Rejection,
    entry_of,
    episode_name,
    kept_row,
    rejected_row,
)
from sart_toolkit.data.records import Annotation, Demonstration, Episode, library_versions
from sart_toolkit.data.storage import (
    Journal,
    OutputLock,
    check_bytes,
    check_replaceable,
    link_file,
    load_episode,
    remove,
    remove_temporary_files,
    save_annotation,
    save_demonstration,
    save_episode,
    write_json,
)
from sart_toolkit.errors import BrokenFile, InvalidInput, Mismatch, OutputExists, SartError

Sources = Sequence[tuple[Demonstration, Annotation | None]]


class SphereShare(NamedTuple):
    """A sphere that trajectories were drawn from, its number in its source, and how many of them.

    `wanted`: what was allocated to it at first, `None` if nobody noted it.
    """

    source: int
    sphere: int
    waypoint: int
    wanted: int | None = None


def check_sources(sources: Sources) -> None:
    """Return if a dataset can be made of demonstrations and their annotations, if they have any.

    Raises:
        InvalidInput: there is none.
        Mismatch: an annotation belongs to another demonstration, or the demonstrations to different
            tasks or robots.
    """
    if not sources:
        raise InvalidInput("sources: expected at least one demonstration, got none")
    for demonstration, annotation in sources:
        if annotation is not None:
            annotation.check_matches(demonstration)
    for what in ("task", "robot"):
        found = sorted({getattr(demonstration, what) for demonstration, _ in sources})
        if len(found) > 1:
            raise Mismatch(
                f"the demonstrations are of different {what}s ({', '.join(found)}); make a dataset "
                "of each"
            )


class EpisodeFiles:
    """Writes the episode files of a dataset directory; picklable, so that any process can.

    Attributes:
        path: the directory.
    """

    def __init__(self, path: Path, numbers: Sequence[int]) -> None:
        """Write to the directory `path`, whose sources had `numbers` where they were generated."""
        self.path, self._numbers = path, tuple(numbers)

    def write(self, episode: Episode) -> EpisodeEntry:
        """What the index is to say of an episode, which is on the disk by then.

        Raises:
            CannotWrite: the disk refuses.
        """
        p = episode.provenance
        key = AttemptKey(p.source, p.sphere, p.k)
        return entry_of(episode, save_episode(self.path / episode_name(key), episode))

    def take(self, path: Path, entry: EpisodeEntry) -> None:
        """Have the file of an episode from another dataset, linked if possible.

        Raises:
            MissingFile, BrokenFile: it isn't there, or was changed since it was written.
            CannotWrite: the disk refuses.
        """
        check_bytes(path, "episode")
        link_file(path, self.path / entry.name)

    def hold(self, entry: EpisodeEntry) -> bool:
        """Whether an episode's file is there and whole, and what the entry says."""
        try:
            episode = load_episode(self.path / entry.name, entry.content_hash)
            # How long the robot moved isn't in the file.
            number = self._numbers[entry.source]
            said = dataclasses.replace(entry, source=number, seconds=None)
            return entry_of(episode, entry.content_hash) == said
        except SartError:
            return False


class DatasetWriter:
    """Writes a dataset directory that no other process can write meanwhile; resumes one.

    Killed at any moment, it finds what was kept when it is opened again: an episode's file is
    written before its row in the manifest, a row without its whole file doesn't count, and a file
    without a row is written again.

    Attributes:
        path: the directory.
        files: writes the episodes, in this process or another.
        sources: the demonstrations in the directory, with their annotations.
        finished: the dataset, if it is whole already.
        tally: the attempts that were made so far.
    """

    def __init__(
        self,
        path: Path,
        sources: Sources,
        request: Mapping[str, Any],
        overwrite: bool = False,
        origins: Sequence[Origin] = (),
    ) -> None:
        """Open a dataset directory to generate, or resume generating, what is asked for.

        Args:
            path: the directory; made if needed.
            sources: demonstrations with their annotations.
            request: whatever else decides what is generated, as JSON values.
            overwrite: replace a dataset in `path`.
            origins: where the dataset is made of others, which number each source had in the one
                that it was generated in, and that one's request.

        Raises:
            InvalidInput, Mismatch: see `check_sources`.
            OutputExists: `path` holds something else, or a dataset made with other settings, and
                `overwrite` is false; the message says which settings.
            CannotWrite: another process is at work on it, or the disk refuses.
            BrokenFile: its manifest can't be read.
        """
        check_sources(sources)
        self.path = path = Path(path)
        hashes = tuple((d.content_hash(), a.content_hash() if a else None) for d, a in sources)
        # As JSON gives it back, to be compared.
        wanted = Manifest(hashes, json.loads(json.dumps(dict(request))), tuple(origins))
        lock = OutputLock(path)
        try:
            if not (path / MANIFEST).exists():
                check_replaceable(path, MANIFEST, overwrite)
        except BaseException:
            lock.close()
            raise
        self._journal = Journal(path / MANIFEST, lock, read=not overwrite)
        try:
            self._manifest = self._opened(wanted, overwrite)
            self.sources = manifest_sources(path, self._manifest)
            self.files = EpisodeFiles(path, [source.number for source in self.sources])
            self.finished = self._checked()
            self.tally = AttemptTally()
            for key in (*self._manifest.kept, *self._manifest.rejected):
                self.tally.add(key, key in self._manifest.kept)
            if self.finished is None:
                self._save_sources(sources)
        except BaseException:
            self.close()
            raise

    def __enter__(self) -> DatasetWriter:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Let go of the directory."""
        self._journal.close()

    def _opened(self, wanted: Manifest, overwrite: bool) -> Manifest:
        """The manifest to continue; a directory that is overwritten is cleared."""
        journal = self._journal
        if journal.rows and not overwrite:
            found = Manifest.from_rows(journal.path, journal.rows)
            differing = _differences(found.head(), wanted.head())
            if differing:
                raise OutputExists(
                    f"{self.path}: holds a dataset made with other settings "
                    f"({', '.join(differing)}); add --overwrite or choose another --out"
                )
            return found
        # The manifest goes last: until then the directory is a dataset with files missing.
        for inside in sorted(self.path.iterdir()):
            if inside != journal.path:
                remove(inside)
        journal.clear()
        journal.append(wanted.head())
        return wanted

    def _checked(self) -> Dataset | None:
        """The dataset if nothing is missing; what is broken is left to be made again."""
        # A process that was killed leaves the file that it was writing.
        remove_temporary_files(self.path)
        manifest = self._manifest
        broken = [entry.key for entry in manifest.kept.values() if not self.files.hold(entry)]
        for key in broken:
            del manifest.kept[key]
        if not broken and (self.path / SUMMARY).exists():
            try:
                return load_dataset(self.path)
            except BrokenFile:
                pass
        remove(self.path / SUMMARY)
        return None

    def _save_sources(self, sources: Sources) -> None:
        for source, (demonstration, annotation) in zip(self.sources, sources, strict=True):
            save_demonstration(source.path / "demo.h5", demonstration)
            if annotation is not None:
                save_annotation(source.path / "annotation.json", annotation)

    @property
    def n_kept(self) -> int:
        """How many episodes are kept so far."""
        return len(self._manifest.kept)

    @property
    def n_rejected(self) -> int:
        """How many attempts gave no episode so far."""
        return len(self._manifest.rejected)

    def outcomes(self) -> list[tuple[AttemptKey, str]]:
        """The attempts so far, each with `KEPT` or why it gave no episode."""
        kept = [(key, KEPT) for key in self._manifest.kept]
        return kept + [(key, found.outcome) for key, found in self._manifest.rejected.items()]

    @property
    def executed_seconds(self) -> float | None:
        """For how long [s] the robot moved in all attempts so far; `None` if one doesn't tell."""
        seconds = [entry.seconds for entry in self._manifest.kept.values()]
        seconds += [rejection.seconds for rejection in self._manifest.rejected.values()]
        told = [value for value in seconds if value is not None]
        # In whatever order they came, the exact sum, rounded once.
        return math.fsum(told) if len(told) == len(seconds) else None

    @property
    def rejections(self) -> dict[str, int]:
        """How many attempts gave no episode so far, by outcome."""
        return _counted(self._manifest.rejected.values())

    @property
    def last_rejection(self) -> Rejection | None:
        """Why the last attempt without an episode gave none."""
        return next(reversed(self._manifest.rejected.values()), None)

    def keep(self, *entries: EpisodeEntry) -> None:
        """Take episodes in whose files are written; they are kept for good when this returns.

        Raises:
            CannotWrite: the disk refuses.
        """
        self._append(*map(kept_row, entries))
        for entry in entries:
            self.tally.add(entry.key, True)

    def reject(self, key: AttemptKey, rejection: Rejection) -> None:
        """Note that an attempt gave no episode, and why.

        Raises:
            CannotWrite: the disk refuses.
        """
        self._append(rejected_row(key, rejection))
        self.tally.add(key, False)

    def _append(self, *rows: Mapping[str, Any]) -> None:
        self._journal.append(*rows)
        for row in rows:
            self._manifest.add(row)

    def finish(
        self, info: Mapping[str, Any], spheres: Sequence[SphereShare] | None = None
    ) -> Dataset:
        """The dataset as it is now, whole; `dataset.json` also says what `info` has.

        Args:
            info: what it says besides counts and hashes.
            spheres: what trajectories were drawn from; the annotations' if left out.

        Raises:
            CannotWrite: the disk refuses.
        """
        manifest = self._manifest
        clearances = [e.clearance for e in manifest.kept.values() if e.clearance is not None]
        summary = {
            **info,
            "n_trajectories": self.n_kept + count_demonstrations(self.sources),
            "n_kept": self.n_kept,
            "n_attempted": self.n_kept + self.n_rejected,
            "rejections": self.rejections,
            "by_sphere": self.by_sphere(spheres),
            "least_commanded_clearance_m": min(clearances, default=None),
            "content_hash": manifest.content_hash(),
            "manifest_hash": manifest.whole_hash(),
            "versions": library_versions(),
        }
        write_json(self.path / SUMMARY, summary)
        return load_dataset(self.path)

    def by_sphere(self, spheres: Sequence[SphereShare] | None = None) -> list[dict[str, Any]]:
        """How the attempts from each sphere ended so far; the annotations' if left out."""
        if spheres is None:
            spheres = [
                SphereShare(source, sphere, at.waypoint)
                for source, found in enumerate(self.sources)
                for sphere, at in enumerate(found.annotation.spheres if found.annotation else ())
            ]
        kept = collections.Counter(key[:2] for key in self._manifest.kept)
        rejected: dict[tuple[int, int], list[Rejection]] = collections.defaultdict(list)
        for key, rejection in self._manifest.rejected.items():
            rejected[key[:2]].append(rejection)
        return [
            {
                "source": share.source,
                "waypoint": share.waypoint,
                **({} if share.wanted is None else {"wanted": share.wanted}),
                "kept": kept[share[:2]],
                "rejections": _counted(rejected[share[:2]]),
            }
            for share in spheres
        ]


def _counted(rejections: Iterable[Rejection]) -> dict[str, int]:
    return dict(sorted(collections.Counter(r.outcome for r in rejections).items()))


def _differences(found: Any, wanted: Any, name: str = "") -> list[str]:
    """Where two JSON values differ, with what each has there."""
    if isinstance(found, dict) and isinstance(wanted, dict):
        pairs = {key: (found.get(key), wanted.get(key)) for key in found | wanted}
    elif isinstance(found, list) and isinstance(wanted, list):
        if len(found) != len(wanted):
            return [f"{len(found)} {name}, now {len(wanted)}"]
        pairs = {str(i): pair for i, pair in enumerate(zip(found, wanted, strict=True))}
    else:
        return [] if found == wanted else [f"{name} {_short(found)}, now {_short(wanted)}"]
    return [
        line
        for key, (a, b) in pairs.items()
        for line in _differences(a, b, f"{name}.{key}" if name else key)
    ]


def _short(value: Any) -> str:
    text = json.dumps(value)
    return text if len(text) <= 20 else f"{text[:16]}..."


def write_dataset(
    path: Path,
    sources: Sources,
    episodes: Iterable[Episode],
    info: Mapping[str, Any],
) -> Dataset:
    """A dataset directory of episodes that were made elsewhere, written one at a time.

    Args:
        path: the directory.
        sources: demonstrations with their annotations.
        episodes: what was generated from them; only one needs to be in memory.
        info: what `dataset.json` is to say besides counts and hash.

    Raises:
        InvalidInput, Mismatch, OutputExists, CannotWrite: see `DatasetWriter`.
    """
    with DatasetWriter(path, sources, {}) as writer:
        for episode in episodes:
            writer.keep(writer.files.write(episode))
        return writer.finish(info)
