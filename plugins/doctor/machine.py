"""This machine and what is installed on it, with the standard library alone.

Python, the packages that matter, and what onnxruntime offers; processor, cores, memory, clock and load, from ``/proc``
and ``/sys``.
"""

import importlib
import os
import platform
import re
import statistics
import struct
import sys
import time
from importlib.metadata import PackageNotFoundError, requires, version
from itertools import pairwise
from math import floor
from pathlib import Path
from typing import NamedTuple

from ttscompile.core.finding import Finding, Level
from ttscompile.measure.machine import BUSY, X86, cpuinfo
from ttscompile.measure.versions import release

PYTHON = (3, 10)
PROJECT = "ttscompile"
ENABLES = {
    "compile": "convert, calibrate, bench -t, inspect -o, pictures, runtime='torch' and 'reference'",
    "tokens": "instructions as text",
    "recordings": "recordings in zarr, HDF5 and LeRobot's format",
    "videos": "LeRobot's data sets with videos",
    "serve": "serve",
    "hub": "hf:// names, push",
    "pusht": "examples/pusht",
    "octo": "checkpoints of Octo",
    "openpi": "JAX checkpoints of openpi",
    "examples": "Meta-World, Fetch and SO-101 in examples/evaluation",
    "ray": "calibrate --ray, serve --copies",
}
"""What each extra of ttscompile is for. Those for its own development are not looked at."""

_REQUIREMENT = re.compile(
    r"(?P<name>[\w.-]+)(\[.*?\])?\s*([>=]=\s*(?P<least>[0-9.]+))?[^;]*(;\s*extra\s*==\s*['\"](?P<extra>\w+)['\"])?$"
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
    better = f"Python {'.'.join(map(str, PYTHON))} or later" if old else "a 64-bit Python: onnxruntime has no other"
    own = Finding.judged(part, "version", told, old or bits < 64, f"Install {better}.", Level.PROBLEM)
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


_X86 = {
    "avx2": "AVX2",
    "avx512f": "AVX-512",
    "avx512_vnni": "AVX-512 VNNI",
    "avx_vnni": "AVX VNNI",
    "avx512_bf16": "AVX-512 BF16",
    "amx_int8": "AMX int8",
    "amx_bf16": "AMX bf16",
}
_ARM = {"asimd": "NEON", "asimddp": "dotprod", "i8mm": "i8mm", "bf16": "BF16", "sve": "SVE", "sve2": "SVE2"}
"""Name in ``/proc/cpuinfo`` -> name that people know."""

_AS_GOOD = {"avx_vnni": {"avx512_vnni"}, "avx512_vnni": {"avx_vnni"}}
"""What does the same, so that its absence is not worth a word."""

_FAST_CLOCKS = ("tsc", "arch_sys_counter", "kvm-clock", "hyperv_clocksource_tsc_page")
_LATE_MS = 1.0
"""How late a sleep may wake in the median before a control loop should worry."""


def machine_findings(root: Path = Path("/")) -> list[Finding]:
    """What decides how fast calls are here, and how steady."""
    return [*_processor(root), *_cores(root), *_memory(root), *_clock(root)]


def usable_cores(root: Path = Path("/")) -> float:
    """Cores that this process may keep busy: affinity, physical cores and the cgroup's limit, whichever is least."""
    limits = len(_affinity()), _physical(root), cgroup_cores(root)
    return min(limit for limit in limits if limit is not None)


def cgroup_cores(root: Path) -> float | None:
    """Cores' worth of time that the control group allows; None for no limit."""
    told = _text(root / "sys/fs/cgroup/cpu.max").split()  # of version 2; of version 1 there are two files
    if len(told) != 2:
        told = [_text(root / f"sys/fs/cgroup/cpu/cpu.cfs_{name}_us").strip() for name in ("quota", "period")]
    quota, period = (int(number) if number.isdigit() else 0 for number in told)  # "max" and -1 are no limit
    return quota / period if quota and period else None


def available_bytes(root: Path = Path("/")) -> int | None:
    """Memory that can be had without swapping, in the control group's limit; None where nothing says so."""
    kibibytes = cpuinfo(root / "proc/meminfo").get("MemAvailable")  # a file of the same form
    found = [] if kibibytes is None else [1024 * int(kibibytes.split()[0])]
    for limit, used in (
        ("sys/fs/cgroup/memory.max", "sys/fs/cgroup/memory.current"),
        ("sys/fs/cgroup/memory/memory.limit_in_bytes", "sys/fs/cgroup/memory/memory.usage_in_bytes"),
    ):
        most, now = (_text(root / name).strip() for name in (limit, used))
        if most.isdigit():
            found.append(int(most) - (int(now) if now.isdigit() else 0))
    return max(min(found), 0) if found else None


def _processor(root: Path) -> list[Finding]:
    part, x86, fields = "processor", platform.machine().lower() in X86, cpuinfo(root / "proc/cpuinfo")
    found = [Finding(part, "model", fields.get("model name") or platform.processor() or platform.machine())]
    flags = set((fields.get("flags") or fields.get("Features") or "").split())
    if not flags:
        return [*found, Finding(part, "instructions", "not known: nothing here lists them", Level.NOTE)]
    known = _X86 if x86 else _ARM
    has = [told for name, told in known.items() if name in flags]
    lacks = [told for name, told in known.items() if name not in flags and not flags & _AS_GOOD.get(name, set())]
    told = f"{', '.join(has) or 'none that matter'}" + (f"; not {', '.join(lacks)}" if lacks else "")
    remedy = "onnxruntime falls back to kernels that are several times slower; use a processor of 2015 or later."
    return [*found, Finding.judged(part, "instructions", told, x86 and "avx2" not in flags, remedy)]


def _cores(root: Path) -> list[Finding]:
    part, affinity, physical, quota = "cores", _affinity(), _physical(root), cgroup_cores(root)
    told = f"{os.cpu_count()} logical" + (f", {physical} physical" if physical is not None else "")
    found = [Finding(part, "cores", f"{told}, {len(affinity)} of them for this process")]
    if quota is not None:
        level = Level.WARNING if quota < 1 else Level.NOTE
        remedy = "A call waits for its share of a core: give the container at least one." if quota < 1 else ""
        found.append(Finding(part, "limit of the control group", f"{quota:g} cores", level, remedy))
    usable = usable_cores(root)
    most = max(floor(usable) - 1, 1)
    advice = (
        "threads=1: there is no core to spare"
        if most == 1
        else f"threads=1 first; up to {most}, if a call is too slow: it leaves a core to the control loop"
    )
    found.append(Finding(part, "threads", advice))
    if governor := _text(root / "sys/devices/system/cpu/cpu0/cpufreq/scaling_governor").strip():
        remedy = "The first calls after a pause are slow. Run: sudo cpupower frequency-set -g performance."
        found.append(Finding.judged(part, "frequency governor", governor, governor != "performance", remedy))
    load = os.getloadavg()[0]
    remedy = "Timings taken now say little: stop what else runs, or reserve cores (taskset)."
    return [*found, Finding.judged(part, "load", f"{load:.1f} over the last minute", load > BUSY * usable, remedy)]


def _memory(root: Path) -> list[Finding]:
    available = available_bytes(root)
    if available is None:
        return [Finding("memory", "memory", "not known: nothing here says how much there is", Level.NOTE)]
    return [Finding("memory", "available", f"{available / 2**30:.1f} GiB")]


def _clock(root: Path) -> list[Finding]:
    part, info = "clock", time.get_clock_info("monotonic")
    readings = [time.monotonic() for _ in range(201)]
    apart = statistics.median(b - a for a, b in pairwise(readings))
    found = [Finding(part, "resolution", f"{1e9 * info.resolution:g} ns, {1e9 * apart:.0f} ns between two readings")]
    if source := _text(root / "sys/devices/system/clocksource/clocksource0/current_clocksource").strip():
        remedy = "Reading the time costs a system call of microseconds; see the kernel's parameter clocksource=tsc."
        found.append(Finding.judged(part, "source", source, source not in _FAST_CLOCKS, remedy))
    latenesses = []
    for _ in range(20):
        started = time.monotonic()
        time.sleep(0.001)
        latenesses.append(1e3 * (time.monotonic() - started) - 1)
    late = statistics.median(latenesses)
    told = f"{late:.2f} ms late in the median, of 20 sleeps of 1 ms"
    remedy = "A control loop will jitter: look at late and held actions in the statistics of the executor."
    return [*found, Finding.judged(part, "sleep", told, late > _LATE_MS, remedy)]


def _affinity() -> set[int]:
    if hasattr(os, "sched_getaffinity"):
        return set(os.sched_getaffinity(0))
    return set(range(os.cpu_count() or 1))


def _physical(root: Path) -> int | None:
    """Physical cores of those that this process may use: hyperthreads of one core count once."""
    found = set()
    for cpu in _affinity():
        siblings = _text(root / f"sys/devices/system/cpu/cpu{cpu}/topology/thread_siblings_list").strip()
        if not siblings:
            return None
        found.add(siblings)
    return len(found)


def _text(path: Path) -> str:
    """A file of the system; empty where there is none."""
    try:
        return path.read_text(errors="replace")
    except OSError:
        return ""
