"""Images of a board with the robot's poses: from a folder, or from a demonstration."""

from __future__ import annotations

import csv
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image as PillowImage
from scipy.spatial.transform import Rotation

from sart_toolkit.calibrate.hand_eye import BoardView
from sart_toolkit.data.records import Demonstration, DepthImage, Image
from sart_toolkit.errors import BrokenFile, InvalidInput, MissingFile, unknown_name
from sart_toolkit.poses import Array, distance, pose
from sart_toolkit.robots.model import RobotModel

POSES = "poses.csv"
_POSITION = ("x", "y", "z")
_ROTATIONS = {("rx", "ry", "rz"): "rotation vector", ("qx", "qy", "qz", "qw"): "quaternion"}
# A demonstration's views this near to each other tell hardly more than one of them.
_NEAR, _NEAR_DEG = 0.01, 3.0
_MOST_VIEWS = 40


def views_in_folder(path: Path, robot: RobotModel | None = None) -> list[BoardView]:
    """The views that `poses.csv` in a folder, or a CSV file itself, lists.

    A line for each, under a header. `image`: a file beside it; `depth`: a PNG of 16 bits in
    millimetres, aligned to the image, or nothing. The tool's pose in the world as `x`, `y`, `z` [m]
    and either `rx`, `ry`, `rz` (rotation vector [rad]) or `qx`, `qy`, `qz`, `qw`; or the joints
    [rad] by their names in the robot's URDF.

    Args:
        path: the folder or the file.
        robot: whose joints are listed.

    Raises:
        MissingFile, BrokenFile: a file isn't there, or can't be read.
        InvalidInput: a column is missing, or a number isn't one.
    """
    table = path / POSES if path.is_dir() else path
    if not table.is_file():
        raise MissingFile(f"{table}: no such file; it lists images with poses, a line each")
    try:
        with open(table, encoding="utf-8-sig", newline="") as file:
            reader = csv.DictReader(file, skipinitialspace=True)
            columns = [name.strip() for name in reader.fieldnames or ()]
            rows = [dict(zip(columns, row.values(), strict=False)) for row in reader]
    except (UnicodeDecodeError, csv.Error) as error:
        raise BrokenFile(f"{table}: can't be read as CSV ({error})") from error
    if "image" not in columns:
        raise InvalidInput(f"{table}: column image is missing; the first line names the columns")
    views = []
    for number, row in enumerate(rows, start=2):
        name = row["image"] or ""
        try:
            T = _pose_of(row, columns, robot)
        except (TypeError, ValueError) as error:
            raise InvalidInput(f"{table}: line {number}: {error}") from error
        depth = row.get("depth")
        views.append(
            BoardView(
                name, T, _rgb(table.parent / name), _depth(table.parent / depth) if depth else None
            )
        )
    return views


def _pose_of(row: Mapping[str, str], columns: Sequence[str], robot: RobotModel | None) -> Array:
    if all(name in columns for name in _POSITION):
        for names in _ROTATIONS:
            if all(name in columns for name in names):
                p, r = ([float(row[name]) for name in group] for group in (_POSITION, names))
                if len(r) == 3:
                    return pose(p, r)
                if abs(np.linalg.norm(r) - 1) > 1e-2:
                    raise InvalidInput(f"quaternion: expected length 1, got {r}")
                T = pose(p)
                T[:3, :3] = Rotation.from_quat(r).as_matrix()
                return T
    if robot is None:
        raise InvalidInput(
            "expected columns x, y, z and rx, ry, rz or qx, qy, qz, qw, got "
            f"{', '.join(columns)}; for joints, say whose they are: --robot REF"
        )
    for joint in robot.spec.arm_joints:
        if joint not in columns:
            raise unknown_name("column", joint, columns)
    return robot.fk(np.array([float(row[joint]) for joint in robot.spec.arm_joints]))


def _opened(path: Path) -> PillowImage.Image:
    try:
        image = PillowImage.open(path)
        image.load()
    except FileNotFoundError as error:
        raise MissingFile(f"{path}: no such file; check its name in {POSES}") from error
    except OSError as error:
        raise BrokenFile(f"{path}: can't be read as an image ({error})") from error
    return image


def _rgb(path: Path) -> Image:
    return np.array(_opened(path).convert("RGB"), dtype=np.uint8)


def _depth(path: Path) -> DepthImage:
    image = _opened(path)
    if image.mode not in ("I;16", "I;16B", "I"):
        raise InvalidInput(f"{path}: expected a PNG of 16 bits in millimetres, got {image.mode!r}")
    values: NDArray[np.float32] = np.asarray(image).astype(np.float32) / 1e3
    return values


def views_of_demonstration(demonstration: Demonstration, camera: str) -> list[BoardView]:
    """Up to forty of a demonstration's images by one camera, from places that differ.

    Raises:
        UnknownName: it has no such camera.
    """
    steps = demonstration.steps
    if camera not in steps.cameras:
        raise unknown_name("camera", camera, steps.cameras)
    record = steps.cameras[camera]
    chosen: list[int] = []
    for t, T in enumerate(steps.measured_Ts_world_tool):
        if all(_apart(T, steps.measured_Ts_world_tool[other]) for other in chosen):
            chosen.append(t)
    if len(chosen) > _MOST_VIEWS:
        chosen = [chosen[i] for i in np.linspace(0, len(chosen) - 1, _MOST_VIEWS).astype(int)]
    return [
        BoardView(
            f"step {t}",
            steps.measured_Ts_world_tool[t],
            record.rgb[t],
            record.depth[t] if record.depth[t].any() else None,
        )
        for t in chosen
    ]


def _apart(T_a: Array, T_b: Array) -> bool:
    metres, angle = distance(T_a, T_b)
    return metres > _NEAR or np.rad2deg(angle) > _NEAR_DEG
