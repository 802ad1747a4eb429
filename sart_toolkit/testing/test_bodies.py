"""Bodies that move: free ones, and those with a joint."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from sart_toolkit.backends.interface import SavesStates
from sart_toolkit.poses import angle_between, pose
from sart_toolkit.robots.spec import mass_properties
from sart_toolkit.scenes.spec import Body, Joint
from sart_toolkit.testing.bench import Bench
from sart_toolkit.testing.scenes import (
    BRICK_HEIGHT,
    DRAWER_GAP,
    PUSH_HEIGHT,
)

kinds = pytest.mark.parametrize("kind", ["hinge", "slide"])

# --- free ---------------------------------------------------------------------------------------


def _brick(bench: Bench) -> np.ndarray:
    return bench.see().Ts_world_body["brick"]


def _lifted(bench: Bench, height: float) -> dict[str, np.ndarray]:
    """The brick `height` [m] above its place on the table."""
    brick = {body.name: body for body in bench.scene.bodies}["brick"]
    return {"brick": pose([0, 0, height]) @ brick.T_world_body}


def test_reset_puts_free_bodies_where_the_state_says(loose: Bench) -> None:
    """By the body's own frame, which need not be its centre of mass."""
    for height in (0.3, 0.1):
        state = loose.reset(Ts_world_body=_lifted(loose, height))
        for name, T in state.Ts_world_body.items():
            np.testing.assert_allclose(loose.see().Ts_world_body[name], T, rtol=0, atol=1e-6)


def test_a_reset_stops_free_bodies(loose: Bench) -> None:
    """Everything is at rest in a state."""
    loose.reset(Ts_world_body=_lifted(loose, 0.5))
    loose.wait(0.3)
    loose.reset(Ts_world_body=_lifted(loose, 0.5))
    top = _brick(loose)[2, 3]
    loose.wait(1 / loose.hz)
    assert top - _brick(loose)[2, 3] < 0.02


def test_a_free_body_stays_where_it_rests(loose: Bench) -> None:
    """It neither creeps, sinks nor jumps."""
    before = _brick(loose)
    loose.wait(1.0)
    assert np.linalg.norm(_brick(loose)[:3, 3] - before[:3, 3]) < 1e-3
    assert angle_between(_brick(loose)[:3, :3], before[:3, :3]) < np.deg2rad(0.5)


def test_a_free_body_falls_as_gravity_says(loose: Bench) -> None:
    """By g t²/2, without damping."""
    loose.reset(Ts_world_body=_lifted(loose, 0.6))
    top = _brick(loose)[2, 3]
    loose.wait(0.3)
    assert top - _brick(loose)[2, 3] == pytest.approx(9.81 * 0.3**2 / 2, rel=0.04)


def test_a_falling_body_lands_on_what_is_below(loose: Bench) -> None:
    """By its shape."""
    loose.reset(Ts_world_body=_lifted(loose, 0.05))
    loose.wait(1.5)
    assert _brick(loose)[2, 3] == pytest.approx(BRICK_HEIGHT / 2, abs=1e-3)


def test_restore_returns_free_bodies(loose: Bench) -> None:
    """Exactly, in their fall."""
    loose.needs(SavesStates)
    loose.reset(Ts_world_body=_lifted(loose, 0.3))
    loose.wait(0.1)
    before, state = _brick(loose), loose.states.save()
    loose.wait(0.3)
    loose.states.restore(state)
    np.testing.assert_array_equal(_brick(loose), before)


def test_a_falling_body_keeps_falling_after_a_restore(loose: Bench) -> None:
    """Velocities are part of the state."""
    loose.needs(SavesStates)
    loose.reset(Ts_world_body=_lifted(loose, 0.5))
    loose.wait(0.2)
    before, state = _brick(loose), loose.states.save()
    loose.wait(0.1)
    live = _brick(loose)
    loose.reset()
    loose.states.restore(state)
    loose.relies_on((_brick(loose) == before).all(), "test_restore_returns_free_bodies")
    loose.wait(0.1)
    np.testing.assert_allclose(_brick(loose), live, rtol=0, atol=2e-3)


def test_a_second_after_a_restore_resting_bodies_are_where_they_would_have_been(
    loose: Bench,
) -> None:
    """Within the declared drift, all the time."""
    loose.needs(SavesStates)
    loose.relies_on_repeating()

    def second() -> list[dict[str, np.ndarray]]:
        seen = []
        for i in range(loose.hz):
            loose.command(loose.ready + 0.002 * i)
            seen.append(dict(loose.see().Ts_world_body))
        return seen

    loose.wait(0.5)
    before, state = _brick(loose), loose.states.save()
    live = second()
    loose.states.restore(state)
    loose.relies_on((_brick(loose) == before).all(), "test_restore_returns_free_bodies")
    declared = loose.states
    for Ts_live, Ts in zip(live, second(), strict=True):
        for name in ("peg", "brick"):
            T, T_live = Ts[name], Ts_live[name]
            assert np.linalg.norm(T[:3, 3] - T_live[:3, 3]) <= declared.drift + 1e-9
            angle = np.rad2deg(angle_between(T[:3, :3], T_live[:3, :3]))
            assert angle <= declared.drift_deg + 1e-6


def test_what_happens_to_free_bodies_after_a_reset_depends_on_the_state_alone(
    bench: Bench, loose: Bench
) -> None:
    """To the bit: a solver remembers the forces of contacts that last."""
    bench.relies_on_repeating()
    expected = loose.continuation()
    loose.wait(0.2)
    loose.reset()
    assert loose.continuation() == expected


def test_what_happens_to_free_bodies_after_a_restore_depends_on_the_saved_state_alone(
    loose: Bench,
) -> None:
    """To the bit: a bouncing brick bounces in the same way each time."""
    loose.needs(SavesStates)
    loose.relies_on_repeating()
    loose.reset(Ts_world_body=_lifted(loose, 0.05))
    loose.wait(0.1)
    before, state = _brick(loose), loose.states.save()
    seen = []
    histories: tuple[Callable[[], object], ...] = (lambda: loose.wait(0.3), loose.reset)
    for between in histories:
        between()
        loose.states.restore(state)
        loose.relies_on((_brick(loose) == before).all(), "test_restore_returns_free_bodies")
        seen.append(loose.continuation(12))
    assert seen[1] == seen[0]


# --- with a joint -------------------------------------------------------------------------------


def _path(bench: Bench, name: str, start: float, seconds: float) -> np.ndarray:
    """The positions of a joint that starts at rest, at each control period, the first included."""
    bench.reset(bench.ready, joint_positions={name: start})
    found = [bench.positions()[name]]
    for _ in range(round(seconds * bench.hz)):
        bench.wait(1 / bench.hz)
        found.append(bench.positions()[name])
    return np.array(found)


def _jointed_body(bench: Bench, name: str) -> tuple[Body, Joint]:
    body = bench.scene.jointed[name]
    assert body.joint is not None
    return body, body.joint


def _inertia(bench: Bench, name: str) -> float:
    """What resists the joint: kg m² about a hinge's axis, kg along a slide's."""
    body, joint = _jointed_body(bench, name)
    assert body.mass is not None
    if joint.kind == "prismatic":
        return body.mass
    centre, inertia = mass_properties(body.shapes, body.mass)
    arm = np.cross(joint.axis, centre)
    return float(joint.axis @ inertia @ joint.axis + body.mass * arm @ arm)


def test_reset_puts_jointed_bodies_where_the_state_says(jointed: Bench) -> None:
    """At the joint positions, and so their poses."""
    rng = np.random.default_rng(3)
    for _ in range(2):
        positions = {
            name: float(rng.uniform(body.joint.lower, body.joint.upper))
            for name, body in jointed.scene.jointed.items()
            if body.joint is not None
        }
        state = jointed.reset(joint_positions=positions)
        for name, T in state.Ts_world_body.items():
            seen = jointed.see().Ts_world_body[name]
            np.testing.assert_allclose(seen, T, rtol=0, atol=1e-5)


@kinds
def test_jointed_bodies_stay_within_their_limits(jointed: Bench, kind: str) -> None:
    """One that falls against its limit comes to rest there."""
    _, joint = _jointed_body(jointed, f"free_{kind}")
    path = _path(jointed, f"free_{kind}", 0.0, 1.5)
    assert path.max() < joint.upper + 0.01 * (joint.upper - joint.lower)
    assert path[-1] == pytest.approx(joint.upper, abs=0.02)


@kinds
def test_dry_friction_holds_against_less(jointed: Bench, kind: str) -> None:
    """10 % more friction than the weight asks for, and the body stays for a second."""
    assert np.abs(_path(jointed, f"held_{kind}", 0.0, 1.0)).max() < 5e-3


@kinds
def test_dry_friction_gives_way_to_more(jointed: Bench, kind: str) -> None:
    """10 % less, and it goes; a slide as fast as the difference lets it."""
    path = _path(jointed, f"slipping_{kind}", 0.0, 0.5)
    assert path[-1] > 0.05


@kinds
def test_a_spring_pulls_with_its_stiffness(jointed: Bench, kind: str) -> None:
    """From rest to the spring's rest position takes a quarter of sqrt(inertia / stiffness) 2 pi."""
    _, joint = _jointed_body(jointed, f"sprung_{kind}")
    quarter = np.pi / 2 * np.sqrt(_inertia(jointed, f"sprung_{kind}") / joint.stiffness)
    start = joint.rest - 0.3 * (joint.rest - joint.lower)
    path = _path(jointed, f"sprung_{kind}", start, 2 * quarter) - joint.rest
    assert (path >= 0).any(), "it never comes to the rest position"
    after = int(np.argmax(path >= 0))
    crossed = after - path[after] / (path[after] - path[after - 1])
    assert crossed / jointed.hz == pytest.approx(quarter, rel=0.1)


@kinds
def test_a_detent_draws_in_from_its_nearer_half(jointed: Bench, kind: str) -> None:
    """And so holds what is in it: the body stays about the catch."""
    _, joint = _jointed_body(jointed, f"caught_{kind}")
    assert joint.detent is not None
    x = 0.25 * joint.detent.width
    path = _path(jointed, f"caught_{kind}", joint.detent.position + x, 1.0) - joint.detent.position
    assert path.min() < 0, "it is not drawn in"
    assert np.abs(path).max() < 1.1 * x, "it is not kept"


@kinds
def test_a_detent_pushes_out_from_its_farther_half(jointed: Bench, kind: str) -> None:
    """And leaves alone what is out of its width."""
    _, joint = _jointed_body(jointed, f"caught_{kind}")
    detent = joint.detent
    assert detent is not None
    path = _path(jointed, f"caught_{kind}", detent.position + 0.7 * detent.width, 1.0)
    assert path.max() > detent.position + detent.width, "it is not pushed out"
    outside = detent.position + 1.2 * detent.width
    path = _path(jointed, f"caught_{kind}", outside, 0.3)
    assert np.abs(path - outside).max() < 1e-3, "it acts beyond its width"


def test_the_tool_pushes_a_jointed_body(jointed: Bench) -> None:
    """By contact, as far as the tool goes."""
    jointed.reset(jointed.joints_at([0, 0, PUSH_HEIGHT]))
    jointed.move_tool([DRAWER_GAP + 0.05, 0, PUSH_HEIGHT], 40)
    assert jointed.positions()["drawer"] > 0.05 - 3e-3


def test_restore_returns_jointed_bodies(jointed: Bench) -> None:
    """Exactly, in their swing."""
    jointed.needs(SavesStates)
    jointed.wait(0.2)
    before, state = jointed.positions(), jointed.states.save()
    jointed.wait(0.3)
    jointed.states.restore(state)
    assert jointed.positions() == before


def test_a_swinging_body_keeps_swinging_after_a_restore(jointed: Bench) -> None:
    """Joint velocities are part of the state."""
    jointed.needs(SavesStates)
    jointed.wait(0.3)
    before, state = jointed.positions(), jointed.states.save()
    jointed.wait(0.1)
    live = jointed.positions()
    jointed.reset()
    jointed.states.restore(state)
    jointed.relies_on(jointed.positions() == before, "test_restore_returns_jointed_bodies")
    jointed.wait(0.1)
    assert jointed.positions() == pytest.approx(live, abs=0.005)
