from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from sart_toolkit.augment.allocation import Allocation, allocate
from sart_toolkit.augment.config import AugmentConfig
from sart_toolkit.augment.strategies import SphereStrategy

radii = st.lists(st.floats(1e-3, 0.3), min_size=1, max_size=12)
numbers = st.integers(0, 300)


@given(n=numbers, m=st.integers(1, 90))
def test_with_equal_weights_nobody_gets_two_more_than_another(n, m):
    given_out = allocate(n, np.ones(m))
    assert sum(given_out) == n
    assert max(given_out) - min(given_out) <= 1


@given(m=st.integers(2, 90), n=st.integers(1, 89))
def test_an_incomplete_round_is_spread_over_all_spheres(m, n):
    got = np.flatnonzero(allocate(min(n, m), np.ones(m)))
    # Of the first half and the second, no more than a few apart whatever the numbers.
    halves = (got < m / 2).sum(), (got >= m / 2).sum()
    assert abs(int(halves[0]) - int(halves[1])) <= 1 + m // 4
    if min(n, m) >= 4:
        gaps = np.diff([-1, *got, m])
        assert gaps.max() <= 4 * m / min(n, m) + 1


@given(radii=radii, n=numbers)
def test_the_allocation_follows_the_weights(radii, n):
    quotas = allocate(n, np.array(radii))
    assert sum(quotas) == n
    # Nobody could hand a trajectory on to a sphere that has fewer for its weight.
    for a, r_a in zip(quotas, radii, strict=True):
        for b, r_b in zip(quotas, radii, strict=True):
            assert a == 0 or r_a / (2 * a - 1) >= r_b / (2 * b + 1) * (1 - 1e-12)


@given(radii=radii, n=numbers)
def test_more_trajectories_take_none_away(radii, n):
    fewer, more = (allocate(m, np.array(radii)) for m in (n, n + 1))
    assert all(a <= b for a, b in zip(fewer, more, strict=True))


@given(radii=radii, n=numbers, data=st.data())
def test_what_a_sphere_cannot_take_goes_to_the_others(radii, n, data):
    most = data.draw(st.lists(st.integers(0, 20), min_size=len(radii), max_size=len(radii)))
    quotas, free = allocate(n, np.array(radii), most), allocate(n, np.array(radii))
    assert sum(quotas) == min(n, sum(most))
    assert all(quota <= limit for quota, limit in zip(quotas, most, strict=True))
    # Nobody loses by another's limit.
    assert all(
        quota >= min(limit, before) for quota, limit, before in zip(quotas, most, free, strict=True)
    )


def test_a_wide_sphere_gets_most():
    assert allocate(39, np.array([0.122, 0.005, 0.004, 0.0075])) == [35, 1, 1, 2]


def test_without_spheres_nothing_is_given():
    assert allocate(5, np.ones(0)) == []


class _OnlyTheLast(SphereStrategy):
    """A strategy that shares N in a way of its own."""

    def weights(self, spheres, allocation):
        return np.arange(len(spheres)) == len(spheres) - 1


ONLY_THE_LAST = _OnlyTheLast()


def test_a_strategy_decides_how_trajectories_are_shared(peg_demonstration, peg_annotation):
    config = AugmentConfig(n=9, strategy=ONLY_THE_LAST)
    shares = Allocation([(peg_demonstration, peg_annotation)], config).shares
    assert [share.wanted for share in shares] == [0] * (len(shares) - 1) + [8]


def test_every_waypoint_of_miles_is_given_as_many_and_few_are_spread(peg_demonstration):
    n = len(peg_demonstration) - 1
    for each in (1, 3):
        config = AugmentConfig(n=1 + each * n, strategy="miles")
        shares = Allocation([(peg_demonstration, None)], config).shares
        assert [share.waypoint for share in shares] == list(range(n))
        assert {share.wanted for share in shares} == {each}
    few = Allocation([(peg_demonstration, None)], AugmentConfig(n=13, strategy="miles")).shares
    chosen = [share.waypoint for share in few if share.wanted]
    assert len(chosen) == 12 and max(np.diff([-1, *chosen, n])) <= n / 3
