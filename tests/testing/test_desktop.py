"""A screen without a viewer: images of it, its windows, and what happens without Xvfb."""

from __future__ import annotations

import sys

import pytest

from sart_toolkit.errors import MissingExtra
from sart_toolkit.testing import desktop
from sart_toolkit.testing.desktop import Desktop, check_desktop

# Draws a window that turns white while the space bar is down.
WINDOW = """
import pygame
pygame.init()
screen = pygame.display.set_mode((200, 100))
pygame.display.set_caption("a test window")
colour = "red"
while True:
    for event in pygame.event.get():
        if event.type == pygame.KEYDOWN and event.key == pygame.K_SPACE:
            colour = "white"
        if event.type == pygame.KEYUP and event.key == pygame.K_SPACE:
            colour = "blue"
    screen.fill(colour)
    pygame.display.flip()
    pygame.time.wait(10)
"""


def without_program(monkeypatch, name):
    which = desktop.shutil.which
    monkeypatch.setattr(desktop.shutil, "which", lambda n: None if n == name else which(n))


@pytest.mark.parametrize("name", ["Xvfb", "xdotool"])
def test_without_its_programs_the_remedy_is_reported(monkeypatch, name):
    without_program(monkeypatch, name)
    with pytest.raises(MissingExtra, match=f"{name} not found; type: bash tools/setup_debian.sh"):
        check_desktop()


@pytest.mark.window
def test_a_key_reaches_the_window_and_changes_the_image(wait_until, tmp_path):
    pytest.importorskip("pygame")
    check_desktop()
    with Desktop(640, 480) as screen:
        program = screen.start([sys.executable, "-c", WINDOW])
        screen.window("a test window")

        def shows(colour):
            colours = screen.screenshot().getcolors(1 << 24) or []
            return colour in [c for n, c in colours if n > 10000]

        wait_until(lambda: shows((255, 0, 0)))
        screen.press("space")
        wait_until(lambda: shows((255, 255, 255)))
        screen.release("space")
        wait_until(lambda: shows((0, 0, 255)))
        assert screen.screenshot(tmp_path / "a.png").size == (640, 480)
        assert (tmp_path / "a.png").stat().st_size > 100
    assert program.returncode is not None


@pytest.mark.window
def test_a_window_that_does_not_open_is_an_error():
    check_desktop()
    with Desktop(64, 48) as screen, pytest.raises(TimeoutError, match="'nothing' within 0.2 s"):
        screen.window("nothing", 0.2)
