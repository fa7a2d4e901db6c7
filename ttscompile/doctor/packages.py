"""Python, the packages that matter, and what onnxruntime offers; standard library alone."""

import importlib
import platform
import re
import struct
import sys
from importlib.metadata import PackageNotFoundError, requires, version
from typing import NamedTuple

from ..core.finding import Finding, Level
from ..measure.versions import release

PYTHON = (3, 11)
PROJECT = "ttscompile"
ENABLES = {
    "compile": "convert, calibrate, bench -t, inspect -o, pictures, runtime='torch' and 'reference'",
    "tokens": "instructions as text",
    "recordings": "recordings in zarr, HDF5 and LeRobot's format",
    "serve": "serve",
    "hub": "hf:// names, push",
    "pusht": "examples/pusht",
    "examples": "Meta-World and Fetch in examples/evaluation",
    "ray": "--ray of calibrate and compare, fleet",
}
"""What each extra of ttscompile is for. Those for its own development are not looked at."""

_REQUIREMENT = re.compile(
    r"(?P<name>[A-Za-z0-9._-]+)(\[.*?\])?\s*(>=\s*(?P<least>[0-9.]+))?[^;]*(;\s*extra\s*==\s*['\"](?P<extra>\w+)['\"])?$"
)
_COMMAND_LINE = ("click", "rich")
_PROVIDER = "CPUExecutionProvider"


class Requirement(NamedTuple):
    """``name>=least; extra == "extra"``; parts that are not there are empty."""

    name: str
    least: str
    extra: str


def package_findings() -> list[Finding]:
    """Python, required packages, extras, and onnxruntime's providers."""
    return [*_python(), *_packages(requirements()), *_providers(), *_devices()]


def requirements() -> list[Requirement]:
    """What ttscompile asks for, from its own installation; empty if it is not installed."""
    try:
        told = requires(PROJECT) or []
    except PackageNotFoundError:
        return []
    found = (_REQUIREMENT.match(line) for line in told)
    return [Requirement(m["name"], m["least"] or "", m["extra"] or "") for m in found if m and m["name"] != PROJECT]


def _python() -> list[Finding]:
    part, bits = "python", 8 * struct.calcsize("P")
    told = f"{platform.python_implementation()} {platform.python_version()}, {bits} bits"
    old = sys.version_info[:2] < PYTHON
    remedy = "Install a 64-bit Python: onnxruntime has no other."
    if old:
        remedy = f"Install Python {'.'.join(map(str, PYTHON))} or later."
    own = Finding.judged(part, "version", told, old or bits < 64, remedy, Level.PROBLEM)
    system = f"{platform.system()} {platform.release()} {platform.machine()}"
    remedy = "ttscompile is tested on Linux only; use that."
    return [own, Finding.judged(part, "system", system, platform.system() != "Linux", remedy)]


def _packages(wanted: list[Requirement]) -> list[Finding]:
    part = "packages"
    try:
        found = [Finding(part, PROJECT, version(PROJECT))]
    except PackageNotFoundError:
        remedy = "Install it: pip install ttscompile. Until then nothing is known of the packages it needs."
        return [Finding(part, PROJECT, "not installed: imported from a folder", Level.WARNING, remedy)]
    for each in (r for r in wanted if not r.extra):
        installed, fits = _installed(each)
        if fits:
            found.append(Finding(part, each.name, installed))
            continue
        level, needed = Level.PROBLEM, "no artifact runs without"
        if each.name in _COMMAND_LINE:
            level, needed = Level.WARNING, "the command line needs it"
        remedy = f"Run: pip install '{each.name}>={each.least}' ({needed})."
        found.append(Finding(part, each.name, f"{installed}; {each.least} or later is needed", level, remedy))
    for extra in dict.fromkeys(r.extra for r in wanted if r.extra in ENABLES):
        found.append(_extra(extra, [r for r in wanted if r.extra == extra]))
    return found


def _installed(wanted: Requirement) -> tuple[str, bool]:
    try:
        found = version(wanted.name)
    except PackageNotFoundError:
        return "not installed", False
    return found, release(found) >= release(wanted.least or "0")


def _extra(name: str, wanted: list[Requirement]) -> Finding:
    """One extra: complete, or what it lacks; its absence is no problem on a robot."""
    what, lacking, there = f"extra {name!r}", [], []
    for each in wanted:
        told, fits = _installed(each)
        there.append(f"{each.name} {told}")
        if not fits:
            lacking.append(f"{each.name} {'' if told == 'not installed' else told + ' '}(needs {each.least})")
    if not lacking:
        return Finding("packages", what, f"for {ENABLES[name]}: {', '.join(there)}")
    remedy = f"Where you want {ENABLES[name]}: pip install 'ttscompile[{name}]'."
    return Finding("packages", what, f"lacks {', '.join(lacking)}", Level.NOTE, remedy)


def _providers() -> list[Finding]:
    part = "onnxruntime"
    try:
        module = importlib.import_module("onnxruntime")
        offered = list(module.get_available_providers())
    except ModuleNotFoundError as error:
        lacking = error.name or "onnxruntime"
        told, remedy = f"fails: {lacking} is not installed", f"Run: pip install {lacking}."
        return [Finding(part, "import", told, Level.PROBLEM, remedy)]
    except Exception as error:  # a broken installation: its shared library, or numpy's
        remedy = "Install it again: pip install --force-reinstall onnxruntime numpy."
        return [Finding(part, "import", f"fails: {type(error).__name__}: {error}", Level.PROBLEM, remedy)]
    told = ", ".join(offered)
    if _PROVIDER not in offered:
        remedy = "Install the plain build: pip install onnxruntime."
        return [Finding(part, "providers", told or "none", Level.PROBLEM, remedy)]
    found = [Finding(part, "providers", f"{told}; artifacts run on {_PROVIDER}")]
    builds = [name for name in ("onnxruntime", "onnxruntime-gpu") if _installed(Requirement(name, "", ""))[1]]
    if len(builds) > 1:
        remedy = "They overwrite each other's files. Run: pip uninstall onnxruntime-gpu, and onnxruntime again."
        found.append(Finding(part, "builds", " and ".join(builds), Level.WARNING, remedy))
    return found


def _devices() -> list[Finding]:
    """Where the runtime on torch can compute; nothing where torch is not installed."""
    if not _installed(Requirement("torch", "", ""))[1]:
        return []
    try:
        torch = importlib.import_module("torch")
        found = [torch.cuda.get_device_name(i) for i in range(torch.cuda.device_count())]
        found += ["mps"] if torch.backends.mps.is_available() else []
    except Exception as error:  # a broken installation: its shared libraries, or numpy's
        remedy = "Install it again: pip install --force-reinstall torch. Only what needs torch fails."
        return [Finding("torch", "import", f"fails: {type(error).__name__}: {error}", Level.WARNING, remedy)]
    return [Finding("torch", "devices", ", ".join(["cpu", *found]))]
