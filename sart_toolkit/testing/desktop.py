"""A virtual screen, with hands: windows under Xvfb, keys by xdotool, images of it.

For tests of windows and for the programs that make the documentation's images.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import time
from collections.abc import Mapping, Sequence
from pathlib import Path

from PIL import Image, ImageGrab

from sart_toolkit.errors import MissingExtra

_PROGRAMS = ("Xvfb", "xdotool")


def check_desktop() -> None:
    """Return if a screen can be had here.

    Raises:
        MissingExtra: Xvfb or xdotool isn't installed.
    """
    missing = [name for name in _PROGRAMS if shutil.which(name) is None]
    if missing:
        raise MissingExtra(
            f"{' and '.join(missing)} not found; type: bash tools/setup_debian.sh annotate"
        )


class Desktop:
    """A screen of its own, ended with all windows on it when the `with` block ends.

    Attributes:
        display: its X display, such as ":99".
    """

    def __init__(self, width: int = 1280, height: int = 800) -> None:
        """A screen of `width` by `height` pixels.

        Raises:
            MissingExtra: Xvfb or xdotool isn't installed.
        """
        check_desktop()
        reading, writing = os.pipe()
        self._server = subprocess.Popen(
            ["Xvfb", "-displayfd", str(writing), "-screen", "0", f"{width}x{height}x24",
             "-nolisten", "tcp", "-noreset"],
            pass_fds=[writing], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
        )  # fmt: skip
        os.close(writing)
        with os.fdopen(reading) as answer:
            # Ends without a line where the server could not start.
            number = answer.readline().strip()
        if not number:
            self._server.wait()
            raise MissingExtra("Xvfb did not start; try `Xvfb :99` by hand to see why")
        self.display = f":{number}"
        self._programs: list[subprocess.Popen[str]] = []

    def __enter__(self) -> Desktop:
        return self

    def __exit__(self, *_: object) -> None:
        for program in self._programs:
            if program.poll() is None:
                program.kill()
            program.communicate()
        self._server.terminate()
        self._server.wait()

    @property
    def environment(self) -> dict[str, str]:
        """The environment variables for a program that is to open its windows here."""
        # What belongs to a Wayland session would be preferred to the display.
        kept = {k: v for k, v in os.environ.items() if k != "WAYLAND_DISPLAY"}
        return {**kept, "DISPLAY": self.display, "LIBGL_ALWAYS_SOFTWARE": "1"}

    def start(
        self, command: Sequence[str], environment: Mapping[str, str] | None = None
    ) -> subprocess.Popen[str]:
        """A program started on this screen; its output is piped, as text."""
        program = subprocess.Popen(
            list(command), env={**self.environment, **(environment or {})}, text=True,
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE,
        )  # fmt: skip
        self._programs.append(program)
        return program

    def window(self, title: str, timeout_s: float = 60.0) -> str:
        """The id of the window whose title holds `title`, focused, once it is there.

        Raises:
            TimeoutError: it didn't open within `timeout_s` [s].
        """
        deadline = time.monotonic() + timeout_s
        while time.monotonic() < deadline:
            # Searching by name misses windows whose name is in UTF-8, as SDL's is.
            for window in self._answer(
                "search", "--onlyvisible", "--any", "--class", "--name", "."
            ):
                if title in " ".join(self._answer("getwindowname", window)):
                    self._xdotool("windowfocus", window)
                    return window
            time.sleep(0.1)
        raise TimeoutError(f"no window called {title!r} within {timeout_s:g} s")

    def key(self, *keys: str) -> None:
        """Press and let go of keys one after the other, by their X names (`Right`, `Page_Up`)."""
        for key in keys:
            self._xdotool("key", "--clearmodifiers", key)

    def press(self, *keys: str) -> None:
        """Press keys and keep them down until `release`."""
        for key in keys:
            self._xdotool("keydown", key)

    def release(self, *keys: str) -> None:
        """Let go of keys."""
        for key in keys:
            self._xdotool("keyup", key)

    def screenshot(self, path: Path | None = None) -> Image.Image:
        """The whole screen as an image, written to `path` if there is one."""
        image = ImageGrab.grab(xdisplay=self.display)
        if image.mode != "RGB":
            image = image.convert("RGB")
        if path is not None:
            image.save(path)
        return image

    def _answer(self, *arguments: str) -> list[str]:
        """What xdotool prints, in words; none where it fails."""
        return subprocess.run(
            ["xdotool", *arguments],
            env=self.environment, capture_output=True, text=True, check=False,
        ).stdout.split()  # fmt: skip

    def _xdotool(self, *arguments: str) -> None:
        subprocess.run(["xdotool", *arguments], env=self.environment, check=True)
