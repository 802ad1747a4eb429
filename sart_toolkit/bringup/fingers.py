"""What a gripper's fingers do between open and closed, by geometry."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sart_toolkit.collision.linkage import Linkage
from sart_toolkit.collision.parts import (
    ConvexPart,
    coal_transform,
    convex_distance,
    robot_parts,
)
from sart_toolkit.poses import Array, inverse
from sart_toolkit.robots.model import RobotModel


@dataclass(frozen=True)
class Fingers:
    """A gripper's first two finger links at commands from 0 to 1.

    `gaps (k,)` [m]: between them, negative where their hulls overlap; `closing (3,)`: the direction
    in which the first nears the second, tool frame, 0 if it doesn't; `tips (3,)` [m]: the middle
    between what is farthest out of each along the tool's z, open, tool frame.
    """

    gaps: Array
    closing: Array
    tips: Array


def fingers_of(model: RobotModel, steps: int = 5) -> Fingers | None:
    """What the fingers do at so many commands; None unless two links with parts are fingers."""
    parts = robot_parts(model)
    names = [n for n in model.spec.gripper.finger_links if any(p.body == n for p in parts)]
    if len(names) < 2 or model.spec.gripper.driver is None:
        return None
    frames = model.pinocchio_model.frames
    T_joint_tool = next(
        np.array(f.placement.homogeneous) for f in frames if f.name == model.spec.tool_frame
    )
    linkage = Linkage(model, parts)
    at = [linkage.at(float(each)).parts for each in np.linspace(0.0, 1.0, steps)]
    sides = [
        [[part for part in placed if part.body == name] for name in names[:2]] for placed in at
    ]
    gaps = np.array([min(_distance(a, b) for a in left for b in right) for left, right in sides])
    T_tool_joint = inverse(T_joint_tool)
    middles = [
        [np.concatenate([p.points for p in side]) @ T_tool_joint[:3, :3].T + T_tool_joint[:3, 3]
         for side in both]
        for both in (sides[0], sides[-1])
    ]  # fmt: skip
    (a0, b0), (a1, b1) = middles
    nearing = (a1.mean(0) - b1.mean(0)) - (a0.mean(0) - b0.mean(0))
    length = float(np.linalg.norm(nearing))
    tips = np.mean([side[side[:, 2] > side[:, 2].max() - 0.01].mean(0) for side in (a0, b0)], 0)
    return Fingers(gaps, nearing / length if length > 1e-4 else np.zeros(3), tips)


def _distance(a: ConvexPart, b: ConvexPart) -> float:
    """The distance [m] between two parts on one joint."""
    return convex_distance(
        a.geometry, coal_transform(a.T_joint_part), b.geometry, coal_transform(b.T_joint_part)
    )
