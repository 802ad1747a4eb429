"""Collects what a robot measures and is commanded, step by step, into `Steps`."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from sart_toolkit.backends.interface import Backend, Observation
from sart_toolkit.data.records import CameraRecord, Steps
from sart_toolkit.motion.controller import ToolController
from sart_toolkit.poses import Array, inverse


class StepRecorder:
    """Records one row each time `add` is called; `steps` gives them as a record.

    Attributes:
        observations: what was measured, a row each.
    """

    def __init__(self, backend: Backend, cameras: Sequence[str]) -> None:
        """Record `backend` with the named cameras' pictures."""
        self._backend = backend
        self._cameras = tuple(cameras)
        self.observations: list[Observation] = []
        self._commanded_q: list[Array] = []
        self._commanded_T: list[Array] = []
        self._commanded_gripper: list[float] = []
        self._force: list[float] = []

    def add(self, controller: ToolController, gripper: float, force: float) -> Observation:
        """Measure and keep it, with the command in force and the contact force until now [N]."""
        observation = self._backend.observe(self._cameras)
        self.observations.append(observation)
        self._commanded_q.append(controller.commanded_q)
        self._commanded_T.append(controller.commanded_T_world_tool)
        self._commanded_gripper.append(gripper)
        self._force.append(force)
        return observation

    def steps(self, order: slice = slice(None)) -> Steps:
        """The rows recorded, or some of them in the order of a slice (reversed, for instance)."""
        rows = self.observations[order]
        spec = self._backend.cameras
        size = self._backend.image_size
        T_world_tool = rows[0].T_world_tool
        cameras = {}
        for name in self._cameras:
            T_world_camera = rows[0].cameras[name].T_world_camera
            cameras[name] = CameraRecord(
                rgb=np.stack([row.cameras[name].rgb for row in rows]),
                depth=np.stack([row.cameras[name].depth for row in rows]),
                intrinsics=spec[name].intrinsics(size, size),
                T_tool_camera=inverse(T_world_tool) @ T_world_camera,
            )
        return Steps(
            joint_positions=np.stack([row.q for row in rows]),
            joint_velocities=np.stack([row.dq for row in rows]),
            commanded_joint_positions=np.stack(self._commanded_q[order]),
            measured_Ts_world_tool=np.stack([row.T_world_tool for row in rows]),
            commanded_Ts_world_tool=np.stack(self._commanded_T[order]),
            measured_gripper=np.array([row.gripper for row in rows]),
            commanded_gripper=np.array(self._commanded_gripper[order]),
            contact_force=np.array(self._force[order]),
            cameras=cameras,
        )
