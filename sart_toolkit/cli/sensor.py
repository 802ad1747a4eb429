"""What the flags about cameras say."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Protocol

import numpy as np

from sart_toolkit.collision.sensor import SensorErrors, sensor_errors
from sart_toolkit.errors import InvalidInput
from sart_toolkit.poses import Array


class SensorFlags(Protocol):
    """The flags; each is None where it was left out."""

    @property
    def source(self) -> str:
        """What is known of obstacles."""

    @property
    def sensor(self) -> str | None:
        """A sensor's name."""

    @property
    def hand_eye_error(self) -> str | None:
        """Millimetres and degrees, as in "2,0.3"."""

    @property
    def depth_scale_error(self) -> float | None:
        """In percent."""

    @property
    def calibration(self) -> tuple[Path, ...]:
        """Files from `sart calibrate`."""


def declared_sensor(flags: SensorFlags, demos: Sequence[Path]) -> SensorErrors | None:
    """The errors that the flags declare of demonstrations' cameras; None if none was given.

    Where neither --hand-eye-error nor --calibration says how far cameras are from where they are
    said to be, the demonstrations' cells do.

    Raises:
        InvalidInput: they are given for obstacles from the scene, can't be read, or contradict
            each other.
        MissingFile, BrokenFile: a calibration or a demonstration can't be read.
        Mismatch: a calibration is not that of a demonstration's camera.
    """
    given = {
        "--sensor": flags.sensor,
        "--hand-eye-error": flags.hand_eye_error,
        "--depth-scale-error": flags.depth_scale_error,
        "--calibration": flags.calibration or None,
    }
    names = [name for name, value in given.items() if value is not None]
    if not names:
        return None
    if flags.source != "cloud":
        raise InvalidInput(
            f"{names[0]}: is about the recorded RGB-D; add --source cloud, or leave it out"
        )
    scale = flags.depth_scale_error
    depth_scale = None if scale is None else scale / 100
    if flags.calibration:
        if flags.hand_eye_error is not None:
            raise InvalidInput("--hand-eye-error: --calibration declares it; leave one out")
        hand_eye, calibrated = _calibrated(flags.calibration, demos)
        if calibrated is not None and depth_scale is not None:
            raise InvalidInput("--depth-scale-error: --calibration declares it; leave this out")
        depth_scale = depth_scale if calibrated is None else calibrated
    elif flags.hand_eye_error is not None:
        hand_eye = hand_eye_error(flags.hand_eye_error)
    else:
        hand_eye = _of_their_cells(demos)
    return sensor_errors(flags.sensor or "exact", hand_eye, depth_scale or 0.0)


def _calibrated(
    files: Sequence[Path], demos: Sequence[Path]
) -> tuple[tuple[float, float], float | None]:
    """What the cameras of demonstrations are off by, as their calibrations have it."""
    from sart_toolkit.calibrate.calibration import declared_errors, load_calibration
    from sart_toolkit.data.storage import load_demonstration

    calibrations = [load_calibration(path) for path in files]
    found = [declared_errors(load_demonstration(path), calibrations) for path in demos]
    scales = [errors.depth_scale for errors in found if errors.depth_scale is not None]
    hand_eye = max(e.hand_eye for e in found), max(e.hand_eye_deg for e in found)
    return hand_eye, max(scales) if len(scales) == len(found) else None


def _of_their_cells(demos: Sequence[Path]) -> tuple[float, float]:
    """What the cameras of demonstrations are off by, as their cells' files have it."""
    from sart_toolkit import pipeline
    from sart_toolkit.data.storage import load_demonstration

    found = [pipeline.mounting_error(load_demonstration(path)) for path in demos]
    return max(length for length, _ in found), max(angle for _, angle in found)


def hand_eye_error(text: str) -> tuple[float, float]:
    """Metres and degrees from "MM,DEG".

    Raises:
        InvalidInput: it is something else.
    """
    try:
        length, angle = (float(word) for word in text.split(","))
    except ValueError as error:
        raise InvalidInput(
            f"--hand-eye-error: expected millimetres and degrees as in 2,0.3, got {text!r}"
        ) from error
    return length / 1e3, angle


def intrinsics_of(flag: str, text: str) -> Array:
    """The matrix `(3, 3)` of "FX,FY,CX,CY".

    Raises:
        InvalidInput: it is something else.
    """
    try:
        fx, fy, cx, cy = map(float, text.split(","))
    except ValueError as error:
        raise InvalidInput(
            f"{flag}: expected FX,FY,CX,CY in pixels as in 606,606,319.5,239.5, got {text!r}"
        ) from error
    return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]])
