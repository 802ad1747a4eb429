"""A demonstration steered once more by its own commands, on this simulator or another."""

from __future__ import annotations

import numpy as np

from sart_toolkit.backends.interface import Backend, Observation
from sart_toolkit.data.records import Demonstration
from sart_toolkit.errors import Mismatch
from sart_toolkit.poses import distance
from sart_toolkit.record.session import Device, SessionConfig, TeleopCommand, record_demonstration
from sart_toolkit.robots.model import RobotModel
from sart_toolkit.scenes.spec import SceneSpec
from sart_toolkit.tasks.task import Placement, Task


class ReplayDevice(Device):
    """Gives the commands of a demonstration again, whatever the robot measures."""

    name = "replay"

    def __init__(self, demonstration: Demonstration) -> None:
        """Replay `demonstration` from its start."""
        self.operator = demonstration.operator
        self._commands = iter(demonstration.raw_commands)
        self._gripper = float(demonstration.steps.commanded_gripper[0])

    def read(self, observation: Observation) -> TeleopCommand:
        row = next(self._commands, None)
        if row is None:
            return TeleopCommand(np.zeros(6), self._gripper, stop=True)
        self._gripper = float(row[6])
        return TeleopCommand(row[:6], self._gripper)


def replay_demonstration(
    demonstration: Demonstration,
    backend: Backend,
    task: Task,
    model: RobotModel,
    config: SessionConfig | None = None,
) -> Demonstration:
    """The result of a demonstration's commands on a backend, the object placed as it was.

    Args:
        demonstration: what is replayed.
        backend: a robot in the task's scene.
        task: what was demonstrated.
        model: the robot's kinematics.
        config: cameras and limits.

    Raises:
        Mismatch: the demonstration is of another task or robot, or at other rates.
    """
    for what, was, now in (
        ("task", demonstration.task, task.name),
        ("robot", demonstration.robot, model.spec.name),
        ("control rate", demonstration.rates.control_hz, backend.rates.control_hz),
    ):
        if was != now:
            raise Mismatch(f"replay: the demonstration is of {what} {was!r}, not {now!r}")
    placement = Placement.from_json(demonstration.task_parameters["placement"])
    device = ReplayDevice(demonstration)
    return record_demonstration(backend, task, model, device, placement, config=config)


def tracking_difference(
    a: Demonstration, b: Demonstration, scene: SceneSpec, finger_links: tuple[str, ...]
) -> tuple[float, float, int]:
    """How far the measured tool poses of two runs are apart, at most: [m], [rad], steps compared.

    Steps at which the robot, or what it has grasped, touches anything else in either run are left
    out: there the simulators' contacts differ, not their tracking.

    Args:
        a, b: the runs; the longer one's last steps are left out.
        scene: the task's scene.
        finger_links: the gripper's.
    """
    worst = np.zeros(2)
    compared = 0
    poses = (a.steps.measured_Ts_world_tool, b.steps.measured_Ts_world_tool)
    for t in range(min(len(a), len(b))):
        if not any(
            scene.outer_contacts(run.touching[t], scene.grasped(run.touching[t], finger_links))
            for run in (a, b)
        ):
            worst = np.maximum(worst, distance(poses[0][t], poses[1][t]))
            compared += 1
    return float(worst[0]), float(worst[1]), compared
