"""`python tools/kill.py`: kills `sart` at random moments, resumes it, and compares what comes out.

Only the process that was started is sent SIGKILL, as the kernel does where memory runs out. What it
started must end by itself, and the same command, typed again until it gets through, must leave
exactly what an uninterrupted one leaves. It prints a table; `--out` keeps the figures.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import shlex
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from sart_toolkit.data.dataset import load_dataset
from sart_toolkit.data.records import library_versions
from sart_toolkit.data.schemas import EvaluationFile
from sart_toolkit.data.storage import read_json, write_json
from sart_toolkit.doctor import machine
from sart_toolkit.errors import Mismatch

# How long [s] what a killed process had started may live on.
_GRACE = 5.0
# A checkpoint at nearly every step, so that there is something to resume in so short a training.
_SART = """
import sys
from sart_toolkit.cli import main
if sys.argv[1] == "train":
    from sart_toolkit.learn import training
    training._CHECKPOINT_SECONDS = 0.1
main()
"""


@dataclass(frozen=True)
class Subject:
    """A command to kill: its words, `OUT` for what it writes, and a hash of what that holds."""

    words: str
    out: str
    content_hash: Callable[[Path], str]

    def command(self, out: Path) -> list[str]:
        """The program and its arguments."""
        words = [str(out) if word == "OUT" else word for word in self.words.split()]
        return [sys.executable, "-c", _SART, *words]


def _digest(value: Any) -> str:
    return hashlib.sha256(json.dumps(value, sort_keys=True).encode()).hexdigest()


def _without(value: Any, *names: str) -> Any:
    """JSON without the figures that depend on the clock."""
    if isinstance(value, dict):
        return {k: _without(v, *names) for k, v in value.items() if k not in names}
    return [_without(each, *names) for each in value] if isinstance(value, list) else value


def _hash_of_dataset(path: Path) -> str:
    dataset = load_dataset(path)
    # Reading an episode compares it with its hash.
    return _digest([dataset.content_hash, [episode.content_hash() for episode in dataset]])


def _hash_of_weights(path: Path) -> str:
    return hashlib.sha256((path / "model.safetensors").read_bytes()).hexdigest()


def _hash_of_evaluation(path: Path) -> str:
    return _digest(_without(read_json(path, EvaluationFile), "seconds", "versions"))


def _hash_of_segments(path: Path) -> str:
    result = read_json(path, dict)
    kept = {key: result[key] for key in ("config", "total", "cells")}
    return _digest(_without(kept, "tries_per_second_and_process"))


SUBJECTS = {
    "augment": Subject(
        "augment demo.h5 annotation.json --out OUT --n 8 --workers 2", "dataset", _hash_of_dataset
    ),
    "train": Subject(
        "train dataset --out OUT --epochs 4 --image-size 48 --device cpu", "skill", _hash_of_weights
    ),
    "evaluate": Subject(
        "evaluate skill --out OUT --episodes 4 --videos 0 --workers 2",
        "evaluation.json",
        _hash_of_evaluation,
    ),
    "benchmark": Subject(
        "benchmark segments --tasks peg_in_hole --backends pybullet --count 12 --workers 2 "
        "--out OUT",
        "segments.json",
        _hash_of_segments,
    ),
}


def _start(command: Sequence[str], directory: Path) -> subprocess.Popen[bytes]:
    with open(directory / "said.txt", "wb") as said:
        return subprocess.Popen(
            command, cwd=directory, stdout=said, stderr=said, start_new_session=True
        )


def _check(process: subprocess.Popen[bytes], directory: Path) -> None:
    said = (directory / "said.txt").read_text(errors="replace")
    # The one before was killed when all was written.
    done_before = process.returncode == 2 and "already exists; add --overwrite" in said
    if process.returncode and not done_before:
        raise Mismatch(f"it ended with exit status {process.returncode}: {said[-2000:]}")


def living(session: int) -> list[int]:
    """The processes of a session, those that have ended but were not waited for left out."""
    found = []
    for stat in Path("/proc").glob("[0-9]*/stat"):
        try:
            # After the program's name in parentheses: state, parent, group, session.
            state, _, _, its_session, *_ = stat.read_text().rpartition(")")[2].split()
        except OSError:
            continue
        if int(its_session) == session and state not in "ZX":
            found.append(int(stat.parent.name))
    return found


def _seconds_until_none(session: int) -> float:
    """How long processes of a session live on.

    Raises:
        Mismatch: longer than is allowed.
    """
    began = time.perf_counter()
    while left := living(session):
        if time.perf_counter() - began > _GRACE:
            raise Mismatch(f"processes {left} are alive {_GRACE:g} s after their parent was killed")
        time.sleep(0.01)
    return time.perf_counter() - began


def kill(
    name: str, subject: Subject, directory: Path, kills: int, rng: np.random.Generator
) -> dict[str, Any]:
    """What came of killing a command so often.

    Raises:
        Mismatch: it left a process, could not be resumed, or ended with something else than the
            uninterrupted one.
    """
    began = time.perf_counter()
    process = _start(subject.command(directory / subject.out), directory)
    process.wait()
    _check(process, directory)
    whole_seconds = time.perf_counter() - began
    expected = subject.content_hash(directory / subject.out)
    moments: list[float] = []
    lingered: list[float] = []
    results = 0
    while len(moments) < kills or results == 0:
        results += 1
        out = directory / f"killed_{results}_{subject.out}"
        while True:
            process = _start(subject.command(out), directory)
            try:
                if len(moments) == kills:
                    process.wait()
                else:
                    moment = float(rng.uniform(0.0, whole_seconds))
                    process.wait(moment)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()
                moments.append(moment)
                lingered.append(_seconds_until_none(process.pid))
                print(f"{name}: killed {len(moments)} of {kills}", file=sys.stderr, flush=True)
                continue
            _check(process, directory)
            break
        found = subject.content_hash(out)
        if found != expected:
            raise Mismatch(f"{name}: result {results} differs: {found}, expected {expected}")
    return {
        "command": shlex.join(["sart", *subject.words.replace("OUT", subject.out).split()]),
        "content_hash": expected,
        "seconds_uninterrupted": whole_seconds,
        "kills": len(moments),
        "killed_after_seconds": moments,
        "results": results,
        "results_that_differ": 0,
        "processes_left": 0,
        "longest_until_none_seconds": max(lingered, default=0.0),
    }


def main(arguments: Sequence[str] | None = None) -> None:
    """Kill each command so often, and write what came of it."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--kills", type=int, default=20, help="of each command")
    parser.add_argument("--only", choices=SUBJECTS, help="one of the commands")
    parser.add_argument("--seed", type=int, default=0, help="of the moments")
    parser.add_argument("--out", type=Path, help="JSON file to write")
    options = parser.parse_args(arguments)
    # The same threads each time: their number decides how sums are rounded.
    os.environ["OMP_NUM_THREADS"] = "1"
    table: dict[str, Any] = {}
    with tempfile.TemporaryDirectory() as scratch:
        directory = Path(scratch)
        for words in (
            "record peg_in_hole --image-size 48 --out demo.h5",
            "suggest demo.h5 --out annotation.json",
        ):
            process = _start([sys.executable, "-c", _SART, *words.split()], directory)
            process.wait()
            _check(process, directory)
        for number, (name, subject) in enumerate(SUBJECTS.items()):
            kills = options.kills if options.only in (None, name) else 0
            rng = np.random.default_rng([options.seed, number])
            row = kill(name, subject, directory, kills, rng)
            if kills:
                table[name] = row
            if options.only == name:
                break
    print(f"{'command':<12}{'kills':>6}{'results':>9}{'differ':>8}{'last process after':>20}")
    for name, row in table.items():
        last = f"{row['longest_until_none_seconds']:.2f} s"
        print(f"{name:<12}{row['kills']:>6}{row['results']:>9}{0:>8}{last:>20}")
    if options.out is not None:
        write_json(options.out, {
            "command": shlex.join(["python", "tools/kill.py", *sys.argv[1:]]),
            "seed": options.seed,
            "cells": table,
            "versions": library_versions(),
            "machine": machine(),
        })  # fmt: skip


if __name__ == "__main__":
    main()
