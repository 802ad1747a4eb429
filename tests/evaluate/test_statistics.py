from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import binom, norm

from sart_toolkit.errors import InvalidInput
from sart_toolkit.evaluate.statistics import wilson_interval


@st.composite
def counts(draw: st.DrawFn) -> tuple[int, int]:
    n = draw(st.integers(1, 2000))
    return draw(st.integers(0, n)), n


@pytest.mark.parametrize(
    ("n_success", "n", "confidence", "low", "high"),
    [
        # Newcombe, Statistics in Medicine 17 (1998), table I, method 3.
        (81, 263, 0.95, 0.2553, 0.3662),
        (15, 148, 0.95, 0.0624, 0.1605),
        (0, 20, 0.95, 0.0, 0.1611),
        (1, 29, 0.95, 0.0061, 0.1718),
        (50, 50, 0.95, 0.9287, 1.0),
    ],
)
def test_known_intervals(
    n_success: int, n: int, confidence: float, low: float, high: float
) -> None:
    assert wilson_interval(n_success, n, confidence) == pytest.approx((low, high), abs=5e-5)


def test_no_success_and_only_successes_end_exactly_at_0_and_1() -> None:
    for n in (1, 3, 7, 50, 1000):
        z2 = 1.959963984540054**2
        assert wilson_interval(0, n)[0] == 0.0
        assert wilson_interval(n, n)[1] == 1.0
        assert wilson_interval(0, n)[1] == pytest.approx(z2 / (n + z2), rel=1e-12)


def test_numpy_counts_are_counts() -> None:
    assert wilson_interval(np.int64(3), np.int32(4)) == wilson_interval(3, 4)


@given(counts(), st.floats(0.01, 0.999))
def test_contains_the_measured_rate_and_stays_within_0_and_1(
    count: tuple[int, int], confidence: float
) -> None:
    k, n = count
    low, high = wilson_interval(k, n, confidence)
    assert 0.0 <= low <= k / n <= high <= 1.0


@given(counts(), st.floats(0.01, 0.999))
def test_ends_solve_the_score_equation(count: tuple[int, int], confidence: float) -> None:
    k, n = count
    z = norm.ppf(0.5 + confidence / 2)
    for p in wilson_interval(k, n, confidence):
        assert (k / n - p) ** 2 == pytest.approx(z * z * p * (1 - p) / n, rel=1e-6, abs=1e-12)


@given(counts())
def test_successes_and_failures_mirror_each_other(count: tuple[int, int]) -> None:
    k, n = count
    low, high = wilson_interval(k, n)
    assert wilson_interval(n - k, n) == pytest.approx((1 - high, 1 - low), abs=1e-12)


@given(counts(), st.floats(0.05, 0.9))
def test_more_successes_raise_it_and_more_confidence_widens_it(
    count: tuple[int, int], confidence: float
) -> None:
    k, n = count
    low, high = wilson_interval(k, n, confidence)
    if k < n:
        assert low < wilson_interval(k + 1, n, confidence)[0]
        assert high < wilson_interval(k + 1, n, confidence)[1] or high == 1.0
    wider = wilson_interval(k, n, confidence + 0.05)
    assert wider[0] <= low and high <= wider[1]
    tenfold = wilson_interval(10 * k, 10 * n, confidence)
    assert tenfold[1] - tenfold[0] < high - low


@pytest.mark.parametrize("n", [20, 50, 100])
def test_covers_the_true_rate_about_as_often_as_promised(n: int) -> None:
    intervals = np.array([wilson_interval(k, n) for k in range(n + 1)])
    rates = np.linspace(0.02, 0.98, 193)
    covered = [
        binom.pmf(np.flatnonzero((intervals[:, 0] <= p) & (p <= intervals[:, 1])), n, p).sum()
        for p in rates
    ]
    assert np.mean(covered) == pytest.approx(0.95, abs=0.01)
    assert min(covered) > 0.85


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((0, 0), "n: expected at least 1 trial, got 0"),
        ((0, -5), "n: expected at least 1 trial"),
        ((-1, 5), "n_success: expected between 0 and n = 5, got -1"),
        ((6, 5), "n_success: expected between 0 and n = 5, got 6"),
        ((2.0, 5), "n_success: expected a whole number, got 2.0"),
        ((2, "5"), "n: expected a whole number, got '5'"),
        ((True, 5), "n_success: expected a whole number, got True"),
        ((2, 5, 1.0), "confidence: expected between 0 and 1"),
        ((2, 5, 0.0), "confidence: expected between 0 and 1"),
        ((2, 5, math.nan), "confidence: expected between 0 and 1"),
    ],
)
def test_refuses_what_is_no_count_or_confidence(arguments: Any, message: str) -> None:
    with pytest.raises(InvalidInput, match=message):
        wilson_interval(*arguments)
