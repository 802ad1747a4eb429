"""What an augmentation is to generate."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from sart_toolkit.augment import STRATEGIES, get_strategy
from sart_toolkit.augment.strategies import Strategy
from sart_toolkit.collision.demonstrated import GRASP_PLAY
from sart_toolkit.data.sampling import SamplingConfig
from sart_toolkit.errors import InvalidInput, unknown_name
from sart_toolkit.poses import check_positive
from sart_toolkit.registry import lasting_reference

SHARES = ("radius", "equal")


@dataclass(frozen=True)
class AugmentConfig:
    """What to generate.

    `n`: trajectories in all, the demonstration among them; how the spheres share the others tells
    `quotas`, their weights being their radii, or with `share` "equal" all the same, as in the
    paper. `duration` [s] is the paper's delta, the least that a segment takes. Every segment is
    proved to keep `margin` [m] free, even if what is carried moves by `grasp_play` [m] in the
    grasp; if any point of it moves farther the segment is rejected. `camera`: whose pictures are
    recorded, `None` for none. `strategy` may be given as an object; its reference is kept.
    """

    n: int = 40
    share: str = "radius"
    strategy: str | Strategy = "sart"
    sampling: SamplingConfig = field(default_factory=SamplingConfig)
    duration: float = 2.0
    margin: float = 0.0002
    grasp_play: float = GRASP_PLAY
    seed: int = 0
    camera: str | None = "wrist"

    def __post_init__(self) -> None:
        if self.n < 2:
            raise InvalidInput(f"n: expected at least 2 (the demonstration counts), got {self.n}")
        if self.seed < 0:
            raise InvalidInput(f"seed: expected a whole number >= 0, got {self.seed}")
        if self.share not in SHARES:
            raise unknown_name("share", self.share, SHARES)
        check_positive("duration", self.duration, "s")
        for name in ("margin", "grasp_play"):
            value = getattr(self, name)
            if not (np.isfinite(value) and value >= 0):
                raise InvalidInput(f"{name}: expected a finite number >= 0 m, got {value}")
        get_strategy(self.strategy)
        reference = lasting_reference("strategy", self.strategy, STRATEGIES)
        object.__setattr__(self, "strategy", reference)

    def quotas(self, radii: Sequence[float]) -> list[int]:
        """How many of the n - 1 trajectories spheres of the given radii [m] get.

        One after the other goes to the sphere with the greatest weight / (2 trajectories + 1)
        (Webster's method), so that more trajectories never take one away from any sphere. With
        equal weights that is round-robin.
        """
        weights = np.ones(len(radii)) if self.share == "equal" else np.asarray(radii)
        counts = np.zeros(len(radii), dtype=int)
        for _ in range(self.n - 1):
            counts[np.argmax(weights / (2 * counts + 1))] += 1
        return [int(count) for count in counts]
