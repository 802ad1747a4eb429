"""A robot that restores nothing follows the demonstration and makes its attempts on the way."""

from __future__ import annotations

import dataclasses
import functools
import logging
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest

from sart_toolkit.annotate.suggest import suggest_annotation
from sart_toolkit.augment.config import AugmentConfig
from sart_toolkit.augment.engine import augment_demonstration
from sart_toolkit.augment.execution import SegmentRun
from sart_toolkit.augment.executors import RestoreExecutor, get_executor
from sart_toolkit.augment.planner import SegmentPlanner
from sart_toolkit.augment.replay import ReplayExecutor, start_state
from sart_toolkit.augment.validate import validate_dataset
from sart_toolkit.backends import make_backend
from sart_toolkit.backends.interface import (
    Contact,
    KnowsBodies,
    Resets,
    SensesContacts,
    SensesForce,
)
from sart_toolkit.collision.exact import ExactWorld
from sart_toolkit.data.manifest import AttemptKey
from sart_toolkit.errors import InvalidInput, Mismatch, MissingCapability, MotionRejected
from sart_toolkit.poses import distance, pose
from sart_toolkit.record.scripted import ScriptedOperator
from sart_toolkit.record.session import SessionConfig, record_demonstration
from sart_toolkit.robots import get_robot
from sart_toolkit.tasks.task import Placement

REPLAY = AugmentConfig(n=7, execution="replay", cameras=())
NO_RESTORE = (Resets, SensesContacts, KnowsBodies)


@pytest.fixture
def made(peg_demonstration, peg_annotation, make_peg_backend, limited, tmp_path):
    """Makes a dataset on a backend with some abilities; gives it and what the backend did."""

    def make(*abilities, config=REPLAY, out="d", demonstration=peg_demonstration, **options):
        annotation = dataclasses.replace(
            peg_annotation, demonstration_hash=demonstration.content_hash()
        )

        def backend():
            return limited(make_peg_backend(), *(abilities or NO_RESTORE))

        return augment_demonstration(
            demonstration, annotation, backend, tmp_path / out, config, **options
        )

    return make


def measured_differences(a, b):
    """How far measured tool poses of the episodes with equal keys are apart, at most [m], [rad]."""
    others = {(e.provenance.sphere, e.provenance.k): e for e in b}
    pairs = [
        (T, U)
        for episode in a
        for T, U in zip(
            episode.steps.measured_Ts_world_tool,
            others[episode.provenance.sphere, episode.provenance.k].steps.measured_Ts_world_tool,
            strict=True,
        )
    ]
    return np.array([distance(T, U) for T, U in pairs]).max(0)


@pytest.mark.parametrize("recording", ["reversed", "return"])
@pytest.mark.parametrize("backend", ["pybullet", pytest.param("sapien", marks=pytest.mark.render)])
def test_what_is_recorded_without_restoring_is_what_is_recorded_from_restored_states(
    backend, recording, peg_task, peg_model, limited, tmp_path
):
    if backend != "pybullet":
        pytest.importorskip(backend)
    make = functools.partial(make_backend, backend, get_robot(peg_task.robot), peg_task.scene, 48)
    plan = peg_task.plan(peg_task.initial_state(peg_model, Placement()))
    with closing(make()) as robot:
        demonstration = record_demonstration(
            robot, peg_task, peg_model, ScriptedOperator(plan, np.random.default_rng(0)),
            config=SessionConfig(cameras=()),
        )  # fmt: skip
    world = ExactWorld(demonstration, peg_model.spec, peg_task.scene)
    annotation = suggest_annotation(demonstration, world)
    config = dataclasses.replace(REPLAY, recording=recording)
    restored = augment_demonstration(
        demonstration, annotation, make, tmp_path / "restored",
        dataclasses.replace(config, execution="restore"),
    )  # fmt: skip
    replayed = augment_demonstration(
        demonstration, annotation, lambda: limited(make(), *NO_RESTORE), tmp_path / "d", config
    )
    assert replayed.info["resets"] == 1 and replayed.info["n_attempted"] == 6
    assert restored.info["resets"] == 0
    far, turned = measured_differences(replayed, restored)
    assert far < 5e-5 and turned < 1e-4
    assert not validate_dataset(tmp_path / "d", peg_model.spec, peg_task.scene).problems


def test_waypoints_are_visited_in_their_order_and_each_once(
    peg_demonstration, peg_annotation, peg_backend
):
    executor = ReplayExecutor(peg_backend, [(peg_demonstration, peg_annotation)], REPLAY)
    keys = [AttemptKey(0, sphere, k) for k in range(2) for sphere in (2, 0, 1)]
    attempts = list(executor.attempts(keys))
    assert [a.key for a in attempts] == sorted(keys, key=lambda key: (key.sphere, key.k))
    assert [a.resets for a in attempts] == [1, 0, 0, 0, 0, 0]
    stars = [a.episode.provenance.t_star for a in attempts]
    assert stars == sorted(stars)
    # Out and back in 2 s each, the first after following the demonstration to its waypoint.
    assert attempts[0].seconds > stars[0] / 10 + 4 > attempts[1].seconds > 4


def test_auto_restores_where_it_can(peg_demonstration, peg_backend, limited):
    whole, bare = peg_demonstration, dataclasses.replace(peg_demonstration, states=())
    arm = limited(peg_backend, *NO_RESTORE)
    assert get_executor("auto", peg_backend, [whole]) is RestoreExecutor
    assert get_executor("auto", peg_backend, [whole, bare]) is ReplayExecutor
    assert get_executor("auto", arm, [whole]) is ReplayExecutor
    assert get_executor("restore", arm, [whole]) is RestoreExecutor


def test_one_robot_has_one_process(made):
    with pytest.raises(InvalidInput, match="workers: execution 'replay' needs 1 process, got 2"):
        made(workers=2)


# --- what goes wrong ----------------------------------------------------------------------------


class Bump:
    """Has the backend report a contact in the n-th control period of attempts, if any."""

    def __init__(self, backend, period, monkeypatch):
        self.count, self.now = 0, False
        send, contacts = SegmentRun._send, backend.contacts
        bump = [Contact("block", "peg", 1.0, 0.0)]

        def counted(run, targets):
            self.count += 1
            self.now = self.count == period
            try:
                send(run, targets)
            finally:
                self.now = False

        monkeypatch.setattr(SegmentRun, "_send", counted)
        monkeypatch.setattr(backend, "contacts", lambda: bump if self.now else contacts())


def with_loose_block(scene):
    """The scene with a block that might be moved."""
    bodies = [
        dataclasses.replace(body, mass=1.0) if body.name == "block" else body
        for body in scene.bodies
    ]
    return dataclasses.replace(scene, bodies=tuple(bodies))


@pytest.fixture
def attempts(peg_demonstration, peg_annotation, peg_backend):
    """Makes attempts from two spheres, their spares being the next numbers."""

    def attempts(
        backend=peg_backend, config=REPLAY, demonstration=peg_demonstration, spheres=(0, 1)
    ):
        executor = ReplayExecutor(backend, [(demonstration, peg_annotation)], config)
        last = dict.fromkeys(spheres, 1)

        def spare(source, sphere):
            last[sphere] += 1
            if last[sphere] >= 5:
                return None
            return AttemptKey(source, sphere, last[sphere])

        keys = [AttemptKey(0, sphere, k) for sphere in spheres for k in (0, 1)]
        return list(executor.attempts(keys, spare))

    return attempts


def test_a_contact_has_the_robot_go_back_and_try_the_spare_without_a_reset(
    attempts, peg_backend, monkeypatch
):
    Bump(peg_backend, 30, monkeypatch)
    made = attempts()
    assert [(a.key.sphere, a.key.k, a.outcome) for a in made] == [
        (0, 0, "contact block / peg"),
        (0, 1, "kept"),
        (0, 2, "kept"),
        (1, 0, "kept"),
        (1, 1, "kept"),
    ]
    assert sum(a.resets for a in made) == 1


def test_a_robot_that_senses_force_alone_takes_more_of_it_for_a_contact(
    attempts, peg_backend, limited, monkeypatch
):
    arm = limited(peg_backend, Resets, SensesForce, KnowsBodies)
    bump = Bump(peg_backend, None, monkeypatch)
    forces = {0: 20.0, 30: 25.5, 31: 20.0}
    monkeypatch.setattr(peg_backend, "force", lambda: forces.get(bump.count, 20.0))
    made = attempts(arm)
    assert [a.outcome for a in made] == ["contact force", *["kept"] * 4]
    assert "contact force: 25.5 N, 20.0 N before" in made[0].detail


def test_a_retreat_stays_on_the_path_and_is_smooth(
    peg_demonstration, peg_annotation, peg_backend, peg_world, monkeypatch
):
    Bump(peg_backend, 30, monkeypatch)
    sent, command = [], peg_backend.command
    monkeypatch.setattr(
        peg_backend, "command", lambda q, gripper: (sent.append(q), command(q, gripper))[1]
    )
    planner = SegmentPlanner(peg_world, peg_annotation, REPLAY)
    proposal, rng = planner.proposal(0, 0)
    motion, _ = planner.plan(proposal, rng, peg_backend.tracking_error)
    t = proposal.t_star
    peg_backend.restore(peg_demonstration.states[t])
    run = SegmentRun(peg_backend, planner, t, REPLAY)
    run.settle(planner.approach(t))
    settled, sent[:] = run.periods, []
    with pytest.raises(MotionRejected, match="contact block / peg"):
        run.go_out(motion, record=False)
    outwards = len(sent)
    assert outwards == 30 - settled
    run.retreat(motion)
    rows = np.concatenate(sent)
    start = peg_demonstration.steps.commanded_joint_positions[t]
    np.testing.assert_allclose(rows[-1], start, atol=1e-9)
    path = motion.path.positions(np.linspace(0, 1, 4000))
    for row in rows[8 * outwards :]:
        assert np.abs(path - row).max(1).min() < 1e-3
    spec = peg_backend.robot
    assert (np.abs(np.diff(rows, 1, axis=0)) * 240 <= spec.velocity_limits).all()
    assert (np.abs(np.diff(rows, 2, axis=0)) * 240**2 <= spec.acceleration_limits).all()


def moved_after(backend, period, bump, far, monkeypatch):
    """The block is farther in x from some period of the attempts on until the next reset."""
    observe, reset, put_back = backend.observe, backend.reset, []

    def elsewhere(*args):
        seen = observe(*args)
        off = far if bump.count >= period and not put_back else 0.0
        at = pose([off, 0, 0]) @ seen.Ts_world_body["block"]
        return dataclasses.replace(seen, Ts_world_body={**seen.Ts_world_body, "block": at})

    def again(state):
        if bump.count >= period > 0:
            put_back.append(True)
        reset(state)

    monkeypatch.setattr(backend, "scene", with_loose_block(backend.scene))
    monkeypatch.setattr(backend, "observe", elsewhere)
    monkeypatch.setattr(backend, "reset", again)


@pytest.mark.parametrize("recording", ["reversed", "return"])
def test_a_disturbed_scene_ends_the_pass_says_why_and_goes_on_after_a_reset(
    attempts, peg_backend, monkeypatch, caplog, recording
):
    bump = Bump(peg_backend, None, monkeypatch)
    moved_after(peg_backend, 30, bump, 2e-3, monkeypatch)
    with caplog.at_level(logging.WARNING):
        made = attempts(config=dataclasses.replace(REPLAY, recording=recording))
    assert [a.outcome for a in made] == ["block was moved", *["kept"] * 4]
    assert [a.resets for a in made] == [1, 1, 0, 0, 0]
    assert "at waypoint 25 the scene was disturbed: block was moved: by 2.00 mm" in caplog.text


def test_what_was_recorded_on_the_way_out_is_kept_whatever_happens_on_the_way_back(
    attempts, peg_backend, monkeypatch
):
    """The second way back is disturbed; a return that was to be recorded is lost by that."""
    outcomes = {}
    for recording in ("reversed", "return"):
        with monkeypatch.context() as patch:
            bump = Bump(peg_backend, None, patch)
            moved_after(peg_backend, 90, bump, 2e-3, patch)
            made = attempts(config=dataclasses.replace(REPLAY, recording=recording))
            outcomes[recording] = [a.outcome for a in made[:1]]
            assert [a.resets for a in made[:2]] == [1, 1]
    assert outcomes == {"reversed": ["kept"], "return": ["block was moved"]}


def test_attempts_are_proved_again_where_a_body_has_crept(attempts, peg_backend, monkeypatch):
    bump = Bump(peg_backend, None, monkeypatch)
    moved_after(peg_backend, 0, bump, 3e-4, monkeypatch)
    for attempt in attempts():
        if attempt.episode is None:
            assert attempt.outcome.startswith(("path too close", "start too close"))
        else:
            certificate = attempt.episode.provenance.certificate
            assert certificate["body_stillness"] == pytest.approx(5e-4)
            margin = REPLAY.margin + 5e-4
            assert certificate["measured"]["margin"] == pytest.approx(margin)


def test_a_waypoint_that_does_not_reproduce_is_given_up_after_three_arrivals(
    attempts, peg_demonstration, peg_backend, monkeypatch, caplog
):
    """From a waypoint on the demonstration has the block where it isn't."""
    Ts = np.array(peg_demonstration.body_Ts_world["block"])
    Ts[27:, 0, 3] += 0.002
    bodies = {**peg_demonstration.body_Ts_world, "block": Ts}
    monkeypatch.setattr(peg_backend, "scene", with_loose_block(peg_backend.scene))
    demonstration = dataclasses.replace(peg_demonstration, body_Ts_world=bodies)
    with caplog.at_level(logging.WARNING):
        made = attempts(demonstration=demonstration, spheres=(0, 6))
    assert [a.outcome for a in made[:2]] == ["kept", "kept"]
    given_up = made[2:]
    # The two that were wanted, and all their spares, for which the robot doesn't move.
    assert {a.key.k for a in given_up} == set(range(5))
    assert all(a.key.sphere == 6 for a in given_up)
    assert {a.outcome for a in given_up} == {"demonstration doesn't reproduce"}
    assert (
        "3 times something was otherwise at waypoint 29, the last time block was moved: by 2.00"
        in given_up[-1].detail
    )
    assert sum(a.resets for a in made) == 3
    assert sum(a.seconds > 0 for a in given_up) == 1
    assert "at waypoint 29 the scene isn't the demonstration's: block was moved" in caplog.text


def test_an_interrupted_generation_keeps_what_is_written_and_resumes(made):
    def interrupt(kept, wanted, rejected):
        if kept == 3:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        made(progress=interrupt)
    resumed, whole = made(), made(out="whole")
    assert len(resumed) == 6 and resumed.info["resets"] is None
    assert [e.key for e in resumed.index] == [e.key for e in whole.index]
    far, _ = measured_differences(resumed, whole)
    assert far < 1e-5


# --- resets by a person -------------------------------------------------------------------------


def test_a_robot_that_nobody_can_reset_is_refused(made, tmp_path):
    with pytest.raises(MissingCapability, match="lacks the ability Resets, and nobody can be ask"):
        made(SensesContacts)
    assert not (tmp_path / "d").exists()


def test_a_demonstration_that_does_not_tell_where_bodies_were_is_no_state_to_reset_to(
    made, peg_demonstration, tmp_path
):
    blind = dataclasses.replace(peg_demonstration, body_Ts_world={})
    with pytest.raises(Mismatch, match="doesn't tell where 'table' was, so that a backend can't"):
        made(Resets, demonstration=blind)


def test_a_person_is_asked_and_the_robot_goes_to_the_start_by_itself(
    peg_demonstration, peg_annotation, peg_backend, limited, monkeypatch
):
    peg_backend.reset(start_state(peg_demonstration, peg_backend.scene))
    arm = limited(peg_backend, SensesContacts)
    sources, asked = [(peg_demonstration, peg_annotation)], []
    executor = ReplayExecutor(arm, sources, REPLAY, ask=asked.append)
    keys = [AttemptKey(0, 1, 0)]
    (first,) = executor.attempts(keys)
    away = peg_backend.observe().q
    (again,) = executor.attempts(keys)
    assert first.outcome == again.outcome == "kept"
    assert len(asked) == 2 and all("Put the scene back" in text for text in asked)
    start = peg_demonstration.steps.joint_positions[0]
    assert np.abs(away - start).max() > 0.05, "it had to go there"
    far, _ = measured_differences([first.episode], [again.episode])
    assert far < 5e-5
    assert again.seconds > first.seconds + 3


def test_a_way_to_the_start_that_is_not_clear_is_left_to_the_person(
    peg_demonstration, peg_annotation, peg_backend, peg_model, limited
):
    """The robot stands in the block."""
    steps = peg_demonstration.steps
    inside = pose([0.02, 0.0, 0.0]) @ steps.commanded_Ts_world_tool[-1]
    q = peg_model.ik(inside, steps.commanded_joint_positions[-1], 0.5)
    state = start_state(peg_demonstration, peg_backend.scene)
    peg_backend.reset(dataclasses.replace(state, q=q))
    arm = limited(peg_backend, SensesContacts)
    sources, asked = [(peg_demonstration, peg_annotation)], []
    executor = ReplayExecutor(arm, sources, REPLAY, ask=asked.append)
    with pytest.raises(MotionRejected, match="way to the start: it isn't clear .* by hand"):
        list(executor.attempts([AttemptKey(0, 1, 0)]))
    assert len(asked) == 4
    assert "isn't clear (" in asked[1] and "move the robot there" in asked[1]
    moves = [text for text in asked if "move the robot" in text]
    assert len(moves) == 3


def test_a_gripper_that_holds_something_is_opened_before_the_scene_is_put_back(
    peg_demonstration, peg_annotation, peg_backend, limited
):
    steps = peg_demonstration.steps
    state = start_state(peg_demonstration, peg_backend.scene)
    other = 0.0 if steps.commanded_gripper[0] > 0.5 else 1.0
    peg_backend.reset(dataclasses.replace(state, gripper=other, gripper_target=other))
    arm = limited(peg_backend, SensesContacts)
    asked = []
    executor = ReplayExecutor(arm, [(peg_demonstration, peg_annotation)], REPLAY, ask=asked.append)
    list(executor.attempts([AttemptKey(0, 0, 0)]))
    assert "Take what the gripper holds" in asked[0] and "Put the scene back" in asked[1]
    assert peg_backend.observe().gripper == pytest.approx(steps.measured_gripper[0], abs=0.01)


def test_an_arm_without_any_ability_generates_a_dataset_with_a_person_beside_it(
    peg_demonstration, peg_annotation, peg_task, peg_model, tmp_path
):
    core_only = Path(__file__).parents[1] / "testing" / "core_only.py"
    make = functools.partial(
        make_backend, f"{core_only}:CoreOnly", peg_model.spec, peg_task.scene, 48
    )
    asked = []
    dataset = augment_demonstration(
        peg_demonstration, peg_annotation, make, tmp_path / "d", AugmentConfig(n=7, cameras=()),
        ask=asked.append,
    )  # fmt: skip
    assert len(dataset) == 6 and dataset.info["resets"] == 1
    assert any("Put the scene back" in text for text in asked)
    assert not validate_dataset(tmp_path / "d", peg_model.spec, peg_task.scene).problems
