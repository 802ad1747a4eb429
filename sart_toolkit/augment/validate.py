"""Checks a dataset again: content, certificates and reversals of every episode, from scratch."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from sart_toolkit.augment.config import AugmentConfig
from sart_toolkit.augment.planner import SegmentPlanner, path_deviation
from sart_toolkit.collision.certificate import Certificate, certify
from sart_toolkit.collision.model import PlacedModel
from sart_toolkit.data.records import (
    Annotation,
    Dataset,
    Demonstration,
    Episode,
    apply_action,
)
from sart_toolkit.data.sampling import SamplingConfig
from sart_toolkit.data.storage import (
    load_annotation,
    load_dataset_info,
    load_demonstration,
    load_episode,
)
from sart_toolkit.errors import BrokenFile, MotionRejected, SartError
from sart_toolkit.motion.path import PolylinePath
from sart_toolkit.motion.timing import Motion
from sart_toolkit.poses import Array
from sart_toolkit.robots.spec import RobotSpec
from sart_toolkit.scenes.spec import SceneSpec

# Clearances are stored in hundredths of a millimetre, rounded down, deviations in micrometres.
_LENGTH_TOLERANCE = 5e-6
_JOINT_TOLERANCE = 1e-6
_POSE_TOLERANCE = 1e-6


@dataclass(frozen=True)
class Validation:
    """What came of checking a dataset.

    `episodes`: how many were looked at; `problems`: what doesn't hold, by the episode's file (or
    `dataset.json`); `least_clearance` [m]: the smallest that the certificates of the commanded and
    of the measured paths prove, `largest_deviation` [m] of the measured paths from the commanded.
    """

    episodes: int
    problems: Mapping[str, str]
    least_clearance: float
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
    path backwards, and what it measured the measured path backwards; that every commanded pose
    followed by its action gives the next one, also across the join. For the dataset: that it holds
    the demonstration and the episodes that it lists.

    Args:
        path: directory from `sart augment`.
        robot: the demonstration's robot.
        scene: the demonstration's scene.
        progress: called with (episodes done, episodes in all).

    Raises:
        MissingFile: a file of the dataset isn't there.
        BrokenFile: generation was interrupted, or demonstration, annotation or `dataset.json`
            can't be read.
        Mismatch: the annotation belongs to another demonstration.
    """
    path = Path(path)
    info = load_dataset_info(path)
    demonstration = load_demonstration(path / "demo.h5")
    annotation = load_annotation(path / "annotation.json")
    annotation.check_matches(demonstration)
    try:
        names = [str(name) for name in info["episodes"]]
        config = AugmentConfig(
            **{**info["config"], "sampling": SamplingConfig(**info["config"]["sampling"])}
        )
        content_hash = info["content_hash"]
    except (KeyError, TypeError) as error:
        raise BrokenFile(
            f"{path / 'dataset.json'}: {error} is missing or wrong; generate again"
        ) from error
    check = _EpisodeCheck(robot, scene, demonstration, annotation, config)
    problems: dict[str, str] = {}
    episodes: list[Episode] = []
    for done, name in enumerate(names, 1):
        try:
            episodes.append(load_episode(path / "episodes" / name))
            check(episodes[-1])
        except SartError as error:
            problems[name] = str(error)
        if progress is not None:
            progress(done, len(names))
    dataset = Dataset(demonstration, annotation, tuple(episodes))
    if len(episodes) == len(names) and dataset.content_hash() != content_hash:
        problems["dataset.json"] = "content differs from its hash; generate again"
    return Validation(len(names), problems, check.least_clearance, check.largest_deviation)


class _EpisodeCheck:
    """Checks episodes of one dataset; raises where something doesn't hold."""

    def __init__(
        self,
        robot: RobotSpec,
        scene: SceneSpec,
        demonstration: Demonstration,
        annotation: Annotation,
        config: AugmentConfig,
    ) -> None:
        self._demonstration = demonstration
        self._hash = annotation.demonstration_hash
        self._config = config
        self._planner = SegmentPlanner(robot, scene, demonstration, annotation, config)
        self.least_clearance = np.inf
        self.largest_deviation = 0.0

    def __call__(self, episode: Episode) -> None:
        p = episode.provenance
        if p.demonstration_hash != self._hash:
            raise MotionRejected("provenance: it belongs to another demonstration")
        if (p.seed, p.strategy, p.law) != (
            self._config.seed, self._config.strategy, self._config.sampling.law
        ):  # fmt: skip
            raise MotionRejected("provenance: made with another seed, strategy or law")
        proposal, rng = self._planner.proposal(p.sphere, p.k)
        far = np.abs(proposal.T_world_sampled - p.T_world_sampled).max()
        if p.t_star != proposal.t_star or far > _POSE_TOLERANCE:
            raise MotionRejected("provenance: seed, sphere and k lead to another pose or waypoint")
        if not p.certificate:
            raise MotionRejected("certificate: there is none")
        motion, commanded = self._planner.plan(proposal, rng)
        placed = self._planner.scene.placed(p.t_star)
        measured = certify(placed, PolylinePath(episode.joint_path))
        deviation = path_deviation(placed, motion, episode.joint_path)
        self._compare(p.certificate, "commanded", commanded)
        self._compare(p.certificate, "measured", measured)
        if abs(p.certificate["deviation"] - deviation) > _LENGTH_TOLERANCE:
            raise MotionRejected(
                f"certificate: the measured path is {deviation * 1e3:.3f} mm off the commanded, "
                f"{p.certificate['deviation'] * 1e3:.3f} mm are stated"
            )
        self.largest_deviation = max(self.largest_deviation, deviation)
        _check_reversal(episode, motion, placed, self._demonstration.rates.record_hz)
        _check_actions(episode, self._demonstration)

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
        self.least_clearance = min(self.least_clearance, found.clearance)


def _check_reversal(episode: Episode, motion: Motion, placed: PlacedModel, record_hz: int) -> None:
    """Return if an episode commands a motion backwards, and measured its joint path backwards."""
    steps = episode.steps
    times = motion.times(record_hz)
    if len(times) != len(steps):
        raise MotionRejected(f"reversal: {len(steps)} steps, the motion has {len(times)}")
    outwards = steps.commanded_joint_positions[::-1]
    if np.abs(outwards - motion.joints(times)).max() > _JOINT_TOLERANCE:
        raise MotionRejected("reversal: the commanded joints aren't the planned path backwards")
    poses = steps.commanded_Ts_world_tool[::-1]
    planned = np.array([motion.T_world_tool(time) for time in times])
    if np.abs(poses - planned).max() > _POSE_TOLERANCE:
        raise MotionRejected("reversal: the commanded poses aren't the planned line backwards")
    if not _in_order(steps.joint_positions[::-1], episode.joint_path):
        raise MotionRejected("reversal: the measured joints aren't the measured path backwards")
    measured = np.array([placed.kinematics.fk(q) for q in steps.joint_positions])
    if np.abs(measured - steps.measured_Ts_world_tool).max() > 100 * _POSE_TOLERANCE:
        raise MotionRejected("reversal: measured tool poses and joints don't belong together")


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
