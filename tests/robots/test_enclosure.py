"""A link's parts enclose all that is drawn of it, and are as tight as that allows."""

from __future__ import annotations

import importlib.util
import itertools
import xml.etree.ElementTree as ET
from pathlib import Path

import numpy as np
import pytest
import trimesh

from sart_toolkit.errors import InvalidInput
from sart_toolkit.poses import pose, rpy_pose
from sart_toolkit.robots import get_robot
from sart_toolkit.robots import urdf as urdf_module
from sart_toolkit.robots.enclosure import (
    TOLERANCE,
    HullPart,
    ShapePart,
    enclose,
    shape_stands_out,
    standing_out,
)
from sart_toolkit.robots.references import resource_path
from sart_toolkit.robots.source import links_and_joints
from sart_toolkit.robots.spec import Shape
from sart_toolkit.robots.urdf import composed_urdf, drawn_shapes, drawn_triangles, link_parts

_OWN = Path(__file__).parents[2] / "docs" / "examples" / "04_own_robot.py"


def _box(size, p=(0, 0, 0)):
    mesh = trimesh.creation.box(size)
    mesh.apply_translation(p)
    return mesh


def _soup(*meshes):
    """Corners and triangles of several meshes."""
    joined = trimesh.util.concatenate(meshes)
    return np.asarray(joined.vertices), np.asarray(joined.faces)


def _hull(*meshes):
    return HullPart(np.concatenate([mesh.vertices for mesh in meshes]))


def _iiwa():
    found = importlib.util.spec_from_file_location("own_robot", _OWN)
    module = importlib.util.module_from_spec(found)
    found.loader.exec_module(module)
    return module.IIWA


@pytest.mark.parametrize("name", ["ur5e_2f85", "ur5e_hande", "iiwa_2f85"])
def test_parts_of_every_link_enclose_its_drawn_and_its_collision_meshes(name):
    robot = _iiwa() if name == "iiwa_2f85" else get_robot(name)
    urdf = composed_urdf(robot)
    composed = {link.get("name"): link for link in ET.parse(urdf).getroot().findall("link")}
    checked = 0
    for resource, prefix in ((robot.urdf, ""), (robot.gripper.urdf, "gripper_")):
        source = resource_path(resource)
        for link in links_and_joints(source):
            if link.tag != "link" or link.find("visual") is None:
                continue
            made = composed[prefix + link.get("name")]
            parts = link_parts(made, urdf.parent)
            # What the source draws, what is drawn now, and what collided in the source.
            drawn = [drawn_triangles(link, source.parent), drawn_triangles(made, urdf.parent)]
            for vertices, faces in drawn:
                assert (standing_out(parts, vertices, faces) <= TOLERANCE / 10).all()
            for shape in drawn_shapes(link):
                assert not shape_stands_out(parts, shape)
            for part in link_parts(link, source.parent):
                if isinstance(part, HullPart):
                    assert min(p.outside(part.points).max() for p in parts) <= TOLERANCE / 10
                else:
                    assert not shape_stands_out(parts, part.shape)
            checked += 1
    assert checked >= 11


def test_a_part_takes_in_what_stands_out_a_little_and_no_more():
    part = _hull(_box((0.1, 0.1, 0.1)))
    drawn = _box((0.06, 0.06, 0.104))
    made = enclose([part], *_soup(drawn))
    (grown,) = made
    np.testing.assert_allclose(np.ptp(grown.points, axis=0), [0.1, 0.1, 0.104], atol=1e-12)
    assert grown.volume < 1.04 * part.volume
    assert (standing_out([part], *_soup(drawn)) > 1e-3).any()
    assert (standing_out(made, *_soup(drawn)) <= 1e-9).all()


def test_what_lies_inside_leaves_a_part_as_it_is():
    part = _hull(_box((0.1, 0.1, 0.1)))
    made = enclose([part], *_soup(_box((0.1, 0.08, 0.02)), _box((0.01, 0.01, 0.01))))
    assert made == [part]


def test_what_stands_far_out_gets_a_part_of_its_own_where_that_is_tighter():
    body, bracket = _box((0.1, 0.1, 0.1)), _box((0.02, 0.02, 0.02), (0, 0, 0.2))
    part = _hull(body)
    made = enclose([part], *_soup(body, bracket))
    assert made[0] is part
    assert made[1].volume == pytest.approx(8e-6)


def test_a_mesh_over_several_parts_keeps_each_of_them_tight():
    # An angle of two plates, as a convex decomposition has it, drawn 1 mm thicker.
    plates = _box((0.2, 0.1, 0.01), (0.1, 0, 0)), _box((0.01, 0.1, 0.2), (0, 0, 0.1))
    drawn = _box((0.2, 0.1, 0.011), (0.1, 0, 0)), _box((0.011, 0.1, 0.2), (0, 0, 0.1))
    parts = [_hull(plate) for plate in plates]
    made = enclose(parts, *_soup(*drawn))
    assert len(made) == 2
    for before, after in zip(parts, made, strict=True):
        assert after.volume < 1.12 * before.volume
    assert (standing_out(made, *_soup(*drawn)) <= 1e-9).all()


def test_a_primitive_that_does_not_enclose_is_accompanied_by_a_hull():
    ball = ShapePart(Shape("sphere", (0.05,)))
    made = enclose([ball], *_soup(_box((0.1, 0.1, 0.02))))
    assert made[0] is ball
    assert made[1].volume == pytest.approx(0.1 * 0.1 * 0.02)


def test_a_mesh_of_very_many_pieces_ends_in_few_parts():
    rng = np.random.default_rng(0)
    pieces = [_box((0.01, 0.01, 0.01), p) for p in rng.uniform(-0.5, 0.5, (200, 3))]
    made = enclose([ShapePart(Shape("sphere", (0.01,)))], *_soup(*pieces))
    assert len(made) < 12
    assert (standing_out(made, *_soup(*pieces)) <= 1e-9).all()


def test_flat_and_tiny_things_have_a_hull_too():
    square = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]], dtype=np.float64)
    for points in (square, square[:2], square[:1], 1e-12 * square):
        part = HullPart(points)
        assert (part.outside(points) < 0).all()
        assert part.volume < 1e-3


@pytest.mark.parametrize(
    ("shape", "other", "stands_out"),
    [
        (Shape("box", (0.1, 0.1, 0.1)), Shape("box", (0.1, 0.1, 0.1)), False),
        (Shape("cylinder", (0.05, 0.1)), Shape("cylinder", (0.05, 0.1)), False),
        (Shape("sphere", (0.05,)), Shape("sphere", (0.05,)), False),
        (Shape("sphere", (0.05,)), Shape("sphere", (0.051,)), True),
        (Shape("box", (0.1, 0.1, 0.1)), Shape("sphere", (0.05,)), False),
        (Shape("cylinder", (0.05, 0.1)), Shape("sphere", (0.05,)), False),
        (Shape("cylinder", (0.05, 0.1)), Shape("sphere", (0.05,), pose([0, 0, 0.001])), True),
        (Shape("box", (0.1, 0.1, 0.1)), Shape("cylinder", (0.04, 0.1)), False),
        (Shape("box", (0.1, 0.1, 0.1)), Shape("cylinder", (0.06, 0.1)), True),
        (Shape("cylinder", (0.05, 0.1)), Shape("box", (0.06, 0.06, 0.1)), False),
        (Shape("cylinder", (0.05, 0.1)), Shape("box", (0.08, 0.08, 0.1)), True),
    ],
)
def test_a_primitive_in_a_primitive_is_known_to_be_inside(shape, other, stands_out):
    T = pose([0.1, -0.2, 0.3], [0.3, -0.5, 0.7])
    part = ShapePart(Shape(shape.kind, shape.size, T @ shape.T_body_shape))
    moved = Shape(other.kind, other.size, T @ other.T_body_shape)
    assert shape_stands_out([part], moved) == stands_out
    hull = HullPart(part.shape.corners())
    assert not (shape_stands_out([hull], moved) and not stands_out)


@pytest.mark.parametrize("kind", ["hull", "box", "sphere", "cylinder"])
def test_confined_points_are_inside_and_move_no_farther_than_they_must(kind):
    size = {"box": (0.1, 0.2, 0.3), "sphere": (0.1,), "cylinder": (0.1, 0.2)}
    part = (
        HullPart(np.random.default_rng(1).normal(size=(100, 3)) * 0.1)
        if kind == "hull"
        else ShapePart(Shape(kind, size[kind], pose([0.1, 0, 0], [0, 1, 0])))
    )
    points = np.random.default_rng(0).normal(size=(500, 3)) * 0.2
    confined = part.confined(points)
    out = part.outside(points)
    assert (part.outside(confined) <= 1e-7).all()
    np.testing.assert_array_equal(confined[out <= 0], points[out <= 0])
    moved = np.linalg.norm(confined - points, axis=1)
    assert (moved[out > 0] >= out[out > 0] - 1e-7).all()
    if kind == "hull":
        assert np.median(moved[out > 0] / out[out > 0]) < 1.3


# --- as they are composed -----------------------------------------------------------------------


def _draw(tmp_path, visual, collision=None):
    """Let the tiny robot's link `upper` be drawn and collide as given."""
    arm = tmp_path / "arm.urdf"
    text = arm.read_text()
    at = text.index("<collision>", text.index('name="upper"'))
    end = text.index("</collision>", at) + len("</collision>")
    arm.write_text(text[:at] + (collision or text[at:end]) + visual + text[end:])


def _composed(spec):
    urdf = composed_urdf(spec)
    links = {link.get("name"): link for link in ET.parse(urdf).getroot().findall("link")}
    return link_parts(links["upper"], urdf.parent)


_PLACE = '<origin xyz="0.1 -0.2 0.3" rpy="0.4 0.5 -0.6"/>'


@pytest.mark.parametrize(
    "geometry",
    ['<sphere radius="0.2"/>', '<cylinder radius="0.02" length="0.4"/>', '<box size="1 1 .01"/>'],
)
def test_a_link_drawn_by_a_primitive_that_stands_out_collides_by_it(make_tiny, tmp_path, geometry):
    _draw(tmp_path, f"<visual>{_PLACE}<geometry>{geometry}</geometry></visual>")
    box, drawn = _composed(make_tiny())
    assert box.shape.size == (0.1, 0.1, 0.1)
    assert drawn.shape.kind in geometry
    np.testing.assert_allclose(drawn.shape.T_body_shape[:3, 3], [0.1, -0.2, 0.3])


def test_scale_and_origin_count_when_drawn_and_collision_meshes_are_compared(make_tiny, tmp_path):
    _box((100, 100, 100)).export(tmp_path / "solid.stl")
    _box((20, 20, 300)).export(tmp_path / "drawn.stl")
    mesh = '<geometry><mesh filename="{}" scale="0.001 -0.001 0.001"/></geometry>'
    _draw(
        tmp_path,
        f"<visual>{_PLACE}{mesh.format('drawn.stl')}</visual>",
        f"<collision>{mesh.format('solid.stl')}</collision>",
    )
    parts = _composed(make_tiny())
    T = rpy_pose([0.1, -0.2, 0.3], [0.4, 0.5, -0.6])
    corners = _box((0.02, 0.02, 0.3)).vertices @ T[:3, :3].T + T[:3, 3]
    assert np.min([part.outside(corners) for part in parts], axis=0).max() < 1e-7
    assert max(part.outside(_box((0.1, 0.1, 0.1)).vertices).max() for part in parts[:1]) < 1e-7


def test_a_robot_whose_parts_do_not_enclose_it_is_refused_by_link(make_tiny, tmp_path, monkeypatch):
    _box((0.1, 0.1, 0.1)).export(tmp_path / "solid.stl")
    _box((0.1, 0.1, 0.104)).export(tmp_path / "drawn.stl")
    mesh = '<geometry><mesh filename="{}"/></geometry>'
    _draw(
        tmp_path,
        f"<visual>{mesh.format('drawn.stl')}</visual>",
        f"<collision>{mesh.format('solid.stl')}</collision>",
    )
    # As if parts were not grown.
    monkeypatch.setattr(urdf_module, "enclose", lambda parts, v, faces: list(parts))
    with pytest.raises(InvalidInput, match="link 'upper': what is drawn stands .* mm out of its"):
        composed_urdf(make_tiny())


@pytest.mark.parametrize("signs", list(itertools.product((-1, 1), repeat=3)))
def test_a_mirrored_mesh_is_enclosed(make_tiny, tmp_path, signs):
    corner = trimesh.Trimesh(
        [[0, 0, 0], [0.3, 0, 0], [0, 0.2, 0], [0, 0, 0.1]],
        [[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]],
    )
    corner.export(tmp_path / "solid.stl")
    scale = " ".join(map(str, signs))
    shape = f'<geometry><mesh filename="solid.stl" scale="{scale}"/></geometry>'
    _draw(tmp_path, f"<visual>{shape}</visual>", f"<collision>{shape}</collision>")
    (part,) = _composed(make_tiny())
    assert part.volume == pytest.approx(corner.volume)
    assert part.outside(corner.vertices * signs).max() < 1e-7
