"""The golden record: what the original network answered when the artifact was made, kept in the artifact.

It is small whatever the policy is: inputs of a call and what came of it are kept as they are; residuals, predictions
and the sample after each step as ``DIGITS`` random projections of each stream, which keep the relative size of an error
within some tens of per cent (Johnson and Lindenstrauss, 1984) and are compared with tolerances far above rounding.
Residuals are of blocks taken one by one, each given a pseudorandom stream that nobody has to store. Large observations
are a pattern that repeats. Whoever checks needs numpy alone.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from ..core.coercion import Array, Arrays
from ..core.spec import ORIGINAL, FloatArray, Noise, PolicySpec
from ..errors import ArtifactError
from ..ir.graph import TensorType
from ..ir.pieces import LAYERS
from . import tensors
from .manifest import Manifest, PlanRecord
from .strict_json import REMEDY

if TYPE_CHECKING:
    from .load import Artifact

DIGITS = 16
"""Random projections that are kept of an array, for each stream."""

PATTERN = 16384
"""Numbers of one stream's observation that are stored; a larger observation repeats them."""

_PREFIXES = {"observations": "observation/", "normalized": "normalized/"}
_COMMON = ("observations", "normalized", "initial", "scales", "loops")
"""What the records of all loops have in common, and what is of the original alone."""


@dataclass(frozen=True, eq=False)
class Golden:
    """Inputs of one call of B streams, and what the original module made of them in eager PyTorch, in one loop.

    Residuals are those of the captured graph before any pass of the compiler changed it.

    Attributes:
        observations: by key ``[B, ...]`` as ``predict_action`` takes them; patterns, see ``expand``.
        normalized: by key ``[B, ...]``, what the module was given; patterns.
        initial: float32 ``[B, T, D]``, the sample at step 0.
        draws: float32 ``[K, B, T, D]``; None for a deterministic sampler.
        steps: int64 ``[A]``, the steps whose residuals are kept.
        scales: float32 ``[blocks]``, standard deviation of the residual stream before each block.
        residuals: float32 ``[A, blocks, B, DIGITS]``, projections of each block's residual on ``probe_stream``.
        layers: float32 ``[E, L, DIGITS]``, projections of what each output of the piece ``layers`` is on
            ``probe_stream``, of all streams together; None where there is no such piece.
        evaluated: int64 ``[E]``, steps at which single evaluations of the network are kept.
        inputs: float32 ``[E, B, T, D]``, the samples that it was given there.
        outputs: float32 ``[E, B, T, D]``, what it gave.
        predictions: float32 ``[K, B, DIGITS]``, projections of what it gave at every step.
        path: float32 ``[K, B, DIGITS]``, projections of the sample after every step.
        sample: float32 ``[B, T, D]``, the denoised sample.
        actions: float32 ``[B, T, Da]``, the same as ``action_pred``.
        executed: float32 ``[B, Ta, Da]``, the same as ``action``.
        loops: by further loop, the record of a call in it; with the same observations, initial sample and scales.
    """

    observations: Arrays
    normalized: Arrays
    initial: FloatArray
    draws: FloatArray | None
    steps: npt.NDArray[np.int64]
    scales: FloatArray
    residuals: FloatArray
    layers: FloatArray | None
    evaluated: npt.NDArray[np.int64]
    inputs: FloatArray
    outputs: FloatArray
    predictions: FloatArray
    path: FloatArray
    sample: FloatArray
    actions: FloatArray
    executed: FloatArray
    loops: Mapping[str, Golden] = field(default_factory=dict)

    def in_loop(self, name: str) -> Golden:
        """The record of one loop alone."""
        return replace(self, loops={}) if name == ORIGINAL else self.loops[name]

    @property
    def streams(self) -> int:
        """B."""
        return len(self.initial)

    @property
    def noise(self) -> Noise:
        """Of the call."""
        return Noise(self.initial, self.draws)

    def arrays(self) -> dict[str, Array]:
        """All of it by name, for a file: what is of a further loop as ``loop/NAME/path``."""
        found: dict[str, Array] = {"initial": self.initial, "scales": self.scales}
        for name, prefix in _PREFIXES.items():
            found |= {prefix + key: array for key, array in getattr(self, name).items()}
        for loop, record in {ORIGINAL: self, **self.loops}.items():
            own = {name: value for name, value in vars(record).items() if name not in _COMMON and value is not None}
            found |= {_start(loop) + name: value for name, value in own.items()}
        return found

    def raw_observations(self, spec: PolicySpec) -> dict[str, Array]:
        """What ``predict_action`` is given, ``[B, ...]``."""
        return {key: expand(self.observations[key], one.shape) for key, one in spec.observations.items()}

    def network_observations(self, spec: PolicySpec) -> dict[str, Array]:
        """What the network is given, ``[B, ...]``."""
        return {key: expand(self.normalized[key], one.shape) for key, one in spec.observations.items()}


@dataclass(frozen=True, eq=False)
class GoldenPlan:
    """What the reference runtime made of one plan when it was calibrated: an episode of two calls.

    The first call has the inputs of ``Golden``; the second the same with the order of the streams reversed.

    Attributes:
        plan: int8 ``[2, B, K, blocks]``, as executed.
        path: float32 ``[2, K, B, DIGITS]``, projections of the sample after every step.
        sample: float32 ``[2, B, T, D]``, the denoised samples.
    """

    plan: npt.NDArray[np.int8]
    path: FloatArray
    sample: FloatArray


def plan_arrays(plans: Mapping[str, GoldenPlan]) -> dict[str, Array]:
    """Records of plans by name, for a file."""
    return {f"{name}/{field}": array for name, one in plans.items() for field, array in vars(one).items()}


def load_golden(artifact: Artifact) -> Golden:
    """The record of an artifact. Raises ArtifactError: it has none, or one that does not fit."""
    manifest, spec = artifact.manifest, artifact.manifest.spec
    if manifest.stores.golden is None:
        raise ArtifactError(
            f"{artifact.path}: expected a golden record of the original network; found none: it was written by"
            " 'write_artifact' alone. Convert the checkpoint with 'ttscompile convert', or use compile_denoiser."
        )
    with artifact.reading(manifest.stores.golden):
        arrays, where = tensors.read(artifact.files / manifest.stores.golden), f"{artifact.path}: golden record"
    streams = _length(arrays, "initial")
    wanted: dict[str, tuple[str, tuple[int, ...]]] = {
        "initial": ("float32", (streams, *spec.sample)),
        "scales": ("float32", (len(manifest.blocks),)),
    }
    for key, one in spec.observations.items():
        shape = (streams, pattern_size(one.shape))
        wanted[_PREFIXES["observations"] + key] = (one.dtype, shape)
        wanted[_PREFIXES["normalized"] + key] = (one.dtype if one.normalizer is None else "float32", shape)
    for loop in spec.all_loops:
        wanted |= _wanted_of(loop, manifest, arrays, streams)
    tensors.check_arrays("array", arrays, wanted, where)
    for loop, sampler in spec.all_loops.items():
        kept = [arrays[_start(loop) + name] for name in ("steps", "evaluated")]
        at = np.concatenate(kept)
        if not (streams and all(map(len, kept)) and ((at >= 0) & (at < sampler.steps)).all()):
            told = f"expected streams, and steps of 0..{sampler.steps - 1} of the loop {loop}"
            raise ArtifactError(f"{where}: {told}; found none, or others. {REMEDY}")
    mappings = {name: {key: arrays[start + key] for key in spec.observations} for name, start in _PREFIXES.items()}
    common = {**mappings, "initial": arrays["initial"], "scales": arrays["scales"]}
    own = [each.name for each in fields(Golden) if each.name not in _COMMON]
    records = {
        loop: Golden(**common, **{name: arrays.get(_start(loop) + name) for name in own})  # type: ignore[arg-type]
        for loop in spec.all_loops
    }
    return replace(records.pop(ORIGINAL), loops=records)


def _start(loop: str) -> str:
    return "" if loop == ORIGINAL else f"loop/{loop}/"


def _length(arrays: Arrays, name: str) -> int:
    return len(arrays[name]) if name in arrays and arrays[name].ndim else 0


def _wanted_of(loop: str, manifest: Manifest, arrays: Arrays, streams: int) -> dict[str, tuple[str, tuple[int, ...]]]:
    """Dtype and shape of every array that is of one loop, by its name."""
    spec, start = manifest.spec.in_loop(loop), _start(loop)
    anchors, evaluated = (_length(arrays, start + name) for name in ("steps", "evaluated"))
    steps, sample = spec.sampler.steps, (streams, *spec.sample)
    projected = (steps, streams, DIGITS)
    float32: dict[str, tuple[int, ...]] = {
        "residuals": (anchors, len(manifest.blocks), streams, DIGITS),
        "inputs": (evaluated, *sample),
        "outputs": (evaluated, *sample),
        "predictions": projected,
        "path": projected,
        "sample": sample,
        "actions": (streams, spec.sample[0], spec.chunk.action_dim),
        "executed": (streams, spec.chunk.executes, spec.chunk.action_dim),
    }
    if spec.sampler.stochastic:
        float32["draws"] = (steps, *sample)
    if LAYERS in manifest.pieces:
        float32["layers"] = (evaluated, len(manifest.pieces[LAYERS].outputs), DIGITS)
    wanted = {start + name: ("float32", shape) for name, shape in float32.items()}
    return wanted | {f"{start}steps": ("int64", (anchors,)), f"{start}evaluated": ("int64", (evaluated,))}


def load_golden_plans(artifact: Artifact, streams: int) -> dict[str, GoldenPlan]:
    """Records of the plans of an artifact by name, of B ``streams`` as its ``Golden`` has; empty if it has none."""
    manifest = artifact.manifest
    if manifest.stores.golden_plans is None:
        return {}
    with artifact.reading(manifest.stores.golden_plans):
        arrays = tensors.read(artifact.files / manifest.stores.golden_plans)
    wanted = dict[str, tuple[str, tuple[int, ...]]]()
    names = sorted(name for name, plan in manifest.plans.items() if f"{name}/plan" in arrays or is_sparse(plan))
    for name in names:
        steps = manifest.steps_of(manifest.plans[name].loop)
        wanted[f"{name}/plan"] = "int8", (2, streams, steps, len(manifest.blocks))
        wanted[f"{name}/path"] = "float32", (2, steps, streams, DIGITS)
        wanted[f"{name}/sample"] = "float32", (2, streams, *manifest.spec.sample)
    tensors.check_arrays("array", arrays, wanted, f"{artifact.path}: golden record of plans")
    own = [each.name for each in fields(GoldenPlan)]
    return {name: GoldenPlan(**{field: arrays[f"{name}/{field}"] for field in own}) for name in names}


def is_sparse(plan: PlanRecord) -> bool:
    """Whether something of a plan is reused, or comes from the call before: then calibration records two calls."""
    return plan.kind != "all" or plan.otherwise is not None


def pattern_size(shape: tuple[int, ...]) -> int:
    """How many numbers of an observation of this shape are stored: whole rows of the last axis."""
    size, last = int(np.prod(shape)), shape[-1]
    return size if size <= PATTERN else max(PATTERN // last, 1) * last


def pattern(array: Array, shape: tuple[int, ...]) -> Array:
    """What is stored of ``[B, *shape]``."""
    return np.ascontiguousarray(array.reshape(len(array), -1)[:, : pattern_size(shape)])


def expand(stored: Array, shape: tuple[int, ...]) -> Array:
    """``[B, *shape]`` of a stored pattern."""
    return np.stack([np.resize(one, shape) for one in stored])


def probe_stream(block: int, kind: TensorType, streams: int, scale: float) -> FloatArray:
    """A pseudorandom residual stream, uniform with this standard deviation; the same on every machine.

    Made of the raw bits of PCG64, whose sequence numpy guarantees; that of its distributions it does not.
    """
    shape = kind.at(streams)
    bits = np.random.PCG64(1 + block).random_raw(int(np.prod(shape))) >> 40
    unit = (bits.astype(np.float64) / 2**23 - 1).astype(np.float32)
    return np.asarray(unit.reshape(shape) * np.float32(np.sqrt(3) * scale), np.float32)


def project(array: Array, axis: int | None) -> FloatArray:
    """Random projections of each stream, float32 ``[B, DIGITS]``, whose norm is about that stream's.

    A layer has no axis of streams, and is one; infinite numbers in it, of a mask, count as zeros.
    """
    rows = np.where(np.isinf(array), 0, array)[None] if axis is None else np.moveaxis(array, axis, 0)
    rows = rows.reshape(len(rows), -1).astype(np.float64)
    return np.asarray(rows @ _signs(rows.shape[1]) / np.sqrt(DIGITS), np.float32)


@lru_cache(maxsize=2)  # residuals, and samples
def _signs(size: int) -> npt.NDArray[np.float64]:
    """Pseudorandom signs ``[size, DIGITS]``."""
    bits = np.random.PCG64(0).random_raw((DIGITS * size + 63) // 64).astype("<u8").view(np.uint8)
    return 2 * np.unpackbits(bits)[: DIGITS * size].reshape(size, DIGITS).astype(np.float64) - 1
