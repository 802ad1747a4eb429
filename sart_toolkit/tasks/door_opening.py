"""Door opening: hook a cabinet door's handle with the fingers and pull the door open."""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING

import numpy as np

from sart_toolkit.backends.interface import Observation
from sart_toolkit.poses import Array, pose
from sart_toolkit.robots.spec import Shape, look_at
from sart_toolkit.scenes.spec import Body, Joint, SceneSpec, SceneState
from sart_toolkit.tasks.parts import OVERVIEW, TABLE, tool_down
from sart_toolkit.tasks.task import Placement, PlanStep, Task

if TYPE_CHECKING:
    from sart_toolkit.robots.model import RobotModel

PANEL_THICKNESS, PANEL_WIDTH, PANEL_HEIGHT = 0.01, 0.29, 0.18
BAR_RADIUS, BAR_LENGTH, BAR_HEIGHT = 0.0075, 0.06, 0.17
BAR_GAP = 0.050  # between the bar and the panel
OPEN_DEG = 45.0
_EDGE = 0.05  # from the bar's middle to the panel's free edge
_POST, _LIFT = 0.008, 0.002  # the post's thickness; from the table to the panel
_STANDOFF = BAR_GAP + BAR_RADIUS + PANEL_THICKNESS / 2  # from the bar's axis to the hinge's plane
_CABINET_DEPTH, _WALL = 0.16, 0.012
_MIDDLE = np.array([0.50, 0.0, 0.0])
_START = np.array([0.51, 0.0, 0.41])
_GRIPPER = 1.0
# The closed fingers are 22 mm thick across the gap and end 18 mm beyond the tool's origin. Their
# tips go 15 mm below the bar's axis, where they are still narrow beside the post.
_FINGER_HALF, _FINGERTIP, _DEPTH = 0.011, 0.018, 0.015
_HOOK = 0.008  # from the bar's middle, away from the post, to where the fingers hook it
_PULL_DEG = (10.0, 20.0, 30.0, 40.0, 50.0, 57.0)
_CABINET = (0.80, 0.82, 0.84, 1.0)
_PANEL = (0.25, 0.50, 0.58, 1.0)
_HANDLE = (0.95, 0.72, 0.10, 1.0)
# The cabinet's origin is on the table below the middle of the bar, x into the cabinet.
_T_CABINET_HINGE = pose([_STANDOFF, PANEL_WIDTH - _EDGE, 0.0])
_P_HINGE_BAR = np.array([-_STANDOFF, _EDGE - PANEL_WIDTH, BAR_HEIGHT])


def _cabinet() -> Body:
    """Two sides, a back and a top behind the panel, open towards the robot."""
    front = _STANDOFF + PANEL_THICKNESS / 2 + 0.001
    x, y, z = front + _CABINET_DEPTH / 2, PANEL_WIDTH / 2 - _EDGE, PANEL_HEIGHT / 2
    y_side = (PANEL_WIDTH - _WALL) / 2
    side = (_CABINET_DEPTH, _WALL, PANEL_HEIGHT)
    back, top = (_WALL, PANEL_WIDTH, PANEL_HEIGHT), (_CABINET_DEPTH, PANEL_WIDTH, _WALL)
    walls = (
        (side, [x, y - y_side, z]),
        (side, [x, y + y_side, z]),
        (back, [front + _CABINET_DEPTH - _WALL / 2, y, z]),
        (top, [x, y, PANEL_HEIGHT - _WALL / 2]),
    )
    return Body("cabinet", tuple(Shape("box", size, pose(p), _CABINET) for size, p in walls))


def _door() -> Body:
    """Panel and handle; the hinge's axis goes up through the origin."""
    panel = (PANEL_THICKNESS, PANEL_WIDTH, PANEL_HEIGHT)
    y_post = _P_HINGE_BAR[1] - (BAR_LENGTH - _POST) / 2
    along_y = [np.pi / 2, 0, 0]
    joint = Joint(
        "cabinet",
        _T_CABINET_HINGE,
        np.array([0.0, 0.0, -1.0]),
        lower=0.0,
        upper=np.deg2rad(110),
        friction=0.05,
        stiffness=0.2,
        rest=-0.6,
    )
    return Body(
        "door",
        (
            Shape("box", panel, pose([0, -PANEL_WIDTH / 2, _LIFT + PANEL_HEIGHT / 2]), _PANEL),
            Shape("cylinder", (BAR_RADIUS, BAR_LENGTH), pose(_P_HINGE_BAR, along_y), _HANDLE),
            Shape(
                "box",
                (_STANDOFF, _POST, _POST),
                pose([-_STANDOFF / 2, y_post, BAR_HEIGHT]),
                _HANDLE,
            ),
        ),
        mass=0.6,
        joint=joint,
    )


class DoorOpening(Task):
    """Hook the handle of a cabinet's door with the closed fingers and pull the door open.

    Goal: the door is held open.
    Randomisation: the cabinet is placed uniformly within ±10 cm in x and y of (0.50, 0) m; nothing
    else moves. The robot starts with the fingertips 22 cm above the cabinet, over the middle of the
    range.
    Success: the hinge is open by at least 45 deg.

    The panel is 29 cm wide, 18 cm high, 1 cm thick and weighs 0.6 kg with its handle, a lever: a
    bar of radius 7.5 mm, 6 cm long, 5 cm off the panel on a post at its outer end. The hinge, on
    the robot's left, has 0.05 N m of dry friction and a closer that pulls with 0.12 N m when closed
    and 0.28 N m at 45 deg: about 1 N at the handle. A door that is let go falls shut.
    """

    name = "door_opening"
    robot = "ur5e_2f85"
    placement_range = 0.10
    horizon = 25.0
    hold = 0.5
    report_body = "cabinet"
    scene = SceneSpec(
        bodies=(TABLE, _cabinet(), _door()),
        cameras=(
            dataclasses.replace(
                OVERVIEW,
                T_frame_camera=look_at(
                    np.array([0.0, -0.80, 0.60]), np.array([0.50, 0.03, 0.16]), np.array([0, 0, 1])
                ),
            ),
        ),
    )

    def initial_state(self, model: RobotModel, placement: Placement) -> SceneState:
        q = model.ik(tool_down(_START), model.spec.home)
        T_world_cabinet = pose(_MIDDLE) @ placement.T_middle_object
        return self.scene.initial_state(q, _GRIPPER, {"cabinet": T_world_cabinet})

    def _opened_deg(self, observation: Observation) -> float:
        return float(np.rad2deg(self.scene.joint_position("door", observation.Ts_world_body)))

    def success(self, observation: Observation) -> bool:
        return self._opened_deg(observation) >= OPEN_DEG

    def failure_reason(self, observation: Observation) -> str:
        return f"door open by {self._opened_deg(observation):.0f} of {OPEN_DEG:.0f} deg"

    def plan(self, state: SceneState) -> list[PlanStep]:
        T_world_cabinet = state.Ts_world_body["cabinet"]

        def behind_bar(distance: float, depth: float, opened_deg: float = 0.0) -> Array:
            """The tool that far behind the bar's axis, the fingertips so deep below it [m].

            It goes round the hinge with the door but doesn't turn, so that the image shows how
            far the door is open.
            """
            T_door_tool = pose(_P_HINGE_BAR + [distance, _HOOK, _FINGERTIP - depth])
            turn = pose(rotvec=[0.0, 0.0, -np.deg2rad(opened_deg)])
            p_cabinet_tool = (_T_CABINET_HINGE @ turn @ T_door_tool)[:3, 3]
            return T_world_cabinet @ tool_down(p_cabinet_tool)

        in_gap, at_bar = BAR_RADIUS + BAR_GAP / 2, BAR_RADIUS + _FINGER_HALF
        pull = [
            PlanStep(behind_bar(at_bar, _DEPTH, deg), _GRIPPER, 0.05, 0.012, 6.0, through=True)
            for deg in _PULL_DEG
        ]
        return [
            PlanStep(behind_bar(in_gap, -0.04), _GRIPPER, 0.08, 0.005),
            PlanStep(behind_bar(in_gap, _DEPTH), _GRIPPER, 0.04, 0.005),
            *pull[:-1],
            dataclasses.replace(pull[-1], through=False),
        ]
