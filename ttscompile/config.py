"""What a policy is beside its network: sampler tables, normaliser, chunking, observations. Frozen and checked.

Nothing here imports torch; the same records are written to the artifact and read on the robot.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from .errors import SpecError

FloatArray = npt.NDArray[np.float32]

FP32, BF16, INT8 = "fp32", "bf16", "int8"
PRECISIONS = (FP32, BF16, INT8)
"""Names of what the weights of residual blocks can be asked for in."""


@dataclass(frozen=True)
class Affine:
    """A normaliser: ``x * scale + offset``; inverted as ``(x - offset) / scale``.

    Attributes:
        scale: float32 ``[D]``, finite and not zero.
        offset: float32 ``[D]``, finite.
    """

    scale: FloatArray
    offset: FloatArray

    def __post_init__(self) -> None:
        for name in ("scale", "offset"):
            array = np.asarray(getattr(self, name), dtype=np.float32)
            if array.ndim != 1 or not np.isfinite(array).all():
                raise SpecError(f"normaliser {name} must be a finite vector; found shape {array.shape}, {array}.")
            object.__setattr__(self, name, array)
        if self.scale.shape != self.offset.shape:
            raise SpecError(f"normaliser scale {self.scale.shape} and offset {self.offset.shape} differ in length.")
        if (self.scale == 0).any():
            raise SpecError(f"normaliser scale is zero at {np.flatnonzero(self.scale == 0).tolist()}: not invertible.")

    def normalize(self, x: npt.NDArray[np.float32]) -> FloatArray:
        """``x * scale + offset`` over the last axis."""
        return np.asarray(x * self.scale + self.offset, dtype=np.float32)

    def unnormalize(self, x: npt.NDArray[np.float32]) -> FloatArray:
        """``(x - offset) / scale`` over the last axis."""
        return np.asarray((x - self.offset) / self.scale, dtype=np.float32)


@dataclass(frozen=True)
class SamplerTable:
    """One denoising loop as numbers: row k takes the sample from step k to k + 1.

    With network output ``out``::

        x0   = clip(sample_to_x0[k] * x + out_to_x0[k] * out, -clip, clip)
        next = x0_to_next[k] * x0 + sample_to_next[k] * x + out_to_next[k] * out + noise_to_next[k] * noise

    The tables are computed at compile time from diffusers' scheduler (``ttscompile.samplers``); all float32 ``[K]``.

    Attributes:
        name: ``ddpm`` or ``ddim``, for people.
        timesteps: float32 ``[K]`` or int64 ``[K]``: what the network is given, in order of execution.
        clip: bound on the predicted sample; None for no bound.
    """

    name: str
    timesteps: npt.NDArray[np.int64] | FloatArray
    sample_to_x0: FloatArray
    out_to_x0: FloatArray
    x0_to_next: FloatArray
    sample_to_next: FloatArray
    out_to_next: FloatArray
    noise_to_next: FloatArray
    clip: float | None

    COLUMNS = ("sample_to_x0", "out_to_x0", "x0_to_next", "sample_to_next", "out_to_next", "noise_to_next")

    def __post_init__(self) -> None:
        timesteps = np.asarray(self.timesteps)
        kind = np.int64 if timesteps.dtype.kind in "iu" else np.float32
        object.__setattr__(self, "timesteps", timesteps.astype(kind))
        if timesteps.ndim != 1 or len(timesteps) == 0:
            raise SpecError(f"sampler timesteps must be a non-empty vector; found shape {timesteps.shape}.")
        for name in self.COLUMNS:
            column = np.asarray(getattr(self, name), dtype=np.float32)
            if column.shape != timesteps.shape or not np.isfinite(column).all():
                raise SpecError(f"sampler column {name} must hold {len(timesteps)} finite numbers; found {column}.")
            object.__setattr__(self, name, column)

    @property
    def steps(self) -> int:
        """K, the number of denoising steps."""
        return len(self.timesteps)

    @property
    def stochastic(self) -> bool:
        """Whether any step adds noise, so that a call needs ``Noise.steps``."""
        return bool((self.noise_to_next != 0).any())


@dataclass(frozen=True)
class ObservationSpec:
    """One array of the observation, which is one condition input of the denoiser.

    Attributes:
        shape: shape of one stream's array, for instance ``(To, Do)``.
        normalizer: applied over the last axis before the network sees it; None to pass as it is.
        dtype: numpy name of the dtype that callers must give.
    """

    shape: tuple[int, ...]
    normalizer: Affine | None = None
    dtype: str = "float32"

    def __post_init__(self) -> None:
        object.__setattr__(self, "shape", tuple(int(n) for n in self.shape))
        if not self.shape or min(self.shape) < 1:
            raise SpecError(f"an observation needs a shape of positive sizes; found {self.shape}.")
        if self.normalizer is not None and self.normalizer.scale.shape != self.shape[-1:]:
            raise SpecError(
                f"normaliser has {len(self.normalizer.scale)} entries for an observation of shape {self.shape}."
            )


@dataclass(frozen=True)
class ChunkSpec:
    """What of the denoised sample ``[T, D]`` is action, and what of the actions is executed.

    Attributes:
        action_dim: the first ``action_dim`` channels of the sample are the action (``action_pred``).
        start: first executed step of the chunk (``To - 1`` for Diffusion Policy).
        stop: one past the last executed step.
        normalizer: its inverse is applied to the actions; None to return them as they are.
    """

    action_dim: int
    start: int
    stop: int
    normalizer: Affine | None = None

    def __post_init__(self) -> None:
        if not 0 <= self.start < self.stop or self.action_dim < 1:
            raise SpecError(f"chunk [{self.start}:{self.stop}] of {self.action_dim} channels is empty.")


@dataclass(frozen=True)
class PolicySpec:
    """Everything ``compile_denoiser`` has to know about a module ``eps(sample, timestep, **conditions)``.

    Attributes:
        sample: shape ``(T, D)`` of one stream's noisy sample.
        observations: condition inputs in the order of the module's keyword arguments; the keys are the keys of the
            observation dictionary that ``predict_action`` takes.
        sampler: the denoising loop.
        chunk: from sample to actions.
        sample_argument: name of the module's sample argument.
        timestep_argument: name of the module's timestep argument (a ``[B]`` tensor).
        source: what this was compiled from, for people: format and variant, no path.
    """

    sample: tuple[int, int]
    observations: Mapping[str, ObservationSpec]
    sampler: SamplerTable
    chunk: ChunkSpec
    sample_argument: str = "sample"
    timestep_argument: str = "timestep"
    source: Mapping[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        object.__setattr__(self, "sample", tuple(int(n) for n in self.sample))
        if len(self.sample) != 2 or min(self.sample) < 1:
            raise SpecError(f"the sample's shape must be (T, D); found {self.sample}.")
        if not self.observations:
            raise SpecError("a policy needs at least one observation: a condition input of the denoiser.")
        taken = {self.sample_argument, self.timestep_argument}
        for key in self.observations:
            if key in taken or not key.isidentifier():
                raise SpecError(f"observation key {key!r} must be an identifier other than {sorted(taken)}.")
        horizon, channels = self.sample
        if self.chunk.stop > horizon or self.chunk.action_dim > channels:
            raise SpecError(
                f"chunk [{self.chunk.start}:{self.chunk.stop}] of {self.chunk.action_dim} channels does not fit a"
                f" sample of {horizon} steps and {channels} channels."
            )
        normalizer = self.chunk.normalizer
        if normalizer is not None and len(normalizer.scale) != self.chunk.action_dim:
            found = len(normalizer.scale)
            raise SpecError(f"action normaliser has {found} entries for {self.chunk.action_dim} channels.")


@dataclass(frozen=True)
class Noise:
    """The random numbers of one call.

    Attributes:
        initial: float32 ``[B, T, D]``, the sample at step 0.
        steps: float32 ``[K, B, T, D]``, the draw used at step k; None for a deterministic sampler.
    """

    initial: FloatArray
    steps: FloatArray | None = None
