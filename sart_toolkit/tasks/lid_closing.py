"""Lid closing: press the hinged lid of a container until it snaps shut."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from sart_toolkit.backends.interface import Observation
from sart_toolkit.poses import inverse, pose
from sart_toolkit.robots.spec import Shape
from sart_toolkit.scenes.spec import Body, Detent, Joint, SceneSpec, SceneState
from sart_toolkit.tasks.parts import OVERVIEW, TABLE, tool_down
from sart_toolkit.tasks.task import Placement, PlanStep, Task

if TYPE_CHECKING:
    from sart_toolkit.robots.model import RobotModel

DEPTH, WIDTH, HEIGHT = 0.07, 0.09, 0.05
LID_THICKNESS = 0.006
OPEN_DEG = 50.0
_WALL, _GAP = 0.004, 0.0005
LID_TOP = HEIGHT + _GAP + LID_THICKNESS
# The closed jaws' tips from the tool's origin.
TIP = 0.010
SHUT_DEG, LET_GO = 2.0, 0.010
# From the hinge to the jaws' middle. Their front, 11 mm further, so meets the open lid's face; on
# its edge, 40 mm from the hinge and 58 mm above it, they would jam with friction above 40 / 58.
PRESS = 0.026
_MIDDLE = np.array([0.48, 0.0, 0.0])
_START = _MIDDLE + [0.02, 0.0, 0.36]
_CLOSED = 1.0
_TEAL, _DARK, _ORANGE = (0.08, 0.36, 0.44, 1.0), (0.05, 0.10, 0.12, 1.0), (0.93, 0.50, 0.10, 1.0)


def _container() -> Body:
    """Four walls and a floor; origin at the middle of its bottom, the hinge at -x."""
    x, y, z = (DEPTH - _WALL) / 2, (WIDTH - _WALL) / 2, HEIGHT / 2
    walls = [
        Shape("box", size, pose(at), _TEAL)
        for size, at in (
            ((_WALL, WIDTH, HEIGHT), (x, 0, z)),
            ((_WALL, WIDTH, HEIGHT), (-x, 0, z)),
            ((DEPTH - 2 * _WALL, _WALL, HEIGHT), (0, y, z)),
            ((DEPTH - 2 * _WALL, _WALL, HEIGHT), (0, -y, z)),
        )
    ]
    size = (DEPTH - 2 * _WALL, WIDTH - 2 * _WALL, _WALL)
    return Body("container", (*walls, Shape("box", size, pose([0, 0, _WALL / 2]), _DARK)))


def _lid() -> Body:
    """A plate on a hinge; origin on the hinge, shut at 0."""
    plate = Shape(
        "box", (DEPTH, WIDTH, LID_THICKNESS), pose([DEPTH / 2, 0, LID_THICKNESS / 2]), _ORANGE
    )
    hinge = Joint(
        "container",
        pose([-DEPTH / 2, 0, HEIGHT + _GAP]),
        np.array([0.0, -1.0, 0.0]),
        lower=0.0,
        upper=np.deg2rad(OPEN_DEG),
        friction=0.01,
        stiffness=0.10,
        rest=np.deg2rad(75.0),
        # Beyond the stop, so that it still draws when the lid is shut.
        detent=Detent(position=np.deg2rad(-2.0), width=np.deg2rad(28.0), effort=0.5),
    )
    return Body("lid", (plate,), mass=0.05, friction=0.2, joint=hinge)


class LidClosing(Task):
    """Press the lid of a small container shut with closed jaws, and let go of it.

    Goal: the lid has snapped shut and stays so by itself.
    Randomisation: the container is placed uniformly within ±10 cm in x and y of (0.48, 0) m, on
    request also turned within ±15 deg. The robot starts with its jaws closed, 36 cm above the
    table, 2 cm beyond the middle.
    Success: the lid is less than 2 deg open and the jaws' tips are at least 10 mm above it; all
    this for 1 s.
    Geometry: the container is 7 cm deep (from the hinge), 9 cm wide, 5 cm tall, and fixed; the lid
    is 6 mm thick, weighs 50 g and starts 50 deg open. A spring pushes it open with 0.04 N m there
    and 0.13 N m when shut; a catch keeps it out with up to 0.5 N m from 26 to 12 deg and draws it
    shut from about 11 deg, so that a press of some 15 N is needed. Friction coefficient 0.2.
    """

    name = "lid_closing"
    robot = "ur5e_hande"
    placement_range = 0.10
    horizon = 20.0
    report_body = "container"
    scene = SceneSpec(bodies=(TABLE, _container(), _lid()), cameras=(OVERVIEW,))

    def initial_state(self, model: RobotModel, placement: Placement) -> SceneState:
        q = model.ik(tool_down(_START), model.spec.home)
        T_world_container = pose(_MIDDLE) @ placement.T_middle_object
        return self.scene.initial_state(
            q, _CLOSED, {"container": T_world_container}, {"lid": np.deg2rad(OPEN_DEG)}
        )

    def _measured(self, observation: Observation) -> tuple[float, float]:
        """The lid's angle [deg], and how far the tips are above the lid when shut [m]."""
        Ts = observation.Ts_world_body
        angle_deg = np.rad2deg(self.scene.joint_position("lid", Ts))
        p_container_tip = inverse(Ts["container"]) @ observation.T_world_tool @ [0, 0, TIP, 1]
        return float(angle_deg), float(p_container_tip[2]) - LID_TOP

    def success(self, observation: Observation) -> bool:
        angle_deg, above = self._measured(observation)
        return bool(angle_deg < SHUT_DEG and above > LET_GO)

    def failure_reason(self, observation: Observation) -> str:
        angle_deg, above = self._measured(observation)
        if angle_deg >= SHUT_DEG:
            return f"lid {angle_deg:.0f} deg open"
        return f"lid shut, but the jaws only {above * 1e3:.0f} mm above it"

    def plan(self, state: SceneState) -> list[PlanStep]:
        T_world_container = state.Ts_world_body["container"]
        R_world_tool = T_world_container[:3, :3] @ tool_down([0, 0, 0])[:3, :3]

        def step(height: float, speed: float, tolerance: float, pause: float = 0.0) -> PlanStep:
            """The tips `height` above the lid when shut."""
            T = np.eye(4)
            T[:3, :3] = R_world_tool
            p = [PRESS - DEPTH / 2, 0, LID_TOP + height + TIP, 1]
            T[:3, 3] = (T_world_container @ p)[:3]
            return PlanStep(T, _CLOSED, speed, tolerance, pause=pause)

        return [
            step(0.085, 0.08, 0.006),
            step(0.002, 0.05, 0.003, pause=0.1),
            step(0.04, 0.06, 0.006, pause=0.5),
        ]
