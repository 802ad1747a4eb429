"""`sart calibrate`: a camera's mounting from images of a board, and the board to print."""

from __future__ import annotations

from typing import Any

from sart_toolkit.calibrate.board import Board, save_board
from sart_toolkit.calibrate.calibration import Calibration, save_calibration
from sart_toolkit.calibrate.hand_eye import BoardView, calibrate_camera
from sart_toolkit.calibrate.pictures import views_in_folder, views_of_demonstration
from sart_toolkit.cli.arguments import Calibrate, whole_numbers
from sart_toolkit.cli.console import say
from sart_toolkit.cli.sensor import intrinsics_of
from sart_toolkit.data.records import CameraFrame
from sart_toolkit.data.storage import check_writable, load_demonstration
from sart_toolkit.errors import InvalidInput
from sart_toolkit.poses import Array
from sart_toolkit.robots import get_robot
from sart_toolkit.robots.model import RobotModel


def calibrate_verb(args: Calibrate) -> dict[str, Any]:
    """`sart calibrate`."""
    board = _board(args)
    if args.board is not None:
        for flag in ("source", "out", "robot", "intrinsics", "mount"):
            if getattr(args, flag) is not None:
                raise InvalidInput(f"--board: only writes the board; leave {flag} out")
        save_board(args.board, board, args.overwrite)
        return {"board": str(args.board), **_described(board)}
    if args.source is None or args.out is None:
        raise InvalidInput("SOURCE, --out: both are needed; to print a board: --board board.pdf")
    check_writable(args.out, args.overwrite)
    views, frame, recorded = _views(args)
    calibration = calibrate_camera(
        views, board, args.camera, frame, _intrinsics(args.intrinsics, recorded)
    )
    save_calibration(args.out, calibration, args.overwrite)
    for name in calibration.left_out:
        say(f"{name}: left out, shows no board or contradicts the others")
    return {"calibration": str(args.out), **describe_calibration(calibration)}


def _board(args: Calibrate) -> Board:
    try:
        columns, rows = whole_numbers("squares", args.squares.replace("x", ","))
    except ValueError as error:
        raise InvalidInput(f"--squares: expected 9x7 for instance, got {args.squares!r}") from error
    return Board(columns, rows, args.square_mm / 1e3, args.marker_mm / 1e3, args.dictionary)


def _views(args: Calibrate) -> tuple[list[BoardView], CameraFrame, Array | None]:
    """The views, what the camera is mounted on, and its intrinsics where these are recorded."""
    assert args.source is not None
    if args.source.suffix == ".h5":
        if args.mount is not None or args.robot is not None:
            raise InvalidInput("--mount, --robot: a demonstration says these; leave them out")
        demonstration = load_demonstration(args.source)
        views = views_of_demonstration(demonstration, args.camera)
        record = demonstration.steps.cameras[args.camera]
        return views, record.frame, record.intrinsics
    robot = None if args.robot is None else RobotModel(get_robot(args.robot))
    return views_in_folder(args.source, robot), args.mount or "tool", None


def _intrinsics(text: str | None, recorded: Array | None) -> Array | None:
    if text is None:
        return recorded
    if text == "estimate":
        return None
    return intrinsics_of("--intrinsics", text)


def _described(board: Board) -> dict[str, Any]:
    return {
        "squares": f"{board.columns}x{board.rows}",
        "square_mm": board.square * 1e3,
        "marker_mm": board.marker * 1e3,
        "dictionary": board.dictionary,
    }


def describe_calibration(calibration: Calibration) -> dict[str, Any]:
    """What a calibration found, in figures of a few digits."""
    scale, off = calibration.depth_scale, calibration.depth_scale_error
    return {
        "camera": calibration.camera,
        "mounted_on": calibration.frame,
        "T_frame_camera": calibration.T_frame_camera.round(6).tolist(),
        "intrinsics": calibration.intrinsics.round(3).tolist(),
        "views": calibration.views,
        "rms_pixels": round(calibration.rms_pixels, 3),
        "error_mm": round(calibration.hand_eye * 1e3, 3),
        "error_deg": round(calibration.hand_eye_deg, 4),
        "error_xyz_mm": [round(x * 1e3, 3) for x in calibration.axis_errors],
        "error_xyz_deg": [round(x, 4) for x in calibration.axis_errors_deg],
        "square_mm_by_motion": round(calibration.board.square * calibration.square_scale * 1e3, 4),
        "depth_scale": "no depth was given" if scale is None else round(scale, 5),
        **({} if off is None else {"depth_scale_error_percent": round(off * 100, 3)}),
    }
