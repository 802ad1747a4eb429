from __future__ import annotations

import dataclasses
import itertools
import logging
import os
import re
import shutil
import signal
import subprocess
import sys
from collections import Counter
from contextlib import closing

import numpy as np
import pytest

from sart_toolkit.augment import STRATEGIES, allocation, engine, get_strategy
from sart_toolkit.augment.allocation import allocate
from sart_toolkit.augment.config import ALLOCATIONS, AugmentConfig
from sart_toolkit.augment.engine import augment_demonstration, augment_sources
from sart_toolkit.augment.executors import Attempt, RestoreExecutor, no_spare
from sart_toolkit.augment.planner import SegmentPlanner
from sart_toolkit.augment.validate import validate_dataset
from sart_toolkit.backends.interface import Contact, KnowsBodies, Resets, SavesStates
from sart_toolkit.backends.pybullet import PyBulletBackend
from sart_toolkit.collision.phases import BODY_STILLNESS
from sart_toolkit.data import writer
from sart_toolkit.data.dataset import load_dataset
from sart_toolkit.data.manifest import KEPT, AttemptKey
from sart_toolkit.data.pace import Pace
from sart_toolkit.data.records import (
    Annotation,
    PrecisionSphere,
    Rates,
    apply_action,
    convergence_waypoint,
)
from sart_toolkit.data.storage import (
    append_json_line,
    read_json_lines,
    save_annotation,
    save_demonstration,
)
from sart_toolkit.errors import (
    CannotWrite,
    InvalidInput,
    Mismatch,
    MissingCapability,
    OutputExists,
    SartError,
    UnknownName,
)
from sart_toolkit.poses import interpolate, log_rotation, pose
from sart_toolkit.record.scripted import ScriptedOperator
from sart_toolkit.record.session import record_demonstration
from sart_toolkit.tasks.task import Placement

CROWDED = AugmentConfig(n=5, seed=3, duration=0.8)


@pytest.fixture
def augment(peg_demonstration, make_peg_backend):
    """Augments the peg-in-hole demonstration."""

    def augment(annotation, out, config=CROWDED, **options):
        return augment_demonstration(
            peg_demonstration, annotation, make_peg_backend, out, config, **options
        )

    return augment


@pytest.fixture(scope="module")
def crowded_dataset(peg_demonstration, crowded, make_peg_backend, tmp_path_factory):
    """Made without interruption by one process."""
    out = tmp_path_factory.mktemp("crowded") / "dataset"
    return augment_demonstration(peg_demonstration, crowded, make_peg_backend, out, CROWDED)


@pytest.fixture(scope="module", params=[n for n in STRATEGIES if n not in ("bc", "replay")])
def strategy_dataset(
    request, peg_demonstration, peg_annotation, make_peg_backend, tmp_path_factory
):
    if request.param == "sart_planned":
        pytest.importorskip("ompl")
    out = tmp_path_factory.mktemp(request.param) / "dataset"
    config = AugmentConfig(n=9, strategy=request.param)
    return augment_demonstration(peg_demonstration, peg_annotation, make_peg_backend, out, config)


def n_attempts(path):
    """How many attempts a dataset's manifest tells of."""
    return len((path / "manifest.jsonl").read_text().splitlines()) - 1


class Interrupt:
    """A progress callback that interrupts after some attempts."""

    def __init__(self, after):
        self.calls, self.after = [], after

    def __call__(self, kept, wanted, rejected):
        self.calls.append((kept, wanted, rejected))
        if len(self.calls) == self.after:
            raise KeyboardInterrupt


# --- what an episode is -------------------------------------------------------------------------


def test_a_commanded_pose_followed_by_its_action_is_the_next_commanded_pose(strategy_dataset):
    """Through the reversed segment, across the join, and on to the end."""
    demonstration = strategy_dataset.sources[0].demonstration
    assert len(strategy_dataset) == 8
    for episode in strategy_dataset:
        Ts, gripper = episode.commands(demonstration)
        actions = episode.actions(demonstration)
        p = episode.provenance
        follows = len(demonstration) - p.t_star if p.merged else 1
        assert len(Ts) == len(actions) == len(episode) + follows
        for t in range(len(Ts) - 1):
            T, g = apply_action(Ts[t], actions[t])
            np.testing.assert_allclose(T, Ts[t + 1], rtol=0, atol=1e-9)
            assert g == gripper[t + 1]
        assert not actions[-1, :6].any()
        suffix = demonstration.steps.commanded_Ts_world_tool[p.t_star :][:follows]
        np.testing.assert_array_equal(Ts[len(episode) :], suffix)


def test_a_segment_is_commanded_along_the_straight_line_from_the_sampled_pose_to_t_star(
    strategy_dataset,
):
    steps = strategy_dataset.sources[0].demonstration.steps
    for episode in strategy_dataset:
        goal = steps.commanded_Ts_world_tool[episode.provenance.t_star]
        start = episode.provenance.T_world_sampled
        commanded = episode.steps.commanded_Ts_world_tool
        np.testing.assert_allclose(commanded[0], start, rtol=0, atol=1e-9)
        way = goal[:3, 3] - start[:3, 3]
        shares = (commanded[:, :3, 3] - start[:3, 3]) @ way / (way @ way)
        assert (np.diff(shares) > 0).all() and shares[-1] < 1
        for s, T in zip(shares, commanded, strict=True):
            np.testing.assert_allclose(T, interpolate(start, goal, s), rtol=0, atol=1e-7)
        turned = [np.linalg.norm(log_rotation(start[:3, :3].T @ T[:3, :3])) for T in commanded]
        whole = np.linalg.norm(log_rotation(start[:3, :3].T @ goal[:3, :3]))
        np.testing.assert_allclose(turned, shares * whole, atol=1e-7)


def test_an_episode_says_where_it_comes_from(strategy_dataset, peg_annotation):
    demonstration = strategy_dataset.sources[0].demonstration
    config = strategy_dataset.info["config"]
    strategy = get_strategy(config["strategy"])
    spheres = strategy.spheres(demonstration, peg_annotation)
    for episode in strategy_dataset:
        p = episode.provenance
        assert p.demonstration_hash == demonstration.content_hash()
        assert p.strategy == config["strategy"] and p.seed == config["seed"]
        assert spheres[p.sphere].waypoint <= p.t_star < len(demonstration)
        rows = strategy_dataset.info["by_sphere"]
        assert rows[p.sphere]["waypoint"] == spheres[p.sphere].waypoint
    assert [row["kept"] for row in rows] == [
        sum(entry.sphere == i for entry in strategy_dataset.index) for i in range(len(spheres))
    ]


def test_by_the_paper_s_strategy_an_episode_starts_on_its_sphere_and_joins_at_t_star(
    peg_dataset, peg_annotation
):
    for episode in peg_dataset:
        p = episode.provenance
        sphere = peg_annotation.spheres[p.sphere]
        offset = p.T_world_sampled[:3, 3] - sphere.T_world_key[:3, 3]
        assert np.linalg.norm(offset) == pytest.approx(sphere.radius, abs=1e-12)
        assert p.t_star == convergence_waypoint(peg_dataset.sources[0].demonstration, sphere)


def test_a_segment_takes_as_long_as_the_demonstration_for_as_much_motion(
    peg_dataset, peg_world, peg_annotation
):
    pace = Pace(peg_world.demonstration)
    lengths = set()
    for episode in peg_dataset:
        p = episode.provenance
        seconds = np.clip(pace.time_for(p.t_star, p.T_world_sampled), 0.4, 2.0)
        assert len(episode) == np.ceil(np.round(seconds * 10, 6))
        lengths.add(len(episode))
    assert len(lengths) > 1
    planner = SegmentPlanner(peg_world, peg_annotation, AugmentConfig(duration=1.23))
    assert planner.duration(planner.proposal(0, 0)[0]) == 1.3


def test_the_measured_tool_follows_the_commands_and_the_join_is_smooth(strategy_dataset):
    steps = strategy_dataset.sources[0].demonstration.steps
    for episode in strategy_dataset:
        commanded, measured = (
            episode.steps.commanded_Ts_world_tool[:, :3, 3],
            episode.steps.measured_Ts_world_tool[:, :3, 3],
        )
        assert np.linalg.norm(commanded - measured, axis=1).max() < 0.003
        ahead = steps.measured_Ts_world_tool[episode.provenance.t_star, :3, 3]
        stride = np.linalg.norm(np.diff(measured, axis=0), axis=1).max()
        assert np.linalg.norm(measured[-1] - ahead) < 1.2 * stride + 0.003


def test_executed_again_a_kept_segment_touches_nothing_and_measures_the_same_to_the_bit(
    strategy_dataset, peg_backend, peg_world, peg_annotation
):
    demonstration = strategy_dataset.sources[0].demonstration
    planner = SegmentPlanner(
        peg_world,
        peg_annotation,
        AugmentConfig(strategy=strategy_dataset.info["config"]["strategy"]),
    )
    for episode in itertools.islice(strategy_dataset, 4):
        t = episode.provenance.t_star
        peg_backend.restore(demonstration.states[t])
        steps = episode.steps
        proposal, rng = planner.proposal(episode.provenance.sphere, episode.provenance.k)
        motion, _ = planner.plan(proposal, rng, peg_backend.tracking_error)
        for rows in planner.approach(t)[1:].reshape(-1, 8, 6):
            peg_backend.command(rows, steps.commanded_gripper[-1])
            peg_backend.step()
        outwards = motion.joints(motion.times(240)).reshape(-1, 8, 6)
        for i in reversed(range(len(steps))):
            for rows in outwards[3 * (len(steps) - 1 - i) :][:3]:
                peg_backend.command(rows, steps.commanded_gripper[i])
                peg_backend.step()
                assert peg_backend.contacts() == []
            seen = peg_backend.observe(("wrist",))
            np.testing.assert_array_equal(seen.q, steps.joint_positions[i])
            np.testing.assert_array_equal(seen.T_world_tool, steps.measured_Ts_world_tool[i])
            image = steps.cameras["wrist"]
            np.testing.assert_array_equal(seen.cameras["wrist"].rgb, image.rgb[i])
            np.testing.assert_array_equal(seen.cameras["wrist"].depth, image.depth[i])


def test_an_attempt_depends_on_seed_sphere_and_number_alone(
    peg_demonstration, peg_annotation, peg_backend, peg_dataset
):
    make = RestoreExecutor(
        peg_backend, [(peg_demonstration, peg_annotation)], AugmentConfig(n=5)
    ).attempt
    for episode in reversed(list(peg_dataset)):
        p = episode.provenance
        again = make(AttemptKey(0, p.sphere, p.k))
        assert again.outcome == "kept"
        assert again.episode.content_hash() == episode.content_hash()


# --- what is kept, rejected and counted ---------------------------------------------------------


@pytest.mark.parametrize("allocation", ALLOCATIONS)
def test_every_sphere_gets_its_quota(peg_annotation, augment, tmp_path, allocation):
    config = AugmentConfig(n=10, allocation=allocation, cameras=())
    dataset = augment(peg_annotation, tmp_path / "d", config)
    made = Counter(episode.provenance.sphere for episode in dataset)
    spheres = peg_annotation.spheres
    weights = get_strategy("sart").weights(spheres, allocation)
    assert [made[i] for i in range(len(spheres))] == allocate(9, weights)


def test_attempts_that_would_touch_are_rejected_and_counted_by_what_touched(crowded_dataset):
    info = crowded_dataset.info
    assert len(crowded_dataset) == info["n_kept"] == 4
    assert info["rejections"]["path too close peg / block"] > 0
    for i, row in enumerate(info["by_sphere"]):
        assert row["kept"] == sum(e.provenance.sphere == i for e in crowded_dataset)
    total = sum((Counter(row["rejections"]) for row in info["by_sphere"]), Counter())
    assert total == info["rejections"]
    assert all(isinstance(count, int) for count in info["rejections"].values())
    assert info["n_attempted"] == info["n_kept"] + sum(info["rejections"].values())
    assert info["content_hash"] == crowded_dataset.content_hash


def test_simulated_seconds_are_those_that_the_robot_moved(
    peg_demonstration, crowded, make_peg_backend, crowded_dataset, augment, tmp_path
):
    """Counted at the simulator; the same with two processes, and after an interruption."""
    periods = []

    def counting():
        backend = make_peg_backend()
        step = backend.step
        backend.step = lambda: (periods.append(1), step())
        return backend

    info = augment_demonstration(
        peg_demonstration, crowded, counting, tmp_path / "counted", CROWDED
    ).info
    assert info["rejections"]["path too close peg / block"] > 0, "some were never executed"
    assert info["simulated_seconds"] == pytest.approx(len(periods) / 30, abs=1e-9)
    assert info["simulated_seconds"] < 0.8 * info["n_attempted"]
    assert info["simulated_seconds"] == crowded_dataset.info["simulated_seconds"]
    two = augment(crowded, tmp_path / "two", workers=2).info
    with pytest.raises(KeyboardInterrupt):
        augment(crowded, tmp_path / "cut", progress=Interrupt(3))
    resumed = augment(crowded, tmp_path / "cut").info
    assert two["simulated_seconds"] == resumed["simulated_seconds"] == info["simulated_seconds"]


def test_a_manifest_that_does_not_tell_how_long_attempts_took_gives_no_sum(
    crowded, augment, tmp_path
):
    with pytest.raises(KeyboardInterrupt):
        augment(crowded, tmp_path / "d", progress=Interrupt(3))
    manifest = tmp_path / "d" / "manifest.jsonl"
    rows = read_json_lines(manifest)
    manifest.unlink()
    for row in rows:
        append_json_line(manifest, {k: v for k, v in row.items() if k != "seconds"})
    assert augment(crowded, tmp_path / "d").info["simulated_seconds"] is None


def test_episodes_tell_the_force_that_was_measured_or_that_none_was(
    peg_demonstration, peg_annotation, peg_backend, limited, monkeypatch
):
    sources, key = [(peg_demonstration, peg_annotation)], AttemptKey(0, 0, 0)
    forces = itertools.count(1)
    with monkeypatch.context() as patch:
        patch.setattr(peg_backend, "force", lambda: float(next(forces)))
        seen = RestoreExecutor(peg_backend, sources, AugmentConfig()).attempt(key).episode
    # After the way to a rest, outwards 3, 6, ... 60 periods at the end of each step of three; the
    # last comes first backwards.
    before = (len(seen.joint_path) - 1) // 8 - 60
    expected = [0, *range(before + 60, before + 3, -3)]
    np.testing.assert_array_equal(seen.steps.contact_force, expected)
    blind = limited(peg_backend, SavesStates, KnowsBodies)
    unseen = RestoreExecutor(blind, sources, AugmentConfig()).attempt(key).episode
    assert np.isnan(unseen.steps.contact_force).all()


def test_joint_velocities_of_an_episode_are_those_of_its_own_motion(peg_dataset):
    for episode in peg_dataset:
        q, dq = episode.steps.joint_positions, episode.steps.joint_velocities
        moved = np.diff(q, axis=0)
        fast = np.abs(moved) > 0.5 * np.abs(moved).max()
        np.testing.assert_array_equal(np.sign(moved)[fast], np.sign(dq[1:])[fast])


def test_what_a_sphere_cannot_give_is_asked_of_the_others_and_said_with_the_reason(
    annotate, augment, tmp_path, caplog
):
    with caplog.at_level(logging.WARNING):
        dataset = augment(
            annotate((0, 0.01), (34, 1.5)),
            tmp_path / "d",
            AugmentConfig(n=5, duration=0.5, allocation="equal"),
        )
    assert [episode.provenance.sphere for episode in dataset] == [0, 0, 0, 0]
    assert "sphere at waypoint 34 of demonstration 0 gave 0 of 2 trajectories (" in caplog.text
    assert "trajectories were kept" not in caplog.text, "all that were asked for"
    assert [row["wanted"] for row in dataset.info["by_sphere"]] == [2, 2]
    assert sum(dataset.info["rejections"].values()) == 20


def test_what_no_sphere_can_give_leaves_fewer_trajectories_and_a_warning(
    annotate, augment, tmp_path, caplog, monkeypatch
):
    monkeypatch.setattr(allocation, "_LEAST_ATTEMPTS", 3)
    monkeypatch.setattr(allocation, "_ATTEMPTS_PER_EPISODE", 1)
    spheres = annotate((0, 0.01), (34, 1.5))
    with caplog.at_level(logging.WARNING):
        dataset = augment(
            spheres, tmp_path / "d", AugmentConfig(n=11, duration=0.5, allocation="equal")
        )
    # Of five attempts each all of one sphere and none of the other are kept.
    assert [row["kept"] for row in dataset.info["by_sphere"]] == [5, 0]
    assert "only 5 of 10 trajectories were kept (" in caplog.text


def test_when_every_attempt_is_rejected_the_error_counts_the_reasons(annotate, augment, tmp_path):
    calls = Interrupt(None)
    for expected in (20, 0):
        with pytest.raises(
            InvalidInput, match=r"none of 20 attempts was kept \(.*out of reach: .*\); use smaller"
        ):
            augment(annotate((0, 1.5)), tmp_path / "d", AugmentConfig(n=2), progress=calls)
        # The second time the answer is known.
        assert len(calls.calls) == expected
        calls.calls.clear()


def test_a_line_too_fast_for_the_joints_takes_longer_and_the_episode_says_so(
    annotate, augment, tmp_path
):
    dataset = augment(annotate((0, 0.02)), tmp_path / "d", AugmentConfig(n=3, duration=0.1))
    for episode in dataset:
        duration = episode.provenance.certificate["duration"]
        assert 0.1 < duration < 1.0
        assert len(episode) == round(10 * duration)


def test_a_start_in_collision_is_reported_with_the_pair_and_by_how_much(
    peg_demonstration, peg_task, peg_backend, augment, annotate, tmp_path
):
    """The block stands where the peg is when the segment starts."""
    sunk = np.array(peg_demonstration.body_Ts_world["block"])
    sunk[:, 2, 3] += 0.2
    demo = dataclasses.replace(
        peg_demonstration, body_Ts_world={**peg_demonstration.body_Ts_world, "block": sunk}
    )
    Ts = demo.steps.measured_Ts_world_tool
    annotation = Annotation((PrecisionSphere(20, Ts[20], 0.01),), demo.content_hash())
    attempt = RestoreExecutor(peg_backend, [(demo, annotation)], AugmentConfig()).attempt(
        AttemptKey(0, 0, 0)
    )
    assert attempt.outcome.startswith("start too close")
    assert re.search(r"start too close .* / block: they overlap by \d+\.\d mm", attempt.detail)


def test_what_touches_in_spite_of_the_proof_ends_the_segment_at_once(
    peg_demonstration, peg_annotation, peg_backend, monkeypatch
):
    steps = []
    step = peg_backend.step
    monkeypatch.setattr(peg_backend, "step", lambda: (steps.append(1), step()))
    bump = [Contact("block", "peg", 1.0, 0.0)]
    monkeypatch.setattr(peg_backend, "contacts", lambda: bump if len(steps) == 7 else [])
    make = RestoreExecutor(
        peg_backend, [(peg_demonstration, peg_annotation)], AugmentConfig()
    ).attempt
    key = AttemptKey(0, 0, 0)
    assert make(key) == Attempt(
        key, "contact block / peg", None, "contact block / peg: stopped there", seconds=7 / 30
    )
    assert len(steps) == 7


def test_a_backend_that_reports_no_contacts_can_augment(
    peg_demonstration, peg_annotation, peg_backend, limited
):
    blind = limited(peg_backend, SavesStates, KnowsBodies)
    make = RestoreExecutor(blind, [(peg_demonstration, peg_annotation)], AugmentConfig()).attempt
    assert make(AttemptKey(0, 0, 0)).outcome == KEPT


@pytest.mark.parametrize(
    ("far", "while_", "outcome"),
    [
        (2e-3, range(30, 1000), "block was moved"),
        # So little, and it came back.
        (1.2e-4, range(30, 33), "block was moved"),
        (0.9e-4, range(1000), KEPT),
    ],
)
def test_a_segment_on_which_something_else_is_moved_at_any_time_is_rejected(
    peg_demonstration, peg_annotation, peg_backend, monkeypatch, far, while_, outcome
):
    observe, seen = peg_backend.observe, []

    def disturbed(*args):
        found = observe(*args)
        at = pose([far if len(seen) in while_ else 0.0, 0, 0]) @ found.Ts_world_body["block"]
        seen.append(found)
        return dataclasses.replace(found, Ts_world_body={**found.Ts_world_body, "block": at})

    monkeypatch.setattr(peg_backend, "observe", disturbed)
    bodies = [
        dataclasses.replace(body, mass=1.0) if body.name == "block" else body
        for body in peg_backend.scene.bodies
    ]
    scene = dataclasses.replace(peg_backend.scene, bodies=tuple(bodies))
    monkeypatch.setattr(peg_backend, "scene", scene)
    make = RestoreExecutor(
        peg_backend, [(peg_demonstration, peg_annotation)], AugmentConfig()
    ).attempt
    found = make(AttemptKey(0, 0, 0))
    assert found.outcome == outcome, found.detail


def test_bodies_have_to_be_where_the_demonstration_has_them_from_the_start(
    peg_demonstration, peg_annotation, peg_backend, monkeypatch
):
    """Restored elsewhere it never moves, and yet the proof is about another place."""
    elsewhere = {
        name: pose([2e-4, 0, 0]) @ Ts if name == "block" else Ts
        for name, Ts in peg_demonstration.body_Ts_world.items()
    }
    demonstration = dataclasses.replace(peg_demonstration, body_Ts_world=elsewhere)
    bodies = [dataclasses.replace(body, mass=1.0) for body in peg_backend.scene.bodies]
    scene = dataclasses.replace(peg_backend.scene, bodies=tuple(bodies))
    monkeypatch.setattr(peg_backend, "scene", scene)
    make = RestoreExecutor(peg_backend, [(demonstration, peg_annotation)], AugmentConfig()).attempt
    found = make(AttemptKey(0, 0, 0))
    assert found.detail == "block was moved: by 0.20 mm"


def test_nothing_is_planned_from_a_waypoint_at_which_a_body_moves(
    peg_demonstration, peg_annotation, peg_backend
):
    drift = np.linspace(0, 0.1, len(peg_demonstration))
    Ts = np.array([pose([x, 0, 0]) for x in drift]) @ peg_demonstration.body_Ts_world["table"]
    moving = dataclasses.replace(
        peg_demonstration, body_Ts_world={**peg_demonstration.body_Ts_world, "table": Ts}
    )
    make = RestoreExecutor(peg_backend, [(moving, peg_annotation)], AugmentConfig()).attempt
    assert make(AttemptKey(0, 0, 0)).outcome == "table moves"


def test_a_segment_farther_off_its_path_than_the_backend_declares_is_rejected(
    peg_demonstration, peg_annotation, peg_backend, monkeypatch
):
    monkeypatch.setattr(peg_backend, "tracking_error", 1e-7)
    make = RestoreExecutor(
        peg_backend, [(peg_demonstration, peg_annotation)], AugmentConfig()
    ).attempt
    found = make(AttemptKey(0, 0, 0))
    assert found.outcome == "left its path"
    assert re.search(
        r"by up to 0\.\d\d mm, backend 'pybullet' declares a tracking error of 0.00", found.detail
    )


def test_what_a_backend_declares_is_left_free_beside_the_margin(
    peg_demonstration, peg_annotation, peg_backend, monkeypatch
):
    """0.1 m is more than there is between the peg and the hole."""
    monkeypatch.setattr(peg_backend, "tracking_error", 0.1)
    last = len(peg_annotation.spheres) - 1
    make = RestoreExecutor(
        peg_backend, [(peg_demonstration, peg_annotation)], AugmentConfig(margin=0.0)
    ).attempt
    assert "too close" in make(AttemptKey(0, last, 0)).outcome


@pytest.mark.parametrize(("asked", "steps"), [(1.75, 18), (2.05, 21), (0.33, 4)])
def test_any_duration_is_rounded_up_to_whole_recorded_steps_and_validates(
    peg_demonstration, annotate, make_peg_backend, peg_model, peg_task, tmp_path, asked, steps
):
    config = AugmentConfig(n=3, duration=asked, cameras=())
    dataset = augment_demonstration(
        peg_demonstration, annotate((15, 0.01)), make_peg_backend, tmp_path / "d", config
    )
    for episode in dataset:
        p = episode.provenance
        assert p.certificate["duration"] == pytest.approx(steps / 10, abs=1e-12)
        assert len(episode.steps) == steps
        # The first step is at the sampled pose.
        np.testing.assert_allclose(
            episode.steps.commanded_Ts_world_tool[0], p.T_world_sampled, atol=1e-9
        )
    assert not validate_dataset(tmp_path / "d", peg_model.spec, peg_task.scene).problems


def test_a_measured_path_that_is_not_clear_rejects_the_segment(
    peg_demonstration, peg_annotation, peg_backend, monkeypatch
):
    observe = peg_backend.observe
    folded = np.array([0.0, 0.3, 2.6, 0.0, 0.0, 0.0])

    def astray(*args):
        found = observe(*args)
        return dataclasses.replace(found, joint_path=np.stack([found.q, folded, found.q]))

    monkeypatch.setattr(peg_backend, "observe", astray)
    make = RestoreExecutor(
        peg_backend, [(peg_demonstration, peg_annotation)], AugmentConfig()
    ).attempt
    assert make(AttemptKey(0, 0, 0)).outcome.startswith("left its path")


def test_an_episode_s_certificates_say_what_is_proved(peg_dataset, peg_world, peg_annotation):
    planner = SegmentPlanner(peg_world, peg_annotation, AugmentConfig())
    for episode in peg_dataset:
        proof = episode.provenance.certificate
        assert proof["duration"] == len(episode) / 10
        assert proof["commanded"]["verdict"] == proof["measured"]["verdict"] == "free"
        assert (
            proof["commanded"]["clearance"]
            >= proof["commanded"]["margin"]
            == pytest.approx(AugmentConfig().margin + BODY_STILLNESS + proof["tracking_error"])
        )
        assert (
            proof["measured"]["clearance"]
            >= proof["measured"]["margin"]
            == pytest.approx(AugmentConfig().margin + proof["body_stillness"])
        )
        assert proof["body_stillness"] == BODY_STILLNESS
        assert 0 <= proof["deviation"] <= proof["tracking_error"] == PyBulletBackend.tracking_error
        before = planner.approach(episode.provenance.t_star)
        assert len(episode.joint_path) == len(before) + 24 * len(episode)
        np.testing.assert_allclose(episode.joint_path[len(before) - 1], before[-1], atol=1e-4)


def test_without_body_poses_nothing_can_be_proved(peg_demonstration, peg_annotation, peg_backend):
    blind = dataclasses.replace(peg_demonstration, body_Ts_world={})
    with pytest.raises(Mismatch, match="doesn't tell where 'table' was, .* observes bodies"):
        RestoreExecutor(peg_backend, [(blind, peg_annotation)], AugmentConfig()).planner(0)


def test_a_line_faster_than_the_tool_may_lead_is_rejected(
    annotate, peg_demonstration, peg_backend, peg_model
):
    make = RestoreExecutor(
        peg_backend, [(peg_demonstration, annotate((0, 0.1)))], AugmentConfig(duration=0.5)
    ).attempt
    assert "tool lags behind" in {make(AttemptKey(0, 0, k)).outcome for k in range(12)}


def test_progress_counts_kept_and_rejected_attempts(augment, crowded, crowded_dataset, tmp_path):
    calls = Interrupt(None)
    dataset = augment(crowded, tmp_path / "d", progress=calls)
    assert [kept + rejected for kept, _, rejected in calls.calls] == list(
        range(1, dataset.info["n_attempted"] + 1)
    )
    assert calls.calls[-1] == (4, 4, sum(dataset.info["rejections"].values()))
    assert dataset.content_hash == crowded_dataset.content_hash


# --- the same bytes -----------------------------------------------------------------------------


def test_two_processes_generate_the_same_as_one(augment, crowded, crowded_dataset, tmp_path):
    dataset = augment(crowded, tmp_path / "d", workers=2)
    assert dataset.content_hash == crowded_dataset.content_hash
    assert dataset.info["rejections"] == crowded_dataset.info["rejections"]
    assert dataset.info["n_attempted"] == crowded_dataset.info["n_attempted"]


@pytest.fixture(scope="module")
def interrupted(peg_demonstration, crowded, make_peg_backend, tmp_path_factory):
    """The directory of `crowded_dataset` as an interruption after a few attempts left it."""
    out = tmp_path_factory.mktemp("interrupted") / "dataset"

    def progress(kept, wanted, rejected):
        if kept == 3:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        augment_demonstration(
            peg_demonstration, crowded, make_peg_backend, out, CROWDED, progress=progress
        )
    return out


@pytest.mark.parametrize("after", [1, 6])
def test_an_interruption_changes_nothing_that_is_generated(
    augment, crowded, crowded_dataset, tmp_path, after
):
    with pytest.raises(KeyboardInterrupt):
        augment(crowded, tmp_path / "d", progress=Interrupt(after))
    assert n_attempts(tmp_path / "d") == after
    resumed = Interrupt(None)
    dataset = augment(crowded, tmp_path / "d", progress=resumed)
    assert dataset.content_hash == crowded_dataset.content_hash
    assert dataset.info["rejections"] == crowded_dataset.info["rejections"]
    assert len(resumed.calls) == dataset.info["n_attempted"] - after
    assert load_dataset(tmp_path / "d").content_hash == dataset.content_hash


def _flip_a_joint_angle(path, episode):
    content = bytearray(path.read_bytes())
    at = content.find(episode.steps.joint_positions.tobytes())
    assert at > 0
    content[at + 3] ^= 1
    path.write_bytes(content)


@pytest.mark.parametrize(
    "damage",
    [
        pytest.param(lambda path, _: path.write_bytes(path.read_bytes()[:5000]), id="truncated"),
        pytest.param(lambda path, _: path.unlink(), id="deleted"),
        pytest.param(_flip_a_joint_angle, id="one bit flipped"),
    ],
)
def test_a_damaged_episode_file_is_made_again_on_resuming(
    augment, crowded, crowded_dataset, interrupted, tmp_path, damage
):
    out = shutil.copytree(interrupted, tmp_path / "d")
    attempted = n_attempts(out)
    path = sorted(out.glob("episodes/*/*.h5"))[0]
    episodes = dict(zip((e.name for e in crowded_dataset.index), crowded_dataset, strict=True))
    damage(path, episodes[str(path.relative_to(out))])
    resumed = Interrupt(None)
    dataset = augment(crowded, out, progress=resumed)
    assert dataset.content_hash == crowded_dataset.content_hash
    assert len(resumed.calls) == dataset.info["n_attempted"] - attempted + 1


def test_a_log_whose_last_line_was_cut_is_resumed(
    augment, crowded, crowded_dataset, interrupted, tmp_path
):
    out = shutil.copytree(interrupted, tmp_path / "d")
    log = out / "manifest.jsonl"
    log.write_text(log.read_text()[:-9])
    assert augment(crowded, out).content_hash == crowded_dataset.content_hash
    assert n_attempts(out) == crowded_dataset.info["n_attempted"]


@pytest.mark.parametrize("write", ["save_demonstration", "save_annotation", "write_json"])
def test_an_interruption_while_the_directory_is_set_up_can_be_resumed(
    augment, crowded, crowded_dataset, tmp_path, monkeypatch, write
):
    def interrupt(*_):
        raise KeyboardInterrupt

    with monkeypatch.context() as patched, pytest.raises(KeyboardInterrupt):
        patched.setattr(writer, write, interrupt)
        augment(crowded, tmp_path / "d")
    assert augment(crowded, tmp_path / "d").content_hash == crowded_dataset.content_hash


_KILLED = """
import functools, sys
from pathlib import Path
from sart_toolkit.augment.config import AugmentConfig
from sart_toolkit.augment.engine import augment_demonstration
from sart_toolkit.backends import make_backend
from sart_toolkit.data.storage import load_annotation, load_demonstration
from sart_toolkit.robots import get_robot
from sart_toolkit.tasks import get_task

path = Path(sys.argv[1])
task = get_task("peg_in_hole")
demonstration = load_demonstration(path / "demo.h5")
size = demonstration.steps.cameras["wrist"].rgb.shape[1]
make = functools.partial(make_backend, "pybullet", get_robot(task.robot), task.scene, size)
augment_demonstration(
    demonstration, load_annotation(path / "annotation.json"), make, path / "d",
    AugmentConfig(n=5, seed=3, duration=0.8), workers=int(sys.argv[2]),
    progress=lambda *counts: print(*counts, flush=True),
)
"""


@pytest.mark.parametrize("workers", [1, 2])
def test_killed_it_resumes_to_the_same(
    augment, crowded, crowded_dataset, peg_demonstration, tmp_path, workers
):
    save_demonstration(tmp_path / "demo.h5", peg_demonstration)
    save_annotation(tmp_path / "annotation.json", crowded)
    for lines in (1, 3):
        process = subprocess.Popen(
            [sys.executable, "-c", _KILLED, str(tmp_path), str(workers)],
            stdout=subprocess.PIPE,
            start_new_session=True,
        )
        for _ in range(lines):
            assert process.stdout.readline()
        os.killpg(process.pid, signal.SIGKILL)
        process.communicate()
        assert n_attempts(tmp_path / "d") >= lines
    dataset = augment(crowded, tmp_path / "d")
    assert dataset.content_hash == crowded_dataset.content_hash
    assert [e.content_hash() for e in dataset] == [e.content_hash for e in crowded_dataset.index]


_CHAIN = """
import sys
import numpy as np
from pathlib import Path
from sart_toolkit.augment.config import AugmentConfig
from sart_toolkit.augment.engine import augment_demonstration
from sart_toolkit.backends import make_backend
from sart_toolkit.robots import get_robot
from sart_toolkit.robots.model import RobotModel
from sart_toolkit.tasks import get_task
from sart_toolkit.tasks.task import Placement
from sart_toolkit.record.scripted import ScriptedOperator
from sart_toolkit.record.session import record_demonstration
from sart_toolkit.collision.exact import ExactWorld
from sart_toolkit.annotate.suggest import suggest_annotation

task = get_task("peg_in_hole")
robot = get_robot(task.robot)
model = RobotModel(robot, task.scene.held)
make = lambda: make_backend("pybullet", robot, task.scene, int(sys.argv[2]))
operator = ScriptedOperator(
    task.plan(task.initial_state(model, Placement())), np.random.default_rng(0)
)
demonstration = record_demonstration(make(), task, model, operator, seed=0)
scene = ExactWorld(demonstration, robot, task.scene)
annotation = suggest_annotation(demonstration, scene)
config = AugmentConfig(n=5)
dataset = augment_demonstration(demonstration, annotation, make, Path(sys.argv[1]), config)
print()
print(dataset.content_hash)
"""


def test_another_process_generates_the_same_from_the_same_seeds(peg_dataset, tmp_path):
    size = peg_dataset.sources[0].demonstration.steps.cameras["wrist"].rgb.shape[1]
    result = subprocess.run(
        [sys.executable, "-c", _CHAIN, str(tmp_path / "d"), str(size)],
        capture_output=True,
        text=True,
    )
    assert result.returncode == 0, result.stderr
    assert result.stdout.splitlines()[-1] == peg_dataset.content_hash


def test_another_seed_generates_something_else(peg_annotation, augment, peg_dataset, tmp_path):
    other = augment(peg_annotation, tmp_path / "d", AugmentConfig(n=5, seed=1))
    assert other.content_hash != peg_dataset.content_hash


def test_a_finished_dataset_is_returned_without_another_attempt(
    augment, crowded, crowded_dataset, tmp_path
):
    augment(crowded, tmp_path / "d")
    again = augment(crowded, tmp_path / "d", progress=Interrupt(1), workers=2)
    assert again.content_hash == crowded_dataset.content_hash
    assert again.info["seconds"] > 0


def test_how_long_an_interrupted_generation_took_is_not_claimed(crowded, augment, tmp_path):
    with pytest.raises(KeyboardInterrupt):
        augment(crowded, tmp_path / "d", progress=Interrupt(3))
    assert augment(crowded, tmp_path / "d").info["seconds"] is None


# --- several demonstrations ---------------------------------------------------------------------


@pytest.fixture(scope="module")
def two_sources(peg_task, peg_model, make_peg_backend, peg_demonstration):
    """Two demonstrations of peg-in-hole, the second with another hand, and a sphere of each."""
    operator = ScriptedOperator(
        peg_task.plan(peg_task.initial_state(peg_model, Placement())), np.random.default_rng(7)
    )
    with closing(make_peg_backend()) as backend:
        other = record_demonstration(backend, peg_task, peg_model, operator, seed=7)
    sources = []
    for demonstration, radius in ((peg_demonstration, 0.04), (other, 0.02)):
        sphere = PrecisionSphere(2, demonstration.steps.measured_Ts_world_tool[2], radius)
        sources.append((demonstration, Annotation((sphere,), demonstration.content_hash())))
    return sources


def test_the_spheres_of_all_demonstrations_share_the_trajectories(
    two_sources, make_peg_backend, peg_backend, peg_task, tmp_path
):
    config = AugmentConfig(n=8, cameras=(), duration=1.0)
    one, two = (
        augment_sources(two_sources, make_peg_backend, tmp_path / str(workers), config, workers)
        for workers in (1, 2)
    )
    assert one.content_hash == two.content_hash
    assert [entry.source for entry in one.index].count(0) == 4
    assert one.info["n_trajectories"] == 8
    for entry, episode in zip(one.index, one, strict=True):
        demonstration = one.sources[entry.source].demonstration
        p = episode.provenance
        assert p.demonstration_hash == demonstration.content_hash()
        Ts, _ = episode.commands(demonstration)
        actions = episode.actions(demonstration)
        for t in range(len(Ts) - 1):
            np.testing.assert_allclose(apply_action(Ts[t], actions[t])[0], Ts[t + 1], atol=1e-9)
    # The same attempts from different demonstrations are drawn apart.
    firsts = [episode.provenance.T_world_sampled for episode in one][:2]
    keys = [source.annotation.spheres[0].T_world_key for source in one.sources]
    directions = [(T - key)[:3, 3] / np.linalg.norm((T - key)[:3, 3])
                  for T, key in zip(firsts, keys, strict=True)]  # fmt: skip
    assert directions[0] @ directions[1] < 0.99
    found = validate_dataset(tmp_path / "1", peg_backend.robot, peg_task.scene)
    assert found.problems == {} and found.episodes == 6


def test_a_demonstration_s_episodes_do_not_depend_on_those_after_it(
    two_sources, make_peg_backend, tmp_path
):
    config = AugmentConfig(n=6, cameras=(), duration=1.0, allocation="equal")
    both = augment_sources(two_sources, make_peg_backend, tmp_path / "both", config)
    config = dataclasses.replace(config, n=3)
    alone = augment_sources(two_sources[:1], make_peg_backend, tmp_path / "alone", config)
    of_first = [entry.content_hash for entry in both.index if entry.source == 0]
    assert of_first == [entry.content_hash for entry in alone.index]


def test_by_a_strategy_that_draws_nothing_the_dataset_is_its_demonstrations(
    two_sources, make_peg_backend, tmp_path
):
    sources = [(demonstration, None) for demonstration, _ in two_sources]
    config = AugmentConfig(n=2, strategy="bc", cameras=())
    dataset = augment_sources(sources, make_peg_backend, tmp_path / "d", config)
    assert len(dataset) == 0 and dataset.info["n_trajectories"] == 2
    assert [source.annotation for source in dataset.sources] == [None, None]
    for source, (demonstration, _) in zip(dataset.sources, sources, strict=True):
        assert source.demonstration.content_hash() == demonstration.content_hash()
    with pytest.raises(InvalidInput, match=r"'bc' draws nothing.*demonstrations \(2\), got 3"):
        augment_sources(sources, make_peg_backend, tmp_path / "e", dataclasses.replace(config, n=3))


def test_a_strategy_that_draws_from_annotations_is_refused_without_one(
    two_sources, make_peg_backend, tmp_path
):
    sources = [two_sources[0], (two_sources[1][0], None)]
    with pytest.raises(InvalidInput, match="demonstration has none; make one with `sart suggest`"):
        augment_sources(sources, make_peg_backend, tmp_path / "d", AugmentConfig(n=5))
    assert not (tmp_path / "d").exists()


# --- executors ----------------------------------------------------------------------------------


class Backwards(RestoreExecutor):
    """Makes its attempts in an order of its own, which takes one process."""

    parallel = False

    def attempts(self, keys, spare=no_spare):
        return map(self.attempt, reversed(list(keys)))


def test_an_executor_may_choose_its_order_and_changes_nothing_by_it(
    augment, crowded, crowded_dataset, tmp_path, monkeypatch
):
    monkeypatch.setattr(engine, "get_executor", lambda *_: Backwards)
    with pytest.raises(InvalidInput, match="workers: execution 'auto' needs 1 process, got 2"):
        augment(crowded, tmp_path / "d", workers=2)
    assert augment(crowded, tmp_path / "d").content_hash == crowded_dataset.content_hash


def test_an_unknown_executor_is_refused_with_the_nearest_name(annotate, augment, tmp_path):
    with pytest.raises(UnknownName, match="executor 'restroe': did you mean 'restore'"):
        augment(annotate((0, 0.05)), tmp_path / "d", AugmentConfig(execution="restroe"))
    assert not (tmp_path / "d").exists()


# --- refusals -----------------------------------------------------------------------------------


@pytest.mark.parametrize("finished", [True, False])
def test_a_directory_made_with_other_settings_is_left_alone_unless_overwritten(
    annotate, augment, peg_demonstration, make_peg_backend, tmp_path, finished
):
    annotation, out = annotate((0, 0.03)), tmp_path / "d"

    def larger():
        backend = make_peg_backend()
        backend.image_size = (64, 64)
        return backend

    config = AugmentConfig(n=3, duration=0.8)
    if finished:
        augment(annotation, out, config)
    else:
        with pytest.raises(KeyboardInterrupt):
            augment(annotation, out, config, progress=Interrupt(1))
    before = {path: path.stat().st_mtime_ns for path in out.rglob("*")}
    for changed, differing in (
        (
            lambda: augment(annotation, out, dataclasses.replace(config, n=2)),
            r"request.config.n 3, now 2\)",
        ),
        (
            lambda: augment(annotation, out, dataclasses.replace(config, seed=1)),
            r"request.config.seed 0, now 1\)",
        ),
        (
            lambda: augment_demonstration(peg_demonstration, annotation, larger, out, config),
            r"request.image_size.0 48, now 64, request.image_size.1 48, now 64\)",
        ),
        (lambda: augment(annotate((0, 0.031)), out, config), r"sources.0.annotation .*, now .*\)"),
    ):
        with pytest.raises(
            OutputExists, match=rf"made with other settings \({differing}; add --over"
        ):
            changed()
    assert {path: path.stat().st_mtime_ns for path in out.rglob("*")} == before
    smaller = augment(annotation, out, dataclasses.replace(config, n=2), overwrite=True)
    assert len(smaller) == 1
    assert len(list(out.glob("episodes/*/*.h5"))) == 1


def test_a_directory_with_something_else_in_it_is_left_alone(annotate, augment, tmp_path):
    (tmp_path / "notes.txt").write_text("mine")
    with pytest.raises(OutputExists, match="already exists; add --overwrite"):
        augment(annotate((0, 0.05)), tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["notes.txt"]


def test_a_place_that_cannot_be_written_is_refused(annotate, augment, tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(CannotWrite, match="is not a directory"):
        augment(annotate((0, 0.05)), tmp_path / "file" / "d")


def test_an_annotation_of_another_demonstration_is_refused(peg_annotation, augment, tmp_path):
    other = dataclasses.replace(peg_annotation, demonstration_hash="0" * 64)
    with pytest.raises(Mismatch, match="made for another demonstration"):
        augment(other, tmp_path / "d")
    assert not (tmp_path / "d").exists()


def test_a_demonstration_without_states_is_refused(
    peg_demonstration, peg_annotation, make_peg_backend, tmp_path
):
    bare = dataclasses.replace(peg_demonstration, states=())
    spheres = dataclasses.replace(peg_annotation, demonstration_hash=bare.content_hash())
    with pytest.raises(Mismatch, match="holds no saved states"):
        config = AugmentConfig(execution="restore")
        augment_demonstration(bare, spheres, make_peg_backend, tmp_path / "d", config)
    assert not (tmp_path / "d").exists()


@pytest.mark.parametrize("workers", [1, 2])
def test_a_backend_that_cannot_restore_is_refused_and_closed(
    peg_demonstration, peg_annotation, peg_backend, limited, monkeypatch, tmp_path, workers
):
    closed = []
    arm = limited(peg_backend, Resets)
    monkeypatch.setattr(arm, "close", lambda: closed.append(True))
    message = "backend 'limited' lacks the ability SavesStates, but segments start from"
    with pytest.raises(MissingCapability, match=message):
        augment_demonstration(
            peg_demonstration, peg_annotation, lambda: arm, tmp_path / "d",
            AugmentConfig(execution="restore"), workers,
        )  # fmt: skip
    assert closed == [True] and not (tmp_path / "d").exists()


def test_an_attempt_on_a_backend_that_cannot_restore_is_refused(
    peg_demonstration, peg_annotation, peg_backend, limited
):
    arm = limited(peg_backend, Resets)
    executor = RestoreExecutor(arm, [(peg_demonstration, peg_annotation)], AugmentConfig())
    with pytest.raises(MissingCapability, match="lacks the ability SavesStates, but segments"):
        executor.attempt(AttemptKey(0, 0, 0))


def test_a_backend_without_images_is_refused_unless_none_are_wanted(
    peg_demonstration, peg_backend, limited
):
    blind = limited(peg_backend, SavesStates, KnowsBodies)
    blind.no_images, blind.name = "it has no eyes", peg_backend.name
    with pytest.raises(MissingCapability, match="takes no images: it has no eyes"):
        RestoreExecutor.check(blind, [peg_demonstration], AugmentConfig())
    RestoreExecutor.check(blind, [peg_demonstration], AugmentConfig(cameras=()))


def test_a_backend_at_other_rates_than_the_demonstration_s_is_refused(
    peg_demonstration, peg_backend
):
    slow = dataclasses.replace(peg_demonstration, rates=Rates(record_hz=5))
    with pytest.raises(Mismatch, match="rates: the demonstration was recorded with .*record_hz=5"):
        RestoreExecutor.check(peg_backend, [slow], AugmentConfig())


def test_a_segment_that_the_robot_can_t_follow_is_rejected(
    peg_demonstration, peg_annotation, peg_backend, monkeypatch
):
    command = peg_backend.command

    def cut_short(q, gripper):
        return dataclasses.replace(command(q, gripper), q=q - 1e-3)

    monkeypatch.setattr(peg_backend, "command", cut_short)
    sources = [(peg_demonstration, peg_annotation)]
    make = RestoreExecutor(peg_backend, sources, AugmentConfig()).attempt
    assert make(AttemptKey(0, 0, 0)).outcome == "command cut short"


@pytest.mark.parametrize("workers", [0, -1])
def test_at_least_one_process_is_needed(annotate, augment, tmp_path, workers):
    with pytest.raises(InvalidInput, match=f"workers: expected at least 1, got {workers}"):
        augment(annotate((0, 0.05)), tmp_path / "d", workers=workers)


def test_an_unknown_camera_is_refused_with_the_nearest_name(annotate, augment, tmp_path):
    with pytest.raises(UnknownName, match="camera 'wirst': did you mean 'wrist'"):
        augment(annotate((0, 0.05)), tmp_path / "d", AugmentConfig(cameras=("wirst",)))


@pytest.mark.parametrize("mistake", ["workers", "camera", "backend", "annotation"])
def test_a_request_that_is_refused_replaces_nothing_even_if_it_may_overwrite(
    annotate, peg_demonstration, make_peg_backend, limited, interrupted, tmp_path, mistake
):
    out = shutil.copytree(interrupted, tmp_path / "d")
    annotation, make, config, workers = annotate((0, 0.05)), make_peg_backend, CROWDED, 1
    if mistake == "workers":
        workers = 0
    elif mistake == "camera":
        config = dataclasses.replace(CROWDED, cameras=("wirst",))
    elif mistake == "backend":

        def make():
            return limited(make_peg_backend())
    else:
        annotation = dataclasses.replace(annotation, demonstration_hash="0" * 64)
    with pytest.raises(SartError, match="workers|wirst|lacks the ability|another demonstration"):
        augment_demonstration(
            peg_demonstration, annotation, make, out, config, workers, overwrite=True
        )
    for path in interrupted.rglob("*.*"):
        assert (out / path.relative_to(interrupted)).read_bytes() == path.read_bytes()


@pytest.mark.parametrize(
    ("changes", "error", "message"),
    [
        ({"n": 1}, InvalidInput, "n: expected at least 2"),
        ({"seed": -1}, InvalidInput, "seed: expected a whole number >= 0"),
        ({"duration": 0.0}, InvalidInput, "duration: expected a finite number > 0"),
        ({"duration": np.nan}, InvalidInput, "duration: expected a finite number > 0"),
        ({"margin": -0.001}, InvalidInput, "margin: expected a finite number >= 0 m"),
        ({"strategy": "srat"}, UnknownName, "did you mean 'sart'"),
    ],
)
def test_a_bad_setting_is_refused(changes, error, message):
    with pytest.raises(error, match=message):
        AugmentConfig(**changes)
