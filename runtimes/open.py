"""The runtimes that there are, by name, and how each is opened. A new one is a row of ``RUNTIMES``."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, TypeAlias

from ttscompile.artifact.load import Artifact
from ttscompile.artifact.view import View, require_held
from ttscompile.core.coercion import integer
from ttscompile.core.plan import Plan
from ttscompile.core.spec import BF16, FP16, INT4, INT8
from ttscompile.errors import IllegalPlanError, RuntimeUnavailableError
from ttscompile.ir.pieces import parts_of

from .backend import Backend, fitting
from .runtime import Runtime

CPU = "cpu"

MOST_THREADS = 1024
"""More than any machine has a use for: onnxruntime tries to make as many as it is told, for minutes."""

Open: TypeAlias = Callable[[View], Backend[Any]]


@dataclass(frozen=True)
class Kind:
    """One kind of runtime.

    Attributes:
        make: what opens its backends on views of one artifact, which share what they have in common; imports what it
            needs when it is called, with threads of arithmetic, one of which is the caller's (the reference runs with
            torch's own setting), and with a device.
        install: what pip has to install where its packages are missing.
        held: the precisions beside fp32 that it computes in, from models that the artifact holds.
        made: the precisions of any part that it makes of the weights in fp32.
        tokens: whether it can compute some of the tokens of an image encoder.
        devices: whether it computes anywhere else than on the CPU.
        slow: whether it is there for checks alone.
    """

    make: Callable[[int, str], Open]
    install: str
    held: tuple[str, ...] = ()
    made: tuple[str, ...] = ()
    tokens: bool = False
    devices: bool = False
    slow: bool = False


def _onnxruntime(threads: int, device: str) -> Open:
    from .onnxruntime.backend import OnnxBackend
    from .onnxruntime.sessions import Sessions

    return partial(OnnxBackend, sessions=Sessions(threads), known={})


def _reference(threads: int, device: str) -> Open:
    from .reference.backend import ReferenceBackend

    return ReferenceBackend


def _torch(threads: int, device: str) -> Open:
    from .torch.backend import TorchBackend
    from .torch.devices import device_of
    from .torch.network import Placed

    return partial(TorchBackend, placed=Placed(device_of(device)), threads=threads)


RUNTIMES = {
    "onnxruntime": Kind(_onnxruntime, install="onnxruntime", held=(INT8, INT4), tokens=True),
    "torch": Kind(_torch, install="ttscompile[compile]", made=(BF16, FP16), devices=True),
    "reference": Kind(_reference, install="ttscompile[compile]", slow=True),
}


def require_able(runtime: str, artifact: Artifact, plan: Plan) -> None:
    """Raise unless a runtime can compute what a plan asks for.

    Raises:
        RuntimeUnavailableError: it has no such precision, or cannot reuse tokens.
        ArtifactError: it could, and the artifact holds no such models.
        IllegalPlanError: the artifact has no such part.
    """
    kind, remedy = kind_of(runtime), "Take plan='dense', or a plan in fp32: plan='NAME@fp32', which is plan.exact"
    parts = parts_of(artifact.manifest.pieces)
    for part, precision in plan.precision.items():
        if precision in kind.made and part not in parts:
            told = f"a plan wants {part!r} in {precision!r}; the artifact's parts are {', '.join(parts)}"
            raise IllegalPlanError(f"{told}. Name some of these.")
        if precision not in (*kind.made, *kind.held):
            able = (*kind.held, *kind.made)
            can = f"fp32, and beside it {', '.join(able)}" if able else "fp32 alone"
            raise RuntimeUnavailableError(
                f"runtime {runtime!r} computes in {can}; the plan wants {part!r} in {precision!r}. {remedy}."
            )
    require_held(artifact, replace(plan, precision={p: n for p, n in plan.precision.items() if n in kind.held}))
    if plan.tokens is not None and not kind.tokens:
        others = ", ".join(repr(name) for name, each in RUNTIMES.items() if each.tokens)
        raise RuntimeUnavailableError(
            f"runtime {runtime!r} computes all tokens of a frame; the plan reuses some. Use runtime={others}. {remedy}."
        )


def kind_of(runtime: str) -> Kind:
    """The kind of this name. Raises RuntimeUnavailableError: there is none."""
    if runtime not in RUNTIMES:
        raise RuntimeUnavailableError(f"no runtime is called {runtime!r}; expected one of {', '.join(RUNTIMES)}.")
    return RUNTIMES[runtime]


def open_runtime(
    artifact: Artifact,
    runtime: str = "onnxruntime",
    threads: int = 1,
    device: str | None = None,
    plan: Plan | None = None,
) -> Runtime:
    """Make a runtime for an artifact.

    Raises:
        RuntimeUnavailableError: no runtime of this name, its packages are missing, or threads, device or what the plan
            asks for cannot be had.
        ArtifactError: the parts of the artifact do not fit each other.
        IllegalPlanError: the plan names what the artifact lacks.
    """
    threads = integer(threads, "threads", RuntimeUnavailableError, 1, MOST_THREADS)
    kind = kind_of(runtime)
    if device is not None and not isinstance(device, str):
        raise RuntimeUnavailableError(f"expected the name of a device, 'cpu' or 'cuda'; found {device!r}.")
    if device not in (None, CPU) and not kind.devices:
        able = ", ".join(repr(name) for name, each in RUNTIMES.items() if each.devices)
        problem = f"runtime {runtime!r} computes on the CPU alone; found device {device!r}"
        raise RuntimeUnavailableError(f"{problem}. Use runtime={able}.")
    opener = list[Open]()

    def backend(view: View) -> Backend[Any]:
        require_able(runtime, artifact, Plan(precision=view.precision, tokens=view.variant.tokens))
        try:
            with artifact.reading(), fitting(view):  # a backend reads arrays that are mapped from the files
                if not opener:
                    opener.append(kind.make(threads, device or CPU))
                return opener[0](view)
        except ModuleNotFoundError as error:
            problem = f"runtime {runtime!r} needs {error.name!r}, which is not installed"
            raise RuntimeUnavailableError(f"{problem}. Run: pip install '{kind.install}'.") from error

    return Runtime(artifact, backend, plan)
