"""Every key in the real window, on a screen of its own; what happens without Open3D."""

from __future__ import annotations

import importlib
import json
import signal
import sys

import pytest

from sart_toolkit.annotate.session import KEYS
from sart_toolkit.data.storage import load_annotation, save_demonstration
from sart_toolkit.errors import InvalidInput, MissingExtra
from sart_toolkit.testing.desktop import Desktop, check_desktop

SART = [sys.executable, "-c", "from sart_toolkit.cli import main; main()", "annotate"]
X_NAMES = {
    "Enter": "Return", "Backspace": "BackSpace", "Page Down": "Page_Down", "Page Up": "Page_Up",
    "Space": "space", "+": "plus", "-": "minus",
}  # fmt: skip


def x_name(key):
    return X_NAMES.get(key, key if len(key) > 1 else key.lower())


@pytest.fixture
def window_module():
    pytest.importorskip("open3d")
    return importlib.import_module("sart_toolkit.annotate.open3d_window")


@pytest.fixture
def screen():
    pytest.importorskip("open3d")
    check_desktop()
    with Desktop() as screen:
        yield screen


def rows(folder):
    journal = folder / "demo.annotation.json.journal"
    if not journal.exists():
        return []
    return [json.loads(line) for line in journal.read_text().splitlines() if line.endswith("}")]


@pytest.mark.window
@pytest.mark.slow
def test_every_key_does_in_the_window_what_the_table_says(
    screen, tmp_path, peg_demonstration, wait_until
):
    save_demonstration(tmp_path / "demo.h5", peg_demonstration)
    program = screen.start([*SART, str(tmp_path / "demo.h5"), "--json"])
    screen.window("sart annotate", timeout_s=120)
    keys = [key for key, name in KEYS.items() if name not in ("save", "quit")]
    for key in ["A", *keys]:
        done = len(rows(tmp_path))
        # A window takes keys only once its first image stands.
        screen.key(x_name(key))
        wait_until(lambda done=done: len(rows(tmp_path)) > done, 60)
        assert rows(tmp_path)[-1]["action"] == KEYS[key]
    before = screen.screenshot().tobytes()
    screen.key("Home")
    wait_until(lambda: screen.screenshot().tobytes() != before, 60)

    # The next window continues what a killed one has done.
    n = len(rows(tmp_path)) - 1
    program.kill()
    program.wait()
    with Desktop() as other:
        program = other.start([*SART, str(tmp_path / "demo.h5"), "--json"])
        other.window("sart annotate", timeout_s=120)
        for key in ("Escape", "W", "Q"):
            done = len(rows(tmp_path))
            other.key(x_name(key))
            wait_until(lambda done=done: len(rows(tmp_path)) != done, 60)
        out, err = program.communicate(timeout=60)
    assert program.returncode == 0, err
    assert f"recovered the {n} key presses" in err
    result = json.loads(out)
    assert result["saved"] and result["presses"] == n + 3
    load_annotation(tmp_path / "demo.annotation.json").check_matches(peg_demonstration)
    assert not (tmp_path / "demo.annotation.json.journal").exists()


@pytest.mark.window
@pytest.mark.slow
def test_ctrl_c_closes_the_window_and_keeps_the_work(
    screen, tmp_path, peg_demonstration, wait_until
):
    save_demonstration(tmp_path / "demo.h5", peg_demonstration)
    command = [*SART, str(tmp_path / "demo.h5"), "--show", "scene", "--suggest-all"]
    program = screen.start(command)
    screen.window("sart annotate", timeout_s=120)
    screen.key("g")
    wait_until(lambda: len(rows(tmp_path)) == 3, 60)
    program.send_signal(signal.SIGINT)
    _, err = program.communicate(timeout=60)
    assert program.returncode == 130, err
    assert "to resume type: sart annotate" in err
    assert len(rows(tmp_path)) == 3


def test_every_key_has_a_number_of_open3d(window_module):
    # Escape closes the window, which is asked first like every closing.
    assert set(window_module._KEY_NAMES.values()) == set(KEYS) - {"Escape"}


def test_without_open3d_the_remedy_is_reported(monkeypatch):
    monkeypatch.setitem(sys.modules, "open3d", None)
    monkeypatch.delitem(sys.modules, "sart_toolkit.annotate.open3d_window", raising=False)
    with pytest.raises(MissingExtra, match=r"pip install sart_toolkit\[annotate\].*--no-window"):
        importlib.import_module("sart_toolkit.annotate.open3d_window")


@pytest.mark.parametrize(
    "changes", [{"width": 100}, {"height": 1}, {"moving_points": 0}, {"idle_s": 0.0}]
)
def test_impossible_windows_are_refused(window_module, changes):
    with pytest.raises(InvalidInput, match="window: expected at least 400 x 400 pixels"):
        window_module.WindowConfig(**changes)
