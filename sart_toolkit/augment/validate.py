"""Checks a dataset again: content, certificates and course of every episode, from scratch."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from sart_toolkit.augment.config import AugmentConfig
from sart_toolkit.augment.planner import SegmentPlanner, path_deviation, world_of
from sart_toolkit.collision.certificate import Certificate
from sart_toolkit.collision.phases import BODY_STILLNESS
from sart_toolkit.data.dataset import MANIFEST, Dataset, load_dataset
from sart_toolkit.data.manifest import EpisodeEntry
from sart_toolkit.data.records import (
    Demonstration,
    Episode,
    apply_action,
)
from sart_toolkit.errors import BrokenFile, MotionRejected, SartError
from sart_toolkit.motion.path import PolylinePath
from sart_toolkit.motion.timing import Motion
from sart_toolkit.poses import Array
from sart_toolkit.robots.model import RobotModel
from sart_toolkit.robots.spec import RobotSpec
from sart_toolkit.scenes.spec import SceneSpec

# Clearances are stored in hundredths of a millimetre, rounded down, deviations in micrometres.
_LENGTH_TOLERANCE = 5e-6
_JOINT_TOLERANCE = 1e-6
_POSE_TOLERANCE = 1e-6


@dataclass(frozen=True)
class Validation:
    """What came of checking a dataset.

    `episodes`: how many were checked; `problems`: what doesn't hold, by the episode's file;
    `least_commanded_clearance`, `least_measured_clearance` [m]: the smallest that the certificates
    of the commanded and of the measured paths prove; `largest_deviation` [m] of any point of the
    robot on a measured path from the commanded one.
    """

    episodes: int
    problems: Mapping[str, str]
    least_commanded_clearance: float
    least_measured_clearance: float
    largest_deviation: float


def validate_dataset(
    path: Path,
    robot: RobotSpec,
    scene: SceneSpec,
    progress: Callable[[int, int], None] | None = None,
) -> Validation:
    """Every episode of a dataset directory read, planned and proved again, and compared.

    For each episode: the file's content hash; that seed, sphere and k lead to its sampled pose; the
    certificates of the joint path commanded and of the one measured; that what it commands is that
    path backwards, and what it measured the measured path, backwards where it was reversed; that
    every commanded pose followed by its action gives the next one, also across the join. For the
    dataset: that it holds the demonstrations and the episodes that it lists. One episode is in
    memory at a time.

    Args:
        path: directory from `sart augment`.
        robot: the demonstration's robot.
        scene: the demonstration's scene.
        progress: called with (episodes done, episodes in all).

    Raises:
        MissingFile: a file of the dataset isn't there.
        BrokenFile: generation was interrupted, or a demonstration, an annotation, the manifest or
            `dataset.json` can't be read.
        Mismatch: an annotation or a demonstration isn't the one that the dataset was made from.
    """
    dataset = load_dataset(path)
    for source in dataset.sources:
        if source.annotation is not None:
            source.annotation.check_matches(source.demonstration)
    configs = generated_with(dataset)
    check = _EpisodeCheck(robot, scene, dataset, configs)
    problems: dict[str, str] = {}
    for i, entry in enumerate(dataset.index):
        try:
            check(entry, dataset.episode(i))
        except SartError as error:
            problems[entry.name] = str(error)
        if progress is not None:
            progress(i + 1, len(dataset))
    least = check.least_clearance
    return Validation(
        len(dataset), problems, least["commanded"], least["measured"], check.largest_deviation
    )


def generated_with(dataset: Dataset) -> list[AugmentConfig]:
    """What each source of a dataset was generated with.

    Raises:
        BrokenFile: the manifest doesn't say.
    """
    try:
        return [AugmentConfig.from_json(source.request["config"]) for source in dataset.sources]
    except (KeyError, TypeError) as error:
        raise BrokenFile(
            f"{dataset.path / MANIFEST}: {error} is missing or wrong; generate again"
        ) from error


class _EpisodeCheck:
    """Checks episodes of one dataset; raises where something doesn't hold."""

    def __init__(
        self,
        robot: RobotSpec,
        scene: SceneSpec,
        dataset: Dataset,
        configs: Sequence[AugmentConfig],
    ) -> None:
        self._sources = dataset.sources
        # What each source was generated with.
        self._configs = configs
        self._planners = [
            SegmentPlanner(
                world_of(source.demonstration, robot, scene, config),
                source.annotation,
                config,
                source.number,
            )
            for source, config in zip(dataset.sources, configs, strict=True)
        ]
        self.least_clearance = {"commanded": np.inf, "measured": np.inf}
        self.largest_deviation = 0.0

    def __call__(self, entry: EpisodeEntry, episode: Episode) -> None:
        p = episode.provenance
        source, config = self._sources[entry.source], self._configs[entry.source]
        if (p.source, p.sphere, p.k) != (source.number, entry.sphere, entry.k):
            raise MotionRejected("provenance: it is of another attempt than the index says")
        made_with = (
            config.seed,
            config.strategy,
            config.sampling.distribution,
            config.recording,
        )
        if (p.seed, p.strategy, p.distribution, p.recording) != made_with:
            raise MotionRejected(
                "provenance: made with another seed, strategy, distribution or recording"
            )
        planner = self._planners[entry.source]
        proposal, rng = planner.proposal(p.sphere, p.k)
        far = np.abs(proposal.T_world_sampled - p.T_world_sampled).max()
        if (p.t_star, p.merged) != (proposal.t_star, proposal.merged) or far > _POSE_TOLERANCE:
            raise MotionRejected("provenance: seed, sphere and k lead to another pose or waypoint")
        if not p.certificate:
            raise MotionRejected("certificate: there is none")
        declared = _stated_length(p.certificate, "tracking_error")
        stillness = _stated_length(p.certificate, "body_stillness")
        if stillness < BODY_STILLNESS:
            raise MotionRejected(
                f"certificate: proved for bodies that move by less than {BODY_STILLNESS * 1e3} mm"
            )
        motion, commanded = planner.plan(proposal, rng, declared, stillness)
        measured = planner.world.certify(
            p.t_star, PolylinePath(episode.joint_path), planner.measured_margin(stillness)
        )
        placed, approach = planner.world.placed(p.t_star), planner.approach(p.t_star)
        deviation = path_deviation(placed, approach, motion, episode.joint_path)
        self._compare(p.certificate, "commanded", commanded)
        self._compare(p.certificate, "measured", measured)
        stated = _stated_length(p.certificate, "deviation")
        if abs(stated - deviation) > _LENGTH_TOLERANCE:
            raise MotionRejected(
                f"certificate: the measured path is {deviation * 1e3:.3f} mm off the commanded, "
                f"{stated * 1e3:.3f} mm are stated"
            )
        if not deviation <= declared + _LENGTH_TOLERANCE:
            raise MotionRejected(
                f"certificate: the measured path is {deviation * 1e3:.3f} mm off the commanded, "
                f"more than the tracking error of {declared * 1e3:.3f} mm that was proved for"
            )
        self.largest_deviation = max(self.largest_deviation, deviation)
        demonstration = source.demonstration
        _check_course(episode, motion, planner.world.kinematics, demonstration.rates.record_hz)
        _check_actions(episode, demonstration)

    def _compare(self, stated: Mapping[str, Any], which: str, found: Certificate) -> None:
        claim = Certificate.from_json(stated[which])
        if claim.verdict != found.verdict or found.verdict != "free":
            raise MotionRejected(
                f"certificate: the {which} path is {found.verdict}, {claim.verdict} is stated"
            )
        # One that is more cautious than needed does no harm.
        if claim.clearance - found.clearance > _LENGTH_TOLERANCE or claim.margin != found.margin:
            raise MotionRejected(
                f"certificate: the {which} path is proved {found.clearance * 1e3:.3f} mm clear, "
                f"{claim.clearance * 1e3:.3f} mm are stated"
            )
        self.least_clearance[which] = min(self.least_clearance[which], found.clearance)


def _stated_length(proof: Mapping[str, Any], name: str) -> float:
    """A length [m] that a proof states."""
    value = proof.get(name)
    if not isinstance(value, int | float) or not 0 <= value < np.inf:
        raise MotionRejected(f"certificate: {name}: expected a length >= 0 m, got {value!r}")
    return float(value)


def _check_course(episode: Episode, motion: Motion, model: RobotModel, record_hz: int) -> None:
    """Return if an episode commands a motion backwards, and measured what its joint path has."""
    steps = episode.steps
    times = motion.times(record_hz)
    if len(times) != len(steps):
        raise MotionRejected(f"course: {len(steps)} steps, the motion has {len(times)}")
    outwards = steps.commanded_joint_positions[::-1]
    if np.abs(outwards - motion.joints(times)).max() > _JOINT_TOLERANCE:
        raise MotionRejected("course: the commanded joints aren't the planned path backwards")
    poses = steps.commanded_Ts_world_tool[::-1]
    planned = np.array([motion.T_world_tool(time) for time in times])
    if np.abs(poses - planned).max() > _POSE_TOLERANCE:
        raise MotionRejected("course: the commanded poses aren't the planned line backwards")
    if episode.provenance.recording == "reversed":
        if not _in_order(steps.joint_positions[::-1], episode.joint_path):
            raise MotionRejected("course: the measured joints aren't the measured path backwards")
    elif not _in_order(steps.joint_positions, episode.joint_path):
        raise MotionRejected("course: the measured joints aren't those of the measured path")
    measured = np.array([model.fk(q) for q in steps.joint_positions])
    if np.abs(measured - steps.measured_Ts_world_tool).max() > 100 * _POSE_TOLERANCE:
        raise MotionRejected("course: measured tool poses and joints don't belong together")


def _in_order(rows: Array, path: Array) -> bool:
    """Whether the rows `(k, n)` occur in a path `(m, n)`, one after the other."""
    at = 0
    for row in rows:
        equal = np.flatnonzero(np.abs(path[at:] - row).max(1) <= _JOINT_TOLERANCE)
        if not len(equal):
            return False
        at += int(equal[0])
    return True


def _check_actions(episode: Episode, demonstration: Demonstration) -> None:
    """Return if every commanded pose followed by its action gives the next, also at the join."""
    Ts, gripper = episode.commands(demonstration)
    actions = episode.actions(demonstration)
    for t in range(len(Ts) - 1):
        T, opening = apply_action(Ts[t], actions[t])
        if np.abs(T - Ts[t + 1]).max() > _POSE_TOLERANCE or opening != gripper[t + 1]:
            raise MotionRejected(f"actions: command {t} followed by its action isn't the next one")
