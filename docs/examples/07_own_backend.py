"""A backend of your own: an arm that is wherever it was commanded to be, drawn by PyBullet.

In Python: python docs/examples/07_own_backend.py OUT_DIR [N_TRAJECTORIES EPOCHS ROLLOUTS]
By verbs:  sart run peg_in_hole --backend docs/examples/07_own_backend.py:Kinematic --out OUT_DIR
Test:      pytest --pyargs sart_toolkit.testing --sart-backend 07_own_backend:Kinematic
"""

import sys
from pathlib import Path

import numpy as np

import sart_toolkit as sart


class Kinematic(sart.Backend, sart.Resets, sart.SavesStates, sart.KnowsBodies, sart.Draws):
    """No physics: bodies stay where a reset puts them."""

    name = "kinematic"

    def __init__(self, robot, scene, *options):
        super().__init__(robot, scene, *options)
        self.model = sart.RobotModel(robot, scene.held)
        self.eye = sart.make_backend("pybullet", robot, scene)
        self.of = robot.name, sart.scene_digest(self.model, scene), [b.name for b in scene.bodies]
        self.reset(scene.initial_state(robot.home, 0.0))

    def reset(self, state):
        self.scene.check_state(state)
        q = self.model.check_limits(state.q).tolist()
        bodies = {name: T.tolist() for name, T in state.Ts_world_body.items()}
        self.now = {"q": q, "dq": [0.0] * len(q), "gripper": state.gripper, "periods": 0}
        self.now |= {"bodies": bodies, "target": [q, state.commanded_gripper]}

    def observe(self, cameras=(), image_size=None):
        self.check_cameras(cameras)
        q, dq, gripper = (np.array(self.now[name]) for name in ("q", "dq", "gripper"))
        time, Ts = self.now["periods"] / self.rates.control_hz, self.body_poses()
        state = self.scene.seen_state(q, gripper, Ts)
        size = sart.check_image_size(self.image_size if image_size is None else image_size)
        views = {name: self.draw(state, self.cameras[name], *size) for name in cameras}
        return sart.Observation(q, dq, float(gripper), self.model.fk(q), time, views, Ts)

    def command(self, q, gripper):
        q = np.atleast_2d(self.model.check_limits(q))[-1]
        self.now["target"] = [q.tolist(), sart.check_gripper(gripper)]
        return sart.CommandSent(q, gripper)

    def step(self):
        (q, gripper), was, hz = self.now["target"], self.now["gripper"], self.rates.control_hz
        reach = self.robot.gripper.speed / self.robot.gripper.closed_position / hz
        self.now["dq"] = [(b - a) * hz for a, b in zip(self.now["q"], q, strict=True)]
        self.now |= {"q": q, "gripper": was + float(np.clip(gripper - was, -reach, reach))}
        self.now["periods"] += 1

    def body_poses(self):
        model = sart.RobotModel(self.robot, self.scene.held, self.now["gripper"])
        held = {body.name: model.fk(self.now["q"], body.name) for body in self.scene.held}
        return {name: np.array(T) for name, T in self.now["bodies"].items()} | held

    def draw(self, state, camera, width, height):
        return self.eye.draw(state, camera, width, height)

    def save(self):
        head = dict(zip(("robot", "scene", "bodies"), self.of, strict=True)) | {"now": self.now}
        return sart.pack_state(self.name, head, b"")

    def restore(self, state):
        self.now = sart.unpack_state(self.name, state, *self.of)[0]["now"]

    def close(self):
        self.eye.close()


if __name__ == "__main__":
    n, epochs, rollouts = map(int, sys.argv[2:] or (40, 60, 20))
    options = {"n": n, "epochs": epochs, "episodes": rollouts}
    result = sart.run("peg_in_hole", Path(sys.argv[1]), backend=Kinematic, **options)
    print(f"{result['success']} succeeded; the page: {result['report']}")
