"""What the flags about the depth camera say."""

from __future__ import annotations

from typing import Protocol

from sart_toolkit.collision.sensor import SensorErrors, sensor_errors
from sart_toolkit.errors import InvalidInput


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


def declared_sensor(flags: SensorFlags) -> SensorErrors | None:
    """The errors that the flags declare; None if none of them was given.

    Raises:
        InvalidInput: they are given for obstacles from the scene, or can't be read.
    """
    given = {
        "--sensor": flags.sensor,
        "--hand-eye-error": flags.hand_eye_error,
        "--depth-scale-error": flags.depth_scale_error,
    }
    names = [name for name, value in given.items() if value is not None]
    if not names:
        return None
    if flags.source != "cloud":
        raise InvalidInput(
            f"{names[0]}: is about the recorded RGB-D; add --source cloud, or leave it out"
        )
    scale = flags.depth_scale_error or 0.0
    return sensor_errors(
        flags.sensor or "exact", _hand_eye(flags.hand_eye_error or "0,0"), scale / 100
    )


def _hand_eye(text: str) -> tuple[float, float]:
    """Metres and degrees from "MM,DEG"."""
    try:
        length, angle = (float(word) for word in text.split(","))
    except ValueError as error:
        raise InvalidInput(
            f"--hand-eye-error: expected millimetres and degrees as in 2,0.3, got {text!r}"
        ) from error
    return length / 1e3, angle
