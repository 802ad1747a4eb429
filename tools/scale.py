"""Generate many episodes and see what grows: `python tools/scale.py --episodes 10000 --out F.json`.

The engine generates them as `sart augment` does. Progress goes to stderr.
"""

from __future__ import annotations

import argparse
import functools
import json
import resource
import statistics
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from bench import augmentation

from sart_toolkit import doctor
from sart_toolkit.augment.config import AugmentConfig
from sart_toolkit.augment.engine import augment_demonstration
from sart_toolkit.data.dataset import load_dataset
from sart_toolkit.data.records import library_versions
from sart_toolkit.data.storage import write_json
from sart_toolkit.errors import SartError
from sart_toolkit.poses import check_positive
from sart_toolkit.tasks import TASKS

_POINTS = 50


def measure(options: argparse.Namespace, folder: Path) -> dict[str, Any]:
    """Rate and memory over time, and what opening, resuming and reading the dataset takes."""
    demonstration, annotation, make = augmentation(options.task, options.image_size)
    cameras = None if options.images else ()
    courses: list[list[dict[str, float]]] = []
    # Spheres come one after the other and don't take equally long, so that only a smaller dataset
    # with as many parts tells what growing costs.
    tenth = max(1, options.episodes // 10)
    for path, episodes in ((folder / "tenth", tenth), (folder / "whole", options.episodes)):
        config = AugmentConfig(episodes + 1, cameras=cameras)
        make_it = functools.partial(
            augment_demonstration, demonstration, annotation, make, path, config, options.workers
        )
        courses.append([])
        generated, dataset = _timed(make_it, progress=_Course(courses[-1], episodes))
    course_of_tenth, course = courses
    rows = max(1, len(course) // 10)
    opening, _ = _timed(functools.partial(load_dataset, path))
    resuming, _ = _timed(make_it)
    reading, _ = _timed(lambda: [episode.provenance.k for episode in dataset])
    sizes = [file.stat().st_size for file in path.rglob("*") if file.is_file()]
    return {
        "task": options.task,
        "images": options.images,
        "image_size": options.image_size,
        "workers": options.workers,
        "kept": len(dataset),
        "attempted": dataset.info["n_attempted"],
        "generating_seconds": generated,
        "kept_per_second": len(dataset) / generated,
        # Of the last tenth, over that of a dataset of a tenth as many: 1 where size costs nothing.
        "last_rate_over_tenth": _last_rate(course, rows) / _last_rate(course_of_tenth, rows),
        "memory_growth_mb": course[-1]["memory_mb"]
        - course[min(rows, len(course) - 1)]["memory_mb"],
        "peak_memory_mb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
        "size_mb": sum(sizes) / 2**20,
        "kilobytes_per_episode": sum(sizes) / len(dataset) / 1000,
        "opening_seconds": opening,
        "resuming_finished_seconds": resuming,
        "reading_seconds": reading,
        "course": course,
        "course_of_tenth": course_of_tenth,
    }


def _last_rate(course: Sequence[dict[str, float]], rows: int) -> float:
    return statistics.median(row["kept_per_second"] for row in course[-rows:])


class _Course:
    """Notes rate and memory in a list as trajectories are kept."""

    def __init__(self, course: list[dict[str, float]], episodes: int) -> None:
        self._course, self._every = course, max(1, episodes // _POINTS)
        self._started = self._last = time.perf_counter()

    def __call__(self, kept: int, wanted: int, rejected: int) -> None:
        before = int(self._course[-1]["kept"]) if self._course else 0
        if kept % self._every or kept == before:
            return
        now = time.perf_counter()
        row = {
            "kept": kept,
            "seconds": now - self._started,
            "kept_per_second": (kept - before) / (now - self._last),
            "memory_mb": _memory_mb(),
        }
        self._course.append(row)
        self._last = now
        print(
            f"{kept}/{wanted}, {rejected} rejected, {row['kept_per_second']:.1f}/s, "
            f"{row['memory_mb']:.0f} MB",
            file=sys.stderr,
            flush=True,
        )


def _timed(function: Any, **arguments: Any) -> tuple[float, Any]:
    started = time.perf_counter()
    result = function(**arguments)
    return time.perf_counter() - started, result


def _memory_mb() -> float:
    """What this process has in memory, of Linux's table."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * resource.getpagesize() / 2**20


def main(arguments: Sequence[str] | None = None) -> int:
    """The exit code of one measurement, whose JSON object is written and printed."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--episodes", type=int, default=10_000)
    parser.add_argument("--images", action="store_true", help="record RGB and depth")
    parser.add_argument("--image-size", type=int, default=128, help="[pixels]")
    parser.add_argument("--task", default="peg_in_hole", help=", ".join(TASKS))
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--folder", type=Path, help="where the dataset goes; a temporary one")
    parser.add_argument("--out", type=Path, help="JSON file to write; none if left out")
    options = parser.parse_args(arguments)
    try:
        check_positive("--episodes", options.episodes)
        if options.folder is not None:
            options.folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=options.folder) as scratch:
            figures = measure(options, Path(scratch) / "dataset")
        report = {"figures": figures, "machine": doctor.machine(), "versions": library_versions()}
        if options.out is not None:
            write_json(options.out, report, sealed=False)
    except (SartError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    print(json.dumps(report))
    return 0


if __name__ == "__main__":
    sys.exit(main())
