"""Sampler tables against the diffusers schedulers they are measured on, and the schedulers that are refused."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from diffusers.schedulers.scheduling_ddim import DDIMScheduler
from diffusers.schedulers.scheduling_ddpm import DDPMScheduler
from diffusers.schedulers.scheduling_dpmsolver_multistep import DPMSolverMultistepScheduler
from diffusers.schedulers.scheduling_euler_discrete import EulerDiscreteScheduler
from diffusers.schedulers.scheduling_flow_match_euler_discrete import FlowMatchEulerDiscreteScheduler
from diffusers.schedulers.scheduling_flow_match_heun_discrete import FlowMatchHeunDiscreteScheduler
from diffusers.schedulers.scheduling_flow_match_lcm import FlowMatchLCMScheduler
from diffusers.schedulers.scheduling_lcm import LCMScheduler
from diffusers.schedulers.scheduling_pndm import PNDMScheduler
from diffusers.schedulers.scheduling_unipc_multistep import UniPCMultistepScheduler

from tests.rounding import amplified, assert_equal_but_for_rounding, bound
from ttscompile.core.spec import SamplerTable
from ttscompile.errors import SpecError
from ttscompile.samplers.flow import flow_matching_table
from ttscompile.samplers.table import sampler_table, set_timesteps

BETAS: dict[str, Any] = {"num_train_timesteps": 50, "beta_schedule": "squaredcos_cap_v2"}


def chain_of_table(table: SamplerTable, start: torch.Tensor, outs: torch.Tensor, draws: torch.Tensor) -> torch.Tensor:
    """The loop that every runtime executes, in float32."""
    x, memory = start, torch.zeros(table.memories, *start.shape)
    for k in range(table.steps):
        a, b, p, q, r, n = (float(getattr(table, column)[k]) for column in table.COLUMNS)
        x0 = a * x + b * outs[k]
        if table.clip is not None:
            x0 = x0.clamp(-table.clip, table.clip)
        terms = torch.cat([torch.stack([x0, x, outs[k]]), memory])
        x = p * x0 + q * x + r * outs[k] + n * draws[k]
        x = x + torch.tensordot(torch.from_numpy(table.memory_to_next[k]), memory, 1)
        memory = torch.tensordot(torch.from_numpy(table.to_memory[k]), terms, 1)
    return x


CASES: list[tuple[type[Any], dict[str, Any], int, dict[str, Any]]] = [
    (DDPMScheduler, {}, 50, {}),
    (DDPMScheduler, {}, 10, {}),
    (DDPMScheduler, {"timestep_spacing": "trailing"}, 10, {}),
    (DDPMScheduler, {"prediction_type": "sample"}, 50, {}),
    (DDPMScheduler, {"variance_type": "fixed_large", "clip_sample_range": 2.0}, 25, {}),
    (DDPMScheduler, {"variance_type": "fixed_small_log", "clip_sample": False, "beta_schedule": "linear"}, 25, {}),
    (DDIMScheduler, {}, 8, {}),
    (DDIMScheduler, {}, 1, {}),
    (DDIMScheduler, {"set_alpha_to_one": False, "steps_offset": 1}, 10, {}),
    (DDIMScheduler, {"timestep_spacing": "trailing"}, 10, {}),
    (DDIMScheduler, {"timestep_spacing": "linspace", "prediction_type": "sample"}, 10, {}),
    (DDIMScheduler, {"clip_sample": False, "beta_schedule": "linear"}, 10, {}),
    (DDIMScheduler, {}, 10, {"eta": 0.7}),
    (DDIMScheduler, {}, 10, {"eta": 1.0, "use_clipped_model_output": True}),
    (DDIMScheduler, {"prediction_type": "v_prediction"}, 10, {}),
    (DDPMScheduler, {"thresholding": True, "clip_sample_range": 2.0}, 25, {}),
    (DDIMScheduler, {"thresholding": True, "clip_sample": False, "dynamic_thresholding_ratio": 0.5}, 10, {}),
]


@pytest.mark.slow
@pytest.mark.parametrize(("scheduler_class", "settings", "steps", "arguments"), CASES)
def test_table_gives_what_the_scheduler_gives(
    scheduler_class: type[Any], settings: dict[str, Any], steps: int, arguments: dict[str, Any]
) -> None:
    """Whole loops in float32, from the same noise; outputs are made up, and feed on the sample as a network's do."""
    scheduler = scheduler_class(**(BETAS | settings))
    table = sampler_table(scheduler, steps, step_arguments=arguments)
    scheduler.set_timesteps(steps)
    assert table.timesteps.tolist() == scheduler.timesteps.tolist()
    generator = torch.Generator().manual_seed(3)
    start, outs = torch.randn(2, 4, 3, generator=generator), torch.randn(steps, 2, 4, 3, generator=generator)
    x, draws = start, []
    for k, timestep in enumerate(scheduler.timesteps):
        draws.append(torch.randn(x.shape, generator=torch.Generator().manual_seed(k)))
        x = scheduler.step(outs[k], timestep, x, generator=torch.Generator().manual_seed(k), **arguments).prev_sample
    found = chain_of_table(table, start, outs, torch.stack(draws))
    assert_equal_but_for_rounding(found, x, terms=6 * steps)  # two for the clean sample, four for the next
    assert table.stochastic == (scheduler_class is DDPMScheduler or arguments.get("eta", 0) > 0)


def test_columns_of_ddpm_are_the_formula() -> None:
    """One row against the closed form of Ho et al., equation (7), by hand."""
    scheduler = DDPMScheduler(**BETAS)
    table = sampler_table(scheduler, 50)
    assert (table.name, table.clip, table.steps) == ("ddpm", 1.0, 50)
    k = 20
    now, before = (float(scheduler.alphas_cumprod[t]) for t in (49 - k, 48 - k))
    beta = 1 - now / before  # which cancels, and so is rounded by 1 / beta as much
    expected = {
        "sample_to_x0": now**-0.5,
        "out_to_x0": -((1 - now) ** 0.5) * now**-0.5,
        "x0_to_next": before**0.5 * beta / (1 - now),
        "sample_to_next": (1 - beta) ** 0.5 * (1 - before) / (1 - now),
        "out_to_next": 0.0,
        "noise_to_next": ((1 - before) / (1 - now) * beta) ** 0.5,
    }
    for column, value in expected.items():
        assert getattr(table, column)[k] == pytest.approx(value, rel=bound(9) / beta), column
    assert table.noise_to_next[-1] == 0  # the last step draws none
    assert np.all(table.noise_to_next[:-1] > 0)


def test_paths_are_told_apart() -> None:
    """DDIM's output reaches the next sample past the clip; DDPM's does not, its sample does."""
    ddim, ddpm = sampler_table(DDIMScheduler(**BETAS), 10), sampler_table(DDPMScheduler(**BETAS), 10, name="mine")
    assert (ddim.name, ddpm.name) == ("ddim", "mine")
    assert np.all(ddim.out_to_next[:-1] > 0.01)
    assert np.all(ddim.sample_to_next == 0)
    assert np.all(ddpm.out_to_next == 0)
    assert np.all(ddpm.sample_to_next[:-1] > 0)
    rows = [[getattr(table, c)[-1] for c in table.COLUMNS[2:]] for table in (ddim, ddpm)]
    np.testing.assert_array_equal(rows, [[1, 0, 0, 0]] * 2)  # both end on x0 itself


def near_miss(base: type[Any], name: str, change: Callable[[Any, Any, Any], Any]) -> type[Any]:
    """A scheduler whose next sample is ``change(next, output, sample)``."""

    def step(self: Any, model_output: Any, timestep: Any, sample: Any, *args: Any, **kwargs: Any) -> Any:
        result = base.step(self, model_output, timestep, sample, *args, **kwargs)
        result.prev_sample = change(result.prev_sample, model_output, sample)
        return result

    return type(name, (base,), {"step": step})


class Multistep(DDIMScheduler):
    """Averages with the output of the step before."""

    before: Any = None

    def set_timesteps(self, *args: Any, **kwargs: Any) -> None:
        super().set_timesteps(*args, **kwargs)
        self.before = None

    def step(self, model_output: Any, timestep: Any, sample: Any, *args: Any, **kwargs: Any) -> Any:
        mixed = model_output if self.before is None else 0.9 * model_output + 0.1 * self.before
        self.before = model_output
        return super().step(mixed, timestep, sample, *args, **kwargs)


class OneSided(DDIMScheduler):
    """Bounds the sample from above, so that x0 stops at another value in every step."""

    def step(self, model_output: Any, timestep: Any, sample: Any, *args: Any, **kwargs: Any) -> Any:
        return super().step(model_output, timestep, sample.clamp(max=0.3), *args, **kwargs)


class Silent(DDIMScheduler):
    """Does not say what it takes the clean sample for."""

    def step(self, model_output: Any, timestep: Any, sample: Any, *args: Any, **kwargs: Any) -> Any:
        made: Any = super().step(model_output, timestep, sample, *args, **kwargs)
        made.pred_original_sample = None
        return made


class TwoDraws(DDPMScheduler):
    """Draws its noise twice."""

    def step(self, model_output: Any, timestep: Any, sample: Any, *args: Any, **kwargs: Any) -> Any:
        torch.randn(sample.shape, generator=kwargs["generator"], dtype=sample.dtype)
        return super().step(model_output, timestep, sample, *args, **kwargs)


NEAR_MISSES = [
    Multistep,
    near_miss(DDIMScheduler, "Curved", lambda after, out, sample: after + 1e-4 * out**2),
    near_miss(DDIMScheduler, "PerChannel", lambda x, out, sample: x * (1 + 0.01 * (torch.arange(x.shape[-1]) == 2))),
    near_miss(DDIMScheduler, "Mixing", lambda after, out, sample: after - 0.01 * sample.mean(dim=1, keepdim=True)),
    near_miss(DDIMScheduler, "Shifting", lambda after, out, sample: after + 0.01),
    TwoDraws,
]


@pytest.mark.parametrize("scheduler_class", NEAR_MISSES)
def test_near_misses_are_refused(scheduler_class: type[Any]) -> None:
    """Each differs from a good scheduler by little, and each is found out."""
    with pytest.raises(SpecError, match=f"{scheduler_class.__name__} does not have the form"):
        sampler_table(scheduler_class(**BETAS), 10)


def test_bounds_that_differ_are_refused() -> None:
    """One bound holds for the whole table."""
    with pytest.raises(SpecError, match="OneSided clips x0 at .* not alike at every step"):
        sampler_table(OneSided(**BETAS), 10)


@pytest.mark.parametrize(
    ("scheduler_class", "settings", "message"),
    [
        (DDPMScheduler, {"thresholding": True, "sample_max_value": 2.0}, "thresholding=True"),
        (DDIMScheduler, {"thresholding": True, "sample_max_value": 0.5}, "makes it a clip"),
        (DDPMScheduler, {"variance_type": "learned_range"}, "variance_type='learned_range'"),
        (DDIMScheduler, {"rescale_betas_zero_snr": True, "timestep_spacing": "trailing"}, "not finite"),
        (DPMSolverMultistepScheduler, {"thresholding": True, "sample_max_value": 1.5}, "makes it a clip"),
        (DPMSolverMultistepScheduler, {"variance_type": "learned"}, "variance_type='learned'"),
        (DPMSolverMultistepScheduler, {"timestep_spacing": "leading", "num_train_timesteps": 10}, "1 different noise"),
        (
            UniPCMultistepScheduler,
            {},
            r"UniPCMultistepScheduler: no table .* DPMSolverMultistepScheduler.from_config\(",
        ),
        (EulerDiscreteScheduler, {}, "standard deviation"),
        (LCMScheduler, {"original_inference_steps": 20}, "LCMScheduler: no table can be measured"),
        (PNDMScheduler, {}, "19 timesteps for 10 steps"),
        (Silent, {}, r"failed: it gives no prediction of the clean sample\. Use a DDPM"),
    ],
)
def test_other_samplers_are_refused_by_name(scheduler_class: type[Any], settings: dict[str, Any], message: str) -> None:
    """With what they are, not with a stack trace of diffusers."""
    with pytest.raises(SpecError, match=message):
        sampler_table(scheduler_class(**(BETAS | settings)), 10)


@pytest.mark.parametrize("trained", [1000, 100])
def test_of_flow_matching_the_schedulers_own_times_make_the_loop(trained: int) -> None:
    """The message says so: one loop against the scheduler's, on outputs that are made up."""
    scheduler = FlowMatchEulerDiscreteScheduler(trained, shift=3.0)
    named = (
        r"FlowMatchEulerDiscreteScheduler is .*"
        rf"flow_matching_table\(scheduler.sigmas.tolist\(\), timestep_scale={trained}\)"
    )
    with pytest.raises(SpecError, match=named):
        sampler_table(scheduler, 10)
    scheduler.set_timesteps(10)
    table = flow_matching_table(scheduler.sigmas.tolist(), timestep_scale=trained)
    np.testing.assert_allclose(table.timesteps, scheduler.timesteps.numpy(), rtol=bound(4))
    start, *outs = torch.randn(11, 2, 4, 3, generator=torch.Generator().manual_seed(0))
    x = start
    for out, timestep in zip(outs, scheduler.timesteps, strict=True):
        x = scheduler.step(out, timestep, x).prev_sample
    assert_equal_but_for_rounding(chain_of_table(table, start, torch.stack(outs), torch.stack(outs)), x, terms=40)


@pytest.mark.parametrize(
    "scheduler",
    [
        FlowMatchLCMScheduler(),  # a loop of the same times ends elsewhere, by as much as other noise would
        FlowMatchEulerDiscreteScheduler(stochastic_sampling=True),
        FlowMatchHeunDiscreteScheduler(),
    ],
)
def test_another_method_of_flow_matching_is_not_called_its_table(scheduler: Any) -> None:
    with pytest.raises(
        SpecError, match=f"{type(scheduler).__name__}.* has no table; that of Euler's steps without noise is"
    ):
        sampler_table(scheduler, 10)


@pytest.mark.parametrize(
    ("steps", "arguments", "message"),
    [
        (51, {}, "51 denoising steps are not possible; the policy was trained with 50 timesteps"),
        (10, {"eta": 0.5}, r"unexpected keyword argument 'eta'.*\['eta'\]"),
    ],
)
def test_impossible_settings(steps: int, arguments: dict[str, Any], message: str) -> None:
    """More steps than were trained; DDIM's eta for DDPM."""
    with pytest.raises(SpecError, match=message):
        sampler_table(DDPMScheduler(**BETAS), steps, step_arguments=arguments)


DPM: dict[str, Any] = {"num_train_timesteps": 100, "beta_schedule": "squaredcos_cap_v2"}
RDT: dict[str, Any] = {"num_train_timesteps": 1000, "beta_schedule": "squaredcos_cap_v2", "prediction_type": "sample"}
"""The scheduler of RDT-1B, which takes five steps."""

MULTISTEP: list[tuple[dict[str, Any], int, int]] = [
    ({}, 16, 1),
    ({"thresholding": True}, 16, 1),
    ({"thresholding": True, "timestep_spacing": "leading", "steps_offset": 1}, 10, 1),
    ({"thresholding": True, "timestep_spacing": "trailing"}, 20, 1),
    ({"thresholding": True, "timestep_spacing": "trailing"}, 1, 0),
    ({"solver_order": 1}, 8, 0),
    ({"solver_order": 3}, 12, 2),
    ({"solver_type": "heun"}, 8, 1),
    ({"prediction_type": "v_prediction"}, 8, 1),
    (RDT, 5, 1),
    ({"final_sigmas_type": "sigma_min"}, 8, 1),
    ({"euler_at_final": True, "lower_order_final": False}, 16, 1),
    ({"use_karras_sigmas": True, "beta_schedule": "linear"}, 8, 1),
    ({"algorithm_type": "sde-dpmsolver++", "thresholding": True}, 8, 1),
]


@pytest.mark.parametrize(("settings", "steps", "memories"), MULTISTEP)
def test_multistep_tables_give_what_the_scheduler_gives(settings: dict[str, Any], steps: int, memories: int) -> None:
    """Whole loops of DPM-Solver++ in float32; what a step remembers of the ones before is in the table's memories."""
    scheduler = DPMSolverMultistepScheduler(**(DPM | settings))
    table = sampler_table(scheduler, steps)
    set_timesteps(scheduler, steps)
    assert table.timesteps.tolist() == scheduler.timesteps.tolist()
    assert (table.memories, table.clip) == (memories, 1.0 if "thresholding" in settings else None)
    assert (table.name, table.stochastic) == ("dpmsolver++", "algorithm_type" in settings)
    generator = torch.Generator().manual_seed(4)
    start, outs = torch.randn(2, 4, 3, generator=generator), torch.randn(steps, 2, 4, 3, generator=generator)
    draws = torch.randn(outs.shape, generator=generator)
    x = start
    for k, timestep in enumerate(scheduler.timesteps):
        x = scheduler.step(outs[k], timestep, x, variance_noise=draws[k]).prev_sample
    found = chain_of_table(table, start, outs, draws)
    # Two for the clean sample, four for the next, and memories; unclipped, the first prediction is up to 2,000 times
    # the noise.
    terms = (6 + memories) * steps
    assert_equal_but_for_rounding(found, x, terms if table.clip else amplified(terms, table))


def test_second_order_is_the_formula() -> None:
    """One row of DPM-Solver++ (2M) against algorithm 2 of Lu et al. (arXiv 2211.01095), by hand.

    ``x_next = sigma_next / sigma x - alpha_next (exp(-h) - 1) ((1 + 1 / (2 r)) x0 - 1 / (2 r) x0_before)``
    """
    scheduler = DPMSolverMultistepScheduler(**(DPM | {"thresholding": True, "timestep_spacing": "trailing"}))
    table = sampler_table(scheduler, 16)
    k = 7
    bars = [float(scheduler.alphas_cumprod[t]) for t in table.timesteps[k - 1 : k + 2]]
    alpha, sigma = (np.sqrt([f(bar) for bar in bars]) for f in (lambda b: b, lambda b: 1 - b))
    steps = np.diff(np.log(alpha / sigma))
    gain, r = -alpha[2] * np.expm1(-steps[1]), steps[0] / steps[1]
    rounding = bound(9) / np.abs(steps).min()  # of logarithms, which differ by little
    assert table.sample_to_next[k] == pytest.approx(sigma[2] / sigma[1], rel=rounding)
    assert table.x0_to_next[k] == pytest.approx(gain * (1 + 1 / (2 * r)), rel=rounding)
    assert table.memory_to_next[k].tolist() == [pytest.approx(-gain / (2 * r), rel=rounding)]
    np.testing.assert_array_equal(table.to_memory[k], [[1, 0, 0, 0]])  # x0 is remembered, once
    assert table.memory_to_next[0].tolist() == [0]  # the first step has nothing to remember


class LongMemory(DPMSolverMultistepScheduler):
    """Keeps a trace of the first output for ever."""

    before: Any = None

    def set_timesteps(self, *args: Any, **kwargs: Any) -> None:
        super().set_timesteps(*args, **kwargs)
        self.before = None

    def step(self, model_output: Any, *args: Any, **kwargs: Any) -> Any:
        self.before = model_output if self.before is None else self.before
        result: Any = super().step(model_output, *args, **kwargs)
        result.prev_sample = result.prev_sample + 1e-3 * self.before
        return result


CurvedMultistep = near_miss(
    DPMSolverMultistepScheduler, "CurvedMultistep", lambda after, out, sample: after + 1e-3 * out**2
)


@pytest.mark.parametrize("scheduler_class", [CurvedMultistep, LongMemory])
def test_multistep_near_misses_are_refused(scheduler_class: type[Any]) -> None:
    with pytest.raises(SpecError, match=f"{scheduler_class.__name__} does not have the form"):
        sampler_table(scheduler_class(**DPM), 10)


def test_leading_spacing_starts_too_low_and_dpm_solvers_lower_still() -> None:
    """All start from pure noise; at the first timestep of ``leading`` the network expects less."""
    found = {}
    for scheduler_class in (DDIMScheduler, DPMSolverMultistepScheduler):
        for spacing in ("leading", "trailing", "linspace"):
            scheduler = scheduler_class(**(DPM | {"timestep_spacing": spacing}))
            first = sampler_table(scheduler, 16).timesteps[0]
            found[scheduler_class, spacing] = (first, float(scheduler.alphas_cumprod[first] ** 0.5))
    assert [found[DDIMScheduler, spacing][0] for spacing in ("leading", "trailing", "linspace")] == [90, 99, 99]
    solver = [found[DPMSolverMultistepScheduler, spacing] for spacing in ("leading", "trailing", "linspace")]
    assert [first for first, _ in solver] == [80, 99, 99]
    assert solver[0][1] > 0.29  # so much of the action the network expects in the sample, and finds none
    assert found[DDIMScheduler, "leading"][1] == pytest.approx(0.14, abs=0.01)
    assert solver[1][1] < 0.001
