"""Load a trained skill and let it act once, on the robot and task that it notes.

Run: python docs/examples/02_run_a_skill.py SKILL_DIR
"""

import sys
from pathlib import Path

import sart_toolkit as sart


def main(directory: Path) -> None:
    def watch(seen: sart.Observation, step: int, success: bool) -> None:
        if success or step % 10 == 0:
            print(f"{seen.time:4.1f} s  {'goal reached' if success else 'under way'}")

    rollout = sart.run_skill(directory, seed=7, watch=watch)
    print("succeeded" if rollout.success else f"failed: {rollout.reason}")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
