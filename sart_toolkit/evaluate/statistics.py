"""Interval estimates for success rates."""

from __future__ import annotations

import operator

from scipy.stats import binomtest

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


def _whole(name: str, value: int) -> int:
    if isinstance(value, bool):
        raise InvalidInput(f"{name}: expected a whole number, got {value}; count the trials")
    try:
        return operator.index(value)
    except TypeError as error:
        raise InvalidInput(f"{name}: expected a whole number, got {value!r}") from error
