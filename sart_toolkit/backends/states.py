"""The envelope of a saved state: which backend and scene it is of, and whether it is whole."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from typing import Any

import numpy as np

from sart_toolkit.data.schemas import StateHead
from sart_toolkit.data.storage import check_values, parse_json
from sart_toolkit.errors import BrokenFile
from sart_toolkit.robots.model import RobotModel
from sart_toolkit.scenes.spec import SceneSpec

_VERSION = 6


def scene_digest(model: RobotModel, scene: SceneSpec) -> str:
    """A hash of robot, shapes, joints and gravity; not of appearance, nor of where bodies stand.

    Args:
        model: the robot with what it holds.
        scene: what surrounds it.
    """
    what = [
        (
            [(*s.identity, s.T_body_shape, s.collides) for s in body.shapes],
            (body.name, body.mass, body.friction, body.joint),
        )
        for body in scene.bodies
    ]
    with np.printoptions(precision=17, floatmode="unique", threshold=10**6):
        text = repr((what, scene.gravity))
    return hashlib.sha256(text.encode() + model.urdf.read_bytes()).hexdigest()


def pack_state(kind: str, head: Mapping[str, Any], payload: bytes) -> bytes:
    """A saved state as bytes: what made it, a checksum, then JSON values and the payload.

    Args:
        kind: the backend's name.
        head: JSON values; `robot`, `scene` (a `scene_digest`) and `bodies` among them.
        payload: the simulator's own bytes.
    """
    # Not compressed: a demonstration's states are nearly alike, so its file packs them together.
    body = json.dumps(head).encode() + b"\n" + payload
    return _magic(kind) + hashlib.sha256(body).digest() + body


def unpack_state(
    kind: str, state: bytes, robot: str, scene: str, bodies: list[str]
) -> tuple[dict[str, Any], bytes]:
    """The JSON values and the payload of a saved state.

    Args:
        kind: the backend's name.
        state: what `pack_state` made.
        robot: the backend's robot.
        scene: the backend's `scene_digest`.
        bodies: names of its bodies, for the message.

    Raises:
        BrokenFile: the bytes are damaged or of another backend, robot or scene.
    """
    magic = _magic(kind)
    try:
        if not state.startswith(magic):
            raise ValueError(f"not a state of backend {kind!r}")
        sha, body = state[len(magic) :][:32], state[len(magic) + 32 :]
        if hashlib.sha256(body).digest() != sha:
            raise ValueError("damaged")
        head_line, payload = body.split(b"\n", 1)
    except ValueError as error:
        raise BrokenFile(f"saved state: {error}; record the demonstration again") from error
    head: dict[str, Any] = parse_json(head_line, "saved state")
    check_values(head, StateHead, "saved state")
    if head["scene"] != scene:
        raise BrokenFile(
            f"saved state: of robot {head['robot']!r} with {head['bodies']}, this backend has "
            f"{robot!r} with {bodies} or other shapes; load the matching task"
        )
    return head, payload


def _magic(kind: str) -> bytes:
    return f"sart-{kind}-{_VERSION}\n".encode()
