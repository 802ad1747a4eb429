"""Single keys at a real terminal."""

import os
import pty
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


def _says(here, text):
    said = b""
    while text.encode() not in said:
        said += os.read(here, 4096)
    return said.decode()


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
    _says(here, "ready")
    os.write(here, b" ")
    _says(here, "' '")
    _says(here, "''")
    os.write(here, b"\x7f")
    _says(here, r"'\x7f'")
    if end == "ctrl-c":
        os.write(here, b"\x03")
        _says(here, "KeyboardInterrupt")
    assert process.wait(20) != 0
    assert termios.tcgetattr(there) == before
