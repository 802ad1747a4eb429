"""How far a rollout came along the demonstration, and when it came no farther."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sart_toolkit.poses import Array

# As near as this [m] to a waypoint, seen from the object, a rollout has reached it.
_NEAR = 0.02
# So many metres a gripper wrong by its whole travel counts as.
_GRIPPER = 0.1


@dataclass(frozen=True)
class Progress:
    """The furthest waypoint of `n` that a rollout reached, and at which of its steps it did."""

    waypoint: int
    n: int
    step: int


def progress_along(
    shown: Array, shown_gripper: Array, done: Array, gripper: Array
) -> Progress | None:
    """How far a rollout came along a demonstration; None if it came near to none of it.

    A waypoint is reached where the tool, seen from the object, is within 2 cm of where it was
    shown, with the gripper about as open. Waypoints are reached in order, but may be left out.

    Args:
        shown: the demonstration's tool positions in the object's frame `(T, 3)` [m].
        shown_gripper: its gripper `(T,)` in [0, 1].
        done: the rollout's tool positions in the object's frame `(S, 3)` [m].
        gripper: its gripper `(S,)` in [0, 1].
    """
    found: Progress | None = None
    for step, (p, opening) in enumerate(zip(done, gripper, strict=True)):
        first = 0 if found is None else found.waypoint
        off = np.linalg.norm(shown[first:] - p, axis=1)
        off += _GRIPPER * np.abs(shown_gripper[first:] - opening)
        waypoint = first + int(np.argmin(off))
        if off.min() < _NEAR and (found is None or waypoint > found.waypoint):
            found = Progress(waypoint, len(shown), step)
    return found
