"""One denoising loop as numbers: the table of a sampler. Frozen and checked; nothing here imports torch."""

from __future__ import annotations

from dataclasses import dataclass, field, fields, replace

import numpy as np
import numpy.typing as npt

from ..errors import SpecError
from .coercion import listed, numbers

FloatArray = npt.NDArray[np.float32]


@dataclass(frozen=True)
class SamplerTable:
    """One denoising loop as numbers: row k takes the sample from step k to k + 1.

    With network output ``out``, and S memories of the sample's shape that are zeros before step 0::

        x0        = clip(sample_to_x0[k] * x + out_to_x0[k] * out, -clip, clip)
        next      = x0_to_next[k] * x0 + sample_to_next[k] * x + out_to_next[k] * out + noise_to_next[k] * noise
                    + sum over s: memory_to_next[k, s] * memory[s]
        memory[s] = to_memory[k, s] . [x0, x, out, memory[0], ..., memory[S - 1]]       all s at once, after ``next``

    The tables are computed at compile time: from diffusers' scheduler (``ttscompile.samplers``), or for flow matching
    from the method's definition (``ttscompile.samplers.flow``). Columns are float32 ``[K]``. A multistep solver keeps
    earlier predictions in memories; a Runge-Kutta method, of which each evaluation is a step of its own here, what its
    stages have in common.

    Attributes:
        name: ``ddpm``, ``ddim``, ``dpmsolver++``, ``euler``, ``rk4``, ``remix`` or ``edm``, for people.
        timesteps: float32 ``[K]`` or int64 ``[K]``: what the network is given, in order of execution.
        clip: bound on the predicted sample; None for no bound.
        memory_to_next: float32 ``[K, S]``; empty where S = 0.
        to_memory: float32 ``[K, S, 3 + S]``; empty where S = 0.
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
    memory_to_next: FloatArray = field(default_factory=lambda: np.zeros((0, 0), np.float32))
    to_memory: FloatArray = field(default_factory=lambda: np.zeros((0, 0, 3), np.float32))

    COLUMNS = ("sample_to_x0", "out_to_x0", "x0_to_next", "sample_to_next", "out_to_next", "noise_to_next")

    def __post_init__(self) -> None:
        timesteps = listed(self.timesteps, "sampler timesteps", SpecError, "float32")
        kind = "int64" if timesteps.dtype.kind in "iu" else "float32"
        object.__setattr__(self, "timesteps", numbers(timesteps, "sampler timesteps", SpecError, kind))
        if timesteps.ndim != 1 or len(timesteps) == 0:
            raise SpecError(f"sampler timesteps must be a non-empty vector; found shape {timesteps.shape}.")
        for name in self.COLUMNS:
            column = numbers(getattr(self, name), f"sampler column {name}", SpecError)
            if column.shape != timesteps.shape or not np.isfinite(column).all():
                raise SpecError(f"sampler column {name} must hold {len(timesteps)} finite numbers; found {column}.")
            object.__setattr__(self, name, column)
        if self.clip is not None:
            clip = listed(self.clip, "sampler clip", SpecError, "float64")
            if clip.shape or clip.dtype.kind not in "iuf" or not 0 < clip < np.inf:
                raise SpecError(f"sampler clip must be a positive number, or None for none; found {self.clip!r:.80}.")
            object.__setattr__(self, "clip", float(clip))
        memory_to_next, to_memory = (numbers(getattr(self, n), n, SpecError) for n in ("memory_to_next", "to_memory"))
        if not memory_to_next.size and not to_memory.size:
            memory_to_next, to_memory = (np.zeros((len(timesteps), 0, *rest), np.float32) for rest in ((), (3,)))
        count = memory_to_next.shape[-1]
        expected = ((len(timesteps), count), (len(timesteps), count, 3 + count))
        if (memory_to_next.shape, to_memory.shape) != expected:
            raise SpecError(
                f"a sampler of {len(timesteps)} steps with S memories has memory_to_next [K, S] and to_memory"
                f" [K, S, 3 + S]; found {memory_to_next.shape} and {to_memory.shape}."
            )
        if not (np.isfinite(memory_to_next).all() and np.isfinite(to_memory).all()):
            raise SpecError("sampler memories must have finite coefficients.")
        object.__setattr__(self, "memory_to_next", memory_to_next)
        object.__setattr__(self, "to_memory", to_memory)

    def with_skip(self, times: int = 1) -> SamplerTable:
        """The table for a network that predicts ``out - x``: it adds the sample itself, wherever ``out`` is read.

        With -1 it is the table of which ``with_skip`` makes this one.
        """
        to_memory = self.to_memory.copy()
        to_memory[..., 1] += times * to_memory[..., 2]
        return replace(
            self,
            sample_to_x0=self.sample_to_x0 + times * self.out_to_x0,
            sample_to_next=self.sample_to_next + times * self.out_to_next,
            to_memory=to_memory,
        )

    def same_as(self, other: SamplerTable) -> bool:
        """Whether both have the same name and the same numbers."""
        return all(np.array_equal(getattr(self, each.name), getattr(other, each.name)) for each in fields(self))

    def takes_noise_as(self, other: SamplerTable) -> bool:
        """Whether the same noise means the same in both: a sampler of this name, with as many steps and draws."""
        return (self.name, self.steps, self.stochastic) == (other.name, other.steps, other.stochastic)

    @property
    def memories(self) -> int:
        """S, how many arrays of the sample's shape are carried from step to step beside it."""
        return int(self.memory_to_next.shape[1])

    @property
    def steps(self) -> int:
        """K, the number of denoising steps."""
        return len(self.timesteps)

    @property
    def bound(self) -> float | None:
        """What no number of the denoised sample exceeds, either way; None if there is nothing that would see to that.

        It is ``clip`` where the last step gives the clipped x0 and nothing beside.
        """
        beside = (self.sample_to_next[-1], self.out_to_next[-1], self.noise_to_next[-1], *self.memory_to_next[-1])
        return self.clip if self.x0_to_next[-1] == 1 and np.abs(beside).max() < 1e-9 else None

    @property
    def stochastic(self) -> bool:
        """Whether any step adds noise, so that a call needs ``Noise.steps``."""
        return bool((self.noise_to_next != 0).any())
