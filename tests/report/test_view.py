from __future__ import annotations

import base64
import json
import re
import shutil
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sart_toolkit import get_robot, get_task
from sart_toolkit.data.dataset import Dataset
from sart_toolkit.data.records import Annotation, Demonstration
from sart_toolkit.poses import Array, pose
from sart_toolkit.report.figures import SegmentPath, segment_paths
from sart_toolkit.report.page import write_report
from sart_toolkit.report.view import (
    MAX_MOMENTS,
    MAX_SEGMENTS,
    MAX_TRIANGLES,
    View,
    scene_view,
    simplified,
)
from sart_toolkit.robots.model import RobotModel
from sart_toolkit.robots.spec import Shape
from sart_toolkit.robots.visuals import DrawnMesh, RobotVisuals, body_meshes
from sart_toolkit.scenes.spec import Body, SceneSpec

BROWSER = shutil.which("chromium") or shutil.which("chromium-browser")
BOX = Body("block", (Shape("box", (0.1, 0.2, 0.3), pose((0.0, 0.0, 0.15))),))
TABLE = Body("table", (Shape("box", (1.0, 1.0, 0.1)),))


@pytest.fixture(scope="module")
def annotation(dataset: Dataset) -> Annotation:
    (source,) = dataset.sources
    assert source.annotation is not None
    return source.annotation


@pytest.fixture(scope="module")
def whole(demonstration: Demonstration, annotation: Annotation, dataset: Dataset) -> View:
    """The view of a UR5e that holds a peg, over a block."""
    scene = SceneSpec((BOX, TABLE), get_task("peg_in_hole").scene.held)
    paths = segment_paths(dataset)
    return scene_view(demonstration, annotation, paths, get_robot("ur5e_2f85"), scene)


def decoded(text: str, dtype: str, columns: int = 3) -> Array:
    return np.frombuffer(base64.b64decode(text), dtype).reshape(-1, columns)


def points(view: View, line: View) -> Array:
    return view["low"] + np.array(view["step"]) * decoded(line["points"], "<u2")


def corners(mesh: View) -> Array:
    return mesh["low"] + np.array(mesh["step"]) * decoded(mesh["positions"], "<u2")


def triangles(view: View) -> int:
    return sum(
        len(decoded(m["triangles"], "<u2")) for body in view["bodies"] for m in body["meshes"]
    )


def test_the_view_is_json_of_less_than_half_a_megabyte(whole: View) -> None:
    assert len(json.dumps(whole, allow_nan=False)) < 0.5e6


def test_lines_decode_to_demonstration_and_segments(
    whole: View, demonstration: Demonstration, dataset: Dataset
) -> None:
    demonstrated, *segments = whole["lines"]
    expected = demonstration.steps.measured_Ts_world_tool[:, :3, 3]
    assert demonstrated["sphere"] is None
    np.testing.assert_allclose(points(whole, demonstrated), expected, atol=1e-5)
    assert len(segments) == len(dataset)
    for segment, path in zip(segments, segment_paths(dataset), strict=True):
        assert segment["sphere"] == path.sphere
        np.testing.assert_allclose(points(whole, segment), path.positions, atol=1e-5)


def test_balls_are_the_precision_spheres(whole: View, annotation: Annotation) -> None:
    assert [ball["sphere"] for ball in whole["balls"]] == list(range(len(annotation.spheres)))
    for ball, sphere in zip(whole["balls"], annotation.spheres, strict=True):
        np.testing.assert_allclose(ball["centre"], sphere.T_world_key[:3, 3], atol=1e-6)
        assert ball["radius"] == pytest.approx(sphere.radius, abs=1e-6)
        assert re.fullmatch("#[0-9a-f]{6}", ball["colour"])


def test_a_box_decodes_to_its_corners_where_the_body_stood(whole: View) -> None:
    # Where the table stood was not recorded.
    (box,) = [body for body in whole["bodies"] if body["layer"] == "scene"]
    T = decoded(box["poses"], "<f4", 4)
    np.testing.assert_allclose(T, pose((0.5, 0.0, 0.0))[:3], atol=1e-6)
    (mesh,) = box["meshes"]
    found = np.unique(np.round(corners(mesh), 4), axis=0)
    signs = np.array(np.meshgrid([-1, 1], [-1, 1], [0, 1])).reshape(3, -1).T
    np.testing.assert_allclose(found, np.unique(signs * [0.05, 0.1, 0.3], axis=0), atol=1e-4)
    normals = decoded(mesh["normals"], "<i1") / 127
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1.0, atol=0.01)


def test_links_stand_where_the_robot_s_joints_have_them(
    whole: View, demonstration: Demonstration
) -> None:
    held = get_task("peg_in_hole").scene.held
    visuals = RobotVisuals(RobotModel(get_robot("ur5e_2f85"), held))
    q = demonstration.steps.joint_positions[0]
    Ts = visuals.poses_at(q, float(demonstration.steps.measured_gripper[0]))
    robot = [body for body in whole["bodies"] if body["layer"] == "robot"]
    assert len(robot) == len(visuals.bodies)
    for body, (name, meshes) in zip(robot, visuals.bodies.items(), strict=True):
        # In this demonstration the joints stay as they are.
        np.testing.assert_allclose(decoded(body["poses"], "<f4", 4), Ts[name][:3], atol=1e-6)
        there = np.concatenate([corners(mesh) for mesh in body["meshes"]])
        true = np.concatenate([mesh.vertices for mesh in meshes])
        np.testing.assert_allclose(there.min(axis=0), true.min(axis=0), atol=0.01)
        np.testing.assert_allclose(there.max(axis=0), true.max(axis=0), atol=0.01)


def test_a_body_that_moves_has_a_pose_for_each_moment(
    demonstration: Demonstration, annotation: Annotation
) -> None:
    Ts = np.array([pose((0.5, 0.001 * t, 0.0)) for t in range(len(demonstration))])
    object.__setattr__(moved := _copy(demonstration), "body_Ts_world", {"block": Ts})
    view = scene_view(moved, annotation, scene=SceneSpec((BOX,)))
    found = decoded(view["bodies"][0]["poses"], "<f4", 12).reshape(-1, 3, 4)
    assert len(found) == len(view["times"]) == min(len(demonstration), MAX_MOMENTS)
    np.testing.assert_allclose(found[-1], Ts[-1][:3], atol=1e-6)
    assert view["times"][0] == 0.0 and view["times"][-1] == pytest.approx(4.0)


def _copy(demonstration: Demonstration) -> Demonstration:
    copied = object.__new__(Demonstration)
    for name, value in vars(demonstration).items():
        object.__setattr__(copied, name, value)
    return copied


def test_of_many_segments_some_are_shown(
    demonstration: Demonstration, annotation: Annotation
) -> None:
    paths = [SegmentPath(k % 3, np.full((2, 3), 0.1) + 1e-4 * k) for k in range(1000)]
    view = scene_view(demonstration, annotation, paths)
    assert len(view["lines"]) == 1 + MAX_SEGMENTS
    np.testing.assert_allclose(points(view, view["lines"][-1]), paths[-1].positions, atol=1e-5)


# --- fewer triangles ----------------------------------------------------------------------------


def test_meshes_fit_a_page_and_their_triangles_name_corners_that_are_there(whole: View) -> None:
    assert 0.5 * MAX_TRIANGLES < triangles(whole) <= MAX_TRIANGLES
    for body in whole["bodies"]:
        for mesh in body["meshes"]:
            n = len(decoded(mesh["positions"], "<u2"))
            assert len(decoded(mesh["normals"], "<i1")) == n
            assert decoded(mesh["triangles"], "<u2").max() == n - 1


def test_a_simpler_mesh_stays_close_and_closed() -> None:
    ball = body_meshes([Shape("sphere", (0.1,))])[0]
    simple = simplified(ball, 0.02)
    assert 100 < len(simple.triangles) < 0.6 * len(ball.triangles)
    radii = np.linalg.norm(simple.vertices, axis=1)
    assert radii.min() > 0.09 and radii.max() < 0.101
    outwards = np.sum(simple.normals * simple.vertices, axis=1) / radii
    assert outwards.min() > 0.9
    # By position, as corners that face differently share one: each edge has a triangle either way.
    _, at = np.unique(np.round(simple.vertices, 9), axis=0, return_inverse=True)
    faces = at.reshape(-1)[simple.triangles]
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    there = {tuple(edge) for edge in edges.tolist()}
    assert there == {(b, a) for a, b in there}


def test_corners_that_face_apart_stay_apart() -> None:
    vertices = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 0], [1, 0, 0], [0, 0, 1]], float)
    normals = np.repeat([[0.0, 0.0, -1.0], [0.0, -1.0, 0.0]], 3, axis=0)
    faces = np.array([[0, 2, 1], [3, 4, 5]])
    simple = simplified(DrawnMesh(vertices, faces, normals, (1.0, 1.0, 1.0, 1.0)), 0.1)
    assert len(simple.vertices) == 6 and len(simple.triangles) == 2


def test_too_many_simple_shapes_fit_a_page_as_well(
    demonstration: Demonstration, annotation: Annotation
) -> None:
    shapes = tuple(
        Shape("cylinder", (0.02, 0.05), pose((0.05 * i, 0.05 * j, 0.0)))
        for i in range(12)
        for j in range(12)
    )
    scene = SceneSpec((Body("block", shapes),))
    view = scene_view(demonstration, annotation, scene=scene)
    assert 0 < triangles(view) <= MAX_TRIANGLES


# --- in a browser -------------------------------------------------------------------------------


def browsed(page: Path, *flags: str) -> str:
    """The page's elements after its scripts ran."""
    assert BROWSER is not None
    command = [
        BROWSER, "--headless", "--no-sandbox", "--disable-dev-shm-usage", *flags,
        "--virtual-time-budget=5000", "--dump-dom", page.as_uri(),
    ]  # fmt: skip
    done = subprocess.run(command, capture_output=True, text=True, timeout=300, check=True)
    return done.stdout


@pytest.mark.window
@pytest.mark.skipif(BROWSER is None, reason="no Chromium: apt-get install chromium")
def test_a_browser_draws_the_view_and_keeps_the_picture_where_it_can_not(run_dir: Path) -> None:
    def setting(demonstration: Demonstration) -> Any:
        return get_robot("ur5e_2f85"), get_task("peg_in_hole").scene

    page = run_dir / "report.html"
    write_report(run_dir, page, setting)
    drawn = browsed(page, "--use-angle=swiftshader", "--enable-unsafe-swiftshader")
    assert '<figure class="view live" id="view">' in drawn
    assert re.search(r'<canvas [^>]*data-drawn="[1-9]', drawn)
    assert drawn.count(">Copy</button>") == drawn.count('class="command"') > 2
    without = browsed(page, "--disable-3d-apis")
    assert '<figure class="view" id="view">' in without
    assert "data-drawn" not in without
