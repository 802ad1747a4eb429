"""A scripted operator that steers as a person does: unhurried, with pauses and an unsteady hand."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sart_toolkit.backends.interface import Observation
from sart_toolkit.data.records import DEFAULT_RATES
from sart_toolkit.errors import InvalidInput
from sart_toolkit.poses import check_positive, relative_motion
from sart_toolkit.record.session import Device, DeviceSetup, TeleopCommand
from sart_toolkit.tasks.task import PlanStep


@dataclass(frozen=True)
class OperatorStyle:
    """How a person steers; the defaults give tool speeds and pauses seen with a 3D mouse.

    `reaction` [s]: time constant with which the hand's velocity follows the intention. `approach`
    [1/s]: speed per distance left, near a goal; `creep` [m/s] is the least. `tremor` [m/s] and
    `tremor_deg` [deg/s]: standard deviation of the hand's slow noise, `tremor_time` [s] its memory.
    `hesitation` [s]: longest slowing-down between plan steps; `turn_deg` [deg/s]: greatest turning
    speed. `rest` [s]: stillness before saying stop.
    """

    reaction: float = 0.12
    approach: float = 3.0
    creep: float = 0.012
    tremor: float = 0.004
    tremor_deg: float = 1.2
    tremor_time: float = 0.25
    hesitation: float = 0.4
    turn_deg: float = 25.0
    rest: float = 0.7

    def __post_init__(self) -> None:
        for name in ("reaction", "approach", "creep", "tremor_time", "turn_deg"):
            check_positive(name, getattr(self, name))
        for name in ("tremor", "tremor_deg", "hesitation", "rest"):
            value = getattr(self, name)
            if not (np.isfinite(value) and value >= 0):
                raise InvalidInput(f"{name}: expected a finite number >= 0, got {value}")


class ScriptedOperator(Device):
    """Follows the steps of a task's plan by what it sees, like a person at a 3D mouse."""

    name = "scripted"
    operator = "scripted operator"

    def __init__(
        self,
        plan: Sequence[PlanStep],
        rng: np.random.Generator,
        style: OperatorStyle | None = None,
        control_hz: int = DEFAULT_RATES.control_hz,
    ) -> None:
        """Follow the steps of `plan` in order, with the hand's noise drawn from `rng`.

        Raises:
            InvalidInput: the plan is empty.
        """
        if not plan:
            raise InvalidInput("operator: the plan has no step; give it at least one")
        self._plan = list(plan)
        self._rng = rng
        self._style = style or OperatorStyle()
        self._dt = 1.0 / control_hz
        self._at = 0
        self._paused = 0.0
        self._still = 0.0
        self._hesitating = 0.0
        self._velocity = np.zeros(6)
        self._tremor = np.zeros(6)

    def read(self, observation: Observation) -> TeleopCommand:
        style, dt = self._style, self._dt
        step = self._plan[self._at]
        error = relative_motion(observation.T_world_tool, step.T_world_tool)
        far, turn = float(np.linalg.norm(error[:3])), float(np.linalg.norm(error[3:]))
        if far < step.tolerance and turn < np.deg2rad(step.tolerance_deg):
            self._paused += dt
            if self._paused > step.pause:
                if self._at + 1 < len(self._plan):
                    self._at += 1
                    self._paused = 0.0
                    if not step.through:
                        self._hesitating = float(self._rng.uniform(0.0, style.hesitation))
                    return self.read(observation)
                self._still += dt
        elif self._still > 0:
            self._still += dt
        resting = self._still > 0
        wanted = np.zeros(6)
        if not resting:
            near = step.speed if step.through else max(style.approach * far, style.creep)
            speed = min(step.speed, near)
            if self._hesitating > 0:
                self._hesitating -= dt
                speed = min(speed, style.creep)
            if far > 1e-6:
                wanted[:3] = error[:3] / far * min(speed, far / dt)
            wanted[3:] = error[3:] * min(
                style.approach, np.deg2rad(style.turn_deg) / max(turn, 1e-6)
            )
        self._velocity += (dt / (style.reaction + dt)) * (wanted - self._velocity)
        spread = np.repeat([style.tremor, np.deg2rad(style.tremor_deg)], 3)
        keep = np.exp(-dt / style.tremor_time)
        noise = self._rng.standard_normal(6) * np.sqrt(1.0 - keep**2)
        self._tremor = keep * self._tremor + noise * spread * (0.0 if resting else step.tremor)
        stop = self._still > style.rest
        return TeleopCommand(self._velocity + self._tremor, step.gripper, stop)


def scripted_operator(setup: DeviceSetup) -> ScriptedOperator:
    """The operator for a recording, following its task's plan."""
    hz = setup.backend.rates.control_hz
    return ScriptedOperator(setup.task.plan(setup.state), setup.rng, control_hz=hz)
