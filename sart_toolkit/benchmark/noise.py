"""What a real depth camera would have recorded in place of a simulated one."""

from __future__ import annotations

import dataclasses

import numpy as np
from scipy.ndimage import maximum_filter, minimum_filter

from sart_toolkit.collision.sensor import SensorErrors
from sart_toolkit.data.records import CameraRecord, Demonstration, DepthImage
from sart_toolkit.data.sampling import sample_direction
from sart_toolkit.poses import pose

# Neighbours whose depths differ by this [m] have an edge between them.
_EDGE = 0.02
# A speck's depth is at least this fraction of the true one.
_NEAREST = 0.3


def as_measured(
    demonstration: Demonstration, errors: SensorErrors, holes: float, rng: np.random.Generator
) -> Demonstration:
    """A demonstration as a sensor with such errors would have recorded it.

    Every camera is where it says but for `hand_eye` and `hand_eye_deg`, in full, in directions
    drawn once. Depths are longer by `depth_scale`; Gaussian noise of the declared deviation is
    added to each, of a share `flying` of them nothing is left: half of these are interpolated
    between the two sides of a depth edge, the others anywhere along their ray before the surface.
    A share `holes` of all pixels has no depth. What remains is rounded to `step`.

    Args:
        demonstration: recorded with exact depth.
        errors: of the sensor.
        holes: share of pixels without depth.
        rng: draws all of it.
    """
    cameras = {}
    for name, camera in demonstration.steps.cameras.items():
        depth = np.stack([measured_depth(z, errors, holes, rng) for z in camera.depth])
        off = pose(
            errors.hand_eye * sample_direction(rng, "area"),
            errors.hand_eye_angle * sample_direction(rng, "area"),
        )
        cameras[name] = CameraRecord(
            camera.rgb, depth, camera.intrinsics, camera.frame, camera.T_frame_camera @ off
        )
    steps = dataclasses.replace(demonstration.steps, cameras=cameras)
    return dataclasses.replace(demonstration, steps=steps)


def measured_depth(
    depth: DepthImage, errors: SensorErrors, holes: float, rng: np.random.Generator
) -> DepthImage:
    """A depth image `(H, W)` [m] as a sensor with such errors measures it, see `as_measured`."""
    z = depth.astype(np.float64)
    seen = z > 0
    flat = z.ravel().copy()
    if errors.flying:
        # Where nothing was hit is no depth to interpolate to.
        low = minimum_filter(np.where(seen, z, np.inf), 3).ravel()
        high = maximum_filter(z, 3).ravel()
        count = rng.binomial(int(seen.sum()), errors.flying)
        edge = np.flatnonzero((high - low > _EDGE) & seen.ravel())
        at_edges = rng.permutation(edge)[: count // 2]
        anywhere = rng.choice(np.flatnonzero(seen), count - len(at_edges), replace=False)
        flat[anywhere] *= rng.uniform(_NEAREST, 1.0, len(anywhere))
        mixed = rng.uniform(size=len(at_edges))
        flat[at_edges] = low[at_edges] + mixed * (high - low)[at_edges]
    z = flat.reshape(z.shape) * (1 + errors.depth_scale)
    z += (errors.noise + errors.noise_quadratic * z**2) * rng.standard_normal(z.shape)
    if errors.step:
        z = np.round(z / errors.step) * errors.step
    found = seen & (rng.uniform(size=z.shape) >= holes)
    return np.where(found, np.maximum(z, 0.0), 0.0).astype(np.float32)
