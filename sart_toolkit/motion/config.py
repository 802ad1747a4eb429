"""The bounds that a `ToolController` keeps; data that needs no robot model."""

from __future__ import annotations

from dataclasses import dataclass

from sart_toolkit.poses import check_positive


@dataclass(frozen=True)
class ControllerConfig:
    """Bounds of the `ToolController`.

    `max_lead` [m], `max_lead_deg`: how far the commanded pose may be from the measured one.
    `max_joint_step` [rad]: how far, at most, a joint's goal may be from the one before; a farther
    one is on another branch of the arm. (How fast the joints then move, the robot's limits say.)
    """

    max_lead: float = 0.020
    max_lead_deg: float = 5.0
    max_joint_step: float = 0.35

    def __post_init__(self) -> None:
        check_positive("max_lead", self.max_lead, "m")
        check_positive("max_lead_deg", self.max_lead_deg, "deg")
        check_positive("max_joint_step", self.max_joint_step, "rad")
