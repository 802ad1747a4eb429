"""How the spheres of an annotation share the trajectories."""

from __future__ import annotations

import dataclasses
import json

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sart_toolkit.annotate.suggest import SuggestConfig
from sart_toolkit.augment.config import AugmentConfig
from sart_toolkit.augment.strategies import SART_PLANNED
from sart_toolkit.backends import BACKENDS, get_backend
from sart_toolkit.collision.phases import BODY_STILLNESS
from sart_toolkit.data.sampling import SamplingConfig
from sart_toolkit.errors import InvalidInput, UnknownName

radii = st.lists(st.floats(0.004, 0.2), min_size=1, max_size=8)
numbers = st.integers(2, 200)


def test_an_unknown_allocation_is_refused():
    with pytest.raises(UnknownName, match="allocation 'radios'.*radius"):
        AugmentConfig(allocation="radios")


def test_obstacles_known_from_elsewhere_are_refused():
    with pytest.raises(UnknownName, match="unknown obstacles 'clouds': did you mean 'cloud'"):
        AugmentConfig(obstacles="clouds")


@pytest.mark.parametrize("backend", [get_backend(name) for name in BACKENDS])
def test_suggested_radii_leave_room_for_all_that_augmentation_proves_for(backend):
    """And 0.05 mm for the path, which is within 0.02 mm of the line between poses in the sphere."""
    assert (
        SuggestConfig().margin
        >= AugmentConfig().margin + BODY_STILLNESS + backend.tracking_error + 5e-5
    )


@pytest.mark.parametrize("name", ["margin", "slip_tolerance"])
def test_a_negative_length_is_refused(name):
    with pytest.raises(InvalidInput, match=f"{name}: expected a finite number >= 0 m, got -0.1"):
        AugmentConfig(**{name: -0.1})


@given(radii=radii, n=numbers)
def test_equal_allocation_goes_round_robin(radii, n):
    expected = [len(range(i, n - 1, len(radii))) for i in range(len(radii))]
    assert AugmentConfig(n, allocation="equal").quotas(radii) == expected


@given(radii=radii, n=numbers)
def test_the_allocation_follows_the_radii(radii, n):
    quotas = AugmentConfig(n).quotas(radii)
    assert sum(quotas) == n - 1
    # Nobody could hand a trajectory on to a sphere that has fewer for its radius.
    for a, r_a in zip(quotas, radii, strict=True):
        for b, r_b in zip(quotas, radii, strict=True):
            assert a == 0 or r_a / (2 * a - 1) >= r_b / (2 * b + 1) * (1 - 1e-12)


@given(radii=radii, n=numbers)
def test_more_trajectories_take_none_away(radii, n):
    fewer, more = (AugmentConfig(m).quotas(radii) for m in (n, n + 1))
    assert all(a <= b for a, b in zip(fewer, more, strict=True))


def test_demonstrations_count_among_the_trajectories():
    assert sum(AugmentConfig(40).quotas([0.1, 0.2], demonstrations=3)) == 37
    with pytest.raises(InvalidInput, match="n: expected more than the 3 demonstrations, got 3"):
        AugmentConfig(3).quotas([0.1], demonstrations=3)


def test_settings_survive_json():
    config = AugmentConfig(7, "equal", SART_PLANNED, SamplingConfig("area", 1.0), 1.5, seed=3)
    again = AugmentConfig.from_json(json.loads(json.dumps(config.to_json())))
    assert again == dataclasses.replace(config, strategy="sart_planned")


def test_a_wide_sphere_gets_most():
    assert AugmentConfig(40).quotas([0.122, 0.005, 0.004, 0.0075]) == [35, 1, 1, 2]
