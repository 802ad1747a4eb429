"""Exception classes of the toolkit: every error it raises on purpose is a `SartError`."""

from __future__ import annotations

import difflib
from collections.abc import Iterable


class SartError(Exception):
    """Base of all errors raised on purpose; the command line prints it as one line."""


class InvalidInput(SartError, ValueError):
    """A value, shape, name or option is not acceptable."""


class UnknownName(SartError, LookupError):
    """A name or reference leads to nothing, or to something of another kind."""


class MissingFile(SartError, FileNotFoundError):
    """A file or directory that should be read does not exist."""


class BrokenFile(SartError, OSError):
    """A file exists but can't be read as what it should be."""


class OutputExists(SartError, FileExistsError):
    """Writing would replace something; nothing was written."""


class CannotWrite(SartError, OSError):
    """The disk refuses a write: permission, space or a missing parent."""


class Unreachable(SartError, ValueError):
    """No joint configuration within limits reaches the pose."""


class MotionRejected(SartError, RuntimeError):
    """A motion can't be executed as asked; the message's words before the colon say which way."""


class MissingCapability(SartError, NotImplementedError):
    """A backend was asked for something that it declares it can't do."""


class MissingExtra(SartError, ImportError):
    """An optional dependency is not installed; the message says how to install it."""


class NoDisplay(SartError, RuntimeError):
    """No window can be opened here; the message says what works without one."""


class DeviceLost(SartError, ConnectionError):
    """What a person steers with isn't there, or no longer answers."""


class RobotStopped(SartError, RuntimeError):
    """A real robot stands still, by itself or because something was wrong; the message says why."""


class Discarded(SartError, RuntimeError):
    """A person threw away what they had made; nothing was written."""


class Mismatch(SartError, ValueError):
    """Two things that belong together don't: an annotation and another demonstration, say."""


def unknown_name(kind: str, name: str, choices: Iterable[str]) -> UnknownName:
    """An `UnknownName` that lists the choices and offers the nearest one.

    Args:
        kind: what was looked up, such as "task".
        name: the name that is not there.
        choices: the names that are.
    """
    choices = sorted(choices)
    near = nearest_name(name, choices)
    hint = f"did you mean {near!r}? " if near else ""
    return UnknownName(f"unknown {kind} {name!r}: {hint}choose from {', '.join(choices)}")


def nearest_name(name: str, choices: Iterable[str]) -> str | None:
    """The choice that a person who typed `name` may have meant; None if none is like it."""
    near = difflib.get_close_matches(name, list(choices), n=1, cutoff=0.5)
    return near[0] if near else None
