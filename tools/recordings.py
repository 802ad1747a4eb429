"""Which recording trains better: `python tools/recordings.py DIR --out recordings.json`.

For each task, seed and recording (segments recorded on the way out and reversed, or on the return)
a whole `sart run` in DIR: the same demonstration, spheres, draws, training seed and placements for
both. Interrupted, it resumes. Prints one JSON object.
"""

from __future__ import annotations

import argparse
import itertools
import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any, get_args

from sart_toolkit import doctor, pipeline
from sart_toolkit.data.records import Recording, library_versions
from sart_toolkit.data.schemas import EvaluationFile
from sart_toolkit.data.storage import read_json, write_json
from sart_toolkit.evaluate.statistics import wilson_interval


def main(arguments: Sequence[str] | None = None) -> int:
    """Run all cells and write what came of them."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("directory", type=Path, help="where the runs are")
    parser.add_argument("--tasks", default="toolbox_picking,bottle_placing,lid_closing")
    parser.add_argument("--seeds", default="101,102,103", help="of demonstrations and trainings")
    parser.add_argument("--n", type=int, default=40, help="trajectories")
    parser.add_argument("--episodes", type=int, default=50, help="rollouts")
    parser.add_argument("--epochs", type=int, help="of training; the policy's own if left out")
    parser.add_argument("--eval-seed", type=int, default=7100000, help="plus the seed: placements")
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--out", type=Path, help="JSON file to write")
    options = parser.parse_args(arguments)
    rows: list[dict[str, Any]] = []
    seeds = [int(seed) for seed in options.seeds.split(",")]
    for task, seed in itertools.product(options.tasks.split(","), seeds):
        for recording in get_args(Recording):
            out = options.directory / f"{task}-{seed}-{recording}"
            pipeline.run(
                task, out, recording=recording, n=options.n, episodes=options.episodes,
                epochs=options.epochs, seed=seed, eval_seed=options.eval_seed + seed,
                workers=options.workers, device="cpu",
            )  # fmt: skip
            found = read_json(out / "evaluation.json", EvaluationFile)
            row = {"task": task, "seed": seed, "recording": recording}
            row |= {name: found[name] for name in ("n_success", "n_episodes", "n_success_any")}
            rows.append(row)
            print(row, file=sys.stderr, flush=True)
    totals = {recording: _total(rows, recording) for recording in get_args(Recording)}
    arguments_ = {name: str(value) for name, value in vars(options).items() if name != "directory"}
    result = {
        "cells": rows,
        "totals": totals,
        "arguments": arguments_,
        "machine": doctor.machine(),
        "versions": library_versions(),
    }
    if options.out is not None:
        write_json(options.out, result)
    print(json.dumps(result))
    return 0


def _total(rows: Sequence[dict[str, Any]], recording: Recording) -> dict[str, Any]:
    """Successes of all cells of a recording, and between which numbers its cells lie."""
    counts = [row["n_success"] for row in rows if row["recording"] == recording]
    n = sum(row["n_episodes"] for row in rows if row["recording"] == recording)
    return {
        "n_success": sum(counts),
        "n_episodes": n,
        "ci95": list(wilson_interval(sum(counts), n)),
        "least_of_a_cell": min(counts),
        "most_of_a_cell": max(counts),
    }


if __name__ == "__main__":
    raise SystemExit(main())
