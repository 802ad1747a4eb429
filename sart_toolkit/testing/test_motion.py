"""Commanded joints, the tool's pose, time."""

from __future__ import annotations

import numpy as np
import pytest

from sart_toolkit.backends.interface import KnowsBodies, Resets, SavesStates
from sart_toolkit.testing.bench import Bench

# Where a joint may be [rad] when it is where it was commanded to.
_REACHED = 2e-3


def test_commanded_joints_are_reached(bench: Bench) -> None:
    """Each of them, both ways."""
    rng = np.random.default_rng(1)
    for _ in range(3):
        offset = rng.uniform(0.1, 0.3, len(bench.ready)) * rng.choice([-1, 1], len(bench.ready))
        bench.reset()
        for s in np.linspace(0, 1, 20):
            bench.command(bench.ready + s * offset)
        bench.wait(0.3)
        np.testing.assert_allclose(bench.see().q, bench.q, rtol=0, atol=_REACHED)


def test_joints_follow_at_the_commanded_speed(bench: Bench) -> None:
    """They reach what is commanded by the end of each control period, not some time later."""
    speed = np.linspace(0.2, 0.8, len(bench.ready))
    late = []
    for i in range(1, 16):
        bench.command(bench.ready + speed * i / bench.hz)
        late.append(np.abs(bench.see().q - bench.q))
    bench.wait(0.3)
    arrived = np.abs(bench.see().q - bench.q) < _REACHED
    bench.relies_on(arrived.any(), "test_commanded_joints_are_reached")
    assert np.max(np.array(late)[:, arrived]) < 2 * _REACHED


def test_several_targets_of_a_period_end_at_the_last(bench: Bench) -> None:
    """The last of them is where the joints are when the period is over, and is what was sent."""
    n, steps = len(bench.ready), bench.backend.rates.physics_per_control
    speed = np.linspace(0.2, 0.6, n)
    for i in range(12):
        times = (i + np.arange(1, steps + 1) / steps) / bench.hz
        rows = bench.ready + times[:, None] * speed
        sent = bench.backend.command(rows, bench.gripper)
        bench.backend.step()
        assert np.shape(sent.q) == (n,)
    bench.wait(0.3)
    arrived = np.abs(bench.see().q - sent.q) < _REACHED
    bench.relies_on(arrived.any(), "test_commanded_joints_are_reached")
    np.testing.assert_array_equal(sent.q, rows[-1])


def test_a_command_returns_what_was_sent(bench: Bench) -> None:
    """Where a robot goes no farther than it can in one step, it says so."""
    last = np.eye(len(bench.ready))[-1]
    for offset in (0.01, 0.1):
        sent = bench.backend.command(bench.ready + offset * last, 0.6)
        assert 0.0 <= sent.gripper <= 1.0
        bench.wait(0.5)
        arrived = np.abs(bench.see().q - sent.q) < _REACHED
        if offset == 0.01:
            bench.relies_on(arrived.all(), "test_commanded_joints_are_reached")
        assert arrived.all()


def test_joint_velocities_are_those_of_the_joints(bench: Bench) -> None:
    """In rad/s, with the sign of the motion."""
    speed = np.linspace(0.2, 0.8, len(bench.ready))
    for i in range(1, 16):
        before = bench.see().q
        bench.command(bench.ready + speed * i / bench.hz)
    seen = bench.see()
    np.testing.assert_allclose(seen.dq, (seen.q - before) * bench.hz, rtol=0.02, atol=0.01)


def test_the_joint_path_leads_from_one_observation_to_the_next(bench: Bench) -> None:
    """Evenly, oldest first, to the joints as they are; none after a restore or reset.

    A backend may give no rows at all.
    """
    speed = np.linspace(0.2, 0.8, len(bench.ready))
    for i in range(1, 16):
        before = bench.see().q
        bench.command(bench.ready + speed * i / bench.hz)
    seen = bench.see()
    path, n = seen.joint_path, len(seen.q)
    assert path.ndim == 2 and path.shape[1] == n
    if len(path) > 0:
        np.testing.assert_array_equal(path[-1], seen.q)
        way = seen.q - before
        even = before + np.linspace(0, 1, len(path) + 1)[1:, None] * way
        # The backend's own clock may be off the control period by one row.
        assert (np.abs(path - even) <= np.abs(way) / len(path) + 1e-3).all()
    if bench.has(SavesStates):
        bench.states.restore(bench.states.save())
        assert bench.see().joint_path.shape == (0, n)
    if bench.has(Resets):
        bench.command(bench.ready)
        bench.reset()
        assert bench.see().joint_path.shape == (0, n)


def test_joints_stay_within_their_limits(bench: Bench) -> None:
    """A target at the limit is not overshot."""
    for limit, sign in ((bench.model.upper[-1], -1), (bench.model.lower[-1], 1)):
        q = bench.ready.copy()
        q[-1] = limit + sign * 0.05
        bench.reset(q)
        for s in np.linspace(0, 1, 6):
            q[-1] = limit + sign * 0.05 * (1 - s)
            bench.command(q)
            assert sign * (bench.see().q[-1] - limit) >= -1e-3


def test_a_step_without_a_new_command_keeps_to_the_last_one(bench: Bench) -> None:
    """A target stays in force until the next command."""
    bench.command(bench.ready + 0.01, periods=10)
    before = bench.see().q
    bench.wait(0.5)
    np.testing.assert_allclose(bench.see().q, before, rtol=0, atol=_REACHED)


def test_the_tool_is_where_kinematics_have_it(bench: Bench) -> None:
    """The tool frame's pose, not the flange's, in the frame of the robot's base."""
    rng = np.random.default_rng(2)
    for _ in range(4):
        bench.reset(bench.ready + rng.uniform(-0.5, 0.5, len(bench.ready)))
        bench.command(bench.q + 0.01)
        seen = bench.see()
        np.testing.assert_allclose(seen.T_world_tool, bench.model.fk(seen.q), rtol=0, atol=1e-4)


def test_what_is_held_moves_rigidly_with_the_robot(bench: Bench) -> None:
    """A scene's attachments stand where their frame has them."""
    bench.needs(KnowsBodies)
    known = "test_the_bodies_observed_are_those_that_a_backend_knows"
    bench.relies_on("stick" in bench.see().Ts_world_body, known)
    for offset in (0.0, 0.2):
        bench.reset(bench.ready + offset)
        bench.command(bench.q + 0.01)
        seen = bench.see()
        expected = bench.model.fk(seen.q, "stick")
        np.testing.assert_allclose(seen.Ts_world_body["stick"], expected, rtol=0, atol=1e-4)


def test_a_step_advances_time_by_one_control_period(bench: Bench) -> None:
    """Exactly."""
    start, times = bench.see().time, []
    for _ in range(2 * bench.hz):
        bench.command(bench.ready)
        times.append(bench.see().time)
    np.testing.assert_allclose(np.diff([start, *times]), 1 / bench.hz, rtol=0, atol=1e-12)
    assert times[-1] - start == pytest.approx(2.0, abs=1e-12)
