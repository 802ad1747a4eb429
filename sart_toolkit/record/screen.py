"""A window to draw on, and the keys pressed in it: all that the toolkit's own windows need of SDL.

The only module that draws with pygame; it is imported when the first window opens.
"""

from __future__ import annotations

import functools
import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np

from sart_toolkit.data.records import Image
from sart_toolkit.errors import MissingExtra, NoDisplay

WIDTH, HEIGHT = 1280, 800
Box = tuple[int, int, int, int]

BACKGROUND, CARD, LINE = "#15181d", "#20252d", "#39424f"
TEXT, FAINT, BRIGHT = "#e9edf2", "#93a0b0", "#ffffff"
# Okabe and Ito's colours, told apart by colour-blind viewers as well.
GREEN, RED, ORANGE, BLUE = "#009e73", "#d55e00", "#e69f00", "#56b4e9"


@dataclass(frozen=True)
class Key:
    """A key that went down or up, by pygame's name of it: "w", "space", "right"."""

    name: str
    down: bool


@dataclass(frozen=True)
class Closed:
    """Someone asked the window to close."""


@dataclass(frozen=True)
class FocusLost:
    """Keys go elsewhere from now on; those that are down won't be heard to rise."""


Event = Key | Closed | FocusLost


def start_sdl() -> Any:
    """pygame, with displays and gamepads ready but no sound, so that none is looked for.

    Raises:
        MissingExtra: pygame-ce isn't installed.
        NoDisplay: there is nowhere to open a window.
    """
    os.environ.setdefault("PYGAME_HIDE_SUPPORT_PROMPT", "1")
    # SDL would turn a request to end the program into one that the window may ask back about.
    os.environ.setdefault("SDL_NO_SIGNAL_HANDLERS", "1")
    try:
        import pygame
    except ImportError as error:
        raise MissingExtra(
            f"a window needs pygame-ce ({error}); pip install sart_toolkit[teleop]"
        ) from error
    chosen = os.environ.get("SDL_VIDEODRIVER")
    try:
        if not chosen and not os.environ.get("DISPLAY") and not os.environ.get("WAYLAND_DISPLAY"):
            raise pygame.error("neither DISPLAY nor WAYLAND_DISPLAY is set")
        pygame.display.init()
        # Rather than say so, SDL draws where nobody sees it if the display doesn't answer.
        if not chosen and pygame.display.get_driver() in ("offscreen", "dummy"):
            pygame.display.quit()
            raise pygame.error(f"display {os.environ.get('DISPLAY')!r} doesn't answer")
        pygame.font.init()
        pygame.joystick.init()
    except pygame.error as error:
        raise NoDisplay(
            f"no window can be opened: {error}; work on a desktop, or give it a virtual display: "
            "xvfb-run -a COMMAND"
        ) from error
    return pygame


class Screen:
    """A window, drawn on as if it were 1280 by 800 whatever its size; closed by `with`."""

    def __init__(self, title: str) -> None:
        """Open the window, smaller where the desktop is.

        Raises:
            MissingExtra: pygame-ce isn't installed.
            NoDisplay: there is nowhere to open a window.
        """
        self._pygame = start_sdl()
        wide, high = self._pygame.display.get_desktop_sizes()[0]
        # A bar or two of the desktop's own are there as well.
        scale = 1.0 if wide >= WIDTH and high >= HEIGHT else min(wide / WIDTH, high / HEIGHT) * 0.9
        try:
            self._window = self._pygame.display.set_mode(
                (round(WIDTH * scale), round(HEIGHT * scale)), self._pygame.RESIZABLE
            )
        except self._pygame.error as error:
            self._pygame.display.quit()
            raise NoDisplay(f"no window can be opened: {error}") from error
        self._pygame.display.set_caption(title)
        self._canvas = self._pygame.Surface((WIDTH, HEIGHT))

    def __enter__(self) -> Screen:
        return self

    def __exit__(self, *_: object) -> None:
        self._pygame.display.quit()

    def events(self) -> Iterator[Event]:
        """What was pressed or asked for since the last call."""
        pygame = self._pygame
        for event in pygame.event.get():
            if event.type in (pygame.KEYDOWN, pygame.KEYUP):
                yield Key(pygame.key.name(event.key), event.type == pygame.KEYDOWN)
            elif event.type == pygame.QUIT:
                yield Closed()
            elif event.type == pygame.WINDOWFOCUSLOST:
                yield FocusLost()

    def clear(self) -> None:
        """Begin a new image of the whole window."""
        self._canvas.fill(BACKGROUND)

    def show(self) -> None:
        """Put on the screen what was drawn since `clear`."""
        pygame = self._pygame
        # The window has another surface after its size has changed.
        self._window = pygame.display.get_surface()
        size = self._window.get_size()
        if size == (WIDTH, HEIGHT):
            self._window.blit(self._canvas, (0, 0))
        else:
            scale = min(size[0] / WIDTH, size[1] / HEIGHT)
            fitted = (max(1, int(WIDTH * scale)), max(1, int(HEIGHT * scale)))
            left, top = (size[0] - fitted[0]) // 2, (size[1] - fitted[1]) // 2
            self._window.fill(BACKGROUND)
            self._window.blit(pygame.transform.smoothscale(self._canvas, fitted), (left, top))
        pygame.display.flip()

    # --- drawing --------------------------------------------------------------------------------

    @functools.lru_cache(maxsize=16)  # noqa: B019 - as long as the window
    def _font(self, size: int, bold: bool) -> Any:
        name = "DejaVuSans-Bold.ttf" if bold else "DejaVuSans.ttf"
        path = Path(matplotlib.get_data_path()) / "fonts" / "ttf" / name
        return self._pygame.font.Font(str(path), size)

    @functools.lru_cache(maxsize=256)  # noqa: B019 - as long as the window
    def _written(self, words: str, size: int, colour: str, bold: bool) -> Any:
        return self._font(size, bold).render(words, True, colour)

    def text(
        self,
        at: tuple[int, int],
        words: str,
        size: int = 16,
        colour: str = TEXT,
        bold: bool = False,
        align: str = "left",
    ) -> int:
        """Write one line, its upper corner at `at`; its width [pixels]."""
        surface = self._written(words, size, colour, bold)
        width = int(surface.get_width())
        shift = {"left": 0, "middle": width // 2, "right": width}[align]
        self._canvas.blit(surface, (at[0] - shift, at[1]))
        return width

    def paragraph(self, box: Box, words: str, size: int = 16, colour: str = TEXT) -> None:
        """Write words in lines no wider than a box, with "…" where it is full."""
        left, top, width, height = box
        font = self._font(size, False)
        step = font.get_linesize()
        lines: list[str] = []
        for word in words.split():
            longer = f"{lines[-1]} {word}" if lines else word
            if lines and font.size(longer)[0] <= width:
                lines[-1] = longer
            else:
                lines.append(word)
        room = max(1, height // step)
        if len(lines) > room:
            lines = [*lines[: room - 1], lines[room - 1] + " …"]
        for i, line in enumerate(lines):
            self.text((left, top + i * step), line, size, colour)

    def box(self, box: Box, colour: str = CARD, edge: str = "", radius: int = 8) -> None:
        """Fill a box with round corners, and draw its edge if that has a colour."""
        self._pygame.draw.rect(self._canvas, colour, box, border_radius=radius)
        if edge:
            self._pygame.draw.rect(self._canvas, edge, box, width=1, border_radius=radius)

    def bar(self, box: Box, share: float, colour: str) -> None:
        """A bar filled from the left to a share in [0, 1]."""
        left, top, width, height = box
        self.box(box, LINE, radius=height // 2)
        filled = round(width * min(max(share, 0.0), 1.0))
        if filled:
            self.box((left, top, max(filled, height), height), colour, radius=height // 2)

    def dot(self, at: tuple[int, int], radius: int, colour: str) -> None:
        """A filled circle."""
        self._pygame.draw.circle(self._canvas, colour, at, radius)

    def image(self, box: Box, rgb: Image) -> None:
        """An image `(H, W, 3)` uint8, scaled to fit into the middle of a box."""
        left, top, width, height = box
        scale = min(width / rgb.shape[1], height / rgb.shape[0])
        left += (width - round(scale * rgb.shape[1])) // 2
        top += (height - round(scale * rgb.shape[0])) // 2
        width, height = (round(scale * n) for n in rgb.shape[1::-1])
        pixels = np.ascontiguousarray(rgb)
        surface = self._pygame.image.frombuffer(pixels, pixels.shape[1::-1], "RGB")
        if surface.get_size() != (width, height):
            surface = self._pygame.transform.smoothscale(surface, (width, height))
        self._canvas.blit(surface, (left, top))
