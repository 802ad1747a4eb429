"""Lid opening: reach under a box's lid through its notch and throw the lid open."""

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

LID_DEPTH, LID_WIDTH, LID_THICKNESS = 0.20, 0.32, 0.01
NOTCH_DEPTH, NOTCH_WIDTH = 0.04, 0.10
BOX_HEIGHT = 0.10
OPEN_DEG, STOP_DEG = 120.0, 135.0
_REACH = LID_DEPTH - NOTCH_DEPTH  # from the hinge to the notch's edge
_WING = (LID_WIDTH - NOTCH_WIDTH) / 2  # of the lid, beside the notch
_Y_WING = (NOTCH_WIDTH + _WING) / 2
_WALL, _SILL = 0.01, 0.06  # the walls' thickness; the front wall's height below the notch
_RIM = 0.008
_MIDDLE = np.array([0.63, 0.0, 0.0])
_START, _START_PITCH_DEG = np.array([0.45, 0.0, 0.36]), 37.0
_GRIPPER = 1.0
_PITCH_DEG = 45.0
# The closed fingers are 22 mm thick and end 18 mm beyond the tool's origin; they reach 20 mm beyond
# the notch's edge.
_FINGER_HALF, _FINGERTIP, _INSERTION = 0.011, 0.018, 0.020
_LIFT_DEG, _PUSH_DEG = (15.0, 30.0, 45.0, 60.0, 75.0, 90.0), 108.0
_BOX_COLOUR = (0.80, 0.82, 0.84, 1.0)
_INSIDE_COLOUR = (0.20, 0.20, 0.24, 1.0)
_LID_COLOUR = (0.25, 0.50, 0.58, 1.0)
_RIM_COLOUR = (0.95, 0.72, 0.10, 1.0)
# The box's origin is on the table below the middle of the notch's edge, x away from the notch.
_T_BOX_HINGE = pose([_REACH, 0.0, BOX_HEIGHT])


def _box() -> Body:
    """Walls and a floor; the front wall is cut down below the notch."""
    front, back = -NOTCH_DEPTH + _WALL / 2, _REACH - _WALL / 2
    # A hair lower than the lid, so that no two drawn faces coincide.
    height = BOX_HEIGHT - 0.001
    x, y_side, z = (front + back) / 2, (LID_WIDTH - _WALL) / 2, height / 2
    side, wing = (LID_DEPTH, _WALL, height), (_WALL, _WING, height)
    walls = (
        (side, [x, y_side, z]),
        (side, [x, -y_side, z]),
        ((_WALL, LID_WIDTH, height), [back, 0, z]),
        (wing, [front, _Y_WING, z]),
        (wing, [front, -_Y_WING, z]),
        ((_WALL, NOTCH_WIDTH, _SILL), [front, 0, _SILL / 2]),
    )
    floor = Shape(
        "box", (LID_DEPTH - _WALL, LID_WIDTH - _WALL, 0.004), pose([x, 0, 0.002]), _INSIDE_COLOUR
    )
    return Body("box", (*(Shape("box", size, pose(p), _BOX_COLOUR) for size, p in walls), floor))


def _lid() -> Body:
    """The lid, the rim of its notch drawn in another colour; the hinge's axis along its y."""
    x_wing, z = -_REACH - NOTCH_DEPTH / 2, LID_THICKNESS / 2
    wing = (NOTCH_DEPTH, _WING, LID_THICKNESS)
    plates = (
        ((_REACH, LID_WIDTH, LID_THICKNESS), [-_REACH / 2, 0, z]),
        (wing, [x_wing, _Y_WING, z]),
        (wing, [x_wing, -_Y_WING, z]),
    )
    # The rim stands out a little all round, or the colours would mix where faces coincide.
    proud = 0.001
    x_rim, y_rim = x_wing + _RIM / 2 - proud, NOTCH_WIDTH / 2 + _RIM / 2 - proud
    flank = (NOTCH_DEPTH + _RIM, _RIM, LID_THICKNESS + 2 * proud)
    rims = (
        ((_RIM, NOTCH_WIDTH, LID_THICKNESS + 2 * proud), [-_REACH + _RIM / 2 - proud, 0, z]),
        (flank, [x_rim, y_rim, z]),
        (flank, [x_rim, -y_rim, z]),
    )
    joint = Joint(
        "box",
        _T_BOX_HINGE,
        np.array([0.0, 1.0, 0.0]),
        lower=0.0,
        upper=np.deg2rad(STOP_DEG),
        friction=0.05,
    )
    shapes = (
        *(Shape("box", size, pose(p), _LID_COLOUR) for size, p in plates),
        *(Shape("box", size, pose(p), _RIM_COLOUR, collides=False) for size, p in rims),
    )
    return Body("lid", shapes, mass=0.5, friction=0.3, joint=joint)


def _tool(p_world_tip: Array, pitch_deg: float, yaw: float = 0.0) -> Array:
    """The tool pitched forward, the camera on top, with the fingertips at a point `(3,)` [m]."""
    T = pose(rotvec=[0, 0, yaw]) @ tool_down([0, 0, 0], pitch_deg) @ pose(rotvec=[0, 0, np.pi])
    T[:3, 3] = p_world_tip - _FINGERTIP * T[:3, 2]
    return T


class LidOpening(Task):
    """Put the closed fingers through the notch under a box's lid and throw the lid open.

    Goal: the lid lies open against its stop.
    Randomisation: the box is placed uniformly within ±10 cm in x and y of (0.63, 0) m; nothing else
    moves. The robot starts with the tool pitched 37 deg forward, the fingertips 25 cm above the lid
    and 18 cm before the middle of the range.
    Success: the hinge is open by more than 120 deg.

    The lid is 20 cm deep, 32 cm wide, 1 cm thick and weighs 0.5 kg; the notch in its front edge is
    10 cm wide and 4 cm deep. The hinge at the back has 0.05 N m of dry friction and a stop at 135
    deg. The weight pulls the closed lid down with 0.5 N m, about 3 N at the notch, and turns over
    at 90 deg: let go 6 deg earlier, the lid falls shut; 6 deg later, it falls open and stays there.
    """

    name = "lid_opening"
    robot = "ur5e_2f85"
    placement_range = 0.10
    horizon = 25.0
    hold = 0.5
    report_body = "box"
    scene = SceneSpec(
        bodies=(TABLE, _box(), _lid()),
        cameras=(
            dataclasses.replace(
                OVERVIEW,
                T_frame_camera=look_at(
                    np.array([1.05, -1.0, 0.65]), np.array([0.64, 0, 0.20]), np.array([0, 0, 1])
                ),
            ),
        ),
    )

    def initial_state(self, model: RobotModel, placement: Placement) -> SceneState:
        q = model.ik(_tool(_START, _START_PITCH_DEG), model.spec.home + [0, 0, 0, 0, 0, np.pi])
        T_world_box = pose(_MIDDLE) @ placement.T_middle_object
        return self.scene.initial_state(q, _GRIPPER, {"box": T_world_box})

    def _opened_deg(self, observation: Observation) -> float:
        return float(np.rad2deg(self.scene.joint_position("lid", observation.Ts_world_body)))

    def success(self, observation: Observation) -> bool:
        return self._opened_deg(observation) > OPEN_DEG

    def failure_reason(self, observation: Observation) -> str:
        return f"lid open by {self._opened_deg(observation):.0f} of {OPEN_DEG:.0f} deg"

    def plan(self, state: SceneState) -> list[PlanStep]:
        T_world_box = state.Ts_world_body["box"]
        yaw = float(np.arctan2(T_world_box[1, 0], T_world_box[0, 0]))
        pitch = np.deg2rad(_PITCH_DEG)
        along = np.array([np.sin(pitch), 0.0, -np.cos(pitch)])
        across = np.array([np.cos(pitch), 0.0, np.sin(pitch)])
        touching = _INSERTION * along - _FINGER_HALF * across  # fingertips from the notch's edge

        def under_lid(opened_deg: float, drop: float = 0.0, retreat: float = 0.0) -> Array:
            """The tool touching a lid opened so far from below; or lower, or drawn back [m].

            The fingers, which don't turn, go along with the notch's edge, so that it doesn't slide
            on them, until the lid lies along them; from there on their tips carry it.
            """
            on_edge_deg = min(opened_deg, 90.0 - _PITCH_DEG)
            a = np.deg2rad(on_edge_deg)
            p_hinge_edge = _REACH * np.array([-np.cos(a), 0.0, np.sin(a)])
            p_hinge_tip = p_hinge_edge + touching - retreat * along - [0.0, 0.0, drop]
            turn = pose(rotvec=[0.0, np.deg2rad(opened_deg - on_edge_deg), 0.0])
            p_world_tip = (T_world_box @ _T_BOX_HINGE @ turn @ pose(p_hinge_tip))[:3, 3]
            return _tool(p_world_tip, _PITCH_DEG, yaw)

        return [
            PlanStep(under_lid(0.0, 0.012, 0.07), _GRIPPER, 0.08, 0.005),
            PlanStep(under_lid(0.0, 0.012), _GRIPPER, 0.04, 0.005),
            *(
                PlanStep(under_lid(deg), _GRIPPER, 0.06, 0.008, 6.0, through=True)
                for deg in _LIFT_DEG
            ),
            PlanStep(under_lid(_PUSH_DEG), _GRIPPER, 0.06, 0.006, 6.0, pause=0.5),
        ]
