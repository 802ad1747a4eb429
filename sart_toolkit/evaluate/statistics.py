"""Interval estimates and tests for success rates.

Rollouts of one skill are no independent trials of a method: its demonstration and its training
were drawn once for all of them. Across skills the units are demonstration and training seeds.
"""

from __future__ import annotations

import operator
from collections.abc import Sequence

import numpy as np
from scipy.stats import barnard_exact, binomtest, bootstrap

from sart_toolkit.errors import InvalidInput


def wilson_interval(n_success: int, n: int, confidence: float = 0.95) -> tuple[float, float]:
    """The Wilson score interval (low, high) in [0, 1] of a success probability.

    Wilson, "Probable inference, the law of succession, and statistical inference", J. Am. Stat.
    Assoc. 22 (1927). Unlike p +- z times the standard error it stays in [0, 1], and says something
    when every trial succeeded.

    Args:
        n_success: trials that succeeded.
        n: independent trials, at least 1.
        confidence: probability with which such an interval covers the true rate, in (0, 1).

    Raises:
        InvalidInput: counts not whole, n < 1, n_success outside 0..n, or confidence outside (0, 1).
    """
    n = _whole("n", n)
    n_success = _whole("n_success", n_success)
    if n < 1:
        raise InvalidInput(f"n: expected at least 1 trial, got {n}; evaluate some episodes first")
    if not 0 <= n_success <= n:
        raise InvalidInput(f"n_success: expected between 0 and n = {n}, got {n_success}")
    if not 0.0 < confidence < 1.0:
        raise InvalidInput(f"confidence: expected between 0 and 1, such as 0.95, got {confidence}")
    interval = binomtest(n_success, n).proportion_ci(confidence, method="wilson")
    return float(interval.low), float(interval.high)


# Below this, an interval covers half of all rates or more.
_FEW = 20


def few_rollouts(n: int) -> str | None:
    """A warning where so many rollouts say little; None where they are enough."""
    if n >= _FEW:
        return None
    low, high = wilson_interval(n // 2, n)
    return (
        f"only {n} rollout{'' if n == 1 else 's'}: half of them successful would mean a rate "
        f"between {low:.0%} and {high:.0%}; take at least {_FEW}"
    )


def cluster_interval(
    rates: Sequence[float], weights: Sequence[int], confidence: float = 0.95
) -> tuple[float, float] | None:
    """The percentile bootstrap interval (low, high) of a mean over units, such as seeds.

    Units are drawn with replacement, each with all its rollouts. Between two units no interval can
    be told from one: None for fewer than two. Where all have the same rate, it has no width.

    Args:
        rates: of each unit.
        weights: how many rollouts each has.
        confidence: probability that such an interval is to cover the true mean, in (0, 1).

    Raises:
        InvalidInput: numbers of rates and weights differ, or a weight is not positive.
    """
    values, counts = np.asarray(rates, float), np.asarray(weights, float)
    if values.shape != counts.shape or not (counts > 0).all():
        raise InvalidInput(
            f"weights: expected {len(values)} positive ones, got {list(weights)}; one a rate"
        )
    if len(values) < 2:
        return None
    if np.ptp(values) == 0:
        return float(values[0]), float(values[0])

    def mean(values: np.ndarray, counts: np.ndarray, axis: int = -1) -> np.ndarray:
        return (values * counts).sum(axis) / counts.sum(axis)

    found = bootstrap(
        (values, counts), mean, paired=True, vectorized=True, confidence_level=confidence,
        method="percentile", rng=np.random.default_rng(0),
    ).confidence_interval  # fmt: skip
    return float(found.low), float(found.high)


def spread(rates: Sequence[float]) -> float | None:
    """The standard deviation of rates between units, such as seeds; None for fewer than two."""
    return float(np.std(rates, ddof=1)) if len(rates) > 1 else None


def mcnemar_p(only_a: int, only_b: int) -> float:
    """The exact two-sided p-value of McNemar's test that two methods succeed equally often.

    McNemar, "Note on the sampling error of the difference between correlated proportions",
    Psychometrika 12 (1947): of the pairs in which they differ, half should go to either.

    Args:
        only_a: pairs in which only the first succeeded.
        only_b: pairs in which only the second did.
    """
    n = _whole("only_a", only_a) + _whole("only_b", only_b)
    return float(binomtest(only_a, n).pvalue) if n else 1.0


def unpaired_p(n_success: tuple[int, int], n: tuple[int, int]) -> float:
    """The two-sided p-value of Barnard's exact test that two success probabilities are the same.

    Barnard, "A new test for 2x2 tables", Nature 156 (1945).

    Args:
        n_success: trials that succeeded, of either.
        n: independent trials of either.
    """
    if sum(n_success) in (0, sum(n)):
        return 1.0
    table = [list(n_success), [n[0] - n_success[0], n[1] - n_success[1]]]
    return float(barnard_exact(table).pvalue)


def holm(p_values: Sequence[float]) -> list[float]:
    """p-values adjusted so that a whole table of tests errs as rarely as one, in the same order.

    Holm, "A simple sequentially rejective multiple test procedure", Scand. J. Stat. 6 (1979).
    """
    adjusted = [0.0] * len(p_values)
    least = 0.0
    for rank, i in enumerate(sorted(range(len(p_values)), key=p_values.__getitem__)):
        least = max(least, min(1.0, (len(p_values) - rank) * p_values[i]))
        adjusted[i] = least
    return adjusted


def _whole(name: str, value: int) -> int:
    if isinstance(value, bool):
        raise InvalidInput(f"{name}: expected a whole number, got {value}; count the trials")
    try:
        return operator.index(value)
    except TypeError as error:
        raise InvalidInput(f"{name}: expected a whole number, got {value!r}") from error
