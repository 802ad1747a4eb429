"""Toolbox picking: grasp a box by its handle and lift it."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from sart_toolkit.backends.interface import Observation
from sart_toolkit.poses import Array, inverse, pose
from sart_toolkit.robots.spec import Shape
from sart_toolkit.scenes.spec import Body, SceneSpec, SceneState
from sart_toolkit.tasks.parts import OVERVIEW, TABLE, tool_down
from sart_toolkit.tasks.task import Placement, PlanStep, Task

if TYPE_CHECKING:
    from sart_toolkit.robots.model import RobotModel

BOX_WIDTH, BOX_HEIGHT = 0.12, 0.08
BAR_WIDTH, BAR_LENGTH = 0.016, 0.08
_FINGER_ROOM = 0.03
_POST = 0.008
BAR_HEIGHT = BOX_HEIGHT + _FINGER_ROOM + BAR_WIDTH / 2
MASS, FRICTION = 0.5, 0.9
LIFT, TILT_DEG = 0.05, 15.0
# How far the bar's middle may be from the tool's origin, in the tool's axes: across the bar, along
# it, and along the fingers.
_IN_FINGERS = np.array([0.010, 0.030, 0.015])
_MIDDLE = np.array([0.50, 0.0, 0.0])
_START = _MIDDLE + [-0.04, 0.0, 0.36]
_RAISED = 0.08
_RED, _STEEL = (0.80, 0.16, 0.12, 1.0), (0.93, 0.80, 0.20, 1.0)


def _toolbox() -> Body:
    """A box with a bar on two posts; origin at the middle of its bottom, the bar along x."""
    box = Shape("box", (BOX_WIDTH, BOX_WIDTH, BOX_HEIGHT), pose([0, 0, BOX_HEIGHT / 2]), _RED)
    bar = Shape("box", (BAR_LENGTH, BAR_WIDTH, BAR_WIDTH), pose([0, 0, BAR_HEIGHT]), _STEEL)
    x, z = (BAR_LENGTH - _POST) / 2, BOX_HEIGHT + _FINGER_ROOM / 2
    posts = [
        Shape("box", (_POST, BAR_WIDTH, _FINGER_ROOM), pose([side * x, 0, z]), _STEEL)
        for side in (-1, 1)
    ]
    return Body("toolbox", (box, bar, *posts), mass=MASS, friction=FRICTION)


class ToolboxPicking(Task):
    """Grasp a toolbox by its handle, by friction alone, and lift it.

    Goal: the toolbox hangs in the fingers, well above the table.
    Randomisation: the toolbox is placed uniformly within ±10 cm in x and y of (0.50, 0) m, on
    request also turned within ±15 deg. The robot starts with its open fingers 36 cm above the
    table, 4 cm on the robot's side of the middle.
    Success: the box's bottom is at least 5 cm above the table, the box is tilted < 15 deg, and the
    middle of the handle's bar is within 10 mm of the tool's origin across the bar, 30 mm along it
    and 15 mm along the fingers; all this for 1 s.
    Geometry: a 12 x 12 x 8 cm box of 0.5 kg; on it a bar 1.6 x 1.6 x 8 cm on two posts that leave
    3 cm of room below it for the fingertips. Friction coefficient 0.9, 1.0 at the fingers.
    """

    name = "toolbox_picking"
    robot = "ur5e_2f85"
    placement_range = 0.10
    horizon = 20.0
    report_body = "toolbox"
    scene = SceneSpec(bodies=(TABLE, _toolbox()), cameras=(OVERVIEW,))

    def initial_state(self, model: RobotModel, placement: Placement) -> SceneState:
        q = model.ik(tool_down(_START), model.spec.home)
        T_world_toolbox = pose(_MIDDLE) @ placement.T_middle_object
        return self.scene.initial_state(q, 0.0, {"toolbox": T_world_toolbox})

    def _measured(self, observation: Observation) -> tuple[float, float, Array]:
        """The box's height [m] and tilt [deg]; the bar's middle `(3,)` [m] in the tool's frame."""
        T = observation.Ts_world_body["toolbox"]
        up = float(np.clip(T[2, 2], -1.0, 1.0))
        p_tool_bar = (inverse(observation.T_world_tool) @ T @ [0, 0, BAR_HEIGHT, 1])[:3]
        return float(T[2, 3]), float(np.rad2deg(np.arccos(up))), p_tool_bar

    def success(self, observation: Observation) -> bool:
        height, tilt_deg, p_tool_bar = self._measured(observation)
        in_fingers = (np.abs(p_tool_bar) < _IN_FINGERS).all()
        return bool(height > LIFT and tilt_deg < TILT_DEG and in_fingers)

    def failure_reason(self, observation: Observation) -> str:
        height, tilt_deg, p_tool_bar = self._measured(observation)
        if tilt_deg >= TILT_DEG:
            return f"toolbox tilted {tilt_deg:.0f} deg"
        if (np.abs(p_tool_bar) >= _IN_FINGERS).any():
            return f"handle {np.linalg.norm(p_tool_bar) * 1e3:.0f} mm from between the fingers"
        return f"toolbox between the fingers but only {height * 1e3:.0f} mm above the table"

    def plan(self, state: SceneState) -> list[PlanStep]:
        toolbox = state.Ts_world_body["toolbox"]
        T = tool_down([0, 0, 0])
        T[:3, :3] = toolbox[:3, :3] @ T[:3, :3]

        def step(
            height: float, gripper: float, speed: float, tolerance: float, pause: float = 0.0
        ) -> PlanStep:
            """The tool's origin `height` above where the bar's middle is now."""
            T_step = T.copy()
            T_step[:3, 3] = toolbox[:3, 3] + [0, 0, BAR_HEIGHT + height]
            return PlanStep(T_step, gripper, speed, tolerance, pause=pause)

        return [
            step(0.06, 0.0, 0.08, 0.006),
            step(0.0, 0.0, 0.05, 0.004),
            step(0.0, 1.0, 0.02, 0.008, pause=0.8),
            step(_RAISED, 1.0, 0.06, 0.006, pause=0.8),
        ]
