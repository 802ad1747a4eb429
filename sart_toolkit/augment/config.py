"""What an augmentation is to generate."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, get_args

import numpy as np

from sart_toolkit.augment import STRATEGIES, get_strategy
from sart_toolkit.augment.strategies import Strategy
from sart_toolkit.collision import SOURCES, Source
from sart_toolkit.collision.phases import IN_GRASP_SLIP
from sart_toolkit.collision.sensor import CloudConfig
from sart_toolkit.data.records import Recording
from sart_toolkit.data.sampling import SamplingConfig
from sart_toolkit.errors import InvalidInput, unknown_name
from sart_toolkit.poses import check_positive
from sart_toolkit.registry import lasting_reference

ALLOCATIONS = ("root", "radius", "equal")


@dataclass(frozen=True)
class AugmentConfig:
    """What to generate.

    `n`: trajectories in all, the demonstrations among them; the others are allocated to the spheres
    (see `allocate`) by the root of their radius, with `allocation` "radius" by the radius itself,
    with "equal" all alike, as in the paper. `duration` [s] is the paper's delta (2 s), the least
    that a segment takes, rounded up to whole recorded steps; `None`: as long as the demonstration
    takes for as much motion near the waypoint, from 0.4 to 2 s. Every segment is proved to keep
    `margin` [m] free of the `obstacles`, the bodies of the scene or the cloud that the
    demonstration's cameras saw (made as `cloud` says): as measured, even if what is grasped has
    slipped by `slip_tolerance` [m] and bodies have moved by `BODY_STILLNESS`; as commanded, even if
    the robot is off its path by its backend's `tracking_error` besides. A segment on which any of
    these was exceeded is rejected. `cameras`: whose images are recorded, `None` for those of the
    demonstration. `execution`: how segments are executed, "auto" for whichever executor the backend
    and the demonstrations allow. `recording`: "reversed" records the way out and reverses it, as
    the paper does; "return" records the way back, so that the robot lags behind its commands as it
    will when a policy acts.
    `strategy` may be given as an object; its reference is kept.
    """

    n: int = 40
    allocation: str = "root"
    strategy: str | Strategy = "sart"
    sampling: SamplingConfig = field(default_factory=SamplingConfig)
    duration: float | None = None
    margin: float = 0.0002
    slip_tolerance: float = IN_GRASP_SLIP
    obstacles: Source = "scene"
    cloud: CloudConfig = field(default_factory=CloudConfig)
    seed: int = 0
    cameras: tuple[str, ...] | None = None
    execution: str = "auto"
    recording: Recording = "reversed"

    def __post_init__(self) -> None:
        least = 2 if get_strategy(self.strategy).draws else 1
        if self.n < least:
            raise InvalidInput(
                f"n: expected at least {least} (the demonstration counts), got {self.n}"
            )
        if self.seed < 0:
            raise InvalidInput(f"seed: expected a whole number >= 0, got {self.seed}")
        if self.allocation not in ALLOCATIONS:
            raise unknown_name("allocation", self.allocation, ALLOCATIONS)
        if self.obstacles not in SOURCES:
            raise unknown_name("obstacles", self.obstacles, SOURCES)
        if self.recording not in get_args(Recording):
            raise unknown_name("recording", self.recording, get_args(Recording))
        if self.duration is not None:
            check_positive("duration", self.duration, "s")
        for name in ("margin", "slip_tolerance"):
            value = getattr(self, name)
            if not (np.isfinite(value) and value >= 0):
                raise InvalidInput(f"{name}: expected a finite number >= 0 m, got {value}")
        if self.cameras is not None:
            object.__setattr__(self, "cameras", tuple(self.cameras))
        reference = lasting_reference("strategy", self.strategy, STRATEGIES)
        object.__setattr__(self, "strategy", reference)

    def to_json(self) -> dict[str, Any]:
        """The settings as JSON values."""
        return dataclasses.asdict(self)

    @classmethod
    def from_json(cls, values: Mapping[str, Any]) -> AugmentConfig:
        """The settings that `to_json` wrote."""
        sampling, cloud = SamplingConfig(**values["sampling"]), CloudConfig()
        if "cloud" in values:
            cloud = CloudConfig.from_json(values["cloud"])
        return cls(**{**values, "sampling": sampling, "cloud": cloud})
