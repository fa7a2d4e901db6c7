"""Processor, cores, memory, clock and load of this machine, from ``/proc`` and ``/sys``; standard library alone."""

import os
import platform
import statistics
import time
from itertools import pairwise
from math import floor
from pathlib import Path

from ..core.finding import Finding, Level
from ..measure.machine import BUSY, X86, cpuinfo

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
