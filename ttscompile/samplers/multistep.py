"""A multistep scheduler of diffusers as a table of numbers: DPM-Solver and DPM-Solver++ in their multistep form.

A multistep solver remembers what the network's outputs of the last steps meant for the sample (``model_outputs`` of
the scheduler: predictions of the clean sample for DPM-Solver++, of the noise for DPM-Solver). So its step is linear in
the sample, the output's meaning, and the meanings before, which become the memories of ``SamplerTable``. Again nothing
is written down a second time. The scheduler is driven through whole chains whose inputs are pulses, one in four steps;
what answers a pulse, and how many steps later, are the coefficients. Chains of random inputs then check them.

Everything is in float64, but for one operation of diffusers' own: its step rounds the sample to float32.
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import torch

from ..core.spec import SamplerTable
from ..errors import SpecError

_SHAPE = (2, 3, 4)
_SMALL, _FAR = 2.0**-30, 2.0**30  # inside any clip and outside of it
_PERIOD = 4  # steps between pulses; answers to a pulse must have died out by then
_TOLERANCE = 1e-6  # of the largest term of a step; diffusers rounds the sample to float32, a wrong form leaves 1e-3

Array = npt.NDArray[np.float64]


@dataclass(frozen=True)
class _Rows:
    """The columns of ``SamplerTable`` that a multistep solver uses, float64 ``[K]``; ``before`` is ``[K, S]``."""

    sample_to_x0: Array
    out_to_x0: Array
    x0_to_next: Array
    sample_to_next: Array
    noise_to_next: Array
    before: Array
    clip: float | None


class _Chains:
    """Drives a scheduler through all its K steps on given inputs; ``step_arguments`` go to every ``step``."""

    def __init__(self, scheduler: Any, steps: int, step_arguments: Mapping[str, Any]) -> None:
        self._scheduler, self.steps, self._step_arguments = scheduler, steps, dict(step_arguments)
        self.name = type(scheduler).__name__

    def run(
        self, samples: torch.Tensor, outs: torch.Tensor, noise: torch.Tensor, follow: bool = False
    ) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """One chain, on samples, outputs and noise ``[K, ...]``, the noise float32 and the others float64.

        With ``follow`` only the first sample is used: each step starts from what the step before made. Gives the
        samples that went into the steps, what the scheduler remembers of each, and the samples that came out.
        """
        set_timesteps(self._scheduler, self.steps)
        given, meant = [], []
        made: list[torch.Tensor] = []
        for k, timestep in enumerate(self._scheduler.timesteps):
            given.append(made[-1] if follow and k else samples[k])
            arguments = {"variance_noise": noise[k], **self._step_arguments}
            try:
                result = self._scheduler.step(outs[k], timestep, given[-1], **arguments)
            except Exception as error:
                raise SpecError(f"sampler {self.name}: its step at timestep {int(timestep)} failed: {error}") from error
            meant.append(self._scheduler.model_outputs[-1].double())
            made.append(result.prev_sample.double())
        return torch.stack(given), torch.stack(meant), torch.stack(made)

    def numbers(self, samples: Array, outs: Array, noise: float = 0.0) -> tuple[Array, Array]:
        """A chain of constants ``[K]``: what is remembered of each step, and what comes out, as numbers ``[K]``."""
        ones = torch.ones(self.steps, *_SHAPE, dtype=torch.float64)
        each = [torch.from_numpy(values)[:, None, None, None] * ones for values in (samples, outs)]
        _, meant, made = self.run(each[0], each[1], noise * ones.float())
        return meant[:, 0, 0, 0].numpy() + 0.0, made[:, 0, 0, 0].numpy() + 0.0


def set_timesteps(scheduler: Any, steps: int) -> None:
    """Call the scheduler's ``set_timesteps``, without what numpy has to say about the way diffusers uses it."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "__array__ implementation", DeprecationWarning)
        scheduler.set_timesteps(steps)


def multistep_table(scheduler: Any, steps: int, name: str, step_arguments: Mapping[str, Any]) -> SamplerTable:
    """Measure the denoising loop of a multistep scheduler.

    Args:
        scheduler: a configured ``DPMSolverMultistepScheduler`` after ``set_timesteps``, which is called again.
        steps: K.
        name: of the table.
        step_arguments: further keyword arguments of ``step``.

    Raises:
        SpecError: noise levels that repeat, or a step that has not the form of ``SamplerTable``.
    """
    timesteps = torch.as_tensor(scheduler.timesteps)
    distinct = len(set(torch.as_tensor(scheduler.sigmas[:-1]).tolist()))
    if distinct != steps:
        raise SpecError(
            f"sampler {name}: {scheduler.config.timestep_spacing!r} timestep spacing gives {steps} steps only"
            f" {distinct} different noise levels. Use fewer steps, or 'trailing' spacing."
        )
    chains = _Chains(scheduler, steps, step_arguments)
    rows = _measure(chains)
    _verify(chains, rows)
    columns = {column: getattr(rows, column, np.zeros(steps)) for column in SamplerTable.COLUMNS}
    count = rows.before.shape[1]
    shift = np.zeros((count, 3 + count))
    shift[0:1, 0] = 1  # the newest memory is what the output meant
    shift[range(1, count), range(3, 2 + count)] = 1
    return SamplerTable(
        name=name,
        timesteps=timesteps.numpy(),
        clip=rows.clip,
        **{column: values.astype(np.float32) for column, values in columns.items()},
        memory_to_next=rows.before.astype(np.float32),
        to_memory=np.tile(shift, (steps, 1, 1)).astype(np.float32),
    )


def _measure(chains: _Chains) -> _Rows:
    steps, name = chains.steps, chains.name
    zero, numbers = np.zeros(steps), np.arange(steps)
    sample_to_x0, out_to_x0 = np.zeros((2, steps))
    answers = np.zeros((2, steps, _PERIOD))  # of the sample out of step k, to a pulse at step k - d: sample, output
    for start in range(_PERIOD):
        here = numbers % _PERIOD == start
        since = (numbers - start) % _PERIOD
        heard = numbers >= start  # of steps before the first pulse there is nothing to say
        for which, kept in enumerate((sample_to_x0, out_to_x0)):
            pulse = np.where(here, _SMALL, 0.0)
            meant, made = chains.numbers(*((pulse, zero) if which == 0 else (zero, pulse)))
            kept[here] = meant[here] / _SMALL
            answers[which, numbers[heard], since[heard]] = made[heard] / _SMALL
    if not (np.isfinite(answers).all() and np.isfinite(sample_to_x0).all() and np.isfinite(out_to_x0).all()):
        raise SpecError(f"sampler {name}: its step gives values that are not finite. Check the betas.")
    if (out_to_x0 == 0).any():
        raise SpecError(f"sampler {name}: at steps {np.flatnonzero(out_to_x0 == 0).tolist()} the output has no effect.")
    x0_to_next = answers[1, :, 0] / out_to_x0
    before = np.zeros((steps, _PERIOD - 1))
    for d in range(1, _PERIOD):
        before[d:, d - 1] = answers[1, d:, d] / out_to_x0[:-d]
    scale = np.abs(x0_to_next).max() + np.abs(before).max()
    used = np.flatnonzero((np.abs(before) > 1e-9 * scale).any(axis=0))
    _, noise = chains.numbers(zero, zero, noise=1.0)
    return _Rows(
        sample_to_x0=sample_to_x0,
        out_to_x0=out_to_x0,
        x0_to_next=x0_to_next,
        sample_to_next=answers[0, :, 0] - x0_to_next * sample_to_x0,
        noise_to_next=noise,
        before=before[:, : used[-1] + 1 if len(used) else 0],
        clip=_clip(chains, out_to_x0),
    )


def _clip(chains: _Chains, out_to_x0: Array) -> float | None:
    zero = np.zeros(chains.steps)
    near, far = (np.abs(chains.numbers(zero, reach * _FAR / out_to_x0)[0]) for reach in (1, 2))
    if not (near == far).any():
        return None
    if not (near == far).all() or len(set(near.tolist())) > 1 or near[0] == 0:
        raise SpecError(f"sampler {chains.name} clips x0 at {sorted(set(near.tolist()))}, not alike at every step.")
    return float(near[0])


def _verify(chains: _Chains, rows: _Rows) -> None:
    """Hold the rows against the scheduler: a chain that feeds on itself, and inputs inside and outside of the clip."""
    draw = torch.Generator().manual_seed(1)
    shape = (chains.steps, *_SHAPE)
    reach = torch.from_numpy((rows.clip or 1.0) / np.maximum(np.abs(rows.sample_to_x0), np.abs(rows.out_to_x0)))
    for factor in (None, 0.01, 3.0):
        samples, outs = (torch.randn(shape, generator=draw, dtype=torch.float64) for _ in range(2))
        noise = torch.randn(shape, generator=draw)
        if factor is not None:
            samples, outs = (factor * reach[:, None, None, None] * values for values in (samples, outs))
        samples = samples.float().double()
        given, meant, made = chains.run(samples, outs, noise, follow=factor is None)
        kept = [torch.zeros(_SHAPE, dtype=torch.float64)] * rows.before.shape[1]
        for k in range(chains.steps):
            unclipped = rows.sample_to_x0[k] * given[k] + rows.out_to_x0[k] * outs[k]
            x0 = unclipped if rows.clip is None else unclipped.clamp(-rows.clip, rows.clip)
            terms = [rows.x0_to_next[k] * x0, rows.sample_to_next[k] * given[k], rows.noise_to_next[k] * noise[k]]
            terms += [weight * memory for weight, memory in zip(rows.before[k], kept, strict=True)]
            expected = torch.stack(terms).sum(0)
            scale = max(1.0, float(unclipped.abs().max()), *(float(term.abs().max()) for term in terms))
            error = max(float((meant[k] - x0).abs().max()), float((made[k] - expected).abs().max()))
            if not error <= _TOLERANCE * scale:
                raise SpecError(
                    f"sampler {chains.name} does not have the form of SamplerTable: at step {k} it is {error:.3g} off."
                    " Use DDPM, DDIM or DPM-Solver++ (DPMSolverMultistepScheduler without dynamic thresholding)."
                )
            kept = [x0, *kept][: len(kept)]
