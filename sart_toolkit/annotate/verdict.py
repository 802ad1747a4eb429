"""What geometry says of a precision sphere, whoever set its radius."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Literal

from sart_toolkit.annotate.suggest import SuggestConfig, Suggestion, suggest_radius
from sart_toolkit.collision.world import CollisionWorld
from sart_toolkit.data.records import Annotation, PrecisionSphere

Word = Literal["safe", "tight", "colliding", "no room", "region"]
# Suggested radii are rounded down to whole micrometres.
_ROUNDING = 1e-6
# A radius [m] as small as this is looked for, where the question is whether there is room at all.
_SMALLEST = 0.001


@dataclass(frozen=True)
class Verdict:
    """What geometry says of a sphere.

    `word`: "safe": the tool is proved clear at every pose that can be drawn; "tight": it is not,
    though no pose is known to touch; "colliding": the radius is more than the distance of the
    limiting pair; "no room": nothing may be drawn here, whatever the radius; "region": free space
    for the planner, which itself keeps clear. `largest` [m]: the largest radius that is safe, 0
    for none. `limited_by`: the pair, or what else limits it.
    """

    word: Word
    largest: float
    limited_by: str

    def __str__(self) -> str:
        if self.word in ("no room", "region"):
            return f"{self.word}: {self.limited_by}"
        return f"{self.word}: up to {1e3 * self.largest:.1f} mm is safe ({self.limited_by})"

    @property
    def proved(self) -> bool:
        """Whether nothing that is drawn from the sphere is expected to touch."""
        return self.word in ("safe", "region")


def verdict_of(sphere: PrecisionSphere, found: Suggestion, margin: float) -> Verdict:
    """What geometry says of a sphere, by the largest radius that is safe there.

    Args:
        sphere: about one waypoint.
        found: the suggestion for that waypoint.
        margin: distance [m] that stays free.
    """
    room = found.clearance is not None and found.clearance > margin
    word: Word
    if not room:
        word = "no room"
    elif sphere.kind == "free_space":
        word = "region"
    elif sphere.radius <= found.radius + _ROUNDING:
        word = "safe"
    else:
        assert found.clearance is not None
        word = "tight" if sphere.radius <= found.clearance else "colliding"
    reason = found.limited_by if word != "region" else "the planner keeps clear in it"
    return Verdict(word, found.radius, reason)


def unproved(sphere: PrecisionSphere, verdict: Verdict) -> str:
    """A sphere that isn't proved clear in words: where, how large, and why."""
    return f"waypoint {sphere.waypoint}, {1e3 * sphere.radius:.1f} mm: {verdict}"


def unproved_spheres(annotation: Annotation, world: CollisionWorld, margin: float) -> list[str]:
    """Those spheres of an annotation, in words, whose radius no certificate backs.

    A radius that was suggested and not enlarged is backed by its own.

    Args:
        annotation: made for the world's demonstration.
        world: where the obstacles are.
        margin: distance [m] that stays free.
    """
    found = []
    for sphere in annotation.spheres:
        if not needs_verdict(sphere):
            continue
        config = SuggestConfig()
        config = dataclasses.replace(
            config,
            margin=max(margin, _ROUNDING),
            min_radius=min(_SMALLEST, sphere.radius),
            max_radius=max(config.max_radius, sphere.radius),
        )
        safe = suggest_radius(world, world.demonstration, sphere.waypoint, config)
        verdict = verdict_of(sphere, safe, config.margin)
        if not verdict.proved:
            found.append(unproved(sphere, verdict))
    return found


def needs_verdict(sphere: PrecisionSphere) -> bool:
    """Whether a sphere's own fields don't say that its radius is backed by a certificate."""
    return sphere.source == "human" or sphere.clearance is None or sphere.radius > sphere.clearance
