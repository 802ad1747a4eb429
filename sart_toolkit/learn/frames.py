"""Training images in a file that is mapped into memory, so that they needn't fit there."""

from __future__ import annotations

import mmap
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from sart_toolkit.data.records import Image, Steps

# Mapped pages count as this process's memory until they are let go, which costs a millisecond.
_MAPPED_AT_MOST = 512 * 2**20
# The kernel maps up to this much around each page that is touched [bytes].
_FAULT_AROUND = 64 * 2**10


def input_size(recorded: tuple[int, int], image_size: int) -> tuple[int, int]:
    """`(height, width)` [pixels] of the images that a policy sees.

    `image_size` is the height; the width keeps the recorded proportions.

    Args:
        recorded: `(height, width)` [pixels].
        image_size: new height [pixels].
    """
    height, width = recorded
    return image_size, max(1, round(image_size * width / height))


def resize_area(rgb: Image, size: tuple[int, int]) -> Image:
    """The image uint8 `(*size, 3)`, each pixel the mean of the area it covers.

    Computed in whole numbers up to the last division, hence the same to the bit everywhere, and
    without BLAS, whose threads would cost far more than so small a product.

    Args:
        rgb: uint8 `(H, W, 3)`, of any height and width.
        size: new height and width [pixels].
    """
    height, width = rgb.shape[:2]
    new_height, new_width = size
    if (height, width) == (new_height, new_width):
        return rgb
    rows = _area_sums(rgb.reshape(height, -1), new_height).reshape(new_height, width, 3)
    columns = _area_sums(rows.swapaxes(0, 1).reshape(width, -1), new_width)
    columns = columns.reshape(new_width, new_height, 3)
    return np.rint(columns.swapaxes(0, 1) / (height * width)).astype(np.uint8)


def _area_sums(x: NDArray[Any], size: int) -> NDArray[np.int64]:
    """Sums `(size, m)` of `x (n, m)` over `size` equal parts of its rows; a row counts `size`."""
    n = len(x)
    if n % size == 0:
        # Usual, and five times as quick.
        return size * x.reshape(size, n // size, -1).sum(1, dtype=np.int64)
    before = np.zeros((n + 1, x.shape[1]), np.int64)
    np.cumsum(x, axis=0, out=before[1:])
    whole, part = np.divmod(np.arange(size + 1) * n, size)
    up_to_edge = size * before[whole] + part[:, None] * x[np.minimum(whole, n - 1)]
    return np.diff(up_to_edge, axis=0)


@dataclass(frozen=True)
class FrameLayout:
    """How a file holds one step: each camera's image, with its edge repeated around it.

    `sizes` gives the images' `(height, width)` [pixels] by camera, in the file's order; `pad` how
    often the edge is repeated on every side.
    """

    sizes: Mapping[str, tuple[int, int]]
    pad: int = 0

    def padded(self, camera: str) -> tuple[int, int, int]:
        """Shape of a camera's image with its edge."""
        height, width = self.sizes[camera]
        return height + 2 * self.pad, width + 2 * self.pad, 3

    @property
    def frame_bytes(self) -> int:
        """Bytes of one step."""
        return sum(int(np.prod(self.padded(camera))) for camera in self.sizes)

    def pack(self, steps: Steps) -> Image:
        """What the file holds of recorded steps: uint8 `(T, frame_bytes)`."""
        edge = (self.pad, self.pad)
        packed = []
        for camera, size in self.sizes.items():
            images = np.stack([resize_area(rgb, size) for rgb in steps.cameras[camera].rgb])
            padded = np.pad(images, ((0, 0), edge, edge, (0, 0)), mode="edge")
            packed.append(padded.reshape(len(images), -1))
        return np.concatenate(packed, axis=1)


class Frames:
    """The images of every step by camera, wherever they lie.

    Attributes:
        images: uint8 `(F, H + 2 pad, W + 2 pad, 3)` by camera.
        layout: their sizes.
    """

    def __init__(
        self, images: Mapping[str, Tensor], layout: FrameLayout, mapped: mmap.mmap | None = None
    ) -> None:
        self.images = images
        self.layout = layout
        self._mapped = mapped
        self._gathered = 0

    @classmethod
    def in_file(cls, path: Path, layout: FrameLayout) -> Frames:
        """The frames in a file of packed steps, read from it as they are asked for."""
        # Torch knows no read-only tensors, hence "+"; nothing writes to them.
        with open(path, "r+b") as file:
            mapped = mmap.mmap(file.fileno(), 0)
        # Steps are drawn at random: what follows one on the disk isn't worth reading.
        mapped.madvise(mmap.MADV_RANDOM)
        rows = torch.from_numpy(np.frombuffer(mapped, np.uint8)).view(-1, layout.frame_bytes)
        ends = np.cumsum([np.prod(layout.padded(camera)) for camera in layout.sizes])[:-1]
        parts = rows.tensor_split(ends.tolist(), dim=1)
        images = {
            camera: part.unflatten(1, layout.padded(camera))
            for camera, part in zip(layout.sizes, parts, strict=True)
        }
        return cls(images, layout, mapped)

    def to(self, device: torch.device) -> Frames:
        """All of them in the memory of a device."""
        return Frames({k: v.to(device, copy=True) for k, v in self.images.items()}, self.layout)

    def gather(self, at: Tensor, offsets: Tensor | None = None) -> dict[str, Tensor]:
        """Images uint8 `(M, 3, H, W)` by camera, channels-last in memory.

        Args:
            at: which steps, int64 `(M,)`.
            offsets: row and column, int64 `(M, 2)` in 0..2 pad, at which each is cut from the
                padded one. In the middle when left out.
        """
        images = {camera: self._gather(camera, at, offsets) for camera in self.images}
        self._gathered += at.numel() * (self.layout.frame_bytes + 2 * _FAULT_AROUND)
        if self._gathered > _MAPPED_AT_MOST:
            self.let_go()
        return images

    def _gather(self, camera: str, at: Tensor, offsets: Tensor | None) -> Tensor:
        images, pad = self.images[camera], self.layout.pad
        height, width = self.layout.sizes[camera]
        if pad == 0:
            cut = images.index_select(0, at)
        elif offsets is None:
            cut = images[at][:, pad : pad + height, pad : pad + width]
        else:
            cuts = images.unfold(1, height, 1).unfold(2, width, 1).permute(0, 1, 2, 4, 5, 3)
            cut = cuts[at, offsets[:, 0], offsets[:, 1]]
        return cut.permute(0, 3, 1, 2)

    def will_need(self, at: Tensor) -> None:
        """Have the disk read steps while something else is computed, if they lie there."""
        if self._mapped is None or len(self._mapped) <= _MAPPED_AT_MOST:
            return
        size = self.layout.frame_bytes
        for step in at.flatten().tolist():
            start = step * size // mmap.PAGESIZE * mmap.PAGESIZE
            self._mapped.madvise(mmap.MADV_WILLNEED, start, (step + 1) * size - start)

    def let_go(self) -> None:
        """Unmap what was gathered; the kernel keeps what it has room for."""
        if self._mapped is not None:
            self._mapped.madvise(mmap.MADV_DONTNEED)
        self._gathered = 0
