from __future__ import annotations

from typing import Any

import pytest

from sart_toolkit.evaluate.compare import compare_rollouts, rate_of


def rows(outcomes: str, seed: int = 7, x: float = 0.0) -> list[dict[str, Any]]:
    """A rollout for each letter, "+" a success."""
    return [
        {
            "episode": i,
            "seed": [seed, i],
            "placement": {"block": {"x": x + i, "y": 0.0, "yaw_deg": 0.0}},
            "outcome": "success" if letter == "+" else "failure",
            "success_any": letter in "+?",
        }
        for i, letter in enumerate(outcomes)
    ]


def test_rollouts_of_the_same_placements_are_compared_in_pairs() -> None:
    found = compare_rollouts(rows("++++++++--"), rows("++--------"))
    assert found["test"] == "mcnemar"
    assert found["pairs"] == {"n": 10, "only_a": 6, "only_b": 0}
    # Two of 2**6 ways in which six coins fall.
    assert found["p"] == pytest.approx(2 / 2**6)
    assert found["difference"] == pytest.approx(-0.6)


@pytest.mark.parametrize("other", [rows("+" * 10, seed=8), rows("+" * 10, x=0.5), rows("+" * 9)])
def test_rollouts_of_other_placements_are_no_pairs(other: list[dict[str, Any]]) -> None:
    found = compare_rollouts(rows("-" * 10), other)
    assert found["test"] == "barnard" and found["pairs"] is None
    assert found["p"] < 0.001 and found["difference"] == 1.0


def test_rollouts_of_several_skills_pair_within_a_skill() -> None:
    a, b = (
        [{**row, "unit": unit} for unit, word in enumerate(words) for row in rows(word)]
        for words in (("++", "--"), ("--", "++"))
    )
    found = compare_rollouts(a, b)
    assert found["pairs"] == {"n": 4, "only_a": 2, "only_b": 2} and found["p"] == 1.0


def test_a_rate_says_what_seeds_make_of_it() -> None:
    found = rate_of([rows("+" * 10), rows("+" * 5 + "?" * 5)])
    assert (found["n_success"], found["n_episodes"], found["n_success_any"]) == (15, 20, 20)
    assert found["units"] == [1.0, 0.5] and found["sd_units"] == pytest.approx(0.5 / 2**0.5)
    assert found["ci95_units"] == (0.5, 1.0)
    assert found["warning"] is None
    assert "only 19 rollouts" in rate_of([rows("+" * 19)])["warning"]
    assert rate_of([rows("+" * 19)])["ci95_units"] is None
