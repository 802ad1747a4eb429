"""Makes attempts at segments on a robot: planned, proved clear, executed, checked, recorded."""

from __future__ import annotations

import abc
import functools
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass

from sart_toolkit.augment.config import AugmentConfig
from sart_toolkit.augment.execution import (
    SegmentRun,
    recorded_cameras,
    segment_proof,
)
from sart_toolkit.augment.planner import SegmentPlanner, world_of
from sart_toolkit.augment.rehearsal import Rehearsal
from sart_toolkit.augment.strategies import Proposal
from sart_toolkit.backends.interface import (
    Backend,
    SavesStates,
    missing_abilities,
    require,
)
from sart_toolkit.collision.certificate import Certificate
from sart_toolkit.data.manifest import KEPT, AttemptKey
from sart_toolkit.data.records import Annotation, Demonstration, Episode, Provenance, Steps
from sart_toolkit.errors import Mismatch, MotionRejected, Unreachable
from sart_toolkit.motion.timing import Motion
from sart_toolkit.poses import Array
from sart_toolkit.registry import expect_class, resolve
from sart_toolkit.tasks.task import Task

# Gives a further attempt from the sphere of a source (both numbers), if one is needed.
Spare = Callable[[int, int], AttemptKey | None]

_FROM_STATES = "segments start from the demonstration's saved states"


@dataclass(frozen=True)
class Attempt:
    """The outcome of an attempt: the episode, or the reason why it was rejected.

    `outcome` is the same for all attempts that fail alike; `detail` gives this one's figures.
    `seconds`: for how long [s] the robot moved, on its own clock; 0 for what was never executed,
    `None` where the executor doesn't tell; what it did since the attempt before counts. `resets`:
    how often robot and scene were put back to the demonstration's start since then.
    """

    key: AttemptKey
    outcome: str
    episode: Episode | None
    detail: str = ""
    seconds: float | None = None
    resets: int = 0


def no_spare(source: int, sphere: int) -> AttemptKey | None:
    """No further attempt."""
    return None


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
        ask: Callable[[str], None] | None = None,
        task: Task | None = None,
    ) -> None:
        """Make attempts on `backend`, the robot in the demonstrations' scene.

        Args:
            backend: the robot.
            sources: the demonstrations, with their annotations.
            config: what to generate.
            ask: shows a person what to do beside the robot, and returns when it is done; `None`
                where nobody is there.
            task: judges trajectories that can be executed to their end, see `RestoreExecutor`.
        """
        self._backend, self._sources, self._config = backend, sources, config
        self._ask, self._task = ask, task
        self._planners: dict[int, SegmentPlanner] = {}

    @property
    def tracking_error(self) -> float:
        """How far [m] the backend may be off a commanded path."""
        return self._backend.tracking_error

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
    def attempts(self, keys: Iterable[AttemptKey], spare: Spare = no_spare) -> Iterator[Attempt]:
        """The attempts with the given keys, each once, in an order of the executor's choice.

        An executor that would have to come back for more may ask for a `spare` where an attempt
        gave no episode; otherwise the caller asks it for these later.

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

    def _episode(
        self,
        key: AttemptKey,
        proposal: Proposal,
        motion: Motion,
        certificate: Certificate,
        steps: Steps,
        path: Array,
        stillness: float,
    ) -> Episode:
        """The episode of an executed segment, its measured joint path `(m, n)` proved clear.

        Bodies were up to `stillness` [m] from where the demonstration has them.

        Raises:
            MotionRejected: that can't be proved.
        """
        config, t = self._config, proposal.t_star
        provenance = Provenance(
            demonstration_hash=self.planner(key.source).demonstration_hash,
            source=key.source,
            sphere=key.sphere,
            k=key.k,
            t_star=t,
            T_world_sampled=proposal.T_world_sampled,
            seed=config.seed,
            strategy=str(config.strategy),
            distribution=config.sampling.distribution,
            certificate=segment_proof(
                self.planner(key.source), t, motion, certificate, path, self._backend, stillness
            ),
            merged=proposal.merged,
            recording=config.recording,
        )
        return Episode(steps, provenance, path)


def rejected_outcome(error: Unreachable | MotionRejected) -> str:
    """The outcome of an attempt that ended with an error: the same for all that fail alike."""
    # What stands behind the colon differs each time.
    return "out of reach" if isinstance(error, Unreachable) else str(error).partition(":")[0]


def rejected(
    key: AttemptKey, error: Unreachable | MotionRejected, run: SegmentRun | None = None
) -> Attempt:
    """The attempt that an error ended, `run` being what was executed of it."""
    outcome, seconds = rejected_outcome(error), 0.0 if run is None else run.seconds
    return Attempt(key, outcome, None, str(error), seconds)


class RestoreExecutor(SegmentExecutor):
    """Starts every attempt from the restored state of waypoint t*, at the pose commanded there.

    What is grasped may slip on the way back, where nobody looks, by more than on the way out. So
    where there is a task, and the backend knows what it is judged by, a trajectory that begins with
    something grasped is executed to its end, and rejected if it doesn't reach the goal.
    """

    parallel = True

    @functools.cached_property
    def _rehearsal(self) -> Rehearsal | None:
        if self._task is None or missing_abilities(self._backend, self._task.observes):
            return None
        return Rehearsal(self._backend, self._task)

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
        super().check(backend, demonstrations, config, ask)
        if not all(demonstration.states for demonstration in demonstrations):
            raise Mismatch(
                "the demonstration holds no saved states; record it on a backend that can restore"
            )

    def attempts(self, keys: Iterable[AttemptKey], spare: Spare = no_spare) -> Iterator[Attempt]:
        """The attempts in the order of their keys."""
        return map(self.attempt, keys)

    def attempt(self, key: AttemptKey) -> Attempt:
        """One attempt: sample, prove, move there and perhaps back, check.

        Raises:
            MissingCapability: the backend can't restore states.
        """
        planner = self.planner(key.source)
        demonstration = self._sources[key.source][0]
        proposal, rng = planner.proposal(key.sphere, key.k)
        t = proposal.t_star
        run: SegmentRun | None = None
        try:
            motion, certificate = planner.plan(proposal, rng, self.tracking_error)
            require(self._backend, SavesStates, _FROM_STATES).restore(demonstration.states[t])
            run = SegmentRun(self._backend, planner, t, self._config, planner.stillness)
            run.execute(planner.approach(t), motion)
            episode = self._episode(
                key, proposal, motion, certificate, run.steps(), run.joint_path, planner.stillness
            )
            self._rehearse(planner, episode, run, motion)
        except (Unreachable, MotionRejected) as error:
            return rejected(key, error, run)
        return Attempt(key, KEPT, episode, seconds=run.seconds)

    def _rehearse(
        self, planner: SegmentPlanner, episode: Episode, run: SegmentRun, motion: Motion
    ) -> None:
        """Return if a trajectory reaches the goal, where that has to be seen.

        Raises:
            MotionRejected: it doesn't.
        """
        p = episode.provenance
        if self._rehearsal is None or not (p.merged and planner.world.phases[p.t_star].grasped):
            return
        there = p.recording == "reversed"
        if there:
            run.rest(motion)
        found = self._rehearsal(planner, self._config, episode, there)
        run.periods += round(found["seconds"] * self._backend.rates.control_hz)
        if not found["success"]:
            raise MotionRejected(f"executed to its end, {found['kind']}: {found['reason']}")


EXECUTORS = {
    "restore": "sart_toolkit.augment.executors:RestoreExecutor",
    "replay": "sart_toolkit.augment.replay:ReplayExecutor",
}


def executor_name(
    name: str, backend: type[Backend], demonstrations: Sequence[Demonstration]
) -> str:
    """The executor's name that "auto" stands for; any other name stands for itself.

    It is `restore` where the backend saves states and the demonstrations hold some, of whatever
    backend, else `replay`.
    """
    if name != "auto":
        return name
    states = all(demonstration.states for demonstration in demonstrations)
    return "restore" if states and issubclass(backend, SavesStates) else "replay"


def get_executor(
    name: str, backend: Backend, demonstrations: Sequence[Demonstration]
) -> type[SegmentExecutor]:
    """The class of executors that a name or reference names, see `executor_name` of "auto".

    Raises:
        UnknownName: there is none; the message says which part is wrong.
    """
    name = executor_name(name, type(backend), demonstrations)
    found: type[SegmentExecutor] = expect_class(
        "executor", name, resolve("executor", name, EXECUTORS), SegmentExecutor
    )
    return found
