"""What encloses a gripper's parts at every opening of a range, not only at some."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import pinocchio as pin

from sart_toolkit.collision.obstacles import hull_part
from sart_toolkit.collision.parts import ConvexPart
from sart_toolkit.errors import InvalidInput
from sart_toolkit.poses import Array, inverse
from sart_toolkit.robots.model import RobotModel

# A hull may enclose this much [m] that the part never sweeps on its arc, and leave out at most this
# [m] of what it does; the latter is taken off its distances.
_SAG, _EXCESS = 0.001, 2e-5
# A range of openings is widened to whole multiples of this, so that waypoints share their parts.
_GRID = 0.001


class Sweep(NamedTuple):
    """What encloses a robot's parts wherever its gripper is within a range of openings.

    `parts`: convex parts; `origins`: which of the robot's parts each stands for; `excess` [m]: by
    how much what each encloses may stand out of it.
    """

    parts: tuple[ConvexPart, ...]
    origins: tuple[int, ...]
    excess: tuple[float, ...]


class Linkage:
    """A robot's parts at any opening of its gripper, and what encloses them over a range."""

    def __init__(self, model: RobotModel, parts: Sequence[ConvexPart]) -> None:
        """Find the joints that move each part.

        Args:
            model: the robot, its gripper open.
            parts: its parts there.
        """
        self._parts = tuple(parts)
        self._model = pin.buildModelFromUrdf(str(model.urdf))
        self._data = self._model.createData()
        spec = model.spec
        self._arm = {self._model.getJointId(name) for name in spec.arm_joints}
        self._rates = {}
        self._open_at = {}
        closed_at = spec.gripper.joint_positions(1.0)
        for name, open_at in spec.gripper.joint_positions(0.0).items():
            joint = self._model.getJointId(name)
            self._open_at[joint] = open_at
            self._rates[joint] = closed_at[name] - open_at
        frames = {frame.name: i for i, frame in enumerate(self._model.frames)}
        self._frames = [frames[part.body] for part in parts]
        self._chains = [self._chain(frame) for frame in self._frames]
        self._open = self._frame_poses(0.0)
        self._bends = [self._bend(i) for i in range(len(parts))]

    def _chain(self, frame: int) -> list[int]:
        """The joints between a frame and the arm, the frame's own first; none if none moves it."""
        joint, chain = int(self._model.frames[frame].parentJoint), []
        while joint and joint not in self._arm:
            chain.append(joint)
            joint = int(self._model.parents[joint])
        return chain if any(self._rates.get(joint) for joint in chain) else []

    def moves(self, part: int) -> bool:
        """Whether the gripper's opening moves a part."""
        return bool(self._chains[part])

    @functools.lru_cache(maxsize=256)  # noqa: B019 - models live as long as their process
    def _frame_poses(self, gripper: float) -> dict[int, Array]:
        """The poses `(4, 4)` of the frames of parts that the gripper moves, on the arm's joint."""
        q = pin.neutral(self._model)
        for joint, rate in self._rates.items():
            q[self._model.joints[joint].idx_q] = self._open_at[joint] + rate * gripper
        pin.framesForwardKinematics(self._model, self._data, q)
        poses = {}
        for i, (frame, chain) in enumerate(zip(self._frames, self._chains, strict=True)):
            if chain:
                T_world_arm = self._data.oMi[int(self._model.parents[chain[-1]])]
                poses[i] = np.array(T_world_arm.actInv(self._data.oMf[frame]).homogeneous)
        return poses

    def _move(self, i: int, gripper: float) -> Array:
        """Where the gripper's opening brings a part from where it is open `(4, 4)`."""
        return np.asarray(self._frame_poses(gripper)[i] @ inverse(self._open[i]))

    def _bend(self, i: int) -> float:
        """No less than any point of a part accelerates over the gripper's command, `A` [m].

        For joints that turn, A = sum_jk |w_j| |w_k| R_max(j,k), w_j being joint j's rate and R_j
        the farthest that a point of the part is ever from it; a joint that slides at v adds
        2 v sum |w_k| over those before it that turn.
        """
        if not self._chains[i]:
            return 0.0
        frame = self._model.frames[self._frames[i]]
        T = np.array(frame.placement.homogeneous) @ inverse(self._open[i])
        reach = float(np.linalg.norm(_moved(self._parts[i].points, T), axis=1).max())
        bend = slid = 0.0
        # For the joints nearer to the part: sum |w_k| R_k.
        turned = 0.0
        for joint in self._chains[i]:
            rate = abs(self._rates.get(joint, 0.0))
            if self._model.joints[joint].shortname().startswith("JointModelP"):
                slid += rate
                # A range may go beyond open and closed, by less than this.
                reach += 2.0 * rate + abs(self._open_at.get(joint, 0.0))
            else:
                bend += rate**2 * reach + 2 * rate * (turned + slid)
                turned += rate * reach
            reach += float(np.linalg.norm(self._model.jointPlacements[joint].translation))
        return bend

    @functools.lru_cache(maxsize=32)  # noqa: B019 - models live as long as their process
    def at(self, gripper: float) -> Sweep:
        """The parts as they are at one opening."""
        parts = list(self._parts)
        for i, part in enumerate(parts):
            if self._chains[i]:
                T = self._move(i, gripper)
                points = _moved(part.points, T)
                placed = T @ part.T_joint_part
                parts[i] = ConvexPart(part.body, part.joint, part.geometry, placed, points)
        return Sweep(tuple(parts), tuple(range(len(parts))), (0.0,) * len(parts))

    def over(self, low: float, high: float) -> Sweep:
        """What encloses the parts at every opening from `low` to `high`.

        Those that move are hulls of their points at openings h apart. Between these no point leaves
        the straight line from the one place to the next by more than A h^2 / 8, A as from `_bend`:
        that is their `excess`. A long range is cut, so that hulls of arcs stay slim.

        Raises:
            InvalidInput: not a range, or one far beyond open and closed.
        """
        if not -0.5 <= low <= high <= 1.5:
            raise InvalidInput(f"gripper: expected a range about 0 to 1, got {low} to {high}")
        # What is a whole number of steps but for rounding stays as it is.
        return self._over(int(np.floor(low / _GRID + 1e-6)), int(np.ceil(high / _GRID - 1e-6)))

    @functools.lru_cache(maxsize=64)  # noqa: B019 - models live as long as their process
    def _over(self, first: int, last: int) -> Sweep:
        low, high = first * _GRID, max(last, first + 1) * _GRID
        parts: list[ConvexPart] = []
        origins: list[int] = []
        excess: list[float] = []
        for i, (part, bend) in enumerate(zip(self._parts, self._bends, strict=True)):
            if not self._chains[i]:
                parts.append(part)
                origins.append(i)
                excess.append(0.0)
                continue
            pieces = int(np.ceil((high - low) * np.sqrt(bend / (8 * _SAG)))) or 1
            length = (high - low) / pieces
            steps = int(np.ceil(length * np.sqrt(bend / (8 * _EXCESS)))) or 1
            for start in low + length * np.arange(pieces):
                openings = np.linspace(start, start + length, steps + 1)
                places = [_moved(part.points, self._move(i, float(each))) for each in openings]
                parts.append(hull_part(part.body, part.joint, np.concatenate(places)))
                origins.append(i)
                excess.append(bend * (length / steps) ** 2 / 8)
        return Sweep(tuple(parts), tuple(origins), tuple(excess))


def _moved(points: Array, T: Array) -> Array:
    return np.asarray(points @ T[:3, :3].T + T[:3, 3])
