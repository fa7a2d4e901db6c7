"""The runtimes that there are, by name, and how each is opened. A new one is a row of ``RUNTIMES``."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from ttscompile.artifact.load import Artifact
from ttscompile.core.coercion import integer
from ttscompile.core.spec import BF16, FP16, FP32
from ttscompile.errors import RuntimeUnavailableError

from .backend import Backend, fitting
from .runtime import Runtime

CPU = "cpu"

MOST_THREADS = 1024
"""More than any machine has a use for: onnxruntime tries to make as many as it is told, for minutes."""


@dataclass(frozen=True)
class Options:
    """How a runtime is opened.

    Attributes:
        threads: of arithmetic, one of which is the caller's. The reference runs with torch's own setting.
        device: where it computes.
        precision: of the residual blocks, where the runtime makes it of weights in fp32 (``Kind.precisions``).
    """

    threads: int = 1
    device: str = CPU
    precision: str = FP32


@dataclass(frozen=True)
class Kind:
    """One kind of runtime.

    Attributes:
        make: its backend on an artifact; imports what it needs when it is called.
        install: what pip has to install where its packages are missing.
        precisions: those of residual blocks that it makes of the weights in fp32, which every artifact holds; empty
            where it computes in those that the artifact holds.
        devices: whether it computes anywhere else than on the CPU.
    """

    make: Callable[[Artifact, Options], Backend[Any]]
    install: str
    precisions: tuple[str, ...] = ()
    devices: bool = False


def _onnxruntime(artifact: Artifact, options: Options) -> Backend[Any]:
    from .onnxruntime.backend import OnnxBackend

    return OnnxBackend(artifact, options.threads)


def _reference(artifact: Artifact, options: Options) -> Backend[Any]:
    from .reference.backend import ReferenceBackend

    return ReferenceBackend(artifact)


def _torch(artifact: Artifact, options: Options) -> Backend[Any]:
    from .torch.backend import TorchBackend

    return TorchBackend(artifact, options.threads, options.device, options.precision)


RUNTIMES = {
    "onnxruntime": Kind(_onnxruntime, install="onnxruntime"),
    "torch": Kind(_torch, install="ttscompile[compile]", precisions=(FP32, BF16, FP16), devices=True),
    "reference": Kind(_reference, install="ttscompile[compile]", precisions=(FP32,)),
}


def kind_of(runtime: str) -> Kind:
    """The kind of this name.

    Raises:
        RuntimeUnavailableError: there is none.
    """
    if runtime not in RUNTIMES:
        raise RuntimeUnavailableError(f"no runtime is called {runtime!r}; expected one of {', '.join(RUNTIMES)}.")
    return RUNTIMES[runtime]


def open_runtime(
    artifact: Artifact,
    runtime: str = "onnxruntime",
    threads: int = 1,
    device: str | None = None,
    precision: str = FP32,
    plan: str | None = None,
) -> Runtime:
    """Make a runtime for an artifact.

    Args:
        artifact: loaded and checked.
        runtime: a name in ``RUNTIMES``.
        threads: see ``Options``.
        device: see ``Options``; None for the CPU.
        precision: see ``Options``.
        plan: see ``Runtime``.

    Raises:
        RuntimeUnavailableError: no runtime of this name, its packages are missing, or threads, device or precision
            cannot be had.
        ArtifactError: the parts of the artifact do not fit each other.
    """
    threads = integer(threads, "threads", RuntimeUnavailableError, 1, MOST_THREADS)
    kind = kind_of(runtime)
    if device is not None and not isinstance(device, str):
        raise RuntimeUnavailableError(f"expected the name of a device, 'cpu' or 'cuda'; found {device!r}.")
    if device not in (None, CPU) and not kind.devices:
        able = ", ".join(repr(name) for name, each in RUNTIMES.items() if each.devices)
        problem = f"runtime {runtime!r} computes on the CPU alone; found device {device!r}"
        raise RuntimeUnavailableError(f"{problem}. Use runtime={able}.")
    options = Options(threads, device or CPU, precision)

    def backend(weights: Artifact) -> Backend[Any]:
        try:
            with weights.reading(), fitting(weights):  # a backend reads arrays that are mapped from the files
                return kind.make(weights, options)
        except ModuleNotFoundError as error:
            problem = f"runtime {runtime!r} needs {error.name!r}, which is not installed"
            raise RuntimeUnavailableError(f"{problem}. Run: pip install '{kind.install}'.") from error

    return Runtime(artifact, backend, plan)
