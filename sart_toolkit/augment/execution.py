"""One segment as a robot executes it: out along its path, back where wanted, checked throughout."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from sart_toolkit.augment.config import AugmentConfig
from sart_toolkit.augment.planner import SegmentPlanner, path_deviation
from sart_toolkit.backends.interface import (
    Backend,
    Contact,
    Observation,
    SensesContacts,
    SensesForce,
)
from sart_toolkit.collision.certificate import Certificate
from sart_toolkit.collision.phases import BODY_STILLNESS
from sart_toolkit.collision.world import CollisionWorld
from sart_toolkit.data.records import Demonstration, Steps
from sart_toolkit.errors import MotionRejected
from sart_toolkit.motion.controller import ToolController
from sart_toolkit.motion.path import PolylinePath
from sart_toolkit.motion.timing import Motion
from sart_toolkit.poses import Array, inverse
from sart_toolkit.record.recorder import StepRecorder
from sart_toolkit.scenes.spec import SceneSpec

# At rest, no joint is faster [rad/s]; how long [s] the robot has for it.
REST_SPEED, LONGEST_REST = 0.01, 2.0
# Where only the force is sensed, by how much [N] more than at the start means a contact.
_MORE_FORCE = 5.0
# How soon [s] the robot stands still where something stopped it, and is at speed on its way back.
_STOP, _START = 0.1, 0.3


class SegmentRun:
    """The execution of one segment from a waypoint.

    Its methods raise `MotionRejected` at the first contact of the robot, or of what it holds or has
    grasped, with anything else, and wherever something isn't as the proof has it.

    Attributes:
        periods: control periods executed.
    """

    def __init__(
        self,
        backend: Backend,
        planner: SegmentPlanner,
        t: int,
        config: AugmentConfig,
        stillness: float = BODY_STILLNESS,
    ) -> None:
        """Begin where the robot is: at waypoint `t`, the command of that waypoint in force.

        Bodies may be up to `stillness` [m] from where the demonstration has them.
        """
        world = planner.world
        steps = world.demonstration.steps
        self._backend, self._rates, self._recording = backend, backend.rates, config.recording
        self._gripper = float(steps.commanded_gripper[t])
        self._grasped = world.phases[t].grasped
        self._controller = ToolController(world.kinematics, rates=backend.rates)
        self._controller.reset(steps.commanded_joint_positions[t], steps.commanded_Ts_world_tool[t])
        cameras = recorded_cameras(world.demonstration, config)
        self._recorder = StepRecorder(backend, world.kinematics, cameras)
        # What was measured last at the end of a recorded step.
        self._step_end = start = backend.observe()
        self._disturbance = DisturbanceCheck(backend.scene, world, t, start, config, stillness)
        self._measured = [start.q[None]]
        self._no_force = 0.0 if isinstance(backend, SensesForce) else np.nan
        self._pressed = self._no_force
        # Greatest force of the first period.
        self._force_before: float | None = None
        # Where in a motion's time [s] the robot was sent last.
        self._at = 0.0
        self.periods = 0

    @property
    def seconds(self) -> float:
        """For how long [s] the robot moved."""
        return self.periods / self._rates.control_hz

    @property
    def joint_path(self) -> Array:
        """The joints `(m, n)` [rad] as measured from the start to now."""
        return np.concatenate(self._measured)

    def steps(self) -> Steps:
        """What was recorded, in the order in which it leads to the waypoint."""
        return self._recorder.steps(backwards=self._recording == "reversed")

    def execute(self, approach: Array, motion: Motion) -> None:
        """Come to a rest at the command, go out, and back again if the return is recorded.

        Args:
            approach: joint targets `(k, n)` of whole control periods that end at that rest; before
                them, a row of where they start.
            motion: from there to the sampled pose.

        Raises:
            MotionRejected: something isn't as the proof has it.
        """
        self.settle(approach)
        if self._recording == "reversed":
            self.go_out(motion, record=True)
        else:
            self.go_out(motion, record=False)
            self.go_back(motion, record=True)

    def settle(self, approach: Array) -> None:
        """Follow joint targets `(k, n)`, but for their first row, to a rest at the command."""
        for targets in self._periods(approach[1:]):
            self._send(targets)
            self._step_end = self._measure()
        self._pressed = self._no_force

    def go_out(self, motion: Motion, record: bool) -> None:
        """Follow a motion from the waypoint to the sampled pose."""
        self._follow(motion, backwards=False, rows=len(self._times(motion)) if record else 0)

    def go_back(self, motion: Motion, record: bool) -> None:
        """Come to a rest at the sampled pose, and follow the motion in reversed time.

        Recorded are the rest and each step but the last: that one ends at the waypoint, where the
        demonstration's own step stands.
        """
        self.rest(motion)
        rows = len(self._times(motion)) - 1 if record else 0
        if record:
            self._step_end = self._record()
        self._follow(motion, backwards=True, rows=rows)

    def retreat(self, motion: Motion) -> None:
        """Stop on the way out, and go back along the motion's path to the waypoint; check nothing.

        The motion's time slows down and runs back, so that the robot stays on its path.
        """
        steps = np.arange(1, 1 + round(_STOP * self._rates.physics_hz))
        u = steps / len(steps)
        stopping = self._at + _STOP * (u - _ramp(u))
        back = np.arange(1, 1 + round((self._at + _STOP + _START) * self._rates.physics_hz))
        u = back / (_START * self._rates.physics_hz)
        returning = stopping[-1] - _START * (_ramp(np.minimum(u, 1.0)) + np.maximum(u - 1.0, 0.0))
        times = np.maximum(np.concatenate([stopping, returning]), 0.0)
        # Whole control periods; it rests at the waypoint by then.
        missing = -len(times) % self._rates.physics_per_control
        times = np.concatenate([times, np.zeros(missing)])
        for targets in self._periods(motion.joints(times)):
            self._backend.command(targets, self._gripper)
            self._backend.step()
            self.periods += 1

    def _times(self, motion: Motion) -> Array:
        return motion.times(self._rates.record_hz)

    def _follow(self, motion: Motion, backwards: bool, rows: int) -> None:
        """Follow a motion; its first `rows` recorded steps are kept.

        On the way back the joints follow the command one control period later, as `ToolController`
        has them do when a policy acts. The way out knows no such lag: reversed it would be a lead.
        """
        times = motion.times(self._rates.control_hz)
        fine = motion.times(self._rates.physics_hz)
        if backwards:
            times, fine = motion.duration - times, motion.duration - fine
        targets = sent = self._periods(motion.joints(fine))
        if backwards:
            sent = np.concatenate([self._at_end(motion)[None], targets])
        per_record = self._rates.control_per_record
        for i, (time, wanted, now) in enumerate(zip(times, targets, sent, strict=False), 1):
            # As a policy will be at its own rate, held to what was measured a recorded step ago.
            self._controller.follow(
                wanted, motion.T_world_tool(time), self._step_end.T_world_tool, now[-1]
            )
            self._at = time
            self._send(now)
            if i % per_record:
                self._measure()
            else:
                keep = i // per_record <= rows
                self._step_end = self._record() if keep else self._measure()
        for late in sent[len(targets) :]:
            self._send(late)
            self._step_end = self._measure()

    def _at_end(self, motion: Motion) -> Array:
        """Targets `(steps, n)` of a control period at rest at the end of a motion."""
        return motion.path.positions(np.ones(self._rates.physics_per_control))

    def rest(self, motion: Motion) -> None:
        """Stay at the sampled pose until the joints rest, for whole recorded steps."""
        per_record = self._rates.control_per_record
        for _ in range(round(LONGEST_REST * self._rates.record_hz)):
            self._pressed = self._no_force
            for _ in range(per_record):
                self._send(self._at_end(motion))
                self._step_end = self._measure()
            if np.abs(self._step_end.dq).max() <= REST_SPEED:
                return
        raise MotionRejected(
            f"no rest at the sampled pose: a joint moves by "
            f"{np.abs(self._step_end.dq).max():.3f} rad/s after {LONGEST_REST:g} s"
        )

    def _periods(self, targets: Array) -> Array:
        return targets.reshape(-1, self._rates.physics_per_control, targets.shape[1])

    def _send(self, targets: Array) -> None:
        backend = self._backend
        sent = backend.command(targets, self._gripper)
        if not np.array_equal(sent.q, targets[-1]) or sent.gripper != self._gripper:
            raise MotionRejected("command cut short: the robot can't go so fast")
        backend.step()
        self.periods += 1
        if isinstance(backend, SensesForce):
            self._pressed = max(self._pressed, backend.force())
        if isinstance(backend, SensesContacts):
            check_untouched(backend.scene, backend.contacts(), self._grasped)
        elif isinstance(backend, SensesForce):
            self._check_force(backend.force())

    def _check_force(self, force: float) -> None:
        if self._force_before is None:
            self._force_before = force
        if not force - self._force_before <= _MORE_FORCE:
            raise MotionRejected(
                f"contact force: {force:.1f} N, {self._force_before:.1f} N before it moved; "
                "stopped there"
            )

    def _measure(self) -> Observation:
        return self._checked(self._backend.observe())

    def _record(self) -> Observation:
        seen = self._recorder.add(self._controller, self._gripper, self._pressed)
        self._pressed = self._no_force
        return self._checked(seen)

    def _checked(self, seen: Observation) -> Observation:
        self._disturbance(seen)
        self._measured.append(joint_rows(seen))
        return seen


def _ramp(u: Array) -> Array:
    """How far a speed takes that rises from 0 at u = 0 smoothly to 1 at u = 1; then it is 1 / 2."""
    return np.asarray(u**6 - 3 * u**5 + 2.5 * u**4)


def segment_proof(
    planner: SegmentPlanner,
    t: int,
    motion: Motion,
    certificate: Certificate,
    joint_path: Array,
    backend: Backend,
    stillness: float = BODY_STILLNESS,
) -> dict[str, Any]:
    """What is proved about a segment: of the path commanded, and of the one measured.

    Args:
        planner: what planned it.
        t: the waypoint that it starts from.
        motion: what was commanded.
        certificate: the proof of that.
        joint_path: the joints `(m, n)` [rad] as measured.
        backend: what executed it.
        stillness: how far [m] bodies may have been from where the demonstration has them.

    Raises:
        MotionRejected: the measured path is farther off than the backend's tracking error, or
            can't be proved clear.
    """
    declared = backend.tracking_error
    world = planner.world
    deviation = _micrometres_up(
        path_deviation(world.placed(t), planner.approach(t), motion, joint_path)
    )
    if not deviation <= declared:
        raise MotionRejected(
            f"left its path: by up to {deviation * 1e3:.2f} mm, backend {backend.name!r} declares "
            f"a tracking error of {declared * 1e3:.2f} mm; allow more time"
        )
    measured = world.certify(t, PolylinePath(joint_path), planner.measured_margin(stillness))
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
        "body_stillness": stillness,
        "duration": motion.duration,
    }


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
        stillness: float = BODY_STILLNESS,
    ) -> None:
        """Compare with how things stood at waypoint `t`.

        Args:
            scene: the bodies that are watched, as far as the backend knows where they are.
            world: what was proved about.
            t: the waypoint.
            start: what was measured before anything moved. It stands in for the demonstration,
                where that doesn't tell where bodies were.
            config: says how far an object may slip in the grasp.
            stillness: how far [m] any other body may be from where it was.
        """
        demonstration = world.demonstration
        self._openings = world.openings(t)
        self._grasped = world.phases[t].grasped
        self._slip_tolerance, self._stillness = config.slip_tolerance, stillness
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
        for name in self._Ts_world_body:
            grasped = name in self._grasped
            most = self._slip_tolerance if grasped else self._stillness
            far = self._moved(name, seen)
            # Written so that what is no number is rejected.
            if not far <= most:
                what = "slipped in the grasp" if grasped else "was moved"
                raise MotionRejected(f"{name} {what}: by {far * 1e3:.2f} mm")

    def moved(self, seen: Observation) -> float:
        """How far [m] any body that isn't grasped is from where it was."""
        others = self._Ts_world_body.keys() - self._grasped
        return max((self._moved(name, seen) for name in others), default=0.0)

    def _moved(self, name: str, seen: Observation) -> float:
        """How far [m] any point of a body has moved; if it is grasped, in the grasp."""
        before, now = self._Ts_world_body[name], seen.Ts_world_body[name]
        if name in self._grasped:
            before, now = inverse(self._T_world_tool) @ before, inverse(seen.T_world_tool) @ now
        change = now - before
        moved = self._corners[name] @ change[:3, :3].T + change[:3, 3]
        return float(np.linalg.norm(moved, axis=1).max())


def joint_rows(seen: Observation) -> Array:
    """Where the joints were during the last control period `(m, n)`, as often as was measured."""
    return seen.joint_path if len(seen.joint_path) else seen.q[None]


def _micrometres_up(length: float) -> float:
    return float(np.ceil(length * 1e6) / 1e6)
