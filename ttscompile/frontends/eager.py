"""The policy's denoising loop in plain PyTorch: what a compiled policy is measured against.

It shares nothing with the loop of the reference runtime on purpose: what it gives is the record that this is held to.
"""

from collections.abc import Callable, Mapping

import torch
from torch import nn

from ..core.spec import Noise, PolicySpec
from ..errors import ObservationError
from .encoded import parts

EagerPolicy = Callable[[Mapping[str, torch.Tensor], Noise], torch.Tensor]


def eager_policy(module: nn.Module, spec: PolicySpec) -> EagerPolicy:
    """The loop as the original runs it: the whole network once a step, an observation encoder before it once a call.

    It takes normalised observations ``{key: [B, ...]}`` and the noise of a call, and gives the denoised sample
    ``[B, T, D]`` on the CPU. Runs where the module is. Raises ObservationError: a stochastic sampler has no noise.
    """
    device = next((weight.device for weight in module.parameters()), None)
    table = spec.sampler
    rows = [tuple(float(getattr(table, column)[k]) for column in table.COLUMNS) for k in range(table.steps)]
    timesteps = torch.from_numpy(table.timesteps).to(device)

    def run(observations: Mapping[str, torch.Tensor], noise: Noise) -> torch.Tensor:
        if table.stochastic and noise.steps is None:
            raise ObservationError(
                f"noise.steps is None, but sampler {table.name} draws noise; expected [K, B, T, D], K = {table.steps}."
            )
        with torch.inference_mode():
            evaluate = evaluation(module, spec, {key: value.to(device) for key, value in observations.items()})
            x = torch.from_numpy(noise.initial).to(device)
            draws = None if noise.steps is None else torch.from_numpy(noise.steps).to(device)
            memory = [torch.zeros_like(x)] * table.memories
            for k, (to_x0, out_to_x0, x0_to_next, to_next, out_to_next, noise_to_next) in enumerate(rows):
                out = evaluate(x, timesteps[k].expand(x.shape[0]))
                x0 = to_x0 * x + out_to_x0 * out
                if table.clip is not None:
                    x0 = x0.clamp(-table.clip, table.clip)
                following = x0_to_next * x0 + to_next * x + out_to_next * out
                for weight, kept in zip(table.memory_to_next[k].tolist(), memory, strict=True):
                    following = following + weight * kept
                if noise_to_next and draws is not None:
                    following = following + noise_to_next * draws[k]
                terms = (x0, x, out, *memory)
                memory = [
                    sum((weight * term for weight, term in zip(each, terms, strict=True)), torch.zeros_like(x))
                    for each in table.to_memory[k].tolist()
                ]
                x = following
            return x.cpu()

    return run


def evaluation(
    module: nn.Module, spec: PolicySpec, observations: Mapping[str, torch.Tensor]
) -> Callable[[torch.Tensor, torch.Tensor], torch.Tensor]:
    """One evaluation of the denoiser, a function of sample and timesteps, for these observations."""
    one = next(iter(observations.values()))
    uncommitted = {key: torch.from_numpy(count).to(one.device) for key, count in spec.committed(len(one)).items()}
    named = {spec.arguments[key]: value for key, value in (uncommitted | dict(observations)).items()}
    encoder, denoiser = parts(module)
    if encoder is not None:
        encoded = encoder(named)
        return lambda sample, timestep: denoiser(sample, timestep, encoded)
    return lambda sample, timestep: module(**{spec.sample_argument: sample, spec.timestep_argument: timestep}, **named)
