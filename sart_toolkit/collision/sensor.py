"""What a depth camera's measurements may be off by, and how its images become a cloud."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np

from sart_toolkit.errors import InvalidInput, unknown_name
from sart_toolkit.poses import Array, check_positive

# So many standard deviations of its noise a depth is taken to be off at most.
_QUANTILE = 3.0


@dataclass(frozen=True)
class SensorErrors:
    """What a depth camera's measurements may be off by; nothing, unless declared.

    `hand_eye` [m], `hand_eye_deg` [deg]: how far the camera is from where it is recorded to be in
    its frame, at most. `depth_scale`: the largest error of depth as a fraction of it. `noise` [m]
    and `noise_quadratic` [1/m]: standard deviation of a depth z, noise + noise_quadratic z^2.
    `step` [m]: the grid of depths. `flying`: the share of pixels whose depth is of no surface:
    flying pixels at depth edges, and speckle; 0: every pixel is believed.
    """

    hand_eye: float = 0.0
    hand_eye_deg: float = 0.0
    depth_scale: float = 0.0
    noise: float = 0.0
    noise_quadratic: float = 0.0
    step: float = 0.0
    flying: float = 0.0

    def __post_init__(self) -> None:
        for each in dataclasses.fields(self):
            value, most = getattr(self, each.name), _LARGEST[each.name]
            wrong = isinstance(value, bool) or not isinstance(value, int | float)
            if wrong or not 0.0 <= value <= most:
                raise InvalidInput(f"{each.name}: expected a number from 0 to {most}, got {value}")

    @property
    def hand_eye_angle(self) -> float:
        """`hand_eye_deg` in radians."""
        return float(np.deg2rad(self.hand_eye_deg))

    def systematic(self, distances: Array) -> Array:
        """How far `(n,)` [m] points are off, at most, by what is the same in every image.

        The camera's pose and its scale of depth move a point at `distances (n,)` [m] from the
        camera by no more than |dt| + 2 sin(angle / 2) d + s / (1 - s) d.
        """
        turn = 2 * np.sin(self.hand_eye_angle / 2)
        scale = self.depth_scale / (1 - self.depth_scale)
        return np.asarray(self.hand_eye + (turn + scale) * distances)

    def deviation(self, depths: Array) -> Array:
        """The standard deviation `(n,)` [m] of depths `(n,)` [m], their grid's included."""
        noise = self.noise + self.noise_quadratic * depths**2
        return np.asarray(np.hypot(noise, self.step / np.sqrt(12)))

    def noise_bound(self, depths: Array) -> Array:
        """How far `(n,)` [m] single depths `(n,)` [m] are off at most by noise: 3 deviations."""
        return _QUANTILE * self.deviation(depths)

    def to_json(self) -> dict[str, float]:
        """The errors as JSON values."""
        return dataclasses.asdict(self)


_LARGEST: Mapping[str, float] = {
    "hand_eye": 0.05,
    "hand_eye_deg": 10.0,
    "depth_scale": 0.2,
    "noise": 0.05,
    "noise_quadratic": 0.1,
    "step": 0.02,
    "flying": 0.2,
}

Sensor = Literal["exact", "d405", "d435"]
SENSORS: Mapping[str, SensorErrors] = {
    "exact": SensorErrors(),
    "d405": SensorErrors(noise=0.0005, noise_quadratic=0.001, step=0.0001, flying=0.002),
    "d435": SensorErrors(noise=0.0008, noise_quadratic=0.0025, step=0.001, flying=0.02),
}


def sensor_errors(
    name: str = "exact", hand_eye: tuple[float, float] = (0.0, 0.0), depth_scale: float = 0.0
) -> SensorErrors:
    """A named sensor's errors with those of its calibration.

    Args:
        name: one of `SENSORS`.
        hand_eye: error of the camera's pose in its frame, [m] and [deg].
        depth_scale: largest error of depth, as a fraction of it.

    Raises:
        UnknownName: there is no such sensor.
        InvalidInput: an error is negative or absurdly large.
    """
    if name not in SENSORS:
        raise unknown_name("sensor", name, SENSORS)
    return dataclasses.replace(
        SENSORS[name], hand_eye=hand_eye[0], hand_eye_deg=hand_eye[1], depth_scale=depth_scale
    )


@dataclass(frozen=True)
class CloudConfig:
    """How images become a cloud; lengths in [m].

    `voxel`: points in one cell of this grid are merged into their mean. `near`, `far`: depth that
    is used. `reach`: points farther than this from every tool position shown are left out: no
    radius and no tool is large enough to get there. `self_margin`: points nearer than this to the
    robot's convex parts are its own pixels.

    `unknown` is the rule for space that no image shows: "free", or "behind": solid to a depth of
    `behind` along the ray behind what was seen, except where an image sees through it or the
    robot itself was.

    `inflation`: every point stands for a ball of this radius, for what lies between pixels. It is
    by how much a tool body within 5 cm of the scene may be nearer to the scene than to the points
    seen, measured against the true scenes: demonstrations of the six tasks on PyBullet and of
    peg-in-hole on SAPIEN, 128 x 128 pixels, until the first contact; tool bodies at 8 waypoints,
    there and strayed by up to 4 cm in each axis and some 7 deg. The 95th percentile was 1.14 mm in
    the worst task, the largest 1.8 mm. The points themselves are far better in simulation (by
    `surface_errors` 0.01 mm at the 95th percentile, 2.5 mm at most).

    `sensor`: what a real camera's measurements may be off by; each point's ball is larger by what
    that does to it.
    """

    voxel: float = 0.004
    near: float = 0.05
    far: float = 0.8
    reach: float = 0.35
    self_margin: float = 0.008
    unknown: Literal["behind", "free"] = "behind"
    behind: float = 0.03
    inflation: float = 0.0012
    sensor: SensorErrors = field(default_factory=SensorErrors)

    def __post_init__(self) -> None:
        for name in ("voxel", "near", "far", "reach", "self_margin", "behind", "inflation"):
            check_positive(name, getattr(self, name), "m")
        if self.far <= self.near:
            raise InvalidInput(f"far: expected more than near ({self.near} m), got {self.far} m")
        if self.unknown not in ("behind", "free"):
            raise InvalidInput(f"unknown: expected 'behind' or 'free', got {self.unknown!r}")

    def to_json(self) -> dict[str, Any]:
        """The settings as JSON values."""
        return dataclasses.asdict(self)

    @staticmethod
    def from_json(values: Mapping[str, Any]) -> CloudConfig:
        """The settings that `to_json` wrote.

        Raises:
            InvalidInput: one is missing, unknown or not acceptable.
        """
        try:
            return CloudConfig(**{**values, "sensor": SensorErrors(**values["sensor"])})
        except (KeyError, TypeError) as error:
            raise InvalidInput(f"cloud: a setting is missing or wrong ({error})") from error
