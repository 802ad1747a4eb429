"""Executes segments on a robot: planned, proved clear, executed, checked, and reversed."""

from __future__ import annotations

import abc
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from sart_toolkit.augment.config import AugmentConfig
from sart_toolkit.augment.planner import SegmentPlanner, path_deviation, world_of
from sart_toolkit.backends.interface import (
    Backend,
    Contact,
    Observation,
    SavesStates,
    SensesContacts,
    SensesForce,
    require,
)
from sart_toolkit.collision.certificate import Certificate
from sart_toolkit.data.manifest import KEPT, AttemptKey
from sart_toolkit.data.records import Annotation, Demonstration, Episode, Provenance
from sart_toolkit.errors import Mismatch, MotionRejected, Unreachable
from sart_toolkit.motion.controller import ToolController
from sart_toolkit.motion.path import PolylinePath
from sart_toolkit.motion.timing import Motion
from sart_toolkit.poses import Array, inverse
from sart_toolkit.record.recorder import StepRecorder
from sart_toolkit.registry import expect_class, resolve
from sart_toolkit.scenes.spec import SceneSpec

# By no more than this [m] may any point of a body be moved that isn't grasped.
_MOVED = 0.001
_FROM_STATES = "segments start from the demonstration's saved states"


@dataclass(frozen=True)
class Attempt:
    """The outcome of an attempt: the episode, or the reason why it was rejected.

    `outcome` is the same for all attempts that fail alike; `detail` gives this one's figures.
    `seconds`: for how long [s] the robot moved, on its own clock; 0 for what was never executed,
    `None` where the executor doesn't tell.
    """

    key: AttemptKey
    outcome: str
    episode: Episode | None
    detail: str = ""
    seconds: float | None = None


class SegmentExecutor(abc.ABC):
    """Makes attempts at segments of demonstrations on a backend.

    Attributes:
        parallel: whether an attempt depends on its key alone, so that several processes can share
            the attempts.
    """

    parallel: bool

    def __init__(
        self,
        backend: Backend,
        sources: Sequence[tuple[Demonstration, Annotation]],
        config: AugmentConfig,
    ) -> None:
        """Make attempts on `backend`, the robot in the demonstrations' scene."""
        self._backend, self._sources, self._config = backend, sources, config
        self._planners: dict[int, SegmentPlanner] = {}
        # Control periods that the attempt at hand has executed.
        self._periods = 0

    @classmethod
    def check(
        cls, backend: Backend, demonstrations: Sequence[Demonstration], config: AugmentConfig
    ) -> None:
        """Return if attempts at segments of the demonstrations can be made on `backend`.

        Raises:
            UnknownName: the backend has no such camera.
            MissingCapability: images are wanted and the backend takes none.
            Mismatch: a demonstration was recorded at other rates.
        """
        for demonstration in demonstrations:
            backend.check_cameras(recorded_cameras(demonstration, config))
            if backend.rates != demonstration.rates:
                raise Mismatch(
                    f"rates: the demonstration was recorded with {demonstration.rates}, the "
                    f"backend has {backend.rates}; make it with the demonstration's"
                )

    @abc.abstractmethod
    def attempts(self, keys: Iterable[AttemptKey]) -> Iterator[Attempt]:
        """The attempts with the given keys, each once, in an order of the executor's choice.

        What isn't proved to keep the margin is not executed. Any contact of the robot, or of what
        it holds or has grasped there, with anything else at any physics step ends the execution; an
        object that slips in the grasp or is moved, or a measured motion that can't be proved clear,
        rejects the segment.
        """

    def planner(self, source: int) -> SegmentPlanner:
        """What plans the segments of a source.

        Raises:
            Mismatch: the demonstration is of another robot, or doesn't tell where the scene's
                bodies were.
        """
        if source not in self._planners:
            demonstration, annotation = self._sources[source]
            world = world_of(demonstration, self._backend.robot, self._backend.scene, self._config)
            self._planners[source] = SegmentPlanner(world, annotation, self._config, source)
        return self._planners[source]


class RestoreExecutor(SegmentExecutor):
    """Starts every attempt from the restored state of waypoint t*, at the pose commanded there."""

    parallel = True

    @classmethod
    def check(
        cls, backend: Backend, demonstrations: Sequence[Demonstration], config: AugmentConfig
    ) -> None:
        """Return if attempts at segments of the demonstrations can be made on `backend`.

        Raises:
            UnknownName: the backend has no such camera.
            MissingCapability: the backend can't restore states, or images are wanted and it
                takes none.
            Mismatch: a demonstration holds no saved states, or those of another backend, or was
                recorded at other rates.
        """
        require(backend, SavesStates, _FROM_STATES)
        for demonstration in demonstrations:
            if demonstration.states and backend.name != demonstration.backend:
                raise Mismatch(
                    f"backend {backend.name!r}: can't restore the states that backend "
                    f"{demonstration.backend!r} has saved with the demonstration; augment on "
                    f"{demonstration.backend!r}, or record a demonstration on {backend.name!r}"
                )
        super().check(backend, demonstrations, config)
        if not all(demonstration.states for demonstration in demonstrations):
            raise Mismatch(
                "the demonstration holds no saved states; record it on a backend that can restore"
            )

    def attempts(self, keys: Iterable[AttemptKey]) -> Iterator[Attempt]:
        """The attempts in the order of their keys."""
        return map(self.attempt, keys)

    def attempt(self, key: AttemptKey) -> Attempt:
        """One attempt: sample, prove, move there, check, and reverse the record.

        Raises:
            MissingCapability: the backend can't restore states.
        """
        planner = self.planner(key.source)
        demonstration = self._sources[key.source][0]
        proposal, rng = planner.proposal(key.sphere, key.k)
        t_star = proposal.t_star
        self._periods = 0
        try:
            motion, certificate = planner.plan(proposal, rng)
            recorder, joint_path = self._execute(planner, motion, demonstration, t_star)
            proof = self._proof(planner, motion, certificate, joint_path, t_star)
        except Unreachable as error:
            return Attempt(key, "out of reach", None, str(error), self._seconds)
        except MotionRejected as error:
            # What stands behind the colon differs each time.
            outcome = str(error).partition(":")[0]
            return Attempt(key, outcome, None, str(error), self._seconds)
        provenance = Provenance(
            demonstration_hash=self._sources[key.source][1].demonstration_hash,
            source=key.source,
            sphere=key.sphere,
            k=key.k,
            t_star=t_star,
            T_world_sampled=proposal.T_world_sampled,
            seed=self._config.seed,
            strategy=str(self._config.strategy),
            distribution=self._config.sampling.distribution,
            certificate=proof,
        )
        steps = recorder.steps(backwards=True)
        return Attempt(key, KEPT, Episode(steps, provenance, joint_path), seconds=self._seconds)

    @property
    def _seconds(self) -> float:
        return self._periods / self._backend.rates.control_hz

    def _execute(
        self, planner: SegmentPlanner, motion: Motion, demonstration: Demonstration, t_star: int
    ) -> tuple[StepRecorder, Array]:
        """The record of a motion's execution, and the joints `(m, n)` as measured on the way."""
        backend, steps, rates = self._backend, demonstration.steps, demonstration.rates
        gripper = float(steps.commanded_gripper[t_star])
        world = planner.world
        grasped = world.phases[t_star].grasped
        controller = ToolController(world.kinematics)
        require(backend, SavesStates, _FROM_STATES).restore(demonstration.states[t_star])
        controller.reset(
            steps.commanded_joint_positions[t_star], steps.commanded_Ts_world_tool[t_star]
        )
        cameras = recorded_cameras(demonstration, self._config)
        recorder = StepRecorder(backend, world.kinematics, cameras)
        start = recorded = backend.observe()
        measured = [start.q[None]]
        times = motion.times(rates.control_hz)
        no_force = 0.0 if isinstance(backend, SensesForce) else np.nan
        pressed = no_force
        for i, (time, q) in enumerate(zip(times, motion.joints(times), strict=True), 1):
            # As a policy will be at its own rate, held to what was measured a recorded step ago.
            controller.follow(q, motion.T_world_tool(time), recorded.T_world_tool)
            sent = backend.command(q, gripper)
            if not np.array_equal(sent.q, q) or sent.gripper != gripper:
                raise MotionRejected("command cut short: the robot can't go so fast")
            backend.step()
            self._periods += 1
            if isinstance(backend, SensesForce):
                pressed = max(pressed, backend.force())
            if isinstance(backend, SensesContacts):
                check_untouched(backend.scene, backend.contacts(), grasped)
            if i % rates.control_per_record:
                seen = backend.observe()
            else:
                seen = recorded = recorder.add(controller, gripper, pressed)
                pressed = no_force
            measured.append(seen.joint_path if len(seen.joint_path) else seen.q[None])
        check_undisturbed(backend.scene, grasped, start, recorded, self._config.slip_tolerance)
        return recorder, np.concatenate(measured)

    def _proof(
        self,
        planner: SegmentPlanner,
        motion: Motion,
        certificate: Certificate,
        joint_path: Array,
        t_star: int,
    ) -> dict[str, Any]:
        """What is proved about a segment: of the path commanded, and of the one measured.

        Raises:
            MotionRejected: the measured path can't be proved clear.
        """
        deviation = path_deviation(planner.world.placed(t_star), motion, joint_path)
        measured = planner.world.certify(t_star, PolylinePath(joint_path))
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


EXECUTORS = {"restore": "sart_toolkit.augment.executors:RestoreExecutor"}


def get_executor(name: str) -> type[SegmentExecutor]:
    """The class of executors that a name or reference names.

    Raises:
        UnknownName: there is none; the message says which part is wrong.
    """
    found: type[SegmentExecutor] = expect_class(
        "executor", name, resolve("executor", name, EXECUTORS), SegmentExecutor
    )
    return found


def recorded_cameras(demonstration: Demonstration, config: AugmentConfig) -> tuple[str, ...]:
    """The cameras that segments of a demonstration are recorded with."""
    return tuple(demonstration.steps.cameras) if config.cameras is None else config.cameras


def check_untouched(scene: SceneSpec, contacts: Sequence[Contact], grasped: frozenset[str]) -> None:
    """Return if nothing touched during the last step that should not.

    Raises:
        MotionRejected: the robot touched itself, or it or what it grasps touched something else.
    """
    touching = [(contact.a, contact.b) for contact in contacts]
    bodies = {body.name for body in scene.bodies}
    itself = [pair for pair in touching if bodies.isdisjoint(pair)]
    hits = sorted([*itself, *scene.outer_contacts(touching, grasped)])
    if hits:
        raise MotionRejected(f"contact {hits[0][0]} / {hits[0][1]}: stopped there")


def check_undisturbed(
    scene: SceneSpec,
    grasped: frozenset[str],
    start: Observation,
    end: Observation,
    slip_tolerance: float,
) -> None:
    """Return if what is grasped stayed in the grasp and all else where it was.

    Raises:
        MotionRejected: it didn't.
    """
    for body in scene.bodies:
        if body.mass is None or body.name not in start.Ts_world_body:
            continue
        Ts = [seen.Ts_world_body[body.name] for seen in (start, end)]
        most = _MOVED
        if body.name in grasped:
            most = slip_tolerance
            Ts = [inverse(seen.T_world_tool) @ T for seen, T in zip((start, end), Ts, strict=True)]
        # The farthest that any point of the body has moved.
        corners = np.concatenate([shape.corners() for shape in body.shapes])
        moved = corners @ (Ts[1] - Ts[0])[:3, :3].T + (Ts[1] - Ts[0])[:3, 3]
        far = float(np.linalg.norm(moved, axis=1).max())
        if far > most:
            what = "slipped in the grasp" if body.name in grasped else "was moved"
            raise MotionRejected(f"{body.name} {what}: by {far * 1e3:.1f} mm")


def _micrometres_up(length: float) -> float:
    return float(np.ceil(length * 1e6) / 1e6)
