"""Which processors the policy's thread may run on."""

from __future__ import annotations

import os

from ttscompile.errors import ExecutorError


def pin(cores: tuple[int, ...]) -> None:
    """Keep the calling thread on these processors.

    Raises:
        ExecutorError: this system cannot, or has no such processor.
    """
    if not hasattr(os, "sched_setaffinity"):
        raise ExecutorError("cores cannot be set on this system. Leave ExecutorSettings.cores at None.")
    try:
        os.sched_setaffinity(0, cores)
    except OSError as error:
        raise ExecutorError(
            f"the policy's thread cannot be pinned to {cores}: {error}. This process may use"
            f" {sorted(os.sched_getaffinity(os.getpid()))}."
        ) from error
