"""The annotator's programs: the thin one, and the one that presses the keys."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

from sart_toolkit.storage import load_annotation, save_demonstration
from sart_toolkit.testing.desktop import check_desktop

TOOLS = Path(__file__).parents[2] / "tools"


def test_the_thin_program_is_the_verb(tmp_path, peg_demonstration):
    save_demonstration(tmp_path / "demo.h5", peg_demonstration)
    done = subprocess.run(
        [sys.executable, TOOLS / "annotate.py", tmp_path / "demo.h5", "--suggest-all",
         "--no-window", "--json"],
        capture_output=True, text=True, check=True,
    )  # fmt: skip
    assert json.loads(done.stdout.splitlines()[-1])["saved"]
    load_annotation(tmp_path / "demo.annotation.json").check_matches(peg_demonstration)


@pytest.mark.window
@pytest.mark.slow
def test_peg_in_hole_is_annotated_by_few_keys(tmp_path):
    pytest.importorskip("open3d")
    check_desktop()
    done = subprocess.run(
        [sys.executable, TOOLS / "human_annotation.py", "--pictures", tmp_path],
        capture_output=True, text=True, check=True,
    )  # fmt: skip
    report = json.loads(done.stdout.splitlines()[-1])
    assert report["by_hand"]["presses"] <= 25 and report["suggested"]["presses"] <= 3
    for name, source in (("by_hand", "human"), ("suggested", "suggested")):
        row = report[name]
        assert row["presses_counted_by_the_annotator"] == row["presses"]
        assert {sphere["source"] for sphere in row["spheres"]} == {source}
        assert row["seconds"] > 0 and len(row["spheres"]) > 1
        assert (tmp_path / f"annotate_{name}.png").stat().st_size > 10_000
