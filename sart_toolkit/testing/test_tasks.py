"""What a task promises, each test one promise: placements, starts, success, the operator's plan."""

from __future__ import annotations

import dataclasses
import json
import pickle
from collections.abc import Iterator

import numpy as np
import pytest

from sart_toolkit.backends.interface import KnowsBodies, Resets
from sart_toolkit.errors import InvalidInput, SartError
from sart_toolkit.poses import inverse, pose
from sart_toolkit.registry import lasting_reference
from sart_toolkit.tasks import TASKS, get_task
from sart_toolkit.tasks.task import Placement
from sart_toolkit.testing.task_bench import TaskBench

_DRAWN = 200
_FITS = "test_its_attributes_fit_together"
_NAMED = "test_a_recording_leads_back_to_its_task"
_RANGE = "test_a_placement_is_within_its_range"
_REPEATS = "test_a_start_follows_from_the_placement_alone"
_GOAL = "test_the_plan_reaches_the_goal_wherever_the_object_stands"
# So many pixels of 64 x 64 show the object, each by a difference of at least this of 255.
_PIXELS, _DIFFERENCE = 20, 8


# --- what it is ---------------------------------------------------------------------------------


def test_its_attributes_fit_together(trial: TaskBench) -> None:
    """The reported body is one of the scene's; ranges and times are positive."""
    task = trial.task
    assert isinstance(task.name, str) and task.name.strip()
    assert _fits(trial), "report_body: not a body that stands by itself in the scene"
    assert task.placement_range >= 0, "placement_range: expected at least 0 m"
    assert 0 <= task.yaw_range_deg <= 180, "yaw_range_deg: expected 0 to 180"
    assert task.horizon > task.hold > 0, "expected horizon > hold > 0"


def _fits(trial: TaskBench) -> bool:
    bodies = {body.name: body for body in trial.task.scene.bodies}
    name = trial.task.report_body
    return name in bodies and bodies[name].joint is None


def test_a_recording_leads_back_to_its_task(trial: TaskBench) -> None:
    """A file can name it so that later verbs find it again."""
    assert _named(trial), "defined in a function, or made with arguments and not at a file's top"


def _named(trial: TaskBench) -> bool:
    try:
        found = get_task(lasting_reference("task", trial.task, TASKS))
    except SartError:
        return False
    return type(found) is type(trial.task) and found.name == trial.task.name


def test_it_can_go_to_other_processes(trial: TaskBench) -> None:
    """Workers get a pickled copy, which does the same."""
    trial.relies_on(_named(trial), _NAMED)
    trial.relies_on(_repeats(trial), _REPEATS)
    copy = pickle.loads(pickle.dumps(trial.task))  # noqa: S301 - written here
    there = dataclasses.replace(trial, task=copy)
    trial.relies_on_starts()
    placement = trial.placements[-1]
    assert _same_start(trial, there, placement)


# --- placements ---------------------------------------------------------------------------------


def _drawn(trial: TaskBench, seed: int = 0, yaw_deg: float = 0.0) -> list[Placement]:
    rng = np.random.default_rng(seed)
    return [trial.task.sample_placement(rng, yaw_deg) for _ in range(_DRAWN)]


def _in_range(trial: TaskBench) -> bool:
    r, largest = trial.task.placement_range, trial.task.yaw_range_deg
    upright, turned = _drawn(trial), _drawn(trial, yaw_deg=largest)
    inside = all(max(abs(p.x), abs(p.y)) <= r for p in upright + turned)
    return (
        inside
        and all(p.yaw_deg == 0 for p in upright)
        and all(abs(p.yaw_deg) <= largest for p in turned)
    )


def test_a_placement_is_within_its_range(trial: TaskBench) -> None:
    """`placement_range` either way in x and y; turned only where asked for, and no farther."""
    assert _in_range(trial)


def test_a_placement_is_drawn_from_another_square_where_one_is_given(trial: TaskBench) -> None:
    """Of half width `half_width` in place of `placement_range`."""
    trial.relies_on(_in_range(trial), _RANGE)
    rng, half_width = np.random.default_rng(1), 0.001
    for _ in range(_DRAWN):
        placement = trial.task.sample_placement(rng, half_width=half_width)
        assert max(abs(placement.x), abs(placement.y)) <= half_width


def test_placements_follow_from_the_random_numbers_given(trial: TaskBench) -> None:
    """The same for the same generator, and others for another."""
    assert _drawn(trial) == _drawn(trial)
    if trial.task.placement_range > 0:
        assert _drawn(trial) != _drawn(trial, seed=1)


def test_a_placement_survives_json(trial: TaskBench) -> None:
    """Evaluations and recordings keep it so."""
    for placement in _drawn(trial, yaw_deg=trial.task.yaw_range_deg)[:5]:
        kept = json.loads(json.dumps(placement.to_json()))
        assert Placement.from_json(kept) == placement


def test_a_turn_beyond_what_the_operator_copes_with_is_refused(trial: TaskBench) -> None:
    """By `check_operable`, which accepts all up to `yaw_range_deg`."""
    largest = trial.task.yaw_range_deg
    trial.task.check_operable(largest)
    for yaw_deg in (largest + 1.0, -1.0):
        with pytest.raises(InvalidInput):
            trial.task.check_operable(yaw_deg)


@pytest.mark.parametrize("field", ["x", "y", "yaw_deg"])
def test_a_placement_that_is_nowhere_is_refused(trial: TaskBench, field: str) -> None:
    """No start is made of what isn't a number."""
    with pytest.raises(SartError):
        trial.start(dataclasses.replace(Placement(), **{field: float("nan")}))


# --- the start ----------------------------------------------------------------------------------


def test_the_robot_can_be_at_every_start(trial: TaskBench) -> None:
    """Its joints are within their limits, wherever the object stands."""
    for placement in trial.placements:
        trial.check_reached(placement)


def test_a_start_is_a_state_of_the_scene(trial: TaskBench) -> None:
    """With each of its bodies and no other, those with a joint where their joints have them."""
    for placement in trial.placements:
        trial.check_state(placement)


def _same_start(a: TaskBench, b: TaskBench, placement: Placement) -> bool:
    one, other = a.start(placement), b.start(placement)
    poses = all(
        np.array_equal(T, other.Ts_world_body[name]) for name, T in one.Ts_world_body.items()
    )
    return (
        poses
        and np.array_equal(one.q, other.q)
        and one.joint_positions == other.joint_positions
        and (one.gripper, one.commanded_gripper) == (other.gripper, other.commanded_gripper)
    )


def _repeats(trial: TaskBench) -> bool:
    trial.relies_on_starts()
    return all(_same_start(trial, trial, placement) for placement in trial.placements)


def test_a_start_follows_from_the_placement_alone(trial: TaskBench) -> None:
    """Asked for again, it is the same to the bit: what is random is the placement."""
    assert _repeats(trial)


def _where_placed(trial: TaskBench) -> Iterator[str]:
    """What is wrong about where the object stands."""
    trial.relies_on(_fits(trial), _FITS)
    trial.relies_on_starts()
    name = trial.task.report_body
    T_world_middle = trial.start(Placement()).Ts_world_body[name]
    for placement in trial.placements:
        T_world_object = trial.start(placement).Ts_world_body[name]
        moved = T_world_object[:3, 3] - T_world_middle[:3, 3]
        turned = T_world_object[:3, :3] @ T_world_middle[:3, :3].T
        expected = placement.T_middle_object
        if np.abs(moved - expected[:3, 3]).max() > 1e-6:
            yield f"{placement}: {name} is {moved} m from the middle of its range"
        if np.abs(turned - expected[:3, :3]).max() > 1e-6:
            yield f"{placement}: {name} isn't turned by that about the vertical"


def test_the_object_stands_where_the_placement_says(trial: TaskBench) -> None:
    """`report_body` is shifted by x and y and turned by the yaw, from the middle of its range."""
    assert not list(_where_placed(trial))


def test_nothing_touches_the_robot_at_the_start(trial: TaskBench) -> None:
    """But what it has in its grasp."""
    scene, fingers = trial.task.scene, trial.model.spec.gripper.finger_links
    for placement in trial.placements:
        touching = trial.rest(placement).touching
        assert not scene.outer_contacts(touching, scene.grasped(touching, fingers)), placement


def test_all_is_at_rest_at_the_start(trial: TaskBench) -> None:
    """Nothing falls, slides or is pushed out of what it overlaps, within 3 mm and 2 deg."""
    for placement in trial.placements:
        assert not trial.rest(placement).restless, placement


def test_the_robot_s_camera_sees_the_object_at_the_start(trial: TaskBench) -> None:
    """A policy is to find it there: without the object the image is another."""
    trial.needs(Resets, KnowsBodies)
    trial.relies_on_starts()
    trial.relies_on(_fits(trial), _FITS)
    if not trial.model.spec.cameras:
        pytest.skip("the robot has no camera")
    if trial.backend.no_images:
        pytest.skip(f"backend {trial.backend.name!r} lacks images: {trial.backend.no_images}")
    name = trial.task.report_body
    for placement in trial.placements:
        state = trial.start(placement)
        far = pose([0.0, 0.0, -50.0]) @ inverse(state.Ts_world_body[name])
        free = {b.name: state.Ts_world_body[b.name] for b in trial.task.scene.bodies if not b.joint}
        away = trial.task.scene.initial_state(
            state.q,
            state.gripper,
            {**free, name: far @ state.Ts_world_body[name]},
            state.joint_positions,
            state.gripper_target,
        )
        differs = np.abs(trial.image(state) - trial.image(away)).max(axis=2) > _DIFFERENCE
        assert differs.sum() >= _PIXELS, placement


# --- success ------------------------------------------------------------------------------------


def test_the_goal_is_not_reached_at_the_start(trial: TaskBench) -> None:
    """Or there would be nothing to learn."""
    trial.needs(Resets, *trial.task.observes)
    trial.relies_on_starts()
    for placement in trial.placements:
        trial.reset(placement)
        assert not trial.task.success(trial.backend.observe()), placement


def test_a_failure_has_a_reason(trial: TaskBench) -> None:
    """In one line, for reports."""
    trial.needs(Resets, *trial.task.observes)
    trial.relies_on_starts()
    trial.reset(Placement())
    reason = trial.task.failure_reason(trial.backend.observe())
    assert isinstance(reason, str) and reason.strip() and "\n" not in reason


def test_success_follows_from_the_observation_alone(trial: TaskBench) -> None:
    """Asked again about what was seen, in another order, the task says the same."""
    for placement in trial.placements[:2]:
        attempt = trial.attempt(placement)
        again = [trial.task.success(observation) for observation in attempt.seen[::-1]]
        assert list(map(bool, again[::-1])) == list(attempt.success), placement


# --- the operator's plan ------------------------------------------------------------------------


def test_the_plan_reaches_the_goal_wherever_the_object_stands(trial: TaskBench) -> None:
    """At the corners of its range, and turned as far as the operator copes with."""
    trial.relies_on(
        not list(_where_placed(trial)), "test_the_object_stands_where_the_placement_says"
    )
    for placement in trial.placements:
        attempt = trial.attempt(placement)
        reached = bool(attempt.success.any())
        reason = attempt.trouble or trial.task.failure_reason(attempt.seen[-1])
        assert reached, f"{placement}: {reason}"


def test_success_lasts_until_the_plan_s_end(trial: TaskBench) -> None:
    """For the task's `hold`: only then a recording counts. The last step's `pause` gives time."""
    for placement in trial.placements:
        attempt = trial.attempt(placement)
        trial.relies_on(attempt.success.any(), _GOAL)
        held = np.cumprod(attempt.success[::-1]).sum() / trial.backend.rates.record_hz
        achieved = trial.task.achieved(attempt.success, trial.backend.rates.record_hz)
        assert achieved, f"{placement}: {held:g} s of {trial.task.hold:g} s"


def test_the_plan_takes_no_longer_than_a_rollout_may(trial: TaskBench) -> None:
    """What the operator needs, a policy does as well: `horizon` has to be longer."""
    for placement in trial.placements:
        attempt = trial.attempt(placement)
        trial.relies_on(attempt.success.any(), _GOAL)
        seconds = len(attempt.success) / trial.backend.rates.record_hz
        assert seconds < trial.task.horizon, f"{placement}: {seconds:g} s"
