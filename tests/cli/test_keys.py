"""Single keys at a real terminal."""

import os
import pty
import select
import subprocess
import sys
import termios

import pytest

SCRIPT = """
import sys
from sart_toolkit.cli.keys import single_keys
with single_keys() as key:
    print("ready", flush=True)
    print(repr(key(None)), flush=True)
    print(repr(key(0.0)), flush=True)
    print(repr(key(None)), flush=True)
    if sys.argv[1] == "raise":
        raise RuntimeError("over")
    key(None)
"""


@pytest.fixture
def terminal():
    here, there = pty.openpty()
    yield here, there
    os.close(here)
    os.close(there)


class _Reader:
    """What a program says, in order: several of its lines may come at once."""

    def __init__(self, here):
        self._here, self._left = here, b""

    def until(self, text):
        while text.encode() not in self._left:
            assert select.select([self._here], [], [], 30)[0], f"not within 30 s: {text}"
            self._left += os.read(self._here, 4096)
        self._left = self._left.partition(text.encode())[2]


@pytest.mark.parametrize("end", ["raise", "ctrl-c"])
def test_keys_come_one_by_one_without_enter_and_the_terminal_is_as_it_was(terminal, end):
    here, there = terminal
    before = termios.tcgetattr(there)
    os.write(here, b"typed before")
    process = subprocess.Popen(
        [sys.executable, "-c", SCRIPT, end],
        stdin=there, stdout=there, stderr=there, start_new_session=True,
        preexec_fn=lambda: __import__("fcntl").ioctl(0, termios.TIOCSCTTY, 0),
    )  # fmt: skip
    reader = _Reader(here)
    reader.until("ready")
    os.write(here, b" ")
    reader.until("' '")
    reader.until("''")
    os.write(here, b"\x7f")
    reader.until(r"'\x7f'")
    if end == "ctrl-c":
        os.write(here, b"\x03")
        reader.until("KeyboardInterrupt")
    assert process.wait(20) != 0
    assert termios.tcgetattr(there) == before
