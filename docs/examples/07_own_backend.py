"""A backend of one's own: an arm that is wherever it was told to be, and a scene around it.

Test: pytest --pyargs sart_toolkit.testing --sart-backend 07_own_backend:KinematicBackend
"""

import numpy as np

import sart_toolkit as sart
from sart_toolkit.backends import interface as api
from sart_toolkit.backends.states import pack_state, scene_digest, unpack_state
from sart_toolkit.robots.spec import check_gripper


class KinematicArm(api.Backend):
    """The core, as a hardware arm has it: observe, command, step, close."""

    name, no_pictures = "kinematic", "it has no cameras"

    def __init__(self, robot, scene, *options):
        super().__init__(robot, scene, *options)
        self.model = sart.RobotModel(robot, scene.held)
        self.digest = scene_digest(self.model, scene)
        self.place(robot.home, 0.0, 0.0)

    def place(self, q, gripper, gripper_target):
        q = self.model.check_limits(q).tolist()
        self.now = {"q": q, "dq": [0.0] * len(q), "gripper": gripper, "periods": 0}
        self.now["target"] = [q, gripper_target]

    def observe(self, cameras=(), image_size=None):
        self.check_cameras(cameras)
        q, dq, gripper = (np.array(self.now[name]) for name in ("q", "dq", "gripper"))
        time = self.now["periods"] / self.rates.control_hz
        bodies = self.body_poses() if isinstance(self, api.KnowsBodies) else {}
        return api.Observation(q, dq, float(gripper), self.model.fk(q), time, {}, bodies)

    def command(self, q, gripper):
        self.now["target"] = [self.model.check_limits(q).tolist(), check_gripper(gripper)]
        return api.CommandSent(q, gripper)

    def step(self):
        (q, gripper), was, hz = self.now["target"], self.now["gripper"], self.rates.control_hz
        reach = self.robot.gripper.speed / self.robot.gripper.closed_position / hz
        self.now["dq"] = [(b - a) * hz for a, b in zip(self.now["q"], q, strict=True)]
        self.now |= {"q": q, "gripper": was + float(np.clip(gripper - was, -reach, reach))}
        self.now["periods"] += 1

    def close(self):
        pass


class KinematicBackend(KinematicArm, api.Resets, api.SavesStates, api.KnowsBodies):
    """Three abilities more; bodies stay where a reset puts them."""

    def reset(self, state):
        self.scene.check_state(state)
        self.place(state.q, state.gripper, state.commanded_gripper)
        self.now["bodies"] = {name: T.tolist() for name, T in state.Ts_world_body.items()}

    def body_poses(self):
        model = sart.RobotModel(self.robot, self.scene.held, self.now["gripper"])
        held = {body.name: model.fk(self.now["q"], body.name) for body in self.scene.held}
        return {name: np.array(T) for name, T in self.now.get("bodies", {}).items()} | held

    def save(self):
        head = {"robot": self.robot.name, "scene": self.digest, "bodies": []}
        return pack_state(self.name, head | {"now": self.now}, b"")

    def restore(self, state):
        head, _ = unpack_state(self.name, state, self.robot.name, self.digest, [])
        self.now = head["now"]


if __name__ == "__main__":
    arm = KinematicArm(sart.get_robot("ur5e_2f85"), sart.get_task("peg_in_hole").scene)
    arm.command(arm.observe().q + 0.01, 1.0)
    arm.step()
    print("the tool is at", arm.observe().T_world_tool[:3, 3].round(3), "m")
