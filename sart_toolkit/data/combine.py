"""Datasets made of datasets: several in one, and parts of one.

Nothing is generated again: episodes keep their bytes, and each source says which number it had in
the dataset that it was generated in and with what settings, so that its episodes can still be
proved again. A file is linked where the disk can do that, otherwise copied.
"""

from __future__ import annotations

import collections
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from sart_toolkit.data.dataset import Dataset, Source, count_demonstrations
from sart_toolkit.data.manifest import AttemptKey, EpisodeEntry
from sart_toolkit.data.records import CameraRecord, digest
from sart_toolkit.data.writer import DatasetWriter, SphereShare
from sart_toolkit.errors import InvalidInput, Mismatch, OutputExists

Progress = Callable[[int, int], None]
# These say how many attempts are made, not what one gives.
_NOT_DECIDING = ("n", "allocation")
_ROWS_AT_ONCE = 200
_TOLERANCE = 1e-5


def merge_datasets(
    datasets: Sequence[Dataset],
    out: Path,
    overwrite: bool = False,
    progress: Progress | None = None,
) -> Dataset:
    """One dataset directory of several, whose sources stand side by side.

    Sources that are equal and were generated with the same settings are one, and an episode that
    several datasets hold is there once. The same datasets in the same order give the same content.
    Interrupted, it resumes when called again.

    Args:
        datasets: of one task and robot, with the same cameras and rates.
        out: directory to write.
        overwrite: replace a dataset in `out`.
        progress: called with (episodes done, episodes in all).

    Raises:
        InvalidInput: there is none.
        Mismatch: they are of different tasks or robots, have other cameras or rates, or hold
            different episodes of the same attempt.
        BrokenFile: an episode's file is damaged.
        OutputExists: `out` is one of them, or holds something else and `overwrite` is false.
        CannotWrite: the disk refuses, or another process is at work on `out`.
    """
    if not datasets:
        raise InvalidInput("datasets: expected at least one, got none")
    for dataset in datasets[1:]:
        _check_alike(dataset, datasets[0])
    made = {"merged": [dataset.content_hash for dataset in datasets]}
    picks = [(dataset, range(len(dataset.sources)), dataset.index) for dataset in datasets]
    return _written(out, picks, made, overwrite, progress, with_rejections=True)


def split_dataset(
    dataset: Dataset,
    out: Path,
    parts: Mapping[str, float],
    seed: int = 0,
    overwrite: bool = False,
    progress: Progress | None = None,
) -> dict[str, Dataset]:
    """Dataset directories of a dataset's episodes, `out/NAME` for each part.

    Which episodes a part gets is drawn; of each sphere it gets its share. The parts have no episode
    in common, but each has the demonstrations that its episodes lead back to.

    Args:
        dataset: what is split.
        out: directory to write them in.
        parts: the fraction of the episodes that each gets, by its name.
        seed: of the draw.
        overwrite: replace datasets of these names in `out`.
        progress: called with (episodes done, episodes in all).

    Raises:
        InvalidInput: the fractions are not positive or more than 1 in all, a part would be empty,
            or a name is none of a folder.
        BrokenFile: an episode's file is damaged.
        OutputExists: `out` is the dataset, or a part holds something else and `overwrite` is false.
        CannotWrite: the disk refuses, or another process is at work there.
    """
    _check_outside(dataset, out)
    # Written so that what is no number is refused.
    if not (parts and all(f > 0 for f in parts.values()) and sum(parts.values()) <= 1 + 1e-9):
        raise InvalidInput(
            f"parts: expected fractions > 0 that are at most 1 in all, got {dict(parts)}"
        )
    for name in parts:
        if not name or "/" in name or name.startswith("."):
            raise InvalidInput(f"part {name!r}: expected the name of a folder, such as train")
    order = _spread(dataset.index, seed)
    bounds = np.round(np.cumsum([0.0, *parts.values()]) * len(order)).astype(int)
    chosen = {
        name: order[start:end]
        for name, start, end in zip(parts, bounds[:-1], bounds[1:], strict=True)
    }
    empty = [name for name, entries in chosen.items() if not entries]
    if empty:
        raise InvalidInput(
            f"part {empty[0]!r}: gets none of {len(order)} episodes; choose a larger fraction"
        )
    done, total_episodes = 0, sum(map(len, chosen.values()))
    found = {}
    for name, entries in chosen.items():
        made = {"part": name, "fractions": dict(parts), "seed": seed, "of": dataset.content_hash}
        found[name] = _written(
            out / name, [(dataset, _sources_of(entries), entries)], made, overwrite,
            _after(progress, done, total_episodes),
        )  # fmt: skip
        done += len(entries)
    return found


def shorten_dataset(
    dataset: Dataset,
    out: Path,
    n: int,
    overwrite: bool = False,
    progress: Progress | None = None,
) -> Dataset:
    """A dataset directory of `n` trajectories of a dataset, its demonstrations among them.

    Of each sphere it has its share, first attempts first.

    Args:
        dataset: what it is taken from.
        out: directory to write.
        n: trajectories in all.
        overwrite: replace a dataset in `out`.
        progress: called with (episodes done, episodes in all).

    Raises:
        InvalidInput: the dataset has fewer trajectories, or the demonstrations alone are as many.
        BrokenFile: an episode's file is damaged.
        OutputExists: `out` is the dataset, or holds something else and `overwrite` is false.
        CannotWrite: the disk refuses, or another process is at work on `out`.
    """
    _check_outside(dataset, out)
    demonstrations = count_demonstrations(dataset.sources)
    wanted = n - demonstrations
    if not 1 <= wanted <= len(dataset):
        raise InvalidInput(
            f"n: expected {demonstrations + 1} to {demonstrations + len(dataset)} (the "
            f"demonstrations count), got {n}"
        )
    entries = _spread(dataset.index, None)[:wanted]
    made = {"first": n, "of": dataset.content_hash}
    everyone = range(len(dataset.sources))
    return _written(out, [(dataset, everyone, entries)], made, overwrite, progress)


def split_sources(
    dataset: Dataset, out: Path, overwrite: bool = False, progress: Progress | None = None
) -> dict[str, Dataset]:
    """Dataset directories of a dataset's sources, `out/demoNN` for each.

    Args:
        dataset: what is split.
        out: directory to write them in.
        overwrite: replace datasets of these names in `out`.
        progress: called with (episodes done, episodes in all).

    Raises:
        BrokenFile: an episode's file is damaged.
        OutputExists: `out` is the dataset, or a part holds something else and `overwrite` is false.
        CannotWrite: the disk refuses, or another process is at work there.
    """
    _check_outside(dataset, out)
    done, found = 0, {}
    for i, source in enumerate(dataset.sources):
        entries = [entry for entry in dataset.index if entry.source == i]
        made = {"source": i, "of": dataset.content_hash}
        found[source.name] = _written(
            out / source.name, [(dataset, [i], entries)], made, overwrite,
            _after(progress, done, len(dataset)), with_rejections=True,
        )  # fmt: skip
        done += len(entries)
    return found


# What is taken of a dataset: some of its sources, and some of their episodes.
_Pick = tuple[Dataset, Sequence[int], Sequence[EpisodeEntry]]


def _written(
    out: Path,
    picks: Sequence[_Pick],
    made: Mapping[str, Any],
    overwrite: bool,
    progress: Progress | None,
    with_rejections: bool = False,
) -> Dataset:
    """The dataset directory of what is taken of others; `made` says what that is."""
    for dataset, _, _ in picks:
        _check_outside(dataset, out)
    sources: list[Source] = []
    # By each dataset's own number of a source, the one that it gets.
    numbers: list[dict[int, int]] = []
    seen: dict[str, int] = {}
    for dataset, chosen, _ in picks:
        numbers.append({})
        for i in chosen:
            source = dataset.sources[i]
            identity = digest({
                "hashes": [source.demonstration_hash, source.annotation_hash, source.number],
                "request": _deciding(source.request),
            })  # fmt: skip
            if identity not in seen:
                seen[identity] = len(seen)
                sources.append(source)
            numbers[-1][i] = seen[identity]
    entries = _entries(picks, numbers)
    pairs = [(source.demonstration, source.annotation) for source in sources]
    origins = [(source.number, source.request) for source in sources]
    with DatasetWriter(out, pairs, made, overwrite, origins) as writer:
        if writer.finished is not None:
            return writer.finished
        waiting: list[EpisodeEntry] = []
        for n_done, (entry, path) in enumerate(entries.values(), 1):
            if not writer.tally.has(entry.key):
                writer.files.take(path, entry)
                waiting.append(entry)
            if len(waiting) >= _ROWS_AT_ONCE or n_done == len(entries):
                writer.keep(*waiting)
                waiting = []
            if progress is not None:
                progress(n_done, len(entries))
        if with_rejections:
            for (dataset, _, _), number in zip(picks, numbers, strict=True):
                for key, rejection in dataset.rejected.items():
                    moved = AttemptKey(number.get(key.source, -1), key.sphere, key.k)
                    if moved.source >= 0 and not writer.tally.has(moved):
                        writer.reject(moved, rejection)
        first = picks[0][0].info
        configs = [dict(source.request.get("config", {})) for source in sources]
        about = {
            key: first[key] for key in ("task", "robot", "policy", "references") if key in first
        }
        if len(entries) and writer.executed_seconds is not None:
            about["simulated_seconds"] = writer.executed_seconds
        return writer.finish(
            {**about, "config": _common(configs), "made_of": dict(made)}, _shares(picks, numbers)
        )


def _entries(
    picks: Sequence[_Pick], numbers: Sequence[Mapping[int, int]]
) -> dict[AttemptKey, tuple[EpisodeEntry, Path]]:
    """The episodes by their new keys, and where each is now.

    Raises:
        Mismatch: two are of the same attempt and not the same.
    """
    found: dict[AttemptKey, tuple[EpisodeEntry, Path]] = {}
    for (dataset, _, entries), number in zip(picks, numbers, strict=True):
        for entry in entries:
            new = replace(entry, source=number[entry.source])
            there = found.setdefault(new.key, (new, dataset.path / entry.name))
            if there[0].content_hash != entry.content_hash:
                raise Mismatch(
                    f"{dataset.path / entry.name} and {there[1]}: are of the same attempt and "
                    "differ; generate one of the datasets with another --seed"
                )
    return found


def _shares(picks: Sequence[_Pick], numbers: Sequence[Mapping[int, int]]) -> list[SphereShare]:
    """What the episodes were drawn from."""
    found: dict[tuple[int, int], SphereShare] = {}
    for (dataset, _, _), number in zip(picks, numbers, strict=True):
        spheres: collections.Counter[int] = collections.Counter()
        for row in dataset.info["by_sphere"]:
            source, sphere = row["source"], spheres[row["source"]]
            spheres[source] += 1
            if source in number:
                key = number[source], sphere
                found.setdefault(key, SphereShare(*key, row["waypoint"]))
    return [found[key] for key in sorted(found)]


def _deciding(request: Mapping[str, Any]) -> dict[str, Any]:
    """What of a request decides the episode that an attempt gives."""
    config = {k: v for k, v in request.get("config", {}).items() if k not in _NOT_DECIDING}
    return {**request, "config": config}


def _common(values: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """What all of some settings have in common."""
    return {
        key: value
        for key, value in values[0].items()
        if all(key in other and other[key] == value for other in values)
    }


def _spread(index: Sequence[EpisodeEntry], seed: int | None) -> list[EpisodeEntry]:
    """Episodes in an order whose every stretch has of each sphere its share.

    Those of a sphere are in a random order, or without a seed first attempts first.
    """
    groups: dict[tuple[int, int], list[EpisodeEntry]] = collections.defaultdict(list)
    for entry in sorted(index, key=lambda entry: entry.key):
        groups[entry.key[:2]].append(entry)
    placed = []
    for (source, sphere), group in groups.items():
        order = np.arange(len(group))
        if seed is not None:
            order = np.random.default_rng([seed, source, sphere]).permutation(len(group))
        for rank, i in enumerate(order):
            placed.append(((rank + 0.5) / len(group), group[i].key, group[i]))
    return [entry for *_, entry in sorted(placed, key=lambda row: row[:2])]


def _sources_of(entries: Sequence[EpisodeEntry]) -> list[int]:
    return sorted({entry.source for entry in entries})


def _after(progress: Progress | None, before: int, total: int) -> Progress | None:
    """Progress of a part, as that of the whole."""
    if progress is None:
        return None
    return lambda done, _: progress(before + done, total)


def _check_outside(dataset: Dataset, out: Path) -> None:
    """Return if `out` isn't a dataset's own directory, nor in it."""
    here, there = Path(out).resolve(), dataset.path.resolve()
    if here == there or there in here.parents:
        raise OutputExists(f"{out}: is in the dataset that is read; choose another --out")


def _check_alike(dataset: Dataset, first: Dataset) -> None:
    """Return if a dataset can stand in one with another.

    Raises:
        Mismatch: task, robot, rates or cameras are others.
    """
    for what in ("task", "robot", "rates"):
        found, expected = (
            getattr(each.sources[0].demonstration, what) for each in (dataset, first)
        )
        if found != expected:
            raise Mismatch(
                f"{dataset.path}: {what} is {found!r}, that of {first.path} is {expected!r}; merge "
                f"datasets of the same {what}"
            )
    found, expected = _cameras(dataset), _cameras(first)
    for name in sorted(found.keys() | expected.keys()):
        if name not in found or name not in expected:
            raise Mismatch(
                f"{dataset.path}: has images of {sorted(found)}, {first.path} of "
                f"{sorted(expected)}; merge datasets with the same cameras"
            )
        if not _same_camera(found[name], expected[name]):
            raise Mismatch(
                f"{dataset.path}: camera {name!r} has another size, intrinsics or mounting than in "
                f"{first.path}; merge datasets with the same cameras"
            )


def _cameras(dataset: Dataset) -> Mapping[str, CameraRecord]:
    """The cameras that a dataset's episodes have."""
    recorded = dataset.episode(0) if len(dataset) else dataset.sources[0].demonstration
    return recorded.steps.cameras


def _same_camera(a: CameraRecord, b: CameraRecord) -> bool:
    return (
        a.rgb.shape[1:] == b.rgb.shape[1:]
        and np.allclose(a.intrinsics, b.intrinsics)
        and a.frame == b.frame
        and np.allclose(a.T_frame_camera, b.T_frame_camera, rtol=0, atol=_TOLERANCE)
    )
