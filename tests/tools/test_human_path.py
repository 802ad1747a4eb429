import importlib.util
import json
from pathlib import Path

import pytest
from PIL import Image

from sart_toolkit.data.storage import load_annotation, load_demonstration, save_demonstration
from sart_toolkit.testing.desktop import check_desktop

_PATH = Path(__file__).parents[2] / "tools" / "human_path.py"
_SPEC = importlib.util.spec_from_file_location("human_path", _PATH)
assert _SPEC is not None and _SPEC.loader is not None
human_path = importlib.util.module_from_spec(_SPEC)
_SPEC.loader.exec_module(human_path)


@pytest.mark.window
def test_a_demonstration_is_recorded_by_keys_alone_in_the_real_window(tmp_path, capsys):
    check_desktop()
    pytest.importorskip("pygame")
    assert human_path.main([str(tmp_path), "--stages", "record"]) == 0
    assert "record " in capsys.readouterr().out
    demo = load_demonstration(tmp_path / "demo.h5")
    assert demo.success[-10:].all() and demo.device == "keyboard"
    assert demo.operator == "scripted input"
    assert demo.seconds >= demo.timestamps[-1] * 0.9
    for state in ("ready", "recording", "ended", "saved"):
        with Image.open(tmp_path / "images" / f"record_{state}.png") as image:
            assert image.size == (1280, 800)
    rows = [json.loads(line) for line in (tmp_path / "status.jsonl").read_text().splitlines()]
    assert [rows[0]["state"], rows[-1]["state"]] == ["ready", "saved"]


@pytest.mark.window
def test_peg_in_hole_is_annotated_by_few_keys(tmp_path, peg_demonstration):
    pytest.importorskip("open3d")
    check_desktop()
    save_demonstration(tmp_path / "demo.h5", peg_demonstration)
    assert human_path.main([str(tmp_path), "--stages", "annotate", "suggest"]) == 0
    report = json.loads((tmp_path / "human_path.json").read_text())["stages"]
    assert report["annotate"]["presses"] <= 25 and report["suggest"]["presses"] <= 3
    for stage, name, source in (
        ("annotate", "annotation", "human"),
        ("suggest", "suggested", "suggested"),
    ):
        row = report[stage]
        assert row["presses_counted_by_the_annotator"] == row["presses"]
        assert {sphere["source"] for sphere in row["spheres"]} == {source}
        assert row["seconds"] > 0 and len(row["spheres"]) > 1
        load_annotation(tmp_path / f"{name}.json").check_matches(peg_demonstration)
        assert (tmp_path / "images" / f"annotate_{name}.png").stat().st_size > 10_000


def test_a_stage_that_lacks_what_an_earlier_one_leaves_is_an_error(tmp_path, capsys):
    assert human_path.main([str(tmp_path), "--stages", "train"]) == 2
    assert "sart train ended with 2" in capsys.readouterr().err


def test_an_unknown_task_is_one_line_and_exit_code_2(tmp_path, capsys):
    assert human_path.main([str(tmp_path), "--task", "peg"]) == 2
    out, err = capsys.readouterr()
    assert not out and "unknown task 'peg'" in err and len(err.splitlines()) == 1


def test_an_unknown_stage_is_one_line_and_exit_code_2(tmp_path, capsys):
    assert human_path.main([str(tmp_path), "--stages", "recrod"]) == 2
    out, err = capsys.readouterr()
    assert not out and "unknown stage 'recrod': did you mean 'record'" in err
