"""Radii from recorded images alone: never much larger than those from the true scene."""

import dataclasses

import numpy as np
import pytest

from sart_toolkit.annotate.suggest import (
    SuggestConfig,
    suggest_annotation,
    suggest_radius,
)
from sart_toolkit.backends import make_backend
from sart_toolkit.collision import cloud_world
from sart_toolkit.collision.cloud import CloudConfig
from sart_toolkit.collision.cloud_world import CloudWorld
from sart_toolkit.collision.exact import ExactWorld
from sart_toolkit.collision.phases import IN_GRASP_SLIP
from sart_toolkit.errors import InvalidInput, MotionRejected
from sart_toolkit.motion.path import PolylinePath
from sart_toolkit.poses import pose
from sart_toolkit.record.scripted import ScriptedOperator
from sart_toolkit.record.session import record_demonstration
from sart_toolkit.robots import get_robot
from sart_toolkit.robots.model import RobotModel
from sart_toolkit.tasks import get_task
from sart_toolkit.tasks.task import Placement

# So small a radius counts too, where the two are compared.
FINE = SuggestConfig(min_radius=0.0005)


class Shown:
    """A demonstration of a task and its world, exact and as seen."""

    def __init__(self, name):
        self.task = get_task(name)
        self.robot = get_robot(self.task.robot)
        backend = make_backend("pybullet", self.robot, self.task.scene, 128)
        model = RobotModel(self.robot, self.task.scene.held)
        plan = self.task.plan(self.task.initial_state(model, Placement()))
        self.demonstration = record_demonstration(
            backend, self.task, model, ScriptedOperator(plan, np.random.default_rng(0)), seed=0
        )
        backend.close()
        self.exact = ExactWorld(self.demonstration, self.robot, self.task.scene)
        self.cloud = CloudWorld(self.demonstration, self.robot, self.task.scene)


@pytest.fixture(scope="module")
def peg():
    return Shown("peg_in_hole")


@pytest.fixture(scope="module")
def toolbox():
    return Shown("toolbox_picking")


@pytest.mark.parametrize("name", ["peg", "toolbox"])
def test_radii_are_no_larger_than_the_exact_ones_by_2_mm_and_mostly_nearly_as_large(name, request):
    demo = request.getfixturevalue(name)
    ratios = []
    for sphere in suggest_annotation(demo.demonstration, demo.exact).spheres:
        exact = suggest_radius(demo.exact, demo.demonstration, sphere.waypoint, FINE)
        seen = suggest_radius(demo.cloud, demo.demonstration, sphere.waypoint, FINE)
        assert seen.radius <= exact.radius + 0.002, sphere
        ratios.append(seen.radius / exact.radius)
    assert np.median(ratios) >= 0.5 and ratios[0] > 0.9


def test_spheres_from_the_cloud_tile_the_demonstration_and_say_what_limits_them(toolbox):
    annotation = suggest_annotation(toolbox.demonstration, toolbox.cloud)
    annotation.check_matches(toolbox.demonstration)
    grasping = [bool(toolbox.cloud.phases[s.waypoint].grasped) for s in annotation.spheres]
    assert not grasping[0] and grasping[-1]
    reasons = {sphere.limited_by for sphere in annotation.spheres}
    assert any(reason.endswith("/ cloud") for reason in reasons)
    assert any("gripper command" in reason for reason in reasons)
    assert any(reason.startswith("grasped object") for reason in reasons)


def test_what_was_lifted_reaches_down_to_where_it_stood(toolbox):
    """Its underside was never seen; the clearance above the table still counts from there."""
    heights = toolbox.demonstration.body_Ts_world["toolbox"][:, 2, 3]
    rest = heights[0]
    last = len(toolbox.demonstration) - 3
    rigid = CloudWorld(toolbox.demonstration, toolbox.robot, toolbox.task.scene, slip_tolerance=0.0)
    found = suggest_radius(rigid, toolbox.demonstration, last)
    loose = suggest_radius(toolbox.cloud, toolbox.demonstration, last)
    assert found.clearance == pytest.approx(loose.clearance + IN_GRASP_SLIP, abs=2e-6)
    lifted = heights[last] - rest
    assert found.clearance == pytest.approx(lifted, abs=0.008)
    assert found.clearance < lifted + 0.002


def test_where_the_true_bodies_are_makes_no_difference(peg):
    """Nothing of the simulated scene but what was seen is used."""
    far = {k: T @ pose([0, 0, -5]) for k, T in peg.demonstration.body_Ts_world.items()}
    blind = dataclasses.replace(peg.demonstration, body_Ts_world=far)
    elsewhere = CloudWorld(blind, peg.robot, peg.task.scene)
    for t in (0, 26):
        assert suggest_radius(elsewhere, blind, t) == suggest_radius(
            peg.cloud, peg.demonstration, t
        )


def test_space_that_was_not_seen_may_be_taken_as_free(peg):
    free = CloudWorld(
        peg.demonstration, peg.robot, peg.task.scene, config=CloudConfig(unknown="free")
    )
    for t in (0, 26, 34):
        larger = suggest_radius(free, peg.demonstration, t, FINE).radius
        assert larger >= suggest_radius(peg.cloud, peg.demonstration, t, FINE).radius - 1e-9


def test_without_depth_there_is_no_cloud(peg):
    steps = dataclasses.replace(peg.demonstration.steps, cameras={})
    blind = dataclasses.replace(peg.demonstration, steps=steps)
    world = CloudWorld(blind, peg.robot, peg.task.scene)
    with pytest.raises(InvalidInput, match="camera"):
        suggest_radius(world, blind, 0)


def test_a_shape_that_was_seen_at_another_time_of_the_same_grasp_counts_too(toolbox):
    """While it still touches the table the tool hasn't moved enough to tell it from the table."""
    phases = toolbox.cloud.phases
    first = next(t for t, phase in enumerate(phases) if phase.grasped)
    lifted = next(t for t in range(first, len(phases)) if not phases[t].contacts)
    assert phases[first].contacts and phases[first].grasped == phases[lifted].grasped
    shapes = []
    for t in (first, lifted + 3):
        assert toolbox.cloud.unknown(t) is None
        (part,) = [p for p in toolbox.cloud.placed(t).parts if p.body == "grasped object"]
        shapes.append(part.points)
    np.testing.assert_allclose(*shapes)


def test_nothing_is_proved_of_a_grasp_whose_object_was_never_seen(toolbox, monkeypatch):
    monkeypatch.setattr(cloud_world, "grasped_object", lambda *args: None)
    world = CloudWorld(toolbox.demonstration, toolbox.robot, toolbox.task.scene)
    last = len(world.phases) - 3
    assert world.unknown(0) is None and world.phases[last].grasped
    found = suggest_radius(world, toolbox.demonstration, last)
    assert (found.radius, found.limited_by) == (0.0, "grasped object not seen")
    path = PolylinePath(toolbox.demonstration.steps.joint_positions[last : last + 2])
    with pytest.raises(MotionRejected, match="grasped object not seen: nothing can be proved at w"):
        world.certify(last, path)
    assert world.certify(0, PolylinePath(world.demonstration.steps.joint_positions[:3]))
