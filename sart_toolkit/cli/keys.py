"""Single keys typed at a terminal, without Enter."""

from __future__ import annotations

import os
import select
import sys
import termios
import tty
from collections.abc import Callable, Iterator
from contextlib import contextmanager

Keys = Callable[[float | None], str]


@contextmanager
def single_keys() -> Iterator[Keys]:
    """A function that gives the next key typed, or "" if there is none within some seconds.

    It waits for ever with `None`. What was typed before doesn't count, and Ctrl-C interrupts as
    ever. The terminal is as it was afterwards, however that comes.
    """
    terminal = sys.stdin.fileno()
    before = termios.tcgetattr(terminal)

    def key(seconds: float | None) -> str:
        if not select.select([terminal], [], [], seconds)[0]:
            return ""
        return os.read(terminal, 1).decode(errors="replace")

    try:
        tty.setcbreak(terminal, termios.TCSAFLUSH)
        yield key
    finally:
        termios.tcsetattr(terminal, termios.TCSADRAIN, before)
