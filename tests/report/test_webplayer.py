"""The player's page: what it shows at each step, and in a real browser what keys and slider do."""

from __future__ import annotations

import dataclasses
import importlib
import json
import re

import numpy as np
import pytest

from sart_toolkit.annotate.session import AnnotationSession
from sart_toolkit.cli import main
from sart_toolkit.collision.phases import demonstration_phases
from sart_toolkit.data.storage import save_demonstration
from sart_toolkit.report.player import Playback
from sart_toolkit.robots.visuals import RobotVisuals
from sart_toolkit.testing.browser import MESSAGE


@pytest.fixture
def episode(peg_dataset):
    return Playback("episode.h5", peg_dataset.sources[0].demonstration, peg_dataset.episode(0))


@pytest.fixture
def make_page(free_port, peg_model, peg_task):
    """Makes the page of a playback; what was shown last is `said`."""
    pytest.importorskip("viser")
    webpage = importlib.import_module("sart_toolkit.record.webpage")
    webplayer = importlib.import_module("sart_toolkit.report.webplayer")
    pages = []

    def make(playback, clearances=None, speed=1.0):
        page = webpage.WebPage("a page", port=free_port)
        pages.append(page)
        phases = demonstration_phases(playback.demonstration, peg_model.spec, peg_task.scene)
        robot = RobotVisuals(peg_model)
        shown = webplayer.PlayPage(
            playback, robot, peg_task.scene, None, phases, clearances, page, speed
        )
        return shown, page

    yield make
    for page in pages:
        page.close()


def panel(page):
    """The facts in the page's panel, by name, and its message."""
    content = page._state.content
    said = re.search(r'class="message">([^<]*)<', content)[1]
    return dict(re.findall(r"<td>([^<]*)</td><td>([^<]*)</td>", content)) | {"message": said}


def test_the_page_says_what_was_recorded_at_each_step(make_page, episode, peg_world):
    clearances = episode.clearances(peg_world)
    shown, page = make_page(episode, clearances)
    assert "data:image/png" in shown._state.content
    for i in (0, episode.split, len(episode) - 1):
        page.put("go", i + 1)
        page.put("escape")
        shown.closed = False
        shown.run()
        said = panel(shown)
        assert said["step"] == f"{i + 1} of {len(episode)}" and said["from the"] == episode.part(i)
        assert said["clearance"] == f"{1e3 * clearances[i]:.1f} mm"
        assert said["goal"] == ("reached" if episode.success(i) else "–")
        assert said["message"].startswith("stopped: ") and shown._slider.value == i + 1


def test_buttons_and_keys_are_the_window_s(make_page, episode):
    shown, page = make_page(episode)
    webplayer = importlib.import_module("sart_toolkit.report.webplayer")
    buttons = [name for names in webplayer.BUTTONS.values() for name in names]
    assert sorted(buttons) == sorted(button for _, button, _ in webplayer.KEYS.values())
    for button, at in (("last", len(episode) - 1), ("back", len(episode) - 2), ("first", 0)):
        page.put(button)
        page.put("close")
        shown.closed = False
        shown.run()
        assert shown.at == at and not shown.playing
    assert "clearance" in panel(shown) and panel(shown)["clearance"] == "not known"


def test_it_plays_by_itself_to_the_end(make_page, episode, monkeypatch):
    shown, page = make_page(episode, speed=1000.0)
    seen = []
    draw = shown._draw

    def drawn():
        draw()
        seen.append(shown.at)
        if not shown.playing:
            page.put("escape")

    monkeypatch.setattr(shown, "_draw", drawn)
    # As if a browser had it open.
    monkeypatch.setattr(type(page), "watched", True)
    shown.run()
    assert seen[: len(episode) - 1] == list(range(1, len(episode)))


def test_clearances_are_the_annotator_s_and_no_less_than_what_was_proved(
    peg_demonstration, peg_world, episode, peg_dataset
):
    session = AnnotationSession(peg_demonstration, peg_world)
    played = Playback("demo.h5", peg_demonstration).clearances(peg_world)
    np.testing.assert_allclose(played, session.clearances, rtol=0, atol=1e-12)
    found = episode.clearances(peg_world)
    proved = peg_dataset.episode(0).provenance.certificate["measured"]["clearance"]
    assert found[: episode.split].min() >= proved
    following = played[episode.waypoint(0) :]
    np.testing.assert_allclose(found[episode.split :], following, rtol=0, atol=1e-12)


def test_what_moves_is_drawn_beside_the_cloud(make_page, peg_demonstration):
    moved = {name: Ts.copy() for name, Ts in peg_demonstration.body_Ts_world.items()}
    moved["block"][-1, 0, 3] += 0.01
    shown, _ = make_page(
        Playback("d.h5", dataclasses.replace(peg_demonstration, body_Ts_world=moved))
    )
    assert "table" in shown._still and "block" not in shown._still


@pytest.fixture
def demo(tmp_path, peg_demonstration):
    save_demonstration(tmp_path / "demo.h5", peg_demonstration)
    return tmp_path / "demo.h5"


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--port", "8081"], "--port: says where the page of --web is; add --web"),
        (["--web", "--out", "film.mp4"], "--web and --out: choose one of them"),
        (["--web", "--backend", "pybullet"], "--web and --backend: choose one of them"),
        (
            ["--web", "--camera", "overview"],
            "unknown recorded camera 'overview'",
        ),
    ],
)
def test_options_that_a_page_can_t_honour_are_refused(capsys, demo, options, said):
    pytest.importorskip("viser")
    with pytest.raises(SystemExit) as exit_:
        main(["play", str(demo), *options])
    assert exit_.value.code == 2 and said in capsys.readouterr().err


@pytest.mark.window
@pytest.mark.slow
def test_a_recording_is_played_in_a_browser(demo, serve, browser, peg_demonstration):
    n = len(peg_demonstration)
    program = serve("play", demo, "--camera", "wrist")
    assert re.search(r"ssh -N -L (\d+):127\.0\.0\.1:\1 \S+@\S+", program.said)
    browser.open_page(program.url)
    browser.wait_for("!!document.querySelector('button')")
    assert browser.run("document.title") == "sart play demo.h5"
    # It plays by itself, from when the page was opened.
    browser.wait_for(f"/^stopped: {(n - 1) / 10:.1f} of/.test({said()})")
    at_end = browser.run("document.querySelector('.sart img').src")
    browser.key("Home")
    browser.wait_for(f"/^stopped: 0.0 of/.test({said()})")
    assert browser.run("document.querySelector('.sart img').src") != at_end
    browser.key("ArrowRight")
    browser.wait_for(f"/^stopped: 0.1 of/.test({said()})")
    browser.drag(browser.centre("[role=slider]"), (80.0, 0.0), steps=4)
    browser.wait_for(f"!/^stopped: 0.[01] of/.test({said()})")
    browser.key(" ")
    browser.wait_for(f"/^playing/.test({said()})")
    browser.click("button", "close")
    out, err = program.communicate(timeout=60)
    assert program.returncode == 0, err
    assert json.loads(out)["steps"] == n


def said():
    return f"document.querySelector('{MESSAGE}').innerText"
