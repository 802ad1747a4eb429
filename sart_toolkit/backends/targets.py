"""What a simulator's joints and gripper are to follow in the control period to come."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from sart_toolkit.backends.interface import CommandSent
from sart_toolkit.poses import Array
from sart_toolkit.robots.model import RobotModel
from sart_toolkit.robots.spec import check_gripper


class PeriodTargets:
    """Targets of joints and gripper at each physics step of a control period.

    Attributes:
        rows: `(steps, n + 1)`, the joints' [rad], then the gripper's in [0, 1].
        last: those `(n + 1,)` of the step before.
    """

    def __init__(self, model: RobotModel, steps: int) -> None:
        """At rest at the robot's home, the gripper open; `steps` physics steps a period."""
        self._model, self._steps = model, steps
        self.rest_at(model.spec.home, 0.0)

    def rest_at(self, q: Array, gripper: float) -> None:
        """Stay, as before, at joints `(n,)` [rad] and a gripper target in [0, 1]."""
        self._stay(np.append(q, gripper))

    def command(self, q: Array, gripper: float) -> CommandSent:
        """Take a command as `Backend.command` has it, for the next period.

        Raises:
            InvalidInput: wrong shape, not finite, outside limits.
        """
        given = np.atleast_2d(self._model.check_limits(q))
        gripper = check_gripper(gripper)
        at, joints = np.arange(1, self._steps + 1) / self._steps, given
        if len(given) != self._steps:
            times = np.arange(len(given) + 1) / len(given)
            through = np.concatenate([self.last[None, :-1], given])
            joints = np.stack([np.interp(at, times, joint) for joint in through.T], axis=1)
        closing = self.last[-1] + at * (gripper - self.last[-1])
        closing[-1] = gripper
        self.rows = np.column_stack([joints, closing])
        return CommandSent(given[-1].copy(), gripper)

    def advance(self) -> None:
        """A control period has passed: the last targets stay in force."""
        self._stay(self.rows[-1])

    def _stay(self, at: Array) -> None:
        self.last, self.rows = at, np.broadcast_to(at, (self._steps, len(at)))

    def to_json(self) -> dict[str, Any]:
        """The targets as JSON values, for a saved state."""
        return {"targets": self.rows.tolist(), "last_target": self.last.tolist()}

    def take(self, head: Mapping[str, Any]) -> None:
        """Take over what `to_json` wrote."""
        self.rows, self.last = np.array(head["targets"]), np.array(head["last_target"])
