"""`sart doctor`, apart from the other verbs: it has to work where what they import does not."""

from __future__ import annotations

import dataclasses
import sys
from pathlib import Path
from typing import Any

from sart_toolkit import doctor
from sart_toolkit.cli.arguments import Doctor
from sart_toolkit.cli.console import show
from sart_toolkit.errors import InvalidInput


def doctor_verb(args: Doctor) -> dict[str, Any]:
    """`sart doctor`; exits with 1 where something required does not work."""
    if args.robot is None and args.image is not None:
        raise InvalidInput("--image: is of a robot; add --robot REF")
    if args.robot is not None and args.full:
        raise InvalidInput("--full: is about this machine; leave it out, or --robot")
    other = next((f for f in ("full", "robot", "image") if getattr(args, f)), None)
    if args.cell is not None and other is not None:
        raise InvalidInput(f"--{other}: is not about a cell; leave it out, or --cell")
    if args.cell is not None:
        findings = _of_cell(args.cell)
    else:
        findings = _of_robot(args.robot, args.image) if args.robot else doctor.diagnose(args.full)
    usable = all(finding.ok for finding in findings if finding.required)
    result: dict[str, Any] = {"usable": usable}
    if args.json:
        result["findings"] = [dataclasses.asdict(finding) for finding in findings]
    else:
        weak = "look" if args.robot else "off "
        for finding in findings:
            mark = "ok  " if finding.ok else ("FAIL" if finding.required else weak)
            mark = mark if finding.tested else "?   "
            remedy = f"\n      -> {finding.remedy}" if finding.remedy and not finding.ok else ""
            line = f"{finding.detail}{remedy}"
            key = f"{mark} {finding.name}"
            # A robot may have several findings of one name.
            result[key] = f"{result[key]}\n      {line}" if key in result else line
        if not args.full and not args.robot and not args.cell:
            result["?"] = "is installed; `sart doctor --full` tests it"
    if not usable:
        show(result, args.json)
        sys.exit(1)
    return result


def _of_cell(path: Path) -> list[doctor.Finding]:
    from sart_toolkit.bringup.cell import examine_cell
    from sart_toolkit.hardware.cell import load_cell

    return examine_cell(load_cell(path))


def _of_robot(reference: str, image: Path | None) -> list[doctor.Finding]:
    if reference.lower().endswith((".urdf", ".xacro", ".xml")):
        raise InvalidInput(
            f"--robot {reference}: is a URDF, expected a RobotSpec as file.py:NAME; make one by: "
            f"sart new robot {reference} --out {Path(reference).stem}.py"
        )
    # Here, so that the doctor of the machine works where what a robot needs does not.
    from sart_toolkit.bringup.examine import examine
    from sart_toolkit.robots import get_robot

    return examine(get_robot(reference), image)
