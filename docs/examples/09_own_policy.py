"""A policy of your own: it sees the mean colours of 8 x 8 cells of each image.

In Python: python docs/examples/09_own_policy.py OUT_DIR [N_TRAJECTORIES EPOCHS ROLLOUTS]
By verbs:  sart train dataset --out skill --policy docs/examples/09_own_policy.py:PooledMLP
"""

import sys
from pathlib import Path

from torch import nn

import sart_toolkit as sart


class Pooled(sart.Encoder):
    """The mean colours of 8 x 8 cells."""

    def __init__(self, image_size, norm):
        super().__init__(image_size, norm)
        self.feature_size = 3 * 8 * 8
        self.pool = nn.AdaptiveAvgPool2d(8)

    def forward(self, images):
        return self.pool(images).flatten(1)


class PooledMLP(sart.MLPPolicy):
    """The head of our own policies over these colours."""

    encoder = Pooled


def main(out: Path, n: int = 40, epochs: int = 60, rollouts: int = 20) -> None:
    options = {"n": n, "epochs": epochs, "episodes": rollouts}
    result = sart.run("peg_in_hole", out, policy=PooledMLP, **options)
    print(f"{result['success']} succeeded; the page: {result['report']}")


if __name__ == "__main__":
    main(Path(sys.argv[1]), *map(int, sys.argv[2:]))
