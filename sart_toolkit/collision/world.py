"""What suggestion and augmentation ask about obstacles, however these are known."""

from __future__ import annotations

from abc import ABC, abstractmethod

import numpy as np

from sart_toolkit.collision.certificate import Certificate, JointPath, certify
from sart_toolkit.collision.model import PlacedModel
from sart_toolkit.collision.phases import (
    GRIPPER_TOLERANCE,
    HELD_PLAY,
    HELD_TOLERANCE,
    demonstration_phases,
)
from sart_toolkit.data.records import Demonstration
from sart_toolkit.errors import Mismatch, MotionRejected
from sart_toolkit.poses import Array
from sart_toolkit.robots.model import RobotModel
from sart_toolkit.robots.spec import RobotSpec
from sart_toolkit.scenes.spec import SceneSpec


class CollisionWorld(ABC):
    """Robot and obstacles as they were at each waypoint of a demonstration.

    Attributes:
        demonstration: the recorded demonstration.
        phases: the phase of each waypoint.
        slip_tolerance: how far [m] a grasped object may move in the grasp.
    """

    def __init__(
        self,
        demonstration: Demonstration,
        robot: RobotSpec,
        scene: SceneSpec,
        slip_tolerance: float,
    ) -> None:
        """Find the demonstration's phases.

        Raises:
            Mismatch: the demonstration is of another robot.
        """
        if demonstration.robot != robot.name:
            raise Mismatch(
                f"the demonstration is of robot {demonstration.robot!r}, not {robot.name!r}; give "
                "its own"
            )
        self.demonstration = demonstration
        self.slip_tolerance = slip_tolerance
        self.phases = demonstration_phases(demonstration, robot, scene)

    @property
    @abstractmethod
    def kinematics(self) -> RobotModel:
        """The robot."""

    @abstractmethod
    def placed(self, t: int) -> PlacedModel:
        """Robot and obstacles as at waypoint `t`; what was in the grasp moves with the tool."""

    @abstractmethod
    def moving(self, t: int) -> str | None:
        """The name of an obstacle that is known not to stand still at waypoint `t`, or None."""

    def unknown(self, t: int) -> str | None:
        """What isn't known at waypoint `t`, so that nothing can be proved there, or None."""
        return None

    def openings(self, t: int) -> tuple[float, float]:
        """The least and the greatest opening of the gripper that proofs at waypoint `t` hold for.

        A segment starts with the gripper as it was measured there, and on the way it goes on to
        what is commanded; fingers that hold an object do where it gives way. That range, and
        `GRIPPER_TOLERANCE` beyond each of its ends, or `HELD_TOLERANCE` with something in the
        grasp, is taken as if it all happened at once.
        """
        steps = self.demonstration.steps
        ends = float(steps.measured_gripper[t]), float(steps.commanded_gripper[t])
        beyond = HELD_TOLERANCE if self.phases[t].grasped else GRIPPER_TOLERANCE
        return min(ends) - beyond, max(ends) + beyond

    def gripper_play(self, t: int) -> float:
        """By how much [m] the fingers may stand out of where `openings` has them."""
        return HELD_PLAY if self.phases[t].grasped else 0.0

    def check_known(self, t: int) -> None:
        """Return if all is known that proofs at waypoint `t` are about, and stands still.

        Raises:
            MotionRejected: something isn't, or doesn't.
        """
        moving = self.moving(t)
        if moving is not None:
            raise MotionRejected(
                f"{moving} moves: nothing can be proved at waypoint {t}; choose other waypoints"
            )
        unknown = self.unknown(t)
        if unknown is not None:
            raise MotionRejected(
                f"{unknown}: nothing can be proved at waypoint {t}; choose other waypoints"
            )

    def tool_clearance(self, t: int, q: Array) -> float:
        """How far [m] the tool is from the nearest obstacle of waypoint `t` at joints `q (n,)`.

        Infinite where there is none.
        """
        placed = self.placed(t)
        return float(min(placed.pair_distances(q, placed.tool_pairs()), default=np.inf))

    def too_close(self, t: int, q: Array, margin: float) -> str | None:
        """The names of the nearest pair at joints `q (n,)` if it is nearer than the margin [m].

        Raises:
            InvalidInput: `q` has the wrong shape or isn't finite.
        """
        pair = self.placed(t).too_close(q, margin)
        return None if pair is None else " / ".join(pair)

    def certify(self, t: int, path: JointPath, margin: float = 0.0) -> Certificate:
        """A proof that a joint path keeps clear of the obstacles of waypoint `t`, or where not.

        Raises:
            MotionRejected: not all is known that there is at the waypoint, or something moves.
            InvalidInput: the margin is negative, or the path not finite.
        """
        self.check_known(t)
        return certify(self.placed(t), path, margin)
