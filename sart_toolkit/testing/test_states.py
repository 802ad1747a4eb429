"""Reset, save and restore: what follows depends on the state alone."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from sart_toolkit.backends.interface import KnowsBodies, Resets, SavesStates
from sart_toolkit.errors import BrokenFile
from sart_toolkit.poses import angle_between, pose
from sart_toolkit.robots.spec import Shape
from sart_toolkit.scenes.spec import Body, SceneSpec
from sart_toolkit.testing.bench import Bench, continue_in_new_process

Make = Callable[..., Bench]


def _moved(bench: Bench) -> None:
    """Bring everything out of its place, with a contact on the way."""
    bench.lower_stick(-0.002)
    bench.command(bench.ready + 0.05, 0.9, 3)


def _pressing(bench: Bench) -> bytes:
    """The state saved while the stick presses on the block."""
    bench.reset()
    bench.lower_stick(-0.002)
    return bench.states.save()


# --- reset --------------------------------------------------------------------------------------


def test_reset_puts_the_joints_where_the_state_says(bench: Bench) -> None:
    """Exactly, at rest, and whatever the robot was doing."""
    bench.needs(Resets)
    rng = np.random.default_rng(0)
    for _ in range(4):
        _moved(bench)
        state = bench.reset(bench.ready + rng.uniform(-0.3, 0.3, len(bench.ready)))
        np.testing.assert_allclose(bench.see().q, state.q, rtol=0, atol=1e-6)
        assert not bench.see().dq.any()


def test_reset_puts_the_gripper_where_the_state_says(bench: Bench) -> None:
    """At once, not by closing it."""
    bench.needs(Resets)
    for gripper in (0.0, 0.3, 1.0):
        bench.reset(gripper=gripper)
        assert bench.see().gripper == pytest.approx(gripper, abs=1e-6)


def test_reset_puts_bodies_where_the_state_says(bench: Bench) -> None:
    """Those that never move by themselves, too."""
    bench.needs(Resets, KnowsBodies)
    block = bench.scene.bodies[1].T_world_body
    for x, yaw in ((0.1, 1.0), (-0.05, -3.0)):
        state = bench.reset(Ts_world_body={"block": block @ pose([x, 0, 0], [0, 0, yaw])})
        seen = bench.see().Ts_world_body
        for name, T in state.Ts_world_body.items():
            np.testing.assert_allclose(seen[name], T, rtol=0, atol=1e-6)


def test_reset_starts_time_at_zero(bench: Bench) -> None:
    """Time is counted from the last reset."""
    bench.needs(Resets)
    bench.wait(0.1)
    bench.reset()
    assert bench.see().time == 0.0


def test_after_a_reset_the_robot_stays_where_it_is(bench: Bench) -> None:
    """The joints' targets become the state's own, and the arm doesn't sag."""
    bench.needs(Resets)
    bench.command(bench.ready + 0.1, periods=2)
    state = bench.reset()
    bench.wait(0.5)
    np.testing.assert_allclose(bench.see().q, state.q, rtol=0, atol=2e-3)


def test_after_a_reset_the_gripper_goes_to_the_state_s_target(bench: Bench) -> None:
    """Which differs from where it is when something is grasped."""
    bench.needs(Resets)
    bench.reset(gripper=0.2, gripper_target=0.8)
    bench.wait(1.5)
    assert bench.see().gripper == pytest.approx(0.8, abs=0.02)


def test_the_same_commands_give_the_same_trajectory(bench: Bench) -> None:
    """To the bit: no clock, no threads, no global random numbers."""
    bench.needs(Resets)
    first = bench.continuation()
    bench.reset()
    assert bench.continuation() == first


def test_what_follows_a_reset_depends_on_the_state_alone(bench: Bench) -> None:
    """A solver remembers earlier contacts unless it is made to forget them."""
    bench.relies_on_repeating()
    expected = bench.continuation()
    _moved(bench)
    bench.reset()
    assert bench.continuation() == expected


# --- restore ------------------------------------------------------------------------------------


def test_restore_returns_the_joints(bench: Bench) -> None:
    """Positions, velocities and the tool's pose, exactly, of a robot in motion."""
    bench.needs(SavesStates)
    for i in range(5):
        bench.command(bench.ready + 0.01 * i)
    before, state = bench.see(), bench.states.save()
    _moved(bench)
    bench.states.restore(state)
    for name in ("q", "dq", "T_world_tool"):
        np.testing.assert_array_equal(getattr(bench.see(), name), getattr(before, name))


def test_restore_returns_the_gripper(bench: Bench) -> None:
    """On its way, not where it was to go."""
    bench.needs(SavesStates)
    bench.reset(gripper=0.1)
    bench.command(bench.ready, 0.9, 3)
    before, state = bench.see(), bench.states.save()
    bench.reset(gripper=0.6)
    bench.states.restore(state)
    assert bench.see().gripper == before.gripper


def test_restore_returns_bodies(bench: Bench) -> None:
    """Those that only a reset moves, too."""
    bench.needs(SavesStates, KnowsBodies)
    block = bench.scene.bodies[1].T_world_body
    bench.reset(Ts_world_body={"block": block @ pose([0.1, 0, 0], [0, 0, 1])})
    before, state = bench.see().Ts_world_body, bench.states.save()
    bench.reset()
    bench.states.restore(state)
    np.testing.assert_array_equal(bench.see().Ts_world_body["block"], before["block"])


def test_restore_returns_the_time(bench: Bench) -> None:
    """Time is part of the state."""
    bench.needs(SavesStates)
    bench.wait(0.1)
    before, state = bench.see().time, bench.states.save()
    bench.wait(0.2)
    bench.states.restore(state)
    assert bench.see().time == before


def test_restore_returns_the_commands_in_force(bench: Bench) -> None:
    """A step without a new command continues to the targets that were set when it was saved."""
    bench.needs(SavesStates)
    bench.reset(gripper=0.2)
    bench.backend.command(bench.ready + 0.01, 0.8)
    state = bench.states.save()
    bench.wait(1.0)
    live = bench.see()
    bench.reset(bench.ready - 0.1, 0.6)
    bench.states.restore(state)
    bench.wait(1.0)
    np.testing.assert_allclose(bench.see().q, live.q, rtol=0, atol=2e-3)
    assert bench.see().gripper == pytest.approx(live.gripper, abs=0.02)


def test_a_restored_state_is_saved_as_the_same_bytes(bench: Bench) -> None:
    """Whatever ran before: nothing of the history is in them."""
    bench.needs(SavesStates)
    state = _pressing(bench)
    bench.states.restore(state)
    assert bench.states.save() == state
    _moved(bench)
    bench.states.restore(state)
    assert bench.states.save() == state


def test_saving_changes_nothing(bench: Bench) -> None:
    """What is recorded must not depend on whether it is."""
    bench.needs(SavesStates)
    bench.relies_on_repeating()
    bench.lower_stick(-0.002)
    expected = bench.continuation()
    bench.reset()
    bench.lower_stick(-0.002)
    bench.states.save()
    assert bench.continuation() == expected


def test_what_follows_a_restore_depends_on_the_saved_state_alone(bench: Bench) -> None:
    """To the bit, contacts and images included, whatever ran in between."""
    bench.needs(SavesStates)
    bench.relies_on_repeating()
    state = _pressing(bench)
    continuations = []
    for between in (
        lambda: None,
        lambda: _moved(bench),
        lambda: bench.command(bench.q, 0.1, 2),
        lambda: bench.reset(bench.ready - 0.2, 0.1),
    ):
        between()
        bench.states.restore(state)
        continuations.append([bench.digest(images=True), *bench.continuation()])
    for continuation in continuations[1:]:
        assert continuation == continuations[0]


def test_a_saved_state_continues_identically_in_another_instance(
    bench: Bench, another: Make
) -> None:
    """Made later, with another past."""
    bench.needs(SavesStates)
    bench.relies_on_repeating()
    state = _pressing(bench)
    bench.states.restore(state)
    expected = bench.continuation()
    other = another()
    other.command(other.ready + 0.1, 0.2, 2)
    other.states.restore(state)
    assert other.continuation() == expected


def test_a_saved_state_continues_identically_in_a_new_process(bench: Bench, tmp_path: Path) -> None:
    """The bytes hold all that is needed: no handle, file name or address of this process."""
    bench.needs(SavesStates)
    bench.relies_on_repeating()
    state = _pressing(bench)
    bench.states.restore(state)
    expected = bench.continuation()
    path = tmp_path / "state"
    path.write_bytes(state)
    name = continue_in_new_process.__name__
    code = f"import sys; from {Bench.__module__} import {name}; {name}(*sys.argv[1:])"
    result = subprocess.run(
        [sys.executable, "-c", code, bench.backend_name, bench.robot_name, str(path)],
        capture_output=True,
        text=True,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))},
    )
    assert result.returncode == 0, result.stderr
    assert json.loads(result.stdout.splitlines()[-1]) == expected


@pytest.mark.parametrize("doing", ["moving", "pressing"])
def test_a_second_after_a_restore_the_robot_is_where_it_would_have_been(
    bench: Bench, doing: str
) -> None:
    """Within the declared drift of the motion that was not interrupted, all the time."""
    bench.needs(SavesStates)
    bench.relies_on_repeating()

    def second() -> list[np.ndarray]:
        poses = []
        for i in range(bench.hz):
            bench.command(start + (0.003 * i if doing == "moving" else 0.0))
            poses.append(bench.see().T_world_tool)
        return poses

    if doing == "pressing":
        bench.lower_stick(-0.002)
    else:
        bench.command(bench.ready + 0.003, periods=2)
    start = bench.q
    state = bench.states.save()
    live = second()
    bench.states.restore(state)
    declared = bench.states
    for T_live, T in zip(live, second(), strict=True):
        assert np.linalg.norm(T[:3, 3] - T_live[:3, 3]) <= declared.drift + 1e-9
        angle = np.rad2deg(angle_between(T[:3, :3], T_live[:3, :3]))
        assert angle <= declared.drift_deg + 1e-6


# --- what is no state ---------------------------------------------------------------------------


@pytest.mark.parametrize(
    "damage",
    [
        pytest.param(lambda state: b"", id="empty"),
        pytest.param(lambda state: b"a\nb\nc", id="something else"),
        pytest.param(lambda state: state[: len(state) // 2], id="cut in half"),
        pytest.param(lambda state: state[:-1], id="last byte gone"),
    ],
)
def test_a_damaged_state_is_refused_and_changes_nothing(
    bench: Bench, damage: Callable[[bytes], bytes]
) -> None:
    """With a BrokenFile that says so, before anything is moved."""
    bench.needs(SavesStates)
    state = bench.states.save()
    bench.command(bench.ready + 0.02, 0.8, 3)
    before = bench.digest()
    with pytest.raises(BrokenFile, match="saved state"):
        bench.states.restore(damage(state))
    assert bench.digest() == before


def test_a_state_with_any_changed_bit_is_refused(bench: Bench) -> None:
    """A checksum does it; `backends.states` has one."""
    bench.needs(SavesStates)
    state = bench.states.save()
    rng = np.random.default_rng(0)
    # Half of the flips near the front, where a header would be.
    places = [*rng.integers(min(400, len(state)), size=40), *rng.integers(len(state), size=40)]
    for place in places:
        damaged = bytearray(state)
        damaged[place] ^= 1 << int(rng.integers(8))
        with pytest.raises(BrokenFile, match="saved state"):
            bench.states.restore(bytes(damaged))


def _with_taller_block(scene: SceneSpec) -> SceneSpec:
    table, block = scene.bodies
    taller = Body("block", (Shape("box", (0.06, 0.06, 0.08)),), block.T_world_body)
    return SceneSpec((table, taller), scene.held, scene.cameras)


@pytest.mark.parametrize(
    "change",
    [
        pytest.param(lambda s: SceneSpec(s.bodies[:1], s.held, s.cameras), id="a body fewer"),
        pytest.param(lambda s: SceneSpec(s.bodies, (), s.cameras), id="nothing held"),
        pytest.param(_with_taller_block, id="a body of another shape"),
    ],
)
def test_a_state_of_another_scene_is_refused_and_changes_nothing(
    bench: Bench, another: Make, change: Callable[[SceneSpec], SceneSpec]
) -> None:
    """Its numbers would fit, which is why the bytes must say what they are of."""
    bench.needs(SavesStates)
    other = another(change(bench.scene))
    other.reset(other.ready + 0.1)
    before = other.digest()
    with pytest.raises(BrokenFile, match="saved state"):
        other.states.restore(bench.states.save())
    assert other.digest() == before
