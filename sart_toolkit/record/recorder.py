"""Collects what a robot measures and is commanded, step by step, into `Steps`."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from sart_toolkit.backends.interface import Backend, Observation
from sart_toolkit.data.records import CameraFrame, CameraRecord, Steps
from sart_toolkit.errors import InvalidInput
from sart_toolkit.motion.controller import ToolController
from sart_toolkit.poses import Array, inverse
from sart_toolkit.robots.model import RobotModel


class StepRecorder:
    """Records one row each time `add` is called; `steps` gives them as a record.

    Attributes:
        observations: what was measured, a row each.
    """

    def __init__(self, backend: Backend, model: RobotModel, cameras: Sequence[str]) -> None:
        """Record `backend` with the named cameras' images.

        Args:
            backend: the robot.
            model: its kinematics, which say what each camera is mounted on.
            cameras: names of cameras that move with the tool or stand still.

        Raises:
            UnknownName: there is no such camera.
            MissingCapability: the backend takes no images.
            InvalidInput: a camera is mounted on a part of the arm before the tool.
        """
        backend.check_cameras(cameras)
        self._backend = backend
        self._frames: dict[str, CameraFrame] = {}
        for name in cameras:
            frame = model.mount_of(backend.cameras[name].frame)
            if frame is None:
                raise InvalidInput(
                    f"camera {name!r}: its frame {backend.cameras[name].frame!r} neither moves "
                    "with the tool nor stands still; record another camera"
                )
            self._frames[name] = frame
        self.observations: list[Observation] = []
        self._commanded_q: list[Array] = []
        self._commanded_T: list[Array] = []
        self._commanded_gripper: list[float] = []
        self._force: list[float] = []

    def add(self, controller: ToolController, gripper: float, force: float) -> Observation:
        """Measure and keep it, with the command in force and the contact force until now [N]."""
        observation = self._backend.observe(tuple(self._frames))
        self.observations.append(observation)
        self._commanded_q.append(controller.commanded_q)
        self._commanded_T.append(controller.commanded_T_world_tool)
        self._commanded_gripper.append(gripper)
        self._force.append(force)
        return observation

    def steps(self, backwards: bool = False) -> Steps:
        """The rows recorded, in their order or as if time had run backwards.

        Backwards, joints move the opposite way, so that their velocities change sign. A row's
        contact force is that of the step before it, so each belongs to the row before; the first
        row, before which there is no step, has none, or NaN where the backend can't tell.
        """
        order = slice(None, None, -1 if backwards else 1)
        rows = self.observations[order]
        joint_velocities = np.stack([row.dq for row in rows])
        force = np.array(self._force)
        if backwards:
            joint_velocities = -joint_velocities
            unknown = bool(np.isnan(force).all())
            force = np.append(np.nan if unknown else 0.0, force[:0:-1])
        spec = self._backend.cameras
        cameras = {}
        for name, frame in self._frames.items():
            T_world_frame = rows[0].T_world_tool if frame == "tool" else np.eye(4)
            cameras[name] = CameraRecord(
                rgb=np.stack([row.cameras[name].rgb for row in rows]),
                depth=np.stack([row.cameras[name].depth for row in rows]),
                intrinsics=spec[name].intrinsics(*self._backend.image_size),
                frame=frame,
                T_frame_camera=inverse(T_world_frame) @ rows[0].cameras[name].T_world_camera,
            )
        return Steps(
            joint_positions=np.stack([row.q for row in rows]),
            joint_velocities=joint_velocities,
            commanded_joint_positions=np.stack(self._commanded_q[order]),
            measured_Ts_world_tool=np.stack([row.T_world_tool for row in rows]),
            commanded_Ts_world_tool=np.stack(self._commanded_T[order]),
            measured_gripper=np.array([row.gripper for row in rows]),
            commanded_gripper=np.array(self._commanded_gripper[order]),
            contact_force=force,
            cameras=cameras,
        )
