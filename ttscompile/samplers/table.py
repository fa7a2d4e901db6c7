"""A diffusers scheduler as a table of numbers, found by probing its ``step``.

The maths of DDPM, DDIM and DPM-Solver++ is not written down here a second time: every coefficient is measured on the
scheduler itself, in float64, and the finished table is held against it on random inputs. Whatever does not have the
form of ``SamplerTable`` (dynamic thresholding, scaled inputs, learned variances) is refused. Flow matching needs no
scheduler (``flow``), and neither does a policy that gives its actions in one evaluation (``direct_table``).

The scheduler is driven through whole chains. A multistep solver remembers what the network's outputs of the last steps
meant for the sample (``model_outputs`` of the scheduler: predictions of the clean sample for DPM-Solver++, of the noise
for DPM-Solver). So its step is linear in the sample, the output's meaning, and the meanings before, which become the
memories of ``SamplerTable``. The inputs of its chains are pulses, one in four steps; what answers a pulse, and how many
steps later, are the coefficients. Of any other scheduler all steps are probed at once, and what it does remember shows
when the table is held against it. One operation of diffusers' own is not in float64: the step of a multistep solver
rounds the sample to float32.
"""

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from torch import nn

from ..core.coercion import integer
from ..core.spec import SamplerTable
from ..errors import SpecError
from .flow import deterministic_table

NAMES = {"DDPMScheduler": "ddpm", "DDIMScheduler": "ddim", "DPMSolverMultistepScheduler": "dpmsolver++"}
"""What a table is called, by the class of its scheduler; any other is called by that."""
_UNREAD = ("UniPC", "DEIS", "SASolver", "Singlestep", "IPNDM", "LCM", "TCD")
_SHAPE = (2, 3, 4)  # of a probe; small, with no two sizes equal, so that a broadcast along the wrong axis shows
_SMALL, _FAR = 2.0**-30, 2.0**30  # inside any clip that is there, and outside of it
_PERIOD = 4  # steps between pulses; answers to a pulse must have died out by then
_TOLERANCE = 1e-8  # of the largest term of a step; float64 leaves 1e-12, a wrong form leaves 1e-3 and more
_TOLERANCE_OF_MULTISTEP = 1e-6  # which rounds the sample to float32

Array = npt.NDArray[np.float64]


@dataclass(frozen=True)
class _Rows:
    """The columns of ``SamplerTable``, float64 ``[K]``; ``before`` is ``[K, S]``, of what earlier outputs meant."""

    sample_to_x0: Array
    out_to_x0: Array
    x0_to_next: Array
    sample_to_next: Array
    out_to_next: Array
    noise_to_next: Array
    before: Array
    clip: float | None


class _Chains:
    """Drives a scheduler through all its K steps on given inputs; ``step_arguments`` go to every ``step``.

    It tells whether its outputs are remembered, and what its steps add of their noise, ``[K]``.
    """

    def __init__(self, scheduler: Any, steps: int, step_arguments: Mapping[str, Any]) -> None:
        self._scheduler, self.steps, self._step_arguments = scheduler, steps, dict(step_arguments)
        self.name, self.multistep = type(scheduler).__name__, _is_multistep(scheduler)
        self._ones = torch.ones(steps, *_SHAPE, dtype=torch.float64)
        _, _, made = self.run(0 * self._ones, 0 * self._ones, [0] * steps, self._ones.float())
        self._added = made[:, 0, 0, 0].numpy()
        self.noise_to_next = self._added / (1 if self.multistep else float(_draw(0).flatten()[0])) + 0.0

    def run(
        self, samples: torch.Tensor, outs: torch.Tensor, seeds: Sequence[int], noise: torch.Tensor, follow: bool = False
    ) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """One chain, on samples and outputs float64 ``[K, ...]``.

        A multistep solver is given the noise, float32 ``[K, ...]``; the others draw theirs with these seeds. With
        ``follow`` only the first sample is used: each step starts from what the step before made. Gives the samples
        that went into the steps, what each step says of the clean sample, or remembers; and the samples that came out.
        """
        set_timesteps(self._scheduler, self.steps)
        given, meant = [], []
        made: list[torch.Tensor] = []
        for k, timestep in enumerate(self._scheduler.timesteps):
            given.append(made[-1] if follow and k else samples[k])
            where = f"sampler {self.name}: its step at timestep {int(timestep)}"
            own: Any = {"variance_noise": noise[k]} if self.multistep else {"generator": _generator(seeds[k])}
            try:
                result = self._scheduler.step(outs[k], timestep, given[-1], **own, **self._step_arguments)
                x0 = self._scheduler.model_outputs[-1] if self.multistep else result.pred_original_sample
                if x0 is None:
                    raise TypeError("it gives no prediction of the clean sample")
                meant.append(x0.double())
                made.append(result.prev_sample.double())
            except Exception as error:
                told = f"{where} failed: {str(error).rstrip('.')}. Use a DDPM, DDIM or DPMSolverMultistep scheduler"
                raise SpecError(f"{told}; arguments given to step: {sorted(self._step_arguments)}.") from error
            if not (torch.isfinite(meant[-1]).all() and torch.isfinite(made[-1]).all()):
                remedy = "Check the betas (rescale_betas_zero_snr needs v_prediction)"
                raise SpecError(f"{where} gives values that are not finite. {remedy}.")
        return torch.stack(given), torch.stack(meant), torch.stack(made)

    def numbers(self, samples: Array, outs: Array) -> tuple[Array, Array]:
        """A chain of constants ``[K]``, without its noise: what each step says of x0, and what comes out."""
        each = [torch.from_numpy(values)[:, None, None, None] * self._ones for values in (samples, outs)]
        _, meant, made = self.run(each[0], each[1], [0] * self.steps, 0 * self._ones.float())
        # Adding zero turns -0.0 into 0.0, so that a table reads well and its bytes do not depend on a sign of nothing.
        added = 0.0 if self.multistep else self._added
        return meant[:, 0, 0, 0].numpy() + 0.0, made[:, 0, 0, 0].numpy() - added + 0.0


def _generator(seed: int) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def _draw(seed: int, dtype: torch.dtype = torch.float64) -> torch.Tensor:
    return torch.randn(_SHAPE, generator=_generator(seed), dtype=dtype)


def set_timesteps(scheduler: Any, steps: int) -> None:
    """Call the scheduler's ``set_timesteps``, without what numpy has to say about the way diffusers uses it."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "__array__ implementation", DeprecationWarning)
        scheduler.set_timesteps(steps)


def _measure(chains: _Chains) -> _Rows:
    steps, zero = chains.steps, np.zeros(chains.steps)
    period, numbers = _PERIOD if chains.multistep else 1, np.arange(steps)
    sample_to_x0, out_to_x0 = np.zeros((2, steps))
    answers = np.zeros((2, steps, period))  # of the sample out of step k, to a pulse at step k - d: sample, output
    for start in range(period):
        here = numbers % period == start
        since = (numbers - start) % period
        heard = numbers >= start  # of steps before the first pulse there is nothing to say
        for which, kept in enumerate((sample_to_x0, out_to_x0)):
            pulse = np.where(here, _SMALL, 0.0)
            meant, made = chains.numbers(*((pulse, zero) if which == 0 else (zero, pulse)))
            kept[here] = meant[here] / _SMALL
            answers[which, numbers[heard], since[heard]] = made[heard] / _SMALL
    deaf = (out_to_x0 == 0) & ((sample_to_x0 == 0) | chains.multistep)
    if deaf.any():
        where = np.flatnonzero(deaf).tolist()
        raise SpecError(f"sampler {chains.name}: at steps {where} the output has no effect on what it says of x0.")
    from_sample = np.abs(sample_to_x0) >= np.abs(out_to_x0)
    gain = np.where(from_sample, sample_to_x0, out_to_x0)
    clip, before = _clip(chains, from_sample, gain), np.zeros((steps, period - 1))
    if chains.multistep:
        out_to_next, x0_to_next = zero, answers[1, :, 0] / out_to_x0
        sample_to_next = answers[0, :, 0] - x0_to_next * sample_to_x0
        for d in range(1, period):
            before[d:, d - 1] = answers[1, d:, d] / out_to_x0[:-d]
        scale = np.abs(x0_to_next).max() + np.abs(before).max()
        used = np.flatnonzero((np.abs(before) > 1e-9 * scale).any(axis=0))
        before = before[:, : used[-1] + 1 if len(used) else 0]
    elif clip is None:
        # The path through x0 and the direct one cannot be told apart, need not be, and all is put on the direct one.
        x0_to_next = zero
        sample_to_next, out_to_next = (chains.numbers(*given)[1] for given in ((zero + 1, zero), (zero, zero + 1)))
    else:
        # Inputs beyond the bound hold x0 constant, so that what is left of a change in ``next`` is the direct path. Far
        # enough out a quarter of the way back along either input leaves x0 at its bound.
        x, out = (np.where(which, 8 * clip / gain, 0.0) for which in (from_sample, ~from_sample))
        delta, base = clip / np.abs(gain), chains.numbers(x, out)[1]
        sample_to_next = (chains.numbers(x + delta, out)[1] - base) / delta
        out_to_next = (chains.numbers(x, out + delta)[1] - base) / delta
        x0_to_next = (base - sample_to_next * x - out_to_next * out) / clip
    return _Rows(sample_to_x0, out_to_x0, x0_to_next, sample_to_next, out_to_next, chains.noise_to_next, before, clip)


def _clip(chains: _Chains, from_sample: npt.NDArray[np.bool_], gain: Array) -> float | None:
    """The bound on x0, at which inputs far beyond it leave x0, however far they are; None if there is none."""
    x, out = (np.where(which, _FAR / gain, 0.0) for which in (from_sample, ~from_sample))
    near, far = (np.abs(chains.numbers(times * x, times * out)[0]) for times in (1, 2))
    if not (near == far).any():
        return None
    if not (near == far).all() or len(set(near.tolist())) > 1 or near[0] == 0:
        found = sorted(set(near.tolist()))
        raise SpecError(f"sampler {chains.name} clips x0 at {found}, to zero or not alike at every step.")
    return float(near[0])


def _verify(chains: _Chains, rows: _Rows) -> None:
    """Hold the rows against the scheduler: a chain that feeds on itself, and inputs inside and outside of the clip."""
    draw, shape = _generator(1), (chains.steps, *_SHAPE)
    reach = torch.from_numpy((rows.clip or 1.0) / np.maximum(np.abs(rows.sample_to_x0), np.abs(rows.out_to_x0)))
    seeds, kind = range(1000, 1000 + chains.steps), torch.float32 if chains.multistep else torch.float64
    noise = torch.stack([_draw(seed, kind) for seed in seeds])
    tolerance = _TOLERANCE_OF_MULTISTEP if chains.multistep else _TOLERANCE
    for factor in (None, 0.01, 3.0):
        samples, outs = (torch.randn(shape, generator=draw, dtype=torch.float64) for _ in range(2))
        if factor is not None:
            samples, outs = (factor * reach[:, None, None, None] * values for values in (samples, outs))
        samples = samples.float().double()
        given, meant, made = chains.run(samples, outs, seeds, noise, follow=factor is None)
        kept = [torch.zeros(_SHAPE, dtype=torch.float64)] * rows.before.shape[1]
        for k in range(chains.steps):
            unclipped = rows.sample_to_x0[k] * given[k] + rows.out_to_x0[k] * outs[k]
            x0 = unclipped if rows.clip is None else unclipped.clamp(-rows.clip, rows.clip)
            terms = [rows.x0_to_next[k] * x0, rows.sample_to_next[k] * given[k], rows.out_to_next[k] * outs[k]]
            terms += [rows.noise_to_next[k] * noise[k], *(w * m for w, m in zip(rows.before[k], kept, strict=True))]
            expected = torch.stack(terms).sum(0)
            scale = max(1.0, float(unclipped.abs().max()), *(float(term.abs().max()) for term in terms))
            error = max(float((meant[k] - x0).abs().max()), float((made[k] - expected).abs().max()))
            if not error <= tolerance * scale:
                raise SpecError(
                    f"sampler {chains.name} does not have the form next = p * clip(a * x + b * out) + q * x + r * out +"
                    f" n * noise, with earlier clipped sums for a multistep solver: at step {k} a random input is off"
                    f" by {error:.1e} (largest term {scale:.1e}). Use DDPM, DDIM or DPM-Solver++"
                    " (DPMSolverMultistepScheduler without dynamic thresholding)."
                )
            kept = [x0, *kept][: len(kept)]


def _refuse_known(scheduler: Any) -> None:
    """Refuse by name what probing would refuse by number."""
    name, config = type(scheduler).__name__, scheduler.config
    if name.startswith("FlowMatch"):
        euler = name == "FlowMatchEulerDiscreteScheduler" and not config.get("stochastic_sampling")
        told = "is of flow matching, whose loop is" if euler else "has no table; that of Euler's steps without noise is"
        given = f"scheduler.sigmas.tolist(), timestep_scale={config.num_train_timesteps}"
        raise SpecError(f"sampler {name} {told} ttscompile.flow_matching_table({given}) after set_timesteps.")
    if any(part in name for part in _UNREAD):
        remedy = "Use DPMSolverMultistepScheduler.from_config(scheduler.config), which has the same betas."
        raise SpecError(f"sampler {name}: no table can be measured of its steps. {remedy}")
    # With a largest value of 1, dynamic thresholding is a plain clip to -1..1.
    if config.get("thresholding") and config.get("sample_max_value") != 1:
        told = "depends on the whole sample; set it to False, or sample_max_value to 1, which makes it a clip"
        raise SpecError(f"sampler {name}: thresholding=True {told}.")
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
        name: of the table; that of ``NAMES``, or else the scheduler's class, where it is not given.
        step_arguments: further keyword arguments of ``step`` (``eta`` of DDIM).

    Returns:
        The table, K rows in order of execution.

    Raises:
        SpecError: the scheduler refuses the settings, or its step is not of the form of ``SamplerTable``.
    """
    steps, name_of = integer(steps, "steps", SpecError, 1), type(scheduler).__name__
    _refuse_known(scheduler)
    trained = scheduler.config.get("num_train_timesteps")
    if isinstance(trained, int) and steps > trained:
        limit = f"the policy was trained with {trained} timesteps, so expected as many at most"
        raise SpecError(f"sampler {name_of}: {steps} denoising steps are not possible; {limit}.")
    try:
        set_timesteps(scheduler, steps)
    except Exception as error:
        raise SpecError(f"sampler {name_of}: {steps} denoising steps are not possible: {error}") from error
    timesteps = torch.as_tensor(scheduler.timesteps)
    if timesteps.shape != (steps,):
        remedy = "use another number of steps or timestep spacing, or another sampler: DDPM, DDIM, DPM-Solver++"
        raise SpecError(f"sampler {name_of} has {len(timesteps)} timesteps for {steps} steps; {remedy}.")
    rescale, x = getattr(scheduler, "scale_model_input", None), _draw(1)
    if rescale is not None and not torch.equal(rescale(x, timesteps[0]), x):
        raise SpecError(f"sampler {name_of} rescales the sample before the network; use DDPM, DDIM or DPM-Solver++.")
    if _is_multistep(scheduler):
        distinct = len(set(torch.as_tensor(scheduler.sigmas[:-1]).tolist()))
        if distinct != steps:
            found = f"sampler {name or name_of}: {scheduler.config.timestep_spacing!r} timestep spacing gives {steps}"
            remedy = "Use fewer steps, or 'trailing' spacing"
            raise SpecError(f"{found} steps only {distinct} different noise levels. {remedy}.")
    chains = _Chains(scheduler, steps, step_arguments or {})
    rows = _measure(chains)
    _verify(chains, rows)
    count = rows.before.shape[1]
    shift = np.eye(count, 3 + count, 2)  # each memory is the one before
    shift[:1] = np.eye(1, 3 + count)  # but the newest, which is what the output meant
    return SamplerTable(
        name=name or NAMES.get(name_of, name_of),
        timesteps=timesteps.numpy(),
        clip=rows.clip,
        **{column: getattr(rows, column).astype(np.float32) for column in SamplerTable.COLUMNS},
        memory_to_next=rows.before.astype(np.float32),
        to_memory=np.tile(shift, (steps, 1, 1)).astype(np.float32),
    )


class DirectDenoiser(nn.Module):
    """The network as ``compile_denoiser`` takes it: ``forward(sample, timestep, **observations)``.

    ``network(**observations)`` gives the actions ``[B, T, D]``; all of it leaves the loop. A residual stream begins
    with the sample, so that is read, and nothing depends on it.
    """

    def __init__(self, network: nn.Module) -> None:
        super().__init__()
        self.network = network

    def forward(self, sample: torch.Tensor, timestep: torch.Tensor, **observations: torch.Tensor) -> torch.Tensor:
        """``[B, T, D]``, ``[B]`` -> ``[B, T, D]``."""
        return self.network(**observations) + 0 * sample  # type: ignore[no-any-return]


def direct_table() -> SamplerTable:
    """The loop of a ``DirectDenoiser``: one step, whose result is the prediction."""
    return deterministic_table("direct", np.zeros(1), None, out_to_x0=np.ones(1), x0_to_next=np.ones(1))
