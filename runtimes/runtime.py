"""What every runtime is: one call in, the denoised sample and a report out; state only between calls of an episode."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
import numpy.typing as npt

from ttscompile.core.correction import Correction
from ttscompile.core.lattice import BoolArray, PlanArray, Source, check_plan, legalize, require_legal
from ttscompile.core.spec import FloatArray, Noise, SamplerTable
from ttscompile.errors import (
    ArtifactError,
    IllegalPlanError,
    ObservationError,
    RuntimeUnavailableError,
    TtscompileError,
)

if TYPE_CHECKING:
    from ttscompile.artifact.load import Artifact

    from .inpainting import Known

GIVEN = "given"
"""``CallReport.plan_name`` of a matrix that the caller gave no name."""

RUNTIMES = ("onnxruntime", "reference")

MOST_THREADS = 1024
"""More than any machine has a use for: onnxruntime tries to make as many as it is told, for minutes."""


@dataclass(frozen=True)
class Timings:
    """Wall time of one call in milliseconds.

    Attributes:
        prologue: condition values and step values from the observation.
        pruner: the pruner network and what makes a plan of its logits; 0 if the plan was given.
        wait_pruner: how long the denoising loop stood still for the plan: all of the pruner unless a runtime overlaps
            it with step 0.
        decode: the denoising loop, without that wait.
        total: from the normalised observation to the denoised sample.
    """

    prologue: float
    pruner: float
    wait_pruner: float
    decode: float
    total: float


@dataclass(frozen=True)
class CallReport:
    """What one call did.

    Attributes:
        plan: int8 ``[B, K, blocks]`` of ``Source``, as executed. Read-only.
        plan_name: ``dense``, the name of a plan of the artifact, or ``given`` for a matrix of the caller's.
        computed: computed cells of each stream.
        legalised: cells of each stream that were replaced because their residual was never computed.
        flops: FLOPs of each stream, multiply and add counted as two, prologue and pruner included.
        timings: wall time in milliseconds.
    """

    plan: PlanArray
    plan_name: str
    computed: tuple[int, ...]
    legalised: tuple[int, ...]
    flops: tuple[float, ...]
    timings: Timings


class Runtime(Protocol):
    """One episode at a time on a fixed number of streams.

    Nothing here locks: a runtime belongs to one thread (``CompiledPolicy`` sees to that).
    """

    @property
    def streams(self) -> int | None:
        """B of the episode under way; None after ``reset`` and before the first call."""

    def reset(self) -> None:
        """Forget the rollout cache: a new episode, of any number of streams."""

    def predict(
        self,
        obs: Mapping[str, FloatArray],
        noise: Noise,
        plan: npt.ArrayLike | None = None,
        *,
        plan_name: str | None = None,
        repair: bool = False,
        correction: Correction | None = None,
        known: Known | None = None,
    ) -> tuple[FloatArray, CallReport]:
        """Denoise one chunk. A call that fails after its arguments were checked ends the episode, as ``reset`` does.

        Args:
            obs: normalised observation by key, ``[B, ...]`` each, of the dtype of its specification.
            noise: ``initial [B, T, D]``; ``steps [K, B, T, D]``, needed by a stochastic sampler.
            plan: ``[K, blocks]`` or ``[B, K, blocks]`` of ``Source``; None asks the pruner.
            plan_name: for the report; None for ``pruner`` or ``given``.
            repair: legalise ``plan`` and count it, rather than refuse it when it is illegal.
            correction: of the sampler's steps, which belongs to this plan; None for none.
            known: what a prefix makes known of the samples, see ``inpainting``; None for nothing.

        Returns:
            The denoised sample, float32 ``[B, T, D]``, and the report.

        Raises:
            IllegalPlanError: ``plan`` has the wrong shape, or is illegal and not to be repaired; or no plan was given
                and the artifact has no pruner.
            ObservationError: the number of streams differs from the episode's, or ``noise`` does not fit.
        """


def open_runtime(artifact: Artifact, runtime: str = "onnxruntime", threads: int = 1) -> Runtime:
    """Make a runtime for an artifact.

    Args:
        artifact: loaded and checked.
        runtime: ``onnxruntime`` or ``reference``.
        threads: threads of arithmetic. The reference runtime runs with torch's own setting.

    Raises:
        RuntimeUnavailableError: no runtime of this name, its packages are missing, or the threads cannot be had.
        ArtifactError: the parts of the artifact do not fit each other.
    """
    if not isinstance(threads, int) or isinstance(threads, bool) or not 1 <= threads <= MOST_THREADS:
        raise RuntimeUnavailableError(
            f"threads must be an integer of at least 1 and at most {MOST_THREADS}; found {threads!r}."
        )
    if runtime == "onnxruntime":
        from .onnxruntime.runtime import OnnxRuntime

        with fitting(artifact):
            return OnnxRuntime(artifact, threads)
    if runtime == "reference":
        try:
            from .reference.runtime import ReferenceRuntime
        except ModuleNotFoundError as error:
            raise RuntimeUnavailableError(
                f"runtime 'reference' needs torch, and {error.name!r} is not installed. Install 'ttscompile[compile]',"
                " or use runtime='onnxruntime'."
            ) from error
        with fitting(artifact):
            return ReferenceRuntime(artifact)
    raise RuntimeUnavailableError(f"no runtime is called {runtime!r}; expected one of {', '.join(RUNTIMES)}.")


@contextmanager
def fitting(artifact: Artifact) -> Iterator[None]:
    """Within the block whatever fails is an error of the artifact: its hashes are right, and its parts do not fit.

    Opening a runtime runs every piece once, so that an artifact that somebody put together is refused here.

    Raises:
        ArtifactError: in place of any other exception.
    """
    try:
        yield
    except TtscompileError:
        raise
    except Exception as error:
        raise ArtifactError(
            f"{artifact.path}: its manifest, tables and graphs do not fit each other"
            f" ({type(error).__name__}: {str(error)[:300]}). Convert the checkpoint again."
        ) from error


def settle_plan(
    plan: npt.ArrayLike, groups: Sequence[int], written: BoolArray, repair: bool
) -> tuple[PlanArray, tuple[int, ...]]:
    """The plan that will be executed.

    Args:
        plan: ``[K, blocks]`` or ``[B, K, blocks]``.
        groups: FORWARD group of each block.
        written: bool ``[B, K, blocks]``; rollout entries that exist.
        repair: replace illegal reads rather than refuse them.

    Returns:
        A legal plan, int8 ``[B, K, blocks]``, and the number of replaced cells of each stream.

    Raises:
        IllegalPlanError: wrong shape, or illegal and not to be repaired.
    """
    streams, steps, blocks = written.shape
    plans = check_plan(plan, steps, blocks, streams)
    if not repair:
        require_legal(plans, groups, written)
        return plans, (0,) * streams
    legal, _ = legalize(plans, groups, written)
    return legal, tuple(int(n) for n in np.count_nonzero(legal != plans, axis=(1, 2)))


def pruner_plan(logits: npt.NDArray[np.float32]) -> PlanArray:
    """Plans from the pruner's logits ``[B, K, blocks, 4]``: the largest of the four sources, int8 ``[B, K, blocks]``.

    Raises:
        IllegalPlanError: the logits are not numbers.
    """
    if np.isnan(logits).any():
        raise IllegalPlanError(
            "the pruner's logits hold NaN, so there is no plan to execute: its weights are broken."
            " Calibrate the artifact again, or use plan='dense'."
        )
    plan: PlanArray = np.argmax(logits, axis=-1).astype(np.int8)
    return plan


def no_pruner() -> IllegalPlanError:
    """The error of a call without a plan on an artifact without a pruner."""
    return IllegalPlanError(
        "no plan was given and the artifact has no pruner to make one. Give plan='dense', the name of a plan of the"
        " artifact, or a matrix; or calibrate the artifact with strategy='tts'."
    )


def check_call(streams: int | None, noise: Noise, sample: tuple[int, int], sampler: SamplerTable) -> int:
    """Number of streams of a call whose noise fits it.

    Args:
        streams: B of the episode under way, or None.
        noise: of the call.
        sample: ``(T, D)``.
        sampler: says whether the draws of the steps are read.

    Raises:
        ObservationError: see ``Runtime.predict``.
    """
    initial: tuple[int, ...] = np.shape(noise.initial)
    if len(initial) != 3 or initial[1:] != sample or initial[0] < 1:
        raise ObservationError(
            f"noise.initial has shape {initial}; expected [B, T, D] = (B, {sample[0]}, {sample[1]})."
        )
    found = initial[0]
    expected = (sampler.steps, *initial)
    draws = noise.steps if sampler.stochastic else None
    if sampler.stochastic and draws is None:
        raise ObservationError(
            f"noise.steps is None, and the sampler {sampler.name!r} draws noise at its steps; expected float32"
            f" [K, B, T, D] = {expected}."
        )
    if draws is not None and np.shape(draws) != expected:
        raise ObservationError(f"noise.steps has shape {np.shape(draws)}; expected [K, B, T, D] = {expected}.")
    if streams is not None and streams != found:
        raise ObservationError(
            f"the call has {found} streams, and the episode under way has {streams}: the rollout cache is kept for"
            " each stream. Call reset() before changing the number of streams."
        )
    return found


def computed_cells(plans: PlanArray) -> tuple[int, ...]:
    """Computed cells of each stream."""
    return tuple(int(n) for n in np.count_nonzero(plans == Source.COMPUTE, axis=(1, 2)))


def frozen(array: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """A read-only copy: what a report holds must not change after the call, and the caller's plan is the caller's."""
    array = array.copy()
    array.flags.writeable = False
    return array


def milliseconds(start: float, stop: float | None = None) -> float:
    """Milliseconds between two readings of ``time.perf_counter``, the second being now by default."""
    return 1000.0 * ((time.perf_counter() if stop is None else stop) - start)
