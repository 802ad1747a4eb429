"""A camera is found where it is, within what is declared, or it is said why it can't be."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from sart_toolkit.calibrate.board import Board
from sart_toolkit.calibrate.hand_eye import BoardView, CalibrateConfig, calibrate_camera
from sart_toolkit.errors import InvalidInput
from sart_toolkit.poses import distance, pose

pytest.importorskip("cv2")


def off(found, drawn) -> tuple[float, float]:
    metres, angle = distance(found.T_frame_camera, drawn.T_frame_camera)
    return metres, float(np.rad2deg(angle))


def test_the_camera_and_the_depth_are_found_within_what_is_declared(board_views):
    found = calibrate_camera(board_views.views, Board(), intrinsics=board_views.K)
    metres, degrees = off(found, board_views)
    assert metres <= found.hand_eye <= 0.004 and degrees <= found.hand_eye_deg <= 0.6
    assert (found.views, found.left_out, found.image_size) == (12, (), (480, 360))
    assert found.depth_scale == pytest.approx(1.01, abs=0.004)
    assert 0.01 <= found.depth_scale_error <= 0.02
    assert found.square_scale == pytest.approx(1, abs=0.004)


def test_intrinsics_that_nobody_gives_are_found_as_well(board_views):
    found = calibrate_camera(board_views.views, Board())
    metres, degrees = off(found, board_views)
    assert metres <= found.hand_eye and degrees <= found.hand_eye_deg
    np.testing.assert_allclose(found.intrinsics, board_views.K, atol=4.0)


def test_a_camera_that_stands_in_the_world_is_found(drawing):
    drawn = drawing(seed=1, frame="world")
    found = calibrate_camera(drawn.views, Board(), "overview", "world", drawn.K)
    metres, degrees = off(found, drawn)
    assert metres <= found.hand_eye and degrees <= found.hand_eye_deg
    assert (found.camera, found.frame) == ("overview", "world")
    assert found.depth_scale is None and found.depth_scale_error is None


def test_without_noise_in_the_poses_less_is_declared(drawing):
    exact, noisy = (drawing(seed=2, pose_noise=n, pose_noise_deg=d) for n, d in
                    ((0.0, 0.0), (5e-4, 0.1)))  # fmt: skip
    few, many = (
        calibrate_camera(each.views, Board(), intrinsics=each.K) for each in (exact, noisy)
    )
    assert 3 * few.hand_eye < many.hand_eye and 3 * few.hand_eye_deg < many.hand_eye_deg
    assert off(few, exact)[0] < 3e-4


@pytest.mark.slow
def test_what_is_declared_covers_the_truth_in_19_of_20_draws(drawing):
    covered = 0
    for seed in range(100, 120):
        drawn = drawing(seed=seed, n=9)
        found = calibrate_camera(drawn.views, Board(), intrinsics=drawn.K if seed % 2 else None)
        metres, degrees = off(found, drawn)
        covered += metres <= found.hand_eye and degrees <= found.hand_eye_deg
    assert covered >= 19


def test_a_view_with_another_s_pose_is_left_out(board_views):
    views = list(board_views.views)
    views[3] = dataclasses.replace(views[3], T_world_tool=views[4].T_world_tool)
    found = calibrate_camera(views, Board(), intrinsics=board_views.K)
    metres, degrees = off(found, board_views)
    assert found.left_out == ("03.png",) and found.views == 11
    assert metres <= found.hand_eye and degrees <= found.hand_eye_deg


def test_a_view_without_the_board_is_left_out(board_views):
    blank = BoardView("blank.png", pose(), np.full((360, 480, 3), 200, np.uint8))
    found = calibrate_camera([*board_views.views, blank], Board(), intrinsics=board_views.K)
    assert found.left_out == ("blank.png",)


def test_too_few_views_and_a_board_that_is_not_seen_are_refused(board_views):
    with pytest.raises(InvalidInput, match="views: 5 images, at least 8 are needed; take more"):
        calibrate_camera(board_views.views[:5], Board())
    with pytest.raises(InvalidInput, match="board: 0 of 12 images show it, at least 8 are needed"):
        calibrate_camera(board_views.views, Board(dictionary="DICT_6X6_250"))
    small = dataclasses.replace(
        board_views.views[0], rgb=board_views.views[0].rgb[::2, ::2], depth=None
    )
    with pytest.raises(InvalidInput, match="images of several sizes, 240x180, 480x360"):
        calibrate_camera([small, *board_views.views], Board())


def test_rotations_too_similar_are_refused(drawing):
    drawn = drawing(seed=3, tilt_deg=(0.0, 1.0))
    with pytest.raises(InvalidInput, match="rotations too similar: about a second axis the tool"):
        calibrate_camera(drawn.views, Board(), intrinsics=drawn.K)


def test_squares_of_another_size_than_said_are_refused(drawing):
    drawn = drawing(seed=4, printed=Board(square=0.026, marker=0.0187))
    with pytest.raises(InvalidInput, match=r"squares of 25 mm contradict .* has them 2[56]\.\d+"):
        calibrate_camera(drawn.views, Board(), intrinsics=drawn.K)


def test_intrinsics_of_another_image_are_refused(board_views):
    other = board_views.K * [[1.1], [1.1], [1]]
    with pytest.raises(InvalidInput, match=r"focal length of 4\d\d.\d pixels, given are 506.0"):
        calibrate_camera(board_views.views, Board(), intrinsics=other)


def test_poses_that_do_not_belong_to_the_images_are_refused(board_views):
    shuffled = [
        dataclasses.replace(view, T_world_tool=other.T_world_tool)
        for view, other in zip(board_views.views, board_views.views[5:] + board_views.views[:5],
                               strict=True)
    ]  # fmt: skip
    with pytest.raises(InvalidInput, match="poses and images don't belong together"):
        calibrate_camera(shuffled, Board(), intrinsics=board_views.K)


def test_depth_in_another_unit_is_refused(board_views):
    views = [dataclasses.replace(view, depth=view.depth * 1000) for view in board_views.views]
    with pytest.raises(InvalidInput, match=r"depth: is 10\d\d times what the board says"):
        calibrate_camera(views, Board(), intrinsics=board_views.K)


def test_views_and_settings_that_are_none_are_refused():
    with pytest.raises(InvalidInput, match="a: expected uint8 of shape"):
        BoardView("a", pose(), np.zeros((4, 4), np.uint8))
    with pytest.raises(InvalidInput, match="a: depth: expected shape"):
        BoardView("a", pose(), np.zeros((4, 4, 3), np.uint8), np.zeros((2, 2), np.float32))
    with pytest.raises(InvalidInput, match="least_views: expected at least 6, got 3"):
        CalibrateConfig(least_views=3)
    with pytest.raises(InvalidInput, match="probability: expected 0.5 to 1, got 1"):
        CalibrateConfig(probability=1)
