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
from sart_toolkit.poses import Array
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


class _Joint(NamedTuple):
    """A joint of the linkage: how far it moves from open to closed [rad or m], does it slide."""

    index: int
    rate: float
    slides: bool


class Linkage:
    """A robot's parts at any opening of its gripper, and what encloses them over a range."""

    def __init__(self, model: RobotModel, parts: Sequence[ConvexPart]) -> None:
        """Find the joints that move each part.

        Args:
            model: the robot, its gripper open.
            parts: its parts there.

        Raises:
            InvalidInput: a joint of the linkage neither turns about an axis nor slides along one.
        """
        self._parts = tuple(parts)
        self._model = pin.buildModelFromUrdf(str(model.urdf))
        self._data = self._model.createData()
        spec = model.spec
        self._joints: dict[int, _Joint] = {}
        for name, rate in spec.gripper.joint_positions(1.0).items():
            index = self._model.getJointId(name)
            kind = self._model.joints[index].shortname()
            slides = kind.startswith("JointModelP")
            if self._model.joints[index].nq != 1 or not (slides or kind.startswith("JointModelR")):
                raise InvalidInput(
                    f"{spec.name}: gripper joint {name!r} neither turns within limits nor slides; "
                    "make it revolute or prismatic"
                )
            self._joints[index] = _Joint(index, rate, slides)
        self._arm = {self._model.getJointId(name) for name in spec.arm_joints}
        self._frames = {f.name: i for i, f in enumerate(self._model.frames)}
        # From a part's joint on the arm into its frame, where its points are known at opening 0.
        open_ = self._frame_poses(0.0)
        self._local = [
            np.linalg.inv(open_[i]) if self._chain(part) else None for i, part in enumerate(parts)
        ]
        self._bends = [self._bend(i) for i in range(len(parts))]

    def _chain(self, part: ConvexPart) -> list[int]:
        """The joints between a part and the arm, the part's own first."""
        frame = self._model.frames[self._frames[part.body]]
        joint, chain = int(frame.parentJoint), []
        while joint and joint not in self._arm:
            chain.append(joint)
            joint = int(self._model.parents[joint])
        return chain if any(self._moves(j) for j in chain) else []

    def _moves(self, joint: int) -> bool:
        return joint in self._joints and self._joints[joint].rate != 0.0

    def _frame_poses(self, gripper: float) -> dict[int, Array]:
        """The poses `(4, 4)` of moved parts' frames on the arm's last joint before them."""
        q = pin.neutral(self._model)
        for joint in self._joints.values():
            q[self._model.joints[joint.index].idx_q] = joint.rate * gripper
        pin.framesForwardKinematics(self._model, self._data, q)
        poses = {}
        for i, part in enumerate(self._parts):
            if chain := self._chain(part):
                carrier = self._data.oMi[int(self._model.parents[chain[-1]])]
                frame = self._data.oMf[self._frames[part.body]]
                poses[i] = np.array(carrier.actInv(frame).homogeneous)
        return poses

    def _bend(self, i: int) -> float:
        """No less than any point of a part accelerates over the gripper's command, `A` [m].

        For joints that turn, A = sum_jk |w_j| |w_k| R_max(j,k), w_j being joint j's rate and R_j
        the farthest that a point of the part is ever from it; a joint that slides at v adds
        2 v sum |w_k| over those before it that turn.
        """
        local = self._local[i]
        if local is None:
            return 0.0
        chain = self._chain(self._parts[i])
        frame = self._model.frames[self._frames[self._parts[i].body]]
        points = _moved(self._parts[i].points, local)
        tip = _moved(points, np.array(frame.placement.homogeneous))
        reach = float(np.linalg.norm(tip, axis=1).max())
        bend, slid = 0.0, 0.0
        # The rates at which joints nearer to the part turn, each with its reach.
        turning: list[tuple[float, float]] = []
        for index in chain:
            joint = self._joints.get(index, _Joint(index, 0.0, False))
            rate = abs(joint.rate)
            if joint.slides:
                slid += rate
                # Ranges go beyond open and closed by their tolerance.
                reach += 2.0 * rate
            else:
                bend += rate**2 * reach + 2 * rate * sum(w * r for w, r in turning)
                bend += 2 * rate * slid
                turning.append((rate, reach))
            reach += float(np.linalg.norm(self._model.jointPlacements[index].translation))
        return bend

    @functools.lru_cache(maxsize=32)  # noqa: B019 - models live as long as their process
    def at(self, gripper: float) -> Sweep:
        """The parts as they are at one opening."""
        poses = self._frame_poses(gripper)
        parts = []
        for i, part in enumerate(self._parts):
            local = self._local[i]
            if local is None:
                parts.append(part)
                continue
            T = poses[i] @ local
            points = _moved(part.points, T)
            placed = T @ part.T_joint_part
            parts.append(ConvexPart(part.body, part.joint, part.geometry, placed, points))
        return Sweep(tuple(parts), tuple(range(len(parts))), (0.0,) * len(parts))

    def over(self, low: float, high: float) -> Sweep:
        """What encloses the parts at every opening from `low` to `high`.

        Those that move are hulls of their points at openings h apart. Between these no point leaves
        the straight line from the one place to the next by more than A h^2 / 8, A as from `_bend`:
        that is their `excess`. A long range is cut, so that hulls of arcs stay slim.
        """
        return self._over(int(np.floor(low / _GRID + 1e-6)), int(np.ceil(high / _GRID - 1e-6)))

    @functools.lru_cache(maxsize=64)  # noqa: B019 - models live as long as their process
    def _over(self, first: int, last: int) -> Sweep:
        low, high = first * _GRID, max(last, first + 1) * _GRID
        parts: list[ConvexPart] = []
        origins: list[int] = []
        excess: list[float] = []
        for i, part in enumerate(self._parts):
            local, bend = self._local[i], self._bends[i]
            if local is None:
                parts, origins, excess = [*parts, part], [*origins, i], [*excess, 0.0]
                continue
            pieces = int(np.ceil((high - low) * np.sqrt(bend / (8 * _SAG)))) or 1
            ends = np.linspace(low, high, pieces + 1)
            steps = int(np.ceil((high - low) / pieces * np.sqrt(bend / (8 * _EXCESS)))) or 1
            for a, b in zip(ends[:-1], ends[1:], strict=True):
                openings = np.linspace(a, b, steps + 1)
                places = [_moved(part.points, self._pose(i, g) @ local) for g in openings]
                parts.append(hull_part(part.body, part.joint, np.concatenate(places)))
                origins.append(i)
                excess.append(bend * ((b - a) / steps) ** 2 / 8)
        return Sweep(tuple(parts), tuple(origins), tuple(excess))

    @functools.lru_cache(maxsize=1024)  # noqa: B019 - models live as long as their process
    def _poses(self, gripper: float) -> dict[int, Array]:
        return self._frame_poses(gripper)

    def _pose(self, i: int, gripper: float) -> Array:
        return self._poses(float(gripper))[i]


def _moved(points: Array, T: Array) -> Array:
    return points @ T[:3, :3].T + T[:3, 3]
