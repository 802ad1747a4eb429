"""Build wheel and sdist, and let each prove itself in an empty environment: `make dist-check`.

Each is installed outside the checkout, with the versions of constraints.txt, and runs a whole
`sart run peg_in_hole` on a small budget from an empty folder.
"""

import os
import shutil
import subprocess
import sys
import tempfile
import time
import venv
from pathlib import Path

ROOT = Path(__file__).parents[1]
RUN = ["run", "peg_in_hole", "--out", "run", "--n", "6", "--epochs", "4", "--episodes", "2"]
PROBE = """
import sart_toolkit as sart
print(sart.__file__, sart.load_demonstration(sart.asset("peg_in_hole/demo.h5")).task, sep="\\n")
"""


def call(words: list[object], folder: Path) -> str:
    """What a program prints, run in a folder without the checkout on its path."""
    environment = {k: v for k, v in os.environ.items() if k != "PYTHONPATH"}
    done = subprocess.run(
        [str(word) for word in words], cwd=folder, env=environment, capture_output=True, text=True
    )
    if done.returncode != 0:
        sys.exit(f"{' '.join(map(str, words))}:\n{done.stdout}\n{done.stderr}")
    return done.stdout


def python_of(environment: Path) -> Path:
    """The interpreter of a new, empty environment."""
    venv.create(environment, with_pip=True)
    return environment / "bin" / "python"


def tracked_copy(target: Path) -> Path:
    """What git tracks, as it is in the working tree: builds leave nothing in the checkout."""
    for name in call(["git", "ls-files", "-z"], ROOT).split("\0"):
        if name and (ROOT / name).is_file():
            (target / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(ROOT / name, target / name)
    return target


def check(archive: Path, scratch: Path) -> None:
    """Install an archive and use it; exits with what went wrong."""
    started = time.perf_counter()
    python = python_of(scratch / f"env-{archive.suffix[1:]}")
    call([python, "-m", "pip", "install", "-q", "-c", ROOT / "constraints.txt", archive], scratch)
    installed = time.perf_counter()
    empty = scratch / f"empty-{archive.suffix[1:]}"
    empty.mkdir()
    home, task = call([python, "-c", PROBE], empty).split()
    if not Path(home).is_relative_to(scratch) or task != "peg_in_hole":
        sys.exit(f"{archive.name}: imported {home}, its demonstration is of {task!r}")
    call([python.with_name("sart"), *RUN], empty)
    page = empty / "run" / "report.html"
    if not page.is_file():
        sys.exit(f"{archive.name}: `sart run` left no report")
    print(
        f"{archive.name}: {archive.stat().st_size / 1e6:.1f} MB, installed in "
        f"{installed - started:.0f} s, `sart {' '.join(RUN)}` in "
        f"{time.perf_counter() - installed:.0f} s, report of {page.stat().st_size / 1e6:.1f} MB"
    )


def main() -> None:
    """Build both, check both."""
    with tempfile.TemporaryDirectory(prefix="sart-dist-") as folder:
        scratch = Path(folder)
        builder = python_of(scratch / "builder")
        call([builder, "-m", "pip", "install", "-q", "build"], scratch)
        source = tracked_copy(scratch / "source")
        call([builder, "-m", "build", "--outdir", scratch / "dist", source], scratch)
        for archive in sorted((scratch / "dist").iterdir()):
            check(archive, scratch)


if __name__ == "__main__":
    main()
