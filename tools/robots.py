"""Which arms work, end to end: `python tools/robots.py --episodes 20 --out F.json`.

Each is examined as by `sart doctor --robot`, then the scripted operator puts the peg in its hole on
both simulators, and spheres are suggested for one of its demonstrations and trajectories generated.
A row is written as soon as it is known; those in the file already are kept.
"""

from __future__ import annotations

import argparse
import functools
import json
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from arms import ARMS

from sart_toolkit import pipeline
from sart_toolkit.backends import get_backend
from sart_toolkit.benchmark.cells import Cell
from sart_toolkit.benchmark.operator import BenchmarkConfig, benchmark_operator
from sart_toolkit.bringup.examine import examine
from sart_toolkit.data.records import library_versions
from sart_toolkit.data.storage import write_json
from sart_toolkit.errors import SartError
from sart_toolkit.robots import ROBOTS, get_robot
from sart_toolkit.robots.spec import RobotSpec
from sart_toolkit.tasks import get_task

TASK = "peg_in_hole"


def row_of(robot: RobotSpec, episodes: int, n: int) -> dict[str, Any]:
    """What came of a robot, step by step; a step that fails says why, and those after it go on."""
    row: dict[str, Any] = {"joints": len(robot.arm_joints), "urdf": robot.urdf.partition(":")[0]}
    started = time.perf_counter()
    findings = examine(robot)
    row["doctor"] = {
        "usable": all(f.ok or not f.required for f in findings),
        "to_look_at": [f"{f.name}: {f.detail}" for f in findings if not f.ok],
        "seconds": round(time.perf_counter() - started, 1),
    }
    task = get_task(TASK)
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        for backend in ("pybullet", "sapien"):
            make = functools.partial(get_backend(backend), robot, task.scene)
            cell = Cell(task, backend, make)
            out = folder / f"{backend}.json"
            found = benchmark_operator([cell], BenchmarkConfig(episodes), out)["cells"]
            (summary,) = found.values()
            reasons = {str(each["reason"])[:120] for each in summary["failures"]}
            row[f"operator_{backend}"] = {
                "succeeded": summary["n_success"],
                "episodes": episodes,
                "reasons": sorted(reasons),
            }
        row["pipeline"] = _generated(robot, folder, n)
    return row


def _generated(robot: RobotSpec, folder: Path, n: int) -> dict[str, Any]:
    """Spheres suggested for a demonstration, and how many attempts gave a trajectory."""
    demo, spheres = folder / "demo.h5", folder / "annotation.json"
    try:
        started = time.perf_counter()
        pipeline.record(TASK, demo, robot=robot, image_size=32)
        recorded = time.perf_counter()
        annotation = pipeline.suggest(demo, spheres, robot=robot)
        suggested = time.perf_counter()
        dataset = pipeline.augment(demo, spheres, folder / "data", robot=robot, n=n, cameras=())
    except SartError as error:
        return {"failed": str(error)}
    return {
        "record_seconds": round(recorded - started, 1),
        "suggest_seconds": round(suggested - recorded, 1),
        "spheres": len(annotation.spheres),
        "radii_mm": [round(sphere.radius * 1e3) for sphere in annotation.spheres],
        "augment_seconds": round(time.perf_counter() - suggested, 1),
        "kept": len(dataset),
        "attempted": len(dataset) + len(dataset.rejected),
    }


def main(argv: Sequence[str] | None = None) -> int:
    """Fill the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, required=True, help="JSON file to write")
    parser.add_argument("--episodes", type=int, default=20, help="of the operator, per simulator")
    parser.add_argument("-n", type=int, default=20, help="trajectories to generate")
    parser.add_argument("--robots", help="names, separated by commas; all if left out")
    options = parser.parse_args(argv)
    robots = [get_robot(name) for name in ROBOTS] + list(ARMS)
    chosen = options.robots.split(",") if options.robots else [robot.name for robot in robots]
    rows = json.loads(options.out.read_text())["robots"] if options.out.exists() else {}
    for robot in robots:
        if robot.name not in chosen or robot.name in rows:
            continue
        started = time.perf_counter()
        try:
            rows[robot.name] = row_of(robot, options.episodes, options.n)
        except SartError as error:
            rows[robot.name] = {"failed": str(error)}
        rows[robot.name]["seconds"] = round(time.perf_counter() - started, 1)
        settings = {"task": TASK, "episodes": options.episodes, "n": options.n}
        write_json(options.out, {**settings, "robots": rows, "versions": library_versions()})
        print(robot.name, json.dumps(rows[robot.name]), file=sys.stderr, flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
