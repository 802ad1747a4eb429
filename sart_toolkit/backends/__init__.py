"""Simulators and robots behind one interface (`Backend`).

A new backend is one file and one line in `BACKENDS`.
"""

from __future__ import annotations

from sart_toolkit.backends.interface import Backend
from sart_toolkit.data.records import DEFAULT_RATES, Rates
from sart_toolkit.registry import lookup
from sart_toolkit.robots.spec import ImageSize, RobotSpec
from sart_toolkit.scenes.spec import SceneSpec

BACKENDS = {
    "pybullet": "sart_toolkit.backends.pybullet:PyBulletBackend",
    "sapien": "sart_toolkit.backends.sapien:SapienBackend",
}


def make_backend(
    name: str,
    robot: RobotSpec,
    scene: SceneSpec,
    image_size: ImageSize = 128,
    rates: Rates = DEFAULT_RATES,
) -> Backend:
    """The backend called `name`, with the robot and scene loaded.

    Args:
        name: one of `BACKENDS`.
        robot: the robot.
        scene: what surrounds it.
        image_size: width and height of pictures [pixels]; one number for a square.
        rates: how often it is commanded, measured and recorded.

    Raises:
        UnknownName: no such backend; the message offers the nearest.
    """
    made = lookup("backend", name, BACKENDS)(robot, scene, image_size, rates)
    assert isinstance(made, Backend)
    return made
