"""A source URDF is used as it is written, or refused by file, link and element."""

from __future__ import annotations

import random
import re
from dataclasses import replace

import numpy as np
import pytest

from sart_toolkit.errors import BrokenFile, InvalidInput, SartError, UnknownName
from sart_toolkit.robots.model import RobotModel
from sart_toolkit.robots.references import resource_path
from sart_toolkit.robots.source import links_and_joints, parsed
from sart_toolkit.robots.urdf import assumptions, composed_urdf

_COLLISION = '<collision><geometry><box size="0.1 0.1 0.1"/></geometry></collision>'


def _collision(inside):
    return f"<collision>{inside}</collision>"


def _geometry(inside):
    return _collision(f"<geometry>{inside}</geometry>")


def _origin(attributes):
    return _collision(f'<origin {attributes}/><geometry><box size="1 1 1"/></geometry>')


# What a reader of URDFs would drop, or put elsewhere, without a word.
MALFORMED = {
    _origin('rpy="inf 0 0"'): "<origin rpy>: expected 3 numbers, got 'inf 0 0'",
    _origin('rpy="0 nan 0"'): "<origin rpy>: expected 3 numbers, got '0 nan 0'",
    _origin('rpy="tilted"'): "<origin rpy>: expected 3 numbers, got 'tilted'",
    _origin('xyz="0 0"'): "<origin xyz>: expected 3 numbers, got '0 0'",
    _origin('xyz="0 0 0 0"'): "<origin xyz>: expected 3 numbers",
    _origin('xyz="0 0 1e400"'): "<origin xyz>: expected at most 100 m, got '0 0 1e400'",
    _origin('xyz="0 0 345"'): "<origin xyz>: expected at most 100 m",
    _origin('xyz="0 0 1_0"'): "<origin xyz>: expected 3 numbers",
    _origin('quat_xyzw="0 0 0 1"'): "unknown attribute 'quat_xyzw'",
    _collision('<orgin xyz="0 0 1"/><geometry><box size="1 1 1"/></geometry>'): "mean 'origin'",
    _collision("<origin/><origin/><geometry/>"): "<collision> has 2 <origin>, expected at most one",
    _collision(""): "<collision> has 0 <geometry>, expected one",
    "<collision/>": "<collision> has 0 <geometry>, expected one",
    _geometry(""): "<geometry> has 0 shapes",
    _geometry('<box size="1 1 1"/><sphere radius="1"/>'): "<geometry> has 2 shapes",
    _geometry('<capsule radius="1" length="1"/>'): "unknown <capsule>; expected box, sphere",
    _geometry("<sphere/>"): "<sphere> has no radius",
    _geometry('<sphere radius=""/>'): "<sphere radius>: expected a number, got ''",
    _geometry('<sphere radius="-0.1"/>'): "<sphere radius>: expected above 0",
    _geometry('<sphere radius="0"/>'): "<sphere radius>: expected above 0",
    _geometry('<sphere radius="1mm"/>'): "<sphere radius>: expected a number, got '1mm'",
    _geometry('<box size="1 1"/>'): "<box size>: expected 3 numbers",
    _geometry('<box size="1 -1 1"/>'): "<box size>: expected above 0",
    _geometry('<cylinder radius="1"/>'): "<cylinder> has no length",
    _geometry("<mesh/>"): "<mesh> has no filename",
    _geometry('<mesh filename="a.stl" scale="nan 1 1"/>'): "<mesh scale>: expected 3 numbers",
    _geometry('<mesh filename="a.stl" scale="0 1 1"/>'): "<mesh scale>: expected other than 0",
    _geometry('<mesh filename="a.stl" scale="2"/>'): "<mesh scale>: expected 3 numbers, got '2'",
    _COLLISION.replace("collision", "colision"): "unknown <colision>; did you mean 'collision'",
    _COLLISION.replace("collision", "Collision"): "unknown <Collision>; did you mean 'collision'",
    _COLLISION.replace("collision", "hull"): "unknown <hull>, which holds a <geometry>",
}


@pytest.mark.parametrize(
    ("shape", "message", "kind"),
    [
        pytest.param(shape, message, kind, id=f"{kind}: {message}")
        for shape, message in MALFORMED.items()
        for kind in ("collision", "visual")
        # A misspelt collision is of that one alone.
        if kind == "collision" or shape.startswith("<collision")
    ],
)
def test_a_shape_that_readers_would_drop_or_misplace_is_refused(
    make_tiny, tmp_path, shape, message, kind
):
    arm = tmp_path / "arm.urdf"
    at = arm.read_text().index("<collision>", arm.read_text().index('name="upper"'))
    text = shape.replace("collision", kind)
    arm.write_text(arm.read_text()[:at] + text + arm.read_text()[at:])
    message = message.replace("collision", kind)
    with pytest.raises(InvalidInput, match=f"arm.urdf: link 'upper': .*{re.escape(message)}"):
        composed_urdf(make_tiny())


JOINT = '<limit lower="-2" upper="2" effort="10" velocity="1"/>'


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('<mass value="1"/>', '<mass value="heavy"/>', "<mass value>: expected a number"),
        ('<mass value="1"/>', '<mass value="-1"/>', "<mass value>: expected at least 0"),
        ('<mass value="1"/>', "", "<inertial> has 0 <mass>, expected one"),
        ('ixx="1"', 'ixx="inf"', "<inertia ixx>: expected a number"),
        ('ixy="0"', "", "<inertia> has no ixy"),
        ('xyz="0 0 0.3"', 'xyz="0 0 up"', "<origin xyz>: expected 3 numbers"),
        ('<axis xyz="0 0 1"/>', '<axis xyz="0 0 0"/>', "<axis xyz>: expected a direction"),
        ('<axis xyz="0 0 1"/>', '<axsi xyz="0 0 1"/>', "unknown <axsi>; did you mean 'axis'"),
        (JOINT, "", "a revolute joint has no <limit>"),
        ('lower="-2"', 'lower="3"', "<limit>: lower 3.0 is above upper 2.0"),
        ('type="revolute"', 'type="floating"', "type: expected one of revolute, continuous"),
        ('type="revolute"', "", "<joint> has no type"),
        ('<parent link="base_link"/>', "", "<joint> has 0 <parent>, expected one"),
        ('<child link="upper"/>', "<child/>", "<child> has no link"),
        ('<link name="upper">', "<link>", "<link> has no name"),
        ('<joint name="shoulder"', "<joint", "<joint> has no name"),
        ('<joint name="wrist"', '<jiont name="wrist"', None),
    ],
)
def test_a_number_or_reference_that_is_not_acceptable_is_refused(
    make_tiny, tmp_path, old, new, message
):
    arm = tmp_path / "arm.urdf"
    text = arm.read_text()
    assert old in text
    text = text.replace(old, new, 1)
    if message is None:
        text = text[: text.index("<jiont")] + text[text.index("<jiont") :].replace(
            "</joint>", "</jiont>", 1
        )
        message = "unknown <jiont>; did you mean 'joint'"
    arm.write_text(text)
    with pytest.raises(InvalidInput, match=re.escape(message)):
        composed_urdf(make_tiny())


@pytest.mark.parametrize(
    ("old", "new", "error", "message"),
    [
        ('<child link="upper"/>', '<child link="flange"/>', InvalidInput, "child of two joints"),
        ('<parent link="upper"/>', '<parent link="flange"/>', InvalidInput, "make a loop through"),
        ('<child link="upper"/>', '<child link="lower"/>', UnknownName, "unknown frame 'lower'"),
        ("<robot name", '<robot><link name="lost"/></robot><robot name', BrokenFile, "readable"),
        ("</robot>", '<link name="lost"/></robot>', InvalidInput, "'lost' are not joined"),
    ],
)
def test_links_that_are_not_one_tree_are_refused(make_tiny, tmp_path, old, new, error, message):
    arm = tmp_path / "arm.urdf"
    arm.write_text(arm.read_text().replace(old, new, 1))
    with pytest.raises(error, match=message):
        composed_urdf(make_tiny())


BOMB = b"""<!DOCTYPE robot [<!ENTITY a "aaaaaaaaaa"><!ENTITY b "&a;&a;&a;&a;&a;&a;&a;&a;&a;&a;">
<!ENTITY c "&b;&b;&b;&b;&b;&b;&b;&b;&b;&b;"><!ENTITY d "&c;&c;&c;&c;&c;&c;&c;&c;&c;&c;">]>
<robot name="&d;"/>"""


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (BOMB, "it has a DOCTYPE"),
        (b'<!DOCTYPE robot SYSTEM "file:///etc/passwd"><robot/>', "it has a DOCTYPE"),
        (b"<robot>&lol;</robot>", "undefined entity"),
        (b"<robot>" + b"<link>" * 1000, "nested more than 32 deep"),
        (b'<?xml version="1.0" encoding="klingon"?><robot/>', "not a readable URDF"),
        (b'<robot name="\xff"/>', "not a readable URDF"),
        (b'<robot name="a\x00"/>', "not a readable URDF"),
        (b"<sdf/>", "its root is <sdf>, not <robot>"),
        (b"<robot>" + b'<link name="a"/>' * 2001 + b"</robot>", "2001 links and joints"),
        (b" " * ((16 << 20) + 1), "larger than 16 MB"),
    ],
)
def test_what_is_no_plain_urdf_of_reasonable_size_is_broken(tmp_path, content, message):
    source = tmp_path / "bad.urdf"
    source.write_bytes(content)
    with pytest.raises(BrokenFile, match=message):
        links_and_joints(source)


@pytest.mark.parametrize("encoding", ["utf-8", "utf-16", "iso-8859-1"])
def test_a_urdf_may_be_in_any_encoding_it_declares(tmp_path, encoding):
    text = f'<?xml version="1.0" encoding="{encoding}"?><robot name="é"/>'
    (tmp_path / "a.urdf").write_bytes(text.encode(encoding))
    assert parsed(tmp_path / "a.urdf").get("name") == "é"


def test_prefixes_need_not_be_declared_and_what_they_hold_is_left_out(tmp_path):
    (tmp_path / "a.urdf").write_text(
        '<robot><drake:group><drake:member link="a"/></drake:group><link name="a" drake:b="1">'
        "<drake:c/><visual><material/><geometry><box size='1 2 3'/></geometry></visual></link>"
        "</robot>"
    )
    (link,) = links_and_joints(tmp_path / "a.urdf")
    assert link.attrib == {"name": "a"}
    assert [element.tag for element in link.iter()] == ["link", "visual", "geometry", "box"]


def test_numbers_are_written_in_one_way_for_all_readers(tmp_path):
    (tmp_path / "a.urdf").write_text(
        '<robot><joint name="j" type="prismatic"><parent link="a"/><child link="b"/>'
        '<origin xyz=" +.5\t1.E-1 -0 "/><axis xyz="0 3 4"/>'
        '<limit effort="1" velocity="1" upper="01"/></joint></robot>'
    )
    (joint,) = links_and_joints(tmp_path / "a.urdf")
    assert joint.find("origin").get("xyz") == "0.5 0.1 -0.0"
    assert joint.find("axis").get("xyz") == "0.0 0.6 0.8"
    assert joint.find("limit").get("upper") == "1.0"


def test_a_continuous_joint_is_held_to_one_turn_to_either_side(make_tiny, tmp_path):
    arm = tmp_path / "arm.urdf"
    arm.write_text(
        arm.read_text().replace('name="wrist" type="revolute"', 'name="wrist" type="continuous"')
    )
    model = RobotModel(make_tiny())
    assert model.lower.tolist() == [-2, -2 * np.pi]
    assert model.upper.tolist() == [2, 2 * np.pi]
    (note,) = assumptions(model.urdf)
    assert note == "joint 'wrist' turns without end: held to one turn to either side"


def test_a_link_with_a_mass_but_no_inertia_gets_one_of_a_ball(make_tiny, tmp_path):
    arm = tmp_path / "arm.urdf"
    arm.write_text(re.sub("<inertia [^>]*/>", "", arm.read_text(), count=1))
    assert 'ixx="0.001"' in composed_urdf(make_tiny()).read_text()


@pytest.mark.parametrize("file", ["a.txt", "missing.stl", "folder.stl", "x" * 300 + ".stl", "/"])
def test_a_mesh_that_can_not_be_read_is_reported(make_tiny, tmp_path, file):
    (tmp_path / "folder.stl").mkdir()
    arm = tmp_path / "arm.urdf"
    arm.write_text(
        arm.read_text().replace('<box size="0.1 0.1 0.1"/>', f'<mesh filename="{file}"/>')
    )
    with pytest.raises(
        (BrokenFile, InvalidInput), match="(mesh|robot) .*(missing|expected a file ending)"
    ):
        composed_urdf(make_tiny())


@pytest.mark.parametrize("suffix", ["obj", "stl", "ply", "off", "glb", "dae"])
def test_a_mesh_that_is_no_mesh_is_broken(make_tiny, tmp_path, suffix):
    if suffix == "dae":
        pytest.importorskip("collada")
    (tmp_path / f"part.{suffix}").write_bytes(b"\x00\xff no mesh \n" * 20)
    arm = tmp_path / "arm.urdf"
    arm.write_text(
        arm.read_text().replace('<box size="0.1 0.1 0.1"/>', f'<mesh filename="part.{suffix}"/>')
    )
    with pytest.raises((BrokenFile, InvalidInput), match=f"mesh part.{suffix}"):
        composed_urdf(make_tiny())


@pytest.mark.parametrize("bad", ["v nan 0 0", "v 0 1e999 0", "v 0 0", "v a b c", ""])
def test_a_mesh_with_a_corner_that_can_not_be_read_is_broken_and_not_made_without_it(
    make_tiny, tmp_path, bad
):
    (tmp_path / "part.obj").write_text(
        f"{bad}\nv 1 0 0\nv 0 1 0\nv 0 0 1\nv 1 1 1\nf 1 2 3\nf 1 2 4\nf 1 3 4\nf 2 3 5\n"
    )
    arm = tmp_path / "arm.urdf"
    arm.write_text(
        arm.read_text().replace('<box size="0.1 0.1 0.1"/>', '<mesh filename="part.obj"/>')
    )
    with pytest.raises(BrokenFile, match="mesh part.obj: can't be read"):
        composed_urdf(make_tiny())


def test_a_link_name_can_not_put_files_elsewhere_or_share_them(make_tiny, tmp_path):
    box = '<mesh filename="part.obj"/>'
    (tmp_path / "part.obj").write_text(
        "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 2 3\nf 1 2 4\nf 1 3 4\nf 2 3 4\n"
    )
    arm = tmp_path / "arm.urdf"
    text = arm.read_text().replace('<box size="0.1 0.1 0.1"/>', box)
    arm.write_text(text.replace('"upper"', '"../a b"').replace('"flange"', '"../a/b"'))
    spec = make_tiny()
    spec = replace(spec, gripper=replace(spec.gripper, parent_frame="../a/b"))
    folder = composed_urdf(spec).parent
    assert len(list(folder.glob("*_collision_0.obj"))) == 3
    RobotModel(spec)


def _mutations(content, rng, count):
    """A URDF with numbers, names, elements and bytes changed, left out, doubled or moved."""
    values = [m.span(1) for m in re.finditer(rb'="([^"]*)"', content)]
    elements = [m.span() for m in re.finditer(rb"<\w+[^<>]*/>", content)]
    words = [b"nan", b"-1", b"0", b"1e400", b"", b'"', b"<", b"\xff", b"\x00", b"../", b"base_link"]
    for _ in range(count):
        kind = rng.randrange(5)
        if kind == 0:
            (a, b), new = rng.choice(values), rng.choice(words)
        elif kind == 1:
            (a, b), (c, d) = rng.choice(values), rng.choice(values)
            new = content[c:d]
        elif kind == 2:
            (a, b), (c, d) = rng.choice(elements), rng.choice(elements)
            new = rng.choice([b"", content[c:d]])
        else:
            a, b = sorted(rng.randrange(len(content)) for _ in range(2))
            new = rng.choice([b"", content[a:b] * 2]) if kind == 3 else rng.choice(words)
            b = b if kind == 3 else a + rng.randrange(4)
        yield content[:a] + new + content[b:]


def test_a_mutated_urdf_is_read_or_refused_with_a_typed_error(spec, own_cache, tmp_path):
    hande = resource_path("sart_toolkit:robots/hande.urdf").read_bytes()
    source = tmp_path / "hande.urdf"
    robot = replace(
        spec,
        gripper=replace(
            spec.gripper,
            urdf=str(source),
            driver="gripper_left_jaw_joint",
            followers={"gripper_right_jaw_joint": 1.0},
            closed_position=0.025,
            finger_links=("gripper_left_jaw",),
        ),
    )
    accepted = 0
    source.write_bytes(hande)
    RobotModel(robot)
    for content in _mutations(hande, random.Random(0), 150):
        source.write_bytes(content)
        try:
            RobotModel(robot)
            accepted += 1
        except SartError:
            pass
    assert 0 < accepted < 100
