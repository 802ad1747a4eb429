"""Cluttered scenes and straight tool lines through them, to test proofs that motions are clear.

A seed decides all. Nothing here computes a distance with coal.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache, lru_cache, partial

import numpy as np

from sart_toolkit.errors import InvalidInput, MotionRejected, Unreachable
from sart_toolkit.poses import Array, check_poses, exp_rotation, interpolate, inverse, pose
from sart_toolkit.robots import get_robot
from sart_toolkit.robots.meshes import hull_mesh, nearest_on
from sart_toolkit.robots.model import RobotModel
from sart_toolkit.robots.spec import BodyShape, ConvexShape, MeshShape, Shape
from sart_toolkit.scenes.spec import Body, SceneSpec
from sart_toolkit.tasks.parts import TABLE, tool_down
from sart_toolkit.testing.closest import collision_geometry, cover_spheres
from sart_toolkit.testing.vessels import VESSEL_HEIGHT, funnel, mug, mug_parts, written

# Where clutter stands and tools go [m].
LOWER, UPPER = np.array([0.25, -0.4, 0.0]), np.array([0.75, 0.4, 0.6])
_HOME_GAP = 0.005
_LONGEST, _SHORTEST, _WIDEST_TURN = 0.20, 0.02, 0.4
_SIDEWAYS_SHARE = 0.2
_TRIES = 1000

_Placed = tuple[BodyShape, Array]


# --- scenes -----------------------------------------------------------------------------------


def box_clutter(rng: np.random.Generator) -> SceneSpec:
    """A table with 12 to 20 boxes of 3 to 15 cm, half standing on it, half tilted anyhow."""
    n = int(rng.integers(12, 21))
    return _scene("box", [_draw(rng, partial(_box, standing=i % 2 == 0)) for i in range(n)])


def rod_forest(rng: np.random.Generator) -> SceneSpec:
    """A table with 14 to 22 rods 4 to 8 mm thick: vertical, slanted and horizontal ones."""
    n = int(rng.integers(14, 23))
    return _scene("rod", [_draw(rng, partial(_rod, kind=i % 3)) for i in range(n)])


def shelf(rng: np.random.Generator) -> SceneSpec:
    """A table with a narrow shelf of thin boards on four legs, and 6 to 9 posts beside it.

    The shelf is one body of 11 or 13 shapes.
    """
    while True:
        x, y, yaw = rng.uniform([0.35, -0.35, -np.pi / 2], [0.75, 0.35, np.pi / 2])
        T = pose([x, y, 0.0], [0, 0, yaw])
        shapes = _shelf_shapes(rng)
        if all(_is_clear(shape, T @ shape.T_body_shape) for shape in shapes):
            break
    posts = [_draw(rng, _post) for _ in range(rng.integers(6, 10))]
    return SceneSpec((TABLE, Body("shelf", shapes, T), *_bodies("post", posts)))


def mixed(rng: np.random.Generator) -> SceneSpec:
    """A table with 12 to 20 boxes, cylinders and spheres in equal parts, tilted anyhow."""
    n = int(rng.integers(12, 21))
    return _scene("thing", [_draw(rng, partial(_tilted, kind=i % 3)) for i in range(n)])


def crockery(rng: np.random.Generator) -> SceneSpec:
    """A table with 12 to 16 meshes, upright or tilted anyhow: mugs with a handle, and funnels.

    Every other mug collides as the convex parts that it is made of, all else as its hull.
    """
    n = int(rng.integers(12, 17))
    return _scene("mesh", [_draw(rng, partial(_vessel, kind=i % 3)) for i in range(n)])


CLUTTER: dict[str, Callable[[np.random.Generator], SceneSpec]] = {
    "boxes": box_clutter,
    "rods": rod_forest,
    "shelf": shelf,
    "mixed": mixed,
    "meshes": crockery,
}


def _bodies(name: str, placed: Sequence[_Placed]) -> list[Body]:
    return [Body(f"{name}{i}", (shape,), T) for i, (shape, T) in enumerate(placed)]


def _scene(name: str, placed: Sequence[_Placed]) -> SceneSpec:
    return SceneSpec((TABLE, *_bodies(name, placed)))


def _draw(rng: np.random.Generator, make: Callable[[np.random.Generator], _Placed]) -> _Placed:
    """The first of a function's shapes that doesn't touch the robot at home."""
    while True:
        shape, T = make(rng)
        if _is_clear(shape, T):
            return shape, T


def _box(rng: np.random.Generator, standing: bool) -> _Placed:
    x, y, z = rng.uniform(0.03, 0.15, 3)
    p = rng.uniform(LOWER, UPPER)
    if standing:
        return Shape("box", (x, y, z)), pose([*p[:2], z / 2], [0, 0, rng.uniform(-np.pi, np.pi)])
    return Shape("box", (x, y, z)), _anyhow(rng, p)


def _rod(rng: np.random.Generator, kind: int) -> _Placed:
    radius, length = rng.uniform(0.002, 0.004), rng.uniform(0.2, 0.6)
    p, yaw = rng.uniform(LOWER, UPPER), rng.uniform(-np.pi, np.pi)
    if kind == 0:
        return Shape("cylinder", (radius, length)), pose([*p[:2], length / 2])
    tilt = rng.uniform(0.3, 1.2) if kind == 1 else np.pi / 2
    # Its lower end above the table.
    p[2] = max(p[2], length / 2 * np.cos(tilt) + 0.01)
    T = pose(p)
    T[:3, :3] = exp_rotation(np.array([0, 0, yaw])) @ exp_rotation(np.array([0, tilt, 0]))
    return Shape("cylinder", (radius, length)), T


def _post(rng: np.random.Generator) -> _Placed:
    height, width = rng.uniform(0.15, 0.6), rng.uniform(0.008, 0.025)
    T = pose([*rng.uniform(LOWER, UPPER)[:2], height / 2], [0, 0, rng.uniform(-np.pi, np.pi)])
    if rng.random() < 0.5:
        return Shape("box", (width, width, height)), T
    return Shape("cylinder", (width / 2, height)), T


def _tilted(rng: np.random.Generator, kind: int) -> _Placed:
    T = _anyhow(rng, rng.uniform(LOWER, UPPER))
    if kind == 0:
        x, y, z = rng.uniform(0.02, 0.15, 3)
        return Shape("box", (x, y, z)), T
    if kind == 1:
        return Shape("cylinder", (rng.uniform(0.01, 0.05), rng.uniform(0.05, 0.3))), T
    return Shape("sphere", (rng.uniform(0.02, 0.06),)), T


def _vessel(rng: np.random.Generator, kind: int) -> _Placed:
    """A mug of its parts, a mug's hull or a funnel's, 6 to 12 cm high, half of them standing."""
    # Of few sizes, since parts are made anew for each.
    scale = float(rng.choice([0.06, 0.09, 0.12])) / VESSEL_HEIGHT
    if kind == 2:
        shape = MeshShape(str(written(funnel())), scale)
    else:
        parts = tuple(str(written(part)) for part in mug_parts())
        shape = MeshShape(str(written(mug())), scale, "hull" if kind else parts)
    p = rng.uniform(LOWER, UPPER)
    if rng.random() < 0.5:
        return shape, pose([*p[:2], 0.0], [0, 0, rng.uniform(-np.pi, np.pi)])
    return shape, _anyhow(rng, p)


def _shelf_shapes(rng: np.random.Generator) -> tuple[Shape, ...]:
    """Three or four boards, dividers between them, four legs, a side and a rail along the front."""
    n = int(rng.integers(3, 5))
    width, depth = rng.uniform(0.3, 0.5), rng.uniform(0.15, 0.25)
    leg, thickness = rng.uniform(0.012, 0.02), rng.uniform(0.006, 0.015)
    heights = 0.04 + np.cumsum(rng.uniform(0.10, 0.14, n))
    shapes = [Shape("box", (depth, width, thickness), pose([0, 0, z])) for z in heights]
    tall, along_y = float(heights[-1]), [np.pi / 2, 0, 0]
    for x in (-depth / 2, depth / 2):
        for y in (-width / 2, width / 2):
            shapes.append(Shape("box", (leg, leg, tall), pose([x, y, tall / 2])))
    shapes.append(Shape("box", (depth, thickness, tall), pose([0, width / 2, tall / 2])))
    for low, high in zip(heights[:-1], heights[1:], strict=True):
        y = rng.uniform(-0.3, 0.3) * width
        size = (depth, thickness, float(high - low))
        shapes.append(Shape("box", size, pose([0, y, (low + high) / 2])))
    shapes.append(Shape("cylinder", (leg / 2, width), pose([-depth / 2, 0, tall + 0.03], along_y)))
    return tuple(shapes)


def _anyhow(rng: np.random.Generator, p: Array) -> Array:
    """A pose `(4, 4)` at `p` with a random rotation."""
    axis = _direction(rng)
    return pose(p, rng.uniform(0, np.pi) * axis)


def _direction(rng: np.random.Generator) -> Array:
    v = rng.normal(size=3)
    return v / np.linalg.norm(v)


def _is_clear(shape: BodyShape, T_world_shape: Array) -> bool:
    """Whether a shape keeps off all that the robot may be at home: a box around it does."""
    spheres = _home_spheres()
    local = spheres[:, :3] @ T_world_shape[:3, :3] + inverse(T_world_shape)[:3, 3]
    at_origin = dataclasses.replace(shape, T_body_shape=np.eye(4))
    half = np.abs(at_origin.corners()).max(0)
    outside = np.linalg.norm(np.maximum(np.abs(local) - half, 0.0), axis=1)
    return bool((outside > spheres[:, 3] + _HOME_GAP).all())


@cache
def _home_spheres() -> Array:
    """Spheres `(n, 4)` that enclose the UR5e at home, its gripper open and closed.

    One more encloses what it may hold: 8 cm around a point 2 cm beyond the tool frame.
    """
    found = []
    for name in ("ur5e_2f85", "ur5e_hande"):
        for gripper in (0.0, 1.0):
            model = RobotModel(get_robot(name), gripper=gripper)
            poses = model.link_poses(model.spec.home)
            for link, geometry, T_link_part in collision_geometry(model.urdf):
                points = geometry.corners() if isinstance(geometry, Shape) else geometry
                spheres = cover_spheres(points)
                T = poses[link] @ T_link_part
                found.append(np.c_[spheres[:, :3] @ T[:3, :3].T + T[:3, 3], spheres[:, 3]])
            held = model.fk(model.spec.home) @ [0, 0, 0.02, 1]
            found.append(np.array([[*held[:3], 0.08]]))
    return np.concatenate(found)


# --- segments ---------------------------------------------------------------------------------


@dataclass(frozen=True)
class Segment:
    """A straight tool line: p linear, R geodesic.

    Attributes:
        q_start: joints `(n,)` [rad] at its start.
        T_world_start, T_world_end: tool poses `(4, 4)`.
        beside: the body that its middle was put beside; empty where it was put anywhere.
    """

    q_start: Array
    T_world_start: Array
    T_world_end: Array
    beside: str


def random_segment(
    model: RobotModel,
    q_seed: Array,
    rng: np.random.Generator,
    scene: SceneSpec | None = None,
    beside_share: float = 0.5,
    largest_gap: float = 0.04,
    accept_start: Callable[[Array], bool] | None = None,
) -> Segment:
    """A random straight tool line in the workspace, 2 to 20 cm long, that turns by up to 0.4 rad.

    The tool points down within 40 deg, turned anyhow, or in a fifth of all cases forwards within 20
    deg of level. Where the line is put beside a body, the tool's nearest point is there 0 to
    `largest_gap` from the nearest point of one of the body's shapes when the tool is in the line's
    middle; what comes before and after, and what else the robot meets, is left to chance.

    Args:
        model: the robot; the gripper is as in it.
        q_seed: joints `(n,)` [rad] near which solutions are sought, home for instance.
        rng: decides all.
        scene: what lines are put beside, bodies where it has them.
        beside_share: how many of the lines, on average.
        largest_gap: [m].
        accept_start: whether a line may start at a configuration; all may where left out.

    Raises:
        InvalidInput: there is no scene, or nothing in it, to put lines beside.
        MotionRejected: in 1000 attempts no line was found that the robot can reach.
    """
    bodies = [] if scene is None else [b for b in scene.bodies if any(s.collides for s in b.shapes)]
    if beside_share > 0 and not bodies:
        raise InvalidInput(
            "random_segment: no body to put lines beside; give a scene that has one, or "
            "beside_share=0"
        )
    # Decided once, so that lines which are harder to find are not fewer.
    besides = rng.random() < beside_share
    for _ in range(_TRIES):
        middle = pose(rng.uniform(LOWER + [0.03, 0.05, 0.08], UPPER - [0.03, 0.05, 0.05]))
        middle[:3, :3] = _tool_rotation(rng)
        beside = ""
        if besides:
            body = bodies[rng.integers(len(bodies))]
            beside, gap = body.name, rng.uniform(0.0, largest_gap)
            middle[:3, 3] = _position_beside(body, middle[:3, :3], _tool_points(model), gap, rng)
        step = rng.uniform(_SHORTEST, _LONGEST) / 2 * _direction(rng)
        turn = exp_rotation(rng.uniform(0, _WIDEST_TURN) / 2 * _direction(rng))
        start, end = middle.copy(), middle.copy()
        start[:3, 3] -= step
        end[:3, 3] += step
        start[:3, :3] @= turn.T
        end[:3, :3] @= turn
        near = np.clip(q_seed + rng.normal(0, 0.3, len(q_seed)), model.lower, model.upper)
        try:
            q = q_start = model.ik(start, near)
            for s in np.linspace(0, 1, 6)[1:]:
                q = model.ik(interpolate(start, end, s), q, max_step=0.5)
        except (Unreachable, MotionRejected):
            continue
        if accept_start is None or accept_start(q_start):
            start, end = check_poses("segment", np.stack([start, end]))
            return Segment(q_start, start, end, beside)
    raise MotionRejected(
        f"no line: {_TRIES} drawn ones are out of reach or start where they may not; give "
        "another q_seed or accept more starts"
    )


def _tool_rotation(rng: np.random.Generator) -> Array:
    """The tool pointing down or forwards, as `random_segment` says: a rotation `(3, 3)`."""
    down = tool_down(np.zeros(3))[:3, :3]
    if rng.random() < _SIDEWAYS_SHARE:
        pitch, yaw = rng.uniform(70, 110), rng.uniform(-1.0, 1.0)
        forwards = tool_down(np.zeros(3), pitch)[:3, :3]
        return exp_rotation(np.array([0, 0, yaw])) @ forwards
    yaw, heading = rng.uniform(-np.pi, np.pi, 2)
    tilt = np.deg2rad(rng.uniform(0, 40)) * np.array([np.cos(heading), np.sin(heading), 0])
    return exp_rotation(tilt) @ exp_rotation(np.array([0, 0, yaw])) @ down


def _position_beside(
    body: Body, R_world_tool: Array, p_tool_points: Array, gap: float, rng: np.random.Generator
) -> Array:
    """Where to put the tool `(3,)` so that its nearest point is `gap` off one of a body's parts.

    The part, being convex, lies behind the plane through its point nearest to a random place,
    square to the way there; the tool is put before it.
    """
    shapes = [shape for shape in body.shapes if shape.collides]
    shape = shapes[rng.integers(len(shapes))]
    T = body.T_world_body @ shape.T_body_shape
    parts = shape.convex_parts()
    # A shape that is its own part takes nothing from the generator.
    part = parts[rng.integers(len(parts))] if len(parts) > 1 else parts[0]
    while True:
        place = rng.uniform(LOWER, UPPER)
        nearest = _nearest_point(part, T, place)
        way = float(np.linalg.norm(place - nearest))
        if way > 1e-6:
            break
    normal = (place - nearest) / way
    points = p_tool_points @ R_world_tool.T
    first = points[np.argmin(points @ normal)]
    return nearest + gap * normal - first


def _nearest_point(shape: ConvexShape, T_world_shape: Array, p_world: Array) -> Array:
    """The point `(3,)` of a shape that is nearest to a place: that itself where it is inside.

    Of a hull it is on the surface.
    """
    R = T_world_shape[:3, :3]
    p = R.T @ (p_world - T_world_shape[:3, 3])
    if not isinstance(shape, Shape):
        p = nearest_on(np.array(hull_mesh(shape).triangles), p[None])[0]
    elif shape.kind == "box":
        half = np.array(shape.size) / 2
        p = np.clip(p, -half, half)
    elif shape.kind == "cylinder":
        radius, length = shape.size
        p[:2] *= min(1.0, radius / max(float(np.hypot(p[0], p[1])), 1e-12))
        p[2] = np.clip(p[2], -length / 2, length / 2)
    else:
        p *= min(1.0, shape.size[0] / max(float(np.linalg.norm(p)), 1e-12))
    return R @ p + T_world_shape[:3, 3]


@lru_cache(maxsize=8)
def _tool_points(model: RobotModel) -> Array:
    """Points `(n, 3)` in the tool frame whose hull encloses all that the last joint carries."""
    home = model.spec.home
    here, there = model.link_poses(home), model.link_poses(home + 0.1)
    tool = model.spec.tool_frame
    found = []
    for link, geometry, T_link_part in collision_geometry(model.urdf):
        T_tool_link = inverse(here[tool]) @ here[link]
        if np.abs(T_tool_link - inverse(there[tool]) @ there[link]).max() < 1e-9:
            points = geometry.corners() if isinstance(geometry, Shape) else geometry
            T = T_tool_link @ T_link_part
            found.append(points @ T[:3, :3].T + T[:3, 3])
    return np.concatenate(found)
