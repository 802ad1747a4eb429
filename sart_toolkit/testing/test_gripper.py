"""The gripper's opening, and what it holds by friction."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest

from sart_toolkit.backends.interface import KnowsBodies
from sart_toolkit.poses import inverse
from sart_toolkit.testing.bench import Bench
from sart_toolkit.testing.scenes import GRASP_HEIGHT, GRASPED_WIDTH

_COMMANDS = (0.0, 1.0, 0.3, 0.8, 0.55)


def test_the_gripper_goes_where_commanded(bench: Bench) -> None:
    """0 is open, 1 closed, and the observed value is where it is, not what was commanded."""
    for command in _COMMANDS:
        bench.command(bench.ready, command, 45)
        assert bench.see().gripper == pytest.approx(command, abs=0.01)


def test_the_fingers_are_as_far_apart_as_the_gripper_s_value_says(bench: Bench) -> None:
    """In metres, by the linkage of the robot's description, with every finger moving."""
    bench.needs(KnowsBodies)
    for command in _COMMANDS:
        bench.command(bench.ready, command, 45)
        expected = bench.expected_opening(float(np.clip(bench.see().gripper, 0, 1)))
        assert bench.finger_opening() == pytest.approx(expected, abs=1e-3)


def test_the_gripper_moves_no_faster_than_its_speed(bench: Bench) -> None:
    """It takes its time, and is still on its way when the arm has moved on."""
    spec = bench.model.spec.gripper
    travel = abs(spec.closed_position - spec.open_position)
    per_period = spec.speed / travel / bench.hz
    bench.reset(gripper=0.0)
    before = bench.see().gripper
    for _ in range(15):
        bench.command(bench.ready, 1.0)
        assert abs(bench.see().gripper - before) < 1.1 * per_period + 1e-3
        before = bench.see().gripper


@dataclass
class Grasp:
    """What came of closing on the peg, lifting it and letting go."""

    closed: bool
    opening: float
    touching: list[tuple[str, str]]
    lifted: float
    slipped: float
    fallen: float
    slipped_after_reset: float


_GRASPS: dict[tuple[str, str], Grasp] = {}


@pytest.fixture
def grasp(loose: Bench) -> Grasp:
    """The same grasp for all tests of a backend with a robot."""
    key = (loose.backend_name, loose.robot_name)
    if key not in _GRASPS:
        _GRASPS[key] = _grasp(loose)
    # Without the gripper's motion nothing below can be tested.
    loose.relies_on(_GRASPS[key].closed, "test_the_gripper_goes_where_commanded")
    return _GRASPS[key]


def _grasp(bench: Bench) -> Grasp:
    def peg() -> np.ndarray:
        return bench.see().Ts_world_body["peg"]

    def peg_in_tool() -> np.ndarray:
        return (inverse(bench.see().T_world_tool) @ peg())[:3, 3]

    bench.reset(bench.joints_at([0, 0, GRASP_HEIGHT]), 0.0)
    bench.command(bench.q, 1.0, 60)
    gripper, opening = bench.see().gripper, bench.finger_opening()
    touching = [(c.a, c.b) for c in bench.contacts()]
    stood, in_tool = peg(), peg_in_tool()
    bench.move_tool([0, 0, GRASP_HEIGHT + 0.05], 30)
    bench.command(bench.q, periods=30)
    held = bench.see()
    lifted, slipped = float(peg()[2, 3] - stood[2, 3]), peg_in_tool() - in_tool
    in_tool = peg_in_tool()
    bench.command(bench.q, 0.0, 30)
    fallen = float(held.Ts_world_body["peg"][2, 3] - peg()[2, 3])
    bodies = {name: held.Ts_world_body[name] for name in ("peg", "brick")}
    value = float(np.clip(held.gripper, 0, 1))
    bench.reset(held.q, value, Ts_world_body=bodies, gripper_target=1.0)
    bench.wait(1.0)
    slipped_after = float(np.linalg.norm(peg_in_tool() - in_tool))
    return Grasp(
        gripper > 0.2,
        opening,
        touching,
        lifted,
        float(np.linalg.norm(slipped)),
        fallen,
        slipped_after,
    )


def test_closing_on_a_peg_stops_at_its_width(grasp: Grasp) -> None:
    """The fingers neither stop short of a peg 30 mm wide nor sink into it."""
    assert grasp.opening == pytest.approx(GRASPED_WIDTH, abs=2e-3)


def test_both_fingers_touch_what_they_grasp(bench: Bench, loose: Bench, grasp: Grasp) -> None:
    """Contacts between finger links and a free body are reported."""
    bench.relies_on_contacts()
    fingers = loose.model.spec.gripper.finger_links
    assert "peg" in loose.scene.grasped(grasp.touching, fingers)


def test_what_is_grasped_is_lifted(grasp: Grasp) -> None:
    """By friction alone, 5 cm, and for a second it slips by less than 5 mm."""
    assert grasp.lifted == pytest.approx(0.05, abs=5e-3)
    assert grasp.slipped < 5e-3


def test_what_is_grasped_falls_when_the_gripper_opens(loose: Bench, grasp: Grasp) -> None:
    """Nothing glues it to the fingers."""
    loose.relies_on(grasp.lifted > 0.04, "test_what_is_grasped_is_lifted")
    assert grasp.fallen > 0.03


def test_a_reset_into_a_grasp_holds_it(loose: Bench, grasp: Grasp) -> None:
    """With the gripper where it was and its target closed, the peg stays in the fingers."""
    loose.relies_on(grasp.lifted > 0.04, "test_what_is_grasped_is_lifted")
    assert grasp.slipped_after_reset < 5e-3
