"""Where an augmented segment leads from and to, and whether its path may bend.

A new strategy is one function and one line in `STRATEGIES`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from sart_toolkit.errors import InvalidInput, unknown_name
from sart_toolkit.motion.planning import check_planner
from sart_toolkit.poses import Array, exp_rotation, frozen, orthonormalised
from sart_toolkit.records import (
    ROTATION_PER_METRE,
    Demonstration,
    PrecisionSphere,
    convergence_waypoint,
)

LAWS = ("paper", "area")


@dataclass(frozen=True)
class Proposal:
    """A segment to try: from the commanded pose of waypoint `t_star` to `T_world_sampled (4,4)`."""

    t_star: int
    T_world_sampled: Array

    def __post_init__(self) -> None:
        object.__setattr__(self, "T_world_sampled", frozen(self.T_world_sampled))


@dataclass(frozen=True)
class SamplingConfig:
    """How poses are drawn: `law` of the position, `rotation_per_metre` nu_r [rad/m]."""

    law: str = "paper"
    rotation_per_metre: float = ROTATION_PER_METRE

    def __post_init__(self) -> None:
        if self.law not in LAWS:
            raise unknown_name("sampling law", self.law, LAWS)
        if not np.isfinite(self.rotation_per_metre) or self.rotation_per_metre < 0:
            raise InvalidInput(
                f"rotation_per_metre: expected a finite number >= 0, got {self.rotation_per_metre}"
            )


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


def sample_direction(rng: np.random.Generator, law: str) -> Array:
    """A unit vector `(3,)`: psi ~ U[0, 2 pi], and phi ~ U[0, pi] (`paper`) or cos phi ~ U[-1, 1].

    `paper` is the paper's Eq. (rand_pos) and draws the poles more often; `area` is uniform on the
    sphere, as in the published code.
    """
    psi = rng.uniform(0.0, 2.0 * np.pi)
    phi = rng.uniform(0.0, np.pi) if law == "paper" else np.arccos(rng.uniform(-1.0, 1.0))
    return np.array([np.sin(phi) * np.cos(psi), np.sin(phi) * np.sin(psi), np.cos(phi)])


def sample_rotation(rng: np.random.Generator, largest: float) -> Array:
    """A rotation `(3, 3)` by an angle ~ U[-largest, largest] [rad] about a uniform random axis."""
    angle = rng.uniform(-largest, largest)
    axis = sample_direction(rng, "area")
    return exp_rotation(angle * axis)


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
    return _proposal(demonstration, sphere, sphere.radius, rng, config)


def sart_planned(
    demonstration: Demonstration,
    sphere: PrecisionSphere,
    rng: np.random.Generator,
    config: SamplingConfig,
) -> Proposal:
    """A pose in a free-space region, anywhere in its volume; else as the paper's strategy has it.

    In a `free_space` region p = c + r u^(1/3) d, u ~ U[0, 1] and d a direction by the sampling law:
    by law `area` it is uniform in the ball. Rotation and joining point are those of `sart`.
    """
    distance = sphere.radius
    if sphere.kind == "free_space":
        distance *= float(np.cbrt(rng.uniform()))
    return _proposal(demonstration, sphere, distance, rng, config)


def _proposal(
    demonstration: Demonstration,
    sphere: PrecisionSphere,
    distance: float,
    rng: np.random.Generator,
    config: SamplingConfig,
) -> Proposal:
    """A pose at a distance [m] from a sphere's key pose, and where to rejoin."""
    T = np.eye(4)
    direction = sample_direction(rng, config.law)
    T[:3, 3] = sphere.T_world_key[:3, 3] + distance * direction
    dR = sample_rotation(rng, config.rotation_per_metre * sphere.radius)
    T[:3, :3] = orthonormalised(sphere.T_world_key[:3, :3] @ dR)
    return Proposal(convergence_waypoint(demonstration, sphere), T)


STRATEGIES = {"sart": Strategy(sart), "sart_planned": Strategy(sart_planned, plans=True)}


def get_strategy(name: str) -> Strategy:
    """The strategy called `name`.

    Raises:
        UnknownName: no such strategy; the message offers the nearest.
        MissingExtra: it plans, and OMPL isn't installed.
    """
    if name not in STRATEGIES:
        raise unknown_name("strategy", name, STRATEGIES)
    strategy = STRATEGIES[name]
    if strategy.plans:
        check_planner()
    return strategy
