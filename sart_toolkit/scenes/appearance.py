"""Other colours, light and camera mountings for a scene, to train or evaluate a policy on."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from sart_toolkit.errors import InvalidInput, unknown_name
from sart_toolkit.poses import Array, exp_rotation, inverse, orthonormalised, pose
from sart_toolkit.robots.spec import BodyShape, CameraSpec, RobotSpec, Shape
from sart_toolkit.scenes.spec import Body, SceneSpec

_Rgba = tuple[float, float, float, float]

# What distractors are, with their lengths per half of their height.
_FORMS: tuple[tuple[Literal["box", "cylinder", "sphere"], tuple[float, ...]], ...] = (
    ("box", (1.4, 1.4, 2.0)),
    ("cylinder", (0.8, 2.0)),
    ("sphere", (1.0,)),
)


@dataclass(frozen=True)
class AppearanceConfig:
    """How far the appearance varies; each value is the half-width of a uniform distribution.

    `colour`: of each channel of a shape's colour, in [0, 1]; `light`, `ambient`: relative, of the
    light's intensity and of what it leaves in shadow; `light_deg`: of the light's direction;
    `camera` [m] and `camera_deg`: of the wrist camera's mounting. Two are no half-widths:
    `camera_offset` [m] moves the wrist camera just so far, in a random direction; `distractors`:
    how many other objects lie around the task's. They are only drawn, so that what the policy sees
    is tested and not what the robot runs into.
    """

    colour: float = 0.10
    light: float = 0.25
    ambient: float = 0.15
    light_deg: float = 25.0
    camera: float = 0.003
    camera_deg: float = 1.0
    camera_offset: float = 0.0
    distractors: int = 0

    def __post_init__(self) -> None:
        for field in dataclasses.fields(self):
            value = getattr(self, field.name)
            if not (np.isfinite(value) and value >= 0):
                raise InvalidInput(f"{field.name}: expected a finite number >= 0, got {value}")
        if self.distractors != int(self.distractors):
            raise InvalidInput(f"distractors: expected a whole number, got {self.distractors}")
        object.__setattr__(self, "distractors", int(self.distractors))

    @classmethod
    def only(cls, **values: float) -> AppearanceConfig:
        """Only what is named varies, by so much.

        Raises:
            UnknownName: there is no such field.
            InvalidInput: a value is not acceptable.
        """
        names = [field.name for field in dataclasses.fields(cls)]
        for name in values:
            if name not in names:
                raise unknown_name("part of the appearance", name, names)
        return cls(**{**dict.fromkeys(names, 0), **values})  # type: ignore[arg-type]


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
    Ts_world_body: Mapping[str, Array] | None = None,
) -> tuple[RobotSpec, SceneSpec]:
    """The same robot and scene with a random appearance: what moves, and how, stays the same.

    Colours of the scene's bodies, the light, and the wrist camera's pose vary; robot and held
    bodies keep their colours. Saved states of the one scene can be restored in the other, unless
    there are distractors.

    Args:
        robot: the robot whose camera varies.
        scene: the scene whose bodies and light vary.
        rng: source of randomness.
        config: how far.
        Ts_world_body: poses `(4, 4)` of bodies that don't stand where the scene has them;
            distractors keep off them.
    """
    config = config or AppearanceConfig()
    bodies = [
        dataclasses.replace(body, shapes=_recoloured(body, rng, config.colour))
        for body in scene.bodies
    ]
    light = dataclasses.replace(
        scene.light,
        direction=_turn(rng, config.light_deg) @ scene.light.direction,
        intensity=scene.light.intensity * (1 + rng.uniform(-config.light, config.light)),
        ambient=scene.light.ambient * (1 + rng.uniform(-config.ambient, config.ambient)),
    )
    cameras = tuple(_remounted(camera, rng, config) for camera in robot.cameras)
    if config.distractors:
        i = _ground(bodies)
        lying = _distractors(bodies, i, int(config.distractors), rng, Ts_world_body or {})
        bodies[i] = dataclasses.replace(bodies[i], shapes=(*bodies[i].shapes, *lying))
    return (
        dataclasses.replace(robot, cameras=cameras),
        dataclasses.replace(scene, bodies=tuple(bodies), light=light),
    )


def _ground(bodies: Sequence[Body]) -> int:
    """Which of the bodies that never move is the broadest."""
    still = [i for i, body in enumerate(bodies) if body.mass is None]
    if not still:
        raise InvalidInput("distractors: the scene has no body that never moves for them to lie on")
    return max(still, key=lambda i: _reach(bodies[i]))


def _reach(body: Body) -> float:
    """How far from its origin a body reaches [m], in its own x and y."""
    return max(float(np.linalg.norm(s.corners()[:, :2], axis=1).max()) for s in body.shapes)


def _distractors(
    bodies: Sequence[Body],
    ground: int,
    count: int,
    rng: np.random.Generator,
    Ts_world_body: Mapping[str, Array],
) -> list[Shape]:
    """Boxes, cylinders and balls on the ground round what stands on it, as shapes of the ground."""
    T_world_ground = Ts_world_body.get(bodies[ground].name, bodies[ground].T_world_body)
    top = max(float(shape.corners()[:, 2].max()) for shape in bodies[ground].shapes)
    kept_clear = []
    for body in (b for i, b in enumerate(bodies) if i != ground):
        T = inverse(T_world_ground) @ Ts_world_body.get(body.name, body.T_world_body)
        if body.joint is None or body.name in Ts_world_body:
            kept_clear.append((T[:2, 3], _reach(body)))
    if not kept_clear:
        raise InvalidInput("distractors: the scene has no object for them to lie around")
    shapes: list[Shape] = []
    while len(shapes) < count:
        about, reach = kept_clear[int(rng.integers(len(kept_clear)))]
        size, angle = rng.uniform(0.015, 0.035), rng.uniform(0, 2 * np.pi)
        far = reach + size + rng.uniform(0.02, 0.12)
        p = about + far * np.array([np.cos(angle), np.sin(angle)])
        kind, lengths = _FORMS[int(rng.integers(len(_FORMS)))]
        red, green, blue = (float(value) for value in rng.uniform(0.05, 0.95, 3))
        if any(np.linalg.norm(p - other) < room + size for other, room in kept_clear):
            continue
        T = pose([*p, top + size], [0, 0, rng.uniform(0, 2 * np.pi)])
        edges = tuple(float(size * length) for length in lengths)
        shapes.append(Shape(kind, edges, T, (red, green, blue, 1.0), collides=False))
    return shapes


def _recoloured(body: Body, rng: np.random.Generator, spread: float) -> tuple[BodyShape, ...]:
    """The body's shapes; those of one colour get one other, meshes keep those of their files."""
    changed: dict[_Rgba, _Rgba] = {}
    for rgba in _in_order(shape.rgba for shape in body.shapes if shape.rgba is not None):
        rgb = np.clip(np.array(rgba[:3]) + rng.uniform(-spread, spread, 3), 0.0, 1.0)
        changed[rgba] = (float(rgb[0]), float(rgb[1]), float(rgb[2]), rgba[3])
    return tuple(
        shape if shape.rgba is None else dataclasses.replace(shape, rgba=changed[shape.rgba])
        for shape in body.shapes
    )


def _in_order(colours: Iterable[_Rgba]) -> list[_Rgba]:
    return list(dict.fromkeys(colours))


def _remounted(
    camera: CameraSpec, rng: np.random.Generator, config: AppearanceConfig
) -> CameraSpec:
    T = np.array(camera.T_frame_camera)
    T[:3, 3] += rng.uniform(-config.camera, config.camera, 3)
    T[:3, :3] = orthonormalised(T[:3, :3] @ _turn(rng, config.camera_deg))
    if config.camera_offset:
        direction = rng.standard_normal(3)
        T[:3, 3] += config.camera_offset * direction / np.linalg.norm(direction)
    return dataclasses.replace(camera, T_frame_camera=T)


def _turn(rng: np.random.Generator, degrees: float) -> Array:
    """A rotation `(3, 3)` about each axis by up to so many degrees."""
    return exp_rotation(np.deg2rad(rng.uniform(-degrees, degrees, 3)))
