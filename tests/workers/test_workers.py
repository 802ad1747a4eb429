"""What runs the work is chosen in one place, and what can't be is refused there."""

from __future__ import annotations

import importlib.util
from typing import Any

import pytest

from sart_toolkit.errors import InvalidInput, MissingExtra, UnknownName
from sart_toolkit.workers import Workers


def test_a_number_means_processes_and_one_of_them_is_this_one() -> None:
    assert Workers.of(1).here and not Workers.of(2).here and not Workers(1, "ray").here
    assert Workers.of(3) == Workers(3, "processes")
    assert Workers.of(Workers(2, "ray")).executor == "ray"


@pytest.mark.parametrize(
    ("given", "error", "message"),
    [
        ((0,), InvalidInput, "workers: expected at least 1, got 0"),
        ((-1, "ray"), InvalidInput, "workers: expected at least 1, got -1"),
        ((2, "rya"), UnknownName, "unknown executor 'rya': did you mean 'ray'"),
        ((2, "processes", "auto"), InvalidInput, "ray_address: .*add --executor ray"),
    ],
)
def test_workers_that_can_not_be_are_refused(
    given: tuple[Any, ...], error: type[Exception], message: str
) -> None:
    with pytest.raises(error, match=message):
        Workers(*given)


def test_without_ray_its_extra_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    found = importlib.util.find_spec
    monkeypatch.setattr(
        "importlib.util.find_spec", lambda name: None if name == "ray" else found(name)
    )
    with pytest.raises(MissingExtra, match=r"pip install 'sart_toolkit\[ray\]'"):
        Workers(2, "ray")
