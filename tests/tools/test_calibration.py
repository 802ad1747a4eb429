"""`tools/calibration.py` compares calibrations with where the camera really was."""

from __future__ import annotations

import importlib.util
import json
from pathlib import Path

import numpy as np
import pytest

from sart_toolkit.calibrate.board import Board

pytest.importorskip("cv2")
_PATH = Path(__file__).parents[2] / "tools" / "calibration.py"
_SPEC = importlib.util.spec_from_file_location("calibration", _PATH)
assert _SPEC is not None and _SPEC.loader is not None
calibration = importlib.util.module_from_spec(_SPEC)
_SPEC.loader.exec_module(calibration)


def test_rectangles_tile_what_is_black():
    cells = Board().image(50) == 0
    covered = np.zeros(cells.shape, int)
    for r0, r1, c0, c1 in calibration.rectangles(cells):
        covered[r0:r1, c0:c1] += 1
    assert np.array_equal(covered, cells.astype(int))


def test_a_camera_whose_images_the_ray_caster_drew_is_found_within_what_is_declared():
    with calibration.drawing("raycast", Board()) as draw:
        row = calibration.measure(draw, "raycast", 0, 9, 0.01, given=True)
    assert row["covered"] and row["depth_covered"] and row["views"] == 9
    assert row["error_mm"] < 1.5 and row["rms_pixels"] < 0.5


@pytest.mark.slow
@pytest.mark.render
def test_so_is_one_whose_images_sapien_drew():
    with calibration.drawing("sapien", Board()) as draw:
        row = calibration.measure(draw, "sapien", 0, 10, 0.01, given=False)
    assert row["covered"] and row["depth_covered"] and row["error_mm"] < 2


@pytest.mark.parametrize("covered", [True, False])
def test_the_exit_code_says_whether_the_truth_is_covered(covered, tmp_path, monkeypatch, capsys):
    row = {
        "error_mm": 0.5, "declared_mm": 1.0, "error_deg": 0.1, "declared_deg": 0.2,
        "declared_depth_percent": 1.2, "covered": covered, "depth_covered": True,
    }  # fmt: skip
    monkeypatch.setattr(calibration, "measure", lambda *_: row)
    out = tmp_path / "calibration.json"
    code = calibration.main(["--out", str(out), "--draws", "2", "--by", "raycast"])
    assert code == (0 if covered else 1)
    told = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert told == json.loads(out.read_text())["summary"]
    assert (told["draws"], told["covered"]) == (2, 2 if covered else 0)
