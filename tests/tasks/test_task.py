"""What our own tasks promise beyond the contract suite (tests/testing), and all placements."""

from __future__ import annotations

import re

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from sart_toolkit.annotate.suggest import suggest_annotation
from sart_toolkit.backends import BACKENDS, make_backend
from sart_toolkit.collision.exact import ExactWorld
from sart_toolkit.collision.model import CollisionModel
from sart_toolkit.data.records import DEFAULT_RATES
from sart_toolkit.errors import InvalidInput, UnknownName
from sart_toolkit.poses import inverse
from sart_toolkit.record.scripted import ScriptedOperator
from sart_toolkit.record.session import SessionConfig, record_demonstration
from sart_toolkit.robots import get_robot
from sart_toolkit.robots.model import RobotModel
from sart_toolkit.robots.spec import Shape
from sart_toolkit.tasks import TASKS, get_task
from sart_toolkit.tasks.task import Placement


@pytest.fixture(scope="module", params=TASKS)
def task(request):
    return get_task(request.param)


@pytest.fixture(scope="module", params=BACKENDS)
def backend(request, task):
    backend = make_backend(request.param, get_robot(task.robot), task.scene, 64)
    yield backend
    backend.close()


@pytest.fixture(scope="module")
def model(task):
    return RobotModel(get_robot(task.robot), task.scene.held)


def _corners(task):
    r = task.placement_range
    return [Placement(x, y) for x in (-r, r) for y in (-r, r)]


def _object(task):
    """Names of the body whose placement varies and of those that move on it."""
    moving = [n for n, b in task.scene.jointed.items() if b.joint.parent == task.report_body]
    return [task.report_body, *moving]


def _seen_pixels(backend, names):
    """How many of the wrist image's pixels show one of some bodies, by depth."""
    seen = backend.observe(("wrist",))
    view = seen.cameras["wrist"]
    size = len(view.depth)
    rows, columns = np.nonzero(view.depth)
    K = backend.cameras["wrist"].intrinsics(size, size)
    rays = np.stack([columns, rows, np.ones(len(rows))], -1) @ np.linalg.inv(K).T
    points = rays * view.depth[rows, columns][:, None]
    T = view.T_world_camera
    points = points @ T[:3, :3].T + T[:3, 3]
    shows = np.zeros(len(points), bool)
    for body in backend.scene.bodies:
        for shape in body.shapes if body.name in names else ():
            T_shape = inverse(seen.Ts_world_body[body.name] @ shape.T_body_shape)
            local = points @ T_shape[:3, :3].T + T_shape[:3, 3]
            box = Shape(shape.kind, shape.size).corners().max(0) + 0.002
            shows |= (np.abs(local) < box).all(1) & (points[:, 2] > 0.002)
    return int(shows.sum())


def test_the_docstring_is_a_card_with_numbers(task):
    card = type(task).__doc__
    for heading in ("Goal:", "Randomisation:", "Success:"):
        assert heading in card
    for heading in ("Randomisation", "Success"):
        assert re.search(rf"{heading}:[^:]*\d", card), f"{heading} has no number"


def test_it_is_called_as_in_the_table_and_names_parts_of_its_scene(task):
    assert TASKS[task.name].endswith(f":{type(task).__name__}")
    assert task.report_body in {body.name for body in task.scene.bodies}
    assert "overview" in {camera.name for camera in task.scene.cameras}
    assert task.horizon > task.hold > 0


def test_placements_are_uniform_within_range_and_follow_from_the_seed(task):
    rngs = [np.random.default_rng(7), np.random.default_rng(7)]
    drawn = [[task.sample_placement(rng) for _ in range(2000)] for rng in rngs]
    assert drawn[0] == drawn[1]
    r = task.placement_range
    for values in ([p.x for p in drawn[0]], [p.y for p in drawn[0]]):
        assert np.abs(values).max() <= r
        assert stats.kstest(values, stats.uniform(-r, 2 * r).cdf).pvalue > 0.01


def test_yaw_is_drawn_only_where_asked_for_and_within_what_the_operator_masters(task):
    rng = np.random.default_rng(0)
    assert {task.sample_placement(rng).yaw_deg for _ in range(20)} == {0.0}
    largest = task.yaw_range_deg
    drawn = [task.sample_placement(rng, largest).yaw_deg for _ in range(200)]
    assert 0.8 * largest < np.abs(drawn).max() <= largest
    with pytest.raises(InvalidInput, match="yaw_deg: .* can be turned by 0 to"):
        task.check_operable(largest + 1)
    task.check_operable(largest)


def test_a_placement_is_drawn_from_another_square_where_one_is_given(task):
    rngs = [np.random.default_rng(3) for _ in range(2)]
    usual, wide = task.sample_placement(rngs[0]), task.sample_placement(rngs[1], half_width=0.15)
    assert wide.x == pytest.approx(usual.x * 0.15 / task.placement_range)


def test_success_counts_as_achieved_when_it_lasted_until_the_end(task):
    steps = round(task.hold * DEFAULT_RATES.record_hz)
    success = np.ones(steps + 5, bool)
    success[:5] = False
    assert task.achieved(success)
    assert not task.achieved(np.append(success[1:], False))
    success[-steps] = False
    assert not task.achieved(success)


def test_at_the_start_there_is_room_for_a_sphere_that_covers_every_placement(task, model, backend):
    """Nothing touches but what is grasped, and all that the tool holds is clear."""
    needed = 0.11 if task.name == "peg_in_hole" else 0.20
    fingers = model.spec.gripper.finger_links
    first = task.initial_state(model, Placement())
    collision = CollisionModel(model.spec, task.scene)
    for placement in _corners(task):
        state = task.initial_state(model, placement)
        np.testing.assert_array_equal(state.q, first.q)
        backend.reset(state)
        for _ in range(5):
            backend.command(state.q, state.commanded_gripper)
            backend.step()
        touching = [(contact.a, contact.b) for contact in backend.contacts()]
        grasped = task.scene.grasped(touching, fingers)
        assert not task.scene.outer_contacts(touching, grasped)
        seen = backend.observe()
        placed = collision.placed(
            seen.Ts_world_body,
            float(np.clip(seen.gripper, 0, 1)),
            {name: inverse(seen.T_world_tool) @ seen.Ts_world_body[name] for name in grasped},
        )
        nearest = placed.tool_clearances(seen.q)[0]
        assert nearest.distance > needed, nearest
        assert placed.distances(seen.q).min() > 0
        assert not task.success(seen)
        assert task.failure_reason(seen)


def test_the_object_is_in_the_wrist_view_at_every_corner_of_its_range(task, model, backend):
    for placement in _corners(task):
        backend.reset(task.initial_state(model, placement))
        assert _seen_pixels(backend, _object(task)) > 40, placement


def test_only_the_reported_body_and_what_moves_on_it_follow_the_placement(task, model):
    middle = task.initial_state(model, Placement())
    moved = task.initial_state(model, Placement(0.02, -0.01, 15.0))
    np.testing.assert_array_equal(middle.q, moved.q)
    for name, T in middle.Ts_world_body.items():
        shift = moved.Ts_world_body[name] - T
        if name == task.report_body:
            np.testing.assert_allclose(shift[:3, 3], [0.02, -0.01, 0], atol=1e-12)
        elif name not in _object(task):
            assert not shift.any()


def test_a_sphere_at_the_start_covers_every_placement(task, model):
    backend = make_backend("pybullet", model.spec, task.scene, 16)
    operator = ScriptedOperator(
        task.plan(task.initial_state(model, Placement())), np.random.default_rng(0)
    )
    config = SessionConfig(cameras=(), keep_states=False)
    demonstration = record_demonstration(backend, task, model, operator, config=config)
    backend.close()
    scene = ExactWorld(demonstration, model.spec, task.scene)
    annotation = suggest_annotation(demonstration, scene, [0])
    assert annotation.spheres[0].radius >= np.hypot(*[task.placement_range] * 2)


def test_the_object_stays_in_the_wrist_view_throughout_a_demonstration(task, model, backend):
    operator = ScriptedOperator(
        task.plan(task.initial_state(model, Placement())), np.random.default_rng(0)
    )
    seen = []

    class Watched(type(operator)):
        def read(self, observation):
            if len(seen) == 0 or observation.time - seen[-1][0] > 0.45:
                seen.append((observation.time, _seen_pixels(backend, _object(task))))
            return super().read(observation)

    operator.__class__ = Watched
    config = SessionConfig(cameras=(), keep_states=False)
    record_demonstration(backend, task, model, operator, config=config)
    assert min(pixels for _, pixels in seen) > 40, seen


def test_an_unknown_task_is_refused_with_the_nearest_name():
    with pytest.raises(UnknownName, match="did you mean 'peg_in_hole'"):
        get_task("peg-in-hole")
    with pytest.raises(UnknownName, match="choose from"):
        get_task("zzz")


@settings(max_examples=50, deadline=None, derandomize=True)
@given(st.floats(-1, 1), st.floats(-1, 1), st.floats(-180, 180))
def test_a_placement_survives_json_and_is_a_turn_and_shift_on_the_table(x, y, yaw_deg):
    placement = Placement(x, y, yaw_deg)
    assert Placement.from_json(placement.to_json()) == placement
    T = placement.T_middle_object
    np.testing.assert_allclose(T[:3, 3], [x, y, 0])
    np.testing.assert_allclose(T[:3, 2], [0, 0, 1], atol=1e-12)
    np.testing.assert_allclose(np.exp(1j * np.deg2rad(yaw_deg)), complex(*T[:2, 0]), atol=1e-12)


@pytest.mark.parametrize(
    ("value", "message"),
    [
        ({"z": 1.0}, "placement: expected x, y, yaw_deg"),
        ({"x": "far"}, "placement: expected x, y, yaw_deg"),
        ({"x": None}, "placement: expected x, y, yaw_deg"),
        ({"x": float("nan")}, "placement: has a NaN"),
        ({"yaw_deg": float("inf")}, "placement: has a NaN"),
    ],
)
def test_a_bad_placement_is_refused(value, message):
    with pytest.raises(InvalidInput, match=message):
        Placement.from_json(value)
