"""Simulators and robots behind one interface (`Backend`).

A new backend is one file and one line in `BACKENDS`.
"""

from __future__ import annotations

from sart_toolkit.backends.interface import Backend
from sart_toolkit.registry import lookup
from sart_toolkit.robots.spec import RobotSpec
from sart_toolkit.scenes.spec import SceneSpec

BACKENDS = {
    "pybullet": "sart_toolkit.backends.pybullet:PyBulletBackend",
    "sapien": "sart_toolkit.backends.sapien:SapienBackend",
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
    made = lookup("backend", name, BACKENDS)(robot, scene, image_size)
    assert isinstance(made, Backend)
    return made
