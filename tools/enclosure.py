"""Whether a robot's collision parts enclose what is drawn of it: `python tools/enclosure.py`.

The surface of every link's original meshes is sampled densely, at five openings of the gripper,
and the distance of each sample from the parts that certificates use is measured; so is how much
larger the parts are. A table goes to stderr, one JSON object to stdout as the last line.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from typing import Any, NamedTuple

import coal
import numpy as np
import trimesh
from scipy.spatial import ConvexHull, cKDTree

from sart_toolkit import doctor
from sart_toolkit.collision.model import CollisionModel
from sart_toolkit.collision.parts import ConvexPart
from sart_toolkit.data.records import library_versions
from sart_toolkit.poses import Array, inverse
from sart_toolkit.robots import ROBOTS, get_robot
from sart_toolkit.robots.enclosure import HullPart, Part, ShapePart
from sart_toolkit.robots.model import RobotModel
from sart_toolkit.robots.source import links_and_joints
from sart_toolkit.robots.spec import RobotSpec, Shape, resource_path
from sart_toolkit.robots.urdf import drawn_shapes, drawn_triangles, link_parts
from sart_toolkit.scenes.spec import SceneSpec

OPENINGS = (0.0, 0.25, 0.5, 0.75, 1.0)
LIMIT_MM = 0.01
_VOLUME_SAMPLES = 200_000


class Drawn(NamedTuple):
    """A link as its source draws it.

    Attributes:
        points: samples `(n, 3)` [m] of its surface, in its frame.
        source: the parts that its source's collision elements give, as they are.
    """

    points: Array
    source: list[Part]


def main(arguments: Sequence[str] | None = None) -> int:
    """The exit code: 0 if no sample of any link stands out by more than the limit."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--robots", nargs="*", default=list(ROBOTS), help="by name or as file:NAME")
    parser.add_argument("--samples", type=int, default=20_000, help="of each link, by area")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args(arguments)
    rows = [
        row
        for name in options.robots
        for row in measure(get_robot(name), options.samples, np.random.default_rng(options.seed))
    ]
    print_table(rows)
    worst = max(row["outside_mm"] for row in rows)
    given = " ".join(sys.argv[1:] if arguments is None else arguments)
    report = {
        "command": f"python tools/enclosure.py {given}".strip(),
        "openings": list(OPENINGS),
        "limit_mm": LIMIT_MM,
        "largest_outside_mm": worst,
        "links": rows,
        "machine": doctor.machine(),
        "versions": library_versions() | {"trimesh": trimesh.__version__},
    }
    print(json.dumps(report))
    return 0 if worst <= LIMIT_MM else 1


def measure(
    robot: RobotSpec,
    samples: int,
    rng: np.random.Generator,
    openings: Sequence[float] = OPENINGS,
    every: int = 1,
) -> list[dict[str, Any]]:
    """A row for each link of a robot that is drawn; lengths in mm, volumes in cm³.

    Args:
        robot: the robot.
        samples: how many of each link's surface, beside its corners and its edges' midpoints.
        rng: draws them.
        openings: of the gripper, in [0, 1].
        every: only one in so many corners and midpoints is taken, to be quick.
    """
    collision = CollisionModel(robot, SceneSpec(()))
    links = drawn_links(robot, samples, rng, every)
    outside = dict.fromkeys(links, 0.0)
    for opening in openings:
        model = RobotModel(robot, gripper=opening)
        placed = collision.placed({}, opening)
        poses, joints = model.link_poses(robot.home), placed.joint_poses(robot.home)
        for name, link in links.items():
            T = poses[name]
            points = link.points @ T[:3, :3].T + T[:3, 3]
            parts = [(p, joints[p.joint] @ p.T_joint_part) for p in placed.parts if p.body == name]
            outside[name] = max(outside[name], float(distances(parts, points).max()))
    rows = []
    for name, link in links.items():
        parts = [
            as_part(p, inverse(poses[name]) @ joints[p.joint] @ p.T_joint_part)
            for p in placed.parts
            if p.body == name
        ]
        hull = HullPart(link.points)
        volume, before = union_volume(parts), union_volume(link.source)
        rows.append(
            {
                "robot": robot.name,
                "link": name,
                "samples": len(link.points),
                "outside_mm": outside[name] * 1e3,
                "outside_before_mm": float(
                    np.min([np.maximum(p.outside(link.points), 0) for p in link.source], 0).max()
                    * 1e3
                ),
                "parts": len(parts),
                "parts_before": len(link.source),
                "volume_cm3": volume * 1e6,
                "volume_by_before": volume / before,
                "volume_by_drawn_hull": volume / hull.volume,
                "farthest_from_drawn_mm": farthest_from(parts, link.points, samples, rng) * 1e3,
            }
        )
    return rows


def drawn_links(
    robot: RobotSpec, samples: int, rng: np.random.Generator, every: int = 1
) -> dict[str, Drawn]:
    """The links that the robot's source URDFs draw, and what is attached and collides, by name."""
    found = {}
    for resource, prefix in ((robot.urdf, ""), (robot.gripper.urdf, "gripper_")):
        source = resource_path(resource)
        for element in links_and_joints(source):
            if element.tag != "link" or element.find("visual") is None:
                continue
            vertices, faces = drawn_triangles(element, source.parent)
            points = [surface(shape, samples, rng) for shape in drawn_shapes(element)]
            if len(faces):
                triangles = vertices[faces]
                midpoints = (triangles + np.roll(triangles, 1, 1)).reshape(-1, 3) / 2
                points += [vertices[::every], midpoints[::every]]
                mesh = trimesh.Trimesh(vertices, faces, process=False)
                points.append(_on_triangles(mesh, samples, rng))
            parts = link_parts(element, source.parent)
            found[prefix + element.get("name", "")] = Drawn(np.concatenate(points), parts)
    for body in robot.attachments:
        shapes = [shape for shape in body.shapes if shape.collides]
        if shapes:
            points = [surface(shape, samples, rng) for shape in shapes]
            found[body.name] = Drawn(np.concatenate(points), [ShapePart(s) for s in shapes])
    return found


def _on_triangles(mesh: trimesh.Trimesh, n: int, rng: np.random.Generator) -> Array:
    """Points `(n, 3)` drawn evenly over a mesh's area."""
    chosen = rng.choice(len(mesh.faces), n, p=mesh.area_faces / mesh.area)
    a, b, c = np.moveaxis(mesh.triangles[chosen], 1, 0)
    root, v = np.sqrt(rng.random((n, 1))), rng.random((n, 1))
    return np.asarray((1 - root) * a + root * (1 - v) * b + root * v * c)


def surface(shape: Shape, n: int, rng: np.random.Generator) -> Array:
    """Points `(about n, 3)` on a primitive's surface, its corners among them."""
    if shape.kind == "box":
        mesh = trimesh.creation.box(shape.size)
        local = np.concatenate([mesh.vertices, _on_triangles(mesh, n, rng)])
    elif shape.kind == "sphere":
        local = rng.normal(size=(n, 3))
        local *= shape.size[0] / np.linalg.norm(local, axis=1, keepdims=True)
    else:
        radius, length = shape.size
        angle = rng.uniform(0, 2 * np.pi, n)
        r, z = np.full(n, radius), rng.uniform(-length / 2, length / 2, n)
        cap = rng.random(n) < radius / (radius + length)
        r[cap] *= np.sqrt(rng.random(cap.sum()))
        z[cap | (rng.random(n) < 0.1)] = length / 2
        z[rng.random(n) < 0.5] *= -1
        local = np.stack([r * np.cos(angle), r * np.sin(angle), z], axis=1)
    T = shape.T_body_shape
    return np.asarray(local @ T[:3, :3].T + T[:3, 3])


def distances(parts: Sequence[tuple[ConvexPart, Array]], points: Array) -> Array:
    """How far `(n,)` [m] points are at most outside the union of parts, each with its pose."""
    found = np.full(len(points), np.inf)
    for part, T in parts:
        solid = as_part(part, T)
        left = np.flatnonzero(found > 0)
        out = solid.outside(points[left])
        far = left[out > 0]
        found[left[out <= 0]] = 0.0
        # A point of the part's is no nearer than its nearest.
        reached = np.linalg.norm(points[far] - solid.confined(points[far]), axis=1)
        found[far] = np.minimum(found[far], reached)
    return found


def as_part(part: ConvexPart, T: Array) -> Part:
    """A part of the collision model, where its own frame is at `T (4, 4)`."""
    geometry = part.geometry
    if isinstance(geometry, coal.ConvexBase):
        points = np.array(geometry.points()).reshape(-1, 3)
        return HullPart(points @ T[:3, :3].T + T[:3, 3])
    if isinstance(geometry, coal.Box):
        x, y, z = (2 * float(half) for half in geometry.halfSide)
        return ShapePart(Shape("box", (x, y, z), T))
    if isinstance(geometry, coal.Sphere):
        return ShapePart(Shape("sphere", (float(geometry.radius),), T))
    return ShapePart(Shape("cylinder", (float(geometry.radius), 2 * float(geometry.halfLength)), T))


def union_volume(parts: Sequence[Part]) -> float:
    """The volume [m³] of a union of parts; sampled, always alike, where there are several."""
    if len(parts) == 1:
        return own_volume(parts[0])
    corners = np.concatenate([corners_of(part) for part in parts])
    low, high = corners.min(axis=0), corners.max(axis=0)
    points = np.random.default_rng(0).uniform(low, high, (_VOLUME_SAMPLES, 3))
    inside = np.any([part.outside(points) <= 0 for part in parts], axis=0)
    return float(np.prod(high - low) * inside.mean())


def own_volume(part: Part) -> float:
    """A part's volume [m³]."""
    if isinstance(part, HullPart):
        return part.volume
    size = part.shape.size
    if part.shape.kind == "box":
        return float(np.prod(size))
    return float(
        4 / 3 * np.pi * size[0] ** 3
        if part.shape.kind == "sphere"
        else np.pi * size[0] ** 2 * size[1]
    )


def corners_of(part: Part) -> Array:
    """Points `(n, 3)` whose hull encloses a part."""
    return part.points if isinstance(part, HullPart) else part.shape.corners()


def farthest_from(
    parts: Sequence[Part], drawn: Array, samples: int, rng: np.random.Generator
) -> float:
    """How far [m] the parts' outer surface is from the drawn samples, at most."""
    tree, farthest = cKDTree(drawn), 0.0
    for part in parts:
        if isinstance(part, HullPart):
            hull = ConvexHull(part.points)
            mesh = trimesh.Trimesh(part.points, hull.simplices, process=False)
            points = np.concatenate([part.points, _on_triangles(mesh, samples, rng)])
        else:
            points = surface(part.shape, samples, rng)
        others = [other for other in parts if other is not part]
        outer = np.all([other.outside(points) >= 0 for other in others] or [True], axis=0)
        points = points[np.broadcast_to(outer, len(points))]
        if len(points):
            farthest = max(farthest, float(tree.query(points)[0].max()))
    return farthest


def print_table(rows: Sequence[dict[str, Any]]) -> None:
    """The rows for a person, on stderr."""
    print(
        f"{'robot':11}{'link':31}{'samples':>9}{'outside':>10}{'(before)':>10}{'parts':>6}"
        f"{'volume':>9}{'/before':>9}{'/drawn hull':>12}{'farthest':>10}",
        file=sys.stderr,
    )
    for row in rows:
        print(
            f"{row['robot']:11}{row['link']:31}{row['samples']:9}{row['outside_mm']:10.5f}"
            f"{row['outside_before_mm']:10.3f}{row['parts']:6}{row['volume_cm3']:9.1f}"
            f"{row['volume_by_before']:9.4f}{row['volume_by_drawn_hull']:12.4f}"
            f"{row['farthest_from_drawn_mm']:10.2f}",
            file=sys.stderr,
        )


if __name__ == "__main__":
    sys.exit(main())
