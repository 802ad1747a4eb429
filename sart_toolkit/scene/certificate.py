"""Proofs that a joint path keeps robot and held objects clear, by bisection with motion bounds."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any, Literal, Protocol

import numpy as np

from sart_toolkit.errors import InvalidInput, MotionRejected
from sart_toolkit.poses import Array, check_positive
from sart_toolkit.scene.collision import Index, PlacedModel

_FIRST_KNOTS = 4
_FAR = 0.01
_CHECKS = 20_000
# coal's distances are up to 2.2e-6 m too large, by its tolerance.
_ACCURACY = 5e-6
_YZX, _ZXY = [1, 2, 0], [2, 0, 1]


class JointPath(Protocol):
    """A path of joint configurations over a parameter s in [0, 1]."""

    def positions(self, s: Array) -> Array:
        """The configurations `(k, n)` [rad] at parameters `(k,)`."""

    def bulge(self, start: Array, end: Array) -> Array:
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
        if self.clearance < 0:
            apart = f"they overlap by {-self.clearance * 1e3:.1f} mm"
        else:
            apart = f"{self.clearance * 1e3:.1f} mm apart, {self.margin * 1e3:.1f} mm are asked for"
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
        """The certificate as JSON values, its clearance in whole micrometres, rounded down."""
        clearance = float(np.floor(self.clearance * 1e6) / 1e6)
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
    - twice what the path's bulge beyond its chord adds, sum_j R_j e_j;

    with R_j the farthest that a point of the body can be from joint j in any configuration. First
    d is bounded by spheres and boxes; coal computes it where that doesn't do, and only intervals
    and pairs still open are bisected.

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


class _Search:
    """The bisection of one path: its knots, the distances known there, the bound proved so far."""

    def __init__(
        self, placed: PlacedModel, path: JointPath, margin: float, max_checks: int
    ) -> None:
        self._placed, self._path = placed, path
        self._margin, self._max_checks = margin, max_checks
        self._bounds = placed.bounds
        self._s = np.zeros(0)
        n = len(placed.kinematics.spec.arm_joints)
        self._q = np.zeros((0, n))
        # Poses of the world and all joints, the joints' axes and moments of these, at each knot.
        self._R, self._p = np.zeros((0, n + 1, 3, 3)), np.zeros((0, n + 1, 3))
        self._moments = np.zeros((0, n, 3))
        self._distances = np.zeros((0, len(placed.pairs)))
        self._checks = 0
        self._best, self._best_pair = np.inf, -1

    def run(self) -> Certificate:
        knots = self._add_knots(np.linspace(0.0, 1.0, _FIRST_KNOTS))
        lo, hi, pair = self._near(knots)
        while len(pair):
            mu, rough = self._motion(lo, hi, pair)
            # Rough bounds only settle what is far, so that the clearance proved says something.
            open_ = rough < max(self._margin, _FAR)
            self._note(np.where(open_, np.inf, rough), pair)
            lo, hi, pair, mu = lo[open_], hi[open_], pair[open_], mu[open_]
            if not len(pair):
                break
            if self._checks + 2 * len(pair) > self._max_checks:
                return self._certificate("undecided", self._s[lo[0]], int(pair[0]))
            d_lo, d_hi = self._exact(lo, pair), self._exact(hi, pair)
            if min(d_lo.min(), d_hi.min()) < self._margin:
                return self._first_hit()
            bound = (d_lo + d_hi - mu) / 2 - _ACCURACY
            open_ = bound < self._margin
            self._note(np.where(open_, np.inf, bound), pair)
            lo, hi, pair = lo[open_], hi[open_], pair[open_]
            if len(pair):
                lo, hi, pair = self._bisect(lo, hi, pair)
        return self._certificate("free", 0.0, self._best_pair)

    def _add_knots(self, s: Array) -> Index:
        q = self._path.positions(s)
        if not np.isfinite(q).all():
            raise InvalidInput("joint path: has NaN or infinite entries; remove them")
        poses = np.array([self._placed.joint_poses(each) for each in q])
        R, p = poses[:, :, :3, :3], poses[:, :, :3, 3]
        # A joint's axis is its frame's z; the velocity it gives to the point at the origin is
        # p x z.
        moments = _cross(p[:, 1:], R[:, 1:, :, 2])
        first = len(self._s)
        self._s, self._q = np.concatenate([self._s, s]), np.concatenate([self._q, q])
        self._R, self._p = np.concatenate([self._R, R]), np.concatenate([self._p, p])
        self._moments = np.concatenate([self._moments, moments])
        unknown = np.full((len(s), self._distances.shape[1]), np.nan)
        self._distances = np.concatenate([self._distances, unknown])
        return np.arange(first, len(self._s))

    def _note(self, bound: Array, pair: Index) -> None:
        """Keep the least of the bounds `(k,)` proved for pairs."""
        least = int(np.argmin(bound))
        if bound[least] < self._best:
            self._best, self._best_pair = float(bound[least]), int(pair[least])

    def _twists(self, chord: Array, knots: Index) -> tuple[Array, Array]:
        """The joints' angular velocities and velocities at the origin, `(2, k, n + 1, 3)` each.

        They are those along chords `(k, n)`, per unit of a chord's parameter, at knots `(2, k)`.
        """
        shape = *knots.shape, 1 + chord.shape[1], 3
        spin, drift = np.zeros(shape), np.zeros(shape)
        chord = chord[:, :, None]
        np.cumsum(self._R[knots, 1:, :, 2] * chord, 2, out=spin[:, :, 1:])
        np.cumsum(self._moments[knots] * chord, 2, out=drift[:, :, 1:])
        return spin, drift

    def _near(self, knots: Index) -> tuple[Index, Index, Index]:
        """The intervals between knots and the pairs that spheres and boxes don't keep apart."""
        bounds, lo, hi = self._bounds, knots[:-1], knots[1:]
        if not len(bounds.members):
            return lo[:0], lo[:0], lo[:0]
        ja, jb = bounds.joint_a, bounds.joint_b
        centre, apart = bounds.rough_distances(self._R[knots], self._p[knots])
        chord = self._q[hi] - self._q[lo]
        spin, drift = self._twists(chord, np.stack([lo, hi]))
        turn = spin[:, :, ja] - spin[:, :, jb]
        move = _cross(turn, np.stack([centre[:-1], centre[1:]]))
        move += drift[:, :, ja] - drift[:, :, jb]
        fast = _norm(move) + _norm(turn) * bounds.radii
        speed = 0.5 * np.maximum.reduceat(fast, bounds.starts, axis=2).sum(0)
        bulge = self._path.bulge(self._s[lo], self._s[hi])
        mu = speed + _excess(chord[:, None], bulge[:, None], bounds.reach)
        bound = (apart[:-1] + apart[1:] - mu) / 2
        open_ = bound < max(self._margin, _FAR)
        self._note(np.where(open_, np.inf, bound).min(0), np.array([m[0] for m in bounds.members]))
        intervals, groups = np.nonzero(open_)
        pairs = [bounds.members[group] for group in groups]
        counts = [len(each) for each in pairs]
        pair = np.concatenate([np.zeros(0, np.intp), *pairs])
        return np.repeat(lo[intervals], counts), np.repeat(hi[intervals], counts), pair

    def _motion(self, lo: Index, hi: Index, pair: Index) -> tuple[Array, Array]:
        """For pairs on intervals: mu `(k,)` [m], and what spheres and boxes prove `(k,)` [m]."""
        bounds = self._bounds
        starts, ends, interval = _intervals(lo, hi)
        chord = self._q[ends] - self._q[starts]
        ja, jb = bounds.pair_a[pair], bounds.pair_b[pair]
        spin, drift = self._twists(chord, np.stack([starts, ends]))
        of = np.stack([lo, hi])
        centre = np.einsum("ekij,kj->eki", self._R[of, ja], bounds.pair_centres[pair])
        centre += self._p[of, ja]
        turn = spin[:, interval, ja] - spin[:, interval, jb]
        move = _cross(turn, centre) + drift[:, interval, ja] - drift[:, interval, jb]
        mu = 0.5 * (_norm(move) + _norm(turn) * bounds.pair_radii[pair]).sum(0)
        bulge = self._path.bulge(self._s[starts], self._s[ends])
        mu += _excess(chord[interval], bulge[interval], bounds.pair_reach[pair])
        apart = bounds.rough_pair_distances(centre, self._R[of, jb], self._p[of, jb], pair)
        return mu, (apart.sum(0) - mu) / 2

    def _exact(self, knots: Index, pair: Index) -> Array:
        """Distances [m] of pairs at knots, each computed once."""
        asked = np.zeros(self._distances.shape, bool)
        asked[knots, pair] = True
        asked &= np.isnan(self._distances)
        for knot in np.flatnonzero(asked.any(1)):
            pairs = np.flatnonzero(asked[knot])
            self._distances[knot, pairs] = self._placed.pair_distances(
                self._q[knot], pairs.tolist()
            )
            self._checks += len(pairs)
        return np.asarray(self._distances[knots, pair])

    def _bisect(self, lo: Index, hi: Index, pair: Index) -> tuple[Index, Index, Index]:
        starts, ends, interval = _intervals(lo, hi)
        mid = self._add_knots((self._s[starts] + self._s[ends]) / 2)[interval]
        return np.concatenate([lo, mid]), np.concatenate([mid, hi]), np.concatenate([pair, pair])

    def _first_hit(self) -> Certificate:
        """The collision found nearest to the path's start."""
        hits = (self._distances < self._margin).any(1)
        knot = min(np.flatnonzero(hits), key=lambda each: self._s[each])
        k = int(np.nanargmin(self._distances[knot]))
        return self._certificate("collision", self._s[knot], k, self._distances[knot, k])

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


def _intervals(lo: Index, hi: Index) -> tuple[Index, Index, Index]:
    """The different intervals: their first and last knots, and which one each is."""
    count = int(hi.max()) + 1
    keys, interval = np.unique(lo * count + hi, return_inverse=True)
    return keys // count, keys % count, interval


def _excess(chord: Array, bulge: Array, reach: Array) -> Array:
    """What curvature adds to mu [m]: A / 4 + 2 sum_j R_j e_j, over the last axis of each.

    A = sum_m R_m (S_m^2 - S_(m-1)^2), S_m being the sum of |dq_j| up to joint m of the chain.
    """
    sums = np.cumsum(np.where(reach > 0, np.abs(chord), 0.0), -1)
    squares = sums**2
    squares[..., 1:] -= squares[..., :-1].copy()
    return np.asarray((reach * (0.25 * squares + 2 * bulge)).sum(-1))


def _cross(a: Array, b: Array) -> Array:
    """The cross product over the last axis; NumPy's own takes five times as long here."""
    return np.asarray(a[..., _YZX] * b[..., _ZXY] - a[..., _ZXY] * b[..., _YZX])


def _norm(vectors: Array) -> Array:
    return np.sqrt(np.einsum("...i,...i->...", vectors, vectors))
