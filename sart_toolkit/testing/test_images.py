"""Images: where things appear, how far they are, in which colours."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from sart_toolkit.backends import get_backend
from sart_toolkit.backends.interface import CameraView, Draws, Resets
from sart_toolkit.errors import InvalidInput, UnknownName
from sart_toolkit.poses import Array, inverse, pose
from sart_toolkit.robots.spec import ImageSize, check_image_size
from sart_toolkit.scenes.spec import SceneState
from sart_toolkit.testing.bench import Bench
from sart_toolkit.testing.scenes import DOT_OFFSET, DOT_THICKNESS, ROOM_HALF_WIDTH

_SIZE = 128
_EXTRINSICS = "test_bodies_appear_where_the_camera_s_pose_has_them"


def _wrist(bench: Bench) -> str:
    return bench.backend.robot.cameras[0].name


def _take(bench: Bench, camera: str, size: ImageSize = _SIZE) -> CameraView:
    return bench.see((camera,), size).cameras[camera]


def _coloured(view: CameraView, colour: str) -> Array:
    """Which pixels `(H, W)` are mainly green, or red and blue together."""
    r, g, b = view.rgb.astype(int).transpose(2, 0, 1)
    if colour == "green":
        return (g > 40) & (r < 0.5 * g) & (b < 0.5 * g)
    return (np.minimum(r, b) > 40) & (g < 0.5 * np.minimum(r, b))


def _middle(mask: Array) -> Array | None:
    """The middle `(u, v)` [pixels] of a mask, if it has any pixel."""
    rows, columns = np.nonzero(mask)
    return np.array([columns.mean(), rows.mean()]) if len(rows) else None


def _projected(bench: Bench, camera: str, body: str) -> Array:
    """Where a body's origin should be `(u, v)` [pixels] from the middle of the image."""
    spec, state = bench.backend.cameras[camera], bench.state(bench.q)
    frame = np.eye(4) if spec.frame == "world" else bench.model.fk(bench.see().q, spec.frame)
    p = (
        inverse(frame @ spec.T_frame_camera)
        @ bench.see().Ts_world_body.get(body, state.Ts_world_body[body])[:, 3]
    )
    return spec.intrinsics(_SIZE, _SIZE)[0, 0] * p[:2] / p[2]


def _from_middle(view: CameraView, colour: str) -> Array | None:
    found = _middle(_coloured(view, colour))
    return None if found is None else found - 0.5 * (_SIZE - 1)


def _same_direction(a: Array, b: Array, within_deg: float) -> bool:
    return bool(a @ b > np.cos(np.deg2rad(within_deg)) * np.linalg.norm(a) * np.linalg.norm(b))


@pytest.mark.parametrize("camera", ["wrist", "left", "right"])
def test_bodies_appear_where_the_camera_s_pose_has_them(view: Bench, camera: str) -> None:
    """Extrinsics: z forward, x right, y down; a ball in the middle, a bead in the right direction.

    OpenGL's cameras look along -z with y up; others take the pose's inverse.
    """
    camera = _wrist(view) if camera == "wrist" else camera
    image = _take(view, camera)
    ball, bead = _from_middle(image, "green"), _from_middle(image, "magenta")
    assert ball is not None and bead is not None, "ball and bead are not in the image"
    assert np.linalg.norm(ball) < 1.5
    assert _same_direction(bead, _projected(view, camera, "bead"), 8.0)


@pytest.mark.parametrize("size", [(64, 64), (129, 129), (160, 120), (112, 128)])
def test_bodies_appear_as_the_field_of_view_has_them(view: Bench, size: tuple[int, int]) -> None:
    """Intrinsics: a square of dots is as large as it should be, its middle at the image's.

    `fov_y_deg` is the whole vertical angle, pixels are square, and (0, 0) is the centre of the
    first pixel.
    """
    green = _coloured(_take(view, "room", size), "green")
    u, v = (n // 2 for n in size)
    upper_left, lower_right = _middle(green[:v, :u]), _middle(green[-v:, -u:])
    assert upper_left is not None and lower_right is not None, "the dots are not in the image"
    K = view.backend.cameras["room"].intrinsics(*size)
    offset = K[0, 0] * DOT_OFFSET / (ROOM_HALF_WIDTH - DOT_THICKNESS)
    lower_right = lower_right + np.subtract(size, (u, v))
    np.testing.assert_allclose(upper_left, K[:2, 2] - offset, rtol=0, atol=0.6)
    np.testing.assert_allclose(lower_right, K[:2, 2] + offset, rtol=0, atol=0.6)


def test_depth_is_in_metres(view: Bench) -> None:
    """Not millimetres, not a fraction of the farthest: a wall half a metre away is at 0.5."""
    depth = _take(view, "room").depth
    at = depth[_SIZE // 2, _SIZE // 2]
    assert at == pytest.approx(ROOM_HALF_WIDTH - DOT_THICKNESS, abs=0.002)


def test_depth_is_along_the_camera_s_axis(view: Bench) -> None:
    """Not along the ray: a wall across the view is equally far in the image's corners."""
    depth = _take(view, "room").depth
    corners = depth[[0, 0, -1, -1], [0, -1, 0, -1]]
    np.testing.assert_allclose(corners / depth[_SIZE // 2, _SIZE // 2], 1.0, rtol=0, atol=0.01)


def test_depth_is_zero_where_nothing_was_hit(view: Bench) -> None:
    """Not the farthest distance, not infinite."""
    assert not _take(view, "nowhere", 16).depth.any()


def test_depth_and_colour_show_the_same(view: Bench) -> None:
    """Where the bead is in the image, it is nearer than all around it."""
    image = _take(view, "left", 192)
    bead = _coloured(image, "magenta")
    view.relies_on(bead.sum() > 20, _EXTRINSICS)
    rows, columns = np.nonzero(bead)
    window = np.s_[rows.min() - 2 : rows.max() + 3, columns.min() - 2 : columns.max() + 3]
    depth = np.where(image.depth > 0, image.depth, np.inf)[window]
    near = depth < 1.1 * depth.min()
    assert (near & bead[window]).sum() > 0.75 * (near | bead[window]).sum()


def test_colours_are_red_green_and_blue_in_order(view: Bench) -> None:
    """The plate in the middle of the wall is red."""
    r, g, b = _take(view, "room").rgb[_SIZE // 2, _SIZE // 2].astype(int)
    assert r > 40 and g < 0.5 * r and b < 0.5 * r


def test_images_have_the_size_asked_for(view: Bench) -> None:
    """Or else the backend's own."""
    for size in (1, 33, (16, 9), None):
        image = view.see((_wrist(view),), size).cameras[_wrist(view)]
        width, height = check_image_size(size or view.backend.image_size)
        assert image.rgb.shape == (height, width, 3)
        assert image.depth.shape == (height, width)


def test_images_have_bytes_for_colours_and_float32_for_depth(view: Bench) -> None:
    """As they are recorded."""
    image = _take(view, "left", 8)
    assert image.rgb.dtype == np.uint8
    assert image.depth.dtype == np.float32


def test_only_images_asked_for_are_taken(view: Bench) -> None:
    """By name, each once."""
    assert not view.see().cameras
    names = {"room", _wrist(view)}
    assert set(view.see(sorted(names), 4).cameras) == names


def test_a_camera_s_reported_pose_is_that_of_its_frame(view: Bench) -> None:
    """`T_world_camera` follows the robot for the wrist camera and stays for the scene's."""
    for offset in (0.0, 0.1):
        view.reset(view.ready + offset)
        seen = view.see((_wrist(view), "left"), 4)
        for name, image in seen.cameras.items():
            spec = view.backend.cameras[name]
            T = np.eye(4) if spec.frame == "world" else view.model.fk(seen.q, spec.frame)
            np.testing.assert_allclose(
                image.T_world_camera, T @ spec.T_frame_camera, rtol=0, atol=1e-4
            )


def test_the_wrist_camera_moves_with_the_tool(view: Bench) -> None:
    """What was in the middle of its image is where the moved tool has it."""
    ball = _from_middle(_take(view, _wrist(view)), "green")
    view.relies_on(ball is not None and np.linalg.norm(ball) < 1.5, _EXTRINSICS)
    for sideways in (-0.03, 0.03):
        T = view.model.fk(view.ready) @ pose([sideways, 0, 0])
        view.reset(view.model.ik(T, view.ready))
        ball = _from_middle(_take(view, _wrist(view)), "green")
        expected = _projected(view, _wrist(view), "ball")
        assert ball is not None, "the ball is no longer in the image"
        assert np.linalg.norm(ball) > 3, "the image hasn't changed"
        assert _same_direction(ball, expected, 10.0)


def test_images_show_bodies_where_they_are_now(view: Bench) -> None:
    """A body that a reset has put elsewhere is drawn there."""
    ball = _from_middle(_take(view, "left"), "green")
    view.relies_on(ball is not None and np.linalg.norm(ball) < 1.5, _EXTRINSICS)
    camera = view.backend.cameras["left"].T_frame_camera
    place = view.state().Ts_world_body["ball"].copy()
    place[:3, 3] += 0.05 * camera[:3, 0]
    view.reset(Ts_world_body={"ball": place})
    ball = _from_middle(_take(view, "left"), "green")
    assert ball is not None and ball[0] > 5 and abs(ball[1]) < 1.5


# --- drawn --------------------------------------------------------------------------------------


def _moved_ball(bench: Bench) -> SceneState:
    """A state with the arm and the ball out of their places."""
    camera = bench.backend.cameras["left"].T_frame_camera
    place = bench.state().Ts_world_body["ball"].copy()
    place[:3, 3] += 0.05 * camera[:3, 0]
    return bench.state(bench.ready + 0.1, Ts_world_body={"ball": place})


def test_a_drawn_state_appears_as_the_state_does(view: Bench) -> None:
    """As an image of the same state after a reset does."""
    view.needs(Draws, Resets)
    state = _moved_ball(view)
    for name in ("left", _wrist(view)):
        drawn = view.stage.draw(state, view.backend.cameras[name], 96, 64)
        view.resets.reset(state)
        taken = _take(view, name, (96, 64))
        view.reset()
        np.testing.assert_allclose(drawn.T_world_camera, taken.T_world_camera, rtol=0, atol=1e-4)
        different = np.abs(drawn.rgb.astype(int) - taken.rgb).max(-1) > 8
        assert different.mean() < 0.01
        np.testing.assert_array_equal(drawn.depth > 0, taken.depth > 0)


def test_a_drawing_camera_need_not_be_one_of_the_scene_s(view: Bench) -> None:
    """Any pose and field of view will do, also under a name that is taken."""
    view.needs(Draws)
    left = view.backend.cameras["left"]
    for fov in (left.fov_y_deg, 0.5 * left.fov_y_deg):
        camera = dataclasses.replace(left, fov_y_deg=fov)
        drawn = view.stage.draw(view.state(), camera, _SIZE, _SIZE)
        bead = _from_middle(drawn, "magenta")
        view.relies_on(bead is not None, _EXTRINSICS)
        T_camera_world = inverse(left.T_frame_camera)
        p = T_camera_world @ view.state().Ts_world_body["bead"][:, 3]
        expected = camera.intrinsics(_SIZE, _SIZE)[0, 0] * p[:2] / p[2]
        assert np.linalg.norm(bead - expected) < 0.1 * np.linalg.norm(expected) + 1.5


def test_drawing_changes_nothing(view: Bench) -> None:
    """Robot and bodies stay as they are, to the bit, and so does what follows."""
    view.needs(Draws)
    view.relies_on_repeating()
    view.command(view.ready + 0.02)
    expected = [view.digest(), *view.continuation()]
    view.reset()
    view.command(view.ready + 0.02)
    view.stage.draw(_moved_ball(view), view.backend.cameras["left"], 32, 32)
    assert [view.digest(), *view.continuation()] == expected


# --- refused ------------------------------------------------------------------------------------


@pytest.mark.parametrize("size", [0, -1])
def test_an_image_without_pixels_is_refused(view: Bench, size: int) -> None:
    """When it is made and when it is asked for."""
    with pytest.raises(InvalidInput, match="image_size"):
        get_backend(view.backend_name)(view.backend.robot, view.scene, size)
    with pytest.raises(InvalidInput, match="image_size"):
        view.see((_wrist(view),), size)


def test_an_unknown_camera_is_refused(bench: Bench) -> None:
    """By its name, with the ones that there are, also where no image could be taken."""
    with pytest.raises(UnknownName, match="'sidewise'.*side"):
        bench.see(("sidewise",))
