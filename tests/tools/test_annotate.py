"""The thin program over `sart annotate`."""

import json
import subprocess
import sys
from pathlib import Path

from sart_toolkit.data.storage import load_annotation, save_demonstration

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
