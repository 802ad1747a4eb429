"""Distances from a mesh's parts: those of the primitive that it is made like."""

from __future__ import annotations

import dataclasses
from contextlib import closing

import numpy as np
import pytest
import trimesh

from sart_toolkit.annotate.suggest import suggest_radius
from sart_toolkit.collision.cloud import surface_errors
from sart_toolkit.collision.exact import ExactWorld
from sart_toolkit.collision.model import CollisionModel
from sart_toolkit.poses import pose
from sart_toolkit.robots import get_robot
from sart_toolkit.robots.spec import Attachment, MeshShape, Shape
from sart_toolkit.scenes.spec import Body, SceneSpec
from sart_toolkit.testing.closest import ClosestPoints
from sart_toolkit.testing.vessels import mug, mug_parts

# How much nearer [m] a prism of 96 sides about a cylinder of 5 cm is, or a box from a file.
ROUND, EXACT = 0.05 * (1 / np.cos(np.pi / 96) - 1), 1e-7


@pytest.fixture
def mesh_of(tmp_path):
    """A mesh of a primitive: of a cylinder the prism about it, of 96 sides."""

    def make(shape):
        if shape.kind == "box":
            mesh = trimesh.creation.box(shape.size)
        else:
            radius = shape.size[0] / np.cos(np.pi / 96)
            mesh = trimesh.creation.cylinder(radius, shape.size[1], sections=96)
        file = tmp_path / f"{shape.kind}{len(list(tmp_path.iterdir()))}.obj"
        mesh.export(file, digits=12)
        return MeshShape(str(file), T_body_shape=shape.T_body_shape)

    return make


@pytest.fixture
def mug_shape(tmp_path):
    files = []
    for i, mesh in enumerate([mug(), *mug_parts()]):
        files.append(str(tmp_path / f"mug{i}.stl"))
        mesh.export(files[-1])
    return MeshShape(files[0], collision=tuple(files[1:]))


@pytest.mark.parametrize(
    ("shape", "nearer"),
    [(Shape("box", (0.1, 0.08, 0.2)), EXACT), (Shape("cylinder", (0.05, 0.2)), ROUND + EXACT)],
)
def test_distances_from_a_mesh_are_those_of_its_primitive(shape, nearer, mesh_of):
    robot, rng = get_robot("ur5e_2f85"), np.random.default_rng(0)
    T = pose([0.55, 0.1, 0.3], [0.3, -0.4, 0.8])
    held = Attachment("stick", "tool", (Shape("box", (0.02, 0.02, 0.1)),), pose([0, 0, 0.05]))
    like = Attachment("stick", "tool", (mesh_of(held.shapes[0]),), held.T_frame_body)
    qs = robot.home + rng.normal(0, 0.4, (20, 6))
    found = []
    for thing, stick in ((shape, held), (mesh_of(shape), like)):
        scene = SceneSpec((Body("thing", (thing,), T),), held=(stick,))
        placed = CollisionModel(robot, scene).placed({"thing": T}, 0.5)
        names = [placed.names(k) for k in range(len(placed.pairs))]
        found.append((names, np.array([placed.distances(q) for q in qs])))
    (names, exact), (mesh_names, mesh) = found
    assert mesh_names == names
    assert (mesh <= exact + 2 * EXACT).all()
    # Where two overlap, what is deepest may be another place.
    apart = exact > 0
    assert apart.any() and (exact - mesh)[apart].max() <= nearer + EXACT


def test_the_independent_check_sees_a_meshs_triangles_and_the_model_is_never_farther(mug_shape):
    """Also where parts had left some of the mesh out, the check would see it."""
    robot, rng = get_robot("ur5e_2f85"), np.random.default_rng(1)
    T = pose([0.5, 0.1, 0.35], [0.3, 0.2, 0.1])
    scene = SceneSpec((Body("mug", (mug_shape,), T),))
    placed = CollisionModel(robot, scene).placed({"mug": T}, 0.5)
    with closing(ClosestPoints(robot, scene, joints_apart=2)) as closest:
        closest.place({"mug": T}, 0.5)
        near = 0
        for _ in range(60):
            q = robot.home + rng.normal(0, 0.3, 6)
            links = {placed.names(k)[0] for k in placed.tool_pairs()}
            for link in sorted(links):
                ours = min(
                    d for k, d in enumerate(placed.distances(q)) if placed.names(k) == (link, "mug")
                )
                theirs = closest.pair(q, link, "mug", within=0.3)
                if 0 < theirs < 0.3:
                    near += 1
                    assert ours <= theirs + 2e-5
                    # Parts are as large as the mesh, to what little straddles two of them.
                    assert ours >= theirs - 2e-3
        assert near > 20


def test_points_on_a_mesh_are_no_errors_of_a_cloud(mug_shape):
    points, _ = trimesh.sample.sample_surface(mug(), 300, seed=0)

    class Cloud:
        def __init__(self, points):
            self.points = points

        def __len__(self):
            return len(self.points)

    T = pose([0.5, 0, 0.1], [0.1, 0.2, 0.3])
    scene = SceneSpec((Body("mug", (mug_shape,), T),))
    world = points @ T[:3, :3].T + T[:3, 3]
    assert surface_errors(Cloud(world), scene, {"mug": T}).max() < 1e-6
    middle = (T @ [0, 0, 0.05, 1])[None, :3]
    assert surface_errors(Cloud(middle), scene, {"mug": T})[0] == pytest.approx(0.036, abs=1e-3)


def test_suggested_radii_of_meshes_are_those_of_their_primitives_and_never_larger(
    peg_demonstration, peg_task, peg_model, mesh_of
):
    """A box's to a micrometre; a cylinder's by at most what its prism is nearer and turns add."""
    block = next(body for body in peg_task.scene.bodies if body.name == "block")
    solid = [shape for shape in block.shapes if shape.collides]
    for shapes, nearer in (
        (solid, EXACT),
        ([Shape("cylinder", (0.05, 0.04), pose([0, 0, 0.02]))], ROUND),
    ):
        radii = []
        for made in (tuple(shapes), tuple(mesh_of(shape) for shape in shapes)):
            bodies = tuple(
                dataclasses.replace(body, shapes=made) if body.name == "block" else body
                for body in peg_task.scene.bodies
            )
            scene = dataclasses.replace(peg_task.scene, bodies=bodies)
            world = ExactWorld(peg_demonstration, peg_model.spec, scene)
            found = [suggest_radius(world, peg_demonstration, t) for t in (0, 10, 20)]
            radii.append([each.radius for each in found])
        primitive, mesh = np.array(radii)
        assert primitive.max() > 0.02
        assert (mesh <= primitive + 2e-6).all()
        assert (mesh >= primitive - nearer - 2e-6).all()
