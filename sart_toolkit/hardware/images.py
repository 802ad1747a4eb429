"""Images of a real camera as those that a `CameraSpec` describes."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sart_toolkit.data.records import DepthImage, Image
from sart_toolkit.errors import InvalidInput
from sart_toolkit.hardware.drivers import CameraImage
from sart_toolkit.robots.spec import CameraSpec

# Of so many points across each pixel, at most, the colour is the mean.
_MOST_SAMPLES = 6
# So many pixels may be missing at a border: half of one is rounding.
_MISSING = 1.0


def as_described(
    image: CameraImage, camera: CameraSpec, size: tuple[int, int]
) -> tuple[Image, DepthImage]:
    """Colour and depth of an image as seen by `camera` with so many pixels (width, height).

    Both look along the same axis, so only the field of view and the pixels are others. A pixel's
    colour is the mean of those that it covers, its depth the nearest one's: a mean of depths
    would be of no surface.

    Raises:
        InvalidInput: the camera sees less than the image is to show.
    """
    wanted, given = camera.intrinsics(*size), image.intrinsics
    fine, middle = list[NDArray[np.int_]](), list[NDArray[np.int_]]()
    for axis, (pixels, there) in enumerate(zip(size, image.depth.shape[::-1], strict=True)):
        ratio = given[axis, axis] / wanted[axis, axis]
        samples = int(np.clip(np.ceil(ratio), 1, _MOST_SAMPLES))
        for n, indices in ((samples, fine), (1, middle)):
            at = (np.arange(pixels * n) + 0.5) / n - 0.5
            where = (at - wanted[axis, 2]) * ratio + given[axis, 2]
            if where.min() < -0.5 - _MISSING or where.max() > there - 0.5 + _MISSING:
                half = min(given[1, 2] + 0.5, image.depth.shape[0] - 0.5 - given[1, 2])
                most = 2 * np.rad2deg(np.arctan(half / given[1, 1]))
                raise InvalidInput(
                    f"camera {camera.name!r}: sees less than {size[0]}x{size[1]} pixels with "
                    f"fov_y_deg {camera.fov_y_deg:g}; set fov_y_deg in the cell's file to "
                    f"{np.floor(most):g} or less, less still for images wider than the camera's"
                )
            indices.append(np.clip(np.round(where).astype(int), 0, there - 1))
    (u, v), (u0, v0) = fine, middle
    blocks = image.rgb[v[:, None], u].reshape(size[1], len(v) // size[1], size[0], -1, 3)
    rgb = np.round(blocks.mean((1, 3))).astype(np.uint8)
    return rgb, image.depth[v0[:, None], u0].astype(np.float32)
