from __future__ import annotations

import numpy as np

from sart_toolkit.evaluate.progress import Progress, progress_along

# Down 10 cm in 1 cm steps, the fingers close, up again.
DOWN = np.array([[0.0, 0.0, 0.1 - 0.01 * k] for k in range(11)])
SHOWN = np.concatenate([DOWN, DOWN[::-1]])
GRIPPER = np.repeat([0.0, 0.8], 11)


def test_the_demonstration_itself_reaches_its_last_waypoint_at_the_last_step() -> None:
    assert progress_along(SHOWN, GRIPPER, SHOWN, GRIPPER) == Progress(21, 22, 21)


def test_a_rollout_that_stalls_is_told_where_and_since_when() -> None:
    done = np.concatenate([DOWN[:6], np.repeat(DOWN[5:6], 20, axis=0)])
    assert progress_along(SHOWN, GRIPPER, done, np.zeros(26)) == Progress(5, 22, 5)


def test_what_was_lifted_with_open_fingers_was_not_grasped() -> None:
    found = progress_along(SHOWN, GRIPPER, SHOWN, np.zeros(22))
    assert found is not None and found.waypoint == 10


def test_the_path_may_be_joined_later_and_waypoints_left_out() -> None:
    done = np.array([[0.2, 0.0, 0.1], [0.05, 0.0, 0.06], [0.01, 0.0, 0.05], [0.0, 0.0, 0.0]])
    assert progress_along(SHOWN, GRIPPER, done, np.zeros(4)) == Progress(10, 22, 3)


def test_a_rollout_that_came_near_to_nothing_has_no_progress() -> None:
    assert progress_along(SHOWN, GRIPPER, SHOWN + [0.03, 0, 0], GRIPPER) is None
