"""The suite's command line options; pytest reads them here, before it has found the tests."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import pytest


def pytest_addoption(parser: pytest.Parser) -> None:
    """Add `--sart-backend`, `--sart-robot` and `--sart-task`."""
    group = parser.getgroup("sart", "backends and tasks of sart_toolkit")
    group.addoption(
        "--sart-backend",
        action="append",
        metavar="NAME",
        help="backend to test with `--pyargs sart_toolkit.testing`: one of BACKENDS, "
        "module:Class or file.py:Class; may be repeated (default: all BACKENDS)",
    )
    group.addoption(
        "--sart-robot",
        action="append",
        metavar="NAME",
        help="robot to test it with: one of ROBOTS, module:SPEC or file.py:SPEC; may be "
        "repeated (default: one with a linkage, ur5e_2f85, and one with jaws, ur5e_hande)",
    )
    group.addoption(
        "--sart-task",
        action="append",
        metavar="NAME",
        help="task to test with `--pyargs sart_toolkit.testing`, in place of a backend: one of "
        "TASKS, module:Class or file.py:Class; may be repeated; on the backends named by "
        "--sart-backend (default: PyBullet, or SAPIEN without it), with the robots named by "
        "--sart-robot (default: its own)",
    )


def pytest_configure(config: pytest.Config) -> None:
    """Refuse names of backends, robots and tasks that name nothing.

    Raises:
        UsageError: one does.
    """
    backends = config.getoption("--sart-backend") or []
    robots = config.getoption("--sart-robot") or []
    tasks = config.getoption("--sart-task") or []
    if not backends and not robots and not tasks:
        return
    # Not imported by every run of pytest where the toolkit is installed.
    import pytest

    from sart_toolkit.backends import get_backend
    from sart_toolkit.errors import MissingExtra, UnknownName
    from sart_toolkit.robots import get_robot
    from sart_toolkit.tasks import get_task

    try:
        for name in tasks:
            get_task(name)
        for name in robots:
            get_robot(name)
        for name in backends:
            get_backend(name)
    except (MissingExtra, UnknownName) as error:
        raise pytest.UsageError(str(error)) from error
