"""The file of an emulated cell, for the commands that a real one is used by."""

from __future__ import annotations

import json
import re
import string
from collections.abc import Sequence
from pathlib import Path

from sart_toolkit.collision.sensor import sensor_errors
from sart_toolkit.errors import InvalidInput, MissingFile
from sart_toolkit.poses import check_array, check_positive
from sart_toolkit.robots import ROBOTS, get_robot
from sart_toolkit.tasks import get_task

_TEMPLATE = Path(__file__).with_name("templates") / "emulated_cell.toml.txt"
_GRIPPER = """
[gripper]
driver = "sart_toolkit.testing.emulated:EmulatedGripper"
world = "emulated"
"""
_CAMERA = """
[camera.{name}]
driver = "sart_toolkit.testing.emulated:EmulatedCamera"
world = "emulated"
name = "{name}"
hand_eye_mm = {hand_eye_mm}  # as declared: how far it is from there, at most
hand_eye_deg = {hand_eye_deg}
"""


def emulated_cell(
    task: str,
    robot: str | None = None,
    *,
    simulator: str,
    placement: Sequence[float] = (0.0, 0.0, 0.0),
    hand: Path | None = None,
    image_height: int = 240,
    sensor: str = "d405",
    hand_eye: tuple[float, float] = (2.0, 0.3),
    latency: float = 0.03,
    lag: float = 0.03,
    joint_noise: float = 1e-5,
    speed_scale: float = 1.0,
    seed: int = 0,
) -> str:
    """The text of a cell's file whose parts are in a world that is simulated.

    Args:
        task: the task that the world is of.
        robot: the robot, by the name that it has; the task's own if left out.
        simulator: what simulates it.
        placement: where the object stands, x, y [m] and yaw [deg] from its middle.
        hand: a demonstration's file, whose joints a hand leads the arm along while it is free.
        image_height: of the cameras' images [pixels].
        sensor: whose errors their depth has.
        hand_eye: how far cameras are from where they should be, [mm] and [deg]; declared, too.
        latency: how old an image is when it arrives [s].
        lag: time constant with which the arm follows targets [s].
        joint_noise: standard deviation of measured joints [rad].
        speed_scale: how fast the arm goes of what is commanded.
        seed: of all that is random.

    Raises:
        UnknownName: task, robot or sensor can't be found.
        InvalidInput: a value is not acceptable, or the robot is one's own: a cell's file names it
            by its name alone.
        MissingFile: there is no such demonstration.
    """
    found = get_task(task)
    spec = get_robot(robot or found.robot)
    if spec.name not in ROBOTS:
        raise InvalidInput(f"robot: expected one of {', '.join(ROBOTS)}, got {spec.name!r}")
    check_array("placement", placement, (3,))
    for name, value in (
        ("latency", latency), ("lag", lag), ("image_height", image_height),
        ("speed_scale", speed_scale),
    ):  # fmt: skip
        check_positive(name, value)
    sensor_errors(sensor, (hand_eye[0] / 1e3, hand_eye[1]))
    if hand is not None and not hand.is_file():
        raise MissingFile(f"{hand}: no such file; record one, or leave the hand out")
    parts = _GRIPPER if spec.gripper.driver is not None else ""
    for camera in spec.cameras:
        parts += _CAMERA.format(name=camera.name, hand_eye_mm=hand_eye[0], hand_eye_deg=hand_eye[1])
    led = '# hand = "demo.h5"' if hand is None else f"hand = {_quoted(str(hand))}"
    text = string.Template(_TEMPLATE.read_text(encoding="utf-8")).substitute(
        robot=spec.name,
        task=_quoted(task),
        simulator=_quoted(simulator),
        placement=[float(value) for value in placement],
        hand=f"{led}  # joints that a hand leads it along while it is free",
        image_height=image_height,
        sensor=sensor,
        hand_eye_mm=hand_eye[0],
        hand_eye_deg=hand_eye[1],
        latency=latency,
        lag=lag,
        joint_noise=joint_noise,
        speed_scale=speed_scale,
        seed=seed,
        parts=parts,
    )
    # A setting and its comment; all comments in one column.
    return re.sub(
        r"(?m)^(# )?(\w.* = .*\S|\[\w+\])  # ",
        lambda m: f"{m[1] or ''}{m[2]}".ljust(32) + "# ",
        text,
    )


def _quoted(text: str) -> str:
    """A string as TOML has it."""
    return json.dumps(text, ensure_ascii=False)
