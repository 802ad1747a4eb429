"""The table of keys in the documentation is the annotator's own."""

from pathlib import Path

import pytest

from sart_toolkit.annotate.session import ACTIONS

PAGE = Path(__file__).parents[2] / "docs" / "annotating.md"


@pytest.mark.parametrize("name", ACTIONS)
def test_every_action_is_reported_with_its_keys(name):
    action = ACTIONS[name]
    word = f"{name} NUMBER" if action.takes_number else name
    row = f"| {', '.join(action.keys) or ' '} | {word} | {action.help} |"
    assert row in PAGE.read_text().splitlines()


def test_no_other_key_is_reported():
    rows = [line for line in PAGE.read_text().splitlines() if line.count("|") == 4]
    assert len(rows) == len(ACTIONS) + 2
