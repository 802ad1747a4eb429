"""Record the demonstration in `assets/` again: `python tools/make_assets.py`."""

from pathlib import Path

from sart_toolkit.cli import main

FOLDER = Path(__file__).parents[1] / "assets" / "peg_in_hole"
IMAGE_SIZE = 64

if __name__ == "__main__":
    demo, annotation = str(FOLDER / "demo.h5"), str(FOLDER / "annotation.json")
    main(["record", "peg_in_hole", "--out", demo, "--image-size", str(IMAGE_SIZE), "--overwrite"])
    main(["suggest", demo, "--out", annotation, "--overwrite"])
