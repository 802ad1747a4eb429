"""How the spheres of an annotation share the trajectories."""

from __future__ import annotations

import dataclasses
import json

import pytest
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
    proved = AugmentConfig().margin + BODY_STILLNESS + backend.tracking_error
    assert SuggestConfig.for_tracking_error(backend.tracking_error).margin >= proved + 5e-5
    assert SuggestConfig().margin >= proved + 5e-5


def test_where_a_robot_follows_less_closely_suggested_radii_leave_as_much_more_room():
    config = SuggestConfig.for_tracking_error(0.003, max_radius=0.1)
    proved = AugmentConfig().margin + BODY_STILLNESS + 0.003
    assert proved + 5e-5 <= config.margin <= proved + 2e-4
    assert config.max_radius == 0.1


@pytest.mark.parametrize("name", ["margin", "slip_tolerance"])
def test_a_negative_length_is_refused(name):
    with pytest.raises(InvalidInput, match=f"{name}: expected a finite number >= 0 m, got -0.1"):
        AugmentConfig(**{name: -0.1})


def test_settings_survive_json():
    config = AugmentConfig(7, "equal", SART_PLANNED, SamplingConfig("area", 1.0), 1.5, seed=3)
    again = AugmentConfig.from_json(json.loads(json.dumps(config.to_json())))
    assert again == dataclasses.replace(config, strategy="sart_planned")
