"""Where an augmented segment leads from and to, and whether its path may bend.

A new strategy is one `Strategy` of a function, and one line in `augment.STRATEGIES`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from sart_toolkit.data.records import Demonstration, PrecisionSphere, convergence_waypoint
from sart_toolkit.data.sampling import SamplingConfig, sample_in_region, sample_pose
from sart_toolkit.poses import Array, frozen


@dataclass(frozen=True)
class Proposal:
    """A segment to try: from the commanded pose of waypoint `t_star` to `T_world_sampled (4,4)`."""

    t_star: int
    T_world_sampled: Array

    def __post_init__(self) -> None:
        object.__setattr__(self, "T_world_sampled", frozen(self.T_world_sampled))


Propose = Callable[[Demonstration, PrecisionSphere, np.random.Generator, SamplingConfig], Proposal]


@dataclass(frozen=True)
class Strategy:
    """Draws segments by calling `propose`; where it `plans`, they may bend round obstacles."""

    propose: Propose
    plans: bool = False

    def __call__(
        self,
        demonstration: Demonstration,
        sphere: PrecisionSphere,
        rng: np.random.Generator,
        config: SamplingConfig,
    ) -> Proposal:
        """The segment that `propose` draws."""
        return self.propose(demonstration, sphere, rng, config)


def sart(
    demonstration: Demonstration,
    sphere: PrecisionSphere,
    rng: np.random.Generator,
    config: SamplingConfig,
) -> Proposal:
    """The paper's strategy: a pose on the sphere, joined at the first waypoint outside it.

    Position Eq. (rand_pos): p = c + r [sin phi cos psi, sin phi sin psi, cos phi]. Rotation
    Eq. (rand_ori): R = C dR, its angle within nu_r r. Joining point Eq. (target_pose).
    """
    return Proposal(convergence_waypoint(demonstration, sphere), sample_pose(sphere, rng, config))


def sart_planned(
    demonstration: Demonstration,
    sphere: PrecisionSphere,
    rng: np.random.Generator,
    config: SamplingConfig,
) -> Proposal:
    """A pose in a free-space region, anywhere in its volume; else as the paper's strategy has it.

    Rotation and joining point are those of `sart`.
    """
    draw = sample_in_region if sphere.kind == "free_space" else sample_pose
    return Proposal(convergence_waypoint(demonstration, sphere), draw(sphere, rng, config))


SART = Strategy(sart)
SART_PLANNED = Strategy(sart_planned, plans=True)
