"""The table of robots: each one loads under its name, another name is refused with the nearest."""

import pytest

from sart_toolkit.errors import MissingExtra, UnknownName
from sart_toolkit.robots import ROBOTS, get_robot
from sart_toolkit.robots.model import RobotModel


@pytest.fixture(params=ROBOTS)
def model(request):
    """The model of a robot of the table; of those whose packages are installed."""
    try:
        return RobotModel(get_robot(request.param))
    except MissingExtra as error:
        pytest.skip(str(error))


def test_every_robot_of_the_table_has_its_name_and_a_home_within_its_limits(model):
    spec = model.spec
    assert get_robot(spec.name) is spec
    assert (model.lower <= spec.home).all()
    assert (spec.home <= model.upper).all()
    for limits in (spec.velocity_limits, spec.acceleration_limits, spec.jerk_limits):
        assert (limits > 0).all()


def test_every_robot_can_reach_its_home_pose_from_beside_it(model):
    spec = model.spec
    T = model.fk(spec.home)
    assert abs(model.fk(model.ik(T, spec.home + 0.05)) - T).max() < 1e-5


def test_an_unknown_robot_is_reported_with_the_nearest_name():
    with pytest.raises(UnknownName, match="unknown robot 'ur5_2f85': did you mean 'ur5e_2f85'"):
        get_robot("ur5_2f85")
    with pytest.raises(UnknownName, match="unknown robot 'hal': choose from .*ur5e_2f85"):
        get_robot("hal")
