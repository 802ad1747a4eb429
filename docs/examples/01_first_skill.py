"""From one demonstration to an evaluated skill, in Python.

Run: python docs/examples/01_first_skill.py OUT_DIR [N_TRAJECTORIES EPOCHS ROLLOUTS]
"""

import sys
from functools import partial
from pathlib import Path

import numpy as np

import sart_toolkit as sart


def main(out: Path, n: int = 40, epochs: int = 60, rollouts: int = 20) -> None:
    task = sart.get_task("peg_in_hole")
    robot = sart.get_robot(task.robot)
    make_backend = partial(sart.make_backend, "pybullet", robot, task.scene)
    model = sart.RobotModel(robot, task.scene.held)

    # One demonstration, here by the scripted operator in a person's place.
    plan = task.plan(task.initial_state(model, sart.Placement()))
    operator = sart.ScriptedOperator(plan, np.random.default_rng(0))
    demo = sart.record_demonstration(make_backend(), task, model, operator)

    # How far the tool may stray, from the scene's geometry; then the robot explores by itself.
    world = sart.ExactWorld(demo, robot, task.scene)
    annotation = sart.suggest_annotation(demo, world)
    dataset = sart.augment_demonstration(
        demo, annotation, make_backend, out / "dataset", sart.AugmentConfig(n=n), task=task
    )

    # A policy on the wrist camera, and what it is worth at placements it has not seen.
    config = sart.TrainConfig.for_policy("compact_mlp", epochs=epochs)
    sart.save_skill(out / "skill", sart.train(dataset, config, out / "skill"), dataset)
    result = sart.evaluate_skill(
        out / "skill", task, make_backend, sart.EvaluateConfig(episodes=rollouts)
    )
    print(f"{result['n_success']} of {result['n_episodes']} succeeded")


if __name__ == "__main__":
    main(Path(sys.argv[1]), *map(int, sys.argv[2:]))
