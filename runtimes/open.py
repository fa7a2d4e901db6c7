"""The runtimes that there are, by name, and how each is opened. A new one is a row of ``RUNTIMES``."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from ttscompile.artifact.load import Artifact
from ttscompile.core.given import integer
from ttscompile.errors import RuntimeUnavailableError

from .backend import Backend, fitting
from .runtime import Runtime

MOST_THREADS = 1024
"""More than any machine has a use for: onnxruntime tries to make as many as it is told, for minutes."""


@dataclass(frozen=True)
class Kind:
    """One kind of runtime.

    Attributes:
        make: its backend on an artifact, with so many threads of arithmetic; imports what it needs when it is called.
        install: what pip has to install where its packages are missing.
        fp32_only: whether it computes residual blocks in fp32 alone, whatever other precision the artifact holds.
    """

    make: Callable[[Artifact, int], Backend[Any]]
    install: str
    fp32_only: bool = False


def _onnxruntime(artifact: Artifact, threads: int) -> Backend[Any]:
    from .onnxruntime.backend import OnnxBackend

    return OnnxBackend(artifact, threads)


def _reference(artifact: Artifact, threads: int) -> Backend[Any]:
    from .reference.backend import ReferenceBackend

    return ReferenceBackend(artifact)  # torch has its own setting of threads


RUNTIMES = {
    "onnxruntime": Kind(_onnxruntime, install="onnxruntime"),
    "reference": Kind(_reference, install="ttscompile[compile]", fp32_only=True),
}


def kind_of(runtime: str) -> Kind:
    """The kind of this name.

    Raises:
        RuntimeUnavailableError: there is none.
    """
    if runtime not in RUNTIMES:
        raise RuntimeUnavailableError(f"no runtime is called {runtime!r}; expected one of {', '.join(RUNTIMES)}.")
    return RUNTIMES[runtime]


def open_runtime(artifact: Artifact, runtime: str = "onnxruntime", threads: int = 1) -> Runtime:
    """Make a runtime for an artifact.

    Args:
        artifact: loaded and checked.
        runtime: a name in ``RUNTIMES``.
        threads: threads of arithmetic, one of which is the caller's. The reference runs with torch's own setting.

    Raises:
        RuntimeUnavailableError: no runtime of this name, its packages are missing, or the threads cannot be had.
        ArtifactError: the parts of the artifact do not fit each other.
    """
    threads = integer(threads, "threads", RuntimeUnavailableError, 1, MOST_THREADS)
    kind = kind_of(runtime)
    try:
        with artifact.reading(), fitting(artifact):  # a backend reads arrays that are mapped from the files
            return Runtime(artifact, kind.make(artifact, threads))
    except ModuleNotFoundError as error:
        problem = f"runtime {runtime!r} needs {error.name!r}, which is not installed"
        raise RuntimeUnavailableError(f"{problem}. Run: pip install '{kind.install}'.") from error
