"""A backend's abilities, its instances, and what it refuses."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from sart_toolkit.backends import get_backend
from sart_toolkit.backends.interface import (
    Draws,
    KnowsBodies,
    Resets,
    SavesStates,
    SensesContacts,
)
from sart_toolkit.data.records import Rates
from sart_toolkit.errors import InvalidInput, MissingCapability, UnknownName
from sart_toolkit.poses import Array, pose
from sart_toolkit.scenes.spec import Body, SceneSpec, SceneState
from sart_toolkit.testing.bench import ABILITIES, Bench

Make = Callable[..., Bench]


def test_name_and_abilities_are_known_before_connecting(target: tuple[str, str]) -> None:
    """They are the class's own."""
    backend = get_backend(target[0])
    assert isinstance(backend.name, str)
    if issubclass(backend, SavesStates):
        # Radii around a waypoint are not much larger.
        assert 0.0 <= backend.drift <= 1e-3
        assert 0.0 <= backend.drift_deg <= 0.2


def test_rates_are_those_asked_for(bench: Bench) -> None:
    """A backend is made for rates, and keeps to them."""
    rates = Rates(physics_hz=180, control_hz=60, record_hz=15)
    start = bench.see().time
    bench.wait(1 / bench.hz)
    right = bench.see().time - start == pytest.approx(1 / bench.hz, abs=1e-9)
    bench.relies_on(right, "test_a_step_advances_time_by_one_control_period")
    made = get_backend(bench.backend_name)(bench.backend.robot, bench.scene, 16, rates)
    assert made.rates == rates
    before = made.observe()
    made.command(before.q, float(np.clip(before.gripper, 0, 1)))
    made.step()
    assert made.observe().time - before.time == pytest.approx(1 / 60, abs=1e-9)
    made.close()


@pytest.mark.parametrize("ability", ABILITIES, ids=[ability.__name__ for ability in ABILITIES])
def test_an_ability_that_a_backend_has_works(bench: Bench, ability: type) -> None:
    """One that isn't there would be found out in the middle of a run."""
    if ability is Draws and bench.backend.no_images:
        pytest.skip(f"backend {bench.backend.name!r} lacks images: {bench.backend.no_images}")
    if isinstance(bench.backend, ability):
        assert bench.does(ability)


def test_a_backend_takes_images_or_says_why_not(bench: Bench) -> None:
    """With MissingCapability: nothing is silently left out."""
    if not bench.backend.no_images:
        assert bench.takes_images()
        return
    with pytest.raises(MissingCapability, match="takes no images"):
        bench.see((next(iter(bench.backend.cameras)),), 8)


def test_the_bodies_observed_are_those_that_a_backend_knows(bench: Bench) -> None:
    """All of the scene and all that is held; none where it knows of none."""
    seen = bench.see().Ts_world_body
    if not isinstance(bench.backend, KnowsBodies):
        assert not seen
        return
    bench.relies_on(bench.has(KnowsBodies), "test_an_ability_that_a_backend_has_works")
    names = [body.name for body in bench.scene.bodies] + [body.name for body in bench.scene.held]
    assert set(seen) == set(names)


# --- instances ----------------------------------------------------------------------------------


def test_two_instances_do_the_same(bench: Bench, another: Make) -> None:
    """Nothing depends on which was made first."""
    bench.relies_on_repeating()
    assert another().continuation() == bench.continuation()


def test_two_instances_are_independent(bench: Bench, another: Make) -> None:
    """What one is commanded and does, the other doesn't notice."""
    bench.relies_on_repeating()
    expected = bench.continuation()
    bench.reset()
    other = another()
    seen = []
    for i in range(1, 7):
        offset = 0.004 * i * np.cos(np.arange(len(bench.ready)))
        bench.backend.command(bench.ready + offset, bench.gripper + 0.01 * i)
        other.backend.command(other.ready - 0.05, 0.1)
        bench.backend.step()
        touched = bench.contacts() if bench.has(SensesContacts) else []
        other.backend.step()
        seen.append(f"{bench.digest(images=i == 6)} {touched}")
    assert seen == expected


def test_closing_twice_does_nothing(bench: Bench) -> None:
    """So that a `finally` may close what was closed."""
    before = bench.digest()
    made = get_backend(bench.backend_name)(bench.backend.robot, bench.scene, 16)
    made.close()
    made.close()
    assert bench.digest() == before


def test_closing_one_instance_leaves_others_alone(bench: Bench) -> None:
    """Neither the first close nor the second reaches somebody else's simulator."""
    make = get_backend(bench.backend_name)
    made, kept = (make(bench.backend.robot, bench.scene, 16) for _ in range(2))
    if isinstance(kept, Resets):
        kept.reset(bench.state())
    made.close()
    kept.step()
    assert np.isfinite(kept.observe().T_world_tool).all()
    kept.close()


# --- refused ------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("q", "gripper"),
    [
        pytest.param(lambda q: q[:-1], 0.5, id="a joint fewer"),
        pytest.param(lambda q: np.append(q, 0.0), 0.5, id="a joint more"),
        pytest.param(lambda q: q * np.nan, 0.5, id="no numbers"),
        pytest.param(lambda q: q + 100.0, 0.5, id="above the limits"),
        pytest.param(lambda q: q - 100.0, 0.5, id="below the limits"),
        pytest.param(lambda q: q, -0.01, id="gripper below 0"),
        pytest.param(lambda q: q, 1.01, id="gripper above 1"),
        pytest.param(lambda q: q, np.nan, id="gripper no number"),
    ],
)
def test_a_bad_command_is_refused_and_changes_nothing(
    bench: Bench, q: Callable[[Array], Array], gripper: float
) -> None:
    """Not clipped to something else, and the last good command stays in force."""
    with pytest.raises(InvalidInput):
        bench.backend.command(q(bench.ready), gripper)
    bench.relies_on_repeating()
    bench.backend.command(bench.ready + 0.01, 0.6)
    bench.wait(0.1)
    expected = bench.digest()
    bench.reset()
    bench.backend.command(bench.ready + 0.01, 0.6)
    with pytest.raises(InvalidInput):
        bench.backend.command(q(bench.ready), gripper)
    bench.wait(0.1)
    assert bench.digest() == expected


def test_a_state_with_impossible_joints_is_refused(bench: Bench) -> None:
    """Of the wrong number or outside their limits."""
    bench.needs(Resets)
    for q in (bench.ready[:-1], bench.ready + 100.0):
        with pytest.raises(InvalidInput):
            bench.resets.reset(bench.state(q))


def test_a_state_needs_exactly_the_bodies_of_the_scene(bench: Bench) -> None:
    """Neither one more nor one fewer."""
    bench.needs(Resets)
    table, block = bench.scene.bodies
    more = SceneSpec((table, block, Body("cup", block.shapes)))
    with pytest.raises(UnknownName, match="'cup'"):
        bench.resets.reset(more.initial_state(bench.ready, 0.5))
    fewer = SceneSpec((block,))
    with pytest.raises(UnknownName, match="'table'"):
        bench.resets.reset(fewer.initial_state(bench.ready, 0.5))


def _off_its_joint(state: SceneState) -> dict[str, Any]:
    T = state.Ts_world_body["drawer"] @ pose([0, 0.01, 0])
    return {"Ts_world_body": {**state.Ts_world_body, "drawer": T}}


def _beyond_its_limit(state: SceneState) -> dict[str, Any]:
    return {"joint_positions": {**state.joint_positions, "drawer": 9.0}}


@pytest.mark.parametrize("change", [_off_its_joint, _beyond_its_limit])
def test_a_state_with_a_body_off_its_joint_is_refused(
    jointed: Bench, change: Callable[[SceneState], dict[str, Any]]
) -> None:
    """A hinge has its body in one place only."""
    state = jointed.state()
    values = {"Ts_world_body": state.Ts_world_body, "joint_positions": state.joint_positions}
    with pytest.raises(InvalidInput, match="'drawer'"):
        jointed.resets.reset(SceneState(state.q, state.gripper, **{**values, **change(state)}))
