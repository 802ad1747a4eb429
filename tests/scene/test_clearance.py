"""Clearances: exact where geometry has an answer, 1-Lipschitz, negative in overlap, none missed."""

import itertools
import xml.etree.ElementTree as ET

import coal
import hypothesis.strategies as st
import numpy as np
import pinocchio as pin
import pytest
import trimesh
from hypothesis import given, settings

from sart_toolkit.errors import InvalidInput, UnknownName
from sart_toolkit.poses import pose, rpy_pose
from sart_toolkit.robots.spec import Shape
from sart_toolkit.scene.clearance import ClearanceModel
from sart_toolkit.scene.spec import Body, SceneSpec
from sart_toolkit.tasks.task import Placement

PROPERTY = settings(deadline=None, derandomize=True, max_examples=40)
RADIUS = 0.01

shifts = st.tuples(*[st.floats(-0.3, 0.3)] * 3).map(np.array)


def tool_pairs(clearances, q, Ts_world_body):
    """The nearest pair of each tool body."""
    return [body.nearest for body in clearances.tool_clearances(q, Ts_world_body)]


def of(pairs, link):
    """The distance of the nearest part of a link."""
    return min(pair.distance for pair in pairs if pair.a == link)


@pytest.fixture(scope="session")
def probed(peg_model):
    """The robot with its peg, and one small ball that a test puts somewhere."""
    scene = SceneSpec((Body("ball", (Shape("sphere", (RADIUS,)),)),))
    return ClearanceModel(peg_model, scene)


@pytest.fixture(scope="session")
def peg_tip(peg_model, start):
    """Centre of the peg's lower face in the world at the start."""
    return (peg_model.fk(start.state.q, "peg") @ [0, 0, 0.04, 1])[:3]


# --- analytic cases -----------------------------------------------------------------------------


def test_the_peg_starts_12_5_cm_above_the_block(start):
    pairs = tool_pairs(start.clearances, start.state.q, start.state.Ts_world_body)
    nearest = min(pairs, key=lambda pair: pair.distance)
    assert (nearest.a, nearest.b) == ("peg", "block")
    # Over the middle of the hole: 12.5 cm down to the rim, and 1 cm from peg to wall.
    assert nearest.distance == pytest.approx(np.hypot(0.125, 0.010), abs=1e-5)


def test_the_peg_above_a_wall_of_the_block_is_12_5_cm_from_it(start, peg_task, peg_model):
    state = peg_task.initial_state(peg_model, Placement(0.04, 0.0))
    pairs = tool_pairs(start.clearances, state.q, state.Ts_world_body)
    assert of(pairs, "peg") == pytest.approx(0.125, abs=1e-5)


def test_the_peg_far_from_the_block_is_nearest_to_the_table(start):
    Ts = {**start.state.Ts_world_body, "block": pose([0, 0, -5])}
    pairs = tool_pairs(start.clearances, start.state.q, Ts)
    assert {pair.b for pair in pairs} == {"table"}
    assert of(pairs, "peg") == pytest.approx(0.165, abs=1e-5)


@PROPERTY
@given(gap=st.floats(0.001, 1))
def test_a_ball_below_the_peg_is_as_far_as_its_gap(probed, start, peg_tip, gap):
    p = peg_tip - [0, 0, gap + RADIUS]
    pairs = tool_pairs(probed, start.state.q, {"ball": pose(p)})
    assert of(pairs, "peg") == pytest.approx(gap, abs=1e-6)


def test_reach_is_the_distance_of_a_bodys_farthest_corner_from_the_tool(start):
    bodies = start.clearances.tool_clearances(start.state.q, start.state.Ts_world_body)
    reach = {body.nearest.a: body.reach for body in bodies}
    assert reach["peg"] == pytest.approx(np.sqrt(0.015**2 + 0.015**2 + 0.06**2), abs=1e-6)


@pytest.mark.parametrize(
    ("geometry", "corner", "farthest"),
    [
        (coal.Box(0.02, 0.04, 0.06), (0.01, 0.02, 0.05), np.sqrt(0.0005 + 0.05**2)),
        (coal.Cylinder(0.01, 0.06), (0.01, 0.01, 0.05), np.hypot(0.01, 0.05)),
        (coal.Sphere(0.02), (0.02, 0.02, 0.04), 0.04),
    ],
    ids=["box", "cylinder", "sphere"],
)
def test_reach_covers_a_body_of_any_kind_and_no_more_than_the_box_around_it(
    peg_model, peg_task, monkeypatch, geometry, corner, farthest
):
    build = pin.buildGeomFromUrdf

    def with_another_peg(*args, **kwargs):
        loaded = build(*args, **kwargs)
        (peg,) = [item for item in loaded.geometryObjects if item.name.startswith("peg")]
        peg.geometry = geometry
        return loaded

    monkeypatch.setattr(pin, "buildGeomFromUrdf", with_another_peg)
    clearances = ClearanceModel(peg_model, peg_task.scene)
    Ts = {"table": np.eye(4), "block": np.eye(4)}
    bodies = clearances.tool_clearances(peg_model.spec.home, Ts)
    (reach,) = [body.reach for body in bodies if body.nearest.a == "peg"]
    # The peg's centre is 2 cm beyond the tool's.
    assert farthest - 1e-9 <= reach <= np.linalg.norm(corner) + 1e-9


# --- properties ---------------------------------------------------------------------------------


@PROPERTY
@given(shift=shifts, step=st.floats(0, 0.3))
def test_no_distance_changes_by_more_than_a_body_moves(start, shift, step):
    q, Ts = start.state.q, start.state.Ts_world_body
    moved = pose(shift) @ Ts["block"]
    farther = pose(shift * (1 + step)) @ Ts["block"]
    a = tool_pairs(start.clearances, q, {**Ts, "block": moved})
    b = tool_pairs(start.clearances, q, {**Ts, "block": farther})
    length = np.linalg.norm(shift) * step
    assert all(abs(x.distance - y.distance) <= length + 1e-6 for x, y in zip(a, b, strict=True))


def test_distances_only_grow_when_the_scene_moves_away_below(start):
    q, Ts = start.state.q, start.state.Ts_world_body
    rows = []
    for drop in np.linspace(0, 0.5, 11):
        lower = {name: pose([0, 0, -drop]) @ T for name, T in Ts.items()}
        pairs = tool_pairs(start.clearances, q, lower)
        rows.append([pair.distance for pair in pairs])
    assert (np.diff(rows, axis=0) > 0).all()
    arm = [
        start.clearances.arm_distance(q, {n: pose([0, 0, -drop]) @ T for n, T in Ts.items()})
        for drop in np.linspace(0, 0.5, 11)
    ]
    assert (np.diff([pair.distance for pair in arm]) >= -1e-9).all()


@PROPERTY
@given(inside=st.tuples(*[st.floats(-0.9, 0.9)] * 3))
def test_a_ball_inside_the_peg_overlaps_it(probed, peg_model, start, inside):
    T = peg_model.fk(start.state.q, "peg") @ pose(np.array(inside) * [0.015, 0.015, 0.04])
    assert of(tool_pairs(probed, start.state.q, {"ball": T}), "peg") < 0


def test_a_tool_in_the_table_overlaps_it(start):
    Ts = {**start.state.Ts_world_body, "table": pose([0, 0, 0.2])}
    pairs = tool_pairs(start.clearances, start.state.q, Ts)
    assert of(pairs, "peg") < 0


def collision_vertices(model, q):
    """(link, vertices (n, 3) in the world) of each collision mesh of the composed URDF."""
    poses = model.link_poses(q)
    for link in ET.parse(model.urdf).getroot().findall("link"):
        for element in link.findall("collision"):
            mesh = element.find("geometry/mesh")
            if mesh is None:
                continue
            loaded = trimesh.load(model.urdf.parent / mesh.get("filename"), force="mesh")
            p, rpy = (
                [float(x) for x in element.find("origin").get(k).split()] for k in ("xyz", "rpy")
            )
            T = poses[link.get("name")] @ rpy_pose(p, rpy)
            yield link.get("name"), loaded.vertices @ T[:3, :3].T + T[:3, 3]


def test_every_corner_of_every_collision_mesh_is_enclosed(probed, peg_model, start):
    q = start.state.q
    seen = set()
    for link, vertices in collision_vertices(peg_model, q):
        for vertex in vertices[:: max(1, len(vertices) // 8)]:
            Ts = {"ball": pose(vertex)}
            pairs = tool_pairs(probed, q, Ts)
            if link in {pair.a for pair in pairs}:
                nearest = of(pairs, link)
                seen.add(link)
            elif link != "base_link_inertia":
                nearest = probed.arm_distance(q, Ts).distance
            assert nearest < 0, link
    assert {"gripper_left_inner_finger", "gripper_base_link_inertia", "wrist_3_link"} <= seen


# --- which bodies -------------------------------------------------------------------------------


def test_tool_bodies_are_what_the_last_joint_carries(probed, start):
    pairs = tool_pairs(probed, start.state.q, {"ball": pose([5, 5, 5])})
    links = {pair.a for pair in pairs}
    assert {"peg", "wrist_camera", "gripper_left_inner_finger_pad", "wrist_3_link"} <= links
    assert links.isdisjoint({"forearm_link", "upper_arm_link", "wrist_1_link", "wrist_2_link"})


@pytest.mark.parametrize(
    "link", ["shoulder_link", "upper_arm_link", "forearm_link", "wrist_1_link", "wrist_2_link"]
)
def test_the_arm_is_near_a_ball_beside_each_of_its_links(probed, peg_model, start, link):
    q = start.state.q
    vertices = dict(collision_vertices(peg_model, q))[link]
    pair = probed.arm_distance(q, {"ball": pose(vertices.mean(0))})
    assert pair.distance < 0
    assert pair.b == "ball"


def test_a_tool_folded_onto_the_arm_is_told(probed, start):
    q = np.array(start.state.q)
    free = probed.arm_distance(q, {"ball": pose([5, 5, 5])})
    assert free.distance > 0.02
    distances = []
    for wrist_1, elbow in itertools.product(np.linspace(-3, 3, 13), (1.9, 2.6)):
        q[2:4] = elbow, wrist_1
        distances.append(probed.arm_distance(q, {"ball": pose([5, 5, 5])}))
    nearest = min(distances, key=lambda pair: pair.distance)
    assert nearest.distance < 0
    assert nearest.b in {"forearm_link", "upper_arm_link", "shoulder_link"}


def test_a_shape_that_does_not_collide_is_not_near(peg_model, start):
    shapes = (Shape("sphere", (0.1,), collides=False), Shape("sphere", (0.01,), pose([0, 0, 3])))
    clearances = ClearanceModel(peg_model, SceneSpec((Body("ghost", shapes),)))
    T = pose((peg_model.fk(start.state.q))[:3, 3])
    assert of(tool_pairs(clearances, start.state.q, {"ghost": T}), "peg") > 2.5


@pytest.mark.parametrize(
    ("kind", "size", "reach"),
    [("box", (0.2, 0.2, 0.3), 0.15), ("cylinder", (0.1, 0.3), 0.15), ("sphere", (0.15,), 0.15)],
)
def test_every_kind_of_shape_is_as_large_as_it_says(peg_model, start, peg_tip, kind, size, reach):
    clearances = ClearanceModel(peg_model, SceneSpec((Body("thing", (Shape(kind, size),)),)))
    T = pose(peg_tip - [0, 0, 0.1 + reach])
    pairs = tool_pairs(clearances, start.state.q, {"thing": T})
    assert of(pairs, "peg") == pytest.approx(0.1, abs=1e-5)


def test_an_empty_scene_is_infinitely_far(peg_model, start):
    clearances = ClearanceModel(peg_model, SceneSpec(()))
    pairs = tool_pairs(clearances, start.state.q, {})
    assert pairs
    assert all(pair.distance == np.inf for pair in pairs)
    assert clearances.arm_distance(start.state.q, {}).distance > 0.02


def test_a_body_in_the_grasp_counts_as_the_tools_and_no_longer_as_the_scenes(peg_model, start):
    shapes = (Shape("box", (0.02, 0.02, 0.06)),)
    clearances = ClearanceModel(
        peg_model, SceneSpec((Body("box", shapes, mass=0.1), Body("floor", shapes)))
    )
    T = peg_model.fk(start.state.q)
    Ts = {"box": T @ pose([0, 0, 0.10]), "floor": T @ pose([0, 0, 0.20])}
    q = start.state.q
    assert {pair.b for pair in tool_pairs(clearances, q, Ts)} == {"box"}
    bodies = clearances.tool_clearances(q, Ts, carried={"box"})
    assert {body.nearest.b for body in bodies} == {"floor"}
    (box,) = [body for body in bodies if body.nearest.a == "box"]
    assert box.nearest.distance == pytest.approx(0.04, abs=1e-6)
    assert box.reach == pytest.approx(np.sqrt(0.01**2 + 0.01**2 + 0.13**2), abs=1e-9)
    assert clearances.arm_distance(q, Ts, {"box", "floor"}).b not in Ts


# --- errors -------------------------------------------------------------------------------------


def test_a_body_whose_pose_is_missing_is_told(start):
    for ask in (start.clearances.tool_clearances, start.clearances.arm_distance):
        with pytest.raises(UnknownName, match="unknown body 'block': did you mean 'blok'"):
            ask(start.state.q, {"table": np.eye(4), "blok": np.eye(4)})


@pytest.mark.parametrize("q", [np.zeros(5), np.full(6, np.nan)], ids=["short", "NaN"])
def test_joints_that_are_no_configuration_are_refused(start, q):
    for ask in (start.clearances.tool_clearances, start.clearances.arm_distance):
        with pytest.raises(InvalidInput, match="q: "):
            ask(q, start.state.Ts_world_body)


def test_a_robot_part_that_is_not_convex_is_refused(peg_model, peg_task, monkeypatch):
    build = pin.buildGeomFromUrdf

    def with_a_halfspace(*args, **kwargs):
        loaded = build(*args, **kwargs)
        loaded.geometryObjects[0].geometry = coal.Halfspace(np.array([0, 0, 1.0]), 0.0)
        return loaded

    monkeypatch.setattr(pin, "buildGeomFromUrdf", with_a_halfspace)
    with pytest.raises(
        InvalidInput,
        match="geometry Halfspace is neither a mesh nor a box, sphere or cylinder; use",
    ):
        ClearanceModel(peg_model, peg_task.scene)
