"""Draws the strips of `docs/tasks.md`: `python tools/task_images.py [TASK ...]`.

For each task the scripted operator's demonstration, seen by the wrist camera and once from outside,
one row a backend.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from sart_toolkit.backends import BACKENDS, make_backend
from sart_toolkit.data.records import Demonstration
from sart_toolkit.errors import SartError
from sart_toolkit.record.scripted import ScriptedOperator
from sart_toolkit.record.session import SessionConfig, record_demonstration
from sart_toolkit.robots import get_robot
from sart_toolkit.robots.model import RobotModel
from sart_toolkit.tasks import TASKS, get_task
from sart_toolkit.tasks.task import Placement

_SIZE, _GAP, _LABEL = 176, 4, 22
_MOMENTS = 6


def main(arguments: Sequence[str] | None = None) -> int:
    """The exit code of drawing the named tasks' strips, or all."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("tasks", nargs="*", help=f"of {', '.join(TASKS)}; all if left out")
    parser.add_argument("--out", type=Path, default=Path("docs/images/tasks"), help="folder")
    parser.add_argument("--seed", type=int, default=0, help="of the operator's hand")
    options = parser.parse_args(arguments)
    options.out.mkdir(parents=True, exist_ok=True)
    try:
        for name in options.tasks or TASKS:
            path = options.out / f"{name}.png"
            _strip(name, options.seed).save(path, optimize=True)
            print(path)
    except SartError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    return 0


def _strip(name: str, seed: int) -> Image.Image:
    """Rows of images, a backend each: moments of the demonstration, then its end from outside."""
    width = (_MOMENTS + 1) * (_SIZE + _GAP) - _GAP
    page = Image.new("RGB", (width, len(BACKENDS) * (_SIZE + _LABEL)), "white")
    draw = ImageDraw.Draw(page)
    font = ImageFont.load_default(13)
    for row, backend in enumerate(BACKENDS):
        demonstration = _demonstration(name, backend, seed)
        top = row * (_SIZE + _LABEL)
        moments = np.linspace(0, len(demonstration) - 1, _MOMENTS).round().astype(int)
        for column, t in enumerate([*moments, moments[-1]]):
            camera = "wrist" if column < _MOMENTS else "overview"
            left = column * (_SIZE + _GAP)
            page.paste(
                Image.fromarray(demonstration.steps.cameras[camera].rgb[t]), (left, top + _LABEL)
            )
            text = f"{backend}, {demonstration.timestamps[t]:.1f} s"
            text = text if camera == "wrist" else "from outside, at the end"
            draw.text((left + 2, top + 3), text, fill="black", font=font)
    return page


def _demonstration(name: str, backend_name: str, seed: int) -> Demonstration:
    task = get_task(name)
    backend = make_backend(backend_name, get_robot(task.robot), task.scene, _SIZE)
    model = RobotModel(backend.robot, task.scene.held)
    operator = ScriptedOperator(
        task.plan(task.initial_state(model, Placement())), np.random.default_rng(seed)
    )
    config = SessionConfig(cameras=("wrist", "overview"), keep_states=False)
    demonstration = record_demonstration(backend, task, model, operator, seed=seed, config=config)
    backend.close()
    return demonstration


if __name__ == "__main__":
    sys.exit(main())
