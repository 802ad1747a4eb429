"""Images of a board, drawn by the homography of its plane, with blur and noise."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import pytest

from sart_toolkit.calibrate.board import Board
from sart_toolkit.calibrate.hand_eye import BoardView
from sart_toolkit.data.records import CameraFrame
from sart_toolkit.poses import Array, apply_motion, inverse, pose
from sart_toolkit.robots.spec import look_at

SIZE = (480, 360)
F = 460.0
K = np.array([[F, 0, (SIZE[0] - 1) / 2], [0, F, (SIZE[1] - 1) / 2], [0, 0, 1.0]])
_TEXTURE_PIXELS = 100


class Drawn(NamedTuple):
    """Views, where the camera really is `(4, 4)`, and its intrinsics `(3, 3)`."""

    views: list[BoardView]
    T_frame_camera: Array
    K: Array


def draw_image(board: Board, T_camera_board: Array, rng: np.random.Generator, K: Array = K):
    """What a camera sees of the board."""
    cv2 = pytest.importorskip("cv2")
    scale = board.square / _TEXTURE_PIXELS
    # A texture's pixel, by its middle, on the board; the image has four pixels for each of its own.
    on_board = np.array([[scale, 0, scale / 2], [0, scale, scale / 2], [0, 0, 1.0]])
    fine = np.array([[2, 0, 0.5], [0, 2, 0.5], [0, 0, 1.0]])
    plane = np.stack([T_camera_board[:3, 0], T_camera_board[:3, 1], T_camera_board[:3, 3]], axis=1)
    drawn = cv2.warpPerspective(
        board.image(_TEXTURE_PIXELS), fine @ K @ plane @ on_board, (2 * SIZE[0], 2 * SIZE[1]),
        borderValue=210,
    )  # fmt: skip
    grey = cv2.GaussianBlur(
        cv2.resize(drawn, SIZE, interpolation=cv2.INTER_AREA).astype(float), (0, 0), 0.7
    )
    noisy = np.clip(grey + rng.normal(0, 4.0, grey.shape), 0, 255).astype(np.uint8)
    return np.repeat(noisy[..., None], 3, axis=2)


def depth_image(T_camera_board: Array, factor: float, rng: np.random.Generator):
    """The depth `(H, W)` of the board's plane, too large by a factor."""
    column, row = np.meshgrid(np.arange(SIZE[0]), np.arange(SIZE[1]))
    rays = np.stack([column, row, np.ones_like(row)], axis=-1) @ np.linalg.inv(K).T
    n = T_camera_board[:3, 2]
    depth = n @ T_camera_board[:3, 3] / (rays @ n)
    return (factor * depth + rng.normal(0, 5e-4, depth.shape)).astype(np.float32)


def draw_views(
    seed: int = 0,
    n: int = 12,
    frame: CameraFrame = "tool",
    pose_noise: float = 1e-4,
    pose_noise_deg: float = 0.02,
    tilt_deg: tuple[float, float] = (8, 32),
    depth: float | None = None,
    board: Board | None = None,
    printed: Board | None = None,
) -> Drawn:
    """Views from all sides, tilted, by a robot whose poses are a little off."""
    rng = np.random.default_rng(seed)
    board, printed = board or Board(), printed or board or Board()
    X = pose(rng.normal(0, 0.02, 3) + [0, 0.08, -0.1], rng.normal(0, 0.2, 3))
    Z = pose([0.5, 0, 0], rng.normal(0, 0.05, 3)) @ pose(rotvec=[np.pi, 0, 0])
    middle = np.array([printed.columns, printed.rows, 0]) * printed.square / 2
    views = []
    for i in range(n):
        turn, tilt = rng.uniform(0, 2 * np.pi), np.deg2rad(rng.uniform(*tilt_deg))
        target = middle + rng.uniform(-0.02, 0.02, 3) * [1, 1, 0]
        away = np.array([np.sin(tilt) * np.cos(turn), np.sin(tilt) * np.sin(turn), -np.cos(tilt)])
        twist = rng.uniform(-0.5, 0.5) if tilt_deg[1] > 5 else 0.0
        up = np.array([np.sin(twist), -np.cos(twist), 0.0])
        T_board_camera = look_at(target + rng.uniform(0.26, 0.36) * away, target, up)
        C = inverse(T_board_camera)
        T = Z @ T_board_camera @ inverse(X) if frame == "tool" else X @ C @ inverse(Z)
        off = rng.normal(0, 1, 6) * np.repeat([pose_noise, np.deg2rad(pose_noise_deg)], 3)
        seen = None if depth is None else depth_image(C, depth, rng)
        rgb = draw_image(printed, C, rng)
        views.append(BoardView(f"{i:02d}.png", apply_motion(T, off), rgb, seen))
    return Drawn(views, X, K)


@pytest.fixture(scope="session")
def board_views() -> Drawn:
    """Twelve views of the default board with depth, 1 % too large."""
    return draw_views(depth=1.01)


@pytest.fixture(scope="session")
def drawing() -> Callable[..., Drawn]:
    return draw_views
