"""The scene at each waypoint of a demonstration: what stands where, touches, is carried."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np

from sart_toolkit.collision.model import CollisionModel, PlacedModel
from sart_toolkit.data.records import Demonstration
from sart_toolkit.errors import Mismatch
from sart_toolkit.poses import Array, inverse
from sart_toolkit.robots.spec import RobotSpec
from sart_toolkit.scenes.spec import SceneSpec

# What is carried moves in the grasp: in small spheres by up to 0.9 mm in PyBullet and 0.23 mm in
# SAPIEN, by more in wide ones. A segment on which it moves farther is rejected.
GRASP_PLAY = 0.005


@dataclass(frozen=True)
class Phase:
    """What a waypoint has in common with its neighbours until the gripper or a contact changes.

    `gripper`: its command in [0, 1]; `carried`: names of the bodies in the grasp; `contacts`: pairs
    in which the robot, or what it carries, touches anything else.
    """

    gripper: float
    carried: frozenset[str]
    contacts: frozenset[tuple[str, str]]

    def change(self, after: Phase) -> str:
        """What is other in the phase after this one."""
        if self.gripper != after.gripper:
            return "gripper command"
        if self.carried != after.carried:
            return "grasp of " + ", ".join(sorted(self.carried ^ after.carried))
        return "contact " + " / ".join(min(self.contacts ^ after.contacts))


def demonstration_phases(
    demonstration: Demonstration, robot: RobotSpec, scene: SceneSpec
) -> tuple[Phase, ...]:
    """The phase that each waypoint of a demonstration belongs to, from gripper and contacts."""
    commands = demonstration.steps.commanded_gripper
    phases = []
    for command, touching in zip(commands, demonstration.touching, strict=True):
        carried = scene.grasped(touching, robot.gripper.finger_links)
        contacts = scene.outer_contacts(touching, carried)
        phases.append(Phase(round(float(command), 2), carried, contacts))
    # Before the first step nothing has been felt yet.
    return (dataclasses.replace(phases[1], gripper=phases[0].gripper), *phases[1:])


class DemonstratedScene:
    """Collision models of robot and scene as they were at the waypoints of a demonstration.

    Attributes:
        demonstration: what was shown.
        collision: robot and scene.
        phases: the phase of each waypoint.
    """

    def __init__(
        self,
        demonstration: Demonstration,
        robot: RobotSpec,
        scene: SceneSpec,
        grasp_play: float = GRASP_PLAY,
    ) -> None:
        """Read the geometry of robot and scene.

        Args:
            demonstration: what was shown.
            robot: the robot that was steered.
            scene: the task's scene.
            grasp_play: how far [m] what is carried may move in the grasp; that much more is kept
                clear of it.

        Raises:
            Mismatch: the demonstration doesn't tell where the scene's bodies were.
            InvalidInput: a body of the scene has no shape that collides.
        """
        if demonstration.robot != robot.name:
            raise Mismatch(
                f"the demonstration is of robot {demonstration.robot!r}, not {robot.name!r}; give "
                "its own"
            )
        missing = [b.name for b in scene.bodies if b.name not in demonstration.body_Ts_world]
        if missing:
            raise Mismatch(
                f"the demonstration doesn't tell where {missing[0]!r} was, so nothing can be "
                "proved about it; record it on a backend that observes bodies"
            )
        self.demonstration = demonstration
        self.grasp_play = grasp_play
        self.collision = CollisionModel(robot, scene)
        self.phases = demonstration_phases(demonstration, robot, scene)
        self._placed: dict[int, PlacedModel] = {}

    def at(self, t: int) -> tuple[dict[str, Array], float, dict[str, Array]]:
        """How things stood at waypoint `t`.

        Returns:
            The poses `(4, 4)` of the scene's bodies in the world, the gripper's opening in [0, 1],
            and the poses in the tool frame of what was in the grasp.
        """
        steps = self.demonstration.steps
        Ts = {name: poses[t] for name, poses in self.demonstration.body_Ts_world.items()}
        T_tool_world = inverse(steps.measured_Ts_world_tool[t])
        carried = {name: T_tool_world @ Ts[name] for name in self.phases[t].carried}
        return Ts, float(np.clip(steps.measured_gripper[t], 0.0, 1.0)), carried

    def placed(self, t: int) -> PlacedModel:
        """Robot and scene at waypoint `t`; what was in the grasp there moves with the tool."""
        if t not in self._placed:
            self._placed[t] = self.collision.placed(*self.at(t), grasp_play=self.grasp_play)
        return self._placed[t]
