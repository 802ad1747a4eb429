"""Poses drawn at random on and in precision spheres, as the augmentation does."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sart_toolkit.data.records import ROTATION_PER_METRE, PrecisionSphere
from sart_toolkit.errors import InvalidInput, unknown_name
from sart_toolkit.poses import Array, exp_rotation, orthonormalised

DISTRIBUTIONS = ("paper", "area")


@dataclass(frozen=True)
class SamplingConfig:
    """How poses are drawn: `distribution` of positions, `rotation_per_metre` nu_r [rad/m]."""

    distribution: str = "area"
    rotation_per_metre: float = ROTATION_PER_METRE

    def __post_init__(self) -> None:
        if self.distribution not in DISTRIBUTIONS:
            raise unknown_name("sampling distribution", self.distribution, DISTRIBUTIONS)
        if not np.isfinite(self.rotation_per_metre) or self.rotation_per_metre < 0:
            raise InvalidInput(
                f"rotation_per_metre: expected a finite number >= 0, got {self.rotation_per_metre}"
            )


def sample_direction(rng: np.random.Generator, distribution: str) -> Array:
    """A unit vector `(3,)`: psi ~ U[0, 2 pi], and phi ~ U[0, pi] (`paper`) or cos phi ~ U[-1, 1].

    `paper` is the paper's Eq. (rand_pos) and draws the poles more often; `area` is uniform on the
    sphere, as in the published code.
    """
    psi = rng.uniform(0.0, 2.0 * np.pi)
    phi = rng.uniform(0.0, np.pi) if distribution == "paper" else np.arccos(rng.uniform(-1.0, 1.0))
    return np.array([np.sin(phi) * np.cos(psi), np.sin(phi) * np.sin(psi), np.cos(phi)])


def sample_rotation(rng: np.random.Generator, largest: float) -> Array:
    """A rotation `(3, 3)` by an angle ~ U[-largest, largest] [rad] about a uniform random axis."""
    angle = rng.uniform(-largest, largest)
    axis = sample_direction(rng, "area")
    return exp_rotation(angle * axis)


def sample_pose(sphere: PrecisionSphere, rng: np.random.Generator, config: SamplingConfig) -> Array:
    """A tool pose `(4, 4)` on a precision sphere, in the world.

    Position Eq. (rand_pos): p = c + r [sin phi cos psi, sin phi sin psi, cos phi]. Rotation
    Eq. (rand_ori): R = C dR, its angle within nu_r r.
    """
    return _pose_at(sphere, sphere.radius, rng, config)


def sample_position(
    sphere: PrecisionSphere, rng: np.random.Generator, config: SamplingConfig
) -> Array:
    """A tool pose `(4, 4)` on a precision sphere, turned as its key pose: R = C."""
    T = sample_pose(sphere, rng, config)
    T[:3, :3] = sphere.T_world_key[:3, :3]
    return T


def sample_turn(sphere: PrecisionSphere, rng: np.random.Generator, config: SamplingConfig) -> Array:
    """A tool pose `(4, 4)` at a sphere's centre, p = c, turned as `sample_pose` turns it."""
    return _pose_at(sphere, 0.0, rng, config)


def sample_in_region(
    sphere: PrecisionSphere, rng: np.random.Generator, config: SamplingConfig
) -> Array:
    """A tool pose `(4, 4)` anywhere in a sphere's volume, in the world.

    p = c + r u^(1/3) d, u ~ U[0, 1] and d a direction by the sampling distribution: with `area` it
    is uniform in the ball. The rotation is that of `sample_pose`.
    """
    return _pose_at(sphere, sphere.radius * float(np.cbrt(rng.uniform())), rng, config)


def _pose_at(
    sphere: PrecisionSphere, distance: float, rng: np.random.Generator, config: SamplingConfig
) -> Array:
    """A pose at a distance [m] from a sphere's key pose."""
    T = np.eye(4)
    direction = sample_direction(rng, config.distribution)
    T[:3, 3] = sphere.T_world_key[:3, 3] + distance * direction
    dR = sample_rotation(rng, config.rotation_per_metre * sphere.radius)
    T[:3, :3] = orthonormalised(sphere.T_world_key[:3, :3] @ dR)
    return T
