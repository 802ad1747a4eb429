"""How many trajectories each sphere gets."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from sart_toolkit.poses import Array


def allocate(n: int, weights: Array, most: Sequence[float] | None = None) -> list[int]:
    """How many of `n` trajectories spheres of the given weights get.

    One after the other goes to the sphere with the greatest weight / (2 trajectories + 1)
    (Webster's method), so that more trajectories never take one away from any sphere. With equal
    weights that is round-robin, as in the paper, the last round being spread evenly over them all.

    Args:
        n: how many there are to give.
        weights: of each sphere `(m,)`, in any unit.
        most: how many each can take `(m,)`; fewer than `n` are given if that is not enough.
    """
    weights = np.asarray(weights, float)
    order = _spread(len(weights))
    left = np.full(len(weights), np.inf) if most is None else np.asarray(most, float)[order]
    weights = weights[order]
    counts = np.zeros(len(weights), int)
    for _ in range(min(n, int(min(left.sum(), n)))):
        counts[np.argmax(np.where(counts < left, weights / (2 * counts + 1), -1.0))] += 1
    given = np.empty(len(weights), int)
    given[order] = counts
    return given.tolist()


def _spread(n: int) -> list[int]:
    """The numbers below `n` in an order whose beginnings are spread evenly (van der Corput's)."""
    bits = max(1, (n - 1).bit_length())
    return sorted(range(n), key=lambda i: int(f"{i:0{bits}b}"[::-1], 2))
