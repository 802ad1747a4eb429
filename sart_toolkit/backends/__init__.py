"""Simulators and robots behind one interface (`Backend`).

A new backend is one file and one line in `BACKENDS`.
"""

from __future__ import annotations

import importlib

from sart_toolkit.backends.interface import Backend
from sart_toolkit.errors import unknown_name
from sart_toolkit.robots.spec import RobotSpec
from sart_toolkit.scene.spec import SceneSpec

BACKENDS = {
    "pybullet": "sart_toolkit.backends.pybullet:PyBulletBackend",
}


def make_backend(name: str, robot: RobotSpec, scene: SceneSpec, image_size: int = 128) -> Backend:
    """The backend called `name`, with the robot and scene loaded.

    Args:
        name: one of `BACKENDS`.
        robot: the robot.
        scene: what surrounds it.
        image_size: width and height of pictures [pixels].

    Raises:
        UnknownName: no such backend; the message offers the nearest.
    """
    if name not in BACKENDS:
        raise unknown_name("backend", name, BACKENDS)
    module, attribute = BACKENDS[name].split(":")
    made = getattr(importlib.import_module(module), attribute)(robot, scene, image_size)
    assert isinstance(made, Backend)
    return made
