"""`sart new`: files to begin with."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from sart_toolkit.bringup.skeleton import Kind, Skeleton, make_skeleton, write_source
from sart_toolkit.cli.arguments import NewBackend, NewRobot, NewStrategy, NewTask


def robot_verb(args: NewRobot) -> dict[str, Any]:
    """`sart new robot`."""
    # Reads URDFs and their meshes, which the others needn't wait for.
    from sart_toolkit.bringup.draft import draft_robot

    dirs = tuple(args.package_dirs.split(",")) if args.package_dirs else ()
    draft = draft_robot(args.urdf, args.name or args.out.stem, dirs)
    write_source(draft.text, args.out, args.overwrite)
    gripper = draft.robot.gripper
    return {
        "written": str(args.out),
        "arm joints": list(draft.robot.arm_joints),
        "gripper": gripper.driver or "none",
        "next": f"sart doctor --robot {args.out}:{draft.robot.name.upper()}",
    }


def task_verb(args: NewTask) -> dict[str, Any]:
    """`sart new task`."""
    out, new = _written("task", args)
    return {
        "written": str(out),
        "test": f"pytest --pyargs sart_toolkit.testing --sart-task {new.reference}",
        "next": f"sart run {new.reference} --out runs/{args.name}",
    }


def strategy_verb(args: NewStrategy) -> dict[str, Any]:
    """`sart new strategy`."""
    out, new = _written("strategy", args)
    return {
        "written": str(out),
        "next": f"sart augment demo.h5 annotation.json --out dataset --strategy {new.reference}",
    }


def backend_verb(args: NewBackend) -> dict[str, Any]:
    """`sart new backend`."""
    out, new = _written("backend", args)
    return {
        "written": str(out),
        "test": f"pytest --pyargs sart_toolkit.testing --sart-backend {new.reference} -rs",
        "next": f"sart run peg_in_hole --backend {new.reference} --out runs/{args.name}",
    }


def _written(kind: Kind, args: NewTask | NewStrategy | NewBackend) -> tuple[Path, Skeleton]:
    out = args.out or Path(f"{args.name}.py")
    new = make_skeleton(kind, args.name, out)
    write_source(new.text, out, args.overwrite)
    return out, new
