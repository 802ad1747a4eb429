"""`sart new`: files to begin with."""

from __future__ import annotations

from typing import Any

from sart_toolkit.bringup.draft import draft_robot, write_draft
from sart_toolkit.cli.arguments import NewRobot


def robot_verb(args: NewRobot) -> dict[str, Any]:
    """`sart new robot`."""
    dirs = tuple(args.package_dirs.split(",")) if args.package_dirs else ()
    draft = draft_robot(args.urdf, args.name or args.out.stem, dirs)
    write_draft(draft, args.out, args.overwrite)
    gripper = draft.robot.gripper
    return {
        "written": str(args.out),
        "arm joints": list(draft.robot.arm_joints),
        "gripper": gripper.driver or "none",
        "next": f"sart doctor --robot {args.out}:{draft.robot.name.upper()}",
    }
