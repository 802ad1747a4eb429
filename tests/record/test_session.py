from __future__ import annotations

import logging

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sart_toolkit.backends.interface import KnowsBodies, Resets
from sart_toolkit.data.records import DEFAULT_RATES, apply_action
from sart_toolkit.errors import InvalidInput
from sart_toolkit.motion.controller import ToolController
from sart_toolkit.poses import apply_motion, distance
from sart_toolkit.record.session import (
    Device,
    SessionConfig,
    TeleopCommand,
    record_demonstration,
)
from sart_toolkit.tasks.task import Placement

BLIND = SessionConfig(cameras=())


class Hand(Device):
    """Holds one velocity for a number of control periods, then says stop."""

    name = "hand"
    operator = "test"

    def __init__(self, velocity, periods, gripper=0.67, at_stop=None):
        self.command = TeleopCommand(np.asarray(velocity, float), gripper)
        self.at_stop = at_stop or TeleopCommand(np.zeros(6), gripper, True)
        self.left = periods
        self.reads = 0

    def read(self, observation):
        self.reads += 1
        self.left -= 1
        return self.command if self.left >= 0 else self.at_stop


def _integrated(T, raw_commands):
    for command in raw_commands:
        T = apply_motion(T, command[:6] / DEFAULT_RATES.control_hz)
    return T


velocities = st.lists(st.floats(-1, 1), min_size=6, max_size=6).map(
    lambda v: np.array(v) * [0.06, 0.06, 0.06, 0.2, 0.2, 0.2]
)


@settings(max_examples=10, deadline=None, derandomize=True)
@given(velocity=velocities, periods=st.integers(1, 20))
def test_velocity_commands_integrate_in_the_tool_s_frame(
    peg_backend, peg_task, peg_model, velocity, periods
):
    demonstration = record_demonstration(
        peg_backend, peg_task, peg_model, Hand(velocity, periods), config=BLIND
    )
    commanded = demonstration.steps.commanded_Ts_world_tool
    expected = _integrated(commanded[0], [np.append(velocity, 0)] * periods)
    np.testing.assert_allclose(commanded[-1], expected, atol=1e-9)
    raw = demonstration.raw_commands
    assert raw.shape == (DEFAULT_RATES.control_per_record * (len(demonstration) - 1), 7)
    np.testing.assert_array_equal(raw[:periods, :6], np.tile(velocity, (periods, 1)))
    assert not raw[periods:, :6].any() and (raw[:, 6] == 0.67).all()


def test_raw_commands_lead_from_each_recorded_command_to_the_next(peg_demonstration):
    raw = peg_demonstration.raw_commands
    commanded = peg_demonstration.steps.commanded_Ts_world_tool
    assert raw.shape == (3 * (len(commanded) - 1), 7)
    for t in range(len(commanded) - 1):
        ahead = _integrated(commanded[t], raw[3 * t : 3 * t + 3])
        np.testing.assert_allclose(commanded[t + 1], ahead, atol=1e-9)


def test_a_demonstration_holds_every_step_s_arrays_bodies_and_state(peg_demonstration):
    d, n = peg_demonstration, len(peg_demonstration)
    assert d.steps.joint_positions.shape == d.steps.commanded_joint_positions.shape == (n, 6)
    assert d.steps.measured_Ts_world_tool.shape == (n, 4, 4)
    assert d.steps.commanded_Ts_world_tool.shape == (n, 4, 4)
    assert d.steps.cameras["wrist"].rgb.shape[0] == n
    assert set(d.body_Ts_world) == {"table", "block", "peg"}
    assert all(Ts.shape == (n, 4, 4) for Ts in d.body_Ts_world.values())
    assert len(d.states) == n and d.success.shape == (n,)
    np.testing.assert_allclose(d.timestamps, np.arange(n) / 10)
    assert d.task_parameters == {"placement": Placement().to_json()}
    assert (d.task, d.robot, d.backend, d.seed) == ("peg_in_hole", "ur5e_2f85", "pybullet", 0)
    assert d.device == "scripted" and d.success[-1] and not d.success[0]
    assert d.seconds == 0 and not d.steered_by_person


def test_measured_poses_stay_near_the_commanded_ones(peg_demonstration):
    steps = peg_demonstration.steps
    for commanded, measured in zip(
        steps.commanded_Ts_world_tool, steps.measured_Ts_world_tool, strict=True
    ):
        p, angle = distance(commanded, measured)
        # Two control periods behind, at most, at 0.1 m/s.
        assert p < 0.006 and angle < np.deg2rad(1.5)


def test_actions_reproduce_the_commanded_poses_and_gripper(peg_demonstration):
    steps = peg_demonstration.steps
    for t, action in enumerate(peg_demonstration.actions[:-1]):
        T, gripper = apply_action(steps.commanded_Ts_world_tool[t], action)
        np.testing.assert_allclose(T, steps.commanded_Ts_world_tool[t + 1], atol=1e-12)
        assert gripper == steps.commanded_gripper[t + 1]


def test_the_camera_is_fixed_to_the_tool_as_recorded(peg_demonstration, peg_backend):
    record = peg_demonstration.steps.cameras["wrist"]
    t = len(peg_demonstration) // 2
    peg_backend.restore(peg_demonstration.states[t])
    T_world_camera = peg_backend.observe(("wrist",)).cameras["wrist"].T_world_camera
    T_world_tool = peg_demonstration.steps.measured_Ts_world_tool[t]
    np.testing.assert_allclose(T_world_tool @ record.T_frame_camera, T_world_camera, atol=1e-5)


def test_each_saved_state_shows_exactly_what_was_recorded_then(peg_demonstration, peg_backend):
    steps = peg_demonstration.steps
    for t in range(0, len(peg_demonstration), 5):
        peg_backend.restore(peg_demonstration.states[t])
        seen = peg_backend.observe(("wrist",))
        np.testing.assert_array_equal(seen.q, steps.joint_positions[t])
        np.testing.assert_array_equal(seen.dq, steps.joint_velocities[t])
        np.testing.assert_array_equal(seen.T_world_tool, steps.measured_Ts_world_tool[t])
        np.testing.assert_array_equal(seen.cameras["wrist"].rgb, steps.cameras["wrist"].rgb[t])
        np.testing.assert_array_equal(seen.cameras["wrist"].depth, steps.cameras["wrist"].depth[t])
        for name, Ts in peg_demonstration.body_Ts_world.items():
            np.testing.assert_array_equal(seen.Ts_world_body[name], Ts[t])


def _restored(demonstration, backend, model, t):
    steps = demonstration.steps
    backend.restore(demonstration.states[t])
    controller = ToolController(model)
    moving = steps.joint_positions[t], steps.joint_velocities[t]
    controller.reset(
        steps.commanded_joint_positions[t], steps.commanded_Ts_world_tool[t], moving if t else None
    )
    return controller


@pytest.mark.parametrize(("start", "off"), [(0, 0.0), (20, 1e-3)])
def test_replaying_the_raw_commands_from_a_saved_state_gives_the_same(
    peg_demonstration, peg_backend, peg_model, start, off
):
    """From the start to the bit; on the way up to what led to the state, which it doesn't hold."""
    controller = _restored(peg_demonstration, peg_backend, peg_model, start)
    for i, command in enumerate(peg_demonstration.raw_commands[3 * start :], 1):
        now = peg_backend.observe().T_world_tool
        desired = _integrated(controller.commanded_T_world_tool, [command])
        peg_backend.command(controller.move(desired, now, 1)[0], command[6])
        peg_backend.step()
        if i % 3 == 0:
            np.testing.assert_allclose(
                peg_backend.observe().T_world_tool,
                peg_demonstration.steps.measured_Ts_world_tool[start + i // 3],
                rtol=0,
                atol=off,
            )


@pytest.mark.parametrize("start", [0, 20])
def test_replaying_the_commanded_poses_at_10_hz_reproduces_the_measured_ones(
    peg_demonstration, peg_backend, peg_model, start
):
    steps = peg_demonstration.steps
    controller = _restored(peg_demonstration, peg_backend, peg_model, start)
    for t in range(start + 1, len(steps)):
        now = peg_backend.observe().T_world_tool
        for q in controller.move(steps.commanded_Ts_world_tool[t], now, 3):
            peg_backend.command(q, steps.commanded_gripper[t])
            peg_backend.step()
        T = peg_backend.observe().T_world_tool
        np.testing.assert_allclose(T, steps.measured_Ts_world_tool[t], rtol=0, atol=1e-3)


def test_a_command_out_of_reach_holds_the_tool_still_and_is_logged(
    peg_backend, peg_task, peg_model, caplog
):
    # Along the tool's -y, which points away from the base at the start.
    away = peg_model.fk(peg_model.spec.home)[:3, :3].T @ [0.5, 0.0, 0.0]
    with caplog.at_level(logging.WARNING):
        demonstration = record_demonstration(
            peg_backend, peg_task, peg_model, Hand([*away, 0, 0, 0], 150), config=BLIND
        )
    assert "command not carried out: tool pose at" in caplog.text
    steps = demonstration.steps
    assert steps.measured_Ts_world_tool[-1, 0, 3] > steps.measured_Ts_world_tool[0, 0, 3] + 0.2
    still = steps.commanded_Ts_world_tool[-3:]
    np.testing.assert_array_equal(still, np.stack([still[0]] * 3))
    np.testing.assert_array_equal(*steps.commanded_joint_positions[-2:])
    assert demonstration.raw_commands[70, :3] == pytest.approx(away), "what was asked is kept"


@pytest.mark.parametrize("periods", range(3))
def test_the_command_that_says_stop_is_not_carried_out(peg_backend, peg_task, peg_model, periods):
    stop = TeleopCommand(np.full(6, 0.05), 0.1, stop=True)
    hand = Hand(np.zeros(6), periods, at_stop=stop)
    demonstration = record_demonstration(peg_backend, peg_task, peg_model, hand, config=BLIND)
    steps = demonstration.steps
    assert len(demonstration) == 2
    np.testing.assert_allclose(*steps.commanded_Ts_world_tool, atol=1e-12)
    assert not demonstration.raw_commands[:, :6].any()
    assert (demonstration.raw_commands[:, 6] == 0.67).all()
    assert (steps.commanded_gripper == 0.67).all()


def test_a_device_that_never_stops_is_an_error_after_max_seconds(peg_backend, peg_task, peg_model):
    hand = Hand(np.zeros(6), 1000)
    with pytest.raises(InvalidInput, match="did not end within 1 s: peg .* allow more with"):
        record_demonstration(
            peg_backend, peg_task, peg_model, hand, config=SessionConfig((), max_seconds=1.0)
        )
    assert hand.reads == 30


def test_progress_tells_the_seconds_recorded(peg_backend, peg_task, peg_model):
    seconds = []
    record_demonstration(
        peg_backend, peg_task, peg_model, Hand(np.zeros(6), 6), config=BLIND,
        progress=seconds.append,
    )  # fmt: skip
    assert len(seconds) == 3 and (np.diff(seconds) > 0).all()


def test_a_backend_without_restore_or_contacts_gives_no_states_and_no_forces(
    limited, peg_backend, peg_task, peg_model
):
    backend = limited(peg_backend, Resets, KnowsBodies)
    demonstration = record_demonstration(
        backend, peg_task, peg_model, Hand(np.zeros(6), 3), config=BLIND
    )
    assert demonstration.states == ()
    assert np.isnan(demonstration.steps.contact_force).all()
    assert demonstration.judged_by == "task"


def test_contact_force_is_the_greatest_since_the_step_before(peg_demonstration):
    force = peg_demonstration.steps.contact_force
    assert force[0] == 0 and (force >= 0).all() and not force[:10].any()


@pytest.mark.parametrize(
    ("velocity", "gripper", "message"),
    [
        (np.zeros(5), 0.5, r"velocity: expected shape \(6,\), got \(5,\)"),
        ([np.nan] * 6, 0.5, "velocity: has NaN"),
        ("fast", 0.5, "velocity: expected numbers"),
        (np.zeros(6), -0.1, "gripper: expected 0"),
        (np.zeros(6), 1.1, "gripper: expected 0"),
        (np.zeros(6), np.nan, "gripper: expected 0"),
    ],
)
def test_a_bad_teleoperation_command_is_refused(velocity, gripper, message):
    with pytest.raises(InvalidInput, match=message):
        TeleopCommand(velocity, gripper)


@pytest.mark.parametrize("seconds", [0.0, -1.0, np.nan, np.inf])
def test_a_session_needs_a_finite_time_limit(seconds):
    with pytest.raises(InvalidInput, match="max_seconds: expected a finite number > 0"):
        SessionConfig(max_seconds=seconds)
