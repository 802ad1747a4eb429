"""A backend of one's own: a robot that is wherever it was told to be, without a simulator.

Test: pytest --pyargs sart_toolkit.testing --sart-backend 03_own_backend:KinematicBackend
"""

import numpy as np

import sart_toolkit as sart
from sart_toolkit.backends.interface import Backend, Capabilities, Observation
from sart_toolkit.backends.states import pack_state, scene_digest, unpack_state
from sart_toolkit.data.records import CONTROL_HZ
from sart_toolkit.robots.spec import check_gripper


class KinematicBackend(Backend):
    """Joints are where they were commanded, the gripper moves at its speed, bodies stay."""

    name = "kinematic"
    capabilities = Capabilities(
        can_restore=True, has_contacts=False, renders=False, observes_bodies=True, drift=0.0
    )

    def __init__(self, robot, scene, image_size=128):
        super().__init__(robot, scene, image_size)
        self.model = sart.RobotModel(robot, scene.held)
        self.origin = robot.name, scene_digest(self.model, scene), [b.name for b in scene.bodies]

    def reset(self, state):
        q = self.model.check_limits(state.q)
        self.scene.check_state(state)
        self.command(q, state.commanded_gripper)
        bodies = {name: T.tolist() for name, T in state.Ts_world_body.items()}
        self.now = {"q": q.tolist(), "dq": [0.0] * len(q), "gripper": state.gripper}
        self.now |= {"periods": 0, "bodies": bodies}

    def observe(self, cameras=(), image_size=None):
        self._check_cameras(cameras)
        if cameras:
            raise self._lacks("take pictures")
        q, dq, gripper, periods, bodies = self.now.values()
        model = sart.RobotModel(self.robot, self.scene.held, gripper)
        Ts = {name: np.array(T) for name, T in bodies.items()}
        Ts |= {body.name: model.fk(q, body.name) for body in self.scene.held}
        q, dq, time = np.array(q), np.array(dq), periods / CONTROL_HZ
        return Observation(q, dq, gripper, model.fk(q), time, {}, Ts)

    def command(self, q, gripper):
        self.target = self.model.check_limits(q).tolist(), check_gripper(gripper)

    def step(self):
        q, gripper = self.target
        reach = self.robot.gripper.speed / self.robot.gripper.closed_position / CONTROL_HZ
        self.now["dq"] = [(b - a) * CONTROL_HZ for a, b in zip(self.now["q"], q, strict=True)]
        self.now["q"] = q
        self.now["gripper"] += float(np.clip(gripper - self.now["gripper"], -reach, reach))
        self.now["periods"] += 1

    def save(self):
        head = dict(zip(("robot", "scene", "bodies"), self.origin, strict=True))
        return pack_state(self.name, head | {"now": self.now, "target": self.target}, b"")

    def restore(self, state):
        head, _ = unpack_state(self.name, state, *self.origin)
        self.now, self.target = head["now"], head["target"]

    def contacts(self):
        raise self._lacks("tell what touches")

    def close(self):
        pass


if __name__ == "__main__":
    task = sart.get_task("peg_in_hole")
    backend = KinematicBackend(sart.get_robot(task.robot), task.scene)
    backend.reset(task.initial_state(backend.model, sart.Placement()))
    backend.command(np.array(backend.now["q"]) + 0.01, 1.0)
    backend.step()
    print("the tool is at", backend.observe().T_world_tool[:3, 3].round(3), "m")
