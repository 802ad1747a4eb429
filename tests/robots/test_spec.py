"""Robots as data: shapes, cameras and limits are checked when they are made."""

import dataclasses

import hypothesis.strategies as st
import numpy as np
import pytest
from hypothesis import given, settings

from sart_toolkit.data.assets import asset
from sart_toolkit.errors import InvalidInput, MissingExtra, MissingFile
from sart_toolkit.poses import check_pose, inverse, pose
from sart_toolkit.robots.spec import (
    Attachment,
    CameraSpec,
    Shape,
    check_image_size,
    look_at,
    resource_path,
)

PROPERTY = settings(deadline=None, derandomize=True, max_examples=50)

lengths = st.floats(0.001, 2)
points = st.tuples(*[st.floats(-1, 1)] * 3).map(np.array)
SIZES = {"box": 3, "cylinder": 2, "sphere": 1}


@PROPERTY
@given(st.sampled_from(sorted(SIZES)), st.data(), points, points, st.integers(0, 2**32 - 1))
def test_the_hull_of_a_shapes_corners_encloses_it(kind, data, p, rotvec, seed):
    size = data.draw(st.tuples(*[lengths] * SIZES[kind]))
    shape = Shape(kind, size, pose(p, rotvec))
    rng = np.random.default_rng(seed)
    inside = rng.uniform(-0.5, 0.5, (100, 3))
    if kind == "box":
        inside = inside * size
    elif kind == "cylinder":
        angle = rng.uniform(0, 2 * np.pi, 100)
        ring = size[0] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
        inside = np.column_stack([ring, inside[:, 2] * size[1]])
    else:
        inside = size[0] * inside / np.linalg.norm(inside, axis=1, keepdims=True)
    R, offset = shape.T_body_shape[:3, :3], shape.T_body_shape[:3, 3]
    surface, corners = inside @ R.T + offset, shape.corners()
    # A hull encloses a point if it reaches at least as far as the point in every direction.
    for direction in rng.normal(size=(50, 3)):
        assert (corners @ direction).max() >= (surface @ direction).max() - 1e-12


def test_a_shape_of_unknown_kind_is_refused():
    with pytest.raises(InvalidInput, match=r"shape kind: expected one of \['box'.* got 'cone'"):
        Shape("cone", (1, 1))


def test_a_size_may_be_an_array():
    assert Shape("box", np.array([0.1, 0.2, 0.3])).size == (0.1, 0.2, 0.3)


@pytest.mark.parametrize(
    ("kind", "size"), [("box", (1, 1)), ("cylinder", (1,)), ("sphere", (1, 1))]
)
def test_a_size_with_the_wrong_count_is_refused(kind, size):
    with pytest.raises(InvalidInput, match=f"{kind} size: expected {SIZES[kind]} numbers, got"):
        Shape(kind, size)


@pytest.mark.parametrize("bad", [0, -1, np.nan, np.inf])
def test_a_size_that_is_not_positive_is_refused(bad):
    with pytest.raises(InvalidInput, match="box size: expected a finite number > 0 m"):
        Shape("box", (1, bad, 1))


def test_a_shape_at_what_is_no_pose_is_refused():
    with pytest.raises(InvalidInput, match="T_body_shape: not a rigid transform"):
        Shape("sphere", (1,), np.zeros((4, 4)))


def test_an_attachment_needs_mass_a_pose_and_a_shape():
    box = (Shape("box", (1, 1, 1)),)
    with pytest.raises(InvalidInput, match="mass of peg: expected a finite number > 0 kg"):
        Attachment("peg", "tool", box, mass=0)
    with pytest.raises(InvalidInput, match="T_frame_body: expected pose shape"):
        Attachment("peg", "tool", box, np.eye(3))
    with pytest.raises(InvalidInput, match="peg.* has no shape; give it at least one"):
        Attachment("peg", "tool", ())


@pytest.mark.parametrize("fov", [0, 0.5, 171, -60, np.nan])
def test_a_field_of_view_that_no_lens_has_is_refused(fov):
    with pytest.raises(InvalidInput, match="fov_y_deg: expected 1 to 170 degrees, got"):
        CameraSpec("wrist", "tool", np.eye(4), fov_y_deg=fov)


@pytest.mark.parametrize(("near", "far"), [(0, 1), (-1, 1), (2, 1), (np.nan, 1), (0.1, np.inf)])
def test_a_camera_that_sees_no_range_of_depths_is_refused(near, far):
    with pytest.raises(InvalidInput, match="near|far"):
        CameraSpec("wrist", "tool", np.eye(4), near=near, far=far)


def test_a_camera_at_what_is_no_pose_is_refused():
    with pytest.raises(InvalidInput, match="T_frame_camera: not a rigid transform"):
        CameraSpec("wrist", "tool", 2 * np.eye(4))


@PROPERTY
@given(st.floats(1, 170), st.integers(1, 500), st.integers(1, 500))
def test_intrinsics_put_the_field_of_view_at_the_images_edges(fov, width, height):
    K = CameraSpec("wrist", "tool", np.eye(4), fov_y_deg=fov).intrinsics(width, height)
    rise = np.tan(np.deg2rad(fov) / 2)
    for direction, row in ((rise, height - 0.5), (-rise, -0.5)):
        u, v, w = K @ [0, direction, 1]
        # (0, 0) is the centre of the first pixel, so the image spans -0.5 to height - 0.5.
        assert (u / w, v / w) == pytest.approx(((width - 1) / 2, row), abs=1e-6 * height)
    assert K[0, 0] == K[1, 1]


@PROPERTY
@given(points, points, points)
def test_a_camera_looks_at_its_target_the_right_way_up(p_camera, p_target, up):
    away = p_target - p_camera
    if np.linalg.norm(np.cross(away, up)) < 1e-3:
        return
    T = check_pose("T", look_at(p_camera, p_target, up))
    seen = (inverse(T) @ np.append(p_target, 1))[:3]
    np.testing.assert_allclose(seen, [0, 0, np.linalg.norm(away)], atol=1e-12)
    # y points down: up is against it, and has no part to the right.
    assert up @ T[:3, 1] < 0
    assert up @ T[:3, 0] == pytest.approx(0, abs=1e-12)


def test_the_intrinsics_and_pose_of_a_camera_project_its_target_to_the_middle():
    camera = CameraSpec("c", "world", look_at(np.ones(3), np.zeros(3), np.array([0, 0, 1.0])))
    u, v, w = camera.intrinsics(64, 48) @ (inverse(camera.T_frame_camera) @ [0, 0, 0, 1])[:3]
    assert (u / w, v / w) == pytest.approx((31.5, 23.5))


@pytest.mark.parametrize("target", [np.zeros(3), np.array([0, 0, 1.0])], ids=["itself", "up"])
def test_a_camera_that_looks_nowhere_or_straight_up_is_refused(target):
    with pytest.raises(InvalidInput, match="look_at"):
        look_at(np.zeros(3), target, np.array([0, 0, 1.0]))


@pytest.mark.parametrize("name", ["home", "velocity_limits", "acceleration_limits", "jerk_limits"])
def test_joint_arrays_must_have_one_number_a_joint(spec, name):
    with pytest.raises(InvalidInput, match=rf"{name}: expected shape \(6,\), got \(5,\)"):
        dataclasses.replace(spec, **{name: np.ones(5)})


@pytest.mark.parametrize("name", ["velocity_limits", "acceleration_limits", "jerk_limits"])
@pytest.mark.parametrize("bad", [0, -1])
def test_joint_limits_must_be_positive(spec, name, bad):
    limits = np.ones(6)
    limits[3] = bad
    with pytest.raises(InvalidInput, match=name):
        dataclasses.replace(spec, **{name: limits})


def test_a_tool_frame_that_is_no_pose_is_refused(spec):
    with pytest.raises(InvalidInput, match="T_gripper_tool: not a rigid transform"):
        dataclasses.replace(spec, T_gripper_tool=np.zeros((4, 4)))


def test_a_spec_does_not_follow_the_array_that_it_was_made_from(spec):
    home = np.zeros(6)
    other = dataclasses.replace(spec, home=home)
    home[:] = 1
    assert (other.home == 0).all()
    assert not other.home.flags.writeable


def test_a_resource_is_found_in_a_package_or_by_its_path(spec, tmp_path):
    found = resource_path(spec.urdf)
    assert found.name == "ur5e.urdf"
    assert resource_path(str(found)) == found
    assert resource_path("sart_toolkit:robots/hande.urdf") == asset("robots/hande.urdf")


@pytest.mark.parametrize("package", ["no_such_package", "no_such_package.inside"])
def test_a_resource_of_a_missing_package_says_how_to_install_it(package):
    with pytest.raises(MissingExtra, match=f"package '{package}' missing; pip install no_such_p"):
        resource_path(f"{package}:robot.urdf")


def test_a_missing_resource_is_reported(tmp_path):
    with pytest.raises(MissingFile, match=r"airo_models:x.urdf: no such file \(x.urdf\)"):
        resource_path("airo_models:x.urdf")
    with pytest.raises(MissingFile, match="no such file"):
        resource_path(str(tmp_path))


@pytest.mark.parametrize(
    ("given", "size"),
    [(64, (64, 64)), ("64", (64, 64)), ("160x120", (160, 120)), ((160, 120), (160, 120))],
)
def test_an_image_s_size_is_a_number_or_width_and_height(given, size):
    assert check_image_size(given) == size
    assert check_image_size(np.array(given) if isinstance(given, tuple) else given) == size


@pytest.mark.parametrize("bad", [0, -3, "0x4", "4x", "x", "1x2x3", (1, 2, 3), 64.5, "big", ()])
def test_a_size_without_pixels_is_refused(bad):
    with pytest.raises(InvalidInput, match="image_size: expected pixels, at least 1, as a number"):
        check_image_size(bad)


def test_two_cameras_of_one_name_on_a_robot_are_refused(spec):
    with pytest.raises(InvalidInput, match="cameras of .*: expected different names"):
        dataclasses.replace(spec, cameras=2 * spec.cameras)
