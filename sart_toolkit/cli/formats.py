"""`sart export`, `sart import`, and `sart validate --format`."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

from sart_toolkit import pipeline
from sart_toolkit.calibrate.calibration import load_calibration
from sart_toolkit.cli.arguments import Export, Import, Validate
from sart_toolkit.cli.console import ProgressDisplay, say
from sart_toolkit.cli.sensor import intrinsics_of
from sart_toolkit.errors import InvalidInput, Mismatch


def export_verb(args: Export) -> dict[str, Any]:
    """`sart export`."""
    with ProgressDisplay() as progress:
        written = pipeline.export(
            args.dataset,
            args.out,
            args.format,
            instruction=args.instruction,
            depth=args.depth,
            task=args.task,
            robot=args.robot,
            overwrite=args.overwrite,
            progress=progress,
        )
    return {"out": str(args.out), **written}


def import_verb(args: Import) -> dict[str, Any]:
    """`sart import`."""
    with ProgressDisplay() as progress:
        made = pipeline.import_recordings(
            args.file,
            args.out,
            args.format,
            task=args.task,
            robot=args.robot,
            gripper_range=None if args.gripper_range is None else _range(args.gripper_range),
            calibrations=[load_calibration(path) for path in args.calibration],
            intrinsics={
                name: intrinsics_of("--camera-intrinsics", text)
                for name, text in _named("camera-intrinsics", args.camera_intrinsics).items()
            },
            cameras=_named("cameras", args.cameras),
            columns=_named("columns", args.columns),
            rotation=args.rotation,
            pose_frame=args.pose_frame,
            episode=args.episode,
            overwrite=args.overwrite,
            progress=progress,
        )
    return {"out": str(args.out), "demonstrations": [str(path) for path in made]}


def check_verb(args: Validate, format: str) -> dict[str, Any]:
    """`sart validate --format`."""
    for field in dataclasses.fields(args):
        ours = field.name not in ("dataset", "format", "json")
        if ours and getattr(args, field.name) != field.default:
            flag = field.name.replace("_", "-")
            raise InvalidInput(f"--{flag}: is about datasets of ours; leave it or --format out")
    problems = pipeline.check_export(args.dataset, format)
    for problem in problems:
        say(problem)
    if problems:
        raise Mismatch(
            f"{args.dataset}: {len(problems)} problem(s) as {format}; fix them or write it again"
        )
    return {"dataset": str(args.dataset), "format": format, "problems": 0}


def _named(flag: str, words: Sequence[str]) -> dict[str, str]:
    """What follows `=` in each word, by what stands before it.

    Raises:
        InvalidInput: a word has no `=`, or a name comes twice.
    """
    found: dict[str, str] = {}
    for word in words:
        name, equals, value = word.partition("=")
        if not (name and equals and value):
            raise InvalidInput(f"--{flag}: expected NAME=VALUE, got {word!r}")
        if name in found:
            raise InvalidInput(f"--{flag}: {name} is given twice; leave one out")
        found[name] = value
    return found


def _range(text: str) -> tuple[float, float]:
    """Two numbers separated by a comma.

    Raises:
        InvalidInput: it is something else.
    """
    try:
        open_, closed = map(float, text.split(","))
    except ValueError as error:
        raise InvalidInput(
            f"--gripper-range: expected OPEN,CLOSED such as 0,255, got {text!r}"
        ) from error
    return open_, closed
