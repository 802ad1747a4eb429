"""How fast a demonstration moves, and where it stands still."""

from __future__ import annotations

import numpy as np

from sart_toolkit.data.records import Demonstration
from sart_toolkit.poses import Array, relative_motion

# What turning by 1 rad counts [m]: it moves what a gripper holds by about as much.
_LEVER = 0.1
# Of the pace: below it, a step is a tremor or the end of a motion.
_STILL = 0.1
_LEAST_TRAVEL = 1e-5  # [m]


def travel(motions: Array) -> Array:
    """How far `(n,)` [m] motions `(n, 6)` move the tool; turning by 1 rad counts as 0.1 m.

    Args:
        motions: xyz [m] and rotation vector [rad], such as actions begin with.
    """
    linear = np.linalg.norm(motions[:, :3], axis=1)
    return np.asarray(linear + _LEVER * np.linalg.norm(motions[:, 3:6], axis=1))


class Pace:
    """The pace of a demonstration's commands.

    Attributes:
        step: how far [m] the tool moves in a recorded step at which half of its way is made in
            longer ones; waiting, however long, doesn't count.
    """

    def __init__(self, demonstration: Demonstration) -> None:
        self._demonstration = demonstration
        self._steps = travel(demonstration.actions)
        ordered = np.sort(self._steps)
        half = np.searchsorted(np.cumsum(ordered), ordered.sum() / 2)
        self.step = max(_LEAST_TRAVEL, float(ordered[half]))
        self._moving = self._steps > _STILL * self.step

    def time_for(self, t: int, T_world_tool: Array) -> float:
        """The time [s] that the demonstration takes near waypoint `t` for as much motion as there.

        Counted are the steps before `t` that move, the nearest first, and if these are too few
        those after it; if all are, it is the time at their mean pace.

        Args:
            t: the waypoint.
            T_world_tool: the pose `(4, 4)` whose distance from it counts.
        """
        before, after = np.flatnonzero(self._moving[:t])[::-1], np.flatnonzero(self._moving[t:])
        gone = np.cumsum(self._steps[np.concatenate([before, t + after])])
        if not len(gone):
            return 0.0
        T_t = self._demonstration.steps.commanded_Ts_world_tool[t]
        wanted = travel(relative_motion(T_t, T_world_tool)[None])[0]
        if wanted <= gone[-1]:
            n = float(np.searchsorted(gone, wanted)) + 1.0
        else:
            n = wanted / gone[-1] * len(gone)
        return float(n / self._demonstration.rates.record_hz)
