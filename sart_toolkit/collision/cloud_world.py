"""The world as the recorded images show it, where nothing else is known of the scene."""

from __future__ import annotations

import dataclasses
from typing import NamedTuple

import numpy as np

from sart_toolkit.collision.cloud import (
    CloudConfig,
    GraspedObject,
    SceneCloud,
    fuse_cloud,
    grasped_object,
)
from sart_toolkit.collision.model import CollisionModel, PlacedModel
from sart_toolkit.collision.obstacles import CloudObstacles, hull_part
from sart_toolkit.collision.parts import ConvexPart
from sart_toolkit.collision.phases import IN_GRASP_SLIP
from sart_toolkit.collision.world import CollisionWorld
from sart_toolkit.data.records import Demonstration
from sart_toolkit.robots.model import RobotModel
from sart_toolkit.robots.spec import RobotSpec
from sart_toolkit.scenes.spec import SceneSpec

_GRASPED = "grasped object"
# Support is looked for within this distance [m] of an object, from above.
_BESIDE = 0.03


class _Seen(NamedTuple):
    """The cloud of a run of waypoints, and what is in the grasp there, also as a part."""

    cloud: SceneCloud
    obstacles: CloudObstacles
    grasped: GraspedObject | None
    part: ConvexPart | None


class CloudWorld(CollisionWorld):
    """Robot and obstacles, these as the demonstration's images show them.

    A run of waypoints in which nothing new is touched, grasped or let go has a cloud of its own,
    from its own images: what was seen earlier may have been moved since. What is grasped counts
    as a part of the tool, its shape taken from the images before and after it was lifted.

    Attributes:
        config: how images become a cloud.
    """

    def __init__(
        self,
        demonstration: Demonstration,
        robot: RobotSpec,
        scene: SceneSpec,
        slip_tolerance: float = IN_GRASP_SLIP,
        config: CloudConfig | None = None,
    ) -> None:
        """Take the images of a demonstration; they are processed when a waypoint is asked about.

        Args:
            demonstration: the recorded demonstration.
            robot: the robot that was steered.
            scene: says what is fixed to the robot and which bodies can be lifted; where its bodies
                are and what shape they have is not used.
            slip_tolerance: how far [m] what is grasped may move in the grasp.
            config: how images become a cloud.

        Raises:
            Mismatch: the demonstration is of another robot.
        """
        super().__init__(demonstration, robot, scene, slip_tolerance)
        self._robot, self._held = robot, scene.held
        self.config = config or CloudConfig()
        self._collision = CollisionModel(robot, SceneSpec((), scene.held))
        self._runs_seen: dict[range, _Seen] = {}
        self._shapes: dict[range, GraspedObject | None] = {}
        self._placed: dict[int, PlacedModel] = {}

    @property
    def kinematics(self) -> RobotModel:
        """The robot."""
        return self._collision.kinematics

    def placed(self, t: int) -> PlacedModel:
        """The robot with what it has grasped, and the cloud, as at waypoint `t`.

        Raises:
            InvalidInput: the demonstration holds no depth images, or they show nothing near.
        """
        if t not in self._placed:
            seen = self._seen(self._run(t))
            self._placed[t] = self._collision.placed(
                {},
                self.openings(t),
                slip_tolerance=self.slip_tolerance + (seen.grasped.error if seen.grasped else 0.0),
                gripper_play=self.gripper_play(t),
                grasped_parts=() if seen.part is None else (seen.part,),
                cloud=seen.obstacles,
            )
        return self._placed[t]

    def moving(self, t: int) -> str | None:
        """Always `None`: images of one moment don't show what moves."""
        return None

    def unknown(self, t: int) -> str | None:
        """That the shape of what is in the grasp at waypoint `t` was never seen, or None."""
        known = not self.phases[t].grasped or self._seen(self._run(t)).grasped is not None
        return None if known else f"{_GRASPED} not seen"

    def _run(self, t: int) -> range:
        """The waypoints about `t` in which nothing new is touched, grasped or let go."""

        def state(s: int) -> tuple[frozenset[str], frozenset[tuple[str, str]]]:
            return self.phases[s].grasped, self.phases[s].contacts

        first, end = t, t + 1
        while first > 0 and state(first - 1) == state(t):
            first -= 1
        while end < len(self.phases) and state(end) == state(t):
            end += 1
        return range(first, end)

    def _seen(self, run: range) -> _Seen:
        """What the images of a run of waypoints show."""
        if run not in self._runs_seen:
            self._runs_seen[run] = self._process(run)
        return self._runs_seen[run]

    def _process(self, run: range) -> _Seen:
        grasped = self._own_shape(run)
        if grasped is None:
            others = (o for o in self._same_grasp(run) if self._own_shape(o) is not None)
            if (other := next(others, None)) is None:
                cloud = self._fused(run)
                return _Seen(cloud, CloudObstacles(cloud), None, None)
            grasped = self._seen(other).grasped
            assert grasped is not None
            grasped = dataclasses.replace(grasped, waypoints=tuple(run))
        elif run.start > 0:
            # What it stood on is seen best before it was lifted; else where it has left.
            seen = grasped
            if not self.phases[0].grasped:
                seen = self._down_to_support(grasped, self._seen(self._run(0)).cloud)
            if seen is grasped:
                seen = self._down_to_support(grasped, self._fused(run, grasped))
            grasped = seen
        cloud = self._fused(run, grasped)
        T = self._collision.T_joint_tool
        points = grasped.points @ T[:3, :3].T + T[:3, 3]
        part = hull_part(_GRASPED, len(self._robot.arm_joints), points)
        return _Seen(cloud, CloudObstacles(cloud), grasped, part)

    def _fused(self, run: range, *grasped: GraspedObject) -> SceneCloud:
        about = self.demonstration, self._robot, self._held
        return fuse_cloud(*about, run, self.config, grasped)

    def _own_shape(self, run: range) -> GraspedObject | None:
        """What was in the grasp in a run of waypoints, as its own images show it."""
        if not self.phases[run.start].grasped:
            return None
        if run not in self._shapes:
            about = self.demonstration, self._robot, self._held
            first = self._run(0)
            before = None if first == run else first
            self._shapes[run] = grasped_object(*about, run, before, self.config)
        return self._shapes[run]

    def _same_grasp(self, run: range) -> list[range]:
        """The other runs of waypoints with the same grasp all the way, the nearest first."""
        grasped, runs = self.phases[run.start].grasped, []
        if grasped:
            for step, s in ((-1, run.start - 1), (1, run.stop)):
                while 0 <= s < len(self.phases) and self.phases[s].grasped == grasped:
                    runs.append(self._run(s))
                    s = runs[-1].start - 1 if step < 0 else runs[-1].stop
        return sorted(runs, key=lambda other: abs(other.start - run.start))

    def _down_to_support(self, grasped: GraspedObject, cloud: SceneCloud) -> GraspedObject:
        """What was lifted, with its unseen underside: it reached down to what it had stood on."""
        T = self.demonstration.steps.measured_Ts_world_tool[grasped.waypoints[0]]
        p = grasped.points @ T[:3, :3].T + T[:3, 3]
        low, high = p.min(0) - _BESIDE, p.max(0) + _BESIDE
        beside = (cloud.points[:, :2] >= low[:2]).all(1) & (cloud.points[:, :2] <= high[:2]).all(1)
        below = beside & ~cloud.behind & (cloud.points[:, 2] < p[:, 2].min())
        if not below.any():
            return grasped
        feet = p.copy()
        feet[:, 2] = np.percentile(cloud.points[below, 2], 90)
        points = (np.concatenate([p, feet]) - T[:3, 3]) @ T[:3, :3]
        error = float(cloud.inflation[below].max()) - self.config.inflation
        return dataclasses.replace(grasped, points=points, error=max(grasped.error, error))
