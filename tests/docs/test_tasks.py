"""docs/tasks.md tells of every task and shows it."""

from __future__ import annotations

from pathlib import Path

import pytest
from PIL import Image

from sart_toolkit.tasks import TASKS, get_task

DOCS = Path(__file__).parents[2] / "docs"


@pytest.mark.parametrize("name", TASKS)
def test_every_task_has_its_line_and_its_strip_of_images(name: str) -> None:
    text = (DOCS / "tasks.md").read_text()
    assert f"| `{name}` | `{get_task(name).robot}` |" in text
    path = f"images/tasks/{name}.png"
    assert f"]({path})" in text
    with Image.open(DOCS / path) as strip:
        assert strip.width > 1000
