"""What a generation would attempt, drawn, planned and proved without executing anything."""

from __future__ import annotations

import collections
import dataclasses
import functools
import itertools
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from sart_toolkit.augment.allocation import Allocation
from sart_toolkit.augment.config import AugmentConfig
from sart_toolkit.augment.executors import rejected_outcome
from sart_toolkit.augment.planner import SegmentPlanner, world_of
from sart_toolkit.data.manifest import AttemptKey, AttemptTally
from sart_toolkit.data.storage import OutputLock, check_writable, write_json_lines
from sart_toolkit.data.writer import Sources, check_sources
from sart_toolkit.errors import MotionRejected, Unreachable
from sart_toolkit.robots.spec import RobotSpec
from sart_toolkit.scenes.spec import SceneSpec
from sart_toolkit.workers import Workers, worker_map

PROVED = "proved"
_MOST_AT_ONCE, _FEWEST_BATCHES = 16, 32


@dataclasses.dataclass(frozen=True)
class Preview:
    """What came of planning a generation.

    `wanted`, `proved`, `attempted`: segments; `rejections`: attempts that were not proved, by
    outcome; `by_sphere`: the same for each sphere.
    """

    wanted: int
    proved: int
    attempted: int
    rejections: Mapping[str, int]
    by_sphere: tuple[Mapping[str, Any], ...]


class _Planned(NamedTuple):
    """An attempt's row in the file, and how it ended."""

    key: AttemptKey
    outcome: str
    row: Mapping[str, Any]


class _Planner:
    """Plans attempts of one generation."""

    def __init__(
        self,
        sources: Sources,
        robot: RobotSpec,
        scene: SceneSpec,
        config: AugmentConfig,
        tracking_error: float,
    ) -> None:
        self._sources, self._robot, self._scene = sources, robot, scene
        self._config, self._tracking_error = config, tracking_error
        self._planners: dict[int, SegmentPlanner] = {}

    def __call__(self, keys: Sequence[AttemptKey]) -> list[_Planned]:
        return [self._planned(key) for key in keys]

    def _planned(self, key: AttemptKey) -> _Planned:
        planner = self._planner(key.source)
        proposal, rng = planner.proposal(key.sphere, key.k)
        found: dict[str, Any] = {
            **key._asdict(),
            "t_star": proposal.t_star,
            "T_world_sampled": proposal.T_world_sampled.tolist(),
        }
        try:
            motion, certificate = planner.plan(proposal, rng, self._tracking_error)
        except (Unreachable, MotionRejected) as error:
            outcome = rejected_outcome(error)
            return _Planned(key, outcome, {**found, "outcome": outcome, "detail": str(error)})
        found |= {
            "outcome": PROVED,
            "duration": motion.duration,
            "certificate": certificate.to_json(),
        }
        return _Planned(key, PROVED, found)

    def _planner(self, source: int) -> SegmentPlanner:
        if source not in self._planners:
            demonstration, annotation = self._sources[source]
            world = world_of(demonstration, self._robot, self._scene, self._config)
            self._planners[source] = SegmentPlanner(world, annotation, self._config, source)
        return self._planners[source]

    def close(self) -> None:
        """Nothing is held."""


def _batches(keys: Sequence[AttemptKey]) -> list[Sequence[AttemptKey]]:
    """Some attempts at once, so that processes don't wait for each other at every one."""
    size = min(_MOST_AT_ONCE, max(1, len(keys) // _FEWEST_BATCHES))
    return [keys[i : i + size] for i in range(0, len(keys), size)]


def preview_sources(
    sources: Sources,
    robot: RobotSpec,
    scene: SceneSpec,
    tracking_error: float,
    out: Path,
    config: AugmentConfig | None = None,
    workers: int | Workers = 1,
    overwrite: bool = False,
    progress: Callable[[int, int, int], None] | None = None,
) -> Preview:
    """What `augment_sources` with the same arguments would attempt, written to a file of lines.

    Segments are drawn, planned and proved as there; none is executed, and no backend is made. What
    is proved here may still be rejected where it is executed: by a contact, or because the robot
    leaves its path by more than `tracking_error`. An attempt more is then made in its place.

    The first line says what was asked for. Each further one is of an attempt: `source`, `sphere`,
    `k`, `t_star`, `T_world_sampled (4, 4)`, `outcome`, and of one that is proved its `duration` [s]
    and the `certificate` of the commanded path, of another the `detail`.

    Args:
        sources: demonstrations, each with its precision spheres, `None` where the strategy needs
            none.
        robot: the demonstrations' robot.
        scene: the demonstrations' scene.
        tracking_error: how far [m] any point of the robot may be from its commanded path, as the
            backend that is to execute the segments declares it.
        out: file to write.
        config: what to plan; "auto" for `execution` is taken as `restore`.
        workers: how many processes, or `Workers` elsewhere.
        overwrite: replace what is at `out`.
        progress: called with (proved, wanted, rejected) after each attempt.

    Raises:
        Mismatch: an annotation belongs to another demonstration, or the demonstrations to different
            tasks or robots.
        OutputExists: `out` is there and `overwrite` is false.
        CannotWrite: the disk refuses, or another process is at work on `out`.
        InvalidInput: `workers` is not positive, there is no demonstration, or not fewer than
            trajectories wanted, or no annotation where one is needed.
    """
    config = config or AugmentConfig()
    check_sources(sources)
    allocation = Allocation(sources, config)
    make = functools.partial(_Planner, sources, robot, scene, config, tracking_error)
    tally = AttemptTally()
    rejected: dict[tuple[int, int], collections.Counter[str]]
    rejected = collections.defaultdict(collections.Counter)

    def rows() -> Iterator[Mapping[str, Any]]:
        yield {
            "sources": [
                {"demonstration": d.content_hash(), "annotation": a.content_hash() if a else None}
                for d, a in sources
            ],
            "config": config.to_json(),
            "tracking_error": tracking_error,
        }
        made = n_rejected = 0
        with worker_map(make, workers) as run:
            while keys := allocation.missing(tally):
                for key, outcome, row in itertools.chain.from_iterable(run(_batches(keys))):
                    made += 1
                    tally.add(key, outcome == PROVED)
                    if outcome != PROVED:
                        n_rejected += 1
                        rejected[key[:2]][outcome] += 1
                    if progress is not None:
                        progress(made - n_rejected, allocation.wanted, n_rejected)
                    yield row

    with OutputLock(out, nested=True):
        check_writable(out, overwrite)
        write_json_lines(out, rows())
    counts = [tally.count(share.source, share.sphere) for share in allocation.shares]
    by_sphere = tuple(
        {
            "source": share.source,
            "waypoint": share.waypoint,
            "wanted": share.wanted,
            "proved": proved,
            "attempted": attempted,
            "rejections": dict(sorted(rejected[share[:2]].items())),
        }
        for share, (proved, attempted) in zip(allocation.shares, counts, strict=True)
    )
    rejections = sum(rejected.values(), collections.Counter())
    return Preview(
        allocation.wanted,
        sum(proved for proved, _ in counts),
        sum(attempted for _, attempted in counts),
        dict(sorted(rejections.items())),
        by_sphere,
    )
