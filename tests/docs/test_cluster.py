"""The page about clusters shows commands that can be typed, and says no more than is under test."""

from __future__ import annotations

import re
import shlex
from pathlib import Path

from sart_toolkit.cli.verbs import VERBS, find_verb

PAGE = (Path(__file__).parents[2] / "docs" / "cluster.md").read_text()
INTRODUCTION = PAGE.partition("```")[0]


def test_every_command_on_it_can_be_parsed_and_asks_for_ray() -> None:
    commands = re.findall(r"^sart (.*)$", PAGE, re.M)
    assert len(commands) >= 4
    for command in commands:
        name, words = find_verb(shlex.split(command))
        args = VERBS[name].parse(name, words)
        assert args.executor == "ray" and args.workers > 1


def test_every_verb_with_workers_takes_an_executor_and_is_on_it() -> None:
    shared = [name for name, verb in VERBS.items() if "workers" in _fields(verb.arguments)]
    assert {"run", "augment", "train", "evaluate", "benchmark segments"} <= set(shared)
    for name in shared:
        assert {"executor", "ray_address"} <= _fields(VERBS[name].arguments), name
        assert name.startswith("benchmark ") or f"`{name}" in INTRODUCTION, name


def _fields(arguments: type) -> set[str]:
    return set(arguments.__dataclass_fields__)  # type: ignore[attr-defined]
