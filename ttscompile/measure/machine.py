"""What a timing was taken on: without it a figure in milliseconds says little."""

import os
import platform
from contextlib import suppress
from pathlib import Path
from typing import Any

CPUINFO, CGROUP = Path("/proc/cpuinfo"), Path("/sys/fs/cgroup/memory.max")
PACKAGES = ("ttscompile", "numpy", "onnxruntime", "torch")
_DOT_PRODUCTS = ("avx512_vnni", "avx_vnni", "amx_int8")
X86 = ("x86_64", "amd64", "i386", "i686")
BUSY = 1.0
"""Load for each core from which timings say little: more wants to run than can."""
_INSTRUCTIONS = ("avx2", "avx512f", "avx512_vnni", "amx_int8", "asimd", "sve")


def fingerprint() -> dict[str, Any]:
    """Processor, instruction sets, cores that this process may use, their load now, memory in GiB, system, versions.

    Nothing that names the machine or its user. Packages that are not installed are left out.
    """
    from importlib.metadata import PackageNotFoundError, version  # which imports sockets and mail: 10 ms of each load

    fields = cpuinfo()
    flags = fields.get("flags", fields.get("Features", "")).split()
    versions = {}
    for name in PACKAGES:
        with suppress(PackageNotFoundError):
            versions[name] = version(name)
    return {
        "processor": _processor(),
        "instructions": [name for name in _INSTRUCTIONS if name in flags],
        "cores": len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count(),
        "load_average": round(os.getloadavg()[0], 2),
        "memory_gib": round(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 2**30, 1),
        "system": f"{platform.system()} {platform.machine()}",
        "python": platform.python_version(),
        **versions,
    }


def _processor() -> str:
    return cpuinfo().get("model name", platform.processor() or platform.machine())


def timed_on(threads: int) -> str:
    """Where times are taken now: the processor, and how many threads a call has."""
    return f"{_processor()}, {threads} thread{'s' * (threads > 1)}"


def elsewhere(there: str | None) -> str | None:
    """Where times were taken, given ``timed_on`` of then, and what to do if this is another processor; None of None."""
    if there is None or there.rpartition(",")[0] == (here := _processor()):
        return there and f"timed on {there}"
    return f"timed on {there}; this is {here}: 'ttscompile bench DIR --choose' chooses by the times of this one"


def busy() -> str | None:
    """A warning where other programs keep the cores busy, so that times say little; None where they do not."""
    machine = fingerprint()
    load, cores = machine["load_average"], machine["cores"]
    told = f"other programs keep this machine busy (load {load:g} on {cores} cores), so times say little"
    return f"{told}. Measure again when they are done." if load > BUSY * cores else None


def memory_bytes() -> int:
    """What this machine has, or what its container may take of it, whichever is less."""
    whole = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    with suppress(OSError, ValueError):  # no such file; or it says "max"
        return min(whole, int(CGROUP.read_text()))
    return whole


def has_integer_dot_product() -> bool | None:
    """Whether the processor multiplies eight-bit integers and sums in 32 bits.

    On x86 that takes VNNI or AMX: without, onnxruntime's fastest kernels sum pairs of products in 16 bits, which
    saturate. ARM processors have such sums in one form or another. None: nothing says what the processor has.
    """
    if platform.machine().lower() not in X86:
        return True
    flags = cpuinfo().get("flags", "").split()
    return any(name in flags for name in _DOT_PRODUCTS) if flags else None


def one_line(machine: dict[str, Any]) -> str:
    """The fingerprint for people."""
    versions = ", ".join(f"{name} {machine[name]}" for name in ("python", *PACKAGES) if name in machine)
    return (
        f"{machine['processor']} ({' '.join(machine['instructions'])}), {machine['cores']} cores,"
        f" load {machine['load_average']}, {machine['memory_gib']} GiB, {machine['system']}; {versions}"
    )


def cpuinfo(path: Path | None = None) -> dict[str, str]:
    """The first processor's fields of ``/proc/cpuinfo``, or of another such file; empty where there is none."""
    try:
        text = (CPUINFO if path is None else path).read_text(errors="replace")
    except OSError:
        return {}
    first = text.split("\n\n", 1)[0]
    pairs = (line.split(":", 1) for line in first.splitlines() if ":" in line)
    return {name.strip(): value.strip() for name, value in pairs}
