"""A policy beside OpenVINO (github.com/openvinotoolkit/openvino), the same weights and the same call, taking turns.

    pip install openvino nncf
    python examples/benchmark/large.py --smolvla --output DIR        # or --evo1, --pi0, or --groot
    python examples/benchmark/openvino_beside.py DIR [--threads 1] [--floats f32]

``DIR`` is what ``large.py`` leaves. OpenVINO converts the original network as two models: what the original evaluates
once a call, and one step. The loop between them is the original's. It runs with floats as it chooses, which is
bf16 where the processor has it, or as ``--floats`` says, and in eight bits as NNCF quantises both models on a few
random observations. See ``beside.py`` for what is timed.
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import click
import nncf
import numpy as np
import openvino
import torch
from beside import Array, observed, policy_of, race, race_options
from large import saved
from torch import nn

from ttscompile import Noise, PolicySpec
from ttscompile.frontends import load_checkpoint_policy
from ttscompile.frontends.eager import eager_policy
from ttscompile.frontends.encoded import EncodedDenoiser
from ttscompile.frontends.families import LoadOptions
from ttscompile.runtimes.random_calls import random_calls

LEARNED = 4
"""Random observations that a quantisation learns its ranges from: a call of a large policy takes seconds."""


class Encoder(nn.Module):
    """The encoder of a policy as a function of its arguments, in their order."""

    def __init__(self, encoder: nn.Module, names: tuple[str, ...]) -> None:
        super().__init__()
        self.encoder, self.names = encoder, names

    def forward(self, *values: torch.Tensor) -> tuple[torch.Tensor, ...]:
        """What the denoiser reads, one after the other."""
        return tuple(self.encoder(dict(zip(self.names, values, strict=True))))


class Denoiser(nn.Module):
    """One step as a function of tensors."""

    def __init__(self, denoiser: nn.Module) -> None:
        super().__init__()
        self.denoiser = denoiser

    def forward(self, sample: torch.Tensor, timestep: torch.Tensor, *encoded: torch.Tensor) -> torch.Tensor:
        """``[B, T, D]``."""
        made: torch.Tensor = self.denoiser(sample, timestep, encoded)
        return made


class Part(nn.Module):
    """A model of OpenVINO in place of a part of the policy."""

    def __init__(self, model: Any, threads: int, floats: str | None) -> None:
        super().__init__()
        settings = {"INFERENCE_NUM_THREADS": threads, "PERFORMANCE_HINT": "LATENCY"}
        settings |= {} if floats is None else {"INFERENCE_PRECISION_HINT": floats}
        self._model = openvino.Core().compile_model(model, "CPU", settings)

    def run(self, *given: torch.Tensor) -> tuple[torch.Tensor, ...]:
        """All outputs of the model."""
        made = self._model([np.ascontiguousarray(value) for value in given])
        return tuple(torch.from_numpy(np.array(made[i])) for i in range(len(self._model.outputs)))


class EncoderPart(Part):
    """In place of the encoder; ``seconds`` is what its last evaluation took."""

    seconds = 0.0

    def forward(self, named: Mapping[str, torch.Tensor]) -> tuple[torch.Tensor, ...]:
        """What the denoiser reads of arguments by name."""
        start = time.perf_counter()
        found = self.run(*named.values())
        self.seconds = time.perf_counter() - start
        return found


class DenoiserPart(Part):
    """In place of one step."""

    def forward(self, sample: torch.Tensor, timestep: torch.Tensor, encoded: tuple[torch.Tensor, ...]) -> torch.Tensor:
        """``[B, T, D]``."""
        return self.run(sample, timestep, *encoded)[0]


class OpenVino:
    """OpenVINO with both models; see ``beside.Rival``."""

    parts = "before the loop, loop"

    def __init__(self, encoder: Any, denoiser: Any, spec: PolicySpec, threads: int, floats: str | None) -> None:
        self._encoder, self._spec = EncoderPart(encoder, threads, floats), spec
        self._run = eager_policy(EncodedDenoiser(self._encoder, DenoiserPart(denoiser, threads, floats)), spec)

    def predict(self, obs: Mapping[str, Array], noise: Noise) -> tuple[Array, list[float]]:
        """The actions ``[T, D]``, and seconds."""
        given = {key: torch.from_numpy(value) for key, value in obs.items()}
        start = time.perf_counter()
        actions = self._spec.chunk.unnormalized(self._run(given, noise).numpy())[0]
        return actions, [self._encoder.seconds, time.perf_counter() - start - self._encoder.seconds]


def quantized(model: Any, seen: list[tuple[Array, ...]]) -> Any:
    """The model in eight bits, whose ranges are learned from inputs."""
    kind = nncf.ModelType.TRANSFORMER
    return nncf.quantize(model, nncf.Dataset(seen), model_type=kind, subset_size=len(seen))


@click.command(context_settings={"show_default": True})
@click.argument("folder", type=click.Path(exists=True, file_okay=False, path_type=Path))
@click.option("--floats", type=click.Choice(["f32", "bf16"]), help="Of OpenVINO; by default as it chooses.")
@race_options
def main(folder: Path, threads: int, rounds: int, fp32: bool, floats: str | None) -> None:
    """Time calls of the policy in FOLDER, and of OpenVINO with the same weights."""
    directory, task = saved(folder, policy_of(folder))
    module: Any
    module, spec = load_checkpoint_policy(directory, options=LoadOptions(task=task))
    obs, noise = observed(folder)
    named = {spec.arguments[key]: torch.from_numpy(value) for key, value in obs.items()}
    with torch.inference_mode():
        encoder = openvino.convert_model(Encoder(module.encoder, tuple(named)), example_input=tuple(named.values()))
        encoded = tuple(module.encoder(named))
        step = (torch.from_numpy(noise.initial), torch.from_numpy(spec.sampler.timesteps[:1]), *encoded)
        denoiser = openvino.convert_model(Denoiser(module.denoiser), example_input=step)
        learned = [
            tuple(np.ascontiguousarray(seen[key]) for key in obs) for seen, _ in random_calls(spec, LEARNED, seed=3)
        ]
        steps = [(step[0].numpy(), np.array([t]), *(each.numpy() for each in encoded)) for t in spec.sampler.timesteps]
    whole = OpenVino(encoder, denoiser, spec, threads, floats)
    few = OpenVino(quantized(encoder, learned), quantized(denoiser, steps), spec, threads, floats)
    rivals = {"OpenVINO": whole, "OpenVINO, int8 by NNCF": few}
    print(f"OpenVINO {openvino.__version__}, NNCF {nncf.__version__}")
    race(folder, rivals, threads, rounds, fp32)


if __name__ == "__main__":
    main()
