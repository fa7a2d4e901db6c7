"""``compile_denoiser`` on modules that nobody prepared: which blocks it finds, and that it computes the same."""

from pathlib import Path

import numpy as np
import pytest
import torch
from torch import nn

import ttscompile
from tests.families.checks import assert_runtimes_agree, in_loop, kinds
from tests.families.modules import CHANNELS, FEATURES, HORIZON, MODULES, TOKENS
from tests.ir.meta import assert_types_of
from tests.passes.modules import STREAMS, evaluate_pieces
from tests.passes.specs import toy_spec
from tests.quick import first_quick
from tests.rounding import Counted, assert_equal_but_for_rounding
from ttscompile import PolicySpec
from ttscompile.driver import transform
from ttscompile.ir.program import Program

LAYERS = {"self_attention": 2, "feed_forward": 2}

# Blocks of each kind, how many of them are coarse, and the largest share of the FLOPs that may stay in the loop.
FOUND: dict[str, tuple[dict[str, int], int, float]] = {
    "own DiT, adaLN-Zero, learned sigma": (LAYERS, 0, 0.85),
    "BERT, post-norm": (LAYERS, 3, 0.95),
    "parallel attention and feed-forward": ({"self_attention+feed_forward": 2}, 0, 0.95),
    "RMSNorm, SwiGLU, RoPE, qk-norm": (LAYERS, 0, 0.98),
    "channels first": (LAYERS, 0, 0.95),
    "U-ViT": ({"self_attention": 1, "feed_forward": 2, "4attention_region": 1}, 1, 0.995),
    "MM-DiT": ({"2attention_region": 1, "feed_forward": 1}, 1, 0.89),
    "guidance": (LAYERS, 0, 0.86),
    "nn.TransformerEncoder, pre-norm": (LAYERS, 0, 0.98),
    "nn.TransformerEncoder, post-norm": (LAYERS, 3, 0.98),
    "nn.TransformerDecoder": ({"self_attention": 2, "cross_attention": 2, "feed_forward": 2}, 0, 0.83),
    "cross-attention only": ({"cross_attention": 2, "feed_forward": 2}, 0, 0.81),
}

LOWERED = ("MM-DiT",)
"""Whose structure asks something of the lowering or of the runtimes; the others go there with ``-m soak``."""


def assert_found(name: str, program: Program) -> None:
    found, coarse, share = FOUND[name]
    assert_types_of(program)
    assert kinds(program) == found
    assert sum(block.residual is None for block in program.blocks) == coarse
    assert all(bool(block.reason) is (block.residual is None) for block in program.blocks)
    assert in_loop(program) < share


def made(name: str) -> tuple[nn.Module, PolicySpec]:
    torch.manual_seed(0)
    return MODULES[name]().eval(), toy_spec(sample=(HORIZON, CHANNELS), obs=(TOKENS, FEATURES), steps=4)


@pytest.mark.parametrize("name", first_quick(name for name in FOUND if name not in LOWERED))
def test_blocks_are_found_and_compute_what_the_module_computes(name: str) -> None:
    module, spec = made(name)
    program = transform(module, spec)
    assert_found(name, program)
    sample, obs = torch.randn(STREAMS, HORIZON, CHANNELS), torch.randn(STREAMS, TOKENS, FEATURES)
    for k in (0, 2):
        t = int(spec.sampler.timesteps[k])
        with torch.no_grad(), Counted() as counted:
            expected = module(sample, torch.full((STREAMS,), t), obs)
        found = evaluate_pieces(program, sample, obs, k)
        assert_equal_but_for_rounding(found, expected, counted.terms, counted.angle)


@pytest.mark.slow
@pytest.mark.parametrize("name", [pytest.param(n, marks=() if n in LOWERED else pytest.mark.soak) for n in FOUND])
def test_from_a_module_to_both_runtimes(name: str, tmp_path: Path) -> None:
    module, spec = made(name)
    assert_found(name, ttscompile.compile_denoiser(module, spec, tmp_path / "compiled"))

    rng = np.random.default_rng(0)
    obs = rng.standard_normal((STREAMS, TOKENS, FEATURES), dtype=np.float32)
    noise = ttscompile.Noise(rng.standard_normal((STREAMS, HORIZON, CHANNELS), dtype=np.float32))
    sample = torch.from_numpy(noise.initial)
    with torch.no_grad(), Counted() as counted:
        for t in spec.sampler.timesteps:
            sample = sample - 0.1 * module(sample, torch.full((STREAMS,), int(t)), torch.from_numpy(obs))
    for runtime in ("reference", "onnxruntime"):
        policy = ttscompile.load(tmp_path / "compiled", runtime=runtime)
        action = policy.predict_action({"obs": obs}, noise=noise, plan="dense")["action_pred"]
        assert_equal_but_for_rounding(action, sample, counted.terms, counted.angle)
    assert_runtimes_agree(tmp_path / "compiled")
