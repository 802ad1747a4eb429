"""Joint paths over a parameter s in [0, 1]: smooth ones to command, and measured ones."""

from __future__ import annotations

import functools

import numpy as np
from scipy.interpolate import BSpline, make_interp_spline
from scipy.spatial import cKDTree

from sart_toolkit.errors import InvalidInput
from sart_toolkit.poses import Array, check_array, frozen

_DEGREE = 5


class SplinePath:
    """A quintic spline of joint configurations, its fourth derivative continuous.

    Attributes:
        spline: q(s) `(n,)` [rad] as SciPy has it.
        most: the greatest |q'|, |q''| and |q'''| `(3, n)`, from the derivatives' B-spline
            coefficients, which no spline exceeds.
    """

    def __init__(self, spline: BSpline) -> None:
        if spline.k != _DEGREE or spline.t[_DEGREE] != 0.0 or spline.t[-_DEGREE - 1] != 1.0:
            raise InvalidInput("spline: expected a quintic one over [0, 1]")
        if (np.diff(spline.t[_DEGREE:-_DEGREE]) <= 0).any():
            raise InvalidInput("spline: has a knot twice, so that it isn't smooth; remove one")
        self.spline = spline
        self.most = frozen(
            [np.abs(spline.derivative(order).c).max(0) for order in range(1, _DEGREE - 1)]
        )

    @classmethod
    def through(cls, configurations: Array) -> SplinePath:
        """The spline through configurations `(m, n)` at equal steps of s, m at least 6.

        Raises:
            InvalidInput: too few, or not finite.
        """
        q = check_array("configurations", configurations, (None, None))
        if len(q) <= _DEGREE:
            raise InvalidInput(f"configurations: expected at least {_DEGREE + 1}, got {len(q)}")
        knots, solve = _interpolation(len(q))
        return cls(BSpline.construct_fast(knots, solve @ q, _DEGREE))

    def positions(self, s: Array) -> Array:
        """The configurations `(k, n)` [rad] at parameters `(k,)`."""
        return np.asarray(self.spline(np.asarray(s, dtype=np.float64)))

    def chord_deviation(self, start: Array, end: Array) -> Array:
        """Bounds `(k, n)` [rad] of the distance from each interval's chord: |q''| h² / 8."""
        h = np.asarray(end) - np.asarray(start)
        return h[:, None] ** 2 / 8 * self.most[1]


class PolylinePath:
    """Straight joint motions between configurations `(m, n)` [rad], such as measured ones.

    The parameter s counts configurations, from 0 at the first to 1 at the last.
    """

    def __init__(self, configurations: Array) -> None:
        q = check_array("configurations", configurations, (None, None))
        if len(q) < 2:
            raise InvalidInput(f"configurations: expected at least 2, got {len(q)}")
        self.configurations = frozen(q)

    def positions(self, s: Array) -> Array:
        """The configurations `(k, n)` [rad] at parameters `(k,)`."""
        at = np.asarray(s) * (len(self.configurations) - 1)
        i = np.minimum(at.astype(int), len(self.configurations) - 2)
        fraction = (at - i)[:, None]
        return (1 - fraction) * self.configurations[i] + fraction * self.configurations[i + 1]

    def chord_deviation(self, start: Array, end: Array) -> Array:
        """Bounds `(k, n)` [rad] of the distance from each interval's chord.

        Each configuration in an interval is compared with the nearest point of the chord.
        """
        last = len(self.configurations) - 1
        ends = self.positions(start), self.positions(end)
        deviations = np.zeros((len(ends[0]), self.configurations.shape[1]))
        for k, (a, b) in enumerate(np.stack([start, end], 1) * last):
            inside = self.configurations[int(np.ceil(a)) : int(np.floor(b)) + 1]
            if len(inside):
                chord = ends[1][k] - ends[0][k]
                along = (inside - ends[0][k]) @ chord / max(float(chord @ chord), 1e-300)
                nearest = ends[0][k] + np.clip(along, 0.0, 1.0)[:, None] * chord
                deviations[k] = np.abs(inside - nearest).max(0)
        return deviations


def nearest_on_polyline(points: Array, line: Array) -> Array:
    """The points `(k, d)` of a line through many points `(m, d)` that are nearest to `(k, d)`.

    Only the two pieces at the nearest of the line's points, which SciPy finds, are considered.
    """
    _, nearest = cKDTree(line).query(points)
    found, least = np.empty_like(points), np.full(len(points), np.inf)
    for first in (np.maximum(nearest - 1, 0), np.minimum(nearest, len(line) - 2)):
        a, b = line[first], line[first + 1]
        along = ((points - a) * (b - a)).sum(1) / np.maximum(((b - a) ** 2).sum(1), 1e-300)
        foot = a + np.clip(along, 0.0, 1.0)[:, None] * (b - a)
        distances = np.linalg.norm(points - foot, axis=1)
        found[distances < least] = foot[distances < least]
        least = np.minimum(least, distances)
    return found


@functools.cache
def _interpolation(count: int) -> tuple[Array, Array]:
    """The knots of a quintic spline through `count` points, and the matrix to its coefficients."""
    spline = make_interp_spline(np.linspace(0.0, 1.0, count), np.eye(count), k=_DEGREE)
    return frozen(spline.t), frozen(spline.c)
