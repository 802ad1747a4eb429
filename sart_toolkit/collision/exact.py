"""The world as the scene's description and the recorded poses of its bodies have it."""

from __future__ import annotations

import functools

import numpy as np

from sart_toolkit.collision.model import CollisionModel, PlacedModel
from sart_toolkit.collision.phases import IN_GRASP_SLIP
from sart_toolkit.collision.world import CollisionWorld
from sart_toolkit.data.records import Demonstration
from sart_toolkit.errors import Mismatch
from sart_toolkit.poses import Array, distance, inverse
from sart_toolkit.robots.model import RobotModel
from sart_toolkit.robots.spec import RobotSpec
from sart_toolkit.scenes.spec import SceneSpec

# What moves no farther than this in 0.2 s stands still [m, deg].
_STILL, _STILL_DEG = 0.0005, 0.2


class ExactWorld(CollisionWorld):
    """Robot and bodies of the scene, these where the demonstration has them.

    Attributes:
        collision: robot and scene.
    """

    def __init__(
        self,
        demonstration: Demonstration,
        robot: RobotSpec,
        scene: SceneSpec,
        slip_tolerance: float = IN_GRASP_SLIP,
    ) -> None:
        """Read the geometry of robot and scene.

        Args:
            demonstration: the recorded demonstration.
            robot: the robot that was steered.
            scene: the task's scene.
            slip_tolerance: how far [m] a grasped object may move in the grasp; that much more is
                kept clear of it.

        Raises:
            Mismatch: the demonstration is of another robot, or doesn't tell where the scene's
                bodies were.
            InvalidInput: a body of the scene has no shape that collides.
        """
        super().__init__(demonstration, robot, scene, slip_tolerance)
        missing = [b.name for b in scene.bodies if b.name not in demonstration.body_Ts_world]
        if missing:
            raise Mismatch(
                f"the demonstration doesn't tell where {missing[0]!r} was, so nothing can be "
                "proved about it; record it on a backend that observes bodies"
            )
        self.collision = CollisionModel(robot, scene)
        self._placed: dict[int, PlacedModel] = {}

    @property
    def kinematics(self) -> RobotModel:
        """The robot."""
        return self.collision.kinematics

    def at(self, t: int) -> tuple[dict[str, Array], float, dict[str, Array]]:
        """How things stood at waypoint `t`.

        Returns:
            The poses `(4, 4)` of the scene's bodies in the world, the gripper's measured opening in
            [0, 1], and the poses in the tool frame of what was in the grasp.
        """
        Ts = {name: poses[t] for name, poses in self.demonstration.body_Ts_world.items()}
        T_tool_world = inverse(self.demonstration.steps.measured_Ts_world_tool[t])
        grasped = {name: T_tool_world @ Ts[name] for name in self.phases[t].grasped}
        opening = np.clip(self.demonstration.steps.measured_gripper[t], 0.0, 1.0)
        return Ts, float(opening), grasped

    def placed(self, t: int) -> PlacedModel:
        """Robot and scene as at waypoint `t`; what was in the grasp there moves with the tool.

        The fingers are wherever `openings` has them.
        """
        if t not in self._placed:
            Ts, _, grasped = self.at(t)
            self._placed[t] = self.collision.placed(
                Ts,
                self.openings(t),
                grasped,
                slip_tolerance=self.slip_tolerance,
                gripper_play=self.gripper_play(t),
            )
        return self._placed[t]

    def moving(self, t: int) -> str | None:
        """The name of a body that doesn't stand still at waypoint `t`; a grasped one may move."""
        before, after = max(t - 1, 0), min(t + 1, len(self.phases) - 1)
        for name, Ts in self.demonstration.body_Ts_world.items():
            if name in self.phases[t].grasped or name in self._held:
                continue
            far, turn = distance(Ts[before], Ts[after])
            if far > _STILL or turn > np.deg2rad(_STILL_DEG):
                return name
        return None

    @functools.cached_property
    def _held(self) -> frozenset[str]:
        return frozenset(body.name for body in self.collision.scene.held)
