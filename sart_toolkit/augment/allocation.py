"""How many trajectories each sphere gets, and which attempts that takes."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from sart_toolkit.augment import get_strategy
from sart_toolkit.augment.config import AugmentConfig
from sart_toolkit.data.manifest import AttemptKey, AttemptTally
from sart_toolkit.data.writer import Sources, SphereShare
from sart_toolkit.errors import InvalidInput
from sart_toolkit.poses import Array

_LEAST_ATTEMPTS = 20
_ATTEMPTS_PER_EPISODE = 10


class Allocation:
    """The trajectories that a configuration asks of each sphere of some demonstrations.

    Attributes:
        wanted: how many in all.
        shares: what is asked of each sphere at first.
    """

    def __init__(self, sources: Sources, config: AugmentConfig) -> None:
        """Share out the trajectories; what a sphere can't give is asked of the others.

        Raises:
            InvalidInput: the demonstrations are too many, or other than n where nothing is drawn,
                or one has no annotation where one is needed.
        """
        strategy = get_strategy(config.strategy)
        drawn = [
            (source, i, sphere)
            for source, (demonstration, annotation) in enumerate(sources)
            for i, sphere in enumerate(strategy.spheres(demonstration, annotation))
        ]
        self.wanted = _wanted(config, len(sources), strategy.draws)
        self._weights = strategy.weights([sphere for *_, sphere in drawn], config.allocation)
        self.shares = [
            SphereShare(source, i, sphere.waypoint, share)
            for (source, i, sphere), share in zip(
                drawn, allocate(self.wanted, self._weights), strict=True
            )
        ]

    def missing(self, tally: AttemptTally) -> list[AttemptKey]:
        """The attempts still needed, no more than can all be kept."""
        most = []
        for share in self.shares:
            kept, made = tally.count(share.source, share.sphere)
            most.append(kept if made >= _limit(share) else np.inf)
        keys: list[AttemptKey] = []
        quotas = allocate(self.wanted, self._weights, most)
        for share, quota in zip(self.shares, quotas, strict=True):
            keys += tally.missing(share.source, share.sphere, quota, _limit(share))
        return sorted(keys, key=lambda key: (key.k, key.source, key.sphere))


def _wanted(config: AugmentConfig, demonstrations: int, draws: bool) -> int:
    """How many trajectories are to be generated.

    Raises:
        InvalidInput: the demonstrations are too many, or other than n where nothing is drawn.
    """
    if draws and config.n <= demonstrations:
        raise InvalidInput(
            f"n: expected more than the {demonstrations} demonstrations, got {config.n}"
        )
    if not draws and config.n != demonstrations:
        raise InvalidInput(
            f"n: strategy {config.strategy!r} draws nothing, so expected the number of "
            f"demonstrations ({demonstrations}), got {config.n}"
        )
    return config.n - demonstrations


def _limit(share: SphereShare) -> int:
    """How many attempts a sphere has; a share is not asked of it again and again in vain."""
    return max(_LEAST_ATTEMPTS, _ATTEMPTS_PER_EPISODE * (share.wanted or 0))


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
