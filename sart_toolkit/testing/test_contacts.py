"""Contact is reported when and only when bodies touch."""

from __future__ import annotations

import numpy as np
import pytest

from sart_toolkit.backends.interface import Contact, Resets, SavesStates, SensesContacts
from sart_toolkit.collision.model import CollisionModel
from sart_toolkit.poses import pose
from sart_toolkit.testing.bench import Bench
from sart_toolkit.testing.scenes import BRICK_HEIGHT, PUSH_HEIGHT

_STICK_ON_BLOCK = ("block", "stick")


@pytest.fixture
def touch(bench: Bench) -> Bench:
    """The plain scene on a backend that reports contacts."""
    bench.needs(SensesContacts)
    return bench


def _pairs(contacts: list[Contact]) -> list[tuple[str, str]]:
    return [(contact.a, contact.b) for contact in contacts]


def _moving(bench: Bench, contacts: list[Contact]) -> list[tuple[str, str]]:
    """The pairs of which one at least can move, in the plain scene."""
    frames = bench.model.pinocchio_model.frames
    still = {body.name for body in bench.scene.bodies}
    still |= {frame.name for frame in frames if frame.parentJoint == 0}
    return [pair for pair in _pairs(contacts) if not still.issuperset(pair)]


def _force(contacts: list[Contact], pair: tuple[str, str]) -> float:
    return max((c.force for c in contacts if (c.a, c.b) == pair), default=0.0)


def test_nothing_touches_in_free_space(touch: Bench) -> None:
    """Though the arm stands on the table, a block stands there, and fingers hold a stick."""
    for contacts in touch.lower_stick(0.05):
        assert not _moving(touch, contacts)


def test_contact_is_reported_when_bodies_touch(touch: Bench) -> None:
    """The stick held in the gripper presses on the block, by its name and the block's."""
    steps = touch.lower_stick(-0.002)
    # A stiff arm on a stiff block may bounce.
    for _ in range(10):
        touch.backend.step()
        steps.append(touch.contacts())
    assert any(_force(contacts, _STICK_ON_BLOCK) > 1.0 for contacts in steps[-12:])


def test_contact_is_not_reported_a_millimetre_before(touch: Bench) -> None:
    """A margin within which a simulator starts checking is no contact."""
    for contacts in touch.lower_stick(0.001):
        assert _STICK_ON_BLOCK not in _pairs(contacts)


def test_contacts_are_those_of_the_last_step(touch: Bench) -> None:
    """Not all since the reset."""
    touch.lower_stick(-0.002)
    touch.lower_stick(0.05)
    assert _STICK_ON_BLOCK not in _pairs(touch.contacts())


def test_nothing_has_touched_after_a_reset(touch: Bench) -> None:
    """Contacts are those of the last step, and there was none."""
    touch.needs(Resets)
    touch.lower_stick(-0.002)
    touch.reset()
    assert touch.contacts() == []


def test_nothing_has_touched_after_a_restore(touch: Bench) -> None:
    """Even if the state was saved in contact."""
    touch.needs(SavesStates)
    touch.lower_stick(-0.002)
    touch.states.restore(touch.states.save())
    assert touch.contacts() == []


def test_contacts_agree_with_the_geometry(touch: Bench) -> None:
    """Anywhere: with the scene, and of the tool with the arm."""
    touch.relies_on_contacts()
    touch.wait(0.1)
    touch.relies_on(not _moving(touch, touch.contacts()), "test_nothing_touches_in_free_space")
    model, n = touch.model, len(touch.ready)
    placed = CollisionModel(model.spec, touch.scene).placed(
        touch.state().Ts_world_body, touch.gripper
    )
    # Of the robot itself, a backend need only see the tool touch the arm, the wrist left out.
    joints = [[placed.parts[i].joint for i in pair] for pair in placed.pairs]
    bodies = {body.name for body in touch.scene.bodies}
    seen = [
        k
        for k, (a, b) in enumerate(joints)
        if placed.names(k)[1] in bodies or (a == n and b <= n - 3)
    ]
    rng = np.random.default_rng(0)
    kinds = set()
    for _ in range(24):
        q = touch.ready + rng.uniform(-1.2, 1.2, len(touch.ready))
        if ((q < model.lower) | (q > model.upper)).any():
            continue
        nearest = min(placed.pair_distances(q, seen))
        if abs(nearest) < 0.008:
            continue
        touch.reset(q)
        touch.command(q)
        touched = _moving(touch, touch.contacts())
        assert bool(touched) == (nearest < 0), (nearest, touched)
        kinds.add(bool(touched))
    assert kinds == {False, True}


def test_contacts_are_in_order_of_their_names(touch: Bench, loose: Bench) -> None:
    """Within a pair and in the list, each pair once."""
    loose.reset(Ts_world_body={"brick": _brick_at_post(loose)})
    loose.wait(0.5)
    pairs = _pairs(loose.contacts())
    touch.relies_on_contacts()
    assert all(a < b for a, b in pairs)
    assert pairs == sorted(set(pairs))


def _brick_at_post(bench: Bench) -> np.ndarray:
    """On the table and against the post."""
    x = 0.01 + BRICK_HEIGHT / 2
    return bench.scene.bodies[1].T_world_body @ pose([x, 0, BRICK_HEIGHT / 2])


def test_a_free_body_touches_what_it_stands_on(touch: Bench, loose: Bench) -> None:
    """Pairs of scene bodies count where one of them can move."""
    touch.relies_on_contacts()
    loose.wait(0.2)
    assert {("brick", "table"), ("peg", "post")} <= set(_pairs(loose.contacts()))


def test_contact_forces_are_in_newtons(touch: Bench, loose: Bench) -> None:
    """A brick at rest presses with its weight."""
    loose.wait(1.0)
    contacts = loose.contacts()
    pair = ("brick", "table")
    loose.relies_on(pair in _pairs(contacts), "test_a_free_body_touches_what_it_stands_on")
    assert _force(contacts, pair) == pytest.approx(0.2 * 9.81, rel=0.3)


def test_penetration_is_in_metres_and_not_negative(touch: Bench) -> None:
    """2 mm are pressed for, and the arm gives way to some of it."""
    steps = touch.lower_stick(-0.002)
    assert all(0.0 <= c.penetration < 0.003 for contacts in steps for c in contacts)


def test_bodies_that_never_move_do_not_touch(touch: Bench) -> None:
    """The block on the table, the robot's base on it."""
    for contacts in touch.lower_stick(-0.001):
        assert set(_pairs(contacts)) == set(_moving(touch, contacts))


def test_a_jointed_body_does_not_touch_what_it_moves_on(jointed: Bench) -> None:
    """Though it overlaps it, moves and is pushed."""
    jointed.reset(jointed.joints_at([0, 0, PUSH_HEIGHT]))
    for contacts in jointed.move_tool([0.05, 0, PUSH_HEIGHT], 30):
        assert ("drawer", "rail") not in _pairs(contacts)


def test_a_jointed_body_touches_what_pushes_it(touch: Bench, jointed: Bench) -> None:
    """Pairs of a robot's body and one with a joint count."""
    touch.relies_on_contacts()
    jointed.reset(jointed.joints_at([0, 0, PUSH_HEIGHT]))
    steps = jointed.move_tool([0.05, 0, PUSH_HEIGHT], 30)
    assert any(("drawer", "stick") in _pairs(contacts) for contacts in steps)
