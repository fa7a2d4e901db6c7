"""The wrappers of ``examples/vla`` for other people's modules, on stand-ins with what the wrappers use of these."""

from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import diffusers
import pytest
import torch
from torch import Tensor, nn
from transformers import LlamaConfig, LlamaForCausalLM

import ttscompile
from tests.examples.recipes import script
from tests.families.checks import Arrays, golden, rounded
from tests.families.scaledp import ScaleDPHead
from tests.families.weights import draw_weights
from tests.rounding import Counted, assert_equal_but_for_rounding

FRAMES, WORDS, TOKENS = 2, 3, 4
dita, scaledp = (script(Path(__file__).parents[2] / "examples" / "vla", name) for name in ("dita", "scaledp"))


def seeded(module: nn.Module, arrays: Arrays) -> Any:
    shapes = {key: tuple(value.shape) for key, value in module.state_dict().items()}
    module.load_state_dict(draw_weights(shapes, int(arrays["seed"])))
    return module.eval()


def solver() -> diffusers.DDIMScheduler:
    return diffusers.DDIMScheduler(100, beta_schedule="squaredcos_cap_v2")


class Sines(nn.Module):
    """Sine and cosine of the timestep at rates down to 1 / 10,000, ``[B] -> [B, 128]``."""

    def forward(self, t: Tensor) -> Tensor:
        wave = t[:, None] * torch.logspace(0, -4, 64)
        return torch.cat([wave.sin(), wave.cos()], -1)


class Dita(nn.Module):
    """A Llama of transformers, whose embedding of words is gone."""

    token_embedding_size, tokens_per_context_image = 128, TOKENS
    time_sequence_length, trajectory_dim, num_inference_steps = 6, 7, 10
    use_action_head_diff, dim_align_type = 0, 0

    def __init__(self) -> None:
        super().__init__()
        config = LlamaConfig(
            vocab_size=7, hidden_size=128, intermediate_size=80, num_hidden_layers=2, num_attention_heads=2
        )
        self.transformer, self.time_emb = LlamaForCausalLM(config), Sines()
        self.transformer.model.embed_tokens = None
        self.noise_scheduler_eval = solver()


class Embedder(nn.Module):
    """Its waves are bfloat16, and so it fails where the weights are not."""

    frequency_embedding_size = 256

    def __init__(self, mlp: nn.Module, waves: Tensor) -> None:
        super().__init__()
        self.mlp, self._waves = mlp, waves.bfloat16()

    def timestep_embedding(self, t: Tensor, dim: int) -> Tensor:
        assert dim == self._waves.shape[1]
        return self._waves[t]

    def forward(self, t: Tensor) -> Tensor:
        return self.mlp(self.timestep_embedding(t, self.frequency_embedding_size))


class ScaleDP(ScaleDPHead):
    """Its timestep is embedded as in the original."""

    num_inference_timesteps = 10
    config = SimpleNamespace(prediction_horizon=6, input_dim=5, output_dim=5, cond_dim=18, state_dim=4)

    def __init__(self) -> None:
        super().__init__(24, heads=3, layers=2, hidden=20, horizon=6, actions=5, features=18, state=4)
        table = self.t_embedder
        self.t_embedder = Embedder(table.mlp, table.waves)  # type: ignore[assignment]
        self.noise_scheduler = solver()

    def model_forward(self, x: Tensor, t: Tensor, global_cond: Tensor, states: Tensor) -> Tensor:
        return self(x, t, global_cond, states)


def compile_dita(network: Any, directory: Path) -> Any:
    return dita.compile_head(network, directory, frames=FRAMES, words=WORDS)


Case = tuple[str, type[nn.Module], type[nn.Module], Callable[[Any, Path], Any], tuple[str, ...]]
CASES: list[Case] = [
    ("dita", Dita, dita.Head, compile_dita, ("prefix",)),
    ("scaledp", ScaleDP, scaledp.Head, scaledp.compile_head, ("features", "state")),
]


@pytest.mark.parametrize(("name", "module", "wrapper", "_", "conditions"), CASES)
def test_a_wrapper_computes_what_the_original_computes(
    name: str, module: type[nn.Module], wrapper: type[nn.Module], _: Any, conditions: tuple[str, ...]
) -> None:
    arrays = golden(name)
    head = wrapper(seeded(module(), arrays))
    inputs = {key: torch.from_numpy(arrays[key]) for key in conditions}
    with torch.no_grad(), Counted() as counted:
        made = head(torch.from_numpy(arrays["noise"]), torch.from_numpy(arrays["timesteps"]), **inputs)
    assert_equal_but_for_rounding(made, arrays["prediction"], counted.terms, max(counted.angle, 90.0))


@pytest.mark.parametrize("setting", ["use_action_head_diff", "dim_align_type"])
def test_another_dita_is_refused(setting: str) -> None:
    network = Dita()
    setattr(network, setting, 2)
    with pytest.raises(ValueError, match=f"{setting} of the network must be 0; found 2"):
        dita.Head(network)


@pytest.mark.soak
@pytest.mark.parametrize(("name", "module", "wrapper", "compiles", "conditions"), CASES)
def test_what_an_example_compiles_acts_as_the_original(
    name: str,
    module: type[nn.Module],
    wrapper: type[nn.Module],
    compiles: Callable[[Any, Path], Any],
    conditions: tuple[str, ...],
    tmp_path: Path,
) -> None:
    arrays = golden(name)
    network = seeded(module(), arrays)
    program = compiles(network, tmp_path / "compiled")
    assert [block.kind for block in program.blocks] == ["self_attention", "feed_forward"] * 2
    observed = {key: arrays[key] for key in conditions}
    policy = ttscompile.load(tmp_path / "compiled")
    out = policy.predict_action(observed, noise=ttscompile.Noise(arrays["noise"]), plan="dense")
    terms, angle = rounded(wrapper(network), observed, program.spec)
    assert_equal_but_for_rounding(out["action"], arrays["actions"], terms, max(angle, 90.0))
