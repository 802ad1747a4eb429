"""Other colours, light and camera mountings for a scene, to train or evaluate a policy on."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from sart_toolkit.errors import InvalidInput
from sart_toolkit.poses import Array, exp_rotation, orthonormalised
from sart_toolkit.robots.spec import CameraSpec, RobotSpec, Shape
from sart_toolkit.scenes.spec import Body, SceneSpec


@dataclass(frozen=True)
class AppearanceConfig:
    """How far the appearance varies; each value is the half-width of a uniform distribution.

    `colour`: of each channel of a shape's colour, in [0, 1]; `light`, `ambient`: relative, of the
    light's intensity and of what it leaves in shadow; `light_deg`: of the light's direction;
    `camera` [m] and `camera_deg`: of the wrist camera's mounting.
    """

    colour: float = 0.10
    light: float = 0.25
    ambient: float = 0.15
    light_deg: float = 25.0
    camera: float = 0.003
    camera_deg: float = 1.0

    def __post_init__(self) -> None:
        for field in dataclasses.fields(self):
            value = getattr(self, field.name)
            if not (np.isfinite(value) and value >= 0):
                raise InvalidInput(f"{field.name}: expected a finite number >= 0, got {value}")


@dataclass(frozen=True)
class Appearance:
    """A random appearance that can be drawn again: its generator's seed, and how far it varies.

    A recording keeps it as JSON, so that robot and scene look the same whenever they are made again
    for it.
    """

    seed: tuple[int, ...]
    config: AppearanceConfig = dataclasses.field(default_factory=AppearanceConfig)

    def __post_init__(self) -> None:
        seed = tuple(self.seed)
        if not seed or not all(type(number) is int and number >= 0 for number in seed):
            raise InvalidInput(f"seed: expected whole numbers >= 0, got {self.seed!r}")
        object.__setattr__(self, "seed", seed)

    def applied(self, robot: RobotSpec, scene: SceneSpec) -> tuple[RobotSpec, SceneSpec]:
        """Robot and scene as they look: see `randomise_appearance`."""
        return randomise_appearance(robot, scene, np.random.default_rng(self.seed), self.config)

    def to_json(self) -> dict[str, Any]:
        """The appearance as JSON values."""
        return {"seed": list(self.seed), "config": dataclasses.asdict(self.config)}

    @staticmethod
    def from_json(value: Any) -> Appearance:
        """The appearance from JSON values.

        Raises:
            InvalidInput: a field is unknown, missing or wrong.
        """
        try:
            config = AppearanceConfig(**value["config"])
            unknown = set(value) - {"seed", "config"}
            if unknown or not isinstance(value, Mapping):
                raise TypeError(f"unknown {sorted(unknown)}")
            return Appearance(tuple(value["seed"]), config)
        except (KeyError, TypeError) as error:
            raise InvalidInput(
                f"appearance: expected seed and config, got {value!r} ({error})"
            ) from error


def randomise_appearance(
    robot: RobotSpec,
    scene: SceneSpec,
    rng: np.random.Generator,
    config: AppearanceConfig | None = None,
) -> tuple[RobotSpec, SceneSpec]:
    """The same robot and scene with a random appearance: what moves, and how, stays the same.

    Colours of the scene's bodies, the light, and the wrist camera's pose vary; robot and held
    bodies keep their colours. Saved states of the one scene can be restored in the other.

    Args:
        robot: the robot whose camera varies.
        scene: the scene whose bodies and light vary.
        rng: source of randomness.
        config: how far.
    """
    config = config or AppearanceConfig()
    bodies = tuple(
        dataclasses.replace(body, shapes=_recoloured(body, rng, config.colour))
        for body in scene.bodies
    )
    light = dataclasses.replace(
        scene.light,
        direction=_turn(rng, config.light_deg) @ scene.light.direction,
        intensity=scene.light.intensity * (1 + rng.uniform(-config.light, config.light)),
        ambient=scene.light.ambient * (1 + rng.uniform(-config.ambient, config.ambient)),
    )
    cameras = tuple(_remounted(camera, rng, config) for camera in robot.cameras)
    return (
        dataclasses.replace(robot, cameras=cameras),
        dataclasses.replace(scene, bodies=bodies, light=light),
    )


def _recoloured(body: Body, rng: np.random.Generator, spread: float) -> tuple[Shape, ...]:
    """The body's shapes; those of one colour get one other colour."""
    changed = {}
    for rgba in _in_order(shape.rgba for shape in body.shapes):
        rgb = np.clip(np.array(rgba[:3]) + rng.uniform(-spread, spread, 3), 0.0, 1.0)
        changed[rgba] = (float(rgb[0]), float(rgb[1]), float(rgb[2]), rgba[3])
    return tuple(dataclasses.replace(shape, rgba=changed[shape.rgba]) for shape in body.shapes)


def _in_order(
    colours: Iterable[tuple[float, float, float, float]],
) -> list[tuple[float, float, float, float]]:
    return list(dict.fromkeys(colours))


def _remounted(
    camera: CameraSpec, rng: np.random.Generator, config: AppearanceConfig
) -> CameraSpec:
    T = np.array(camera.T_frame_camera)
    T[:3, 3] += rng.uniform(-config.camera, config.camera, 3)
    T[:3, :3] = orthonormalised(T[:3, :3] @ _turn(rng, config.camera_deg))
    return dataclasses.replace(camera, T_frame_camera=T)


def _turn(rng: np.random.Generator, degrees: float) -> Array:
    """A rotation `(3, 3)` about each axis by up to so many degrees."""
    return exp_rotation(np.deg2rad(rng.uniform(-degrees, degrees, 3)))
