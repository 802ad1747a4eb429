"""Where augmented segments lead from and to, what follows them, and how they are shared out.

A new strategy is one subclass of `Strategy`, or another combination of what `SphereStrategy` is
made of; in this package also one line in `augment.STRATEGIES`. `docs/strategies.md` shows each.
"""

from __future__ import annotations

import abc
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from sart_toolkit.data.records import (
    Annotation,
    Demonstration,
    PrecisionSphere,
    convergence_waypoint,
)
from sart_toolkit.data.sampling import (
    SamplingConfig,
    sample_in_region,
    sample_pose,
    sample_position,
    sample_turn,
)
from sart_toolkit.errors import InvalidInput
from sart_toolkit.poses import Array, check_positive, frozen

Spheres = Sequence[PrecisionSphere]


@dataclass(frozen=True)
class Proposal:
    """A segment to attempt: from the commanded pose of waypoint `t_star` to `T_world_sampled`.

    `T_world_sampled (4, 4)` is the tool's pose in the world. A trajectory leads back along the
    segment, then along the demonstration from `t_star` to its end; if not `merged`, it ends at
    `t_star`.
    """

    t_star: int
    T_world_sampled: Array
    merged: bool = True

    def __post_init__(self) -> None:
        object.__setattr__(self, "T_world_sampled", frozen(self.T_world_sampled))


class Strategy(abc.ABC):
    """Decides where segments start and end, what follows them, and how many each sphere gets.

    Attributes:
        draws: whether it draws segments at all; a dataset by one that doesn't is its
            demonstrations.
        annotated: whether it draws from an annotation's spheres.
        plans: whether a segment whose straight line is blocked may bend round obstacles.
        policy: the policy that its datasets are for, if no other is asked for.
        n: trajectories in a dataset, if no other number is asked for.
    """

    draws: bool = True
    annotated: bool = True
    plans: bool = False
    policy: str = "compact_mlp"
    n: int = 40

    def spheres(
        self, demonstration: Demonstration, annotation: Annotation | None
    ) -> tuple[PrecisionSphere, ...]:
        """The spheres that segments of a demonstration are drawn from: the annotation's.

        Raises:
            InvalidInput: they are an annotation's, and there is none.
        """
        if annotation is None:
            raise InvalidInput(
                "annotation: the strategy draws from its spheres, and the demonstration has none; "
                "make one with `sart suggest`"
            )
        return annotation.spheres

    def weights(self, spheres: Spheres, allocation: str) -> Array:
        """How much of N each sphere is to get `(n,)`, in any unit.

        Args:
            spheres: those of all demonstrations.
            allocation: "root", "radius" or "equal", as `AugmentConfig` has it.
        """
        exponent = {"root": 0.5, "radius": 1.0, "equal": 0.0}[allocation]
        return np.array([sphere.radius for sphere in spheres]) ** exponent

    @abc.abstractmethod
    def propose(
        self,
        demonstration: Demonstration,
        spheres: Spheres,
        i: int,
        rng: np.random.Generator,
        config: SamplingConfig,
    ) -> Proposal:
        """A segment drawn for a sphere of a demonstration.

        Args:
            demonstration: the recorded demonstration.
            spheres: what `spheres` gave for it.
            i: which of them the segment is drawn for.
            rng: the only source of what is random.
            config: how poses are drawn.
        """


# --- where a trajectory rejoins the demonstration -----------------------------------------------


def leaving(demonstration: Demonstration, spheres: Spheres, i: int) -> int:
    """t*: the first waypoint after key waypoint i outside its sphere (paper, Eq. target_pose)."""
    return convergence_waypoint(demonstration, spheres[i])


def leaving_twice_as_far(demonstration: Demonstration, spheres: Spheres, i: int) -> int:
    """The first waypoint after key waypoint i that is farther than 2 r_i from it."""
    return convergence_waypoint(demonstration, spheres[i], 2.0)


def at_key(demonstration: Demonstration, spheres: Spheres, i: int) -> int:
    """Key waypoint i, the centre of its sphere."""
    return spheres[i].waypoint


def at_next_key(demonstration: Demonstration, spheres: Spheres, i: int) -> int:
    """Key waypoint i + 1, the centre of the next sphere; t* of the last sphere has none."""
    return spheres[i + 1].waypoint if i + 1 < len(spheres) else leaving(demonstration, spheres, i)


def leaving_next(demonstration: Demonstration, spheres: Spheres, i: int) -> int:
    """t* of the next sphere; of the last one its own."""
    return leaving(demonstration, spheres, min(i + 1, len(spheres) - 1))


# --- strategies ---------------------------------------------------------------------------------

Draw = Callable[[PrecisionSphere, np.random.Generator, SamplingConfig], Array]
Rejoin = Callable[[Demonstration, Spheres, int], int]


def sample_by_kind(
    sphere: PrecisionSphere, rng: np.random.Generator, config: SamplingConfig
) -> Array:
    """A tool pose `(4, 4)` anywhere in a free-space region, or on any other sphere."""
    draw = sample_in_region if sphere.kind == "free_space" else sample_pose
    return draw(sphere, rng, config)


@dataclass(frozen=True)
class SphereStrategy(Strategy):
    """A pose drawn for a sphere, and a waypoint at which the demonstration is rejoined.

    Without arguments it is the paper's: a pose on the sphere (Eqs. rand_pos and rand_ori), joined
    at the first waypoint outside it (Eq. target_pose), followed by the demonstration.

    Attributes:
        draw: draws the pose for a sphere.
        rejoin: the waypoint where it rejoins.
        merged: whether the demonstration follows.
    """

    draw: Draw = sample_pose
    rejoin: Rejoin = leaving
    merged: bool = True
    plans: bool = False

    def propose(
        self,
        demonstration: Demonstration,
        spheres: Spheres,
        i: int,
        rng: np.random.Generator,
        config: SamplingConfig,
    ) -> Proposal:
        """A segment from where it rejoins to a pose drawn for sphere i."""
        t_star = self.rejoin(demonstration, spheres, i)
        return Proposal(t_star, self.draw(spheres[i], rng, config), self.merged)


@dataclass(frozen=True)
class ContactFreeMiles(SphereStrategy):
    """A sphere of fixed radius at every waypoint, each segment returning to its centre.

    Attributes:
        radius: of all spheres [m].
    """

    annotated = False
    rejoin: Rejoin = at_key
    radius: float = 0.02

    def __post_init__(self) -> None:
        check_positive("radius", self.radius, "m")

    def spheres(
        self, demonstration: Demonstration, annotation: Annotation | None
    ) -> tuple[PrecisionSphere, ...]:
        """A sphere at every waypoint but the last, whatever the annotation says."""
        Ts = demonstration.steps.measured_Ts_world_tool[:-1]
        return tuple(PrecisionSphere(t, T, self.radius) for t, T in enumerate(Ts))


@dataclass(frozen=True)
class DemonstrationsOnly(Strategy):
    """Nothing is drawn: the dataset is its demonstrations.

    Attributes:
        policy: what they are for.
        n: how many, if no other number is asked for.
    """

    draws = False
    annotated = False
    policy: str = "compact_mlp"
    n: int = 40

    def spheres(
        self, demonstration: Demonstration, annotation: Annotation | None
    ) -> tuple[PrecisionSphere, ...]:
        """None."""
        return ()

    def propose(
        self,
        demonstration: Demonstration,
        spheres: Spheres,
        i: int,
        rng: np.random.Generator,
        config: SamplingConfig,
    ) -> Proposal:
        """Nothing.

        Raises:
            InvalidInput: there is no sphere to draw from.
        """
        raise InvalidInput("strategy: it draws no segments; use another, such as sart")


SART = SphereStrategy()
SART_PLANNED = SphereStrategy(draw=sample_by_kind, plans=True)
NO_POSITION = SphereStrategy(draw=sample_turn)
NO_ORIENTATION = SphereStrategy(draw=sample_position)
RETURN_TO_CENTER = SphereStrategy(rejoin=at_key)
NO_MERGE = SphereStrategy(merged=False)
NEXT_SPHERE_CENTER = SphereStrategy(rejoin=at_next_key)
NEXT_SPHERE_CONVERGENCE = SphereStrategy(rejoin=leaving_next)
EXTENDED_CONVERGENCE = SphereStrategy(rejoin=leaving_twice_as_far)
INSIDE_SPHERE = SphereStrategy(draw=sample_in_region)
MILES = ContactFreeMiles()
MILES_1CM = ContactFreeMiles(radius=0.01)
MILES_10CM = ContactFreeMiles(radius=0.1)
BC = DemonstrationsOnly()
REPLAY = DemonstrationsOnly(policy="replay", n=1)
