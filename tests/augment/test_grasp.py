"""A demonstration with a grasp: what is grasped counts as the robot's from then on."""

import dataclasses

import numpy as np
import pytest

from sart_toolkit.annotate.suggest import suggest_annotation
from sart_toolkit.augment.config import AugmentConfig
from sart_toolkit.augment.execution import DisturbanceCheck
from sart_toolkit.augment.executors import RestoreExecutor
from sart_toolkit.backends import BACKENDS, make_backend
from sart_toolkit.backends.interface import Observation
from sart_toolkit.collision.exact import ExactWorld
from sart_toolkit.collision.phases import BODY_STILLNESS
from sart_toolkit.data.manifest import KEPT, AttemptKey
from sart_toolkit.data.records import Annotation, PrecisionSphere, convergence_waypoint
from sart_toolkit.data.storage import load_demonstration, save_demonstration
from sart_toolkit.errors import InvalidInput, MotionRejected
from sart_toolkit.poses import pose
from sart_toolkit.record.scripted import ScriptedOperator
from sart_toolkit.record.session import record_demonstration
from sart_toolkit.robots import get_robot
from sart_toolkit.robots.model import RobotModel
from sart_toolkit.tasks import get_task
from sart_toolkit.tasks.task import Placement


@pytest.fixture(scope="module")
def task():
    return get_task("toolbox_picking")


@pytest.fixture(scope="module")
def model(task):
    return RobotModel(get_robot(task.robot))


@pytest.fixture(scope="module", params=BACKENDS)
def backend(request, task):
    backend = make_backend(request.param, get_robot(task.robot), task.scene, 16)
    yield backend
    backend.close()


@pytest.fixture(scope="module")
def demo(task, model, backend):
    operator = ScriptedOperator(
        task.plan(task.initial_state(model, Placement())), np.random.default_rng(0)
    )
    return record_demonstration(backend, task, model, operator, seed=0)


@pytest.fixture(scope="module")
def grasped_at(task, model, demo):
    fingers = model.spec.gripper.finger_links
    return [task.scene.grasped(touching, fingers) for touching in demo.touching]


@pytest.fixture(scope="module")
def world(task, model, demo):
    return ExactWorld(demo, model.spec, task.scene)


@pytest.fixture(scope="module")
def annotation(demo, world):
    return suggest_annotation(demo, world)


def sphere_at(demo, t, radius):
    sphere = PrecisionSphere(t, demo.steps.measured_Ts_world_tool[t], radius)
    return Annotation((sphere,), demo.content_hash())


def test_a_demonstration_keeps_what_touched_and_so_when_it_was_grasped(demo, grasped_at, tmp_path):
    first = grasped_at.index({"toolbox"})
    assert 10 < first < len(demo) - 10
    assert all(grasped == {"toolbox"} for grasped in grasped_at[first + 1 :])
    assert ("table", "toolbox") in demo.touching[1]
    assert ("table", "toolbox") not in demo.touching[-1]
    save_demonstration(tmp_path / "demo.h5", demo)
    assert load_demonstration(tmp_path / "demo.h5").touching == demo.touching
    other = dataclasses.replace(demo, touching=((),) * len(demo))
    assert other.content_hash() != demo.content_hash()


def test_every_sphere_rejoins_before_the_gripper_or_a_contact_changes(
    task, demo, grasped_at, annotation
):
    commands = demo.steps.commanded_gripper
    for sphere in annotation.spheres:
        t, t_star = sphere.waypoint, convergence_waypoint(demo, sphere)
        assert len(set(np.round(commands[t : t_star + 1], 2))) == 1
        assert len(set(grasped_at[t : t_star + 1])) == 1
        for s in range(t, t_star + 1):
            assert not task.scene.outer_contacts(demo.touching[s], grasped_at[s])


def test_there_are_spheres_before_the_grasp_and_while_lifting(annotation, grasped_at):
    grasping = [bool(grasped_at[sphere.waypoint]) for sphere in annotation.spheres]
    assert not grasping[0] and grasping[-1]
    assert grasping == sorted(grasping)
    reasons = [sphere.limited_by for sphere in annotation.spheres]
    assert any("gripper command at waypoint" in reason for reason in reasons)
    assert any(reason == "toolbox / table" for reason in reasons)


def test_a_waypoint_in_a_contact_or_at_the_gripper_s_event_is_refused_with_that_reason(
    demo, world, grasped_at
):
    closing = next(s for s in range(len(demo)) if demo.steps.commanded_gripper[s] > 0.5)
    standing = grasped_at.index({"toolbox"}) + 1
    for t, reason in (
        (closing - 1, rf"\(gripper command at waypoint {closing}\)"),
        (standing, r"\(contact table / toolbox\)"),
    ):
        with pytest.raises(InvalidInput, match=rf"waypoint {t}: no room for a sphere .* {reason}"):
            suggest_annotation(demo, world, [t])


def test_a_segment_with_the_object_in_the_grasp_is_kept_and_brings_it_along(
    backend, model, demo, annotation, grasped_at
):
    config = AugmentConfig(n=8)
    i = len(annotation.spheres) - 1
    attempt = RestoreExecutor(backend, [(demo, annotation)], config).attempt(AttemptKey(0, i, 0))
    assert attempt.outcome == KEPT
    lifted = backend.observe().Ts_world_body["toolbox"][2, 3]
    assert lifted > 0.01


def test_a_try_with_an_object_in_the_grasp_does_not_depend_on_those_before(
    backend, demo, annotation
):
    """Contacts that exist when a state is restored must leave nothing behind."""
    make = RestoreExecutor(backend, [(demo, annotation)], AugmentConfig(n=8)).attempt
    i = len(annotation.spheres) - 1
    first = make(AttemptKey(0, i, 0))
    make(AttemptKey(0, i, 1))
    again = make(AttemptKey(0, i, 0))
    assert again.outcome == first.outcome == KEPT
    assert again.episode.content_hash() == first.episode.content_hash()


@pytest.mark.parametrize("recording", ["reversed", "return"])
def test_what_does_not_reach_the_goal_with_the_object_in_the_grasp_is_not_kept(
    backend, task, demo, annotation, grasped_at, monkeypatch, recording
):
    """Executed to its end at the rate of a policy; what it takes counts as the robot's time."""
    config = AugmentConfig(n=8, recording=recording, cameras=())
    sources = [(demo, annotation)]
    last = AttemptKey(0, len(annotation.spheres) - 1, 0)
    unjudged = RestoreExecutor(backend, sources, config).attempt(last)
    judged = RestoreExecutor(backend, sources, config, task=task)
    kept = judged.attempt(last)
    assert kept.outcome == KEPT
    assert kept.episode.content_hash() == unjudged.episode.content_hash()
    rest = (len(demo) - kept.episode.provenance.t_star) / demo.rates.record_hz
    assert kept.seconds > unjudged.seconds + len(kept.episode) / demo.rates.record_hz + rest - 0.2
    monkeypatch.setattr(type(task), "success", lambda self, seen: False)
    failed = judged.attempt(last)
    assert failed.outcome == "executed to its end, goal not reached"
    # The goal had been held by the demonstration's end; without it the robot waits for it.
    assert failed.episode is None and failed.seconds == pytest.approx(kept.seconds + task.hold)
    # Before the grasp nothing can slip, and nothing has to be seen.
    assert not grasped_at[annotation.spheres[0].waypoint]
    assert judged.attempt(AttemptKey(0, 0, 0)).outcome == KEPT


def test_a_segment_on_which_the_grasped_object_hits_the_table_is_rejected(
    backend, model, demo, grasped_at
):
    height = demo.body_Ts_world["toolbox"][:, 2, 3]
    t = next(s for s in range(len(demo)) if grasped_at[s] and height[s] > 0.012)
    config = AugmentConfig(n=8)
    outcomes = {
        RestoreExecutor(backend, [(demo, sphere_at(demo, t, 0.04))], config)
        .attempt(AttemptKey(0, 0, k))
        .outcome
        for k in range(12)
    }
    assert "path too close toolbox / table" in outcomes


def test_a_segment_on_which_the_object_slips_is_rejected(backend, demo, annotation):
    i = len(annotation.spheres) - 1
    config = AugmentConfig(n=8, slip_tolerance=0.0)
    attempt = RestoreExecutor(backend, [(demo, annotation)], config).attempt(AttemptKey(0, i, 0))
    assert attempt.outcome == "toolbox slipped in the grasp"
    assert attempt.episode is None


def test_an_object_that_slips_on_the_way_and_comes_back_is_found(task, demo, world, grasped_at):
    t = len(demo) - 1
    assert grasped_at[t] == {"toolbox"}
    start = observed(demo, t)
    check = DisturbanceCheck(task.scene, world, t, start, AugmentConfig())
    check(start)
    for far in (0.0049, -0.0049):
        check(shifted(start, far))
    with pytest.raises(MotionRejected, match="toolbox slipped in the grasp: by 5.10 mm"):
        check(shifted(start, 0.0051))
    # Tool and object together may go anywhere.
    T = pose([0.1, 0.2, 0.3])
    together = {name: T @ at for name, at in start.Ts_world_body.items() if name == "toolbox"}
    check(
        dataclasses.replace(
            start,
            T_world_tool=T @ start.T_world_tool,
            Ts_world_body={**start.Ts_world_body, **together},
        )
    )


def test_what_stands_may_move_by_less_than_is_proved_for_and_no_more(task, demo, world):
    start = observed(demo, 0)
    check = DisturbanceCheck(task.scene, world, 0, start, AugmentConfig())
    check(shifted(start, 0.99 * BODY_STILLNESS))
    with pytest.raises(MotionRejected, match="toolbox was moved: by 0.10 mm"):
        check(shifted(start, 1.01 * BODY_STILLNESS))


def test_fingers_that_leave_the_range_proved_are_found(task, demo, world):
    closing = next(t for t in range(len(demo)) if demo.steps.commanded_gripper[t] > 0.5)
    start = observed(demo, closing)
    check = DisturbanceCheck(task.scene, world, closing, start, AugmentConfig())
    low, high = world.openings(closing)
    for opening in (start.gripper, 0.5, demo.steps.commanded_gripper[closing]):
        check(dataclasses.replace(start, gripper=opening))
    for opening in (low - 0.001, high + 0.001, np.nan):
        with pytest.raises(MotionRejected, match="gripper left its range: it is at"):
            check(dataclasses.replace(start, gripper=opening))


def observed(demo, t):
    steps = demo.steps
    return Observation(
        q=steps.joint_positions[t],
        dq=steps.joint_velocities[t],
        gripper=float(steps.measured_gripper[t]),
        T_world_tool=steps.measured_Ts_world_tool[t],
        time=0.1 * t,
        Ts_world_body={name: Ts[t] for name, Ts in demo.body_Ts_world.items()},
    )


def shifted(seen, far):
    """The same with the toolbox by so much [m] elsewhere."""
    T = pose([far, 0, 0]) @ seen.Ts_world_body["toolbox"]
    return dataclasses.replace(seen, Ts_world_body={**seen.Ts_world_body, "toolbox": T})


def test_a_segment_on_which_the_open_fingers_touch_the_object_is_rejected(
    backend, model, demo, grasped_at
):
    t = next(s for s in range(len(demo)) if demo.steps.commanded_gripper[s] > 0.5) - 2
    config = AugmentConfig(n=8)
    outcomes = [
        RestoreExecutor(backend, [(demo, sphere_at(demo, t - 1, 0.003))], config).attempt(
            AttemptKey(0, 0, k)
        )
        for k in range(2)
    ]
    assert all(attempt.outcome == KEPT for attempt in outcomes)
    wide = sphere_at(demo, t - 1, 0.06)
    make = RestoreExecutor(backend, [(demo, wide)], config).attempt
    assert any("path too close" in make(AttemptKey(0, 0, k)).outcome for k in range(8))
