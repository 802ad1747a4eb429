"""Datasets of ours into a format of the field, and recordings of the field into ours."""

from __future__ import annotations

from pathlib import Path

from sart_toolkit.data.dataset import Dataset
from sart_toolkit.data.formats.format import About, Format, Progress, counted, trajectories_of
from sart_toolkit.data.records import Demonstration
from sart_toolkit.data.storage import (
    OutputLock,
    check_writable,
    linked,
    remove_left,
    replacing,
    replacing_directory,
)
from sart_toolkit.errors import InvalidInput


def export_dataset(
    dataset: Dataset | Demonstration,
    format: Format,
    out: Path,
    about: About,
    overwrite: bool = False,
    progress: Progress | None = None,
) -> None:
    """Write all trajectories of a dataset in a format, whole or not at all.

    One trajectory is in memory at a time. Interrupted, nothing is left, and it begins again.

    Args:
        dataset: what is exported, or one demonstration.
        format: how.
        out: the file or directory.
        about: what holds for all trajectories, see `about_dataset`.
        overwrite: replace an earlier export in `out`.
        progress: called with (trajectories done, trajectories in all).

    Raises:
        InvalidInput: `out` has another suffix than the format's, or it can't hold a trajectory.
        MissingFile, BrokenFile, Mismatch: as for reading the dataset.
        MissingExtra: the format needs a library that isn't installed.
        OutputExists: `out` is there and `overwrite` is false, or it is no such export.
        CannotWrite: the disk refuses, or another process is at work on `out`; it is as it was.
    """
    out = Path(out)
    if format.suffix and out.suffix != format.suffix:
        raise InvalidInput(
            f"{out}: a path of format {format.name} ends in {format.suffix}; change --out"
        )
    trajectories = counted(trajectories_of(dataset), about, progress)
    if format.mark:
        with replacing_directory(out, format.mark, overwrite) as directory:
            format.write(directory, trajectories, about)
    else:
        with OutputLock(out):
            check_writable(out, overwrite)
            remove_left(linked(out).parent, f".{out.stem}.", out.suffix)
            with replacing(out) as file:
                format.write(file, trajectories, about)
