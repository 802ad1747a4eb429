"""Whether the parts of a real cell answer, before anything moves."""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import suppress
from typing import Any, Protocol

import numpy as np

from sart_toolkit.doctor import Finding
from sart_toolkit.errors import InvalidInput, SartError
from sart_toolkit.hardware.cell import Cell
from sart_toolkit.hardware.drivers import Arm, Camera, Clock, Gripper
from sart_toolkit.hardware.images import as_described
from sart_toolkit.robots import get_robot
from sart_toolkit.robots.model import RobotModel
from sart_toolkit.robots.spec import RobotSpec

_SIZE = (128, 128)
_CHECK = "check its address, its cable, and that it is switched on"


class _Connected(Protocol):
    def connect(self) -> None: ...

    def disconnect(self) -> None: ...


def examine_cell(cell: Cell, clock: Clock = time.monotonic) -> list[Finding]:
    """What each part of a cell answers; they are connected and read, and nothing moves.

    Args:
        cell: the cell.
        clock: the time [s] that its drivers tell.

    A cell whose parts are in a world of their own is examined there, by that world's time.

    Raises:
        UnknownName: its robot or a driver can't be found.
        InvalidInput, Mismatch: its file has something that its drivers or its robot don't take.
    """
    spec = cell.mounted(get_robot(cell.robot))
    world = cell.make_world()
    try:
        return _examined(cell, spec, clock if world is None else world.now)
    finally:
        if world is not None:
            world.close()


def _examined(cell: Cell, spec: RobotSpec, clock: Clock) -> list[Finding]:
    model = RobotModel(spec)
    gripper, cameras = cell.make_gripper(clock), cell.make_cameras(clock)
    findings = [_answer("arm", cell.make_arm(clock), lambda arm: _arm(arm, cell, model))]
    if gripper is not None:
        findings.append(_answer("gripper", gripper, _gripper))
    mounts = {camera.name: camera for camera in spec.cameras}

    def seen(name: str) -> Callable[[Camera], str]:
        return lambda camera: _camera(camera, mounts[name], clock)

    for name, camera in cameras.items():
        findings.append(_answer(f"camera {name}", camera, seen(name)))
    return findings


def _answer(name: str, part: _Connected, ask: Callable[[Any], str]) -> Finding:
    try:
        part.connect()
        return Finding(name, True, ask(part), required=True)
    except Exception as error:
        remedy = "as it says" if isinstance(error, SartError) else _CHECK
        return Finding(name, False, str(error) or type(error).__name__, remedy, required=True)
    finally:
        with suppress(Exception):
            part.disconnect()


def _arm(arm: Arm, cell: Cell, model: RobotModel) -> str:
    state = arm.read()
    if state.trouble:
        raise InvalidInput(state.trouble)
    q = model.check_limits(state.q)
    p = model.fk(q)[:3, 3]
    off = cell.limits.workspace.outside(p)
    at = ", ".join(f"{x:.3f}" for x in p)
    if off > 0:
        raise InvalidInput(
            f"the tool is at {at} m, {off * 1e3:.0f} mm outside the workspace; move the arm into "
            "it by hand, or correct the workspace"
        )
    force = "no force sensed" if state.force is None else f"{state.force:.1f} N at it"
    joints = ", ".join(f"{x:.1f}" for x in np.rad2deg(q).round(1) + 0.0)
    return f"joints at {joints} deg, tool at {at} m, {force}"


def _gripper(gripper: Gripper) -> str:
    return f"{gripper.position():.0%} closed"


def _camera(camera: Camera, spec: Any, clock: Clock) -> str:
    image = camera.read()
    age = clock() - image.time
    height, width = image.depth.shape
    as_described(image, spec, _SIZE)
    known = image.depth[image.depth > 0]
    if not len(known):
        raise InvalidInput("its image holds no depth; see what covers it")
    return (
        f"{width}x{height}, {age * 1e3:.0f} ms old, depth at {len(known) / image.depth.size:.0%} "
        f"of its pixels, {np.median(known):.2f} m in the middle of them"
    )
