"""Meshes as bodies' shapes: checked whole when they are read, enclosed by their convex parts."""

from __future__ import annotations

import logging
import pickle
import shutil
import sys
from types import SimpleNamespace

import numpy as np
import pytest
import trimesh
from PIL import Image
from scipy.spatial import ConvexHull

from sart_toolkit.errors import BrokenFile, InvalidInput, MissingExtra, MissingFile
from sart_toolkit.poses import pose
from sart_toolkit.robots import meshes
from sart_toolkit.robots.spec import MeshShape, Shape, mass_from_density, mass_properties
from sart_toolkit.robots.visuals import body_meshes
from sart_toolkit.testing.vessels import funnel, mug, mug_parts
from sart_toolkit.workers.parcels import pack


@pytest.fixture(autouse=True)
def own_cache(tmp_path, monkeypatch):
    monkeypatch.setenv("SART_CACHE", str(tmp_path / "cache"))


def saved(mesh, path):
    mesh.export(path)
    return str(path)


@pytest.fixture
def mug_files(tmp_path):
    """A mug's file, and those of its convex parts."""
    parts = [saved(part, tmp_path / f"part{i}.stl") for i, part in enumerate(mug_parts())]
    return saved(mug(), tmp_path / "mug.stl"), tuple(parts)


def outside(parts, points):
    """How far [m] each point is outside of the part that it is deepest in, by scipy alone."""
    planes = [ConvexHull(part).equations for part in parts]
    return np.min([(points @ p[:, :3].T + p[:, 3]).max(axis=1) for p in planes], axis=0)


def surface(mesh, n=4000):
    points, _ = trimesh.sample.sample_surface(mesh, n, seed=0)
    return np.concatenate([points, mesh.vertices])


# --- what is refused ----------------------------------------------------------------------------


@pytest.mark.parametrize("suffix", ["stl", "obj", "ply", "off", "glb"])
def test_a_mesh_is_the_same_from_every_type_of_file(tmp_path, suffix):
    shape = MeshShape(saved(funnel(), tmp_path / f"funnel.{suffix}"))
    np.testing.assert_allclose(np.ptp(shape.corners(), axis=0), [0.1, 0.1, 0.1], atol=1e-6)
    assert abs(shape.mesh().volume - funnel().volume) < 1e-9


def test_a_missing_file_is_refused(tmp_path):
    with pytest.raises(MissingFile, match=r"no such file \(cup.stl\); check the path of the mesh"):
        MeshShape(str(tmp_path / "cup.stl"))


@pytest.mark.parametrize("ascii_", [False, True])
def test_a_truncated_file_is_refused(tmp_path, ascii_):
    content = mug().export(file_type="stl_ascii" if ascii_ else "stl")
    content = content.encode() if ascii_ else content
    (tmp_path / "mug.stl").write_bytes(content[: len(content) // 2])
    with pytest.raises(BrokenFile, match=r"mesh mug.stl: can't be read \(.*\); export it again"):
        MeshShape(str(tmp_path / "mug.stl"))


def test_an_empty_mesh_is_refused(tmp_path):
    (tmp_path / "none.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\n")
    with pytest.raises((InvalidInput, BrokenFile), match=r"none.obj.*export it again"):
        MeshShape(str(tmp_path / "none.obj"))


def test_a_mesh_in_millimetres_is_refused_with_the_scale_to_give(tmp_path, mug_files):
    large = mug().copy().apply_scale(1000)
    file = saved(large, tmp_path / "large.stl")
    with pytest.raises(InvalidInput, match=r"mesh large.stl reaches 100 m .* give scale=0.001"):
        MeshShape(file)
    right = MeshShape(file, scale=0.001)
    np.testing.assert_allclose(np.ptp(right.corners(), 0), np.ptp(mug().vertices, 0), atol=1e-6)
    with pytest.raises(InvalidInput, match="mesh mug.stl is 1.1e-07 m long, expected at least"):
        MeshShape(mug_files[0], scale=1e-6)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"scale": 0.0}, "scale of mesh mug.stl: expected a finite number > 0"),
        ({"scale": (1.0, 2.0)}, "scale of mesh mug.stl: expected 1 or 3 numbers, got 2"),
        ({"collision": "box"}, "collision of mesh mug.stl: expected 'hull', 'decomposed' or"),
        ({"collision": ()}, "collision of mesh mug.stl: has no file"),
        ({"rgba": (1, 0, 0, 1), "texture": "x.png"}, "has rgba and texture; give one of them"),
        ({"T_body_shape": np.zeros((4, 4))}, "T_body_shape: not a rigid transform"),
    ],
)
def test_a_setting_that_can_not_be_honoured_is_refused(mug_files, options, message):
    with pytest.raises(InvalidInput, match=message):
        MeshShape(mug_files[0], **options)


def test_a_file_of_another_type_is_refused(tmp_path):
    (tmp_path / "mug.step").write_text("ISO-10303-21;")
    with pytest.raises(InvalidInput, match=r"mesh mug.step: expected a file ending in .*convert"):
        MeshShape(str(tmp_path / "mug.step"))


def test_a_file_that_changes_after_the_shape_was_made_is_noticed(mug_files):
    shape = MeshShape(mug_files[0])
    saved(funnel(), mug_files[0])
    meshes.read_mesh.cache_clear()
    with pytest.raises(BrokenFile, match="mug.stl: has changed since it was first read; start"):
        shape.mesh()


def test_what_tells_meshes_apart_is_their_files_content(tmp_path, mug_files):
    file, parts = mug_files
    shape = MeshShape(file)
    elsewhere = MeshShape(shutil.copy(file, tmp_path / "copy.stl"))
    assert shape.identity == elsewhere.identity and shape.digest == elsewhere.digest
    others = [MeshShape(file, scale=1.01), MeshShape(file, collision=parts)]
    others.append(MeshShape(saved(funnel(), tmp_path / "copy.stl")))
    assert len({shape.digest, *(other.digest for other in others)}) == 4


def test_a_mesh_goes_with_its_files_to_other_processes_and_machines(mug_files):
    shape = MeshShape(mug_files[0], collision=mug_files[1])
    again = pickle.loads(pickle.dumps(shape))  # noqa: S301 - ours
    assert again.identity == shape.identity and len(again.convex_parts()) == len(mug_files[1])
    assert set(pack(shape).files) == {mug_files[0], *mug_files[1]}


# --- convex parts -------------------------------------------------------------------------------


def test_a_hull_encloses_the_mesh(mug_files):
    (part,) = MeshShape(mug_files[0], T_body_shape=pose([1, 2, 3])).convex_parts()
    assert outside([part], surface(mug())).max() < 1e-7


def test_given_parts_enclose_the_mesh_and_leave_the_inside_of_a_mug_free(mug_files):
    shape = MeshShape(mug_files[0], collision=mug_files[1])
    parts = shape.convex_parts()
    assert outside(parts, surface(mug())).max() < 1e-5
    inside = np.array([[0, 0, 0.05], [0.05, 0, 0.05]])
    assert outside(parts, inside).min() > 0.005
    # They are no larger than they were given.
    given = sum(part.volume for part in mug_parts())
    assert abs(sum(ConvexHull(part).volume for part in parts) - given) < 1e-3 * given


def test_parts_that_leave_some_of_the_mesh_out_are_refused(mug_files):
    file, parts = mug_files
    with pytest.raises(InvalidInput, match=r"near \(0.0\d+, .* m it stands .* mm out of its parts"):
        MeshShape(file, collision=parts[:-1])


def test_what_stands_out_of_parts_by_a_little_is_taken_in(tmp_path, mug_files):
    file, parts = mug_files
    thin = [part.copy().apply_scale(0.985) for part in mug_parts()]
    given = tuple(saved(part, tmp_path / f"thin{i}.stl") for i, part in enumerate(thin))
    points = surface(mug())
    assert outside([part.vertices for part in thin], points).max() > 5e-4
    assert outside(MeshShape(file, collision=given).convex_parts(), points).max() < 1e-5


def test_a_hull_with_very_many_corners_becomes_a_simpler_one_around_it():
    ball = trimesh.creation.icosphere(subdivisions=4, radius=0.05)
    corners = meshes.hull_corners(ball.vertices)
    assert len(ball.vertices) > 2000 and 50 < len(corners) <= 250
    assert outside([corners], ball.vertices).max() < 1e-9
    assert np.linalg.norm(corners, axis=1).max() < 0.05 * 1.06
    rod = trimesh.creation.cylinder(0.04, 0.2, sections=600)
    corners = meshes.hull_corners(rod.vertices)
    assert len(corners) <= 250 and outside([corners], rod.vertices).max() < 1e-9
    assert np.hypot(corners[:, 0], corners[:, 1]).max() < 0.04 * 1.005


def test_without_coacd_the_error_says_how_to_do_without(mug_files, monkeypatch):
    monkeypatch.setattr(meshes.importlib.util, "find_spec", lambda name: None)
    with pytest.raises(MissingExtra, match=r"mesh mug.stl: collision='decomposed' needs CoACD;"):
        MeshShape(mug_files[0], collision="decomposed")


def test_parts_that_coacd_would_leave_too_small_are_grown(mug_files, monkeypatch):
    """A stand-in gives a mug's true parts, each a bit too small; CoACD itself is tested below."""
    small = [part.copy().apply_scale(0.97) for part in mug_parts()]
    fake = SimpleNamespace(
        Mesh=lambda vertices, faces: None,
        set_log_level=lambda level: None,
        run_coacd=lambda mesh, **_: [(part.vertices, part.faces) for part in small],
    )
    monkeypatch.setitem(sys.modules, "coacd", fake)
    monkeypatch.setattr(meshes, "check_coacd", lambda name: None)
    monkeypatch.setattr(meshes.importlib.metadata, "version", lambda name: "0")
    meshes.enclosing_parts.cache_clear()
    shape = MeshShape(mug_files[0], collision="decomposed")
    points = surface(mug())
    assert outside([part.vertices for part in small], points).max() > 1e-3
    assert outside(shape.convex_parts(), points).max() < 1e-5
    # A damaged file of parts in the cache does no harm.
    (kept,) = meshes.cache_dir().glob("parts-*.npz")
    kept.write_bytes(b"damaged")
    meshes.enclosing_parts.cache_clear()
    assert outside(shape.convex_parts(), points).max() < 1e-5
    meshes.enclosing_parts.cache_clear()


@pytest.mark.slow
def test_parts_that_coacd_finds_enclose_the_mesh_and_leave_a_mug_open(mug_files):
    pytest.importorskip("coacd")
    meshes.enclosing_parts.cache_clear()
    parts = MeshShape(mug_files[0], collision="decomposed").convex_parts()
    assert outside(parts, surface(mug())).max() < 1e-5
    assert outside(parts, np.array([[0, 0, 0.06]])).min() > 0.005


# --- mass ---------------------------------------------------------------------------------------


def test_a_mesh_of_a_box_weighs_and_turns_like_the_box(tmp_path):
    size, T = (0.1, 0.2, 0.3), pose([0.1, 0, 0], [0.3, -0.2, 0.5])
    box = Shape("box", size, T)
    shape = MeshShape(saved(trimesh.creation.box(size), tmp_path / "box.stl"), T_body_shape=T)
    for ours, exact in zip(mass_properties([shape], 2.0), mass_properties([box], 2.0), strict=True):
        np.testing.assert_allclose(ours, exact, rtol=1e-5, atol=1e-9)
    mass = mass_from_density([shape], 500.0)
    assert mass == pytest.approx(mass_from_density([box], 500.0), rel=1e-5)
    assert mass == pytest.approx(500 * 0.006, rel=1e-5)


def test_a_mug_weighs_by_its_wall_and_one_with_a_hole_by_its_hull_which_is_said(
    tmp_path, mug_files, caplog
):
    with caplog.at_level(logging.WARNING):
        mass = mass_from_density([MeshShape(mug_files[0])], 1000.0)
    assert mass == pytest.approx(1000 * mug().volume, rel=1e-4) and not caplog.records
    holed = mug().copy()
    holed.update_faces(np.arange(len(holed.faces)) > 3)
    shape = MeshShape(saved(holed, tmp_path / "holed.stl"))
    with caplog.at_level(logging.WARNING):
        mass = mass_from_density([shape], 1000.0)
    assert mass == pytest.approx(1000 * mug().convex_hull.volume, rel=1e-3)
    (record,) = caplog.records
    assert "holed.stl: isn't closed" in record.message and "give the mass" in record.message
    with pytest.raises(InvalidInput, match="density: expected a finite number > 0 kg/m³"):
        mass_from_density([shape], -1.0)


# --- what is drawn ------------------------------------------------------------------------------


def test_a_mesh_is_drawn_in_its_files_colours_or_in_the_one_given(tmp_path):
    box = trimesh.creation.box((0.1, 0.1, 0.1))
    box.visual = trimesh.visual.ColorVisuals(
        box, face_colors=np.where(box.face_normals[:, 2:] > 0.5, [255, 0, 0, 255], [0, 0, 255, 255])
    )
    for suffix in ("ply", "glb"):
        file = saved(box, tmp_path / f"box.{suffix}")
        drawn = body_meshes([MeshShape(file)])
        if suffix == "ply":
            assert sorted(mesh.rgba for mesh in drawn) == [(0, 0, 1, 1), (1, 0, 0, 1)]
            (top,) = (mesh for mesh in drawn if mesh.rgba[0] == 1)
            assert len(top.triangles) == 2 and (top.vertices[:, 2] > 0.049).all()
        (mesh,) = body_meshes([MeshShape(file, rgba=(0, 1, 0, 1))])
        assert mesh.rgba == (0, 1, 0, 1) and len(mesh.triangles) == 12
    (mesh,) = body_meshes([MeshShape(saved(funnel(), tmp_path / "funnel.stl"))])
    assert mesh.rgba == (0.7, 0.7, 0.7, 1.0)


def test_a_texture_is_drawn_as_one_colour_for_each_triangle(tmp_path):
    image = tmp_path / "halves.png"
    pixels = np.zeros((8, 8, 3), np.uint8)
    pixels[:, :4, 0], pixels[:, 4:, 1] = 200, 100
    Image.fromarray(pixels).save(image)
    (tmp_path / "plate.obj").write_text(
        "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nvt 0.1 0.1\nvt 0.3 0.1\nvt 0.9 0.9\nvt 0.7 0.9\n"
        "f 1/1 2/2 3/1\nf 1/3 3/4 4/3\n"
    )
    shape = MeshShape(str(tmp_path / "plate.obj"), scale=0.1, texture=str(image))
    colours = sorted(mesh.rgba for mesh in body_meshes([shape]))
    np.testing.assert_allclose(colours, [[0, 100 / 255, 0, 1], [200 / 255, 0, 0, 1]], atol=1e-3)
    assert set(pack(shape).files) == {str(tmp_path / "plate.obj"), str(image)}
    with pytest.raises(InvalidInput, match=r"has no texture coordinates, so halves.png can't be"):
        MeshShape(saved(funnel(), tmp_path / "funnel.stl"), texture=str(image))
    (tmp_path / "bad.png").write_bytes(b"no image")
    with pytest.raises(BrokenFile, match=r"texture bad.png: can't be read .* give a PNG or JPEG"):
        MeshShape(str(tmp_path / "plate.obj"), scale=0.1, texture=str(tmp_path / "bad.png"))
