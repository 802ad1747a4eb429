"""How far a robot is from what surrounds it, and proofs that a path stays clear."""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal

from sart_toolkit.collision.phases import IN_GRASP_SLIP
from sart_toolkit.errors import unknown_name

if TYPE_CHECKING:
    from sart_toolkit.collision.cloud import CloudConfig
    from sart_toolkit.collision.world import CollisionWorld
    from sart_toolkit.data.records import Demonstration
    from sart_toolkit.robots.spec import RobotSpec
    from sart_toolkit.scenes.spec import SceneSpec

Source = Literal["scene", "cloud"]
SOURCES: tuple[Source, ...] = ("scene", "cloud")


def make_world(
    source: Source,
    demonstration: Demonstration,
    robot: RobotSpec,
    scene: SceneSpec,
    slip_tolerance: float = IN_GRASP_SLIP,
    cloud: CloudConfig | None = None,
) -> CollisionWorld:
    """The obstacles of a demonstration from the scene's geometry, or from recorded images alone.

    Args:
        source: "scene": the bodies of `scene`, where the demonstration has them; "cloud": the
            recorded RGB-D.
        demonstration: the recorded demonstration.
        robot: the robot that was steered.
        scene: the task's scene; of "cloud", only what is fixed to the robot is used, and the
            names of the bodies that can be lifted.
        slip_tolerance: how far [m] a grasped object may move in the grasp.
        cloud: how images become a cloud.

    Raises:
        UnknownName: no such source.
        Mismatch: the demonstration is of another robot, or "scene": it doesn't tell where the
            scene's bodies were.
        InvalidInput: "scene": a body has no shape that collides.
    """
    from sart_toolkit.collision.cloud_world import CloudWorld
    from sart_toolkit.collision.exact import ExactWorld

    if source == "scene":
        return ExactWorld(demonstration, robot, scene, slip_tolerance)
    if source == "cloud":
        return CloudWorld(demonstration, robot, scene, slip_tolerance, cloud)
    raise unknown_name("source", source, SOURCES)
