"""What is really sent to a robot's joints, against their limits."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sart_toolkit.backends.interface import Backend, CommandSent
from sart_toolkit.poses import Array

# Differences of rounded targets, times the rate cubed, may exceed a limit by this fraction.
_ROUNDING = 1e-5


@dataclass(frozen=True)
class LimitCheck:
    """How what was sent compares with the robot's limits.

    `ratios`: the greatest finite differences for joint velocity, acceleration and jerk over their
    limits; `violations`: how many differences, joints counted singly, exceed theirs; `samples`: how
    many targets were sent.
    """

    ratios: tuple[float, float, float]
    violations: int
    samples: int


class SentTargets:
    """Keeps what a backend is sent at each physics step, until it is checked."""

    def __init__(self, backend: Backend) -> None:
        """Listen to the commands of `backend` from now on."""
        self._spec, self._rates = backend.robot, backend.rates
        self._rows: list[Array] = []
        command = backend.command

        def listen(q: Array, gripper: float) -> CommandSent:
            self._rows.append(np.atleast_2d(q))
            return command(q, gripper)

        setattr(backend, "command", listen)  # noqa: B010 - of this backend alone

    def check(self, q: Array, dq: Array) -> LimitCheck | None:
        """How what was sent since the last check compares with the limits; None if nothing was.

        Args:
            q: where the joints were before `(n,)` [rad].
            dq: how fast they moved `(n,)` [rad/s]; what was sent is taken to go on from there.
        """
        if not self._rows:
            return None
        hz = self._rates.physics_hz
        rows = np.concatenate([*([q - k * dq / hz] for k in (3, 2, 1, 0)), *self._rows])
        self._rows = []
        spec = self._spec
        limits = spec.velocity_limits, spec.acceleration_limits, spec.jerk_limits
        ratios = [
            np.abs(np.diff(rows, order, axis=0)) * float(hz) ** order / limit
            for order, limit in enumerate(limits, 1)
        ]
        v, a, j = (float(ratio.max()) for ratio in ratios)
        violations = sum(int((ratio > 1.0 + _ROUNDING).sum()) for ratio in ratios)
        return LimitCheck((v, a, j), violations, len(rows) - 4)
