"""What is recorded on backends that lack abilities, with other cameras, and at other rates."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from sart_toolkit.annotate.suggest import suggest_annotation
from sart_toolkit.augment.config import AugmentConfig
from sart_toolkit.augment.engine import augment_demonstration
from sart_toolkit.augment.executors import RestoreExecutor
from sart_toolkit.augment.validate import validate_dataset
from sart_toolkit.backends import make_backend
from sart_toolkit.backends.interface import CommandSent, Draws, KnowsBodies, Resets, SensesForce
from sart_toolkit.collision.cloud import CloudConfig, fuse_cloud
from sart_toolkit.collision.exact import ExactWorld
from sart_toolkit.data.manifest import KEPT, AttemptKey
from sart_toolkit.data.records import Rates
from sart_toolkit.data.storage import load_demonstration, save_demonstration
from sart_toolkit.errors import InvalidInput, Mismatch, MissingCapability
from sart_toolkit.evaluate.rollout import run_rollout
from sart_toolkit.record.desk import RecordingDesk
from sart_toolkit.record.devices.keyboard import Keyboard
from sart_toolkit.record.devices.manual import Control
from sart_toolkit.record.replay import replay_demonstration
from sart_toolkit.record.scripted import ScriptedOperator
from sart_toolkit.record.session import (
    SessionConfig,
    TeleopCommand,
    TeleopSession,
    record_demonstration,
)
from sart_toolkit.report.player import Playback, SceneView
from sart_toolkit.robots import get_robot
from sart_toolkit.robots.spec import CameraSpec
from sart_toolkit.tasks.task import Placement

BLIND = SessionConfig(cameras=())


def operator(task, model, hz=30, seed=0):
    plan = task.plan(task.initial_state(model, Placement()))
    return ScriptedOperator(plan, np.random.default_rng(seed), control_hz=hz)


# --- abilities ----------------------------------------------------------------------------------


@pytest.fixture
def core(make_peg_backend, peg_task, peg_model, limited):
    """A backend of the core alone; somebody has put the robot at the task's start."""
    inner = make_peg_backend()
    inner.reset(peg_task.initial_state(peg_model, Placement()))
    yield limited(inner)
    inner.close()


def test_a_robot_that_can_do_nothing_but_move_is_recorded_from_where_it_is(
    core, peg_task, peg_model, peg_demonstration
):
    demo = record_demonstration(core, peg_task, peg_model, operator(peg_task, peg_model))
    steps = peg_demonstration.steps
    np.testing.assert_allclose(
        demo.steps.measured_Ts_world_tool[0], steps.measured_Ts_world_tool[0], atol=1e-4
    )
    np.testing.assert_allclose(
        demo.steps.commanded_Ts_world_tool[-1], steps.commanded_Ts_world_tool[-1], atol=5e-3
    )
    assert demo.body_Ts_world == {} and demo.states == ()
    assert np.isnan(demo.steps.contact_force).all()
    assert demo.judged_by == "nobody" and not demo.success.any()
    assert demo.steps.cameras["wrist"].rgb.any()


def test_a_force_is_recorded_where_only_a_force_is_felt(core, peg_task, peg_model, limited):
    arm = limited(core.inner, SensesForce)
    demo = record_demonstration(arm, peg_task, peg_model, operator(peg_task, peg_model), None, 0)
    assert (demo.steps.contact_force >= 0).all() and not any(demo.touching)


def test_a_recording_that_does_not_end_says_why_its_success_is_unknown(core, peg_task, peg_model):
    with pytest.raises(
        InvalidInput, match="'limited' can't tell, since it lacks KnowsBodies; steer"
    ):
        record_demonstration(
            core, peg_task, peg_model, operator(peg_task, peg_model),
            config=dataclasses.replace(BLIND, max_seconds=0.5),
        )  # fmt: skip


def test_a_person_says_whether_the_goal_was_reached_where_the_backend_can_t(
    core, peg_task, peg_model, peg_setup
):
    session = TeleopSession(core, peg_task, peg_model)
    keyboard, saved = Keyboard(dataclasses.replace(peg_setup, backend=core)), []
    keyboard.connect()
    desk = RecordingDesk(session, keyboard, saved.append)
    desk.press(Control.NEXT)
    for _ in range(60):
        desk.tick()
    desk.press(Control.NEXT)
    assert "Was the goal reached? → saves it as reached" in desk.notice.text
    desk.press(Control.NEXT)
    (demo,) = saved
    assert demo.judged_by == "person" and peg_task.achieved(demo.success)
    assert not demo.success[: -round(peg_task.hold * 10)].any()


def test_time_is_as_the_robot_measured_it_without_pauses(core, peg_task, peg_model, monkeypatch):
    """A clock that goes on while the robot stands, and once loses a second while it moves."""
    lost, observe = [0.0], core.observe

    def delayed(*args):
        seen = observe(*args)
        return dataclasses.replace(seen, time=seen.time + lost[0])

    monkeypatch.setattr(core, "observe", delayed)
    session = TeleopSession(core, peg_task, peg_model, config=BLIND)
    still = TeleopCommand(np.zeros(6), 0.67)
    for gap in (7.0, 5.0):  # before the start, and in a pause
        lost[0] += gap
        session.start()
        for _ in range(9):
            session.advance(still)
        session.pause()
    session.start()
    lost[0] += 1.0
    session.advance(still)
    session.stop()
    times = session.demonstration("operator", "device", 1.0).timestamps
    np.testing.assert_allclose(times, [0, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 1.7], atol=1e-6)


def test_a_person_s_word_is_not_asked_where_the_backend_tells(peg_backend, peg_task, peg_model):
    session = TeleopSession(peg_backend, peg_task, peg_model, config=BLIND)
    session.start()
    session.stop()
    with pytest.raises(InvalidInput, match="say_reached: this backend itself decides"):
        session.say_reached()


def test_what_needs_an_ability_names_it_and_says_what_for(
    core, peg_task, peg_model, peg_demonstration, peg_annotation, limited
):
    config = AugmentConfig(cameras=())
    with pytest.raises(MissingCapability, match="lacks the ability SavesStates, but segments"):
        RestoreExecutor.check(core, [peg_demonstration], config)
    with pytest.raises(MissingCapability, match="lacks the ability Draws, but a recording"):
        SceneView(Playback("demo.h5", peg_demonstration), core, "overview")
    for backend, message in (
        (core, "lacks the ability KnowsBodies, but the success of task 'peg_in_hole' is judged"),
        (limited(core.inner, KnowsBodies), "lacks the ability Resets, but a rollout begins at"),
    ):
        with pytest.raises(MissingCapability, match=message):
            run_rollout(None, peg_task, backend, peg_model, Placement())


def test_what_a_robot_was_really_sent_is_what_is_recorded(
    peg_backend, peg_task, peg_model, limited, monkeypatch
):
    """And the next command continues from there."""
    arm, sent = limited(peg_backend, Resets, KnowsBodies), []

    def half_as_far(q, gripper):
        here = sent[-1].q if sent else arm.observe().q
        sent.append(CommandSent(here + 0.5 * (q[-1] - here), min(gripper, 0.6)))
        return peg_backend.command(sent[-1].q, sent[-1].gripper) and sent[-1]

    monkeypatch.setattr(arm, "command", half_as_far)
    demo = record_demonstration(
        arm, peg_task, peg_model, operator(peg_task, peg_model), config=BLIND
    )
    every_third = np.array([command.q for command in sent[2::3]])
    np.testing.assert_array_equal(demo.steps.commanded_joint_positions[1:], every_third)
    assert (demo.steps.commanded_gripper[1:] <= 0.6).all()
    for q, T in zip(every_third, demo.steps.commanded_Ts_world_tool[1:], strict=True):
        np.testing.assert_allclose(peg_model.fk(q), T, atol=1e-5)


# --- cameras ------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def seen_twice(peg_task, peg_model, tmp_path_factory):
    """A demonstration with rectangular images of wrist and overview, read from its file."""
    robot = get_robot(peg_task.robot)
    backend = make_backend("pybullet", robot, peg_task.scene, "64x48")
    config = SessionConfig(("wrist", "overview"))
    device = operator(peg_task, peg_model)
    demo = record_demonstration(backend, peg_task, peg_model, device, config=config)
    views = [row.T_world_camera for row in backend.observe(("wrist", "overview")).cameras.values()]
    backend.close()
    path = tmp_path_factory.mktemp("seen") / "demo.h5"
    save_demonstration(path, demo)
    return load_demonstration(path), views


def test_cameras_are_recorded_with_the_frame_that_they_are_mounted_on(seen_twice, peg_task):
    demo, (wrist_at_end, overview_at_end) = seen_twice
    cameras, Ts = demo.steps.cameras, demo.steps.measured_Ts_world_tool
    assert {name: camera.frame for name, camera in cameras.items()} == {
        "wrist": "tool", "overview": "world",
    }  # fmt: skip
    overview = peg_task.scene.cameras[0].T_frame_camera
    np.testing.assert_allclose(cameras["overview"].T_frame_camera, overview, atol=1e-12)
    Ts_overview = cameras["overview"].Ts_world_camera(Ts)
    assert Ts_overview.shape == Ts.shape
    np.testing.assert_allclose(Ts_overview - overview_at_end, 0, atol=1e-12)
    np.testing.assert_allclose(cameras["wrist"].Ts_world_camera(Ts)[-1], wrist_at_end, atol=1e-5)


def test_rectangular_images_are_recorded_with_their_intrinsics(seen_twice, peg_task):
    demo, _ = seen_twice
    for spec in (get_robot(peg_task.robot).cameras[0], peg_task.scene.cameras[0]):
        camera = demo.steps.cameras[spec.name]
        assert camera.rgb.shape[1:] == (48, 64, 3)
        np.testing.assert_array_equal(camera.intrinsics, spec.intrinsics(64, 48))


@pytest.mark.parametrize("cameras", [("wrist",), ("overview",), ("wrist", "overview")])
def test_the_block_is_where_it_is_in_a_cloud_of_any_cameras(seen_twice, peg_task, cameras):
    demo, _ = seen_twice
    kept = {name: demo.steps.cameras[name] for name in cameras}
    steps = dataclasses.replace(demo.steps, cameras=kept)
    config = CloudConfig(unknown="free", far=2.0)
    cloud = fuse_cloud(
        dataclasses.replace(demo, steps=steps), get_robot(peg_task.robot), peg_task.scene.held,
        config=config,
    )  # fmt: skip
    T = demo.body_Ts_world["block"][0]
    p = (cloud.points - T[:3, 3]) @ T[:3, :3]
    wood = (np.abs(p[:, :2]) < 0.08).all(1) & (np.abs(p[:, 2]) < 0.06) & (p[:, 2] > 0.015)
    assert wood.sum() > 50
    (block,) = (body for body in peg_task.scene.bodies if body.name == "block")
    corners = np.concatenate([shape.corners() for shape in block.shapes])
    low, high = corners.min(0) - 0.01, corners.max(0) + 0.01
    assert ((p[wood] > low) & (p[wood] < high)).all(1).mean() > 0.98


def test_segments_are_seen_by_the_demonstration_s_cameras(seen_twice, peg_task, tmp_path):
    demo, _ = seen_twice
    robot = get_robot(peg_task.robot)
    annotation = suggest_annotation(demo, ExactWorld(demo, robot, peg_task.scene), [4])

    def make():
        return make_backend("pybullet", robot, peg_task.scene, (64, 48))

    made = augment_demonstration(demo, annotation, make, tmp_path / "d", AugmentConfig(n=2))
    for name, camera in made.episode(0).steps.cameras.items():
        reference = demo.steps.cameras[name]
        assert camera.rgb.shape[1:] == reference.rgb.shape[1:] and camera.frame == reference.frame
        np.testing.assert_allclose(camera.T_frame_camera, reference.T_frame_camera, atol=1e-5)


def test_a_camera_on_the_arm_before_the_tool_is_refused(peg_task, peg_model):
    robot = get_robot(peg_task.robot)
    elbow = CameraSpec("elbow", "forearm_link", np.eye(4))
    base = CameraSpec("base", "base_link", np.eye(4))
    robot = dataclasses.replace(robot, cameras=(*robot.cameras, elbow, base))
    backend = make_backend("pybullet", robot, peg_task.scene, 16)
    with pytest.raises(InvalidInput, match="camera 'elbow': its frame 'forearm_link' neither"):
        TeleopSession(backend, peg_task, peg_model, config=SessionConfig(("elbow",)))
    session = TeleopSession(backend, peg_task, peg_model, config=SessionConfig(("base",)))
    session.start()
    session.stop()
    demo = session.demonstration("test", "none", 0.0)
    assert demo.steps.cameras["base"].frame == "world"
    backend.close()


# --- rates --------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["pybullet", "sapien"])
def test_a_demonstration_and_its_segments_at_other_rates(peg_task, peg_model, name, tmp_path):
    """Recorded, saved, annotated, generated and validated at 15 Hz, commanded at 60 Hz."""
    rates, robot = Rates(physics_hz=240, control_hz=60, record_hz=15), get_robot(peg_task.robot)

    def make():
        return make_backend(name, robot, peg_task.scene, 32, rates)

    backend = make()
    device = operator(peg_task, peg_model, rates.control_hz)
    demo = record_demonstration(backend, peg_task, peg_model, device, config=BLIND)
    assert demo.rates == rates and peg_task.achieved(demo.success, rates.record_hz)
    assert len(demo.raw_commands) == 4 * (len(demo) - 1)
    np.testing.assert_allclose(np.diff(demo.timestamps), 1 / 15)
    assert 3.0 < demo.timestamps[-1] < 12.0
    save_demonstration(tmp_path / "demo.h5", demo)
    assert load_demonstration(tmp_path / "demo.h5").rates == rates
    annotation = suggest_annotation(demo, ExactWorld(demo, robot, peg_task.scene), [4])
    attempt = RestoreExecutor(backend, [(demo, annotation)], AugmentConfig()).attempt(
        AttemptKey(0, 0, 0)
    )
    assert attempt.outcome == KEPT, attempt.detail
    # Two seconds, or as much longer as the joints need, in whole steps.
    duration = (attempt.episode.provenance.certificate or {})["duration"]
    assert len(attempt.episode) == round(15 * duration)
    augment_demonstration(demo, annotation, make, tmp_path / "d", AugmentConfig(n=2))
    assert validate_dataset(tmp_path / "d", robot, peg_task.scene).problems == {}
    backend.close()


def test_commands_are_replayed_at_their_own_rate_only(
    peg_demonstration, peg_backend, peg_task, peg_model
):
    fast = dataclasses.replace(peg_demonstration, rates=Rates(control_hz=60))
    with pytest.raises(Mismatch, match="replay: the demonstration is of control rate 60, not 30"):
        replay_demonstration(fast, peg_backend, peg_task, peg_model)


def test_a_skill_that_acts_more_often_than_the_backend_is_commanded_is_refused(
    limited, peg_backend, peg_task, peg_model, peg_demonstration
):
    class Skill:
        demonstration = dataclasses.replace(peg_demonstration, rates=Rates(240, 60, 20))

    with pytest.raises(InvalidInput, match=r"control_hz: expected a multiple of record_hz \(20 Hz"):
        run_rollout(Skill(), peg_task, peg_backend, peg_model, Placement())


def test_films_need_a_drawing_ability_and_bodies_only(peg_demonstration, peg_backend, limited):
    stage = limited(peg_backend, Draws)
    image = SceneView(Playback("demo.h5", peg_demonstration), stage, "overview").image(0, 24)
    assert image.shape == (24, 24, 3) and image.std() > 5
