"""What a calibration found of a camera, as a file, and what later stages take from it."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from sart_toolkit.calibrate.board import Board
from sart_toolkit.data.records import CameraFrame, CameraRecord, Demonstration, library_versions
from sart_toolkit.data.schemas import CalibrationFile
from sart_toolkit.data.storage import check_writable, read_json, write_json
from sart_toolkit.errors import BrokenFile, InvalidInput, Mismatch, SartError
from sart_toolkit.poses import Array, check_array, check_pose, distance, frozen

# Focal lengths and centres that differ by less are the same, as a fraction of the width.
_SAME_INTRINSICS = 0.005


@dataclass(frozen=True)
class Calibration:
    """Where a camera is mounted, what its image is, and how far each may be off.

    `camera`: its name; `frame`: what it is mounted on; `T_frame_camera (4, 4)`; `intrinsics (3, 3)`
    in pixels of images of `image_size` (width, height). `hand_eye` [m], `hand_eye_deg` [deg]: how
    far the camera is from there at most, with a probability of 99 % each, as far as the views
    tell; `axis_errors` [m] and `axis_errors_deg`, three each, the same along and about the
    camera's axes. `depth_scale`: by what its depth is to be divided, `depth_scale_error` how far
    from 1 that is at most; None where no depth was given. `square_scale`: how much larger the
    squares are than said, as the robot's motion has it. `views` were used; `left_out` names those
    in which the board was not seen or that contradict the others. `rms_pixels`: how far corners are
    from where the calibration has them.
    """

    camera: str
    frame: CameraFrame
    T_frame_camera: Array
    intrinsics: Array
    image_size: tuple[int, int]
    hand_eye: float
    hand_eye_deg: float
    axis_errors: tuple[float, float, float]
    axis_errors_deg: tuple[float, float, float]
    square_scale: float
    rms_pixels: float
    views: int
    board: Board
    left_out: tuple[str, ...] = ()
    depth_scale: float | None = None
    depth_scale_error: float | None = None
    versions: Mapping[str, str] = field(default_factory=library_versions)

    def __post_init__(self) -> None:
        if self.frame not in ("tool", "world"):
            raise InvalidInput(f"frame: expected 'tool' or 'world', got {self.frame!r}")
        T = check_pose("T_frame_camera", self.T_frame_camera)
        object.__setattr__(self, "T_frame_camera", frozen(T))
        K = check_array("intrinsics", self.intrinsics, (3, 3))
        object.__setattr__(self, "intrinsics", frozen(K))
        for name in ("hand_eye", "hand_eye_deg", "rms_pixels"):
            if not getattr(self, name) >= 0:
                raise InvalidInput(f"{name}: expected a number >= 0, got {getattr(self, name)}")

    def intrinsics_of(self, width: int, height: int) -> Array:
        """The intrinsics `(3, 3)` of images of a size, which may be scaled ones.

        Raises:
            Mismatch: they are of another shape, cropped.
        """
        own = self.image_size
        if width * own[1] != height * own[0]:
            raise Mismatch(
                f"camera {self.camera!r}: was calibrated with images of {own[0]}x{own[1]}, these "
                f"are of {width}x{height}, another shape; calibrate it with images as these"
            )
        s = width / own[0]
        K = self.intrinsics.copy()
        K[0, 0], K[1, 1] = s * K[0, 0], s * K[1, 1]
        # (0, 0) is the centre of a pixel.
        K[:2, 2] = s * (K[:2, 2] + 0.5) - 0.5
        return K


class DeclaredErrors(NamedTuple):
    """What calibrated cameras may be off by: [m], [deg], and depth as a fraction of it.

    `depth_scale` is None where it wasn't calibrated.
    """

    hand_eye: float
    hand_eye_deg: float
    depth_scale: float | None


def declared_errors(
    demonstration: Demonstration, calibrations: Sequence[Calibration]
) -> DeclaredErrors:
    """How far a demonstration's cameras are at most from where it has them, by their calibrations.

    That is the calibrations' own error, and how far the recorded poses are from the calibrated
    ones; the largest of all cameras with depth counts.

    Raises:
        Mismatch: a camera has no calibration or two, or is recorded farther from where it is
            calibrated to be than that is off at most, or with other intrinsics.
    """
    names = [calibration.camera for calibration in calibrations]
    found = []
    for name, camera in demonstration.steps.cameras.items():
        if not camera.depth.any():
            continue
        if names.count(name) != 1:
            raise Mismatch(
                f"camera {name!r}: {names.count(name)} calibrations of it, its depth needs one; "
                "pass one file for each camera"
            )
        found.append(_declared_error(name, camera, calibrations[names.index(name)]))
    if not found:
        raise Mismatch("the demonstration holds no depth that a calibration could be about")
    scales = [errors.depth_scale for errors in found]
    known = [scale for scale in scales if scale is not None]
    return DeclaredErrors(
        max(errors.hand_eye for errors in found),
        max(errors.hand_eye_deg for errors in found),
        max(known) if len(known) == len(scales) else None,
    )


def _declared_error(name: str, camera: CameraRecord, own: Calibration) -> DeclaredErrors:
    if camera.frame != own.frame:
        raise Mismatch(
            f"camera {name!r}: is recorded to be mounted on the {camera.frame}, calibrated on the "
            f"{own.frame}; pass the calibration of this camera"
        )
    metres, angle = distance(own.T_frame_camera, camera.T_frame_camera)
    degrees = float(np.rad2deg(angle))
    # Rounding aside: who records with a calibration records its very pose.
    if metres > own.hand_eye + 1e-6 or degrees > own.hand_eye_deg + 1e-3:
        raise Mismatch(
            f"camera {name!r}: is recorded {metres * 1e3:.1f} mm and {degrees:.2f} deg from where "
            f"it is calibrated to be, which is off by {own.hand_eye * 1e3:.1f} mm and "
            f"{own.hand_eye_deg:.2f} deg at most; record with the calibrated pose as the robot's "
            "camera, or pass the calibration that it was recorded with"
        )
    height, width = camera.rgb.shape[1:3]
    off = float(np.abs(camera.intrinsics - own.intrinsics_of(width, height)).max())
    if off > _SAME_INTRINSICS * width:
        raise Mismatch(
            f"camera {name!r}: its recorded intrinsics are {off:.1f} pixels from the calibrated "
            "ones; record with these"
        )
    return DeclaredErrors(own.hand_eye + metres, own.hand_eye_deg + degrees, own.depth_scale_error)


def save_calibration(path: Path, calibration: Calibration, overwrite: bool = False) -> None:
    """Write a calibration's JSON file.

    Raises:
        OutputExists, CannotWrite: it can't be written.
    """
    check_writable(path, overwrite)
    values = dataclasses.asdict(calibration)
    for name in ("T_frame_camera", "intrinsics"):
        values[name] = values[name].tolist()
    write_json(path, {"kind": "calibration", **values})


def load_calibration(path: Path) -> Calibration:
    """The calibration in a JSON file.

    Raises:
        MissingFile, BrokenFile: it can't be read as one.
    """
    values = read_json(path, CalibrationFile)
    del values["kind"]
    try:
        board = Board(**values.pop("board"))
        lists = {k: tuple(v) for k, v in values.items() if k in _TUPLES}
        arrays: dict[str, Any] = {k: np.array(values[k]) for k in ("T_frame_camera", "intrinsics")}
        return Calibration(**{**values, **lists, **arrays, "board": board})
    except (TypeError, ValueError, SartError) as error:
        raise BrokenFile(f"{path}: is no calibration ({error}); calibrate again") from error


_TUPLES = ("image_size", "axis_errors", "axis_errors_deg", "left_out")
