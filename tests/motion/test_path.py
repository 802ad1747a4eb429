"""Joint paths: through what they are given, and never beyond what they say of themselves."""

import hypothesis.strategies as st
import numpy as np
import pytest
from hypothesis import given, settings
from scipy.interpolate import BSpline

from sart_toolkit.errors import InvalidInput
from sart_toolkit.motion.path import PolylinePath, SplinePath

PROPERTY = settings(deadline=None, derandomize=True, max_examples=60)
DENSE = np.linspace(0, 1, 2001)

seeds = st.integers(0, 2**32 - 1)
counts = st.integers(6, 60)


def random_configurations(seed, count, joints=6):
    """Some smooth, some jumping to and fro, some of a joint that stands still."""
    rng = np.random.default_rng(seed)
    q = rng.uniform(-2, 2, (count, joints))
    if rng.random() < 0.5:
        q = np.cumsum(0.1 * q, axis=0)
    q[:, rng.random(joints) < 0.3] = rng.uniform(-1, 1)
    return q


def through(seed, count):
    return SplinePath.through(random_configurations(seed, count))


def clamped(seed, count):
    """As a planner makes it: a control polygon, its first and last point on the path."""
    inner = np.linspace(0, 1, count - 4)
    knots = np.concatenate([np.zeros(5), inner, np.ones(5)])
    return SplinePath(BSpline(knots, random_configurations(seed, count), 5))


def polyline(seed, count):
    return PolylinePath(random_configurations(seed, count))


splines = st.builds(
    lambda make, *rest: make(*rest), st.sampled_from([through, clamped]), seeds, counts
)
paths = st.one_of(splines, st.builds(polyline, seeds, counts))


# --- splines ------------------------------------------------------------------------------------


@PROPERTY
@given(seed=seeds, count=counts)
def test_a_spline_passes_through_its_configurations_at_equal_steps(seed, count):
    q = random_configurations(seed, count)
    found = SplinePath.through(q).positions(np.linspace(0, 1, count))
    np.testing.assert_allclose(found, q, atol=1e-9)


def test_a_spline_through_points_of_a_polynomial_is_that_polynomial():
    s = np.linspace(0, 1, 9)
    polynomials = [[1, -2, 3, 0.5, -1, 2], [0, 1, 0, 0, 0, 0], [0.3, 0, 0, 0, 0, 0]]
    q = np.stack([np.polyval(p, s) for p in polynomials], 1)
    expected = np.stack([np.polyval(p, DENSE) for p in polynomials], 1)
    np.testing.assert_allclose(SplinePath.through(q).positions(DENSE), expected, atol=1e-9)


@PROPERTY
@given(path=splines)
def test_no_derivative_exceeds_the_greatest(path):
    for order, most in enumerate(path.most, 1):
        found = np.abs(path.spline(DENSE, nu=order))
        assert (found <= most + 1e-9 * (1 + most.max())).all()


@PROPERTY
@given(path=splines)
def test_derivatives_are_continuous_up_to_the_fourth(path):
    inner = np.unique(path.spline.t)[1:-1]
    tiny = 1e-9
    for order in range(1, 5):
        before, after = (path.spline(inner + side * tiny, nu=order) for side in (-1, 1))
        steepest = np.abs(path.spline(DENSE, nu=order + 1)).max(initial=0.0)
        assert np.abs(after - before).max(initial=0.0) <= 4 * tiny * steepest + 1e-6


@PROPERTY
@given(path=splines)
def test_a_spline_stays_within_the_range_of_its_coefficients(path):
    q = path.positions(DENSE)
    assert (q >= path.spline.c.min(0) - 1e-9).all()
    assert (q <= path.spline.c.max(0) + 1e-9).all()


def test_splines_do_not_share_what_they_are_made_of():
    q = random_configurations(0, 10)
    path = SplinePath.through(q)
    before = path.positions(DENSE)
    SplinePath.through(2 * q)
    q[:] = 0
    np.testing.assert_array_equal(path.positions(DENSE), before)
    with pytest.raises(ValueError, match="read-only"):
        path.most[0, 0] = 0


@pytest.mark.parametrize("count", [0, 1, 5])
def test_too_few_configurations_for_a_spline_are_refused(count):
    with pytest.raises(InvalidInput, match=f"configurations: expected at least 6, got {count}"):
        SplinePath.through(np.zeros((count, 6)))


@pytest.mark.parametrize(
    "knots",
    [np.linspace(0, 1, 16), 2 * np.repeat([0, 1], 6), np.repeat([0.1, 1], 6)],
    ids=["not clamped", "too long", "later"],
)
def test_a_spline_that_does_not_span_0_to_1_is_refused(knots):
    with pytest.raises(InvalidInput, match=r"spline: expected a quintic one over \[0, 1\]"):
        SplinePath(BSpline(knots, np.zeros((len(knots) - 6, 6)), 5))


def test_a_cubic_spline_is_refused():
    with pytest.raises(InvalidInput, match=r"spline: expected a quintic one over \[0, 1\]"):
        SplinePath(BSpline(np.repeat([0.0, 1.0], 4), np.zeros((4, 6)), 3))


# --- polylines ----------------------------------------------------------------------------------


@PROPERTY
@given(seed=seeds, count=st.integers(2, 60))
def test_a_polyline_is_at_its_configurations_and_half_way_in_between(seed, count):
    q = random_configurations(seed, count)
    path = PolylinePath(q)
    np.testing.assert_allclose(path.positions(np.linspace(0, 1, count)), q, atol=1e-12)
    halves = (np.arange(count - 1) + 0.5) / (count - 1)
    np.testing.assert_allclose(path.positions(halves), (q[:-1] + q[1:]) / 2, atol=1e-12)
    np.testing.assert_array_equal(path.positions(np.array([0.0, 1.0])), q[[0, -1]])


def test_a_polyline_keeps_its_configurations():
    q = random_configurations(0, 10)
    path = PolylinePath(q)
    before = path.positions(DENSE)
    q[:] = 0
    np.testing.assert_array_equal(path.positions(DENSE), before)
    with pytest.raises(ValueError, match="read-only"):
        path.configurations[0, 0] = 0


@PROPERTY
@given(seed=seeds, i=st.integers(0, 8), a=st.floats(0, 1), b=st.floats(0, 1))
def test_a_polyline_has_no_deviation_between_neighbours(seed, i, a, b):
    path = polyline(seed, 10)
    start, end = sorted([(i + a) / 9, (i + b) / 9])
    assert path.chord_deviation(np.array([start]), np.array([end])).max() < 1e-9


@pytest.mark.parametrize("count", [0, 1])
def test_a_polyline_of_one_configuration_is_refused(count):
    with pytest.raises(InvalidInput, match=f"configurations: expected at least 2, got {count}"):
        PolylinePath(np.zeros((count, 6)))


# --- both ---------------------------------------------------------------------------------------


def off_the_chord(path, start, end, allowed, n=200):
    """Whether each configuration of an interval is within `allowed (n,)` of one of the chord's.

    One and the same for all joints: joint by joint there is an interval of the chord's parameter;
    they meet.
    """
    ends = path.positions(np.array([start, end]))
    chord = ends[1] - ends[0]
    q = path.positions(np.linspace(start, end, n)) - ends[0]
    room = allowed + 1e-9
    with np.errstate(divide="ignore", invalid="ignore"):
        bounds = np.sort(np.stack([(q - room) / chord, (q + room) / chord]), axis=0)
    still = np.abs(chord) < 1e-12
    low = np.where(still, 0.0, bounds[0]).max(1, initial=0.0)
    high = np.where(still, 1.0, bounds[1]).min(1, initial=1.0)
    within = (np.abs(q) <= room + 1e-12) | ~still
    return (low > high + 1e-9).any() or not within.all()


@settings(PROPERTY, max_examples=300)
@given(path=paths, ends=st.tuples(st.floats(0, 1), st.floats(0, 1)), zoom=st.floats(0, 1))
def test_the_path_is_never_farther_from_a_chord_than_the_bound(path, ends, zoom):
    start, end = sorted(ends)
    end = start + zoom * (end - start)
    (allowed,) = path.chord_deviation(np.array([start]), np.array([end]))
    assert allowed.shape == (6,)
    assert not off_the_chord(path, start, end, allowed)


@PROPERTY
@given(seed=seeds, count=counts, k=st.integers(2, 5))
def test_the_path_is_never_farther_from_chords_between_its_own_points_than_the_bound(
    seed, count, k
):
    # Where a polyline's corners are exactly on the intervals' ends.
    path = polyline(seed, count)
    s = np.linspace(0, 1, count)[::k]
    for start, end, allowed in zip(s[:-1], s[1:], path.chord_deviation(s[:-1], s[1:]), strict=True):
        assert not off_the_chord(path, start, end, allowed)


@PROPERTY
@given(path=paths, parts=st.integers(1, 12))
def test_deviations_of_many_intervals_are_those_of_each(path, parts):
    s = np.linspace(0, 1, parts + 1)
    together = path.chord_deviation(s[:-1], s[1:])
    for row, start, end in zip(together, s[:-1], s[1:], strict=True):
        np.testing.assert_array_equal(
            path.chord_deviation(np.array([start]), np.array([end]))[0], row
        )


@PROPERTY
@given(path=paths)
def test_finer_intervals_deviate_less(path):
    greatest = []
    for parts in (1, 8, 64, 4096):
        s = np.linspace(0, 1, parts + 1)
        greatest.append(path.chord_deviation(s[:-1], s[1:]).max())
    if isinstance(path, SplinePath):
        assert greatest == sorted(greatest, reverse=True)
    assert greatest[-1] <= 0.5 * greatest[0] + 1e-12


def test_a_way_there_and_back_deviates_by_all_of_it():
    path = PolylinePath([np.zeros(3), [1.0, 0.5, 0.0], np.zeros(3)])
    np.testing.assert_allclose(path.chord_deviation(np.zeros(1), np.ones(1)), [[1.0, 0.5, 0.0]])
    # From a third there and a third back: two thirds of the way on.
    third = np.array([1 / 3]), np.array([2 / 3])
    np.testing.assert_allclose(path.chord_deviation(*third), [[1 / 3, 1 / 6, 0.0]], atol=1e-12)


@pytest.mark.parametrize("make", [SplinePath.through, PolylinePath])
@pytest.mark.parametrize(
    ("bad", "message"),
    [
        (np.full((8, 6), np.nan), "configurations: has NaN or infinite entries"),
        (np.zeros(8), r"configurations: expected shape \('n', 'n'\), got \(8,\)"),
        ([[0.0, "a"]] * 8, "configurations: expected numbers, got"),
    ],
    ids=["NaN", "one row", "words"],
)
def test_what_is_no_list_of_configurations_is_refused(make, bad, message):
    with pytest.raises(InvalidInput, match=message):
        make(bad)
