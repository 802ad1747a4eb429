"""How fast a demonstration moves: its typical step, and the time that it takes for some motion."""

import dataclasses

import numpy as np
import pytest

from sart_toolkit.data.pace import Pace, travel
from sart_toolkit.poses import pose

STEP = 0.005


@pytest.fixture
def along_x(peg_demonstration):
    """A demonstration whose commanded tool moves along x, by the steps [m] that are given."""

    def make(*strides):
        n = len(peg_demonstration)
        strides = (*strides, *[0.0] * (n - 1 - len(strides)))
        Ts = np.stack([pose([x, 0, 0]) for x in np.concatenate([[0.0], np.cumsum(strides)])])
        steps = dataclasses.replace(peg_demonstration.steps, commanded_Ts_world_tool=Ts)
        return dataclasses.replace(peg_demonstration, steps=steps)

    return make


def away(demonstration, t, metres):
    """A pose beside the one at waypoint `t`."""
    return demonstration.steps.commanded_Ts_world_tool[t] @ pose([0, metres, 0])


def test_turning_counts_as_a_tenth_of_a_metre_a_radian():
    motions = np.array(
        [[0.03, 0.04, 0, 0, 0, 0, 1], [0, 0, 0, 0, 0.2, 0, 0], [0.01, 0, 0, 0.1, 0, 0, 0]]
    )
    np.testing.assert_allclose(travel(motions), [0.05, 0.02, 0.02])


def test_the_typical_step_is_that_by_which_half_of_the_way_is_made(along_x):
    creeping = [0.02 * STEP] * 30
    assert Pace(along_x(*[STEP] * 5, *creeping, 2 * STEP)).step == pytest.approx(STEP)
    assert Pace(along_x()).step > 0


def test_as_much_motion_takes_the_time_that_it_took_before_the_waypoint(along_x):
    demonstration = along_x(*[STEP] * 10, *[STEP / 2] * 10)
    pace = Pace(demonstration)
    assert pace.time_for(20, away(demonstration, 20, 3.9 * STEP / 2)) == pytest.approx(0.4)
    assert pace.time_for(10, away(demonstration, 10, 3.9 * STEP)) == pytest.approx(0.4)


def test_waiting_does_not_count(along_x):
    demonstration = along_x(*[STEP] * 4, *[0.02 * STEP] * 12, *[STEP] * 4)
    T = away(demonstration, 18, 3.9 * STEP)
    assert Pace(demonstration).time_for(18, T) == pytest.approx(0.4)


def test_where_too_little_came_before_what_comes_after_counts_and_then_the_mean(along_x):
    demonstration = along_x(*[STEP] * 4, *[STEP / 2] * 4)
    pace = Pace(demonstration)
    assert pace.time_for(0, away(demonstration, 0, 2.9 * STEP)) == pytest.approx(0.3)
    assert pace.time_for(4, away(demonstration, 4, 5.9 * STEP)) == pytest.approx(0.8)
    assert pace.time_for(0, away(demonstration, 0, 12 * STEP)) == pytest.approx(1.6)


def test_a_demonstration_that_stands_still_has_no_time_to_offer(along_x):
    demonstration = along_x()
    assert Pace(demonstration).time_for(3, away(demonstration, 3, 0.1)) == 0.0
