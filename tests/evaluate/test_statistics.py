from __future__ import annotations

import math
import re
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import binom, norm

from sart_toolkit.errors import InvalidInput
from sart_toolkit.evaluate.statistics import (
    cluster_interval,
    few_rollouts,
    holm,
    mcnemar_p,
    spread,
    unpaired_p,
    wilson_interval,
)


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


# --- units and tests ----------------------------------------------------------------------------


def test_the_interval_over_units_is_wider_than_wilsons_where_units_differ() -> None:
    rates, weights = [1.0, 0.5, 0.9, 0.4, 0.95], [40] * 5
    found = cluster_interval(rates, weights)
    assert found is not None
    low, high = wilson_interval(150, 200)
    assert found[1] - found[0] > high - low
    assert found[0] < 0.75 < found[1]
    assert found == cluster_interval(rates, weights), "the same each time"


def test_units_count_by_their_rollouts() -> None:
    found = cluster_interval([1.0, 0.0], [90, 10])
    assert found == (0.0, 1.0)
    low, _ = cluster_interval([1.0, 1.0, 1.0, 0.0], [30, 30, 30, 10]) or (0, 0)
    even, _ = cluster_interval([1.0, 1.0, 1.0, 0.0], [25, 25, 25, 25]) or (0, 0)
    assert low > even


def test_one_unit_has_no_interval_and_equal_ones_have_no_width() -> None:
    assert cluster_interval([0.9], [40]) is None and spread([0.9]) is None
    assert cluster_interval([0.9, 0.9], [40, 40]) == (0.9, 0.9) and spread([0.9, 0.9]) == 0.0


@pytest.mark.parametrize("weights", [[1], [1, 0]])
def test_weights_that_do_not_fit_are_refused(weights: list[int]) -> None:
    with pytest.raises(InvalidInput, match="weights: expected 2 positive ones"):
        cluster_interval([0.5, 0.7], weights)


def test_mcnemar_counts_only_pairs_that_differ() -> None:
    # statsmodels.stats.contingency_tables.mcnemar([[101, 5], [16, 40]], exact=True)
    assert mcnemar_p(5, 16) == pytest.approx(0.026603, abs=1e-6)
    assert mcnemar_p(0, 0) == 1.0
    with pytest.raises(InvalidInput, match="only_b: expected a whole number"):
        mcnemar_p(1, 0.5)  # type: ignore[arg-type]


def test_without_pairs_whole_tables_are_told_apart() -> None:
    # The vaccine trial of scipy's documentation of barnard_exact.
    assert unpaired_p((7, 12), (15, 15)) == pytest.approx(0.0681, abs=1e-3)
    assert unpaired_p((0, 0), (9, 9)) == 1.0 == unpaired_p((9, 9), (9, 9))
    assert unpaired_p((0, 20), (20, 20)) < 1e-6


def test_holm_orders_p_values_and_never_lowers_one() -> None:
    # statsmodels.stats.multitest.multipletests([0.01, 0.04, 0.03, 0.005], method="holm")
    assert holm([0.01, 0.04, 0.03, 0.005]) == pytest.approx([0.03, 0.06, 0.06, 0.02])
    assert holm([]) == [] and holm([0.7, 0.9]) == [1.0, 1.0]


@given(st.lists(st.floats(0, 1), min_size=1, max_size=12))
def test_holm_keeps_the_order_and_stays_within_bonferroni(p_values: list[float]) -> None:
    adjusted = holm(p_values)
    for p, q in zip(p_values, adjusted, strict=True):
        assert p <= q <= 1.0
    order = sorted(range(len(p_values)), key=p_values.__getitem__)
    assert [adjusted[i] for i in order] == sorted(adjusted)
    assert min(adjusted) <= min(1.0, len(p_values) * min(p_values)) + 1e-12


def test_few_rollouts_are_warned_of_with_what_they_leave_open() -> None:
    assert few_rollouts(20) is None
    warning = few_rollouts(10)
    assert warning is not None and re.match(
        r"only 10 rollouts: .* between 24% and 76%; take", warning
    )
