"""Playing a recording: which images and facts belong to which step."""

from __future__ import annotations

import dataclasses
import functools

import numpy as np
import pytest

from sart_toolkit.annotate.suggest import suggest_annotation
from sart_toolkit.augment.config import AugmentConfig
from sart_toolkit.augment.engine import augment_demonstration
from sart_toolkit.backends import make_backend
from sart_toolkit.backends.interface import Draws, Resets
from sart_toolkit.backends.pybullet import PyBulletBackend
from sart_toolkit.collision.exact import ExactWorld
from sart_toolkit.errors import InvalidInput, MissingCapability, UnknownName
from sart_toolkit.record.scripted import ScriptedOperator
from sart_toolkit.record.session import record_demonstration
from sart_toolkit.report.player import Playback, PlayWindow, SceneView, film
from sart_toolkit.robots import get_robot
from sart_toolkit.robots.model import RobotModel
from sart_toolkit.tasks import get_task
from sart_toolkit.tasks.task import Placement


@pytest.fixture
def demonstration(peg_demonstration):
    return Playback("demo.h5", peg_demonstration)


@pytest.fixture
def episode(peg_dataset):
    return Playback("episode.h5", peg_dataset.sources[0].demonstration, peg_dataset.episode(0))


def test_a_demonstration_is_played_from_its_first_step_to_its_last(
    demonstration, peg_demonstration
):
    assert len(demonstration) == len(peg_demonstration) and demonstration.split == 0
    assert demonstration.seconds == pytest.approx(peg_demonstration.timestamps[-1])
    for i in (0, 7, len(demonstration) - 1):
        image = peg_demonstration.steps.cameras["wrist"].rgb[i]
        np.testing.assert_array_equal(demonstration.image(i), image)
        assert demonstration.waypoint(i) == i and demonstration.part(i) == "demonstration"
        assert demonstration.force(i) == peg_demonstration.steps.contact_force[i]
        assert demonstration.success(i) == peg_demonstration.success[i]


def test_an_episode_is_its_segment_and_then_the_demonstration_from_where_it_joins(
    episode, peg_dataset
):
    made, demo = peg_dataset.episode(0), peg_dataset.sources[0].demonstration
    t_star = made.provenance.t_star
    n = len(made)
    assert len(episode) == n + len(demo) - t_star and episode.split == n
    assert episode.part(n - 1) == "segment" and episode.part(n) == "demonstration"
    np.testing.assert_array_equal(episode.image(0), made.steps.cameras["wrist"].rgb[0])
    np.testing.assert_array_equal(episode.image(n), demo.steps.cameras["wrist"].rgb[t_star])
    assert episode.waypoint(0) == episode.waypoint(n) == t_star
    assert episode.waypoint(len(episode) - 1) == len(demo) - 1
    assert not any(episode.success(i) for i in range(n)) and episode.success(len(episode) - 1)


def test_the_scene_is_drawn_with_the_robot_where_it_was(demonstration, peg_backend):
    scene = SceneView(demonstration, peg_backend, "overview")
    demo = demonstration.demonstration
    last = len(demonstration) - 1
    for i in (0, last):
        drawn = scene.image(i, 64)
        peg_backend.restore(demo.states[i])
        exact = peg_backend.observe(("overview",), 64).cameras["overview"].rgb
        assert np.abs(drawn.astype(int) - exact).mean() < 0.5
    assert (scene.image(0, 64) != scene.image(last, 64)).any()


@pytest.fixture
def drawn_states(monkeypatch):
    """The states that are drawn from here on."""
    states, draw = [], PyBulletBackend.draw

    def noted(self, state, *options):
        states.append(state)
        return draw(self, state, *options)

    monkeypatch.setattr(PyBulletBackend, "draw", noted)
    return states


def test_a_segment_s_robot_is_where_its_joints_were(
    episode, peg_backend, peg_model, peg_dataset, drawn_states
):
    SceneView(episode, peg_backend, "overview").image(0, 32)
    measured = peg_dataset.episode(0).steps.measured_Ts_world_tool[0]
    np.testing.assert_allclose(peg_model.fk(drawn_states[0].q), measured, atol=1e-6)


def test_a_scene_is_drawn_by_a_backend_that_can_do_nothing_else(
    demonstration, peg_backend, limited
):
    stage = limited(peg_backend, Draws)
    expected = SceneView(demonstration, peg_backend, "overview").image(3, 32)
    np.testing.assert_array_equal(
        SceneView(demonstration, stage, "overview").image(3, 32), expected
    )


def test_a_backend_that_does_not_draw_is_refused(demonstration, peg_backend, limited):
    with pytest.raises(
        MissingCapability, match="lacks the ability Draws, but a recording is drawn"
    ):
        SceneView(demonstration, limited(peg_backend, Resets), "overview")


def test_what_is_carried_moves_with_the_tool_in_a_segment(tmp_path, drawn_states):
    task = get_task("toolbox_picking")
    robot = get_robot(task.robot)
    make = functools.partial(make_backend, "pybullet", robot, task.scene, 32)
    backend, model = make(), RobotModel(robot, task.scene.held)
    plan = task.plan(task.initial_state(model, Placement()))
    operator = ScriptedOperator(plan, np.random.default_rng(0))
    demo = record_demonstration(backend, task, model, operator)
    scene = ExactWorld(demo, robot, task.scene)
    grasped = [t for t, phase in enumerate(scene.phases) if phase.grasped]
    spheres = suggest_annotation(demo, scene, [grasped[len(grasped) // 2]])
    made = augment_demonstration(demo, spheres, make, tmp_path / "d", AugmentConfig(n=2))
    playback = Playback("episode.h5", demo, made.episode(0))
    SceneView(playback, backend, "overview").image(0, 32)
    (now,) = drawn_states
    T_world_tool = model.fk(now.q)
    t = playback.waypoint(0)
    (name,) = scene.phases[t].grasped
    was = np.linalg.inv(demo.steps.measured_Ts_world_tool[t]) @ demo.body_Ts_world[name][t]
    np.testing.assert_allclose(
        np.linalg.inv(T_world_tool) @ now.Ts_world_body[name], was, atol=1e-4
    )
    backend.close()


def test_a_film_has_one_frame_a_step_all_of_one_size(demonstration, peg_backend):
    frames = list(film(demonstration, None))
    assert len(frames) == len(demonstration) and len({frame.shape for frame in frames}) == 1
    assert frames[0].shape[1] == 480
    drawn = next(film(demonstration, SceneView(demonstration, peg_backend, "overview")))
    assert drawn.shape[1] == 480


def test_a_camera_that_is_not_there_is_refused(demonstration, peg_backend):
    with pytest.raises(UnknownName, match="unknown camera 'front': choose from overview, wrist"):
        SceneView(demonstration, peg_backend, "front")


def test_a_demonstration_that_does_not_tell_where_bodies_were_has_no_scene_view(
    peg_demonstration, peg_backend
):
    blind = dataclasses.replace(peg_demonstration, body_Ts_world={})
    with pytest.raises(InvalidInput, match="doesn't tell where 'table' was, .* --camera wrist"):
        SceneView(Playback("demo.h5", blind), peg_backend, "overview")


def test_a_demonstration_without_images_can_t_be_played(peg_demonstration):
    steps = dataclasses.replace(peg_demonstration.steps, cameras={})
    with pytest.raises(InvalidInput, match="holds no images"):
        Playback("demo.h5", dataclasses.replace(peg_demonstration, steps=steps))


@pytest.fixture
def window(demonstration):
    return PlayWindow(demonstration, None, None)


def test_space_stops_plays_and_begins_again_at_the_end(window, demonstration):
    assert window.playing
    window.key("space")
    assert not window.playing
    window.key("end")
    window.key("space")
    assert window.playing and window.at == 0
    for _ in range(2 * len(demonstration)):
        window.step(1)
    assert window.at == len(demonstration) - 1 and not window.playing


def test_arrows_go_one_step_and_stop_and_stay_within_the_recording(window, demonstration):
    window.key("left")
    assert window.at == 0 and not window.playing
    window.key("right")
    assert window.at == 1
    window.key("end")
    window.key("right")
    assert window.at == len(demonstration) - 1
    window.key("home")
    assert window.at == 0
    window.key("escape")
    assert window.closed


@pytest.mark.parametrize("speed", [0.0, -1.0, np.nan])
def test_speed_is_positive(demonstration, speed):
    with pytest.raises(InvalidInput, match="speed: expected a finite number > 0"):
        PlayWindow(demonstration, None, None, speed)
