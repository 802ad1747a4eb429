"""Proofs that a joint path keeps robot and held objects clear, by bisection with motion bounds."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields
from typing import Any, Literal, Protocol

import numpy as np

from sart_toolkit.collision.model import Enclosures, Index, PlacedModel, cross, gap_text, norms
from sart_toolkit.errors import InvalidInput, MotionRejected
from sart_toolkit.poses import Array, check_positive

_FIRST_KNOTS = 3
_FAR = 0.005
_CHECKS = 20_000
# coal's distances are up to 2.2e-6 m too large, by its tolerance.
_ACCURACY = 5e-6


class JointPath(Protocol):
    """A path of joint configurations over a parameter s in [0, 1]."""

    def positions(self, s: Array) -> Array:
        """The configurations `(k, n)` [rad] at parameters `(k,)`."""

    def chord_deviation(self, start: Array, end: Array) -> Array:
        """For intervals `(k,)`: `(k, n)` [rad], no less than how far each joint is ever from the
        chord, the straight joint motion between the interval's ends.
        """


@dataclass(frozen=True)
class Certificate:
    """What is proved about the clearance of a joint path.

    `free`: everywhere on the path every pair of bodies is at least `clearance` [m] apart, which is
    at least `margin`. `collision`: at path parameter `at` the `pair` is `clearance` [m] apart, less
    than `margin`, negative where it overlaps. `undecided`: neither could be shown with the number
    of distances allowed; to be taken as a rejection. `pair` is the one that bounds the clearance
    (two empty names where there is nothing to hit), `checks` the number of distances computed.
    """

    verdict: Literal["free", "collision", "undecided"]
    clearance: float
    margin: float
    pair: tuple[str, str]
    at: float
    checks: int

    def check_free(self) -> None:
        """Return if the path is proved clear.

        Raises:
            MotionRejected: it isn't; the message names the pair, where, and by how much.
        """
        pair = " / ".join(self.pair)
        apart = gap_text(self.clearance, self.margin)
        if self.verdict == "collision" and self.at == 0.0:
            raise MotionRejected(f"start too close {pair}: {apart}; start elsewhere")
        if self.verdict == "collision":
            raise MotionRejected(
                f"path too close {pair}: {apart}, {self.at:.0%} along; use a smaller radius"
            )
        if self.verdict == "undecided":
            raise MotionRejected(
                f"undecided {pair}: after {self.checks} distances; use a smaller radius"
            )

    def to_json(self) -> dict[str, Any]:
        """The certificate as JSON values, its clearance rounded down to 0.01 mm.

        The last digits of a distance hang on what was computed before.
        """
        # What is rounded already stays as it is.
        clearance = float(np.floor(self.clearance * 1e5 + 1e-7) / 1e5)
        return asdict(self) | {"pair": list(self.pair), "clearance": clearance}

    @staticmethod
    def from_json(value: Mapping[str, Any]) -> Certificate:
        """The certificate from JSON values.

        Raises:
            InvalidInput: a field is missing or unknown.
        """
        try:
            return Certificate(**{**value, "pair": tuple(value["pair"])})
        except (KeyError, TypeError) as error:
            raise InvalidInput(f"certificate: a field is missing or unknown ({error})") from error


def certify(
    placed: PlacedModel, path: JointPath, margin: float = 0.0, max_checks: int = _CHECKS
) -> Certificate:
    """A proof that a joint path is clear of collisions, or where it isn't.

    An interval [a, b] of the path keeps a pair at least m apart if (d(a) + d(b) - mu) / 2 >= m,
    mu bounding how far any point of one body moves on [a, b] as seen from the other: from wherever
    the path is, one of its ends is at most mu / 2 away. mu is the sum of

    - the greatest path length of a point along the chord, (v(a) + v(b)) / 2 + A / 4, v being its
      speed at the ends and A = sum_jk |dq_j| |dq_k| R_max(j,k) no less than its acceleration over
      the chord's unit parameter;
    - twice what the path's deviation from its chord adds, sum_j R_j e_j;

    with R_j the farthest that a point of the body can be from joint j in any configuration, or 1
    for a joint that slides, which moves it by that and whose share in A is less. First
    d is bounded by spheres, boxes and the cloud's nearest points; coal computes it where that
    doesn't do, and only intervals and pairs still open are bisected.

    Args:
        placed: robot and scene.
        path: joint path.
        margin: clearance [m] asked for, >= 0.
        max_checks: distances that may be computed.

    Raises:
        InvalidInput: the margin is negative, or the path not finite.
    """
    if margin < 0 or not np.isfinite(margin):
        raise InvalidInput(f"margin: expected a finite number >= 0 m, got {margin}")
    check_positive("max_checks", max_checks)
    return _Search(placed, path, margin, max_checks).run()


@dataclass(frozen=True)
class _Knots:
    """What is known at some path parameters `s (k,)`, where the joints are at `q (k, n)`.

    `turns`, `moments (k, n, 3)`: the joints' angular velocities, and those of the point at the
    origin, as from `joint_twists`; `centres`, `axes`, `middles`, `beside`: spheres and boxes of the
    parts, as from `Bounds.placed`; `distances (k, p)`: the pairs' by coal, NaN where not computed
    yet.
    """

    s: Array
    q: Array
    turns: Array
    moments: Array
    centres: Array
    axes: Array
    middles: Array
    beside: Array
    distances: Array

    @property
    def enclosures(self) -> Enclosures:
        return self.centres, self.axes, self.middles, self.beside

    @staticmethod
    def at(placed: PlacedModel, path: JointPath, s: Array) -> _Knots:
        q = path.positions(s)
        if not np.isfinite(q).all():
            raise InvalidInput("joint path: has NaN or infinite entries; remove them")
        poses = np.array([placed.joint_poses(each) for each in q])
        turns, moments = placed.joint_twists(poses[:, 1:])
        unknown = np.full((len(s), len(placed.pairs)), np.nan)
        return _Knots(s, q, turns, moments, *placed.bounds.placed(poses), unknown)

    def and_then(self, more: _Knots) -> _Knots:
        return _Knots(*(
            np.concatenate([getattr(self, f.name), getattr(more, f.name)]) for f in fields(_Knots)
        ))  # fmt: skip


class _Search:
    """The bisection of one path: its knots, and the bound proved so far."""

    def __init__(
        self, placed: PlacedModel, path: JointPath, margin: float, max_checks: int
    ) -> None:
        self._placed, self._path = placed, path
        self._margin, self._max_checks = margin, max_checks
        self._knots = _Knots.at(placed, path, np.linspace(0.0, 1.0, _FIRST_KNOTS))
        self._checks = 0
        self._best, self._best_pair = np.inf, -1

    def run(self) -> Certificate:
        count, first = len(self._placed.pairs), _FIRST_KNOTS - 1
        ends: Index = np.stack([np.arange(first), np.arange(first) + 1])
        # What is still open: pairs, and the columns of `ends` that are their intervals' knots.
        interval: Index = np.repeat(np.arange(first), count)
        pair: Index = np.tile(np.arange(count), first)
        while len(pair):
            mu, rough = self._motion(ends, interval, pair)
            # Rough bounds only settle what is far, so that the clearance proved says something.
            # Written so that what is no number stays open.
            open_ = ~(rough >= max(self._margin, _FAR))
            self._note(np.where(open_, np.inf, rough), pair)
            interval, pair, mu = interval[open_], pair[open_], mu[open_]
            if not len(pair):
                break
            knots = ends.take(interval, 1)
            if self._checks + 2 * len(pair) > self._max_checks:
                return self._certificate("undecided", self._knots.s[knots[0, 0]], int(pair[0]))
            distances = self._exact(knots, pair)
            if distances.min() < self._margin:
                return self._first_hit()
            bound = (distances.sum(0) - mu) / 2 - _ACCURACY
            open_ = ~(bound >= self._margin)
            self._note(np.where(open_, np.inf, bound), pair)
            interval, pair = interval[open_], pair[open_]
            if len(pair):
                ends, interval, pair = self._bisect(ends, interval, pair)
        return self._certificate("free", 0.0, self._best_pair)

    def _note(self, bound: Array, pair: Index) -> None:
        """Keep the least of the bounds `(k,)` proved for pairs."""
        least = int(np.argmin(bound))
        if bound[least] < self._best:
            self._best, self._best_pair = float(bound[least]), int(pair[least])

    def _twists(self, chord: Array, ends: Index) -> tuple[Array, Array]:
        """The joints' angular velocities and velocities at the origin, `(2, k, n + 1, 3)` each.

        They are those along chords `(k, n)`, per unit of a chord's parameter, at its ends `(2, k)`.
        """
        shape = *ends.shape, 1 + chord.shape[1], 3
        spin, drift = np.zeros(shape), np.zeros(shape)
        chord = chord[:, :, None]
        np.cumsum(self._knots.turns[ends] * chord, 2, out=spin[:, :, 1:])
        np.cumsum(self._knots.moments[ends] * chord, 2, out=drift[:, :, 1:])
        return spin, drift

    def _motion(self, ends: Index, interval: Index, pair: Index) -> tuple[Array, Array]:
        """For pairs on intervals: mu `(k,)` [m], and what rough distances prove `(k,)` [m].

        `ends (2, m)` are the intervals' knots; each pair has one of them by `interval (k,)`.
        """
        bounds, at = self._placed.bounds, self._knots
        chord = at.q[ends[1]] - at.q[ends[0]]
        spin, drift = self._twists(chord, ends)
        # Rows of arrays laid flat are taken several times as fast as by several indices.
        base = bounds.joint_b.take(pair)
        joint_a, joint_b = (
            interval * spin.shape[2] + joint for joint in (bounds.joint_a.take(pair), base)
        )
        turn, drifted = (
            each.take(joint_a, 1) - each.take(joint_b, 1)
            for each in (spin.reshape(2, -1, 3), drift.reshape(2, -1, 3))
        )
        knots = ends.take(interval, 1)
        first = knots * at.centres.shape[1] + bounds.first.take(pair)
        centres = at.centres.reshape(-1, 3).take(first, 0)
        move = cross(turn, centres) + drifted
        mu = 0.5 * (norms(move) + norms(turn) * bounds.radii.take(pair)).sum(0)
        deviation = self._path.chord_deviation(at.s[ends[0]], at.s[ends[1]])
        excess = _excess(chord, deviation)
        chain = excess.reshape(-1, chord.shape[1]).take(interval * excess.shape[1] + base, 0)
        mu += np.einsum("ij,ij->i", bounds.reach.take(pair, 0), chain)
        apart = bounds.rough_distances(at.enclosures, knots, pair)
        return mu, (apart.sum(0) - mu) / 2

    def _exact(self, knots: Index, pair: Index) -> Array:
        """Distances `(2, k)` [m] of pairs `(k,)` at knots `(2, k)`, each computed once."""
        known = self._knots.distances
        asked = np.zeros(known.shape, bool)
        asked[knots, pair] = True
        asked &= np.isnan(known)
        for knot in np.flatnonzero(asked.any(1)):
            pairs = np.flatnonzero(asked[knot])
            known[knot, pairs] = self._placed.pair_distances(self._knots.q[knot], pairs.tolist())
            self._checks += len(pairs)
        return np.asarray(known[knots, pair])

    def _bisect(self, ends: Index, interval: Index, pair: Index) -> tuple[Index, Index, Index]:
        """The halves of the intervals that are still open, and what is open in them."""
        kept = np.flatnonzero(np.bincount(interval, minlength=ends.shape[1]))
        ends = ends[:, kept]
        interval = np.searchsorted(kept, interval)
        middles: Index = len(self._knots.s) + np.arange(len(kept))
        at = self._knots.s[ends].sum(0) / 2
        self._knots = self._knots.and_then(_Knots.at(self._placed, self._path, at))
        halves = np.concatenate(
            [np.stack([ends[0], middles]), np.stack([middles, ends[1]])], axis=1
        )
        return halves, np.concatenate([interval, interval + len(kept)]), np.tile(pair, 2)

    def _first_hit(self) -> Certificate:
        """The collision found nearest to the path's start."""
        known = self._knots.distances
        hits = np.flatnonzero((known < self._margin).any(1))
        knot = hits[np.argmin(self._knots.s[hits])]
        k = int(np.nanargmin(known[knot]))
        return self._certificate("collision", self._knots.s[knot], k, known[knot, k])

    def _certificate(
        self,
        verdict: Literal["free", "collision", "undecided"],
        at: float,
        pair: int,
        clearance: float | None = None,
    ) -> Certificate:
        if clearance is None:
            clearance = self._best
        names = self._placed.names(pair) if pair >= 0 else ("", "")
        return Certificate(verdict, float(clearance), self._margin, names, float(at), self._checks)


def _excess(chord: Array, deviation: Array) -> Array:
    """What curvature adds to mu, as factors of R_j: `(k, n + 1, n)` for both `(k, n)`.

    mu grows by sum_j R_j (S_j^2 - S_(j-1)^2) / 4 + 2 R_j e_j, the first of which is A / 4, S_j
    being the sum of |dq_m| of the joints m of the chain up to j. Row b is for a chain from joint b.
    """
    k, n = chord.shape
    sums = np.zeros((k, n + 1))
    np.cumsum(np.abs(chord), 1, out=sums[:, 1:])
    squares = np.maximum(sums[:, None, :] - sums[:, :, None], 0.0) ** 2
    return np.asarray(0.25 * np.diff(squares) + 2 * deviation[:, None])
