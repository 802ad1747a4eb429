from __future__ import annotations

from typing import Any

from sart_toolkit.evaluate.failures import group_failures


def failure(episode: int, reason: str | None, waypoint: int | None = None) -> dict[str, Any]:
    progress = None if waypoint is None else {"waypoint": waypoint, "of": 70, "seconds": 0.5}
    return {"episode": episode, "outcome": "failure", "reason": reason, "progress": progress}


def test_reasons_that_differ_in_numbers_alone_are_one_kind_with_their_medians() -> None:
    rows = [
        {"episode": 0, "outcome": "success", "reason": None},
        failure(1, "box tilted 15 deg"),
        failure(2, "peg 30 mm beside, tip +1 mm from the rim", 10),
        failure(3, "peg 44 mm beside, tip -9 mm from the rim", 30),
        failure(4, "peg 41 mm beside, tip -4 mm from the rim", 20),
    ]
    beside, tilted = group_failures(rows)
    assert beside.reason == "peg 41 mm beside, tip -4 mm from the rim"
    assert (beside.episodes, beside.waypoint, beside.seconds) == ((2, 3, 4), 20.0, 0.5)
    assert (tilted.reason, tilted.episodes) == ("box tilted 15 deg", (1,))
    assert tilted.waypoint is None and tilted.seconds is None


def test_a_median_between_two_keeps_the_decimals_of_the_reasons() -> None:
    (kind,) = group_failures([failure(0, "held for 0.3 s"), failure(1, "held for 0.8 s")])
    assert kind.reason in ("held for 0.5 s", "held for 0.6 s")


def test_failures_without_a_reason_are_a_kind_too() -> None:
    (kind,) = group_failures([failure(0, None), failure(1, None)])
    assert kind.reason == "no reason given" and kind.episodes == (0, 1)


def test_of_successes_alone_there_is_no_kind() -> None:
    assert group_failures([{"episode": 0, "outcome": "success"}]) == []
