"""Peg-in-hole: lower a held square peg into a square hole, as in the paper or a narrower one.

The narrower ones aren't in the table of tasks: `sart_toolkit.tasks.peg_in_hole:PegInHole2mm` names
the one whose peg has 2 mm of clearance on each side.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from sart_toolkit.backends.interface import Observation
from sart_toolkit.poses import Array, inverse, pose
from sart_toolkit.robots.spec import Attachment, Shape
from sart_toolkit.scenes.spec import Body, SceneSpec, SceneState
from sart_toolkit.tasks.parts import OVERVIEW, TABLE, tool_down
from sart_toolkit.tasks.task import Placement, PlanStep, Task

if TYPE_CHECKING:
    from sart_toolkit.robots.model import RobotModel

PEG_WIDTH, PEG_LENGTH = 0.03, 0.08
HOLE_WIDTH, HOLE_DEPTH = 0.05, 0.04
_BLOCK_WIDTH = 0.11
_PEG_TIP_BELOW_TOOL = 0.06
_START_CLEARANCE = 0.125
_INSERTION = 0.03
_MIDDLE = np.array([0.50, 0.0, 0.0])
_GRIPPER = 0.67
_WOOD = (0.86, 0.62, 0.30, 1.0)
_PEG = (0.20, 0.45, 0.80, 1.0)


def _block(hole: float) -> Body:
    """Four walls around a square hole so wide; origin at the hole's centre on the table."""
    wall = (_BLOCK_WIDTH - hole) / 2
    middle = (hole + wall) / 2
    z = HOLE_DEPTH / 2
    long, short = (wall, _BLOCK_WIDTH, HOLE_DEPTH), (hole, wall, HOLE_DEPTH)
    walls = [
        Shape("box", size, pose([x, y, z]), _WOOD)
        for size, x, y in (
            (long, middle, 0),
            (long, -middle, 0),
            (short, 0, middle),
            (short, 0, -middle),
        )
    ]
    # The floor of the hole is only drawn darker; the table carries the peg.
    floor = Shape("box", (hole, hole, 0.001), pose([0, 0, 0.0005]), (0.12, 0.10, 0.09, 1), False)
    return Body("block", (*walls, floor))


def _scene(hole: float) -> SceneSpec:
    """The block with a hole so wide on the table, the peg in the gripper."""
    peg = Attachment(
        "peg",
        "tool",
        (Shape("box", (PEG_WIDTH, PEG_WIDTH, PEG_LENGTH), rgba=_PEG),),
        pose([0, 0, _PEG_TIP_BELOW_TOOL - PEG_LENGTH / 2]),
        mass=0.1,
    )
    return SceneSpec(bodies=(TABLE, _block(hole)), held=(peg,), cameras=(OVERVIEW,))


class PegInHole(Task):
    """Lower a 3 cm square peg, fixed to the gripper, into a 5 cm square hole, 4 cm deep.

    Goal: the peg stands in the hole.
    Randomisation: the block with the hole is placed uniformly within ±5 cm in x and y of (0.50, 0)
    m; nothing else moves. The robot starts with the peg's tip 12.5 cm above the block, over the
    middle of the range.
    Success: in the hole's frame the peg's tip is |dx|, |dy| < 12 mm from the axis, at least 20 mm
    below the rim (half the hole's depth), and the peg is tilted < 10 deg.
    """

    name = "peg_in_hole"
    robot = "ur5e_2f85"
    placement_range = 0.05
    horizon = 15.0
    report_body = "block"
    clearance = (HOLE_WIDTH - PEG_WIDTH) / 2
    scene = _scene(HOLE_WIDTH)

    @staticmethod
    def _start() -> Array:
        """The tool's pose at the start: pointing down, the camera on the robot's side."""
        z = HOLE_DEPTH + _START_CLEARANCE + _PEG_TIP_BELOW_TOOL
        return tool_down(_MIDDLE + [0, 0, z])

    def initial_state(self, model: RobotModel, placement: Placement) -> SceneState:
        q = model.ik(self._start(), model.spec.home)
        T_world_block = pose(_MIDDLE) @ placement.T_middle_object
        return self.scene.initial_state(q, _GRIPPER, {"block": T_world_block})

    def _peg_in_hole(self, observation: Observation) -> tuple[Array, float]:
        """The peg tip's position `(3,)` [m] from the rim's centre, and the peg's tilt [rad]."""
        Ts = observation.Ts_world_body
        T_hole_peg = inverse(Ts["block"] @ pose([0, 0, HOLE_DEPTH])) @ Ts["peg"]
        tip = (T_hole_peg @ np.array([0, 0, PEG_LENGTH / 2, 1.0]))[:3]
        axis = T_hole_peg[:3, 2]
        return tip, float(np.arccos(np.clip(-axis[2], -1.0, 1.0)))

    def success(self, observation: Observation) -> bool:
        tip, tilt = self._peg_in_hole(observation)
        inside = np.abs(tip[:2]).max() < 0.012
        return bool(inside and tip[2] < -HOLE_DEPTH / 2 and tilt < np.deg2rad(10))

    def failure_reason(self, observation: Observation) -> str:
        tip, tilt = self._peg_in_hole(observation)
        if np.rad2deg(tilt) >= 10:
            return f"peg tilted {np.rad2deg(tilt):.0f} deg"
        beside = float(np.abs(tip[:2]).max())
        if beside >= 0.012:
            above = f"tip {tip[2] * 1e3:+.0f} mm from the rim"
            return f"peg {beside * 1e3:.0f} mm beside the hole's axis, {above}"
        if tip[2] > 0:
            return f"peg over the hole, tip {tip[2] * 1e3:.0f} mm above the rim"
        return f"peg in the hole but only {-tip[2] * 1e3:.0f} mm deep"

    def plan(self, state: SceneState) -> list[PlanStep]:
        hole = state.Ts_world_body["block"]
        T = self._start()
        T[:3, :3] = hole[:3, :3] @ T[:3, :3]
        steps = []
        # Height of the tip, speed, tolerance, and that of the angle, how unsteady the hand is.
        stages = [(0.012, 0.07, 0.004, 2.0, 1.0), (-_INSERTION, 0.03, 0.003, 2.0, 1.0)]
        if self.clearance < 0.004:
            # A person stops over the rim until the peg is well over the hole, and takes care.
            exact = 0.25 * self.clearance
            stages[1:] = [(0.003, 0.02, exact, 0.3, 0.1), (-_INSERTION, 0.03, 0.003, 2.0, 0.1)]
        for tip_height, speed, tolerance, tolerance_deg, tremor in stages:
            T_step = T.copy()
            T_step[:3, 3] = hole[:3, 3] + [0, 0, HOLE_DEPTH + tip_height + _PEG_TIP_BELOW_TOOL]
            steps.append(PlanStep(T_step, _GRIPPER, speed, tolerance, tolerance_deg, tremor=tremor))
        return steps


class PegInHole5mm(PegInHole):
    """Peg-in-hole with a hole of 4 cm: 5 mm of clearance on each side instead of 10.

    Goal, randomisation and success: as `PegInHole`; nothing else has other numbers.
    """

    name, clearance, scene = "peg_in_hole_5mm", 0.005, _scene(PEG_WIDTH + 2 * 0.005)


class PegInHole2mm(PegInHole):
    """Peg-in-hole with a hole of 3.4 cm: 2 mm of clearance on each side instead of 10.

    Goal, randomisation and success: as `PegInHole`; nothing else has other numbers.
    """

    name, clearance, scene = "peg_in_hole_2mm", 0.002, _scene(PEG_WIDTH + 2 * 0.002)


class PegInHole1mm(PegInHole):
    """Peg-in-hole with a hole of 3.2 cm: 1 mm of clearance on each side instead of 10.

    Goal, randomisation and success: as `PegInHole`; nothing else has other numbers.
    """

    name, clearance, scene = "peg_in_hole_1mm", 0.001, _scene(PEG_WIDTH + 2 * 0.001)
