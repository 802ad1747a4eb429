"""`sart annotate` in words, from a pipe and from a terminal, headless, and with wrong input."""

from __future__ import annotations

import io
import json
import os
import pty
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from sart_toolkit.cli import main
from sart_toolkit.data.records import Demonstration
from sart_toolkit.data.storage import (
    load_annotation,
    load_demonstration,
    save_annotation,
    save_demonstration,
)

SART = [sys.executable, "-c", "from sart_toolkit.cli import main; main()", "annotate"]


@pytest.fixture(scope="module")
def recorded(tmp_path_factory, peg_demonstration: Demonstration) -> Path:
    path = tmp_path_factory.mktemp("annotate") / "demo.h5"
    save_demonstration(path, peg_demonstration)
    return path


@pytest.fixture
def demo(recorded, tmp_path) -> Path:
    return Path(shutil.copy(recorded, tmp_path / "demo.h5"))


@pytest.fixture
def annotate(capsys, monkeypatch):
    """Runs the verb with words piped in; its result, and what it said."""

    def run(*argv, words=""):
        monkeypatch.setattr(sys, "stdin", io.StringIO(words))
        capsys.readouterr()
        main(["annotate", *map(str, argv), "--json"])
        out, err = capsys.readouterr()
        return json.loads(out.strip().splitlines()[-1]), err

    return run


@pytest.fixture
def refused(capsys, monkeypatch):
    """Runs the verb, which should fail with code 2; the last line that it said."""

    def run(*argv, words=""):
        monkeypatch.setattr(sys, "stdin", io.StringIO(words))
        with pytest.raises(SystemExit) as exit_:
            main(["annotate", *map(str, argv)])
        assert exit_.value.code == 2
        return capsys.readouterr().err.strip().splitlines()[-1]

    return run


def test_all_suggested_and_saved_at_once_without_a_window(annotate, demo, peg_annotation):
    result, _ = annotate(demo, "--suggest-all", "--no-window")
    saved = load_annotation(demo.with_name("demo.annotation.json"))
    saved.check_matches(load_demonstration(demo))
    assert [s.waypoint for s in saved.spheres] == [s.waypoint for s in peg_annotation.spheres]
    assert [s.radius for s in saved.spheres] == [s.radius for s in peg_annotation.spheres]
    assert result["saved"] and result["presses"] == 2
    assert [s["waypoint"] for s in result["spheres"]] == [s.waypoint for s in saved.spheres]
    assert sorted(os.listdir(demo.parent)) == ["demo.annotation.json", "demo.h5"]


def test_words_and_keys_from_a_pipe_are_done_in_turn(annotate, demo, tmp_path):
    out = tmp_path / "a.json"
    words = "add radius 90\nconverge Enter\n\ngo 3 A z list help\nsave\nquit\n"
    result, said = annotate(demo, "--text", "--out", out, words=words)
    spheres = load_annotation(out).spheres
    assert [(s.waypoint, s.source) for s in spheres][0] == (0, "human")
    assert spheres[0].radius == 0.09 and len(spheres) == 2 and result["saved"]
    assert "90.0 mm, by hand" in said and "suggest-all   A  suggest all" in said
    assert not out.with_name("a.json.journal").exists()

    result, _ = annotate(demo, "--text", "--out", out, words="remove save quit")
    assert len(result["spheres"]) == 1
    result, _ = annotate(demo, "--text", "--out", out, "--overwrite", words="S quit quit")
    assert not result["saved"] and len(load_annotation(out).spheres) == 1


def test_a_sphere_that_collides_is_named_when_saved_in_the_list_and_by_augment(
    annotate, demo, tmp_path, caplog, monkeypatch
):
    out = tmp_path / "a.json"
    words = "add go 26 add radius 60 list save quit"
    result, said = annotate(demo, "--text", "--out", out, words=words)
    listed = [line for line in said.splitlines() if line.startswith("   26  60.0 mm, by hand")]
    assert len(listed) == 1 and "colliding: up to" in listed[0]
    assert "NOT proved clear: waypoint 26, 60.0 mm: colliding: up to" in said
    assert [s["waypoint"] for s in result["spheres"]] == [0, 26]
    (named,) = result["not_proved_clear"]
    assert named.startswith("waypoint 26, 60.0 mm: colliding")

    class Reached(Exception):
        pass

    def engine(*_, **__):
        raise Reached

    monkeypatch.setattr("sart_toolkit.augment.engine.augment_sources", engine)
    with pytest.raises(Reached):
        main(["augment", str(demo), str(out), "--out", str(tmp_path / "d")])
    (warning,) = [r.getMessage() for r in caplog.records if "not proved" in r.getMessage()]
    assert warning.startswith("sphere not proved clear: waypoint 26, 60.0 mm: colliding: up to")
    # A suggested radius that was edited in the file is no longer backed either.
    annotate(demo, "--suggest-all", "--no-window", "--out", out, "--overwrite")
    value = json.loads(out.read_text())
    value["spheres"][1]["radius_m"] = value["spheres"][1]["clearance_m"] + 0.001
    out.write_text(json.dumps(value))
    caplog.clear()
    with pytest.raises(Reached):
        main(["augment", str(demo), str(out), "--out", str(tmp_path / "d")])
    (warning,) = [r.getMessage() for r in caplog.records if "not proved" in r.getMessage()]
    assert f"waypoint {value['spheres'][1]['waypoint']}, " in warning


def test_what_a_pipe_left_unsaved_is_gone_on_with(annotate, demo):
    result, said = annotate(demo, "--text", words="add grow")
    assert result == result | {"annotation": None, "saved": False, "presses": 2}
    assert "type the same command again" in said
    result, said = annotate(demo, "--text", words="save quit")
    assert "recovered the 2 key presses" in said
    assert result["spheres"][0]["radius_mm"] == 50 and result["presses"] == 4


def test_from_a_pipe_the_first_word_that_cannot_be_done_is_an_error(refused, demo):
    for words, message in [
        ("grow", "grow: no sphere at waypoint 0"),
        ("ad", "unknown action 'ad': did you mean 'add'"),
        ("radius", "radius: expected a number after it, got ''"),
        ("go x", "go: expected a number after it, got 'x'"),
        ("go 1000", "go: waypoint 1000: expected 0 to"),
    ]:
        assert message in refused(demo, "--text", words=words)


def test_at_a_terminal_mistakes_are_reported_and_ctrl_c_keeps_the_work(demo, wait_until):
    here, there = pty.openpty()
    process = subprocess.Popen(
        [*SART, str(demo), "--text"], stdin=there, stdout=there, stderr=there, close_fds=True
    )
    os.close(there)
    said = bytearray()

    def says(text):
        def look():
            while text not in said.decode(errors="replace"):
                said.extend(os.read(here, 4096))
            return True

        return look

    def type_(line, answer):
        said.clear()
        os.write(here, f"{line}\n".encode())
        says(answer)()

    says("annotate> ")()
    type_("grow", "add one first")
    type_("nonsense", "unknown action")
    type_("add", "added a sphere of 40 mm")
    type_("q", "aren't saved")
    said.clear()
    process.send_signal(signal.SIGINT)
    says("finished parts are kept, to resume type: sart annotate")()
    assert process.wait(30) == 130
    os.close(here)
    assert demo.with_name("demo.annotation.json.journal").exists()


def test_headless_nothing_is_replaced_unless_asked_for(annotate, refused, demo):
    headless = (demo, "--suggest-all", "--no-window")
    annotate(*headless)
    assert "already exists; add --overwrite" in refused(*headless)
    annotate(*headless, "--overwrite")
    annotate(demo, "--text", words="remove")
    assert "interrupted session's changes" in refused(*headless)
    annotate(*headless, "--overwrite")
    assert not demo.with_name("demo.annotation.json.journal").exists()


def test_without_a_display_the_headless_way_is_reported(refused, demo, monkeypatch):
    pytest.importorskip("open3d")
    monkeypatch.delenv("DISPLAY", raising=False)
    line = refused(demo)
    assert "no window: DISPLAY is not set" in line and "xvfb-run" in line
    assert "--text, or --suggest-all --no-window" in line
    assert os.listdir(demo.parent) == ["demo.h5"]


def test_wrong_input_is_one_line_and_leaves_nothing(refused, demo, tmp_path, peg_annotation):
    assert "add --suggest-all, or --text" in refused(demo, "--no-window")
    assert "no such file" in refused(tmp_path / "nowhere.h5", "--text")
    torn = tmp_path / "torn.h5"
    torn.write_bytes(demo.read_bytes()[:5000])
    assert "truncated or not a demonstration" in refused(torn, "--text")
    torn.unlink()
    assert "not a directory" in refused(demo, "--text", "--out", demo / "a.json")
    assert "margin" in refused(demo, "--text", "--margin", "-1")
    out = tmp_path / "other.json"
    out.write_text("{")
    assert "not readable as JSON" in refused(demo, "--text", "--out", out)
    out.unlink()
    save_annotation(out, type(peg_annotation)(peg_annotation.spheres, "0" * 64, settings={}))
    before = out.read_bytes()
    line = refused(demo, "--text", "--out", out)
    assert "another demonstration" in line and "start again with --overwrite" in line
    assert out.read_bytes() == before
    assert sorted(os.listdir(tmp_path)) == ["demo.h5", "other.json"]


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write anywhere")
def test_an_unwritable_place_is_reported_before_anything_is_asked(refused, demo, tmp_path):
    place = tmp_path / "place"
    place.mkdir(mode=0o500)
    assert "permission denied" in refused(demo, "--text", "--out", place / "a.json")


def test_spheres_can_be_annotated_from_the_recorded_images_alone(annotate, demo):
    result, said = annotate(demo, "--text", "--source", "cloud", words="suggest save quit")
    assert "peg / cloud" in said and result["saved"]


def test_the_verb_has_help_with_an_example(capsys):
    with pytest.raises(SystemExit) as exit_:
        main(["annotate", "--help"])
    assert exit_.value.code == 0
    assert "Example: sart annotate" in capsys.readouterr().out
