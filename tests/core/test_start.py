"""The rest of a loop: what it begins with, and that it goes on as the whole one does."""

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import pytest
import torch
from diffusers import DDIMScheduler, DDPMScheduler, DPMSolverMultistepScheduler

from ttscompile.core.spec import SamplerTable
from ttscompile.core.start import rest_of
from ttscompile.errors import SpecError
from ttscompile.policies.last_step import clipped
from ttscompile.policies.octo_loop import own_table, schedule
from ttscompile.runtimes.reference.sampler import TorchSampler
from ttscompile.samplers.flow import flow_matching_table
from ttscompile.samplers.table import sampler_table

ROUNDING = 1e-3
"""Without a bound the first clean sample of DPM-Solver++ is thousands of times what the network says, less as much."""

BETAS = {"num_train_timesteps": 100, "beta_schedule": "squaredcos_cap_v2"}
Networks = Callable[[float, float, torch.Tensor, torch.Tensor], torch.Tensor]


def predicts_noise(a: float, s: float, action: torch.Tensor, noise: torch.Tensor) -> torch.Tensor:
    return noise


def predicts_velocity(a: float, s: float, action: torch.Tensor, noise: torch.Tensor) -> torch.Tensor:
    return a * noise - s * action


def ddim(**settings: str) -> SamplerTable:
    return sampler_table(DDIMScheduler(**BETAS, **settings), 8)


CASES: dict[str, tuple[Callable[[], SamplerTable], Networks]] = {
    "ddim": (ddim, predicts_noise),
    "velocity": (lambda: ddim(prediction_type="v_prediction"), predicts_velocity),
    "dpmsolver++": (lambda: sampler_table(DPMSolverMultistepScheduler(**BETAS), 8), predicts_noise),
    "third order": (lambda: sampler_table(DPMSolverMultistepScheduler(**BETAS, solver_order=3), 8), predicts_noise),
    "to 1": (lambda: flow_matching_table(8), lambda a, s, action, noise: action - noise),
    "to 0": (lambda: flow_matching_table(8, start=1.0, end=0.0), lambda a, s, action, noise: noise - action),
}


def samples(table: SamplerTable, initial: torch.Tensor, outs: list[torch.Tensor]) -> list[np.ndarray]:
    """Before every step, and after the last."""
    sampler = TorchSampler(table)
    found = [sampler.begin(initial)]
    for k, out in enumerate(outs):
        found.append(sampler.advance(found[-1], out, None, k))
    return [one.sample.numpy() for one in found]


@pytest.mark.parametrize("name", CASES)
def test_with_a_network_that_is_never_wrong_the_rest_meets_the_whole_loop(name: str) -> None:
    (make, network), rng = CASES[name], torch.Generator().manual_seed(0)
    table = make()
    action, noise = torch.rand((2, 4, 3), generator=rng) * 2 - 1, torch.randn((2, 4, 3), generator=rng)
    starts = [rest_of(table, table.steps - step)[1] for step in range(1, table.steps)]
    if name.startswith("to"):
        first = (0.0, 1.0)
    else:  # hardly any action is in it
        scheduler: Any = DDIMScheduler(**BETAS)
        bar = float(scheduler.alphas_cumprod[int(table.timesteps[0])])
        first = (bar**0.5, (1 - bar) ** 0.5)
    shares = [first, *((one.action, one.noise) for one in starts)]
    outs = [network(a, s, action, noise) for a, s in shares]
    whole = samples(table, shares[0][0] * action + shares[0][1] * noise, outs)
    for step in range(1, table.steps):
        rest, start = rest_of(table, table.steps - step)
        assert (start.skipped, rest.steps) == (step, table.steps - step)
        begin = start.action * action + start.noise * noise
        np.testing.assert_allclose(begin.numpy(), whole[step], atol=ROUNDING)
        np.testing.assert_allclose(samples(rest, begin, outs[step:]), whole[step:], atol=ROUNDING)


def test_noise_of_the_steps_stays_with_them() -> None:
    table = sampler_table(DDPMScheduler(**BETAS), 10)
    rest, start = rest_of(table, 4)
    assert (rest.stochastic, start.skipped) == (True, 6)
    np.testing.assert_array_equal(rest.noise_to_next, table.noise_to_next[6:])


@pytest.mark.parametrize("order", [1, 2, 3])
def test_the_first_step_of_a_rest_is_of_first_order_where_the_last_sample_alone_is_clipped(order: int) -> None:
    """As CogACT's: what the solver remembers is not clipped there."""
    table = sampler_table(DPMSolverMultistepScheduler(**BETAS, solver_order=order, timestep_spacing="leading"), 8)
    found, expected = rest_of(clipped(table, 1.0), 4)[0], clipped(rest_of(table, 4)[0], 1.0)
    for name in (*SamplerTable.COLUMNS, "memory_to_next", "to_memory"):
        np.testing.assert_allclose(getattr(found, name), getattr(expected, name), rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize(("last_steps", "found"), [(0, "0"), (8, "8"), (9, "9"), (True, "True"), (2.5, "2.5")])
def test_there_is_no_rest_of_so_many_steps(last_steps: int, found: str) -> None:
    with pytest.raises(SpecError, match=rf"last_steps.*{found}"):
        rest_of(flow_matching_table(8), last_steps)


def without_plus(prediction_type: str) -> SamplerTable:
    """DPM-Solver, whose outputs mean the noise: its columns are those of DPM-Solver++ for another kind of network."""
    settings = {"algorithm_type": "dpmsolver", "final_sigmas_type": "sigma_min", "prediction_type": prediction_type}
    with pytest.warns(FutureWarning, match="deprecated"):
        return sampler_table(DPMSolverMultistepScheduler(**BETAS, **settings), 2)


@pytest.mark.parametrize(
    "make",
    [
        lambda: flow_matching_table(2, "rk4"),
        lambda: ddim(prediction_type="sample"),
        lambda: flow_matching_table([0, 5.0, 9.0]),
        lambda: flow_matching_table(4, end=2.0),  # the last steps of which look like those of a flow to 1
        # Of a flow the noise is another share; that of its last steps is so small that any kind would do.
        lambda: sampler_table(DPMSolverMultistepScheduler(use_flow_sigmas=True, prediction_type="flow_prediction"), 50),
        lambda: own_table(*schedule(2), bound=5.0),  # Octo's network predicts noise, but x0 is the clipped sample
        *(partial(without_plus, kind) for kind in ("epsilon", "sample", "v_prediction")),
    ],
)
def test_where_the_table_does_not_tell_the_noise_there_is_none(make: Callable[[], SamplerTable]) -> None:
    with pytest.raises(SpecError, match="does not tell what part of its sample is noise"):
        rest_of(make(), 1)
