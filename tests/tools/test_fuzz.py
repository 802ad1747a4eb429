"""Damaged files: a thousand of the mutations of `tools/fuzz.py`, the same each time."""

from __future__ import annotations

import importlib.util
import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from sart_toolkit.errors import BrokenFile

ROOT = Path(__file__).parents[2]
FUZZ = ROOT / "tools" / "fuzz.py"


@pytest.fixture(scope="module")
def fuzz():
    """The program, as a module."""
    spec = importlib.util.spec_from_file_location("fuzz", FUZZ)
    module = importlib.util.module_from_spec(spec)
    sys.modules["fuzz"] = module
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def thousand(tmp_path_factory):
    """What came of the first thousand mutations."""
    out = tmp_path_factory.mktemp("fuzz") / "fuzz.json"
    words = [sys.executable, str(FUZZ), "--count", "1000", "--out", str(out)]
    done = subprocess.run(words, capture_output=True, text=True, env={**os.environ})
    assert out.exists(), done.stderr[-3000:]
    found = json.loads(out.read_text())
    assert done.returncode == (found["n_failures"] > 0)
    return found


def test_each_of_a_thousand_damaged_files_is_refused_or_read_as_it_was(thousand):
    assert [row for row in thousand["failures"] if row["loader"] != "urdf"] == []
    assert sum(row["mutations"] for row in thousand["loaders"].values()) == 1000
    for row in thousand["loaders"].values():
        # Most of what is damaged is seen to be; a URDF has no hash.
        assert row["refused"] > 0.3 * row["mutations"] > 0


def test_each_damaged_urdf_is_a_robot_or_refused(thousand):
    assert [row for row in thousand["failures"] if row["loader"] == "urdf"] == []


@pytest.fixture
def bench(fuzz, tmp_path, monkeypatch):
    """Whole files of each kind."""
    monkeypatch.setenv("SART_CACHE", str(tmp_path / "cache"))
    return fuzz.Bench(tmp_path)


def test_a_mutation_is_the_same_each_time(bench):
    def once(i):
        row = bench.run(7, i)
        files = {p.name: p.read_bytes() for p in (bench.root / "damaged").rglob("*") if p.is_file()}
        return row["mutation"], row["outcome"], files

    assert [once(i) for i in range(12)] == [once(i) for i in range(12)]


@pytest.mark.parametrize(
    ("behaves", "outcome"),
    [
        (lambda whole: whole, "equal"),
        (lambda whole: {**whole, "covered": "other"}, "different, a hash covers"),
        (lambda whole: {**whole, "rest": "other"}, "different, a hash covers"),
        (lambda whole: [][1], "untyped"),
        (lambda whole: bytearray(10**9), "memory"),
    ],
)
def test_what_a_loader_does_wrong_is_counted_as_that(bench, fuzz, behaves, outcome):
    whole = bench.whole["episode"]
    loader = fuzz.Loader("episode", lambda at: behaves(whole))
    assert bench._read(loader, bench.root, "a flip", False)["outcome"] == outcome


def test_what_only_the_forged_hash_covered_is_counted_apart(bench, fuzz):
    whole = bench.whole["demonstration"]
    loader = fuzz.Loader("demonstration", lambda at: {**whole, "rest": "other"})
    assert bench._read(loader, bench.root, "x", True)["outcome"] == "different, no hash covers"


def test_a_refusal_for_want_of_memory_and_a_slow_one_are_failures(bench, fuzz, monkeypatch):
    def refuse(at):
        try:
            bytearray(10**9)
        except MemoryError as error:
            raise BrokenFile("x: broken") from error

    loader = fuzz.Loader("episode", refuse)
    assert bench._read(loader, bench.root, "x", False)["outcome"] == "memory"
    monkeypatch.setattr(fuzz, "SECONDS", -1.0)
    loader = fuzz.Loader("episode", lambda at: bench.whole["episode"])
    assert bench._read(loader, bench.root, "x", False)["outcome"] == "slow"


def test_a_process_that_crashes_or_hangs_is_replaced_and_counted(fuzz, tmp_path, monkeypatch):
    crash = f"""
import os, sys, time
sys.path.insert(0, {str(FUZZ.parent)!r})
import fuzz
def read(self, seed, i):
    if i == 1: os.kill(os.getpid(), 11)
    if i == 2: time.sleep(100)
    return {{"i": i, "loader": "urdf", "mutation": "", "outcome": "equal", "seconds": 0.0}}
fuzz.Bench.run = read
fuzz.make_files = lambda root: None
fuzz.LOADERS = ()
fuzz.serve()
"""
    program = tmp_path / "crash.py"
    program.write_text(crash)
    monkeypatch.setattr(fuzz, "__file__", str(program))
    monkeypatch.setattr(fuzz, "PATIENCE_SECONDS", 1.0)
    process = fuzz.Process()
    outcomes = [row["outcome"] for row in process.rows(0, 0, 4)]
    process.close()
    assert outcomes == ["equal", "crashed", "slow", "equal"]
