"""Makes attempts on a robot that follows the demonstration and restores nothing."""

from __future__ import annotations

import dataclasses
import logging
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from sart_toolkit.augment.config import AugmentConfig
from sart_toolkit.augment.execution import (
    LONGEST_REST,
    REST_SPEED,
    DisturbanceCheck,
    SegmentRun,
    check_untouched,
)
from sart_toolkit.augment.executors import Attempt, SegmentExecutor, Spare, no_spare, rejected
from sart_toolkit.augment.planner import SegmentPlanner
from sart_toolkit.augment.strategies import Proposal
from sart_toolkit.backends.interface import Attended, Backend, Resets, SensesContacts
from sart_toolkit.collision.certificate import Certificate
from sart_toolkit.collision.phases import OUT_AND_BACK_STILLNESS
from sart_toolkit.data.manifest import KEPT, AttemptKey
from sart_toolkit.data.records import Annotation, Demonstration
from sart_toolkit.errors import Mismatch, MissingCapability, MotionRejected, Unreachable
from sart_toolkit.motion.controller import ToolController
from sart_toolkit.motion.path import SplinePath
from sart_toolkit.motion.timing import Motion, timed
from sart_toolkit.poses import Array, apply_motion
from sart_toolkit.robots.model import RobotModel
from sart_toolkit.scenes.spec import SceneSpec, SceneState
from sart_toolkit.tasks.task import Task

_log = logging.getLogger(__name__)
# How often the robot comes to a waypoint before it is given up as one that doesn't reproduce.
_ARRIVALS = 3
# How far [m] bodies may be from where the demonstration has them; attempts are proved for that.
_MOST_MOVED = 1e-3
# The way to the start takes so long [s], or more where the joints need it; nearer than this [rad]
# the robot is there.
_TO_START, _AT_START = 4.0, 1e-3
_KNOTS = 13
# How long [s] the gripper has to go where it was at the start.
_GRIPPER_TIME = 3.0


@dataclass(frozen=True)
class _Planned:
    """An attempt whose segment is proved clear."""

    key: AttemptKey
    proposal: Proposal
    motion: Motion
    certificate: Certificate
    stillness: float

    @property
    def order(self) -> tuple[int, int, AttemptKey]:
        """When it is its turn: by source, then by waypoint."""
        return self.key.source, self.proposal.t_star, self.key


class ReplayExecutor(SegmentExecutor):
    """Follows the demonstration to each convergence waypoint and makes the attempts there.

    The robot starts from the demonstration's start, follows its commands, and comes to a rest at
    the pose commanded at t*; from there it makes all attempts that start at that waypoint, out and
    back on their proved paths, and goes on with the demonstration. Before and after each attempt
    what is measured must agree with the demonstration, whose scene the proofs are about. Where
    something stops an attempt, the robot goes back to t* on the path that it came; where the scene
    no longer agrees then, it is put back to the start and the robot follows the demonstration
    again. A backend that can't do that by itself has a person asked to.
    """

    parallel = False

    def __init__(
        self,
        backend: Backend,
        sources: Sequence[tuple[Demonstration, Annotation | None]],
        config: AugmentConfig,
        ask: Callable[[str], None] | None = None,
        task: Task | None = None,
    ) -> None:
        attendant = backend.ask if isinstance(backend, Attended) else ask
        super().__init__(backend, sources, config, attendant, task)
        # How often what was measured at a waypoint didn't agree with the demonstration, and why.
        self._strayed: Counter[tuple[int, int]] = Counter()
        self._last_reason: dict[tuple[int, int], str] = {}
        # Since the last attempt: control periods executed outside attempts, and resets.
        self._periods = self._resets = 0

    @classmethod
    def check(
        cls,
        backend: Backend,
        demonstrations: Sequence[Demonstration],
        config: AugmentConfig,
        ask: Callable[[str], None] | None = None,
    ) -> None:
        """Return if attempts at segments of the demonstrations can be made on `backend`.

        Raises:
            UnknownName: the backend has no such camera.
            MissingCapability: the backend can't be reset and nobody can be asked to do it, or
                images are wanted and it takes none.
            Mismatch: a demonstration was recorded at other rates, or one that the backend is to be
                reset to doesn't tell where bodies were.
        """
        super().check(backend, demonstrations, config, ask)
        if isinstance(backend, Resets):
            for demonstration in demonstrations:
                start_state(demonstration, backend.scene)
        elif ask is None and not isinstance(backend, Attended):
            raise MissingCapability(
                f"backend {backend.name!r} lacks the ability Resets, and nobody can be asked to "
                "put the scene back to the demonstration's start; type the command at a terminal, "
                "pass `ask`, or use another backend"
            )

    def attempts(self, keys: Iterable[AttemptKey], spare: Spare = no_spare) -> Iterator[Attempt]:
        """The attempts by source and waypoint; those that can't be proved clear come first.

        One that gives no episode is followed by its spare, at the same waypoint.
        """
        todo: list[_Planned] = []
        for key in keys:
            yield from self._prepare(key, todo, spare)
        while todo:
            yield from self._replay(todo, spare)

    def _prepare(
        self, key: AttemptKey | None, todo: list[_Planned], spare: Spare
    ) -> Iterator[Attempt]:
        """Plan an attempt, or its spares until one is proved; the others are what is returned."""
        while key is not None:
            try:
                todo.append(self._planned(key))
                return
            except (Unreachable, MotionRejected) as error:
                yield rejected(key, error)
                key = spare(key.source, key.sphere)

    def _planned(self, key: AttemptKey, stillness: float = OUT_AND_BACK_STILLNESS) -> _Planned:
        """An attempt, proved clear of bodies up to `stillness` [m] from where they were.

        Raises:
            Unreachable, MotionRejected: it can't be, or its waypoint is given up.
        """
        planner = self.planner(key.source)
        proposal, rng = planner.proposal(key.sphere, key.k)
        self._check_reproduces(key.source, proposal.t_star)
        motion, certificate = planner.plan(proposal, rng, self.tracking_error, stillness)
        return _Planned(key, proposal, motion, certificate, stillness)

    def _check_reproduces(self, source: int, t: int) -> None:
        """Return unless the waypoint is given up.

        Raises:
            MotionRejected: it is.
        """
        if self._strayed[source, t] >= _ARRIVALS:
            raise MotionRejected(
                f"demonstration doesn't reproduce: {_ARRIVALS} times something was otherwise at "
                f"waypoint {t}, the last time {self._last_reason[source, t]}"
            )

    def _replay(self, todo: list[_Planned], spare: Spare) -> Iterator[Attempt]:
        """The attempts of one replay of a source's demonstration, up to where it went wrong."""
        source = min(todo, key=lambda planned: planned.order).key.source
        follower = self._started(source)
        while here := [planned for planned in todo if planned.key.source == source]:
            t = min(planned.proposal.t_star for planned in here)
            if t < follower.t:
                # A spare that starts at an earlier waypoint.
                return
            arrived = follower.t == t and follower.stopped
            try:
                if not arrived:
                    follower.go_to(t)
                    self._check_agreement(source, follower)
            except MotionRejected as error:
                self._strayed[source, t] += 1
                self._last_reason[source, t] = str(error)
                _log.warning("at waypoint %d the scene isn't the demonstration's: %s", t, error)
                if self._strayed[source, t] >= _ARRIVALS:
                    yield from self._given_up(source, t, todo, spare)
                return
            planned = min(here, key=lambda planned: planned.order)
            todo.remove(planned)
            attempt, problem = self._attempt(planned, follower.stillness)
            yield self._noted(attempt)
            if attempt.episode is None:
                yield from self._prepare(spare(*planned.key[:2]), todo, spare)
            try:
                if problem is not None:
                    raise problem
                follower.rest()
                self._check_agreement(source, follower)
            except MotionRejected as error:
                _log.warning("at waypoint %d the scene was disturbed: %s", t, error)
                return

    def _given_up(
        self, source: int, t: int, todo: list[_Planned], spare: Spare
    ) -> Iterator[Attempt]:
        """The rejections of what was to start at a waypoint."""
        for planned in list(todo):
            if (planned.key.source, planned.proposal.t_star) == (source, t):
                todo.remove(planned)
                yield from map(self._noted, self._prepare(planned.key, todo, spare))

    def _noted(self, attempt: Attempt) -> Attempt:
        """The attempt with what the robot did since the one before."""
        seconds = (attempt.seconds or 0.0) + self._periods / self._backend.rates.control_hz
        resets, self._periods, self._resets = self._resets, 0, 0
        return dataclasses.replace(attempt, seconds=seconds, resets=resets)

    def _attempt(
        self, planned: _Planned, stillness: float
    ) -> tuple[Attempt, MotionRejected | None]:
        """One attempt from where the robot stands, and what kept it from coming back there, if any.

        What was proved for bodies where they were is proved again for where they are.
        """
        if stillness > planned.stillness:
            try:
                planned = self._planned(planned.key, stillness)
            except (Unreachable, MotionRejected) as error:
                return rejected(planned.key, error), None
        motion, planner = planned.motion, self.planner(planned.key.source)
        t = planned.proposal.t_star
        run = SegmentRun(self._backend, planner, t, self._config, planned.stillness)
        back = self._config.recording == "return"
        try:
            run.go_out(motion, record=not back)
        except MotionRejected as error:
            run.retreat(motion)
            return rejected(planned.key, error, run), None
        path, problem = run.joint_path, None
        try:
            run.go_back(motion, record=back)
        except MotionRejected as error:
            problem = error
        try:
            if back:
                if problem is not None:
                    raise problem
                path = run.joint_path
            # What was recorded on the way out holds whatever happened on the way back.
            episode = self._episode(
                planned.key,
                planned.proposal,
                motion,
                planned.certificate,
                run.steps(),
                path,
                planned.stillness,
            )
        except MotionRejected as error:
            return rejected(planned.key, error, run), problem
        return Attempt(planned.key, KEPT, episode, seconds=run.seconds), problem

    def _started(self, source: int) -> _Follower:
        """A follower at the start of a demonstration, robot and scene put back there."""
        demonstration = self._sources[source][0]
        planner = self.planner(source)
        if isinstance(self._backend, Resets):
            self._backend.reset(start_state(demonstration, self._backend.scene))
        else:
            assert self._ask is not None
            bring_back(self._backend, planner, self._ask, self._count)
        self._resets += 1
        return _Follower(self._backend, planner, self._count)

    def _count(self) -> None:
        self._periods += 1

    def _check_agreement(self, source: int, follower: _Follower) -> None:
        """Return if what is measured, the robot at rest at a waypoint, is as it was demonstrated.

        Raises:
            MotionRejected: something isn't.
        """
        planner, t, backend = self.planner(source), follower.t, self._backend
        seen, world = follower.seen, planner.world
        reach = world.placed(t).bounds.reach.max(0, initial=0.0)
        wanted = world.demonstration.steps.commanded_joint_positions[t]
        off = float((np.abs(seen.q - wanted) * reach).sum())
        if not off <= self.tracking_error:
            raise MotionRejected(f"robot isn't where it was commanded: by {off * 1e3:.2f} mm")
        check = DisturbanceCheck(
            backend.scene, world, t, follower.arrival, self._config, _MOST_MOVED
        )
        check(seen)
        # In tenths of a millimetre, and what may be moved while the robot moves.
        tenths = float(np.ceil(np.round(check.moved(seen) * 1e4, 1)))
        follower.stillness = round(tenths * 1e-4 + OUT_AND_BACK_STILLNESS, 6)
        if isinstance(backend, SensesContacts):
            check_untouched(backend.scene, backend.contacts(), world.phases[t].grasped)


class _Follower:
    """Has a robot follow a demonstration's commands, and stop at waypoints.

    Attributes:
        t: the waypoint that was reached.
        stopped: whether the robot rests there.
        seen: what was measured last.
        arrival: what was measured when the robot had come to a rest there.
        stillness: how far [m] from where they were demonstrated bodies may be in the next attempt.
    """

    def __init__(
        self, backend: Backend, planner: SegmentPlanner, moved: Callable[[], None]
    ) -> None:
        """Begin at the demonstration's start, where robot and scene are."""
        self._backend, self._moved = backend, moved
        self._demonstration = planner.world.demonstration
        self._controller = ToolController(planner.world.kinematics, rates=backend.rates)
        self.t, self.stopped, self.stillness = 0, False, OUT_AND_BACK_STILLNESS
        self._at_waypoint()
        self.seen = self.arrival = backend.observe()

    def go_to(self, t: int) -> None:
        """Follow the commands up to a waypoint, and come to a rest at what it commands.

        Raises:
            MotionRejected: the robot doesn't come to a rest.
        """
        per_record = self._backend.rates.control_per_record
        for row in self._demonstration.raw_commands[self.t * per_record : t * per_record]:
            self._send(self._steered(row[:6]), float(row[6]))
        self.t = t
        self.rest()
        self.arrival = self.seen

    def rest(self) -> None:
        """Come to a rest at what the waypoint commands.

        Raises:
            MotionRejected: the robot doesn't.
        """
        gripper = float(self._demonstration.steps.commanded_gripper[self.t])
        for _ in range(round(LONGEST_REST * self._backend.rates.record_hz)):
            for _ in range(self._backend.rates.control_per_record):
                self._send(self._controller.hold(), gripper)
            if self._controller.settled and np.abs(self.seen.dq).max() <= REST_SPEED:
                break
        else:
            raise MotionRejected(f"no rest at waypoint {self.t}: after {LONGEST_REST:g} s")
        self.stopped = True
        # A command that was held back here on the way is the demonstration's own again.
        self._at_waypoint()

    def _at_waypoint(self) -> None:
        steps = self._demonstration.steps
        q, T = steps.commanded_joint_positions[self.t], steps.commanded_Ts_world_tool[self.t]
        self._controller.reset(q, T)

    def _steered(self, velocity: Array) -> Array:
        """Joint targets `(m, n)` of a control period at a tool velocity, as it was recorded."""
        desired = apply_motion(
            self._controller.commanded_T_world_tool, velocity / self._backend.rates.control_hz
        )
        try:
            (targets,) = self._controller.move(desired, self.seen.T_world_tool, 1)
        except (Unreachable, MotionRejected):
            # The recording holds such commands as they were given; they weren't carried out either.
            return self._controller.hold()
        return targets

    def _send(self, targets: Array, gripper: float) -> None:
        sent = self._backend.command(targets, gripper)
        self._controller.acknowledge(sent.q)
        self._backend.step()
        self._moved()
        self.seen = self._backend.observe()
        self.stopped = False


def start_state(demonstration: Demonstration, scene: SceneSpec) -> SceneState:
    """The state of robot and scene in which a demonstration began.

    Raises:
        Mismatch: it doesn't tell where the scene's bodies were.
    """
    steps = demonstration.steps
    bodies = {name: Ts[0] for name, Ts in demonstration.body_Ts_world.items()}
    missing = [body.name for body in scene.bodies if body.name not in bodies]
    if missing:
        raise Mismatch(
            f"the demonstration doesn't tell where {missing[0]!r} was, so that a backend can't be "
            "reset to its start; record it on a backend that knows the bodies"
        )
    state = scene.seen_state(steps.joint_positions[0], float(steps.measured_gripper[0]), bodies)
    return dataclasses.replace(state, gripper_target=float(steps.commanded_gripper[0]))


def bring_back(
    backend: Backend, planner: SegmentPlanner, ask: Callable[[str], None], moved: Callable[[], None]
) -> None:
    """Have a person put the scene back, then bring gripper and robot to a demonstration's start.

    The joints go there in a straight line if that is proved clear of the scene as it was then.

    Args:
        backend: a robot that can't be reset.
        planner: knows the demonstration and its scene.
        ask: shows a person what to do, and returns when it is done.
        moved: called after each control period.

    Raises:
        MotionRejected: the way isn't clear, though the person was asked to clear it.
    """
    world, rates = planner.world, backend.rates
    steps = world.demonstration.steps
    opening, goal = float(steps.commanded_gripper[0]), steps.commanded_joint_positions[0]

    def send(targets: Array) -> None:
        backend.command(targets, opening)
        backend.step()
        moved()

    def gripper_off() -> bool:
        low, high = world.openings(0)
        return not low <= backend.observe().gripper <= high

    here = backend.observe().q
    if gripper_off():
        ask("Take what the gripper holds: it goes where it was at the demonstration's start")
        for _ in range(round(_GRIPPER_TIME * rates.control_hz)):
            send(here)
            if not gripper_off():
                break
        else:
            raise MotionRejected(
                f"gripper: isn't where it was at the start within {_GRIPPER_TIME:g} s; see what "
                "blocks it"
            )
    ask(
        "Put the scene back as it was at the start of the demonstration, and stay clear of the "
        "robot: it goes there too"
    )
    problem = ""
    for _ in range(_ARRIVALS):
        here = backend.observe().q
        if np.abs(here - goal).max() <= _AT_START:
            return
        motion = _joint_line(world.kinematics, here, goal, rates.record_hz)
        proof = world.certify(
            0, motion.path, planner.measured_margin(planner.stillness) + backend.tracking_error
        )
        if proof.verdict == "free":
            targets = motion.joints(motion.times(rates.physics_hz))
            for rows in targets.reshape(-1, rates.physics_per_control, targets.shape[1]):
                send(rows)
            for _ in range(rates.control_hz):
                send(goal)
            return
        problem = f"{' / '.join(proof.pair)} {proof.verdict}"
        ask(
            f"The robot's straight way to the start isn't clear ({problem}): move the robot there, "
            "or to where the way is clear, by hand"
        )
    raise MotionRejected(f"way to the start: it isn't clear ({problem}); move the robot by hand")


def _joint_line(model: RobotModel, start: Array, goal: Array, record_hz: int) -> Motion:
    """The motion in which all joints go straight from one configuration `(n,)` to another."""
    path = SplinePath.through(np.linspace(start, goal, _KNOTS))

    def T_at(s: float) -> Array:
        return model.fk(path.positions(np.array([s]))[0])

    return timed(model, path, _TO_START, T_at, record_hz)
