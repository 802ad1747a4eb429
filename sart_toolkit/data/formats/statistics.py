"""Statistics of features as readers normalise by them, computed in one pass and bounded memory."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from sart_toolkit.poses import Array

QUANTILES = {"q01": 0.01, "q10": 0.1, "q50": 0.5, "q90": 0.9, "q99": 0.99}
STATISTICS = ("min", "max", "mean", "std", "count", *QUANTILES)
# So many rows are kept for the quantiles; they are exact up to there.
_MOST_ROWS = 2**16


class RowStatistics:
    """Minimum, maximum, mean, standard deviation and quantiles of each column of rows `(n, k)`.

    Quantiles are exact up to 65,536 rows; of more, those of every 2nd, 4th, ... row.
    """

    def __init__(self) -> None:
        self._count, self._stride = 0, 1
        self._sum: Any = 0.0
        self._squares: Any = 0.0
        self._min: Any = np.inf
        self._max: Any = -np.inf
        # Sums of what is left after this: squares of large numbers would lose the digits.
        self._shift: Array | None = None
        self._rows: list[Array] = []
        self._kept = 0

    def add(self, rows: NDArray[Any]) -> None:
        """Take in rows `(n, k)`, at least one."""
        rows = np.asarray(rows, dtype=np.float64)
        if self._shift is None:
            self._shift = rows[0].copy()
        moved = rows - self._shift
        self._sum = self._sum + moved.sum(0)
        self._squares = self._squares + (moved**2).sum(0)
        self._min, self._max = (
            np.minimum(self._min, rows.min(0)),
            np.maximum(self._max, rows.max(0)),
        )
        chosen = rows[-self._count % self._stride :: self._stride]
        self._count += len(rows)
        self._rows.append(chosen)
        self._kept += len(chosen)
        while self._kept > _MOST_ROWS:
            # Row number j of those kept is row j * stride of all.
            self._rows = [np.concatenate(self._rows)[::2]]
            self._kept, self._stride = len(self._rows[0]), 2 * self._stride

    def result(self) -> dict[str, Array]:
        """Each statistic `(k,)` by name; `count (1,)`."""
        assert self._shift is not None
        mean = self._sum / self._count
        variance = np.maximum(self._squares / self._count - mean**2, 0.0)
        quantiles = np.quantile(np.concatenate(self._rows), list(QUANTILES.values()), axis=0)
        return {
            "min": self._min,
            "max": self._max,
            "mean": mean + self._shift,
            "std": np.sqrt(variance),
            "count": np.array([self._count]),
            **dict(zip(QUANTILES, quantiles, strict=True)),
        }


class LevelStatistics:
    """The same of all pixels of images, exactly: how often each of a few levels occurs is counted.

    `values (levels,)`: what each level stands for. Results have the shape `(channels, 1, 1)`;
    `count` is the number of images.
    """

    def __init__(self, values: Array, channels: int) -> None:
        self._values = values
        self._counts = np.zeros((channels, len(values)), dtype=np.int64)
        self._images = 0

    def add(self, images: NDArray[Any]) -> None:
        """Take in images `(n, H, W, channels)` of levels."""
        for channel, counts in enumerate(self._counts):
            levels = images[..., channel].reshape(-1)
            counts += np.bincount(levels, minlength=len(counts))
        self._images += len(images)

    def merge(self, other: LevelStatistics) -> None:
        """Take in what another has."""
        self._counts += other._counts
        self._images += other._images

    def result(self) -> dict[str, Array]:
        """Each statistic `(channels, 1, 1)` by name; `count (1,)`."""
        values, counts = self._values, self._counts
        total = counts.sum(1)
        mean = counts @ values / total
        variance = np.maximum(counts @ values**2 / total - mean**2, 0.0)
        seen = counts > 0
        below = np.cumsum(counts, axis=1)
        found = {
            "min": values[seen.argmax(1)],
            "max": values[len(values) - 1 - seen[:, ::-1].argmax(1)],
            "mean": mean,
            "std": np.sqrt(variance),
        } | {
            name: values[(below >= np.ceil(q * total)[:, None]).argmax(1)]
            for name, q in QUANTILES.items()
        }
        result = {name: value.reshape(-1, 1, 1) for name, value in found.items()}
        return result | {"count": np.array([self._images])}
