"""How many keys and how long annotating peg-in-hole takes, in the real window, by real keys.

`python tools/human_annotation.py` records a demonstration, opens `sart annotate` on a screen of
its own, once by hand and once with all suggested, and prints one JSON object as its last line.
`--pictures DIR` keeps pictures of the screen.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from sart_toolkit import doctor
from sart_toolkit.errors import Mismatch
from sart_toolkit.records import library_versions
from sart_toolkit.storage import load_annotation, load_demonstration, read_json_lines
from sart_toolkit.testing.desktop import Desktop

# X names of keys. By hand: a sphere at the start made larger in coarse steps, then a sphere at
# each convergence waypoint as far as there is room, save, leave.
BY_HAND = (
    "Return", *["Up"] * 8, *["c", "Return"] * 4, "w", "q",
)  # fmt: skip
SUGGESTED = ("a", "w", "q")
_SART = (sys.executable, "-c", "from sart_toolkit.cli import main; main()")


def annotate_by_keys(
    demo: Path, out: Path, keys: Sequence[str], pictures: Path | None = None
) -> dict[str, Any]:
    """What came of annotating a demonstration by pressing keys in the annotator's window.

    `presses`, `seconds` from the first key to the window's end (the next key is pressed once the
    one before has been done), `opening_seconds` before, and the `spheres` as they load again.

    Args:
        demo: the demonstration's file.
        out: the annotation to write; its journal tells when a key has been done.
        keys: X names of keys, which end with saving and leaving.
        pictures: folder for pictures of the screen before and after.

    Raises:
        Mismatch: the window ended in another way than well.
    """
    journal = out.with_name(f"{out.name}.journal")
    with Desktop() as screen:
        opened = time.perf_counter()
        program = screen.start([*_SART, "annotate", str(demo), "--out", str(out), "--json"])
        screen.window("sart annotate")
        started, paused = time.perf_counter(), 0.0
        for n, key in enumerate(keys, 1):
            if n == len(keys) and pictures is not None:
                # With the whole cloud and the ghosts, which wait until nothing is pressed.
                paused = time.perf_counter()
                time.sleep(3.0)
                screen.screenshot(pictures / f"annotate_{out.stem}.png")
                paused = time.perf_counter() - paused
            screen.key(key)
            while n < len(keys) and len(read_json_lines(journal)) < n + 1:
                if program.poll() is not None:
                    break
                time.sleep(0.01)
        said, errors = program.communicate(timeout=60)
        seconds = time.perf_counter() - started - paused
    if program.returncode != 0:
        raise Mismatch(f"the annotator ended with {program.returncode}: {errors[-300:]}")
    result = json.loads(said)
    annotation = load_annotation(out)
    annotation.check_matches(load_demonstration(demo))
    return {
        "presses": len(keys),
        "presses_counted_by_the_annotator": result["presses"],
        "seconds": round(seconds, 2),
        "opening_seconds": round(started - opened, 2),
        "seconds_spent_in_the_file": annotation.seconds,
        "spheres": [
            {"waypoint": s.waypoint, "radius_mm": round(1e3 * s.radius, 1), "source": s.source}
            for s in annotation.spheres
        ],
    }


def main() -> None:
    """Record, annotate twice, print."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--pictures", type=Path, help="folder for pictures of the screen")
    options = parser.parse_args()
    if options.pictures is not None:
        options.pictures.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as scratch:
        demo = Path(scratch) / "demo.h5"
        record = [*_SART, "record", "peg_in_hole", "--out", str(demo)]
        subprocess.run(record, check=True, stdout=sys.stderr)
        report: dict[str, Any] = {
            name: annotate_by_keys(demo, Path(scratch) / f"{name}.json", keys, options.pictures)
            for name, keys in (("by_hand", BY_HAND), ("suggested", SUGGESTED))
        }
    print(json.dumps(report | {"machine": doctor.machine(), "versions": library_versions()}))


if __name__ == "__main__":
    main()
