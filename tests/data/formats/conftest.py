"""Exports of the shared peg-in-hole dataset, each made once."""

from __future__ import annotations

import functools
from collections.abc import Callable
from pathlib import Path

import pytest

from sart_toolkit.data.dataset import Dataset
from sart_toolkit.data.formats import get_format
from sart_toolkit.data.formats.format import Format, Trajectory, about_dataset, trajectories_of
from sart_toolkit.data.formats.transfer import export_dataset

SENTENCE = "Lower the peg into the hole"


@pytest.fixture(scope="session")
def exported(peg_dataset: Dataset, tmp_path_factory: pytest.TempPathFactory) -> Callable[..., Path]:
    """Where the dataset is, written in a format."""

    @functools.cache
    def exported(name: str) -> Path:
        format = get_format(name)
        out: Path = tmp_path_factory.mktemp(name) / f"peg{format.suffix}"
        export_dataset(peg_dataset, format, out, about_dataset(peg_dataset, SENTENCE))
        return out

    return exported


@pytest.fixture(scope="session")
def trajectories(peg_dataset: Dataset) -> list[Trajectory]:
    """What is exported."""
    return list(trajectories_of(peg_dataset))


@pytest.fixture
def problem() -> Callable[[Format, Path], str]:
    """The one thing that is wrong with a path."""

    def problem(format: Format, path: Path) -> str:
        (line,) = format.problems(path)
        return line

    return problem
