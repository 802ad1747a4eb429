"""Exception classes of the toolkit: every error it raises on purpose is a `SartError`.

Each class says when it is raised, and what to do: the documentation's troubleshooting page.
"""

from __future__ import annotations

import difflib
from collections.abc import Iterable


class SartError(Exception):
    """Base of all errors raised on purpose; the command line prints it as one line.

    Raised by itself where none of the others fits: the message says what to do.
    """


class InvalidInput(SartError, ValueError):
    """A value, shape, name or option is not acceptable.

    The message names the value, what it is and what is expected instead: correct it where you give
    it. Where the value comes from a file of yours (a robot, a task, a plan), the message names file
    and field; `sart doctor --robot REF` checks a robot whole.
    """


class UnknownName(SartError, LookupError):
    """A name or reference leads to nothing, or to something of another kind.

    Look at the choices in the message, or at the part of `module:NAME` or `file.py:NAME` that it
    says is wrong. A reference that a recording notes is looked up from the current folder: go to
    the folder where it was recorded, or give `--task`, `--robot` or `--backend`.
    """


class MissingFile(SartError, FileNotFoundError):
    """A file or directory that should be read does not exist.

    Check the path for typing errors and the current folder; the message says which verb writes what
    is missing.
    """


class BrokenFile(SartError, OSError):
    """A file exists but can't be read as what it should be.

    It was damaged, cut short, changed by hand or written by another version: its hash or its
    contents don't fit. Copy it again from where it is whole, or make it again by the verb that
    wrote it. `sart info FILE` says what was checked.
    """


class OutputExists(SartError, FileExistsError):
    """Writing would replace something; nothing was written.

    Choose another `--out`, or add `--overwrite` if what is there may be lost. To resume what was
    interrupted, type the same command with the same settings.
    """


class CannotWrite(SartError, OSError):
    """The disk refuses a write: permission, space or a missing parent.

    Make room, create the parent folder, or choose a place that you may write to. If another process
    is at work on the output, wait for it. What was finished is kept.
    """


class Unreachable(SartError, ValueError):
    """No joint configuration within limits reaches the pose.

    Bring the pose nearer to the robot, turn it, or place the scene's object elsewhere; of your own
    robot, check the joints' limits, the home position and the tool frame.
    """


class MotionRejected(SartError, RuntimeError):
    """A motion can't be executed as asked; the message's words before the colon say which way.

    `augment` counts these by reason and tries again with other poses, so a few need nothing. If a
    sphere gives little or nothing, make it smaller (`sart annotate`) or have it suggested; a
    blocked straight line may be planned round (`--strategy sart_planned`).
    """


class MissingCapability(SartError, NotImplementedError):
    """A backend was asked for something that it declares it can't do.

    The message names the ability. Use a backend that has it, or a way that needs less of it, such
    as `--execution replay` where states can't be saved. In a backend of your own, inherit the
    ability's class and implement it.
    """


class MissingExtra(SartError, ImportError):
    """An optional dependency is not installed; the message says how to install it.

    Type the `pip install 'sart_toolkit[…]'` that the message ends with, in the environment in which
    `sart` runs. `sart doctor` lists what is installed.
    """


class NoDisplay(SartError, RuntimeError):
    """No window can be opened here; the message says what works without one.

    Over SSH, from a container or without a desktop: annotate in words (`--text`), record by a
    script, write a video (`sart play --out`). With a desktop, look at what `sart doctor` says of
    windows.
    """


class DeviceLost(SartError, ConnectionError):
    """What a person steers with isn't there, or no longer answers.

    Plug it in again and press → to resume; nothing was lost. If it isn't found at all, look at its
    permissions, and quit other programs that hold it; `sart doctor` says what it finds.
    """


class RobotStopped(SartError, RuntimeError):
    """A real robot stands still, by itself or because something was wrong; the message says why."""


class Discarded(SartError, RuntimeError):
    """A person threw away what they had made; nothing was written.

    Nothing to fix. Type the same command to begin again.
    """


class Mismatch(SartError, ValueError):
    """Two things that belong together don't: an annotation and another demonstration, say.

    The message names both. Use those that were made for each other (`sart info` says what a file
    belongs to), or make the second again from the first; resumed work needs the settings that it
    was begun with.
    """


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
