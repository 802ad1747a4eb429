"""Simulators and robots behind one interface (`Backend`).

A new backend is one file and one line in `BACKENDS`; one outside the repository needs no line,
`package.module:NAME` or `path/to/file.py:NAME` names it. A real robot is named by the file of its
cell, `path/to/cell.toml`.
"""

from __future__ import annotations

from importlib.util import find_spec
from typing import TYPE_CHECKING, TypeGuard

from sart_toolkit.registry import expect_class, resolve

if TYPE_CHECKING:
    from sart_toolkit.backends.interface import Backend
    from sart_toolkit.data.records import Rates
    from sart_toolkit.robots.spec import ImageSize, RobotSpec
    from sart_toolkit.scenes.spec import SceneSpec

BACKENDS = {
    "pybullet": "sart_toolkit.backends.pybullet:PyBulletBackend",
    "sapien": "sart_toolkit.backends.sapien:SapienBackend",
}
# PyBullet has no wheel for Python 3.12 and later.
DEFAULT_BACKEND = "pybullet" if find_spec("pybullet") is not None else "sapien"


def is_cell(backend: object) -> TypeGuard[str]:
    """Whether a reference names the file of a cell."""
    return isinstance(backend, str) and backend.endswith(".toml")


def get_backend(backend: str | type[Backend]) -> type[Backend]:
    """The class that a name, a reference or a cell's file names; a class itself is returned.

    Raises:
        UnknownName: there is none; the message says which part is wrong.
        MissingFile, BrokenFile, InvalidInput: the cell's file can't be read.
    """
    from sart_toolkit.backends.interface import Backend

    if is_cell(backend):
        from sart_toolkit.backends.hardware import cell_backend

        return cell_backend(backend)
    return expect_class("backend", backend, resolve("backend", backend, BACKENDS), Backend)


def make_backend(
    backend: str | type[Backend],
    robot: RobotSpec,
    scene: SceneSpec,
    image_size: ImageSize = 128,
    rates: Rates | None = None,
) -> Backend:
    """A backend with the robot and scene loaded.

    Args:
        backend: its class, or a name or reference that names it.
        robot: the robot.
        scene: what surrounds it.
        image_size: width and height of images [pixels]; one number for a square.
        rates: how often it is commanded, measured and recorded; by default if left out.

    Raises:
        UnknownName: no such backend; the message says which part is wrong.
    """
    # Not above: this is imported for names alone, too.
    from sart_toolkit.data.records import DEFAULT_RATES

    return get_backend(backend)(robot, scene, image_size, rates or DEFAULT_RATES)
