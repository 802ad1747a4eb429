"""Where an augmented segment leads from and to, and whether its path may bend.

A new strategy is one subclass of `Strategy`; in this package also one line in `augment.STRATEGIES`.
"""

from __future__ import annotations

import abc
from dataclasses import dataclass

import numpy as np

from sart_toolkit.data.records import Demonstration, PrecisionSphere, convergence_waypoint
from sart_toolkit.data.sampling import SamplingConfig, sample_in_region, sample_pose
from sart_toolkit.poses import Array, frozen


@dataclass(frozen=True)
class Proposal:
    """A segment to attempt: from the commanded pose of waypoint `t_star` to `T_world_sampled`.

    `T_world_sampled (4, 4)` is the tool's pose in the world.
    """

    t_star: int
    T_world_sampled: Array

    def __post_init__(self) -> None:
        object.__setattr__(self, "T_world_sampled", frozen(self.T_world_sampled))


class Strategy(abc.ABC):
    """Draws segments.

    Attributes:
        plans: whether a segment whose straight line is blocked may bend round obstacles.
    """

    plans: bool = False

    @abc.abstractmethod
    def propose(
        self,
        demonstration: Demonstration,
        sphere: PrecisionSphere,
        rng: np.random.Generator,
        config: SamplingConfig,
    ) -> Proposal:
        """A segment drawn for a sphere of a demonstration.

        Args:
            demonstration: the recorded demonstration.
            sphere: one of its precision spheres.
            rng: the only source of what is random.
            config: how poses are drawn.
        """


class Sart(Strategy):
    """The paper's strategy: a pose on the sphere, joined at the first waypoint outside it.

    Position Eq. (rand_pos): p = c + r [sin phi cos psi, sin phi sin psi, cos phi]. Rotation
    Eq. (rand_ori): R = C dR, its angle within nu_r r. Joining point Eq. (target_pose).
    """

    def propose(
        self,
        demonstration: Demonstration,
        sphere: PrecisionSphere,
        rng: np.random.Generator,
        config: SamplingConfig,
    ) -> Proposal:
        """A segment from t* to a pose on the sphere."""
        t_star = convergence_waypoint(demonstration, sphere)
        return Proposal(t_star, sample_pose(sphere, rng, config))


class SartPlanned(Strategy):
    """A pose in a free-space region, anywhere in its volume; else as the paper's strategy has it.

    Rotation and joining point are those of `Sart`.
    """

    plans = True

    def propose(
        self,
        demonstration: Demonstration,
        sphere: PrecisionSphere,
        rng: np.random.Generator,
        config: SamplingConfig,
    ) -> Proposal:
        """A segment from t* to a pose in the region, or on the sphere."""
        draw = sample_in_region if sphere.kind == "free_space" else sample_pose
        return Proposal(convergence_waypoint(demonstration, sphere), draw(sphere, rng, config))


SART = Sart()
SART_PLANNED = SartPlanned()
