"""Generate many episodes and see what grows: `python tools/scale.py --episodes 10000 --out F.json`.

The engine generates them as `sart augment` does. Progress goes to stderr.
"""

from __future__ import annotations

import argparse
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
    config = AugmentConfig(options.episodes + 1, cameras=cameras)
    every = max(1, options.episodes // _POINTS)
    course: list[dict[str, float]] = []
    started = last = time.perf_counter()

    def progress(kept: int, wanted: int, rejected: int) -> None:
        nonlocal last
        if kept % every or (course and kept == course[-1]["kept"]):
            return
        now = time.perf_counter()
        done = kept - (course[-1]["kept"] if course else 0)
        course.append(
            {
                "kept": kept,
                "seconds": now - started,
                "kept_per_second": done / (now - last),
                "memory_mb": _memory_mb(),
            }
        )
        last = now
        print(
            f"{kept}/{wanted}, {rejected} rejected, {course[-1]['kept_per_second']:.1f}/s, "
            f"{course[-1]['memory_mb']:.0f} MB",
            file=sys.stderr,
            flush=True,
        )

    dataset = augment_demonstration(
        demonstration, annotation, make, folder, config, options.workers, progress=progress
    )
    generated = time.perf_counter() - started
    # The first part starts a simulator and builds what the proofs need.
    tenth = max(1, len(course) // 10)
    rates = [row["kept_per_second"] for row in course[1:]]
    opening, _ = _timed(load_dataset, folder)
    resuming, _ = _timed(
        augment_demonstration, demonstration, annotation, make, folder, config, options.workers
    )
    reading, _ = _timed(lambda: [episode.provenance.k for episode in dataset])
    sizes = [path.stat().st_size for path in folder.rglob("*") if path.is_file()]
    return {
        "task": options.task,
        "images": options.images,
        "image_size": options.image_size,
        "workers": options.workers,
        "kept": len(dataset),
        "attempted": dataset.info["n_attempted"],
        "generating_seconds": generated,
        "kept_per_second": len(dataset) / generated,
        # 1 where the last tenth is as fast as the first.
        "last_over_first_rate": statistics.median(rates[-tenth:]) / statistics.median(rates[:tenth])
        if rates
        else None,
        "memory_growth_mb": course[-1]["memory_mb"]
        - course[min(tenth, len(course) - 1)]["memory_mb"]
        if course
        else None,
        "peak_memory_mb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
        "size_mb": sum(sizes) / 2**20,
        "kilobytes_per_episode": sum(sizes) / len(dataset) / 1000,
        "opening_seconds": opening,
        "resuming_finished_seconds": resuming,
        "reading_seconds": reading,
        "course": course,
    }


def _timed(function: Any, *arguments: Any) -> tuple[float, Any]:
    started = time.perf_counter()
    result = function(*arguments)
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
        with tempfile.TemporaryDirectory(dir=options.folder) as scratch:
            figures = measure(options, Path(scratch) / "dataset")
        report = {"figures": figures, "machine": doctor.machine(), "versions": library_versions()}
        if options.out is not None:
            write_json(options.out, report, sealed=False)
    except SartError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    print(json.dumps(report))
    return 0


if __name__ == "__main__":
    sys.exit(main())
