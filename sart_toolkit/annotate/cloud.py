"""Radii from what the wrist camera saw, where nothing else is known of the scene."""

from __future__ import annotations

import dataclasses
import functools

import numpy as np

from sart_toolkit.annotate.suggest import Gap, SuggestConfig, Suggestion
from sart_toolkit.collision.cloud import (
    CarriedObject,
    CloudConfig,
    SceneCloud,
    carried_object,
    fuse_cloud,
)
from sart_toolkit.collision.demonstrated import GRASP_PLAY, demonstration_phases
from sart_toolkit.collision.model import CollisionModel, ConvexPart, PlacedModel
from sart_toolkit.collision.obstacles import CloudObstacles, hull_part
from sart_toolkit.data.records import Demonstration
from sart_toolkit.poses import Array
from sart_toolkit.robots.spec import RobotSpec
from sart_toolkit.scenes.spec import SceneSpec

_OBSTACLE, _CARRIED = "cloud", "carried"
# Support is looked for within this distance [m] of an object, from above.
_BESIDE = 0.03


class CloudSurroundings:
    """Obstacles as the demonstration's pictures show them.

    A run of waypoints in which nothing new is touched, grasped or let go has a cloud of its own,
    from its own pictures: what was seen earlier may have been moved since. What is carried counts
    as a part of the tool, its shape taken from the pictures before and after it was lifted.
    """

    def __init__(
        self,
        demonstration: Demonstration,
        robot: RobotSpec,
        scene: SceneSpec,
        config: CloudConfig | None = None,
        grasp_play: float = GRASP_PLAY,
    ) -> None:
        """Look at the pictures of a demonstration.

        Args:
            demonstration: what was shown and seen.
            robot: the robot that was steered.
            scene: tells what is fixed to the robot and which bodies can be lifted; where its bodies
                are and what shape they have is not looked at.
            config: how pictures become a cloud.
            grasp_play: how far [m] what is carried may move in the grasp.

        Raises:
            InvalidInput: the demonstration holds no depth pictures.
        """
        self._demonstration, self._robot, self._held = demonstration, robot, scene.held
        self._config = config or CloudConfig()
        self._grasp_play = grasp_play
        alone = SceneSpec((), scene.held)
        self._collision = CollisionModel(robot, alone)
        self.kinematics = self._collision.kinematics
        self.phases = demonstration_phases(demonstration, robot, scene)

    def _run(self, t: int) -> range:
        """The waypoints about `t` in which nothing new is touched, grasped or let go."""

        def state(s: int) -> tuple[frozenset[str], frozenset[tuple[str, str]]]:
            return self.phases[s].carried, self.phases[s].contacts

        first, end = t, t + 1
        while first > 0 and state(first - 1) == state(t):
            first -= 1
        while end < len(self.phases) and state(end) == state(t):
            end += 1
        return range(first, end)

    def _down_to_support(self, carried: CarriedObject, cloud: SceneCloud) -> CarriedObject:
        """What was lifted, with its unseen underside: it reached down to what it had stood on."""
        T = self._demonstration.steps.measured_Ts_world_tool[carried.waypoints[0]]
        p = carried.points @ T[:3, :3].T + T[:3, 3]
        low, high = p.min(0) - _BESIDE, p.max(0) + _BESIDE
        beside = (cloud.points[:, :2] >= low[:2]).all(1) & (cloud.points[:, :2] <= high[:2]).all(1)
        below = cloud.points[beside & ~cloud.behind & (cloud.points[:, 2] < p[:, 2].min()), 2]
        if not len(below):
            return carried
        feet = p.copy()
        feet[:, 2] = np.percentile(below, 90)
        points = (np.concatenate([p, feet]) - T[:3, 3]) @ T[:3, :3]
        return dataclasses.replace(carried, points=points)

    @functools.cached_property
    def _obstacles(self) -> dict[range, tuple[CloudObstacles, CarriedObject | None]]:
        return {}

    def _seen(self, t: int) -> tuple[CloudObstacles, CarriedObject | None]:
        """The obstacles at a waypoint, and what is carried there."""
        run = self._run(t)
        if run not in self._obstacles:
            fuse = functools.partial(
                fuse_cloud, self._demonstration, self._robot, self._held, config=self._config
            )
            carried = None
            if self.phases[t].carried:
                before = self._run(0)
                carried = carried_object(
                    self._demonstration,
                    self._robot,
                    self._held,
                    after=run,
                    before=None if before == run else before,
                    config=self._config,
                )
            cloud = fuse(run, carried=() if carried is None else (carried,))
            if carried is not None and run.start > 0:
                carried = self._down_to_support(carried, cloud)
            self._obstacles[run] = CloudObstacles(cloud), carried
        return self._obstacles[run]

    @functools.cache  # noqa: B019 - as long as the demonstration's waypoints
    def placed(self, t: int) -> PlacedModel:
        """The robot as at waypoint `t`, without a scene."""
        gripper = float(np.clip(self._demonstration.steps.measured_gripper[t], 0.0, 1.0))
        return self._collision.placed({}, round(gripper, 2))

    @functools.cache  # noqa: B019 - as long as the demonstration's waypoints
    def _parts(self, t: int) -> list[ConvexPart]:
        """The robot's moving parts at a waypoint, and the hull of what is carried."""
        placed = self.placed(t)
        parts = [part for part in placed.parts if part.joint > 0]
        _, carried = self._seen(t)
        if carried is not None:
            T = placed.T_joint_tool
            points = carried.points @ T[:3, :3].T + T[:3, 3]
            parts.append(hull_part(_CARRIED, len(self._robot.arm_joints), points))
        return parts

    def proved(self, t: int, config: SuggestConfig) -> Suggestion:
        """The largest radius about waypoint `t` that keeps the tool clear of all that was seen."""
        obstacles, _ = self._seen(t)
        placed = self.placed(t)
        T_joint = placed.joint_poses(self._demonstration.steps.joint_positions[t])[-1]
        p_tool = (T_joint @ placed.T_joint_tool)[:3, 3]
        best = Suggestion(config.max_radius, None, "max_radius")
        tool = [part for part in self._parts(t) if part.joint == len(self._robot.arm_joints)]
        nearest: list[tuple[float, float, ConvexPart]] = []
        for part in tool:
            reach = float(np.linalg.norm(part.points - placed.T_joint_tool[:3, 3], axis=1).max())
            closest = obstacles.distances(part, T_joint, 0.0)
            if closest:
                nearest.append((closest[0].distance - self._play(part), reach, part))
        nearest.sort(key=lambda row: row[0])
        for apart, reach, part in nearest:
            if best.clearance is None:
                best = dataclasses.replace(best, clearance=apart)
            # Any point that is farther away than this leaves more room than the nearest one.
            within = config.rotation_per_metre * reach * max(apart, 0.0)
            if apart >= best.radius * (1 + config.rotation_per_metre * reach) + config.margin:
                continue
            points = part.points @ T_joint[:3, :3].T + T_joint[:3, 3] - p_tool
            for found in obstacles.distances(part, T_joint, within):
                play = self._play(part)
                support = float(found.normal @ (found.p_cloud - p_tool))
                gap = Gap(
                    found.body,
                    _OBSTACLE,
                    found.distance - play,
                    found.normal,
                    points,
                    support + self._config.inflation + play,
                )
                best = gap.limited(best, config)
        return best

    def too_close(self, t: int, q: Array, margin: float) -> str | None:
        """The names of a pair, the robot whole and the scene as seen, nearer than the margin."""
        placed = self.placed(t)
        pair = placed.too_close(q, margin)
        if pair is not None:
            return " / ".join(pair)
        poses = placed.joint_poses(q)
        obstacles, _ = self._seen(t)
        for part in self._parts(t):
            if obstacles.any_within([(part, poses[part.joint])], margin + self._play(part)):
                return f"{part.body} / {_OBSTACLE}"
        return None

    def _play(self, part: ConvexPart) -> float:
        """How far [m] a part may move in the grasp."""
        return self._grasp_play if part.body == _CARRIED else 0.0

    def moving(self, t: int) -> str | None:
        """Always `None`: pictures of one moment don't tell what moves."""
        return None
