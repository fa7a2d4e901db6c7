"""A diffusers scheduler as a table of numbers, found by probing its ``step``.

The maths of DDPM and DDIM is not written down here a second time: every coefficient is measured on the scheduler
itself, in float64, and the finished table is held against it on random inputs. Whatever does not have the form of
``SamplerTable`` (dynamic thresholding, scaled inputs, learned variances) is refused. DPM-Solver++, which remembers, is
measured in ``multistep``; flow matching needs no scheduler (``flow``).
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch

from ..core.coercion import integer
from ..core.spec import SamplerTable
from ..errors import SpecError
from .multistep import multistep_table, set_timesteps

_SHAPE = (2, 3, 4)  # of a probe; small, with no two sizes equal, so that a broadcast along the wrong axis shows
_FAR = 2.0**30  # an input this large saturates any clip that is there; its inverse stays inside any
_TOLERANCE = 1e-8  # of the largest term of a step; float64 leaves 1e-12, a wrong form leaves 1e-3 and more


_Row = tuple[tuple[float, float, float, float, float, float], float | None]
"""One step of the loop in float64: ``SamplerTable.COLUMNS``, and the clip."""


class _Probe:
    """Calls one scheduler's ``step`` on chosen inputs, in float64, with ``step_arguments`` (``eta``, say) added."""

    def __init__(self, scheduler: Any, step_arguments: Mapping[str, Any]) -> None:
        self._scheduler, self._step_arguments = scheduler, dict(step_arguments)
        self.name = type(scheduler).__name__

    def __call__(
        self, timestep: torch.Tensor, x: torch.Tensor, out: torch.Tensor, seed: int = 0
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """One step; gives ``x0`` and ``next``, or a SpecError in the scheduler's own words."""
        generator = torch.Generator().manual_seed(seed)
        try:
            result = self._scheduler.step(out, timestep, x, generator=generator, **self._step_arguments)
            x0, following = result.pred_original_sample, result.prev_sample
        except Exception as error:
            raise SpecError(
                f"sampler {self.name}: its step at timestep {int(timestep)} failed: {error} Use a DDPM, DDIM or"
                f" DPMSolverMultistep scheduler; arguments given to step: {sorted(self._step_arguments)}."
            ) from error
        if x0 is None or not (torch.isfinite(x0).all() and torch.isfinite(following).all()):
            raise SpecError(
                f"sampler {self.name}: its step at timestep {int(timestep)} gives values that are not finite, or no"
                " prediction of the clean sample. Check the betas (rescale_betas_zero_snr needs v_prediction)."
            )
        return x0, following

    def fill(self, timestep: torch.Tensor, x: float, out: float) -> tuple[float, float]:
        """One step from constant inputs without its noise; gives ``x0`` and ``next`` as numbers."""
        zero = torch.zeros(_SHAPE, dtype=torch.float64)
        _, noise = self(timestep, zero, zero)
        x0, following = self(timestep, zero + x, zero + out)
        # Adding zero turns -0.0 into 0.0, so that a table reads well and its bytes do not depend on a sign of nothing.
        return float(x0.flatten()[0]) + 0.0, float((following - noise).flatten()[0]) + 0.0


def _draw(seed: int) -> torch.Tensor:
    return torch.randn(_SHAPE, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def _probe_step(probe: _Probe, timestep: torch.Tensor) -> _Row:
    """Measure one row.

    x0 is read from the step's own ``pred_original_sample``. Where it is clipped, inputs far beyond the bound hold it
    constant, so what is left of the change in ``next`` is the direct path; otherwise the two paths cannot be told
    apart, need not be, and all of it is put on the direct one.
    """
    small = 1 / _FAR
    sample_to_x0 = probe.fill(timestep, small, 0.0)[0] / small
    out_to_x0 = probe.fill(timestep, 0.0, small)[0] / small
    zero = torch.zeros(_SHAPE, dtype=torch.float64)
    noise_to_next = float((probe(timestep, zero, zero)[1] / _draw(0)).flatten()[0]) + 0.0
    if sample_to_x0 == out_to_x0 == 0:
        raise SpecError(f"sampler {probe.name}: at timestep {int(timestep)} x0 depends on neither sample nor output.")

    from_sample = abs(sample_to_x0) >= abs(out_to_x0)
    gain = sample_to_x0 if from_sample else out_to_x0
    x, out = _FAR * from_sample / gain, _FAR * (not from_sample) / gain
    near, far = probe.fill(timestep, x, out)[0], probe.fill(timestep, 2 * x, 2 * out)[0]
    if near != far:
        sample_to_next, out_to_next = probe.fill(timestep, 1.0, 0.0)[1], probe.fill(timestep, 0.0, 1.0)[1]
        return (sample_to_x0, out_to_x0, 0.0, sample_to_next, out_to_next, noise_to_next), None
    clip = abs(near)
    if clip == 0:
        raise SpecError(f"sampler {probe.name}: at timestep {int(timestep)} x0 is clipped to zero.")

    # Far enough out that a quarter of the way back along either input leaves x0 at its bound.
    x, out = (8 * clip / gain, 0.0) if from_sample else (0.0, 8 * clip / gain)
    delta = clip / abs(gain)
    base = probe.fill(timestep, x, out)[1]
    sample_to_next = (probe.fill(timestep, x + delta, out)[1] - base) / delta
    out_to_next = (probe.fill(timestep, x, out + delta)[1] - base) / delta
    x0_to_next = (base - sample_to_next * x - out_to_next * out) / clip
    return (sample_to_x0, out_to_x0, x0_to_next, sample_to_next, out_to_next, noise_to_next), clip


def _verify(
    probe: _Probe, timestep: torch.Tensor, row: _Row, x: torch.Tensor, out: torch.Tensor, seed: int
) -> torch.Tensor:
    x0, following = probe(timestep, x, out, seed)
    (sample_to_x0, out_to_x0, *to_next), clip = row
    unclipped = sample_to_x0 * x + out_to_x0 * out
    expected_x0 = unclipped if clip is None else unclipped.clamp(-clip, clip)
    terms = [weight * term for weight, term in zip(to_next, (expected_x0, x, out, _draw(seed)), strict=True)]
    expected = terms[0] + terms[1] + terms[2] + terms[3]
    scale = max(1.0, float(unclipped.abs().max()), *(float(term.abs().max()) for term in terms))
    error = max(float((x0 - expected_x0).abs().max()), float((following - expected).abs().max()))
    if error > _TOLERANCE * scale:
        raise SpecError(
            f"sampler {probe.name} does not have the form next = p * clip(a * x + b * out) + q * x + r * out + n *"
            f" noise at timestep {int(timestep)}: a random input is off by {error:.1e} (largest term {scale:.1e})."
            " Use DDPM, DDIM or DPM-Solver++ (DPMSolverMultistepScheduler)."
        )
    return following


def _refuse_known(scheduler: Any) -> None:
    """Refuse by name what probing would refuse by number."""
    name, config = type(scheduler).__name__, scheduler.config
    # With a largest value of 1, dynamic thresholding is a plain clip to -1..1.
    if config.get("thresholding") and not (_is_multistep(scheduler) and config.get("sample_max_value") == 1):
        raise SpecError(
            f"sampler {name}: thresholding=True depends on the whole sample; set it to False, or for DPM-Solver++"
            " sample_max_value to 1, which makes it a clip."
        )
    if str(config.get("variance_type", "")).startswith("learned"):
        raise SpecError(
            f"sampler {name}: variance_type={config['variance_type']!r} needs a network with twice the channels;"
            " expected fixed_small, fixed_small_log, fixed_large or fixed_large_log."
        )
    deviation = float(getattr(scheduler, "init_noise_sigma", 1.0))
    if deviation != 1.0:
        start = f"starts from noise of standard deviation {deviation:g}"
        raise SpecError(f"sampler {name} {start}; expected 1. Use DDPM, DDIM or DPM-Solver++.")


def _is_multistep(scheduler: Any) -> bool:
    return "DPMSolverMultistepScheduler" in {base.__name__ for base in type(scheduler).__mro__}


def sampler_table(
    scheduler: Any, steps: int, *, name: str | None = None, step_arguments: Mapping[str, Any] | None = None
) -> SamplerTable:
    """Measure a denoising loop.

    Args:
        scheduler: a diffusers scheduler, configured; ``set_timesteps`` is called on it.
        steps: K, number of denoising steps.
        name: of the table, for people; the scheduler's class otherwise.
        step_arguments: further keyword arguments of ``step`` (``eta`` of DDIM).

    Returns:
        The table, K rows in order of execution.

    Raises:
        SpecError: the scheduler refuses the settings, or its step is not of the form of ``SamplerTable``.
    """
    steps = integer(steps, "steps", SpecError, 1)
    probe = _Probe(scheduler, step_arguments or {})
    _refuse_known(scheduler)
    trained = scheduler.config.get("num_train_timesteps")
    if isinstance(trained, int) and steps > trained:
        limit = f"the policy was trained with {trained} timesteps, so expected as many at most"
        raise SpecError(f"sampler {probe.name}: {steps} denoising steps are not possible; {limit}.")
    try:
        set_timesteps(scheduler, steps)
    except Exception as error:
        raise SpecError(f"sampler {probe.name}: {steps} denoising steps are not possible: {error}") from error
    timesteps = torch.as_tensor(scheduler.timesteps)
    if timesteps.shape != (steps,):
        raise SpecError(
            f"sampler {probe.name} has {len(timesteps)} timesteps for {steps} steps; use another number of steps or"
            " timestep spacing, or another sampler: DDPM, DDIM, DPM-Solver++."
        )

    x, out = _draw(1), _draw(2)
    rescale = getattr(scheduler, "scale_model_input", None)
    if rescale is not None and not torch.equal(rescale(x, timesteps[0]), x):
        raise SpecError(f"sampler {probe.name} rescales the sample before the network; use DDPM, DDIM or DPM-Solver++.")
    if _is_multistep(scheduler):
        return multistep_table(scheduler, steps, name or probe.name, step_arguments or {})
    rows = [_probe_step(probe, timestep) for timestep in timesteps]
    clips = {clip for _, clip in rows}
    if len(clips) != 1:
        raise SpecError(f"sampler {probe.name} clips x0 at {clips}, not alike at every step.")

    # A chain in order of execution, from fresh timesteps: a scheduler that remembers earlier outputs fails here.
    set_timesteps(scheduler, steps)
    for k, (timestep, row) in enumerate(zip(timesteps, rows, strict=True)):
        x = _verify(probe, timestep, row, x, _draw(100 + k), seed=1000 + k)
    # And single steps, where x0 is inside its bound and where it is outside.
    for k, (timestep, row) in enumerate(zip(timesteps, rows, strict=True)):
        for factor in (0.01, 3.0):
            (sample_to_x0, out_to_x0, *_), clip = row
            reach = factor * (clip or 1.0) / max(abs(sample_to_x0), abs(out_to_x0))
            _verify(probe, timestep, row, reach * _draw(2 * k), reach * out, seed=k)

    numbers = np.array([row for row, _ in rows], dtype=np.float32)
    columns = dict(zip(SamplerTable.COLUMNS, numbers.T.copy(), strict=True))
    return SamplerTable(name=name or probe.name, timesteps=timesteps.numpy(), clip=clips.pop(), **columns)
