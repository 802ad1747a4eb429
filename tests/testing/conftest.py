"""Runs the contract suite as its users do: in a process of its own, from another folder."""

from __future__ import annotations

import os
import subprocess
import sys
import xml.etree.ElementTree as ET
from collections import defaultdict
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import pytest

from sart_toolkit.backends import DEFAULT_BACKEND

ROOT = Path(__file__).parents[2]


@dataclass
class Outcome:
    """Of one backend: the tests that failed and why, those skipped and why, how many passed."""

    failed: dict[str, str] = field(default_factory=dict)
    skipped: dict[str, str] = field(default_factory=dict)
    passed: int = 0


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Leave out what is slow here unless it is asked for: `-m slow`."""
    if config.getoption("-m"):
        return
    here = Path(__file__).parent
    slow = [i for i in items if i.path.is_relative_to(here) and i.get_closest_marker("slow")]
    config.hook.pytest_deselected(items=slow)
    items[:] = [item for item in items if item not in slow]


def _run_pytest(folder: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    """pytest in an empty folder, with the faults and the examples importable."""
    path = [ROOT / "tests" / "testing", ROOT / "docs" / "examples", os.environ.get("PYTHONPATH")]
    environment = {k: v for k, v in os.environ.items() if not k.startswith("PYTEST_")}
    environment["PYTHONPATH"] = os.pathsep.join(str(p) for p in path if p)
    words = ["-p", "no:cacheprovider", "-p", "no:dash", "-p", "sart_toolkit.testing.options"]
    return subprocess.run(
        [sys.executable, "-m", "pytest", "--pyargs", "sart_toolkit.testing", *words, *arguments],
        cwd=folder,
        env=environment,
        capture_output=True,
        text=True,
    )


@pytest.fixture
def run_pytest() -> Callable[..., subprocess.CompletedProcess[str]]:
    """Runs the suite in a folder with arguments."""
    return _run_pytest


Outcomes = dict[str, Outcome]


def _outcomes(folder: Path, names: list[str], rest: str, words: list[str]) -> Outcomes:
    """Run the suite; the outcome of each name, which begins a test's parameters before `rest`."""
    # Warnings are errors, but for SAPIEN's that Debian's libvulkan1 is absent.
    warnings = ["-W", "error", "-W", "ignore:Failed to find system libvulkan:UserWarning"]
    result = _run_pytest(folder, *words, "-q", "--junitxml=out.xml", *warnings)
    assert result.returncode in (0, 1), result.stdout + result.stderr
    outcomes: dict[str, Outcome] = defaultdict(Outcome)
    for case in ET.parse(folder / "out.xml").iter("testcase"):
        test, _, parameters = case.get("name", "").partition("[")
        (name,) = (n for n in names if parameters.startswith(f"{n}-{rest}"))
        outcome = outcomes[name]
        bad = case.find("failure") if case.find("error") is None else case.find("error")
        skipped = case.find("skipped")
        if bad is not None:
            outcome.failed[test] = f"{bad.get('message')}\n{bad.text}"
        elif skipped is not None:
            outcome.skipped[test] = str(skipped.get("message"))
        else:
            outcome.passed += 1
    return outcomes


@pytest.fixture(scope="session")
def run_suite(
    tmp_path_factory: pytest.TempPathFactory,
) -> Callable[[list[str], str], Outcomes]:
    """Runs the suite on backends with a robot; the outcome by backend."""

    def run(backends: list[str], robot: str) -> Outcomes:
        words = [word for name in backends for word in ("--sart-backend", name)]
        words += ["--sart-robot", robot]
        return _outcomes(tmp_path_factory.mktemp("suite"), backends, robot, words)

    return run


@pytest.fixture(scope="session")
def run_task_suite(
    tmp_path_factory: pytest.TempPathFactory,
) -> Callable[..., Outcomes]:
    """Runs the suite on tasks on a backend; the outcome by task."""

    def run(tasks: list[str], backend: str = DEFAULT_BACKEND) -> Outcomes:
        words = [word for name in tasks for word in ("--sart-task", name)]
        words += ["--sart-backend", backend]
        return _outcomes(tmp_path_factory.mktemp("suite"), tasks, backend, words)

    return run
