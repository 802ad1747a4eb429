"""Bottle placing: stand a bottle, held by its neck, in a cup."""

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

BOTTLE_DIAMETER, BODY_LENGTH = 0.065, 0.115
NECK_DIAMETER, NECK_LENGTH = 0.03, 0.05
MASS, FRICTION = 0.3, 0.9
CUP_DIAMETER, CUP_DEPTH, FLOOR = 0.085, 0.055, 0.005
_WALL, _SEGMENTS = 0.005, 16
STROKE = 0.05
# The tool's origin above the bottle's bottom: the jaws' tips end 7 mm above the shoulder.
GRIP_HEIGHT = BODY_LENGTH + 0.017
_GRIPPING = 1.0 - NECK_DIAMETER / STROKE
_SQUEEZE = 1.0
MAX_OFFSET, MAX_HEIGHT, MAX_TILT_DEG, MIN_OPENING = 0.012, 0.010, 10.0, 0.040
_MIDDLE = np.array([0.42, 0.0, 0.0])
_START = _MIDDLE + [0.10, 0.0, CUP_DEPTH + FLOOR + 0.21 + GRIP_HEIGHT]
_GREEN, _PALE = (0.10, 0.55, 0.30, 1.0), (0.85, 0.93, 0.60, 1.0)
_BLUE, _DEEP = (0.15, 0.30, 0.75, 1.0), (0.06, 0.10, 0.25, 1.0)


def _bottle() -> Body:
    """A cylinder with a neck; origin at the middle of its bottom."""
    body = Shape(
        "cylinder", (BOTTLE_DIAMETER / 2, BODY_LENGTH), pose([0, 0, BODY_LENGTH / 2]), _GREEN
    )
    neck = Shape(
        "cylinder",
        (NECK_DIAMETER / 2, NECK_LENGTH),
        pose([0, 0, BODY_LENGTH + NECK_LENGTH / 2]),
        _PALE,
    )
    return Body("bottle", (body, neck), mass=MASS, friction=FRICTION)


def _cup() -> Body:
    """A floor and a ring of flat walls; origin at the middle of its bottom."""
    apothem = (CUP_DIAMETER + _WALL) / 2
    height = FLOOR + CUP_DEPTH
    width = (CUP_DIAMETER + 2 * _WALL) * np.tan(np.pi / _SEGMENTS)
    walls = [
        Shape(
            "box",
            (_WALL, width, height),
            pose(rotvec=[0, 0, angle]) @ pose([apothem, 0, height / 2]),
            _BLUE,
        )
        for angle in np.arange(_SEGMENTS) * 2 * np.pi / _SEGMENTS
    ]
    floor = Shape("cylinder", (apothem, FLOOR), pose([0, 0, FLOOR / 2]), _DEEP)
    return Body("cup", (*walls, floor))


class BottlePlacing(Task):
    """Stand a bottle, held by its neck by friction alone, in a cup, and let go of it.

    Goal: the bottle stands in the cup, the jaws are open.
    Randomisation: the cup is placed uniformly within ±10 cm in x and y of (0.42, 0) m. The robot
    starts with the bottle's bottom 21 cm above the cup's rim, 10 cm beyond the middle, where the
    camera looks past the bottle at the cup.
    Success: the middle of the bottle's bottom is within 12 mm of the cup's axis and at most 10 mm
    above the cup's floor, the bottle is tilted < 10 deg, and the jaws are at least 40 mm apart; all
    this for 1 s.
    Geometry: the bottle is 6.5 cm wide and 11.5 cm tall with a neck 3 cm wide and 5 cm tall, and
    weighs 0.3 kg; the cup is 8.5 cm wide (between opposite walls of its 16) and 5.5 cm deep,
    and fixed. Friction coefficient of the bottle 0.9, 1.0 at the jaws.
    """

    name = "bottle_placing"
    robot = "ur5e_hande"
    placement_range = 0.10
    horizon = 20.0
    report_body = "cup"
    scene = SceneSpec(bodies=(TABLE, _cup(), _bottle()), cameras=(OVERVIEW,))

    def initial_state(self, model: RobotModel, placement: Placement) -> SceneState:
        T_world_tool = tool_down(_START)
        q = model.ik(T_world_tool, model.spec.home)
        bodies = {
            "cup": pose(_MIDDLE) @ placement.T_middle_object,
            "bottle": pose(_START - [0, 0, GRIP_HEIGHT]),
        }
        return self.scene.initial_state(q, _GRIPPING, bodies, gripper_target=_SQUEEZE)

    def _measured(self, observation: Observation) -> tuple[Array, float, float]:
        """The bottom's middle `(3,)` [m] from the floor's, the tilt [deg], the opening [m]."""
        Ts = observation.Ts_world_body
        T_floor_bottle = inverse(Ts["cup"] @ pose([0, 0, FLOOR])) @ Ts["bottle"]
        tilt_deg = np.rad2deg(np.arccos(np.clip(T_floor_bottle[2, 2], -1.0, 1.0)))
        opening = STROKE * (1.0 - observation.gripper)
        return T_floor_bottle[:3, 3], float(tilt_deg), opening

    def success(self, observation: Observation) -> bool:
        bottom, tilt_deg, opening = self._measured(observation)
        stands = np.linalg.norm(bottom[:2]) < MAX_OFFSET and bottom[2] < MAX_HEIGHT
        return bool(stands and tilt_deg < MAX_TILT_DEG and opening > MIN_OPENING)

    def failure_reason(self, observation: Observation) -> str:
        bottom, tilt_deg, opening = self._measured(observation)
        beside, above = np.linalg.norm(bottom[:2]) * 1e3, bottom[2] * 1e3
        if tilt_deg >= MAX_TILT_DEG:
            return f"bottle tilted {tilt_deg:.0f} deg"
        if beside >= MAX_OFFSET * 1e3:
            return f"bottle {beside:.0f} mm beside the cup's axis, {above:+.0f} mm from its floor"
        if above >= MAX_HEIGHT * 1e3:
            return f"bottle over the cup's floor, but {above:.0f} mm above it"
        return f"bottle in the cup, but the jaws only {opening * 1e3:.0f} mm apart"

    def plan(self, state: SceneState) -> list[PlanStep]:
        p_floor = state.Ts_world_body["cup"][:3, 3] + [0, 0, FLOOR]

        def step(
            height: float, gripper: float, speed: float, tolerance: float, pause: float = 0.0
        ) -> PlanStep:
            """The bottle's bottom, while it is held, `height` above the cup's floor."""
            T = tool_down(p_floor + [0, 0, height + GRIP_HEIGHT])
            return PlanStep(T, gripper, speed, tolerance, pause=pause)

        return [
            step(CUP_DEPTH + 0.03, _SQUEEZE, 0.08, 0.006),
            step(0.003, _SQUEEZE, 0.05, 0.004),
            step(0.003, 0.0, 0.02, 0.008, pause=0.5),
            step(0.09, 0.0, 0.06, 0.010, pause=0.5),
        ]
