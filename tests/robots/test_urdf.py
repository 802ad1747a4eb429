"""The composed URDF: one small self-contained file, its solids enclose the source's, made once."""

from __future__ import annotations

import os
import re
import xml.etree.ElementTree as ET
from collections import Counter

import numpy as np
import pytest
import trimesh

from sart_toolkit.errors import BrokenFile, CannotWrite, InvalidInput, MissingExtra, MissingFile
from sart_toolkit.poses import pose, rpy_pose
from sart_toolkit.robots import urdf as urdf_module
from sart_toolkit.robots.references import cache_dir, resource_path
from sart_toolkit.robots.spec import Attachment, Shape
from sart_toolkit.robots.urdf import assumptions, composed_urdf

BOX = (Shape("box", (0.02, 0.02, 0.02)),)


@pytest.fixture(scope="session")
def fresh_urdf(spec, tmp_path_factory):
    """The UR5e's composed URDF, made now."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("SART_CACHE", str(tmp_path_factory.mktemp("cache")))
        yield composed_urdf(spec)


@pytest.fixture(scope="session")
def robot(fresh_urdf):
    return ET.parse(fresh_urdf).getroot()


def source_robots(spec):
    """(name prefix, folder, parsed URDF) of the arm's and the gripper's sources."""
    for prefix, resource in (("", spec.urdf), ("gripper_", spec.gripper.urdf)):
        path = resource_path(resource)
        # The sources use the prefix drake: without declaring it.
        yield prefix, path.parent, ET.fromstring(path.read_text().replace("drake:", "drake_"))


def meshes(link, kind, folder):
    """The link's meshes of a kind, scaled, None for other geometry."""
    found = []
    for element in link.findall(kind):
        mesh = element.find("geometry/mesh")
        if mesh is None:
            found.append(None)
            continue
        loaded = trimesh.load(folder / mesh.get("filename"), force="mesh")
        loaded.apply_scale([float(s) for s in mesh.get("scale", "1 1 1").split()])
        found.append(loaded)
    return found


def place(element):
    origin = element.find("origin")
    attributes = {} if origin is None else origin.attrib
    p, rpy = ([float(x) for x in attributes.get(k, "0 0 0").split()] for k in ("xyz", "rpy"))
    return rpy_pose(p, rpy)


def farthest_outside(mesh, points):
    """How far [m] the farthest point lies outside a convex mesh's face planes (< 0: all inside)."""
    normals = mesh.face_normals
    offsets = np.einsum("ij,ij->i", normals, mesh.triangles[:, 0])
    return float((points @ normals.T - offsets).max())


def test_links_and_joints_have_unique_names(robot):
    for kind in ("link", "joint"):
        counts = Counter(element.get("name") for element in robot.findall(kind))
        assert [name for name, count in counts.items() if count > 1] == []


def test_links_form_one_tree_with_the_arms_base_as_its_root(robot):
    links = {link.get("name") for link in robot.findall("link")}
    children = [joint.find("child").get("link") for joint in robot.findall("joint")]
    parents = {joint.find("parent").get("link") for joint in robot.findall("joint")}
    assert max(Counter(children).values()) == 1
    assert parents <= links
    assert links - set(children) == {"base_link"}
    assert {"tool", "tool0", "wrist_camera", "gripper_base_link"} <= links


def test_no_extension_of_a_vendor_and_no_mimic_is_left(fresh_urdf, robot):
    assert re.findall(r"drake\S*|<mimic", fresh_urdf.read_text()) == []
    assert {element.tag for element in robot} == {"link", "joint"}


def test_every_link_has_an_inertia_that_a_body_can_have(robot):
    for link in robot.findall("link"):
        inertial = link.find("inertial")
        assert float(inertial.find("mass").get("value")) > 0
        xx, xy, xz, yy, yz, zz = (
            float(inertial.find("inertia").get(k))
            for k in ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")
        )
        least, middle, most = np.linalg.eigvalsh([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
        assert least > 0
        assert most <= (least + middle) * (1 + 1e-6), link.get("name")


def test_every_mesh_lies_beside_the_urdf(fresh_urdf, robot):
    names = [mesh.get("filename") for mesh in robot.iter("mesh")]
    assert names
    for name in names:
        assert (fresh_urdf.parent / name).is_file()
        assert os.path.basename(name) == name


def test_collision_parts_are_convex_and_as_tight_as_what_they_enclose(spec, fresh_urdf, robot):
    links = {link.get("name"): link for link in robot.findall("link")}
    checked = 0
    for prefix, folder, source in source_robots(spec):
        for link in source.findall("link"):
            composed = links[prefix + link.get("name")]
            ours = meshes(composed, "collision", fresh_urdf.parent)
            theirs = meshes(link, "collision", folder)
            if len(ours) > len(theirs):
                # A primitive can't grow, so what it doesn't enclose has parts of its own.
                assert prefix + link.get("name") == "base_link_inertia"
            for part in filter(None, ours):
                assert farthest_outside(part, part.vertices) < 1e-6
            drawn = meshes(link, "visual", folder)
            for part, *originals in zip(ours, theirs, drawn, strict=False):
                if part is None or None in originals:
                    continue
                points = np.concatenate([original.vertices for original in originals])
                for original in originals:
                    assert farthest_outside(part, original.vertices[::29]) < 1e-6
                # Not larger than it must be either.
                bounds = [points.min(axis=0), points.max(axis=0)]
                np.testing.assert_allclose(part.bounds, bounds, atol=1e-6)
                checked += 1
    assert checked > 10


def test_visual_and_collision_geometry_stays_where_the_source_has_it(spec, robot):
    links = {link.get("name"): link for link in robot.findall("link")}
    for prefix, _, source in source_robots(spec):
        for link in source.findall("link"):
            for kind in ("visual", "collision"):
                # What had to be added to enclose the link comes last.
                pairs = zip(
                    links[prefix + link.get("name")].findall(kind), link.findall(kind), strict=False
                )
                for ours, theirs in pairs:
                    np.testing.assert_allclose(place(ours), place(theirs), atol=1e-12)


def test_visual_meshes_show_every_triangle_of_the_source(spec, fresh_urdf, robot):
    links = {link.get("name"): link for link in robot.findall("link")}
    seen = 0
    for prefix, folder, source in source_robots(spec):
        for link in source.findall("link"):
            ours = meshes(links[prefix + link.get("name")], "visual", fresh_urdf.parent)
            theirs = meshes(link, "visual", folder)
            for part, original in zip(ours, theirs, strict=True):
                if original is None:
                    continue
                assert len(part.faces) == len(original.faces)
                np.testing.assert_allclose(part.bounds, original.bounds, atol=1e-8)
                assert part.area == pytest.approx(original.area, rel=1e-6)
                seen += 1
    assert seen > 15


def test_every_visual_has_a_colour_and_materials_have_unique_names(robot):
    materials = [visual.find("material") for visual in robot.iter("visual")]
    assert all(material.find("color") is not None for material in materials)
    names = [material.get("name") for material in materials]
    assert len(set(names)) == len(names)


def test_what_is_attached_has_its_place_its_shapes_and_its_mass(make_tiny):
    T = pose([0.1, -0.2, 0.3], [0.4, 0.5, -0.6])
    shapes = (
        Shape("box", (0.1, 0.2, 0.3), pose([0.01, 0, 0])),
        Shape("cylinder", (0.05, 0.4), collides=False),
        Shape("sphere", (0.05,)),
    )
    held = Attachment("peg", "tool", shapes, T, mass=0.25)
    robot = ET.parse(composed_urdf(make_tiny(), (held,))).getroot()
    joint = next(j for j in robot.findall("joint") if j.find("child").get("link") == "peg")
    assert joint.find("parent").get("link") == "tool"
    np.testing.assert_allclose(place(joint), T, atol=1e-9)
    link = next(link for link in robot.findall("link") if link.get("name") == "peg")
    assert float(link.find("inertial/mass").get("value")) == 0.25
    drawn = [next(iter(v.find("geometry"))).tag for v in link.findall("visual")]
    solid = [next(iter(c.find("geometry"))).tag for c in link.findall("collision")]
    assert drawn == ["box", "cylinder", "sphere"]
    assert solid == ["box", "sphere"]
    np.testing.assert_allclose(place(link.find("visual")), shapes[0].T_body_shape, atol=1e-9)


@pytest.mark.parametrize(
    "rotvec", [(0, np.pi / 2, 0), (0, -np.pi / 2, 0), (np.pi, 0, 0), (0, 0, -3), (1, 2, -1)]
)
def test_an_attachment_may_be_turned_any_way(make_tiny, rotvec):
    T = pose([0, 0, 0.1], rotvec)
    robot = ET.parse(composed_urdf(make_tiny(), (Attachment("peg", "tool", BOX, T),))).getroot()
    joint = next(j for j in robot.findall("joint") if j.find("child").get("link") == "peg")
    np.testing.assert_allclose(place(joint), T, atol=1e-9)


# --- the cache ----------------------------------------------------------------------------------


def test_a_composed_urdf_is_made_once(make_tiny, monkeypatch):
    spec = make_tiny()
    first = composed_urdf(spec)
    before = {p: p.stat().st_mtime_ns for p in first.parent.iterdir()}

    def never(*_):
        raise AssertionError("composed again")

    monkeypatch.setattr(urdf_module, "_compose", never)
    assert composed_urdf(spec) == composed_urdf(make_tiny()) == first
    assert {p: p.stat().st_mtime_ns for p in first.parent.iterdir()} == before


def test_links_that_robots_share_are_made_once_in_a_process(make_tiny, tmp_path, monkeypatch):
    spec = make_tiny()
    composed_urdf(spec)

    def never(*_):
        raise AssertionError("made again")

    monkeypatch.setattr(urdf_module, "_prepare_meshes", never)
    path = composed_urdf(spec, (Attachment("peg", "tool", BOX),))
    assert path.is_file()
    arm = tmp_path / "arm.urdf"
    arm.write_text(arm.read_text().replace("0.1 0.1 0.1", "0.1 0.1 0.2", 1))
    with pytest.raises(AssertionError, match="made again"):
        composed_urdf(spec)


def test_another_robot_source_or_held_body_gets_another_urdf(make_tiny, tmp_path):
    spec = make_tiny()
    made = [
        composed_urdf(spec),
        composed_urdf(spec, (Attachment("peg", "tool", BOX),)),
        composed_urdf(spec, (Attachment("peg", "tool", BOX, mass=0.2),)),
        composed_urdf(make_tiny(T_gripper_tool=pose([0, 0, 0.2]))),
    ]
    arm = tmp_path / "arm.urdf"
    arm.write_text(arm.read_text().replace("0.3", "0.25"))
    made.append(composed_urdf(spec))
    assert len(set(made)) == len(made)
    assert all(path.is_file() for path in made)


def _give_block(tmp_path, edge=0.1):
    """Let a link collide and be drawn by a mesh: a box of this edge [m] across."""
    trimesh.creation.box((edge, 0.1, 0.1)).export(tmp_path / "block.stl")
    arm = tmp_path / "arm.urdf"
    arm.write_text(
        arm.read_text().replace(
            '<box size="0.1 0.1 0.1"/>', '<mesh filename="block.stl" scale="1 1 1"/>', 1
        )
    )


def _block(path):
    (hull,) = path.parent.glob("*_collision_0.obj")
    return trimesh.load(hull, force="mesh").extents


def test_a_mesh_with_another_content_gets_another_urdf(make_tiny, tmp_path):
    spec = make_tiny()
    _give_block(tmp_path)
    mesh = tmp_path / "block.stl"
    first, status = composed_urdf(spec), mesh.stat()
    np.testing.assert_allclose(_block(first), 0.1, atol=1e-6)
    # Of the same name, size and time: only its content tells them apart.
    trimesh.creation.box((0.2, 0.1, 0.1)).export(mesh)
    os.utime(mesh, ns=(status.st_atime_ns, status.st_mtime_ns))
    assert mesh.stat().st_size == status.st_size
    second = composed_urdf(spec)
    assert second != first
    np.testing.assert_allclose(_block(second), [0.2, 0.1, 0.1], atol=1e-6)
    # And the first again when it is back.
    trimesh.creation.box((0.1, 0.1, 0.1)).export(mesh)
    assert composed_urdf(spec) == first


def test_a_robot_is_keyed_by_content_and_not_by_when_or_where_its_files_are(make_tiny, tmp_path):
    spec = make_tiny()
    _give_block(tmp_path)
    first = composed_urdf(spec)
    for file in ("arm.urdf", "hand.urdf", "block.stl"):
        os.utime(tmp_path / file, ns=(1, 1))
    assert composed_urdf(spec) == first


@pytest.mark.parametrize("of", ["_RECIPE", "_TRIMESH", "scale"])
def test_another_recipe_library_or_scale_gets_another_urdf(make_tiny, tmp_path, monkeypatch, of):
    spec = make_tiny()
    _give_block(tmp_path)
    first = composed_urdf(spec)
    if of == "scale":
        arm = tmp_path / "arm.urdf"
        arm.write_text(arm.read_text().replace("1 1 1", "1 1 2"))
    elif of == "_TRIMESH":
        monkeypatch.setattr(urdf_module, "_versions", lambda: {"trimesh": "0"})
    else:
        monkeypatch.setattr(urdf_module, of, 999)
    assert composed_urdf(spec) != first


@pytest.mark.parametrize("damage", ["changed", "missing", "added", "no manifest", "odd manifest"])
def test_a_cached_robot_that_was_damaged_is_made_again(make_tiny, own_cache, tmp_path, damage):
    spec = make_tiny()
    _give_block(tmp_path)
    first = composed_urdf(spec)
    whole = {path.name: path.read_bytes() for path in first.parent.iterdir()}
    (hull,) = first.parent.glob("*_collision_0.obj")
    if damage == "changed":
        hull.write_bytes(hull.read_bytes().replace(b"0.05", b"0.01"))
    elif damage == "missing":
        hull.unlink()
    elif damage == "added":
        (first.parent / "more.obj").write_text("")
    else:
        manifest = first.parent / "manifest.json"
        manifest.unlink()
        if damage == "odd manifest":
            manifest.write_text("[1, 2]")
    assert composed_urdf(spec) == first
    assert {path.name: path.read_bytes() for path in first.parent.iterdir()} == whole
    assert list((own_cache / "sart_toolkit").iterdir()) == [first.parent]


def test_files_that_change_while_a_robot_is_made_from_them_leave_nothing(
    make_tiny, own_cache, tmp_path, monkeypatch
):
    spec = make_tiny()
    _give_block(tmp_path)
    compose = urdf_module._compose

    def slow(*arguments):
        compose(*arguments)
        _give_block(tmp_path, 0.2)

    monkeypatch.setattr(urdf_module, "_compose", slow)
    with pytest.raises(BrokenFile, match="changed while they were read; try again"):
        composed_urdf(spec)
    assert list((own_cache / "sart_toolkit").iterdir()) == []


def test_the_cache_is_where_the_environment_says(monkeypatch, tmp_path):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "xdg"))
    monkeypatch.setenv("SART_CACHE", str(tmp_path / "ours"))
    assert cache_dir() == tmp_path / "ours" / "sart_toolkit"
    monkeypatch.delenv("SART_CACHE")
    assert cache_dir() == tmp_path / "xdg" / "sart_toolkit"
    monkeypatch.delenv("XDG_CACHE_HOME")
    monkeypatch.setenv("HOME", str(tmp_path))
    assert cache_dir() == tmp_path / ".cache" / "sart_toolkit"


def test_another_process_may_have_made_the_same_urdf_meanwhile(make_tiny, own_cache, monkeypatch):
    replace = os.replace

    def beaten(work, directory):
        replace(work, directory)
        raise OSError("Directory not empty")

    monkeypatch.setattr(os, "replace", beaten)
    path = composed_urdf(make_tiny())
    assert path.is_file()
    assert list((own_cache / "sart_toolkit").iterdir()) == [path.parent]


@pytest.mark.parametrize("step", ["mkdir", "replace"])
def test_a_cache_that_can_not_be_written_is_reported_and_left_clean(
    make_tiny, own_cache, monkeypatch, step
):
    if step == "mkdir":
        own_cache.write_text("in the way")
    else:

        def full(*_):
            raise OSError(28, "No space left on device")

        monkeypatch.setattr(os, "replace", full)
    with pytest.raises(CannotWrite, match="SART_CACHE"):
        composed_urdf(make_tiny())
    if step == "replace":
        assert list((own_cache / "sart_toolkit").iterdir()) == []


# --- sources that can't be used -----------------------------------------------------------------


def test_a_missing_source_is_reported(make_tiny, tmp_path):
    with pytest.raises(MissingFile, match="nowhere.urdf: no such file"):
        composed_urdf(make_tiny(urdf=str(tmp_path / "nowhere.urdf")))
    with pytest.raises(MissingExtra, match="pip install no_such_package"):
        composed_urdf(make_tiny(gripper={"urdf": "no_such_package:hand.urdf"}))


@pytest.mark.parametrize("content", [b"", b"<robot><link", b"no xml", b"\xff\xfe<robot/>"])
def test_a_source_that_is_no_urdf_is_broken_and_leaves_no_files(
    make_tiny, own_cache, tmp_path, content
):
    (tmp_path / "bad.urdf").write_bytes(content)
    with pytest.raises(BrokenFile, match="bad.urdf: not a readable URDF"):
        composed_urdf(make_tiny(urdf=str(tmp_path / "bad.urdf")))
    assert list(own_cache.rglob("*.urdf")) == []


def test_a_source_whose_mesh_is_missing_is_broken(make_tiny, own_cache, tmp_path):
    arm = tmp_path / "arm.urdf"
    arm.write_text(arm.read_text().replace('<box size="0.1 0.1 0.1"/>', '<mesh filename="x.obj"/>'))
    with pytest.raises(
        BrokenFile, match="link 'base_link': mesh x.obj is missing; put it there, or correct its"
    ):
        composed_urdf(make_tiny())
    assert list((own_cache / "sart_toolkit").iterdir()) == []


@pytest.mark.parametrize("name", ["tool", "upper", "gripper_finger"])
def test_a_held_body_with_the_name_of_a_link_is_refused(make_tiny, name):
    with pytest.raises(InvalidInput, match=f"tiny: two links are called '{name}'; rename one"):
        composed_urdf(make_tiny(), (Attachment(name, "tool", BOX),))


def test_two_joints_of_one_name_are_refused(make_tiny, tmp_path):
    held = Attachment("wrist", "tool", BOX)
    composed_urdf(make_tiny(), (Attachment("peg", "tool", BOX),))
    arm = tmp_path / "arm.urdf"
    arm.write_text(arm.read_text().replace('joint name="wrist"', 'joint name="peg_fixed"'))
    spec = make_tiny(arm_joints=("shoulder", "peg_fixed"))
    composed_urdf(spec, (held,))
    with pytest.raises(InvalidInput, match="two joints are called 'peg_fixed'"):
        composed_urdf(spec, (Attachment("peg", "tool", BOX),))
    with pytest.raises(InvalidInput, match="two links are called 'wrist'"):
        composed_urdf(spec, (held, held))


def test_a_joint_with_the_name_of_another_link_than_its_child_is_refused(make_tiny):
    # Both are frames, at different places, and a name must mean one.
    clash = (Attachment("peg", "tool", BOX), Attachment("peg_fixed", "flange", BOX))
    with pytest.raises(InvalidInput, match="'peg_fixed' has the name of a link that isn't its"):
        composed_urdf(make_tiny(), clash)


def _broken(kind):
    """A box as a mesh that something is wrong with."""
    mesh = trimesh.creation.box((0.1, 0.1, 0.1))
    if kind == "open":
        mesh.update_faces(np.arange(len(mesh.faces)) > 0)
    elif kind == "flat":
        mesh.faces = np.concatenate([mesh.faces, [[0, 1, 1]]])
    elif kind == "nan":
        mesh.vertices[0] = np.nan
    elif kind == "empty":
        mesh.update_faces(np.zeros(len(mesh.faces), bool))
    return mesh


def _give_mesh(urdf, kind, monkeypatch):
    """Let a link's collision shape be a broken mesh."""
    urdf.write_text(
        urdf.read_text().replace('<box size="0.1 0.1 0.1"/>', '<mesh filename="part.stl"/>', 1)
    )
    urdf.with_name("part.stl").write_bytes(trimesh.creation.box().export(file_type="stl"))
    # As read: an exporter would fix or refuse some of these.
    monkeypatch.setattr(urdf_module, "_loaded", lambda *_: _broken(kind))


@pytest.mark.parametrize("kind", ["open", "flat"])
def test_holes_and_flat_triangles_of_a_collision_mesh_do_its_hull_no_harm(
    make_tiny, own_cache, tmp_path, monkeypatch, kind
):
    spec = make_tiny()
    _give_mesh(tmp_path / "arm.urdf", kind, monkeypatch)
    (hull,) = composed_urdf(spec).parent.glob("*_collision_0.obj")
    made = trimesh.load(hull, force="mesh")
    assert made.is_watertight and np.allclose(made.extents, 0.1)


@pytest.mark.parametrize(
    ("kind", "message"),
    [
        ("nan", "collision mesh part.stl has NaN or infinite vertices"),
        ("empty", "collision mesh part.stl has no triangles"),
    ],
)
def test_a_collision_mesh_without_a_hull_is_refused(
    make_tiny, own_cache, tmp_path, monkeypatch, kind, message
):
    spec = make_tiny()
    _give_mesh(tmp_path / "arm.urdf", kind, monkeypatch)
    with pytest.raises(InvalidInput, match=message):
        composed_urdf(spec)
    assert not list(own_cache.rglob("robot.urdf"))


def test_a_link_that_is_drawn_but_does_not_collide_gets_hulls_of_what_is_drawn(make_tiny, tmp_path):
    spec = make_tiny()
    urdf = tmp_path / "arm.urdf"
    urdf.write_text(urdf.read_text().replace("collision>", "visual>", 2))
    composed = composed_urdf(spec)
    base = ET.parse(composed).getroot().find("link[@name='base_link']")
    (box,) = base.findall("collision/geometry/box")
    assert box.get("size") == "0.1 0.1 0.1"
    (note,) = assumptions(composed)
    assert note.startswith("link 'base_link' has no collision shape: hulls")
