"""`sart suggest`."""

from __future__ import annotations

from typing import Any

from sart_toolkit import pipeline
from sart_toolkit.cli.arguments import Suggest
from sart_toolkit.cli.console import ProgressDisplay
from sart_toolkit.cli.sensor import declared_sensor
from sart_toolkit.data.records import Annotation


def suggest_verb(args: Suggest) -> dict[str, Any]:
    """`sart suggest`."""
    sensor = declared_sensor(args, [args.demo])
    with ProgressDisplay() as progress:
        annotation = pipeline.suggest(
            args.demo,
            args.out,
            waypoints=args.waypoints,
            source=args.source,
            unknown=args.unknown,
            sensor=sensor,
            slip_tolerance=args.slip_tolerance,
            task=args.task,
            robot=args.robot,
            backend=args.backend,
            overwrite=args.overwrite,
            progress=progress,
            margin=args.margin,
            min_radius=args.min_radius,
            max_radius=args.max_radius,
        )
    return {"annotation": str(args.out), "spheres": describe_spheres(annotation)}


def describe_spheres(annotation: Annotation) -> list[dict[str, Any]]:
    """The spheres in a few words each."""
    return [
        {
            "waypoint": sphere.waypoint,
            "radius_mm": round(sphere.radius * 1e3, 2),
            "limited_by": sphere.limited_by,
        }
        for sphere in annotation.spheres
    ]
