"""The recording's window: pacing, keys and images, on SDL's display that isn't there."""

from __future__ import annotations

import sys

import numpy as np
import pytest

from sart_toolkit.errors import InvalidInput, MissingExtra, NoDisplay
from sart_toolkit.record import screen as screens
from sart_toolkit.record.desk import RecordingDesk
from sart_toolkit.record.devices.keyboard import Keyboard
from sart_toolkit.record.screen import Closed, FocusLost, Key, Screen, start_sdl
from sart_toolkit.record.session import SessionState
from sart_toolkit.record.window import Pace, RecordingWindow


class Time:
    def __init__(self):
        self.now = 0.0

    def __call__(self):
        return self.now


def passed(pace, clock, seconds, each):
    """The control periods done while time goes by in equal bits."""
    done = 0
    for _ in range(round(seconds / each)):
        clock.now += each
        done += pace.due()
    return done


@pytest.mark.parametrize("each", [0.001, 0.033, 0.05, 0.1, 0.2])
def test_simulated_and_real_time_go_by_alike_however_often_it_is_asked(each):
    clock = Time()
    pace = Pace(30, clock)
    assert passed(pace, clock, 10.0, each) == pytest.approx(300, abs=2)
    assert pace.share > 0.97 and 0.0 <= pace.left() <= 1 / 30


def test_a_machine_too_slow_runs_at_a_share_of_real_time_and_says_so():
    clock = Time()
    pace = Pace(30, clock)
    done = passed(pace, clock, 10.0, 0.5)
    assert done == pytest.approx(150, abs=20)
    assert 0.4 < pace.share < 0.6
    passed(pace, clock, 3.0, 0.01)
    assert pace.share > 0.97


def test_a_recording_without_a_camera_has_no_window(make_session, peg_setup):
    desk = RecordingDesk(make_session(), Keyboard(peg_setup), print)
    with pytest.raises(InvalidInput, match="no camera to show; record with one"):
        RecordingWindow(desk, None, "demo.h5")


@pytest.fixture
def pygame(monkeypatch):
    pytest.importorskip("pygame")
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    return start_sdl()


@pytest.fixture
def screen(pygame):
    with Screen("a test") as screen:
        list(screen.events())
        yield screen


@pytest.fixture
def window(screen, make_session, peg_setup):
    keyboard = Keyboard(peg_setup)
    keyboard.connect()
    session = make_session(cameras=("wrist",))
    desk = RecordingDesk(session, keyboard, lambda _: None)
    return RecordingWindow(desk, screen, "a/very/long/path/to/the/place/where/it/goes/demo.h5")


def drawn(pygame):
    return pygame.surfarray.array3d(pygame.display.get_surface())


def press(pygame, key, *kinds):
    for kind in kinds or (pygame.KEYDOWN, pygame.KEYUP):
        pygame.event.post(pygame.event.Event(kind, key=key))


def test_events_have_the_names_of_keys(pygame, screen):
    press(pygame, pygame.K_RIGHT, pygame.KEYDOWN)
    press(pygame, pygame.K_w, pygame.KEYUP)
    pygame.event.post(pygame.event.Event(pygame.WINDOWFOCUSLOST))
    pygame.event.post(pygame.event.Event(pygame.QUIT))
    assert list(screen.events()) == [Key("right", True), Key("w", False), FocusLost(), Closed()]


def test_every_state_looks_different_and_shows_the_scene(pygame, window):
    images = {}

    def look():
        window.draw()
        image = pygame.surfarray.array3d(window._screen._canvas)
        images[window._desk.session.state] = image

    look()
    window._take(Key("right", True))
    for _ in range(30):
        window._desk.tick()
    look()
    window._desk.session.pause()
    look()
    window._take(Key("right", True))
    window._take(Key("right", True))
    look()
    window._take(Key("right", True))
    window._take(Key("right", True))
    look()
    assert set(images) == set(SessionState)
    heads = [image[800:1264, 76:128] for image in images.values()]
    for i, a in enumerate(heads):
        assert all((a != b).any() for b in heads[i + 1 :])
    for image in images.values():
        scene = image[16:784, 16:784].reshape(-1, 3)
        assert len(np.unique(scene, axis=0)) > 20


def test_keys_reach_the_device_and_are_let_go_with_the_focus(window):
    keyboard = window._desk.device
    window._take(Key("w", True))
    window._take(Key("3", True))
    assert keyboard.poll()[1] == 1 and keyboard.speed.name == "fast"
    window._take(FocusLost())
    assert not keyboard.poll().any()


def test_it_runs_until_the_person_is_done(pygame, window):
    press(pygame, pygame.K_RIGHT)
    press(pygame, pygame.K_ESCAPE)
    window.run()
    assert window._desk.done and window._desk.demonstration is None


def test_after_a_save_it_closes_by_itself(pygame, window, monkeypatch):
    monkeypatch.setattr("sart_toolkit.record.window._SAVED_SHOWN", 0.1)
    for _ in range(4):
        press(pygame, pygame.K_RIGHT)
    window.run()
    assert window._desk.session.state is SessionState.SAVED


def test_closing_the_window_asks_before_much_is_lost(pygame, window):
    window._take(Key("right", True))
    for _ in range(120):
        window._desk.tick()
    window._take(Closed())
    assert not window._desk.done and "Esc again discards" in window._desk.notice.text
    window._take(Closed())
    assert window._desk.done


def test_an_image_that_takes_long_gets_smaller_and_one_that_is_quick_larger(window, monkeypatch):
    window._take(Key("right", True))
    for limit, at in (("_SLOW", 0), ("_QUICK", 4)):
        monkeypatch.setattr("sart_toolkit.record.window._SLOW", 1e9)
        monkeypatch.setattr("sart_toolkit.record.window._QUICK", 0.0)
        monkeypatch.setattr(f"sart_toolkit.record.window.{limit}", 0.0 if at == 0 else 1e9)
        for _ in range(6):
            window._scene_image()
        assert window._size == at


def test_it_fits_any_window_size(pygame, window):
    for size in ((640, 400), (900, 900)):
        pygame.display.set_mode(size, pygame.RESIZABLE)
        window.draw()
        assert drawn(pygame).shape[:2] == size
        assert len(np.unique(drawn(pygame).reshape(-1, 3), axis=0)) > 20


def test_words_too_long_for_their_box_end_in_an_ellipsis(pygame, screen, monkeypatch):
    lines = []
    monkeypatch.setattr(screen, "text", lambda at, words, *_: lines.append(words))
    screen.paragraph((0, 0, 200, 60), "word " * 60, 16)
    assert 1 < len(lines) < 5 and lines[-1].endswith("…")


@pytest.mark.parametrize("display", [None, ":987"])
def test_without_a_display_the_remedy_is_reported(monkeypatch, display):
    pytest.importorskip("pygame")
    for name in ("SDL_VIDEODRIVER", "WAYLAND_DISPLAY", "DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    if display:
        monkeypatch.setenv("DISPLAY", display)
    with pytest.raises(NoDisplay, match="no window can be opened: .*xvfb-run"):
        start_sdl()


def test_without_pygame_the_extra_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "pygame", None)
    with pytest.raises(MissingExtra, match=r"pip install sart_toolkit\[teleop\]"):
        start_sdl()


def test_on_a_small_desktop_the_window_is_smaller_and_of_the_same_shape(screen, pygame):
    (wide, high), *_ = pygame.display.get_desktop_sizes()
    width, height = pygame.display.get_surface().get_size()
    assert width <= wide and height <= high
    assert width / height == pytest.approx(screens.WIDTH / screens.HEIGHT, rel=0.01)
