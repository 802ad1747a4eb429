"""The suite's command line options; pytest reads them here, before it has found the tests."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import pytest


def pytest_addoption(parser: pytest.Parser) -> None:
    """Add `--sart-backend` and `--sart-robot`."""
    group = parser.getgroup("sart", "backends of sart_toolkit")
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


def pytest_configure(config: pytest.Config) -> None:
    """Refuse names of backends and robots that name nothing.

    Raises:
        UsageError: one does.
    """
    backends = config.getoption("--sart-backend") or []
    robots = config.getoption("--sart-robot") or []
    if not backends and not robots:
        return
    # Not imported by every run of pytest where the toolkit is installed.
    import pytest

    from sart_toolkit.backends import get_backend
    from sart_toolkit.errors import MissingExtra, UnknownName
    from sart_toolkit.robots import get_robot

    try:
        for name in robots:
            get_robot(name)
        for name in backends:
            get_backend(name)
    except (MissingExtra, UnknownName) as error:
        raise pytest.UsageError(str(error)) from error
