"""Phases of a demonstration: what changes between them, and what doesn't count as a change."""

import dataclasses

import numpy as np
import pytest

from sart_toolkit.collision.phases import Phase, demonstration_phases


def test_phases_tell_approach_grasp_and_lift_apart(picked, first_grasp):
    phases, demo = picked.phases, picked.demonstration
    assert len(phases) == len(demo)
    changes = [
        (t, before.change(after))
        for t, (before, after) in enumerate(zip(phases[:-1], phases[1:], strict=True))
        if before != after
    ]
    words = [what for _, what in changes]
    assert words.index("gripper command") < words.index("grasp of toolbox")
    assert words.index("grasp of toolbox") < words.index("contact table / toolbox")
    grasped = first_grasp
    assert all(phase.grasped == {"toolbox"} for phase in phases[grasped:])
    assert all(phase.grasped == frozenset() for phase in phases[:grasped])
    commands = np.round(demo.steps.commanded_gripper, 2)
    np.testing.assert_array_equal([phase.gripper for phase in phases], commands)


def test_what_stands_on_something_else_is_no_contact_of_the_robots(picked, first_grasp):
    # The toolbox stands on the table; only once it is lifted is that a contact.
    grasped = first_grasp
    assert ("table", "toolbox") in picked.demonstration.touching[grasped - 5]
    assert picked.phases[grasped - 5].contacts == frozenset()
    assert {frozenset(pair) for pair in picked.phases[grasped].contacts} == {
        frozenset(("table", "toolbox"))
    }


def test_before_the_first_step_all_is_as_after_it_but_for_the_gripper(picked):
    demo = picked.demonstration
    touched = (("table", "wrist_camera"),)
    changed = dataclasses.replace(
        demo, touching=((), touched, *demo.touching[2:]),
        steps=dataclasses.replace(
            demo.steps,
            commanded_gripper=np.concatenate([[0.25], demo.steps.commanded_gripper[1:]]),
        ),
    )  # fmt: skip
    first, second, *_ = demonstration_phases(
        changed, picked.collision.robot, picked.collision.scene
    )
    assert first.contacts == second.contacts == {("table", "wrist_camera")}
    assert (first.gripper, second.gripper) == (0.25, round(demo.steps.commanded_gripper[1], 2))


def test_a_gripper_command_that_is_hardly_another_is_the_same_phase(picked):
    demo = picked.demonstration
    command = np.tile([0.301, 0.299], len(demo))[: len(demo)]
    changed = dataclasses.replace(
        demo,
        touching=((),) * len(demo),
        steps=dataclasses.replace(demo.steps, commanded_gripper=command),
    )
    phases = demonstration_phases(changed, picked.collision.robot, picked.collision.scene)
    assert set(phases) == {Phase(0.3, frozenset(), frozenset())}


@pytest.mark.parametrize(
    ("after", "what"),
    [
        (Phase(0.6, frozenset({"mug"}), frozenset()), "gripper command"),
        (Phase(0.5, frozenset({"mug", "box"}), frozenset()), "grasp of box, mug"),
        (Phase(0.5, frozenset(), frozenset({("a", "c"), ("a", "b")})), "contact a / b"),
    ],
)
def test_a_change_says_what_changed(after, what):
    before = Phase(0.5, frozenset(), frozenset())
    assert before.change(after) == what
    assert after.change(before) == what
