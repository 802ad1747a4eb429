"""A strategy of your own: poses on the upper half of a sphere only.

In Python: python docs/examples/06_own_strategy.py OUT_DIR [N_TRAJECTORIES EPOCHS ROLLOUTS]
By verbs:  sart augment demo.h5 annotation.json --out dataset
           --strategy docs/examples/06_own_strategy.py:ABOVE
"""

import sys
from pathlib import Path

import sart_toolkit as sart


class Above(sart.Strategy):
    """Where the paper's strategy draws a position below the centre, its mirror image above it."""

    def propose(self, demonstration, spheres, i, rng, config):
        sphere = spheres[i]
        T = sart.sample_pose(sphere, rng, config).copy()
        centre = sphere.T_world_key[2, 3]
        T[2, 3] = centre + abs(T[2, 3] - centre)
        return sart.Proposal(sart.convergence_waypoint(demonstration, sphere), T)


ABOVE = Above()


def main(out: Path, n: int = 40, epochs: int = 60, rollouts: int = 20) -> None:
    result = sart.run("peg_in_hole", out, strategy=ABOVE, n=n, epochs=epochs, episodes=rollouts)
    print(f"{result['success']} succeeded; the page: {result['report']}")


if __name__ == "__main__":
    main(Path(sys.argv[1]), *map(int, sys.argv[2:]))
