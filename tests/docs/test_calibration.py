"""The page on calibration shows what can be typed, and names what a calibration holds."""

from __future__ import annotations

import dataclasses
import re
import shlex
from pathlib import Path

from sart_toolkit.calibrate.calibration import Calibration
from sart_toolkit.cli.verbs import VERBS, find_verb

PAGE = (Path(__file__).parents[2] / "docs" / "calibration.md").read_text()


def test_every_command_can_be_parsed() -> None:
    commands = re.findall(r"^sart ([^#\n]*)", PAGE, re.M)
    assert len(commands) >= 5
    for command in commands:
        name, words = find_verb(shlex.split(command))
        VERBS[name].parse(name, words)


def test_every_field_of_a_calibration_is_named() -> None:
    named = re.findall(r"`(\w+)`", PAGE)
    own = {field.name for field in dataclasses.fields(Calibration)}
    assert own - set(named) <= {"camera", "board", "versions"}
