"""A strategy of your own: poses anywhere inside a sphere instead of on its surface.

In Python: python docs/examples/06_own_strategy.py OUT_DIR [N_TRAJECTORIES EPOCHS ROLLOUTS]
By verbs:  sart augment demo.h5 annotation.json --out dataset
           --strategy docs/examples/06_own_strategy.py:INSIDE
"""

import sys
from pathlib import Path

import numpy as np

import sart_toolkit as sart


class Inside(sart.Strategy):
    """Uniform in the ball: p = c + r u^(1/3) d, u ~ U[0, 1], d the direction that SART draws."""

    def propose(self, demonstration, sphere, rng, config):
        T = sart.sample_pose(sphere, rng, config).copy()
        centre = sphere.T_world_key[:3, 3]
        T[:3, 3] = centre + np.cbrt(rng.uniform()) * (T[:3, 3] - centre)
        return sart.Proposal(sart.convergence_waypoint(demonstration, sphere), T)


INSIDE = Inside()


def main(out: Path, n: int = 40, epochs: int = 60, rollouts: int = 20) -> None:
    result = sart.run("peg_in_hole", out, strategy=INSIDE, n=n, epochs=epochs, episodes=rollouts)
    print(f"{result['success']} succeeded; the page: {result['report']}")


if __name__ == "__main__":
    main(Path(sys.argv[1]), *map(int, sys.argv[2:]))
