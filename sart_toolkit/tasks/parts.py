"""What the tasks' scenes have in common: a table, a camera that overlooks it, the tool's poses."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from sart_toolkit.poses import Array, pose
from sart_toolkit.robots.spec import CameraSpec, Shape, look_at
from sart_toolkit.scenes.spec import Body

# Plain, with its edges out of every camera's view: only the task's object may locate the goal.
TABLE = Body(
    "table", (Shape("box", (2.4, 2.4, 0.1), pose([0.5, 0, -0.05]), (0.55, 0.50, 0.44, 1.0)),)
)

# For people and videos; policies see the wrist camera alone.
OVERVIEW = CameraSpec(
    "overview",
    "world",
    look_at(np.array([1.05, -0.60, 0.42]), np.array([0.45, 0.0, 0.17]), np.array([0.0, 0.0, 1.0])),
    fov_y_deg=38.0,
    near=0.05,
    far=6.0,
)


def tool_down(p_world_tool: ArrayLike, pitch_deg: float = 0.0) -> Array:
    """The tool's pose `(4, 4)` at a position [m], pointing down, the camera on the robot's side.

    Args:
        p_world_tool: `(3,)`.
        pitch_deg: how far the tool points forward, away from the robot: 90 is level.
    """
    T = np.eye(4)
    T[:3, :3] = [[0, -1, 0], [-1, 0, 0], [0, 0, -1]]
    T = pose(rotvec=[0, -np.deg2rad(pitch_deg), 0]) @ T
    T[:3, 3] = p_world_tool
    return T
