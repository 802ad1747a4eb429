"""`sart doctor`, apart from the other verbs: it has to work where what they import does not."""

from __future__ import annotations

import dataclasses
import sys
from typing import Any

from sart_toolkit import doctor
from sart_toolkit.cli.arguments import Doctor
from sart_toolkit.cli.console import show


def doctor_verb(args: Doctor) -> dict[str, Any]:
    """`sart doctor`; exits with 1 where something required does not work."""
    findings = doctor.diagnose(args.full)
    usable = all(finding.ok for finding in findings if finding.required)
    result: dict[str, Any] = {"usable": usable}
    if args.json:
        result["findings"] = [dataclasses.asdict(finding) for finding in findings]
    else:
        for finding in findings:
            mark = "ok  " if finding.ok else ("FAIL" if finding.required else "off ")
            mark = mark if finding.tested else "?   "
            remedy = f"\n      -> {finding.remedy}" if finding.remedy and not finding.ok else ""
            result[f"{mark} {finding.name}"] = f"{finding.detail}{remedy}"
        if not args.full:
            result["?"] = "is installed; `sart doctor --full` tests it"
    if not usable:
        show(result, args.json)
        sys.exit(1)
    return result
