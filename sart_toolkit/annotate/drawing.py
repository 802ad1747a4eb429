"""What windows and pages draw alike: colours, words, cloud, sampled tools, where the eye starts."""

from __future__ import annotations

import numpy as np

from sart_toolkit.annotate.session import AnnotationSession
from sart_toolkit.annotate.verdict import Word
from sart_toolkit.collision.cloud import CloudConfig, SceneCloud, fuse_cloud
from sart_toolkit.data.records import Demonstration
from sart_toolkit.poses import Array, inverse
from sart_toolkit.robots.spec import RobotSpec
from sart_toolkit.robots.visuals import DrawnMesh, RobotVisuals
from sart_toolkit.scenes.spec import SceneSpec

TITLE = "sart annotate"
# Okabe and Ito's palette, distinct for colour-blind viewers; words stand beside all colours.
COLOURS: dict[Word, tuple[float, float, float]] = {
    "safe": (0.00, 0.55, 0.40),
    "tight": (0.88, 0.58, 0.00),
    "colliding": (0.75, 0.10, 0.10),
    "no room": (0.75, 0.10, 0.10),
    "region": (0.00, 0.40, 0.70),
}
INK, FAINT, PAPER, BACKDROP = (0.13, 0.15, 0.19), (0.42, 0.45, 0.5), (0.97,) * 3, (0.93,) * 3
ACCENT = (0.55, 0.25, 0.60)
# The path is coloured by clearance between these [m].
CLEARANCES = (0.0, 0.015, 0.05)
PATH_COLOURS = np.array([COLOURS[word] for word in ("colliding", "tight", "safe")])
# From what is looked at to the eye at the start, and to the right as seen from there.
TOWARDS_EYE = np.array([0.55, -0.76, 0.35])
RIGHT = np.array([0.81, 0.59, 0.0])
# From the tool to the eye [m] while the view follows it.
NEAR = 0.45


def fine_cloud(
    demonstration: Demonstration, robot: RobotSpec, scene: SceneSpec
) -> SceneCloud | None:
    """The points that a demonstration's images show; None where they have no depth."""
    if not any(camera.depth.any() for camera in demonstration.steps.cameras.values()):
        return None
    # Twice as fine as for suggestions, which also count what is hidden.
    fine = CloudConfig(voxel=CloudConfig().voxel / 2, unknown="free")
    return fuse_cloud(demonstration, robot, scene.held, config=fine)


def path_colours(clearances: Array) -> Array:
    """Colours `(T, 3)` in [0, 1] of a path, by how clear `(T,)` [m] the tool was."""
    return np.stack(
        [np.interp(clearances, CLEARANCES, channel) for channel in PATH_COLOURS.T], axis=1
    )


def message_of(session: AnnotationSession) -> str:
    """What an annotator says at the top."""
    return session.message or "A suggests all spheres, Enter adds one here"


def heading_of(session: AnnotationSession) -> str:
    """What stands above an annotator's spheres."""
    return f"{len(session.spheres)} spheres{', not saved' if session.dirty else ''}"


def start_view(demonstration: Demonstration) -> tuple[Array, float]:
    """What is looked at first, `p_world (3,)` [m], and how far from it the eye is [m]."""
    p = demonstration.steps.measured_Ts_world_tool[:, :3, 3]
    size = float(np.linalg.norm(np.ptp(p, axis=0)))
    return (p.min(0) + p.max(0)) / 2, max(0.55, 2.5 * size)


def gripper_at(demonstration: Demonstration, t: int) -> float:
    """The measured opening at a waypoint, in [0, 1]."""
    return float(np.clip(demonstration.steps.measured_gripper[t], 0.0, 1.0))


def ghost_gripper(demonstration: Demonstration, t: int) -> float:
    """The opening, to a tenth, with which poses sampled about a waypoint are drawn."""
    return round(gripper_at(demonstration, t), 1)


def ghost_meshes(robot: RobotVisuals, demonstration: Demonstration, t: int) -> list[DrawnMesh]:
    """The tool with what it holds, in the tool's frame, as at a waypoint."""
    steps = demonstration.steps
    Ts_world_joint = robot.poses_at(steps.joint_positions[t], ghost_gripper(demonstration, t))
    T_tool_world = inverse(steps.measured_Ts_world_tool[t])
    return [
        mesh.moved(T_tool_world @ Ts_world_joint[joint])
        for joint in robot.tool
        for mesh in robot.bodies[joint]
    ]
