"""What of this machine and installation stands in the way of running artifacts, and what to do about it.

Needs the standard library alone, so that it can say that numpy is missing: ``python -m ttscompile.doctor [DIR]`` works
where the command line does not. Nothing is sent anywhere, and nothing is changed.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from .artifact import artifact_findings
from .finding import Finding, Level
from .machine import machine_findings
from .packages import package_findings

MARKS = {Level.OK: "ok", Level.NOTE: "-", Level.WARNING: "!", Level.PROBLEM: "PROBLEM"}


def examine(directory: Path | None = None) -> list[Finding]:
    """Everything that is found, in the order of the report.

    Args:
        directory: an artifact, or the same zipped; it is loaded and called. None looks at the machine alone.

    Returns:
        Findings; none raises. What stops an artifact from running has the level ``PROBLEM``.
    """
    found = [*package_findings(), *machine_findings()]
    if directory is not None:
        found += artifact_findings(directory)
    return found


def problems(found: Sequence[Finding]) -> int:
    """How many findings stop an artifact from running."""
    return sum(finding.level is Level.PROBLEM for finding in found)


def document(found: Sequence[Finding]) -> dict[str, Any]:
    """The findings as plain JSON values."""
    return {
        "ok": problems(found) == 0,
        "problems": problems(found),
        "warnings": sum(finding.level is Level.WARNING for finding in found),
        "findings": [finding.to_json() for finding in found],
    }


def text(found: Sequence[Finding]) -> str:
    """The findings for people: a line each, its remedy below it, and the verdict at the end."""
    width = max(len(finding.what) for finding in found)
    lines: list[str] = []
    part = ""
    for finding in found:
        if finding.part != part:
            part = finding.part
            lines += ["", part]
        lines.append(f"  {MARKS[finding.level]:<8}{finding.what:<{width}}  {finding.found}")
        if finding.remedy:
            lines.append(f"  {'':<8}{'':<{width}}  -> {finding.remedy}")
    count, warnings = problems(found), document(found)["warnings"]
    verdict = "No problem" if count == 0 else f"{count} problem{'s' * (count > 1)}"
    lines += ["", f"{verdict}, {warnings} warning{'s' * (warnings != 1)}."]
    return "\n".join(lines[1:])


def main(arguments: Sequence[str]) -> int:
    """``python -m ttscompile.doctor [DIR] [--json]``; returns the exit status, see ``ttscompile doctor``."""
    paths = [argument for argument in arguments if not argument.startswith("-")]
    options = [argument for argument in arguments if argument.startswith("-")]
    if len(paths) > 1 or set(options) - {"--json"}:
        sys.stderr.write("usage: python -m ttscompile.doctor [DIR] [--json]\n")
        return 2
    if paths and not Path(paths[0]).exists():
        sys.stderr.write(f"error: {paths[0]}: does not exist. Give the directory that 'ttscompile convert' wrote.\n")
        return 2
    found = examine(Path(paths[0]) if paths else None)
    sys.stdout.write((json.dumps(document(found), indent=2) if "--json" in options else text(found)) + "\n")
    return 1 if problems(found) else 0
