"""The scenes that the suite tests a backend in, laid out around wherever a robot's tool is."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from sart_toolkit.poses import Array, pose
from sart_toolkit.robots.model import RobotModel
from sart_toolkit.robots.spec import Attachment, CameraSpec, RobotSpec, Shape, look_at
from sart_toolkit.scenes.spec import Body, Detent, Joint, SceneSpec

BLOCK_TOP = 0.04
STICK_TIP = 0.06
STICK_WIDTH = 0.02
GRASPED_WIDTH = 0.03
GRASP_HEIGHT = 0.145
BRICK_HEIGHT = 0.05
PUSH_HEIGHT = 0.16
DRAWER_GAP = 0.02
ROOM_HALF_WIDTH = 0.5
DOT_OFFSET = 0.18
DOT_THICKNESS = 0.002
BAR_MASS, BAR_LENGTH = 0.3, 0.2
SLIDER_MASS = 0.5
HINGE_STIFFNESS, SLIDE_STIFFNESS = 0.04, 5.0
HINGE_REST, SLIDE_REST = 0.3, 0.05
HINGE_CATCH = Detent(0.1, 0.3, 0.05)
SLIDE_CATCH = Detent(0.02, 0.08, 1.0)
HINGE_LIMIT, SLIDE_LIMIT = 0.8, 0.15

_GREEN, _MAGENTA = (0.0, 0.8, 0.0, 1.0), (0.8, 0.0, 0.8, 1.0)
_RED, _GREY = (0.8, 0.0, 0.0, 1.0), (0.5, 0.5, 0.5, 1.0)


def ready_joints(robot: RobotSpec) -> Array:
    """The joints `(n,)` [rad] with the tool pointing straight down where it is at home."""
    model = RobotModel(robot)
    at = model.fk(robot.home)[:3, 3]
    ready = site(robot) @ pose([0, 0, np.clip(at[2], 0.2, 0.4)], [np.pi, 0, 0])
    return model.ik(ready, robot.home)


def site(robot: RobotSpec) -> Array:
    """The frame `(4, 4)` on the ground under the tool at home: z up, x along the tool's x."""
    T_tool = RobotModel(robot).fk(robot.home)
    x, y = T_tool[:2, 0]
    return pose([*T_tool[:2, 3], 0.0], [0, 0, np.arctan2(y, x)])


def _specks(robot: RobotSpec) -> tuple[Attachment, ...]:
    """Specks that collide with nothing, on the finger links: they show where the fingers are."""
    speck = Shape("box", (0.002, 0.002, 0.002), collides=False)
    return tuple(
        Attachment(f"speck{i}", link, (speck,), mass=0.001)
        for i, link in enumerate(robot.gripper.finger_links)
    )


def _held(robot: RobotSpec) -> tuple[Attachment, ...]:
    """A stick along the tool's axis, its tip `STICK_TIP` beyond the tool frame, and the specks."""
    stick = Shape("box", (STICK_WIDTH, STICK_WIDTH, 0.08))
    at = pose([0, 0, STICK_TIP - 0.04])
    return (Attachment("stick", robot.tool_frame, (stick,), at), *_specks(robot))


def _ground() -> Body:
    return Body("table", (Shape("box", (2.4, 2.4, 0.1), pose([0.5, 0, -0.05])),))


def plain_scene(robot: RobotSpec) -> SceneSpec:
    """A table that the robot stands on, a block under the tool, a stick in the gripper."""
    T = site(robot)
    block = Shape("box", (0.06, 0.06, BLOCK_TOP), pose([0, 0, BLOCK_TOP / 2]))
    return SceneSpec(
        (_ground(), Body("block", (block,), T)),
        _held(robot),
        (CameraSpec("side", "world", look_at(T[:3, 3] + [0.3, -0.5, 0.4], T[:3, 3], _UP), 45.0),),
    )


def loose_scene(robot: RobotSpec) -> SceneSpec:
    """A peg that stands on a post between the fingers, and a brick on the table beside it."""
    T = site(robot)
    edge = BRICK_HEIGHT
    return SceneSpec(
        (
            _ground(),
            Body("post", (Shape("box", (0.02, 0.04, 0.1), pose([0, 0, 0.05])),), T),
            Body(
                "peg",
                (Shape("box", (GRASPED_WIDTH, 0.04, 0.06)),),
                T @ pose([0, 0, 0.13]),
                mass=0.1,
                friction=1.0,
            ),
            Body(
                "brick",
                (Shape("box", (edge, edge, edge)),),
                T @ pose([0.2, 0, edge / 2]),
                mass=0.2,
            ),
        ),
        _specks(robot),
    )


def jointed_scene(robot: RobotSpec) -> SceneSpec:
    """A drawer beside a stick in the gripper, and underground a beam with all sorts of joints."""
    T = site(robot)
    drawer = Joint(
        "rail",
        pose([STICK_WIDTH / 2 + DRAWER_GAP + 0.02, 0, 0.1]),
        np.array([1.0, 0.0, 0.0]),
        0.0,
        0.1,
        "prismatic",
        friction=2.0,
    )
    x, y, z = np.eye(3)
    bar_weight = BAR_MASS * 9.81 * BAR_LENGTH / 2
    weight = SLIDER_MASS * 9.81

    def hinged(name: str, place: float, axis: Array, **kwargs: Any) -> Body:
        """A bar along x, its hinge at one end; about y it falls to positive positions."""
        shape = Shape("box", (BAR_LENGTH, 0.02, 0.02), pose([BAR_LENGTH / 2, 0, 0]))
        joint = Joint("beam", pose([0, place, 0.1]), axis, -0.5, HINGE_LIMIT, **kwargs)
        return Body(name, (shape,), mass=BAR_MASS, joint=joint)

    def sliding(name: str, place: float, axis: Array, **kwargs: Any) -> Body:
        shape = Shape("box", (0.03, 0.03, 0.03))
        joint = Joint(
            "beam",
            pose([-0.2, place, 0.2]),
            axis,
            -0.1,
            SLIDE_LIMIT,
            "prismatic",
            **kwargs,
        )
        return Body(name, (shape,), mass=SLIDER_MASS, joint=joint)

    return SceneSpec(
        (
            _ground(),
            # 1 mm into the drawer: what moves on a body may overlap it.
            Body("rail", (Shape("box", (0.2, 0.04, 0.081), pose([0.1, 0, 0.0405])),), T),
            Body("drawer", (Shape("box", (0.04, 0.04, 0.04)),), mass=0.3, joint=drawer),
            Body("beam", (Shape("box", (0.02, 2.0, 0.02)),), T @ pose([0, 0, -1.5])),
            hinged("held_hinge", -0.8, y, friction=1.1 * bar_weight),
            hinged("slipping_hinge", -0.6, y, friction=0.9 * bar_weight),
            hinged("free_hinge", -0.4, y),
            hinged("sprung_hinge", -0.2, z, stiffness=HINGE_STIFFNESS, rest=HINGE_REST),
            hinged("caught_hinge", 0.0, z, detent=HINGE_CATCH),
            sliding("held_slide", 0.2, -z, friction=1.1 * weight),
            sliding("slipping_slide", 0.4, -z, friction=0.9 * weight),
            sliding("free_slide", 0.6, -z),
            sliding("sprung_slide", 0.8, y, stiffness=SLIDE_STIFFNESS, rest=SLIDE_REST),
            sliding("caught_slide", 1.0, x, detent=SLIDE_CATCH),
        ),
        _held(robot),
    )


def view_scene(robot: RobotSpec) -> SceneSpec:
    """A green ball and a magenta bead before three cameras, and a room underground with a fourth.

    The ball is at the middle of the cameras' images, the bead off it, so that where they appear
    shows how a camera stands whatever its field of view. The room's walls all look alike and are
    equally far away, so that the camera in its middle shows its field of view and its depth even
    where it looks along a wrong axis. The camera `nowhere` has nothing before it.
    """
    T = site(robot)
    wrist = robot.cameras[0]
    ready = RobotModel(robot).fk(ready_joints(robot), wrist.frame) @ wrist.T_frame_camera
    ball = (ready @ [0, 0, 0.3, 1])[:3]
    outwards = np.array([*ball[:2], 0.0]) / np.linalg.norm(ball[:2])
    across = np.cross(_UP, outwards)
    bead = ball + 0.05 * T[:3, 1] + 0.02 * _UP
    room = ball - 3.0 * _UP
    return SceneSpec(
        (
            Body("floor", (Shape("box", (3.0, 3.0, 0.1), rgba=_GREY),), pose([0, 0, -0.5])),
            Body("ball", (Shape("sphere", (0.015,), rgba=_GREEN),), pose(ball)),
            Body("bead", (Shape("sphere", (0.01,), rgba=_MAGENTA),), pose(bead)),
            Body("room", _walls(), pose(room)),
        ),
        cameras=(
            CameraSpec(
                "left",
                "world",
                look_at(ball + 0.45 * outwards + 0.3 * across + 0.2 * _UP, ball, _UP),
                40.0,
            ),
            CameraSpec(
                "right",
                "world",
                look_at(ball + 0.45 * outwards - 0.3 * across + 0.1 * _UP, ball, _UP),
                40.0,
            ),
            CameraSpec("room", "world", look_at(room, room + [1, 0, 0], _UP), 60.0),
            CameraSpec("nowhere", "world", pose([0, 0, 9.0]), 45.0),
        ),
    )


def _walls() -> tuple[Shape, ...]:
    """A cubic room: on each wall a red plate in the middle and a square of green dots."""
    d = ROOM_HALF_WIDTH
    shapes = []
    for rotvec in (
        np.pi / 2 * np.array([[0, 0, 0], [2, 0, 0], [1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0]])
    ):
        T = pose(rotvec=rotvec)
        wall = Shape("box", (2 * d, 2 * d, 0.1), T @ pose([0, 0, d + 0.05]), _GREY)
        plate = (0.1, 0.1, 2 * DOT_THICKNESS)
        dot = (0.06, 0.06, 2 * DOT_THICKNESS)
        shapes += [wall, Shape("box", plate, T @ pose([0, 0, d]), _RED, collides=False)]
        shapes += [
            Shape("box", dot, T @ pose([i * DOT_OFFSET, j * DOT_OFFSET, d]), _GREEN, collides=False)
            for i in (-1, 1)
            for j in (-1, 1)
        ]
    return tuple(shapes)


_UP = np.array([0.0, 0.0, 1.0])

SCENES: dict[str, Callable[[RobotSpec], SceneSpec]] = {
    "plain": plain_scene,
    "loose": loose_scene,
    "jointed": jointed_scene,
    "view": view_scene,
}
