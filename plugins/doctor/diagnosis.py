"""What of this machine and installation stands in the way of running artifacts, and what to do about it.

Needs the standard library alone, so that it can say that numpy is missing: ``python -m ttscompile.doctor [TARGET]``
works where the command line does not. Nothing is sent anywhere, and nothing is changed.
"""

import json
import sys
from collections.abc import Sequence
from dataclasses import asdict
from itertools import groupby
from pathlib import Path
from typing import Any

from ttscompile.core.finding import Finding, Level

from .machine import machine_findings, package_findings
from .target import target_findings

MARKS = {Level.OK: "ok", Level.NOTE: "-", Level.WARNING: "!", Level.PROBLEM: "PROBLEM"}


def examine(target: Path | str | None = None, **more: Any) -> list[Finding]:
    """Everything that is found, in the order of the report; nothing raises. Its arguments are ``target_findings``'.

    What stops an artifact from running has the level ``PROBLEM``.
    """
    of_target = [] if target is None else target_findings(target, **more)
    return [*package_findings(), *machine_findings(), *of_target]


def problems(found: Sequence[Finding]) -> int:
    """How many findings stop an artifact from running, or from meaning anything."""
    return sum(finding.level is Level.PROBLEM for finding in found)


def document(found: Sequence[Finding]) -> dict[str, Any]:
    """The findings as plain JSON values."""
    return {
        "ok": problems(found) == 0,
        "problems": problems(found),
        "warnings": sum(finding.level is Level.WARNING for finding in found),
        "findings": [{**asdict(finding), "level": finding.level.value} for finding in found],
    }


def text(found: Sequence[Finding]) -> str:
    """The findings for people: a line each, its remedy below it, and the verdict at the end."""
    width = max(len(finding.what) for finding in found)
    lines: list[str] = []
    for part, findings in groupby(found, lambda finding: finding.part):
        lines += ["", part]
        for each in findings:
            lines.append(f"  {MARKS[each.level]:<8}{each.what:<{width}}  {each.found}")
            if each.remedy:
                lines.append(f"  {'':<8}{'':<{width}}  -> {each.remedy}")
    count, warnings = problems(found), document(found)["warnings"]
    verdict = "No problem" if count == 0 else f"{count} problem{'s' * (count > 1)}"
    lines += ["", f"{verdict}, {warnings} warning{'s' * (warnings != 1)}."]
    return "\n".join(lines[1:])


def main(arguments: Sequence[str]) -> int:
    """``python -m ttscompile.doctor [TARGET] [--json]``; returns the exit status, see ``ttscompile doctor``."""
    paths = [Path(argument) for argument in arguments if argument != "--json"]
    if len(paths) > 1 or any(argument.startswith("-") for argument in arguments if argument != "--json"):
        sys.stderr.write("usage: python -m ttscompile.doctor [TARGET] [--json]\n")
        return 2
    if paths and not paths[0].exists():
        sys.stderr.write(f"error: {paths[0]}: does not exist. Give what 'ttscompile convert' takes or wrote.\n")
        return 2
    found = examine(*paths)
    sys.stdout.write((json.dumps(document(found), indent=2) if "--json" in arguments else text(found)) + "\n")
    return 1 if problems(found) else 0
