"""Load a trained skill and let it act once, step by step.

Run: python docs/examples/02_run_a_skill.py SKILL_DIR
"""

import sys
from pathlib import Path

import numpy as np

import sart_toolkit as sart
from sart_toolkit.backends.interface import Observation
from sart_toolkit.evaluate.rollout import run_rollout


def main(directory: Path) -> None:
    skill = sart.load_skill(directory)
    task = sart.get_task(skill.config.task)
    backend = sart.make_backend("pybullet", sart.get_robot(skill.config.robot), task.scene)
    placement = task.sample_placement(np.random.default_rng(7))
    model = sart.RobotModel(backend.robot, task.scene.held)
    hz = skill.demonstration.rates.record_hz

    def watch(seen: Observation, step: int, success: bool) -> None:
        if success or step % 10 == 0:
            print(f"{step / hz:4.1f} s  {'goal reached' if success else 'under way'}")

    rollout = run_rollout(skill, task, backend, model, placement, watch=watch)
    print("succeeded" if rollout.success else f"failed: {rollout.reason}")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
