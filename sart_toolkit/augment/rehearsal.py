"""Executes a trajectory from its start to the end of the task, commanded as a policy would."""

from __future__ import annotations

from typing import Any

import numpy as np

from sart_toolkit.augment.config import AugmentConfig
from sart_toolkit.augment.execution import SegmentRun
from sart_toolkit.augment.planner import SegmentPlanner
from sart_toolkit.backends.interface import Backend, SavesStates, require
from sart_toolkit.collision.phases import BODY_STILLNESS
from sart_toolkit.data.records import Episode, apply_action
from sart_toolkit.errors import MotionRejected, Unreachable
from sart_toolkit.motion.controller import ToolController
from sart_toolkit.poses import distance
from sart_toolkit.tasks.task import Task


class Rehearsal:
    """Executes trajectories on a backend and tells whether they reach a task's goal."""

    def __init__(self, backend: Backend, task: Task) -> None:
        """Execute on `backend`, the robot in the task's scene.

        Raises:
            MissingCapability: it can't restore states, or lacks what success is judged by.
        """
        for ability in task.observes:
            require(backend, ability, f"the success of task {task.name!r} is judged by it")
        self._restore = require(
            backend, SavesStates, "trajectories start from saved states"
        ).restore
        self._backend, self._task = backend, task
        # Control periods that the trajectory at hand has taken.
        self._periods = 0

    def __call__(
        self,
        planner: SegmentPlanner,
        config: AugmentConfig,
        episode: Episode,
        there: bool = False,
    ) -> dict[str, Any]:
        """What came of an episode's trajectory.

        From the restored state of t* the robot goes out to the sampled pose and comes to a rest.
        From there it is given the trajectory's actions at the rate of a policy, and then
        holds still until the goal has been held, or for as long as it must be.

        Args:
            planner: of the episode's demonstration.
            config: what it was generated with.
            episode: the trajectory's segment.
            there: whether the robot rests at the sampled pose now, having come there like that.

        Returns:
            `success`, `None` of a trajectory that isn't merged; `kind` and `reason` of a failure;
            `seconds`, for how long the robot moved; `segment_mm`, `largest_mm`, `largest_deg`: the
            largest difference of measured tool poses to the record, within the segment and in all,
            `None` where it wasn't executed.
        """
        row: dict[str, Any] = {
            "success": None,
            "kind": None,
            "reason": None,
            "seconds": 0.0,
            "segment_mm": None,
            "largest_mm": None,
            "largest_deg": None,
        }
        self._periods = 0
        try:
            if not there:
                self._go_to_start(planner, config, episode)
            row |= self._followed(planner, episode)
        except (Unreachable, MotionRejected) as error:
            kind = str(error).partition(":")[0]
            success = False if episode.provenance.merged else None
            row |= {"success": success, "kind": kind, "reason": str(error)}
        return row | {"seconds": self._periods / self._backend.rates.control_hz}

    def _go_to_start(
        self, planner: SegmentPlanner, config: AugmentConfig, episode: Episode
    ) -> None:
        """Bring the robot from the restored state of t* to a rest at the sampled pose."""
        p = episode.provenance
        proposal, rng = planner.proposal(p.sphere, p.k)
        stillness = float(p.certificate["body_stillness"]) if p.certificate else BODY_STILLNESS
        motion, _ = planner.plan(proposal, rng, self._backend.tracking_error, stillness)
        self._restore(planner.world.demonstration.states[p.t_star])
        run = SegmentRun(self._backend, planner, p.t_star, config, stillness)
        try:
            run.settle(planner.approach(p.t_star))
            run.go_out(motion, record=False)
            run.rest(motion)
        finally:
            self._periods += run.periods

    def _followed(self, planner: SegmentPlanner, episode: Episode) -> dict[str, Any]:
        """What came of a trajectory's actions from its start on."""
        backend, p = self._backend, episode.provenance
        demonstration, rates = planner.world.demonstration, backend.rates
        suffix = demonstration.steps.measured_Ts_world_tool[episode.suffix(demonstration)]
        recorded = np.concatenate([episode.steps.measured_Ts_world_tool, suffix])
        controller = ToolController(planner.world.kinematics, rates=rates)
        controller.reset(
            episode.steps.commanded_joint_positions[0], episode.steps.commanded_Ts_world_tool[0]
        )
        seen = backend.observe()
        off = [distance(seen.T_world_tool, recorded[0])]
        reached: list[bool] = []
        # A trajectory may be shorter than the goal must be held, and the gripper still on its way
        # at its end. The last action holds still.
        actions, rate, n_moved = episode.actions(demonstration), rates.record_hz, len(recorded) - 1
        held = self._task.steps_held(rate) if p.merged else 0
        actions = np.concatenate([actions[:-1], np.repeat(actions[-1:], held, axis=0)])
        for step, action in enumerate(actions):
            if step >= n_moved and self._task.achieved(np.array(reached), rate):
                break
            desired, gripper = apply_action(controller.commanded_T_world_tool, action)
            for targets in controller.move(desired, seen.T_world_tool, rates.control_per_record):
                sent = backend.command(targets, gripper)
                backend.step()
                self._periods += 1
            controller.acknowledge(sent.q)
            seen = backend.observe()
            if step < n_moved:
                off.append(distance(seen.T_world_tool, recorded[step + 1]))
            reached.append(self._task.success(seen))
        far, turned = np.array(off).T
        row: dict[str, Any] = {
            "segment_mm": round(1e3 * float(far[: len(episode)].max()), 4),
            "largest_mm": round(1e3 * float(far.max()), 4),
            "largest_deg": round(float(np.rad2deg(turned.max())), 4),
        }
        if not p.merged:
            return row
        success = self._task.achieved(np.array(reached), rate)
        row["success"] = success
        if not success:
            row |= {"kind": "goal not reached", "reason": self._task.failure_reason(seen)}
        return row
