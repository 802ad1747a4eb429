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
from sart_toolkit.collision.phases import BODY_STILLNESS
from sart_toolkit.collision.world import CollisionWorld
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
        sources: Sequence[tuple[Demonstration, Annotation | None]],
        config: AugmentConfig,
    ) -> None:
        """Make attempts on `backend`, the robot in the demonstrations' scene."""
        self._backend, self._sources, self._config = backend, sources, config
        self._planners: dict[int, SegmentPlanner] = {}
        # Control periods that the attempt at hand has executed.
        self._periods = 0

    @property
    def tracking_error(self) -> float:
        """How far [m] the backend may be off a commanded path."""
        return self._backend.tracking_error

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
        it holds or has grasped there, with anything else at any physics step ends the execution. So
        does, at any control period, an object that slips in the grasp, a body that isn't where the
        proof has it, or a gripper that is wider open or closed than the proof holds for. A measured
        motion that is off its path by more than the backend's tracking error, or can't be proved
        clear, rejects the segment.
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
            motion, certificate = planner.plan(proposal, rng, self.tracking_error)
            recorder, joint_path = self._execute(planner, motion, demonstration, t_star)
            proof = self._proof(planner, motion, certificate, joint_path, t_star)
        except (Unreachable, MotionRejected) as error:
            return Attempt(key, rejected_outcome(error), None, str(error), self._seconds)
        provenance = Provenance(
            demonstration_hash=planner.demonstration_hash,
            source=key.source,
            sphere=key.sphere,
            k=key.k,
            t_star=t_star,
            T_world_sampled=proposal.T_world_sampled,
            seed=self._config.seed,
            strategy=str(self._config.strategy),
            distribution=self._config.sampling.distribution,
            certificate=proof,
            merged=proposal.merged,
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
        controller = ToolController(world.kinematics, rates=rates)
        require(backend, SavesStates, _FROM_STATES).restore(demonstration.states[t_star])
        cameras = recorded_cameras(demonstration, self._config)
        recorder = StepRecorder(backend, world.kinematics, cameras)
        start = recorded = backend.observe()
        disturbance = DisturbanceCheck(backend.scene, world, t_star, start, self._config)
        measured = [start.q[None]]
        controller.reset(
            steps.commanded_joint_positions[t_star], steps.commanded_Ts_world_tool[t_star]
        )

        no_force = 0.0 if isinstance(backend, SensesForce) else np.nan
        pressed = no_force

        def send(targets: Array) -> None:
            nonlocal pressed
            sent = backend.command(targets, gripper)
            if not np.array_equal(sent.q, targets[-1]) or sent.gripper != gripper:
                raise MotionRejected("command cut short: the robot can't go so fast")
            backend.step()
            self._periods += 1
            if isinstance(backend, SensesForce):
                pressed = max(pressed, backend.force())
            if isinstance(backend, SensesContacts):
                check_untouched(backend.scene, backend.contacts(), grasped)

        def periods(targets: Array) -> Array:
            return targets.reshape(-1, rates.physics_per_control, targets.shape[1])

        for rows in periods(planner.approach(t_star)[1:]):
            send(rows)
            recorded = backend.observe()
            disturbance(recorded)
            measured.append(joint_rows(recorded))
        pressed = no_force
        times = motion.times(rates.control_hz)
        targets = periods(motion.joints(motion.times(rates.physics_hz)))
        for i, (time, rows) in enumerate(zip(times, targets, strict=True), 1):
            # As a policy will be at its own rate, held to what was measured a recorded step ago.
            controller.follow(rows, motion.T_world_tool(time), recorded.T_world_tool)
            send(rows)
            if i % rates.control_per_record:
                seen = backend.observe()
            else:
                seen = recorded = recorder.add(controller, gripper, pressed)
                pressed = no_force
            disturbance(seen)
            measured.append(joint_rows(seen))
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
            MotionRejected: the measured path is farther off than the backend's tracking error, or
                can't be proved clear.
        """
        declared = self.tracking_error
        deviation = _micrometres_up(
            path_deviation(
                planner.world.placed(t_star), planner.approach(t_star), motion, joint_path
            )
        )
        if not deviation <= declared:
            raise MotionRejected(
                f"left its path: by up to {deviation * 1e3:.2f} mm, backend "
                f"{self._backend.name!r} declares a tracking error of {declared * 1e3:.2f} mm; "
                "allow more time"
            )
        margin = planner.measured_margin
        measured = planner.world.certify(t_star, PolylinePath(joint_path), margin)
        if measured.verdict != "free":
            raise MotionRejected(
                f"left its path {' / '.join(measured.pair)}: by {deviation * 1e3:.1f} mm, "
                f"{certificate.clearance * 1e3:.1f} mm were clear; allow more time"
            )
        return {
            "commanded": certificate.to_json(),
            "measured": measured.to_json(),
            "deviation": deviation,
            "tracking_error": declared,
            "body_stillness": BODY_STILLNESS,
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


def rejected_outcome(error: Unreachable | MotionRejected) -> str:
    """The outcome of an attempt that ended with an error: the same for all that fail alike."""
    # What stands behind the colon differs each time.
    return "out of reach" if isinstance(error, Unreachable) else str(error).partition(":")[0]


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


class DisturbanceCheck:
    """Checks each control period that all is still as the proofs from a waypoint take it to be."""

    def __init__(
        self,
        scene: SceneSpec,
        world: CollisionWorld,
        t: int,
        start: Observation,
        config: AugmentConfig,
    ) -> None:
        """Compare with how things stood at waypoint `t`.

        Args:
            scene: the bodies that are watched, as far as the backend knows where they are.
            world: what was proved about.
            t: the waypoint.
            start: what was measured before anything moved. It stands in for the demonstration,
                where that doesn't tell where bodies were.
            config: says how far an object may slip in the grasp.
        """
        demonstration = world.demonstration
        self._openings = world.openings(t)
        self._grasped = world.phases[t].grasped
        self._slip_tolerance = config.slip_tolerance
        self._T_world_tool = demonstration.steps.measured_Ts_world_tool[t]
        self._Ts_world_body, self._corners = {}, {}
        for body in scene.bodies:
            if body.mass is None or body.name not in start.Ts_world_body:
                continue
            recorded = demonstration.body_Ts_world.get(body.name)
            self._Ts_world_body[body.name] = (
                start.Ts_world_body[body.name] if recorded is None else recorded[t]
            )
            self._corners[body.name] = np.concatenate([shape.corners() for shape in body.shapes])

    def __call__(self, seen: Observation) -> None:
        """Return if what is grasped stayed in the grasp, all else where it was, fingers in range.

        Raises:
            MotionRejected: it didn't.
        """
        low, high = self._openings
        if not low <= seen.gripper <= high:
            raise MotionRejected(
                f"gripper left its range: it is at {seen.gripper:.3f}, the proof is for "
                f"{low:.3f} to {high:.3f}"
            )
        for name, T in self._Ts_world_body.items():
            change = seen.Ts_world_body[name] - T
            most, what = BODY_STILLNESS, "was moved"
            if name in self._grasped:
                most, what = self._slip_tolerance, "slipped in the grasp"
                change = (
                    inverse(seen.T_world_tool) @ seen.Ts_world_body[name]
                    - inverse(self._T_world_tool) @ T
                )
            # The farthest that any point of the body has moved.
            moved = self._corners[name] @ change[:3, :3].T + change[:3, 3]
            far = float(np.linalg.norm(moved, axis=1).max())
            # Written so that what is no number is rejected.
            if not far <= most:
                raise MotionRejected(f"{name} {what}: by {far * 1e3:.2f} mm")


def joint_rows(seen: Observation) -> Array:
    """Where the joints were during the last control period `(m, n)`, as often as was measured."""
    return seen.joint_path if len(seen.joint_path) else seen.q[None]


def _micrometres_up(length: float) -> float:
    return float(np.ceil(length * 1e6) / 1e6)
