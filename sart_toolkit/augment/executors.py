"""Carries segments out on a robot: planned, proved clear, executed, checked, and reversed."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from sart_toolkit.augment.config import AugmentConfig
from sart_toolkit.augment.planner import SegmentPlanner, path_deviation
from sart_toolkit.backends.interface import Backend, Observation
from sart_toolkit.collision.certificate import Certificate, certify
from sart_toolkit.data.records import (
    CONTROL_HZ,
    CONTROL_PER_RECORD,
    Annotation,
    Demonstration,
    Episode,
    Provenance,
)
from sart_toolkit.errors import MotionRejected, Unreachable
from sart_toolkit.motion.controller import ToolController
from sart_toolkit.motion.path import PolylinePath
from sart_toolkit.motion.timing import Motion
from sart_toolkit.poses import Array, inverse
from sart_toolkit.record.recorder import StepRecorder
from sart_toolkit.scenes.spec import SceneSpec

KEPT = "kept"
# By no more than this [m] may any point of a body be moved that isn't carried.
_MOVED = 0.001


@dataclass(frozen=True)
class Attempt:
    """The outcome of one try: the episode, or the reason why it was rejected.

    `outcome` is the same for all tries that fail alike; `detail` tells this one's figures.
    """

    outcome: str
    episode: Episode | None
    detail: str = ""


class SegmentMaker:
    """Makes tries (sphere, k) of one demonstration and annotation on a backend."""

    def __init__(
        self,
        backend: Backend,
        demonstration: Demonstration,
        annotation: Annotation,
        config: AugmentConfig,
    ) -> None:
        """Make tries on `backend`, the robot in the demonstration's scene.

        Raises:
            Mismatch: the demonstration doesn't tell where the scene's bodies were.
        """
        self._backend = backend
        self._demonstration, self._annotation = demonstration, annotation
        self._config = config
        self._planner = SegmentPlanner(
            backend.robot, backend.scene, demonstration, annotation, config
        )

    def __call__(self, sphere: int, k: int) -> Attempt:
        """The k-th try from a sphere: sample, prove, move there, check, and reverse the record.

        The robot starts from the restored state of waypoint t*, at the pose commanded there. What
        isn't proved to keep the margin is not executed. Any contact of the robot, or of what it
        holds or has grasped there, with anything else at any physics step ends the execution; an
        object that slips in the grasp or is moved, or a measured motion that can't be proved clear,
        rejects the segment.

        Args:
            sphere: which sphere.
            k: which try; it alone decides the random numbers, with the seed and the sphere.

        Raises:
            MissingCapability: the backend can't restore states.
        """
        proposal, rng = self._planner.proposal(sphere, k)
        t_star = proposal.t_star
        try:
            motion, certificate = self._planner.plan(proposal, rng)
            recorder, joint_path = self._execute(motion, t_star)
            proof = self._proof(motion, certificate, joint_path, t_star)
        except Unreachable as error:
            return Attempt("out of reach", None, str(error))
        except MotionRejected as error:
            # What stands behind the colon differs each time.
            return Attempt(str(error).partition(":")[0], None, str(error))
        provenance = Provenance(
            demonstration_hash=self._annotation.demonstration_hash,
            sphere=sphere,
            k=k,
            t_star=t_star,
            T_world_sampled=proposal.T_world_sampled,
            seed=self._config.seed,
            strategy=str(self._config.strategy),
            law=self._config.sampling.law,
            certificate=proof,
        )
        steps = recorder.steps(slice(None, None, -1))
        return Attempt(KEPT, Episode(steps, provenance, joint_path))

    def _execute(self, motion: Motion, t_star: int) -> tuple[StepRecorder, Array]:
        """The record of a motion's execution, and the joints `(m, n)` as measured on the way."""
        backend, steps = self._backend, self._demonstration.steps
        gripper = float(steps.commanded_gripper[t_star])
        scene = self._planner.scene
        carried = scene.phases[t_star].carried
        controller = ToolController(scene.collision.kinematics)
        backend.restore(self._demonstration.states[t_star])
        controller.reset(
            steps.commanded_joint_positions[t_star], steps.commanded_Ts_world_tool[t_star]
        )
        cameras = () if self._config.camera is None else (self._config.camera,)
        recorder = StepRecorder(backend, cameras)
        start = recorded = backend.observe()
        measured = [start.q[None]]
        times = motion.times(CONTROL_HZ)
        for i, (time, q) in enumerate(zip(times, motion.joints(times), strict=True), 1):
            # As a policy will be at its own rate, held to what was measured a recorded step ago.
            controller.follow(q, motion.T_world_tool(time), recorded.T_world_tool)
            backend.command(q, gripper)
            backend.step()
            if backend.capabilities.has_contacts:
                check_untouched(backend, carried)
            if i % CONTROL_PER_RECORD:
                seen = backend.observe()
            else:
                seen = recorded = recorder.add(controller, gripper, 0.0)
            measured.append(seen.joint_path if len(seen.joint_path) else seen.q[None])
        check_undisturbed(backend.scene, carried, start, recorded, self._config.grasp_play)
        return recorder, np.concatenate(measured)

    def _proof(
        self, motion: Motion, certificate: Certificate, joint_path: Array, t_star: int
    ) -> dict[str, Any]:
        """What is proved about a segment: of the path commanded, and of the one measured.

        Raises:
            MotionRejected: the measured path can't be proved clear.
        """
        placed = self._planner.scene.placed(t_star)
        deviation = path_deviation(placed, motion, joint_path)
        measured = certify(placed, PolylinePath(joint_path))
        if measured.verdict != "free":
            raise MotionRejected(
                f"left its path {' / '.join(measured.pair)}: by {deviation * 1e3:.1f} mm, "
                f"{certificate.clearance * 1e3:.1f} mm were clear; allow more time"
            )
        return {
            "commanded": certificate.to_json(),
            "measured": measured.to_json(),
            "deviation": _micrometres_up(deviation),
            "duration": motion.duration,
        }


def check_untouched(backend: Backend, carried: frozenset[str]) -> None:
    """Return if nothing touched during the last step that should not.

    Raises:
        MotionRejected: the robot touched itself, or it or what it carries touched something else.
    """
    touching = [(contact.a, contact.b) for contact in backend.contacts()]
    bodies = {body.name for body in backend.scene.bodies}
    itself = [pair for pair in touching if bodies.isdisjoint(pair)]
    hits = sorted([*itself, *backend.scene.outer_contacts(touching, carried)])
    if hits:
        raise MotionRejected(f"contact {hits[0][0]} / {hits[0][1]}: stopped there")


def check_undisturbed(
    scene: SceneSpec,
    carried: frozenset[str],
    start: Observation,
    end: Observation,
    grasp_play: float,
) -> None:
    """Return if what is carried stayed in the grasp and all else where it was.

    Raises:
        MotionRejected: it didn't.
    """
    for body in scene.bodies:
        if body.mass is None or body.name not in start.Ts_world_body:
            continue
        Ts = [seen.Ts_world_body[body.name] for seen in (start, end)]
        most = _MOVED
        if body.name in carried:
            most = grasp_play
            Ts = [inverse(seen.T_world_tool) @ T for seen, T in zip((start, end), Ts, strict=True)]
        # The farthest that any point of the body has moved.
        corners = np.concatenate([shape.corners() for shape in body.shapes])
        moved = corners @ (Ts[1] - Ts[0])[:3, :3].T + (Ts[1] - Ts[0])[:3, 3]
        far = float(np.linalg.norm(moved, axis=1).max())
        if far > most:
            what = "slipped in the grasp" if body.name in carried else "was moved"
            raise MotionRejected(f"{body.name} {what}: by {far * 1e3:.1f} mm")


def _micrometres_up(length: float) -> float:
    return float(np.ceil(length * 1e6) / 1e6)
