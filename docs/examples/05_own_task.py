"""A task of your own: push an open drawer shut with closed fingers.

In Python: python docs/examples/05_own_task.py OUT_DIR [N_TRAJECTORIES EPOCHS ROLLOUTS]
By verbs:  sart run docs/examples/05_own_task.py:Drawer --out OUT_DIR
"""

import sys
from pathlib import Path

import numpy as np

import sart_toolkit as sart

OPEN, DEPTH, WIDTH, HEIGHT = 0.08, 0.12, 0.14, 0.06
WALL = 0.008
WOOD, ORANGE = (0.45, 0.30, 0.18, 1.0), (0.93, 0.50, 0.10, 1.0)
MIDDLE = sart.pose([0.62, 0.0, 0.0])
# Towards the robot is -x: the tool's z points down, the camera is on the robot's side.
DOWN = np.pi * np.array([1.0, -1.0, 0.0]) / np.sqrt(2)


def box(size, centre, rgba):
    return sart.Shape("box", size, sart.pose(centre), rgba)


class Drawer(sart.Task):
    """Push a drawer, 8 cm open, shut: success where less than 5 mm are left."""

    name = "drawer"
    robot = "ur5e_2f85"
    placement_range = 0.05
    horizon = 15.0
    report_body = "cabinet"
    table = sart.Body("table", (box((2.4, 2.4, 0.1), [0.5, 0, -0.05], (0.55, 0.50, 0.44, 1)),))
    cabinet = sart.Body(
        "cabinet",
        (
            box((DEPTH, WALL, HEIGHT), [0, WIDTH / 2, HEIGHT / 2], WOOD),
            box((DEPTH, WALL, HEIGHT), [0, -WIDTH / 2, HEIGHT / 2], WOOD),
            box((DEPTH, WIDTH + WALL, WALL), [0, 0, HEIGHT + WALL], WOOD),
        ),
    )
    slide = sart.Joint(
        "cabinet", sart.pose([0, 0, 0.002]), np.array([-1.0, 0, 0]), 0.0, 0.10, "prismatic", 0.5
    )
    front = box((WALL, WIDTH - 0.02, HEIGHT - 0.01), [-DEPTH / 2, 0, HEIGHT / 2 - 0.002], ORANGE)
    tray = box((DEPTH - WALL, WIDTH - 0.02, WALL), [0, 0, WALL / 2], ORANGE)
    drawer = sart.Body("drawer", (front, tray), mass=0.3, joint=slide)
    camera = sart.CameraSpec(
        "overview", "world", sart.look_at([1.1, -0.6, 0.5], [0.5, 0.0, 0.1], [0, 0, 1]), 40.0
    )
    scene = sart.SceneSpec((table, cabinet, drawer), cameras=(camera,))

    def initial_state(self, model, placement):
        q = model.ik(sart.pose([0.42, 0.0, 0.20], DOWN), model.spec.home)
        bodies = {"cabinet": MIDDLE @ placement.T_middle_object}
        return self.scene.initial_state(q, 1.0, bodies, {"drawer": OPEN})

    def success(self, observation):
        return self.scene.joint_position("drawer", observation.Ts_world_body) < 0.005

    def failure_reason(self, observation):
        left = self.scene.joint_position("drawer", observation.Ts_world_body)
        return f"the drawer is {left * 1e3:.0f} mm open"

    def plan(self, state):
        cabinet = state.Ts_world_body["cabinet"]
        return [
            sart.PlanStep(cabinet @ sart.pose([x, 0.0, 0.035], DOWN), 1.0, speed, pause=pause)
            for x, speed, pause in ((-0.19, 0.08, 0.0), (-0.076, 0.04, 0.5))
        ]


def main(out: Path, n: int = 40, epochs: int = 60, rollouts: int = 20) -> None:
    result = sart.run(Drawer(), out, n=n, epochs=epochs, episodes=rollouts)
    print(f"{result['success']} succeeded; the page: {result['report']}")


if __name__ == "__main__":
    main(Path(sys.argv[1]), *map(int, sys.argv[2:]))
