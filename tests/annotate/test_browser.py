"""The annotator's page in a real browser: keys, buttons, sliders, and what is kept of them."""

from __future__ import annotations

import functools
import importlib
import json
import re
import signal
import socket
import subprocess
import sys

import pytest

from sart_toolkit.annotate.session import ACTIONS, KEYS
from sart_toolkit.cli import main
from sart_toolkit.data.storage import load_annotation, save_demonstration
from sart_toolkit.testing.browser import MESSAGE

JS_NAMES = {
    "Right": "ArrowRight", "Left": "ArrowLeft", "Up": "ArrowUp", "Down": "ArrowDown",
    "Page Down": "PageDown", "Page Up": "PageUp", "Space": " ",
}  # fmt: skip


@pytest.fixture
def demo(tmp_path, peg_demonstration):
    save_demonstration(tmp_path / "demo.h5", peg_demonstration)
    return tmp_path / "demo.h5"


@pytest.fixture
def annotate(demo, serve):
    """Starts `sart annotate --web`; the program, once it has said where its page is."""
    return functools.partial(serve, "annotate", demo)


def opened(browser, program):
    browser.open_page(program.url)
    # Keys are listened to once the page has been drawn.
    browser.wait_for("!!document.querySelector('button')")


def rows(folder):
    journal = folder / "demo.annotation.json.journal"
    if not journal.exists():
        return []
    return [json.loads(line) for line in journal.read_text().splitlines() if line.endswith("}")]


def said(browser, text):
    """Waits until the page's message has `text` in it."""
    where = f"document.querySelector('{MESSAGE}')?.innerText.includes({json.dumps(text)})"
    browser.wait_for(where)


def ended(program):
    out, err = program.communicate(timeout=60)
    assert program.returncode == 0, err
    # Nothing of viser's stands among results.
    assert len(out.strip().splitlines()) == 1
    return json.loads(out)


@pytest.mark.window
def test_three_keys_suggest_save_and_end(annotate, browser, tmp_path, peg_annotation):
    program = annotate()
    opened(browser, program)
    assert browser.run("document.title") == "sart annotate"
    browser.key("a")
    said(browser, "suggested")
    browser.key("w")
    said(browser, "saved")
    browser.key("q")
    result = ended(program)
    assert result["saved"] and result["presses"] == 3
    saved = load_annotation(tmp_path / "demo.annotation.json")
    assert [s.radius for s in saved.spheres] == [s.radius for s in peg_annotation.spheres]
    assert not (tmp_path / "demo.annotation.json.journal").exists()


@pytest.mark.window
@pytest.mark.slow
def test_peg_in_hole_is_annotated_by_at_most_25_clicks(annotate, browser, tmp_path):
    program = annotate()
    opened(browser, program)
    clicks = 0
    while True:
        # From each sphere to where its segments start, and another one there.
        browser.click("button", "suggest")
        clicks += 1
        browser.wait_for(f"/^suggested|no sphere can/.test({text_of_message()})")
        if not browser.text(MESSAGE).startswith("suggested"):
            break
        browser.click("button", "converge")
        clicks += 1
        said(browser, "segments of the sphere")
    browser.click("button", "save")
    said(browser, "saved")
    browser.click("button", "quit")
    result = ended(program)
    assert result["saved"] and not result["not_proved_clear"]
    assert result["presses"] == clicks + 2 <= 25
    spheres = load_annotation(tmp_path / "demo.annotation.json").spheres
    assert len(spheres) == clicks // 2


def text_of_message():
    return f"document.querySelector('{MESSAGE}').innerText"


@pytest.mark.window
@pytest.mark.slow
def test_every_key_does_on_the_page_what_the_table_says(annotate, browser, tmp_path, wait_until):
    program = annotate()
    opened(browser, program)
    browser.run("document.addEventListener('keydown', () => { window.leaked = true })")
    for key in ["A", *(key for key, name in KEYS.items() if name not in ("save", "quit"))]:
        done = len(rows(tmp_path))
        browser.key(JS_NAMES.get(key, key if len(key) > 1 else key.lower()))
        wait_until(lambda done=done: len(rows(tmp_path)) > done, 60)
        assert rows(tmp_path)[-1]["action"] == KEYS[key]
    # What viser would move its camera by.
    assert not browser.run("window.leaked")


@pytest.mark.window
@pytest.mark.slow
def test_a_radius_that_is_dragged_is_one_change(annotate, browser, tmp_path, wait_until):
    program = annotate("--suggest-all")
    opened(browser, program)
    before = len(rows(tmp_path))
    browser.drag(browser.centre("[role=slider]", index=1), (-60.0, 0.0), steps=4)
    wait_until(lambda: len(rows(tmp_path)) > before, 60)
    *_, row = rows(tmp_path)
    assert len(rows(tmp_path)) == before + 1 and row["action"] == "radius"
    browser.key("z")
    said(browser, "undone")
    assert rows(tmp_path)[-1]["action"] == "undo"

    browser.drag(browser.centre("[role=slider]"), (80.0, 0.0), steps=4)
    wait_until(lambda: rows(tmp_path)[-1]["action"] == "go", 60)
    wait_until(lambda: not browser.run("document.activeElement?.role === 'slider'"), 60)
    went = rows(tmp_path)[-1]["selected"]
    assert went > 1
    # Whether the slider that was used last takes the arrow or the page does.
    browser.key("ArrowRight")
    wait_until(lambda: rows(tmp_path)[-1]["selected"] == went + 1, 60)


@pytest.mark.window
@pytest.mark.slow
def test_closing_the_browser_and_ctrl_c_lose_nothing(annotate, browser, tmp_path, wait_until):
    program = annotate()
    assert re.search(r"ssh -N -L (\d+):127\.0\.0\.1:\1 \S+@\S+", program.said)
    opened(browser, program)
    browser.key("a")
    said(browser, "suggested")
    browser.open("about:blank")
    opened(browser, program)
    said(browser, "suggested")
    n = len(rows(tmp_path))
    program.send_signal(signal.SIGINT)
    out, err = program.communicate(timeout=60)
    assert program.returncode == 130 and not out, err
    assert "to resume type: sart annotate" in err
    assert len(rows(tmp_path)) == n == 2
    assert not (tmp_path / "demo.annotation.json").exists()

    program = annotate()
    opened(browser, program)
    said(browser, "recovered the 1 key presses of an interrupted session; not saved yet")
    browser.key("q")
    said(browser, "quit again to drop them")


def test_every_action_with_keys_has_one_button():
    pytest.importorskip("viser")
    browser = importlib.import_module("sart_toolkit.annotate.browser")
    shown = [name for names in browser.BUTTONS.values() for name in names]
    assert sorted(shown) == sorted(name for name, action in ACTIONS.items() if action.keys)


def refused(capsys, *argv):
    with pytest.raises(SystemExit) as exit_:
        main(["annotate", *map(str, argv)])
    assert exit_.value.code == 2
    return capsys.readouterr().err.strip().splitlines()[-1]


def test_a_port_that_is_taken_is_named_with_the_remedy(capsys, demo):
    pytest.importorskip("viser")
    with socket.create_server(("127.0.0.1", 0)) as other:
        port = other.getsockname()[1]
        said = refused(capsys, demo, "--web", "--port", port)
    assert f"127.0.0.1:{port}: can't serve a page there" in said and "another --port" in said


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--host", "0.0.0.0"], "--host: says where the page of --web is; add --web"),
        (["--port", "8081"], "--port: says where the page of --web is; add --web"),
        (["--web", "--text"], "--web and --text: choose one of them"),
        (["--web", "--suggest-all", "--no-window"], "--web and --no-window: choose one of them"),
    ],
)
def test_options_that_exclude_each_other_are_refused(capsys, demo, options, said):
    assert said in refused(capsys, demo, *options)


def test_without_viser_the_remedy_is_reported(monkeypatch, capsys, demo):
    monkeypatch.setitem(sys.modules, "viser", None)
    monkeypatch.delitem(sys.modules, "sart_toolkit.record.webpage", raising=False)
    said = refused(capsys, demo, "--web")
    assert "pip install 'sart_toolkit[web]'" in said and "without --web" in said


def test_viser_is_imported_only_for_a_page():
    code = "import sys, sart_toolkit.cli.annotate, sart_toolkit.annotate.drawing; " \
        "sys.exit('viser' in sys.modules)"  # fmt: skip
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
