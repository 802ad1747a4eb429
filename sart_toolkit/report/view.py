"""The scene of a run as compact buffers, for `templates/view.js` to draw and turn in a page."""

from __future__ import annotations

import base64
import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sart_toolkit.data.records import Annotation, Demonstration
from sart_toolkit.poses import Array
from sart_toolkit.report.figures import SegmentPath, sphere_colour
from sart_toolkit.robots.model import RobotModel
from sart_toolkit.robots.spec import RobotSpec
from sart_toolkit.robots.visuals import DrawnMesh, RobotVisuals, body_meshes
from sart_toolkit.scenes.spec import SceneSpec

# Together with two themes of pictures and 1 MB of films a page stays below 3 MB.
MAX_TRIANGLES = 24_000
MAX_SEGMENTS, MAX_MOMENTS = 400, 120
# Of what has so few triangles, such as a box, none is left out.
_FEW_TRIANGLES = 200
# Edge of a cube, per square root of a mesh's size [m].
_FIRST_CELL, _COARSE, _COARSER = 0.004, 0.06, 1.25
_LEVELS = 2**16 - 1

View = dict[str, Any]


def scene_view(
    demonstration: Demonstration,
    annotation: Annotation,
    paths: Sequence[SegmentPath] = (),
    robot: RobotSpec | None = None,
    scene: SceneSpec | None = None,
) -> View:
    """What a page's 3D view shows, as JSON values; all positions [m] in the world frame.

    - `bodies`: each with its `layer` ("robot" or "scene"), its `poses` (float32, the upper three
      rows of a 4 x 4 matrix at each moment, or once where it never moves) and `meshes` in its own
      frame: `rgba`, `positions` (uint16), `normals` (int8, 127 for 1) and `triangles` (uint16).
    - `lines`: the demonstration and the segments: `sphere` (none for the demonstration), `colour`
      and `points` (uint16).
    - `balls`: the precision spheres, each with `centre`, `radius` and `colour`.
    - `times`: of the moments [s], from the demonstration's start.
    - `work`, `whole`: `middle` and `radius` of what encloses the skill, and the robot as well.

    Buffers are little endian, in base64. Positions of uint16 are `low + step * value`.

    Args:
        demonstration: its measured tool path, and where the robot and the bodies were.
        annotation: its precision spheres.
        paths: segments; of more than 400, so many are shown, evenly chosen.
        robot: the demonstration's, drawn with what it holds.
        scene: the demonstration's; bodies whose poses were not recorded are left out.

    Raises:
        InvalidInput, UnknownName, BrokenFile, MissingFile, MissingExtra: the robot can't be drawn.
    """
    moments = np.linspace(0, len(demonstration) - 1, min(len(demonstration), MAX_MOMENTS))
    at = moments.round().astype(int)
    held = () if scene is None else scene.held
    drawn = [] if scene is None else _scene_bodies(demonstration, scene, at)
    if robot is not None:
        drawn += _robot_bodies(demonstration, RobotVisuals(RobotModel(robot, held)), at)
    simple = _simplified([meshes for _, _, meshes in drawn])
    demonstrated = demonstration.steps.measured_Ts_world_tool[:, :3, 3]
    shown = np.linspace(0, len(paths) - 1, min(len(paths), MAX_SEGMENTS)).round().astype(int)
    segments = [paths[i] for i in shown]
    spheres = annotation.spheres
    centres = [sphere.T_world_key[:3, 3] for sphere in spheres]
    low, step = _grid(np.concatenate([demonstrated, *(path.positions for path in segments)]))
    extents = [sign * sphere.radius for sphere in spheres for sign in (1, -1)]
    corners = np.repeat(np.reshape(centres, (-1, 3)), 2, axis=0) + np.reshape(extents, (-1, 1))
    work = np.concatenate([demonstrated, corners])
    reach = [Ts[:, :3, 3] for layer, Ts, _ in drawn if layer == "robot"]
    return {
        "times": np.round(demonstration.timestamps[at] - demonstration.timestamps[0], 3).tolist(),
        "work": _enclosed(work),
        "whole": _enclosed(np.concatenate([work, *reach])),
        "low": low.tolist(),
        "step": step.tolist(),
        "bodies": [
            {
                "layer": layer,
                "poses": _base64(Ts[:, :3, :], "<f4"),
                "meshes": [_packed(mesh) for mesh in _joined(meshes)],
            }
            for (layer, Ts, _), meshes in zip(drawn, simple, strict=True)
        ],
        "lines": [
            {"sphere": None, "colour": None, "points": _levels(demonstrated, low, step)},
            *(
                {
                    "sphere": path.sphere,
                    "colour": sphere_colour(path.sphere),
                    "points": _levels(path.positions, low, step),
                }
                for path in segments
            ),
        ],
        "balls": [
            {
                "sphere": i,
                "centre": np.round(centre, 6).tolist(),
                "radius": round(sphere.radius, 6),
                "colour": sphere_colour(i),
            }
            for i, (sphere, centre) in enumerate(zip(spheres, centres, strict=True))
        ],
    }


# --- what is drawn, and where ---------------------------------------------------------------------

# A layer's name, poses `(n, 4, 4)` at the moments or one for all, and meshes in the body's frame.
_Drawn = tuple[str, Array, Sequence[DrawnMesh]]


def _scene_bodies(demonstration: Demonstration, scene: SceneSpec, at: Array) -> list[_Drawn]:
    return [
        (
            "scene",
            _still(demonstration.body_Ts_world[body.name][at]),
            body_meshes(body.shapes),
        )
        for body in scene.bodies
        if body.name in demonstration.body_Ts_world
    ]


def _robot_bodies(demonstration: Demonstration, robot: RobotVisuals, at: Array) -> list[_Drawn]:
    steps = demonstration.steps
    # A measured opening may lie a little outside.
    openings = np.clip(steps.measured_gripper, 0.0, 1.0)
    poses = [robot.poses_at(steps.joint_positions[t], float(openings[t])) for t in at]
    return [
        ("robot", _still(np.array([Ts[name] for Ts in poses])), meshes)
        for name, meshes in robot.bodies.items()
    ]


def _still(Ts: Array) -> Array:
    """The first pose alone where all are the same to a micrometre."""
    return Ts[:1] if np.abs(Ts - Ts[0]).max() < 1e-6 else Ts


def _joined(meshes: Sequence[DrawnMesh]) -> list[DrawnMesh]:
    """One mesh for each colour; none for what has no triangle left."""
    by_colour: dict[tuple[float, ...], list[DrawnMesh]] = {}
    for mesh in filter(lambda mesh: len(mesh.triangles), meshes):
        by_colour.setdefault(mesh.rgba, []).append(mesh)
    joined = []
    for same in by_colour.values():
        first = np.cumsum([0, *(len(mesh.vertices) for mesh in same)])
        joined.append(
            DrawnMesh(
                np.concatenate([mesh.vertices for mesh in same]),
                np.concatenate([mesh.triangles + i for mesh, i in zip(same, first, strict=False)]),
                np.concatenate([mesh.normals for mesh in same]),
                same[0].rgba,
            )
        )
    return joined


def _enclosed(points: Array) -> View:
    low, high = points.min(axis=0), points.max(axis=0)
    middle = (low + high) / 2
    radius = float(np.linalg.norm(points - middle, axis=1).max())
    return {"middle": np.round(middle, 4).tolist(), "radius": round(max(radius, 0.01), 4)}


# --- fewer triangles ------------------------------------------------------------------------------


def _simplified(bodies: Sequence[Sequence[DrawnMesh]]) -> Sequence[Sequence[DrawnMesh]]:
    """The meshes with no more triangles in all than a page has room for, small ones finer."""
    cell, simple = _FIRST_CELL, bodies
    while sum(len(mesh.triangles) for meshes in simple for mesh in meshes) > MAX_TRIANGLES:
        # Where there are too many simple shapes, they are spared no longer.
        spared = _FEW_TRIANGLES if cell < _COARSE else 0
        simple = [
            [
                mesh
                if len(mesh.triangles) <= spared
                else simplified(mesh, cell * math.sqrt(float(np.ptp(mesh.vertices, axis=0).max())))
                for mesh in meshes
            ]
            for meshes in bodies
        ]
        cell *= _COARSER
    return simple


def simplified(mesh: DrawnMesh, cell: float) -> DrawnMesh:
    """The mesh with the corners within each cube of edge `cell` [m] moved into their mean.

    Those of one cube that face alike become one, so that edges stay sharp. What lies within one
    cube has no triangle left.
    """
    cubes = np.floor((mesh.vertices - mesh.vertices.min(axis=0)) / cell).astype(np.int64)
    cube = np.ravel_multi_index(tuple(cubes.T), tuple(cubes.max(axis=0) + 1))
    _, cube = np.unique(cube, return_inverse=True)
    axis = np.abs(mesh.normals).argmax(axis=1)
    facing = 2 * axis + (mesh.normals[np.arange(len(axis)), axis] > 0)
    _, first, corner = np.unique(6 * cube + facing, return_index=True, return_inverse=True)
    middles = _means(mesh.vertices, cube)
    normals = _means(mesh.normals, corner)
    lengths = np.linalg.norm(normals, axis=1, keepdims=True)
    at = cube[mesh.triangles]
    whole = (at[:, 0] != at[:, 1]) & (at[:, 1] != at[:, 2]) & (at[:, 2] != at[:, 0])
    triangles = np.unique(corner[mesh.triangles[whole]], axis=0)
    used, triangles = np.unique(triangles, return_inverse=True)
    return DrawnMesh(
        middles[cube[first]][used],
        triangles.reshape(-1, 3),
        (normals / np.maximum(lengths, 1e-9))[used],
        mesh.rgba,
    )


def _means(values: Array, groups: NDArray[Any]) -> Array:
    counts = np.bincount(groups)
    sums = [np.bincount(groups, values[:, i]) for i in range(values.shape[1])]
    return np.stack(sums, axis=1) / counts[:, None]


# --- buffers --------------------------------------------------------------------------------------


def _packed(mesh: DrawnMesh) -> View:
    low, step = _grid(mesh.vertices)
    return {
        "rgba": [round(value, 3) for value in mesh.rgba],
        "low": low.tolist(),
        "step": step.tolist(),
        "positions": _levels(mesh.vertices, low, step),
        "normals": _base64(np.round(127 * mesh.normals), "<i1"),
        "triangles": _base64(mesh.triangles, "<u2"),
    }


def _grid(points: Array) -> tuple[Array, Array]:
    """Lowest position and step of a grid of 65536 levels along each axis that holds the points."""
    low = points.min(axis=0)
    return low, np.maximum(points.max(axis=0) - low, 1e-9) / _LEVELS


def _levels(points: Array, low: Array, step: Array) -> str:
    return _base64(np.round((points - low) / step), "<u2")


def _base64(values: NDArray[Any], dtype: str) -> str:
    return base64.b64encode(np.asarray(values, dtype).tobytes()).decode("ascii")
