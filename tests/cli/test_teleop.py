"""`sart record` by hand and `sart play`, from the command line: real windows and wrong input."""

from __future__ import annotations

import json
import shutil
import signal
import sys

import imageio_ffmpeg
import pytest

from sart_toolkit.backends.pybullet import PyBulletBackend
from sart_toolkit.cli import main
from sart_toolkit.data.storage import (
    load_demonstration,
    read_json_lines,
    save_demonstration,
    save_episode,
)
from sart_toolkit.errors import CannotWrite
from sart_toolkit.testing.desktop import Desktop, check_desktop

SART = (sys.executable, "-c", "from sart_toolkit.cli import main; main()")


def error(capsys, *argv):
    """The one line on stderr of a verb that should fail with code 2."""
    capsys.readouterr()
    with pytest.raises(SystemExit) as exit_:
        main([str(a) for a in argv])
    assert exit_.value.code == 2
    lines = capsys.readouterr().err.strip().splitlines()
    assert len(lines) == 1 and lines[0].startswith("sart: error: "), lines
    return lines[0]


def result(capsys, *argv):
    capsys.readouterr()
    main([*map(str, argv), "--json"])
    lines = capsys.readouterr().out.strip().splitlines()
    return json.loads(lines[-1])


@pytest.fixture(scope="module")
def demo(tmp_path_factory, peg_demonstration):
    path = tmp_path_factory.mktemp("demo") / "demo.h5"
    save_demonstration(path, peg_demonstration)
    return path


@pytest.fixture
def dummy(monkeypatch):
    """Windows open where nobody sees them, in this process; gives a way to press keys there."""
    pygame = pytest.importorskip("pygame")
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    pygame.display.init()

    def press(*names):
        for name in names:
            key = pygame.key.key_code(name)
            for kind in (pygame.KEYDOWN, pygame.KEYUP):
                pygame.event.post(pygame.event.Event(kind, key=key))

    yield press
    pygame.display.quit()


# --- record -------------------------------------------------------------------------------------


RECORD = ["record", "peg_in_hole", "--image-size", "32", "--out"]
BY_HAND = ["--device", "keyboard"]


def test_without_a_display_the_remedy_is_reported_and_nothing_written(
    tmp_path, capsys, monkeypatch
):
    pytest.importorskip("pygame")
    for name in ("DISPLAY", "WAYLAND_DISPLAY", "SDL_VIDEODRIVER"):
        monkeypatch.delenv(name, raising=False)
    said = error(capsys, *RECORD, tmp_path / "d.h5", *BY_HAND)
    assert "no window can be opened" in said and "xvfb-run" in said
    assert "--device scripted" in said
    assert list(tmp_path.iterdir()) == []


@pytest.fixture
def any_length(monkeypatch):
    """Recordings of two steps may be saved."""
    monkeypatch.setattr("sart_toolkit.cli.teleop.check_recording", lambda *_: None)


def test_a_person_s_recording_that_cannot_be_learned_from_is_not_saved(tmp_path, capsys, dummy):
    dummy("right", "right", "right", "right", "escape")
    said = error(capsys, *RECORD, tmp_path / "d.h5", *BY_HAND)
    assert "discarded, nothing was written" in said
    assert list(tmp_path.iterdir()) == []


def test_a_person_s_recording_short_of_the_goal_is_saved_when_asked_twice(
    tmp_path, capsys, dummy, monkeypatch, any_length
):
    monkeypatch.setattr("sart_toolkit.record.window._SAVED_SHOWN", 0.0)
    dummy("right", "right", "right", "right")
    out = tmp_path / "d.h5"
    said = result(capsys, *RECORD, out, *BY_HAND, "--operator", "Ada")
    assert said["success"] is False and said["operator"] == "Ada" and said["device"] == "keyboard"
    assert 0 <= said["seconds_spent"] < 60
    assert load_demonstration(out).raw_commands.shape[1] == 7


def test_a_discarded_recording_writes_nothing_and_says_so(tmp_path, capsys, dummy):
    dummy("right", "escape")
    said = error(capsys, *RECORD, tmp_path / "d.h5", *BY_HAND)
    assert "discarded, nothing was written" in said
    assert list(tmp_path.iterdir()) == []


def test_a_disk_that_is_full_at_first_costs_nothing(
    tmp_path, capsys, dummy, monkeypatch, any_length
):
    monkeypatch.setattr("sart_toolkit.record.window._SAVED_SHOWN", 0.0)
    attempts = []

    def save(path, demonstration):
        attempts.append(path)
        if len(attempts) == 1:
            raise CannotWrite(f"{path}: No space left on device; nothing was replaced")
        save_demonstration(path, demonstration)

    monkeypatch.setattr("sart_toolkit.cli.teleop.save_demonstration", save)
    dummy("right", "right", "right", "right", "right", "right")
    result(capsys, *RECORD, tmp_path / "d.h5", *BY_HAND)
    assert len(attempts) == 2 and len(load_demonstration(tmp_path / "d.h5")) == 2


def test_what_is_there_is_refused_before_the_window_opens(demo, tmp_path, capsys, dummy):
    assert "already exists; add --overwrite" in error(capsys, *RECORD, demo, *BY_HAND)
    assert "choose another --out" in error(capsys, *RECORD, demo / "x.h5", *BY_HAND)
    assert "already exists" in error(capsys, *RECORD, tmp_path / "d.h5", *BY_HAND, "--status", demo)
    assert load_demonstration(demo)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--device", "keybord"], "unknown device 'keybord': did you mean 'keyboard'"),
        (["--device", "spacemouse"], "no SpaceMouse found; plug it in"),
        (["--device", "gamepad"], "no gamepad found; plug it in"),
        (["--frame", "tool"], "--frame: is for a device that a person holds"),
        (["--operator", "Ada"], "--operator: is for a device that a person holds"),
        (["--status", "s"], "--status: is for a device that a person holds"),
        ([*BY_HAND, "--max-seconds", "0"], "max_seconds: expected a finite number > 0"),
        (["--max-seconds", "0.5"], "did not end within 0.5 s"),
    ],
)
def test_what_can_t_be_steered_with_is_one_line(tmp_path, capsys, dummy, options, message):
    assert message in error(capsys, *RECORD, tmp_path / "d.h5", *options)
    assert list(tmp_path.iterdir()) == []


def test_a_backend_that_draws_nothing_can_t_be_steered_by_hand(
    tmp_path, capsys, dummy, monkeypatch
):
    monkeypatch.setattr(PyBulletBackend, "no_images", "it has no eyes")
    said = error(capsys, *RECORD, tmp_path / "d.h5", *BY_HAND)
    assert "backend 'pybullet' takes no images: it has no eyes" in said


@pytest.mark.window
def test_ctrl_c_while_recording_ends_cleanly_and_leaves_nothing(tmp_path, wait_until):
    check_desktop()
    pytest.importorskip("pygame")
    out, status = tmp_path / "d.h5", tmp_path / "status.jsonl"
    with Desktop() as desktop:
        program = desktop.start([*SART, *RECORD, str(out), *BY_HAND, "--status", str(status)])
        desktop.window("sart record peg_in_hole")
        wait_until(lambda: bool(read_json_lines(status)))
        desktop.key("Right")
        wait_until(lambda: read_json_lines(status)[-1]["seconds"] > 0.2)
        program.send_signal(signal.SIGINT)
        said, errors = program.communicate(timeout=30)
    assert program.returncode == 130 and "Traceback" not in errors
    assert "nothing was written" in errors
    assert [path.name for path in tmp_path.iterdir()] == ["status.jsonl"]


# --- play ---------------------------------------------------------------------------------------


EPISODE = "episodes/demo00/sphere00_k00000.h5"


@pytest.fixture
def dataset(tmp_path, demo, peg_dataset):
    """A dataset's directory as far as `play` looks at it."""
    path = tmp_path / "data"
    (path / "sources" / "demo00").mkdir(parents=True)
    shutil.copy(demo, path / "sources" / "demo00" / "demo.h5")
    save_episode(path / EPISODE, peg_dataset.episode(0))
    return path


def frames_of(path):
    return imageio_ffmpeg.count_frames_and_secs(str(path))


def test_a_demonstration_becomes_a_film_of_its_length(demo, tmp_path, capsys):
    out = tmp_path / "film.mp4"
    said = result(capsys, "play", demo, "--out", out, "--camera", "wrist")
    frames, seconds = frames_of(out)
    assert frames == said["steps"] and seconds == pytest.approx(said["steps"] / 10, abs=0.05)
    result(capsys, "play", demo, "--out", out, "--camera", "wrist", "--speed", 2, "--overwrite")
    assert frames_of(out)[1] == pytest.approx(seconds / 2, abs=0.05)


def test_an_episode_becomes_a_film_with_the_demonstration_it_joins(dataset, tmp_path, capsys):
    out = tmp_path / "film.mp4"
    said = result(
        capsys, "play", dataset / EPISODE, "--out", out,
        "--camera", "wrist",
    )  # fmt: skip
    assert said["kind"] == "episode" and frames_of(out)[0] == said["steps"]


def test_what_can_t_be_played_is_one_line(demo, dataset, tmp_path, capsys):
    episode = dataset / EPISODE
    torn = tmp_path / "torn.h5"
    torn.write_bytes(demo.read_bytes()[:5000])
    text = tmp_path / "a.json"
    text.write_text("{}")
    stray = shutil.copy(episode, tmp_path / "stray.h5")
    for argv, message in (
        ([tmp_path / "nowhere.h5"], "nowhere.h5: no such file"),
        ([torn], "torn.h5: truncated"),
        ([text], "a.json: holds no recording"),
        ([dataset], "name one of its 1 episodes, such as"),
        ([demo.parent], "its demonstration is"),
        ([dataset / "episodes"], "is a directory; expected a demonstration's or an episode's"),
        ([stray], "play it inside its dataset directory"),
        ([demo, "--camera", "front"], "unknown camera 'front': choose from overview, wrist"),
        ([demo, "--backend", "bullet"], "unknown backend 'bullet': did you mean 'pybullet'"),
        ([demo, "--speed", "0"], "speed: expected a finite number > 0"),
        ([demo, "--out", tmp_path / "film.avi"], "expected a file name that ends in .mp4"),
        ([demo, "--out", tmp_path / "no" / "f.mp4", "--camera", "x"], "unknown camera 'x'"),
    ):
        assert message in error(capsys, "play", *argv)
    there = tmp_path / "there.mp4"
    there.write_text("mine")
    assert "already exists" in error(capsys, "play", demo, "--out", there)
    assert there.read_text() == "mine"


def test_an_episode_beside_another_demonstration_is_refused(dataset, capsys):
    main(["record", "peg_in_hole", "--seed", "5", "--image-size", "32", "--overwrite", "--out",
          str(dataset / "sources" / "demo00" / "demo.h5")])  # fmt: skip
    episode = dataset / EPISODE
    assert "was made from another demonstration" in error(capsys, "play", episode)


def test_keys_steer_the_playing_window(demo, capsys, dummy):
    dummy("space", "right", "right", "end", "home", "space", "escape")
    assert result(capsys, "play", demo)["kind"] == "demonstration"


@pytest.mark.window
def test_a_recording_is_shown_in_a_window_until_esc(demo):
    check_desktop()
    pytest.importorskip("pygame")
    with Desktop() as desktop:
        program = desktop.start([*SART, "play", str(demo), "--json"])
        desktop.window("sart play demo.h5")
        desktop.key("End", "Left", "Escape")
        said, errors = program.communicate(timeout=60)
    assert program.returncode == 0 and not errors
    assert json.loads(said)["kind"] == "demonstration"
