"""Limits for a process of its own that reads what strangers wrote, with libraries which have none."""

import time
from pathlib import Path


def limit(seconds: int, size: int) -> None:
    """Limit this process, where its system can: to so much more processor time and memory, bytes; and to no file."""
    try:
        import resource
    except ModuleNotFoundError:  # Windows
        return
    limits = {resource.RLIMIT_CORE: 0, resource.RLIMIT_FSIZE: 0}
    limits[resource.RLIMIT_CPU] = int(time.process_time()) + seconds
    statm = Path("/proc/self/statm")
    if statm.exists():
        held = int(statm.read_text().split()[5]) * resource.getpagesize()
        limits[resource.RLIMIT_DATA] = held + size  # not what allocators reserve and do not use
    for which, value in limits.items():
        hard = resource.getrlimit(which)[1]
        value = value if hard == resource.RLIM_INFINITY else min(value, hard)
        resource.setrlimit(which, (value, value))
