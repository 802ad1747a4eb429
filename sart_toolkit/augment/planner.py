"""Draws segments of a demonstration and proves them clear; moves nothing."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from sart_toolkit.augment import get_strategy
from sart_toolkit.augment.config import AugmentConfig
from sart_toolkit.augment.strategies import Proposal
from sart_toolkit.collision import make_world
from sart_toolkit.collision.certificate import Certificate
from sart_toolkit.collision.model import PlacedModel
from sart_toolkit.collision.phases import BODY_STILLNESS, OUT_AND_BACK_STILLNESS
from sart_toolkit.collision.world import CollisionWorld
from sart_toolkit.data.manifest import AttemptKey
from sart_toolkit.data.pace import Pace
from sart_toolkit.data.records import Annotation, Demonstration, PrecisionSphere
from sart_toolkit.errors import MotionRejected, Unreachable
from sart_toolkit.motion.controller import settling_targets
from sart_toolkit.motion.line import straight_line
from sart_toolkit.motion.path import PolylinePath, nearest_on_polyline
from sart_toolkit.motion.planning import plan_motion
from sart_toolkit.motion.timing import Motion
from sart_toolkit.poses import Array
from sart_toolkit.robots.spec import RobotSpec
from sart_toolkit.scenes.spec import SceneSpec

_PATH_SAMPLES = 1000
# [s], of segments at the demonstration's pace; the paper's are all as long as the longest.
_DURATIONS = 0.4, 2.0
# Sums of margins are to a nanometre what their parts say.
_DIGITS = 9


class SegmentPlanner:
    """Draws segments of one demonstration and annotation, and proves them clear; moves nothing.

    Attributes:
        world: the obstacles.
        demonstration_hash: the content hash of the demonstration.
    """

    def __init__(
        self,
        world: CollisionWorld,
        annotation: Annotation | None,
        config: AugmentConfig,
        source: int = 0,
    ) -> None:
        """Plan for a robot among the obstacles of a demonstration, the dataset's `source`-th."""
        self.world = world
        self.demonstration_hash = world.demonstration.content_hash()
        self._config, self._source = config, source
        self._pace = Pace(world.demonstration)
        self._spheres = get_strategy(config.strategy).spheres(world.demonstration, annotation)
        self._approaches: dict[int, Array] = {}
        # What is proved of them, by waypoint and margin: all segments from a waypoint share it.
        self._approach_proofs: dict[tuple[int, float], Certificate] = {}

    def proposal(self, sphere: int, k: int) -> tuple[Proposal, np.random.Generator]:
        """The k-th draw from a sphere, and the random numbers that follow."""
        key = AttemptKey(self._source, sphere, k)
        return draw_proposal(self.world.demonstration, self._spheres, key, self._config)

    @property
    def stillness(self) -> float:
        """How far [m] bodies may be from where the demonstration has them, unless more is needed.

        What rests on a table creeps, and a way out and back takes twice as long.
        """
        config = self._config
        back = config.recording == "return" or config.execution == "replay"
        return OUT_AND_BACK_STILLNESS if back else BODY_STILLNESS

    def measured_margin(self, stillness: float) -> float:
        """What a measured path has to keep free [m]: `margin`, and what bodies may have moved."""
        return round(self._config.margin + stillness, _DIGITS)

    def approach(self, t: int) -> Array:
        """The joint targets `(m, n)` [rad], one a physics step, before a segment from waypoint `t`.

        They lead from where the joints were measured, and as fast as they moved, to a rest at the
        pose that was commanded: what is sent lags behind the command.
        """
        if t not in self._approaches:
            steps = self.world.demonstration.steps
            self._approaches[t] = settling_targets(
                self.world.kinematics,
                steps.commanded_joint_positions[t],
                (steps.joint_positions[t], steps.joint_velocities[t]),
                self.world.demonstration.rates,
            )
        return self._approaches[t]

    def duration(self, proposal: Proposal) -> float:
        """How long [s] the segment to a drawn pose takes, if joints and strides allow it.

        At the demonstration's pace: a policy would learn to creep where segments are much slower
        than what they lead to. In whole recorded steps.
        """
        seconds = self._config.duration
        if seconds is None:
            sampled = proposal.T_world_sampled
            seconds = np.clip(self._pace.time_for(proposal.t_star, sampled), *_DURATIONS)
        hz = self.world.demonstration.rates.record_hz
        return float(np.ceil(round(seconds * hz, _DIGITS)) / hz)

    def plan(
        self,
        proposal: Proposal,
        rng: np.random.Generator,
        tracking_error: float,
        stillness: float | None = None,
    ) -> tuple[Motion, Certificate]:
        """The motion from waypoint t* to a drawn pose, and the proof that it keeps the margin.

        It is the straight line if that is clear; else, where the strategy plans, one round what is
        in the way. The proof is of the `approach` too. The margin proved is `measured_margin` and
        the tracking error beyond it.

        Args:
            proposal: what `proposal` drew.
            rng: the random numbers that follow it.
            tracking_error: how far [m] any point of the robot may be from its commanded path.
            stillness: how far [m] bodies may be from where the demonstration has them; the
                planner's if left out.

        Raises:
            Unreachable: no joint configuration reaches some pose.
            MotionRejected: the motion can't be proved clear, a joint forbids it, or something moves
                at t*.
        """
        config, t = self._config, proposal.t_star
        stillness = self.stillness if stillness is None else stillness
        margin = round(self.measured_margin(stillness) + tracking_error, _DIGITS)
        demonstration = self.world.demonstration
        steps, record_hz = demonstration.steps, demonstration.rates.record_hz
        q, T = steps.commanded_joint_positions[t], steps.commanded_Ts_world_tool[t]
        T_goal = proposal.T_world_sampled
        self.world.check_known(t)
        duration = self.duration(proposal)
        if (t, margin) not in self._approach_proofs:
            proof = self.world.certify(t, PolylinePath(self.approach(t)), margin)
            self._approach_proofs[t, margin] = proof
        approach = self._approach_proofs[t, margin]
        approach.check_free()
        try:
            motion = straight_line(
                self.world.kinematics, q, T, T_goal, duration, record_hz=record_hz
            )
            certificate = self.world.certify(t, motion.path, margin)
            certificate.check_free()
        except (Unreachable, MotionRejected):
            if not get_strategy(config.strategy).plans:
                raise
            motion, certificate = plan_motion(
                self.world.placed(t),
                q,
                T_goal,
                duration,
                margin,
                rng,
                record_hz=record_hz,
            )
        return motion, min(certificate, approach, key=lambda proof: proof.clearance)


def draw_proposal(
    demonstration: Demonstration,
    spheres: Sequence[PrecisionSphere],
    key: AttemptKey,
    config: AugmentConfig,
) -> tuple[Proposal, np.random.Generator]:
    """What is drawn for an attempt, and the random numbers that follow.

    Their seed is (seed, sphere, k, source), so that it is the same wherever it is drawn.

    Args:
        demonstration: the attempt's source.
        spheres: what the strategy draws from there.
        key: the attempt.
        config: how poses are drawn.
    """
    rng = np.random.default_rng([config.seed, key.sphere, key.k, key.source])
    strategy = get_strategy(config.strategy)
    return strategy.propose(demonstration, spheres, key.sphere, rng, config.sampling), rng


def world_of(
    demonstration: Demonstration, robot: RobotSpec, scene: SceneSpec, config: AugmentConfig
) -> CollisionWorld:
    """The obstacles that a configuration asks to prove segments clear of.

    Raises:
        Mismatch: the demonstration is of another robot, or doesn't tell where the scene's bodies
            were.
    """
    return make_world(
        config.obstacles, demonstration, robot, scene, config.slip_tolerance, config.cloud
    )


def path_deviation(
    placed: PlacedModel, approach: Array, motion: Motion, joint_path: Array
) -> float:
    """How far [m] any point of the robot was, at most, from the path that was commanded.

    Each measured configuration of `joint_path (m, n)` is compared with the nearest of the path,
    the `approach (k, n)` and then the motion's: sum_j R_j |dq_j|, R_j being the farthest that a
    point of the robot can be from joint j.
    """
    # In these units of length all joints count alike.
    reach = placed.bounds.reach.max(0, initial=0.0)
    along = motion.path.positions(np.linspace(0.0, 1.0, _PATH_SAMPLES))
    measured = joint_path * reach
    # Of each by itself: where they meet they may turn back.
    off = [
        np.abs(measured - nearest_on_polyline(measured, part * reach)).sum(1)
        for part in (approach, along)
    ]
    return float(np.minimum(*off).max())
