from __future__ import annotations

import functools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sart_toolkit.backends import make_backend
from sart_toolkit.backends.interface import Observation
from sart_toolkit.benchmark.cells import Cell
from sart_toolkit.benchmark.operator import BenchmarkConfig, benchmark_operator
from sart_toolkit.poses import interpolate, pose
from sart_toolkit.robots import get_robot
from sart_toolkit.robots.model import RobotModel
from sart_toolkit.tasks import get_task
from sart_toolkit.tasks.peg_in_hole import HOLE_DEPTH, PEG_LENGTH, PEG_WIDTH
from sart_toolkit.tasks.task import Placement

TASK = get_task("peg_in_hole")
STRAIGHT_DOWN = np.array([np.pi, 0, 0])
many = settings(max_examples=200, deadline=None, derandomize=True)


def _observation(tip, tilt_deg=0.0, about_deg=0.0, spin_deg=0.0, T_world_block=None):
    """The peg with its tip at `tip` from the rim's centre in the hole's frame, tilted."""
    about = np.deg2rad(about_deg)
    axis = np.array([np.cos(about), np.sin(about), 0])
    T_rim_peg = (
        pose(tip)
        @ pose(rotvec=np.deg2rad(tilt_deg) * axis)
        @ pose(rotvec=STRAIGHT_DOWN)
        @ pose(rotvec=[0, 0, np.deg2rad(spin_deg)])
        @ pose([0, 0, -PEG_LENGTH / 2])
    )
    T_world_block = np.eye(4) if T_world_block is None else T_world_block
    return Observation(
        q=np.zeros(6),
        dq=np.zeros(6),
        gripper=0.5,
        T_world_tool=np.eye(4),
        time=0.0,
        Ts_world_body={
            "block": T_world_block,
            "peg": T_world_block @ pose([0, 0, HOLE_DEPTH]) @ T_rim_peg,
        },
    )


angles = st.floats(-180, 180)
offsets = st.floats(-0.03, 0.03)


@many
@given(offsets, offsets, st.floats(-0.05, 0.02), st.floats(0, 20), angles, angles)
def test_success_is_what_the_card_says(x, y, z, tilt, about, spin):
    wanted = max(abs(x), abs(y)) < 0.012 and z < -0.020 and tilt < 10
    borders = [abs(x) - 0.012, abs(y) - 0.012, z + 0.020, np.deg2rad(tilt - 10)]
    if min(np.abs(borders)) > 1e-9:
        assert TASK.success(_observation([x, y, z], tilt, about, spin)) == wanted


@many
@given(offsets, offsets, st.floats(-0.05, 0.02), st.floats(0, 20), angles, offsets, offsets, angles)
def test_success_does_not_depend_on_where_the_block_stands(x, y, z, tilt, about, bx, by, yaw):
    T = pose([0.5 + bx, by, 0], [0, 0, np.deg2rad(yaw)])
    borders = [abs(x) - 0.012, abs(y) - 0.012, z + 0.020, np.deg2rad(tilt - 10)]
    if min(np.abs(borders)) > 1e-9:
        here, there = (_observation([x, y, z], tilt, about, 0, T) for T in (None, T))
        assert TASK.success(here) == TASK.success(there)


@pytest.mark.parametrize(
    ("tip", "tilt", "text"),
    [
        ([0, 0, -0.03], 15, "peg tilted 15 deg"),
        ([0, 0, -0.03], 180, "peg tilted 180 deg"),
        ([0.06, 0.01, 0.03], 0, "peg 60 mm beside the hole's axis, tip +30 mm from the rim"),
        ([0, -0.09, -0.04], 0, "peg 90 mm beside the hole's axis, tip -40 mm from the rim"),
        ([0, 0, -0.01], 0, "peg in the hole but only 10 mm deep"),
    ],
)
def test_a_failure_reason_says_what_is_missing_in_millimetres_and_degrees(tip, tilt, text):
    observation = _observation(tip, tilt)
    assert not TASK.success(observation)
    assert TASK.failure_reason(observation) == text


def _lower(backend, model, q, T_goal, periods=90):
    """Push the tool towards a pose; the joints commanded last, and all contacts on the way."""
    T_start, touched = model.fk(q), set()
    for i in range(periods):
        q = model.ik(interpolate(T_start, T_goal, (i + 1) / periods), q)
        backend.command(q, 0.67)
        backend.step()
        touched |= {(contact.a, contact.b) for contact in backend.contacts()}
    return q, touched


@pytest.mark.parametrize(
    ("offset", "tilt_deg", "depth", "touches"),
    [
        pytest.param([0.0, 0.0], 0.0, 0.030, None, id="in the hole"),
        pytest.param([0.03, 0.0], 0.0, 0.002, "block", id="on the rim"),
        pytest.param([0.0, -0.019], 0.0, 0.002, "block", id="half over the hole"),
        pytest.param([0.0, 0.08], 0.0, 0.041, "table", id="beside the block"),
        pytest.param([0.0, 0.0], 13.0, 0.012, None, id="tilted over the hole"),
    ],
)
def test_only_a_peg_in_the_hole_is_a_success(
    peg_backend, peg_model, offset, tilt_deg, depth, touches
):
    """Executed: the peg is lowered as far as it goes, or pressed 2 mm into what stops it."""
    state = TASK.initial_state(peg_model, Placement(-0.01, 0.02))
    hole = state.Ts_world_body["block"][:3, 3] + [0, 0, HOLE_DEPTH]
    turned = peg_model.fk(state.q) @ pose(rotvec=[np.deg2rad(tilt_deg), 0, 0])
    above, below = turned.copy(), turned.copy()
    for T, height in ((above, 0.03), (below, -depth)):
        T[:3, 3] = hole + [*offset, height] - turned[:3, 2] * 0.06
    peg_backend.reset(state)
    q, touched = _lower(peg_backend, peg_model, state.q, above)
    assert touched == set()
    _, touched = _lower(peg_backend, peg_model, q, below)
    assert touched == ({tuple(sorted(("peg", touches)))} if touches else set())
    observation = peg_backend.observe()
    assert TASK.success(observation) == (touches is None and tilt_deg == 0)


# --- narrower holes -----------------------------------------------------------------------------

NARROW = {0.005: "PegInHole5mm", 0.002: "PegInHole2mm", 0.001: "PegInHole1mm"}


@pytest.mark.parametrize("clearance", NARROW)
def test_a_narrow_hole_leaves_so_much_on_each_side_of_the_peg(clearance):
    task = get_task(f"sart_toolkit.tasks.peg_in_hole:{NARROW[clearance]}")
    assert task.name == f"peg_in_hole_{1e3 * clearance:.0f}mm"
    (block,) = (body for body in task.scene.bodies if body.name == "block")
    corners = np.concatenate([shape.corners() for shape in block.shapes if shape.collides])
    for axis in (0, 1):
        inner = np.abs(corners[:, axis])[np.abs(corners[:, axis]) < 0.05]
        assert inner.min() == pytest.approx(PEG_WIDTH / 2 + clearance)
        assert np.abs(corners[:, axis]).max() == pytest.approx(0.055)
    assert repr(task.scene.held) == repr(TASK.scene.held)


@pytest.mark.parametrize("clearance", [0.002, 0.001])
def test_the_operator_masters_narrow_holes(clearance, tmp_path):
    task = get_task(f"sart_toolkit.tasks.peg_in_hole:{NARROW[clearance]}")
    make = functools.partial(make_backend, "pybullet", get_robot(task.robot), task.scene, 16)
    cell = Cell(task, "pybullet", make)
    result = benchmark_operator([cell], BenchmarkConfig(2, seed=3), tmp_path / "out.json")
    assert result["cells"][cell.name]["n_success"] == 2


def test_the_usual_plan_is_as_it_was_before_there_were_narrow_holes():
    model = RobotModel(get_robot(TASK.robot), TASK.scene.held)
    above, inside = TASK.plan(TASK.initial_state(model, Placement()))
    assert (above.speed, above.tolerance, above.tolerance_deg, above.tremor) == (0.07, 0.004, 2, 1)
    assert (inside.speed, inside.tolerance, inside.tremor) == (0.03, 0.003, 1)
