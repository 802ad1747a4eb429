"""How well a wrist camera's mounting is found: `python tools/calibration.py --out F.json`.

For each draw the camera is mounted a little otherwise, the arm looks at the board from some sides,
and what the camera sees is drawn by SAPIEN or by the ray caster that draws for PyBullet, then
blurred and made noisy; the joints that the robot reports are off, too. The camera is calibrated
from that, and the estimate compared with where the camera really was: how far it is off, and
whether no farther than was declared. Depth is too large by a known factor, which is to be found as
well.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from sart_toolkit import doctor
from sart_toolkit.backends import make_backend
from sart_toolkit.backends.interface import CameraView, Draws, require
from sart_toolkit.backends.raycast import RayCaster
from sart_toolkit.calibrate.board import Board
from sart_toolkit.calibrate.hand_eye import BoardView, calibrate_camera
from sart_toolkit.data.records import library_versions
from sart_toolkit.errors import Unreachable
from sart_toolkit.poses import Array, apply_motion, distance, inverse, pose
from sart_toolkit.robots import get_robot
from sart_toolkit.robots.model import RobotModel
from sart_toolkit.robots.spec import CameraSpec, Shape, look_at
from sart_toolkit.robots.visuals import body_meshes
from sart_toolkit.scenes.spec import Body, Light, SceneSpec

_ROBOT = "ur5e_2f85"
# A square of the default board is so many cells wide, its markers' modules a whole number of them.
_CELLS = 50
# What is printed stands out of the paper by so much [m].
_INK = 1e-4
_SIZE = (640, 480)
_FOV_DEG = 42.0
# Every pixel is the mean of so many by so many rays.
_RAYS = 2
DEPTH_SCALE = 1.01
T_WORLD_BOARD = pose([0.42, -0.10, 0.01]) @ pose(rotvec=[np.pi, 0, 0])


def board_body(board: Board) -> Body:
    """The board as boxes that are only drawn: paper, and each black patch of it."""
    cells = board.image(_CELLS) == 0
    width, height = board.columns * board.square, board.rows * board.square
    edge = board.square / 2
    paper = Shape(
        "box",
        (width + 2 * edge, height + 2 * edge, 0.004),
        pose([width / 2, height / 2, _INK + 0.002]),
        (0.95, 0.95, 0.95, 1.0),
        collides=False,
    )
    size = board.square / _CELLS
    ink = [
        Shape(
            "box",
            ((c1 - c0) * size, (r1 - r0) * size, 2 * _INK),
            pose([(c0 + c1) / 2 * size, (r0 + r1) / 2 * size, _INK]),
            (0.03, 0.03, 0.03, 1.0),
            collides=False,
        )
        for r0, r1, c0, c1 in rectangles(cells)
    ]
    return Body("board", (paper, *ink), T_WORLD_BOARD)


def rectangles(cells: NDArray[np.bool_]) -> list[tuple[int, int, int, int]]:
    """Rectangles (first row, row after the last, the same of columns) that tile the true cells."""
    found = []
    open_: dict[tuple[int, int], int] = {}
    for row in range(len(cells) + 1):
        line = cells[row] if row < len(cells) else np.zeros(cells.shape[1], bool)
        edges = np.flatnonzero(np.diff(np.concatenate([[0], line.astype(int), [0]])))
        runs = set(zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True))
        for run in [run for run in open_ if run not in runs]:
            found.append((open_.pop(run), row, *run))
        for run in runs:
            open_.setdefault(run, row)
    return found


# Draws the robot at joints `(n,)` and the board, by a camera in the world.
Artist = Callable[[Array, CameraSpec, int, int], CameraView]


@contextlib.contextmanager
def drawing(name: str, board: Board) -> Iterator[Artist]:
    """What draws: "raycast", the board alone, or a backend with the ability, robot and board."""
    body = board_body(board)
    if name == "raycast":
        caster = RayCaster({body.name: body_meshes(body.shapes)}, Light())
        at = {body.name: body.T_world_body}
        yield lambda q, camera, width, height: caster.view(camera, np.eye(4), (width, height), at)
        return
    scene = SceneSpec((body,))
    backend = make_backend(name, get_robot(_ROBOT), scene, _SIZE)
    artist = require(backend, Draws, "it draws what the camera sees")
    with contextlib.closing(backend):
        yield lambda q, camera, width, height: artist.draw(
            scene.initial_state(q, 0.0), camera, width, height
        )


def draw_views(
    draw: Artist, board: Board, views: int, rng: np.random.Generator, joint_noise_deg: float
) -> tuple[Array, Array, list[BoardView]]:
    """Where the camera is on the tool `(4, 4)`, its intrinsics, and what it sees of the board."""
    model = RobotModel(get_robot(_ROBOT))
    T_tool_camera = model.mounted_cameras()["wrist"][1]
    # A person screws it on to within a centimetre and some degrees.
    T_tool_camera = apply_motion(
        T_tool_camera, np.concatenate([rng.normal(0, 0.01, 3), rng.normal(0, np.deg2rad(4), 3)])
    )
    lens = CameraSpec("calibrated", "world", np.eye(4), _FOV_DEG)
    middle = T_WORLD_BOARD @ [board.columns * board.square / 2, board.rows * board.square / 2, 0, 1]
    home = np.array(model.spec.home)
    drawn: list[BoardView] = []
    while len(drawn) < views:
        away, turn = rng.uniform(0.28, 0.42), rng.uniform(0, 2 * np.pi)
        tilt = np.deg2rad(rng.uniform(8, 32))
        target = middle[:3] + rng.uniform(-0.03, 0.03, 3) * [1, 1, 0]
        p = target + away * np.array(
            [np.sin(tilt) * np.cos(turn), np.sin(tilt) * np.sin(turn), np.cos(tilt)]
        )
        up = np.array([np.cos(a := rng.uniform(-0.6, 0.6)), np.sin(a), 0.0])
        T_world_camera = look_at(p, target, up)
        try:
            q = model.ik(T_world_camera @ inverse(T_tool_camera), home)
        except Unreachable:
            continue
        rgb, depth = picture(draw, q, T_world_camera, lens, rng)
        reported = q + rng.normal(0, np.deg2rad(joint_noise_deg), len(q))
        drawn.append(BoardView(f"view {len(drawn)}", model.fk(reported), rgb, depth))
    return T_tool_camera, lens.intrinsics(*_SIZE), drawn


def picture(
    draw: Artist, q: Array, T_world_camera: Array, lens: CameraSpec, rng: np.random.Generator
) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
    """What the camera sees, with blur and noise, and its depth with noise, too large."""
    camera = CameraSpec("calibrated", "world", T_world_camera, lens.fov_y_deg)
    width, height = _SIZE
    seen = draw(q, camera, _RAYS * width, _RAYS * height)
    sharp = seen.rgb.reshape(height, _RAYS, width, _RAYS, 3).mean(axis=(1, 3))
    soft = gaussian_filter(sharp, (rng.uniform(0.4, 1.0),) * 2 + (0,))
    noisy = soft * rng.uniform(0.7, 1.0) + rng.normal(0, 3.0, soft.shape)
    depth = seen.depth[_RAYS // 2 :: _RAYS, _RAYS // 2 :: _RAYS]
    off = depth + rng.normal(0, 1, depth.shape) * (0.0005 + 0.001 * depth**2)
    measured = np.where(depth > 0, DEPTH_SCALE * off, 0.0).astype(np.float32)
    return np.clip(noisy, 0, 255).astype(np.uint8), measured


def measure(
    draw: Artist, name: str, seed: int, views: int, joint_noise_deg: float, given: bool
) -> dict[str, Any]:
    """A row for one draw: how far the estimate is from the truth, and what was declared."""
    board = Board()
    rng = np.random.default_rng(seed)
    T, K, drawn = draw_views(draw, board, views, rng, joint_noise_deg)
    start = time.perf_counter()
    found = calibrate_camera(drawn, board, intrinsics=K if given else None)
    seconds = time.perf_counter() - start
    metres, angle = distance(T, found.T_frame_camera)
    assert found.depth_scale is not None and found.depth_scale_error is not None
    return {
        "drawn_by": name,
        "seed": seed,
        "intrinsics": "given" if given else "estimated",
        "views": found.views,
        "left_out": len(found.left_out),
        "rms_pixels": round(found.rms_pixels, 4),
        "error_mm": round(metres * 1e3, 4),
        "declared_mm": round(found.hand_eye * 1e3, 4),
        "error_deg": round(float(np.rad2deg(angle)), 4),
        "declared_deg": round(found.hand_eye_deg, 4),
        "focal_error_percent": round(100 * (found.intrinsics[0, 0] / K[0, 0] - 1), 3),
        "square_scale": round(found.square_scale, 5),
        "depth_scale": round(found.depth_scale, 5),
        "declared_depth_percent": round(100 * found.depth_scale_error, 3),
        "covered": bool(
            metres <= found.hand_eye and np.rad2deg(angle) <= found.hand_eye_deg
        ),
        "depth_covered": bool(found.depth_scale_error >= DEPTH_SCALE - 1),
        "seconds": round(seconds, 2),
    }  # fmt: skip


def summary(rows: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """What the draws come to."""
    told: dict[str, Any] = {"draws": len(rows)}
    for name in ("error_mm", "declared_mm", "error_deg", "declared_deg", "declared_depth_percent"):
        values = [row[name] for row in rows]
        told[name] = {
            "median": round(float(np.median(values)), 3),
            "largest": round(max(values), 3),
        }
    for name in ("covered", "depth_covered"):
        told[name] = sum(row[name] for row in rows)
    return told


def main(arguments: Sequence[str] | None = None) -> int:
    """The exit code: 0 if what was declared covers the truth in 95 % of draws at least."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--draws", type=int, default=50, help="half of them by each")
    parser.add_argument("--views", type=int, default=16)
    parser.add_argument("--by", nargs="*", default=["raycast", "sapien"])
    parser.add_argument("--joint-noise-deg", type=float, default=0.01)
    options = parser.parse_args(arguments)
    rows = []
    for number, name in enumerate(options.by):
        with drawing(name, Board()) as draw:
            for seed in range(number, options.draws, len(options.by)):
                given = seed // len(options.by) % 2 == 0
                row = measure(draw, name, seed, options.views, options.joint_noise_deg, given)
                rows.append(row)
                print(json.dumps(row), file=sys.stderr, flush=True)
    told = summary(rows)
    report = {
        "command": f"python tools/calibration.py {' '.join(arguments or sys.argv[1:])}".strip(),
        "image": f"{_SIZE[0]}x{_SIZE[1]}, {_FOV_DEG:g} deg",
        "depth_scale": DEPTH_SCALE,
        "summary": told,
        "rows": rows,
        "machine": doctor.machine(),
        "versions": library_versions(),
    }
    options.out.write_text(json.dumps(report, indent=1) + "\n")
    print(json.dumps(told))
    return 0 if min(told["covered"], told["depth_covered"]) >= 0.95 * len(rows) else 1


if __name__ == "__main__":
    sys.exit(main())
