"""An arm moved by a process of its own."""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np
import pytest

from sart_toolkit.errors import RobotStopped
from sart_toolkit.hardware.cell import Cell, Control, Part
from sart_toolkit.hardware.link import OwnProcess

from .conftest import limits

ARM = f"{Path(__file__).with_name('ideal_arm.py')}:IdealArm"


pytestmark = pytest.mark.slow


@pytest.fixture
def make(robot, model, tmp_path, monkeypatch):
    # The machine that tests run on is no real-time one.
    monkeypatch.setattr("sart_toolkit.hardware.link._START_TIME", 600.0)
    monkeypatch.setattr("sart_toolkit.hardware.link._ANSWER_TIME", 60.0)
    made = []

    def make(**options):
        given = {"notes": str(tmp_path / "notes"), "home": robot.home.tolist(), **options}
        control = Control(rate_hz=50, silence=5.0)
        link = OwnProcess(Cell(robot.name, Part("arm", ARM, given), limits(model), control=control),
                          robot, ())  # fmt: skip
        made.append(link)
        return link

    yield make
    for link in made:
        link.close()


def notes(tmp_path):
    return (tmp_path / "notes").read_text().split()


def test_it_follows_in_real_time_and_is_stopped_and_disconnected_at_the_end(
    make, robot, tmp_path, wait_until
):
    link = make()
    began = time.monotonic()
    link.push(robot.home + np.linspace(0, 0.05, 25)[1:, None], 0.5)
    states = link.wait(0.0)
    assert time.monotonic() - began > 0.45
    assert len(states) > 10 and np.all(np.diff([state.time for state in states]) > 0)
    wait_until(lambda: np.allclose(link.wait(0.0)[-1].q, robot.home + 0.05, atol=1e-9))
    link.close()
    assert notes(tmp_path) == ["connect", "start", "stop", "disconnect"]
    with pytest.raises(RobotStopped, match="doesn't answer"):
        link.push(robot.home[None], 0.1)


def test_what_goes_wrong_there_is_said_here_and_the_arm_is_stopped(make, robot, tmp_path):
    link = make(fails_after=5)
    with pytest.raises(RobotStopped, match="cable pulled"):
        for _ in range(100):
            link.push(robot.home[None], 0.02)
            link.wait(0.0)
    assert "stop" in notes(tmp_path)
    link.close()
    assert notes(tmp_path)[-1] == "disconnect"


def test_a_hand_guides_it_in_real_time_until_it_is_held(make, robot, tmp_path):
    link = make()
    link.guide()
    began = time.monotonic()
    for _ in range(3):
        link.push(robot.home[None] + 1.0, 0.1)
        link.wait(0.0)
    # However slowly it follows targets.
    assert 0.2 < time.monotonic() - began < 3.0
    np.testing.assert_array_equal(link.hold().q, robot.home)
    link.push(robot.home[None] + 0.01, 0.2)
    link.wait(0.0)
    link.close()
    said = notes(tmp_path)
    assert said[:3] == ["connect", "start", "guide"] and said[-3:] == ["hold", "stop", "disconnect"]
    assert said.count("guide") >= 10


def test_an_end_of_this_process_stops_the_arm(make, tmp_path, wait_until):
    """However it ends, what is left of it is a closed pipe."""
    link = make()
    link._pipe.close()
    wait_until(lambda: "disconnect" in notes(tmp_path))
    assert notes(tmp_path) == ["connect", "start", "stop", "disconnect"]
