"""A prediction that is the sample plus more: the sampler's table adds the sample, and the blocks inside are found."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from diffusers import DDIMScheduler, DDPMScheduler, DPMSolverMultistepScheduler
from torch import nn

import ttscompile
from tests.passes.graphs import B, Builder
from tests.passes.modules import Skipping
from tests.passes.specs import toy_spec
from tests.rounding import Counted, assert_equal_but_for_rounding
from ttscompile import Noise, PolicySpec, SamplerTable
from ttscompile.driver import transform
from ttscompile.errors import PassError
from ttscompile.frontends.eager import eager_policy
from ttscompile.ir.graph import Graph
from ttscompile.ir.program import Captured
from ttscompile.passes.move_skip import MoveSkip, skips_network
from ttscompile.samplers.table import sampler_table

STEPS = 4
BETAS = {"num_train_timesteps": 40, "beta_schedule": "squaredcos_cap_v2"}
SHAPE = (B, 4, 2)


class Flat(nn.Module):
    """The sample is the residual stream itself: what is added to it is one block already."""

    def __init__(self) -> None:
        super().__init__()
        self.net = nn.Linear(2, 2)

    def forward(self, sample: torch.Tensor, timestep: torch.Tensor, obs: torch.Tensor) -> torch.Tensor:
        return sample + self.net(sample) * obs.mean((1, 2))[:, None, None] * timestep[:, None, None]


def spec(scheduler: Callable[..., object], **settings: object) -> PolicySpec:
    made = toy_spec(sample=(4, 2), obs=(3, 7))
    return replace(made, sampler=sampler_table(scheduler(**BETAS, **settings), STEPS))


def told_by(module: nn.Module) -> tuple[ttscompile.Program, dict[str, tuple[str, ...]]]:
    told: dict[str, tuple[str, ...]] = {}
    return transform(module.eval(), spec(DDIMScheduler), explain=told.__setitem__), told


@pytest.mark.slow
def test_the_blocks_are_those_of_the_network_inside() -> None:
    program, told = told_by(Skipping())
    inside, told_inside = told_by(Skipping().net)
    assert [block.kind for block in program.blocks] == [block.kind for block in inside.blocks]
    assert len(program.blocks) == 6
    assert "the sampler's table adds %sample" in told["MoveSkip"][0]
    assert "MoveSkip" not in told_inside
    assert program.unmoved is not None and inside.unmoved is None


def test_a_stream_that_is_the_sample_stays_as_it_is() -> None:
    program, told = told_by(Flat())
    assert "MoveSkip" not in told and program.unmoved is None
    assert len(program.blocks) == 1


@pytest.mark.slow
@pytest.mark.parametrize(
    ("scheduler", "settings"),
    [
        pytest.param(DDPMScheduler, {}, marks=pytest.mark.soak),
        pytest.param(DDIMScheduler, {"clip_sample": False}, marks=pytest.mark.soak),
        (DDIMScheduler, {"prediction_type": "v_prediction"}),
        pytest.param(DPMSolverMultistepScheduler, {"prediction_type": "sample"}, marks=pytest.mark.soak),
    ],
)
def test_actions_are_the_originals(
    scheduler: Callable[..., object], settings: dict[str, object], tmp_path: Path
) -> None:
    """Samplers that clip, draw noise, or remember; both runtimes, and the record that ``verify`` holds them to."""
    module, policy = Skipping().eval(), spec(scheduler, **settings)
    ttscompile.compile_denoiser(module, policy, tmp_path / "compiled")
    rng = np.random.default_rng(0)
    obs = rng.uniform(-1, 1, (2, 3, 7)).astype(np.float32)
    initial = rng.standard_normal((2, 4, 2), dtype=np.float32)
    draws = rng.standard_normal((STEPS, 2, 4, 2), dtype=np.float32) if policy.sampler.stochastic else None
    with Counted() as counted:
        expected = eager_policy(module, policy)({"obs": torch.from_numpy(obs)}, Noise(initial, draws)).numpy()
    gain = max(1.0, float(np.abs(policy.sampler.out_to_x0).max()))
    for runtime in ("onnxruntime", "reference"):
        compiled = ttscompile.load(tmp_path / "compiled", runtime=runtime)
        found = compiled.predict_action({"obs": obs}, noise=Noise(initial, draws))["action_pred"]
        assert_equal_but_for_rounding(found / gain, expected / gain, counted.terms, counted.angle)
    assert ttscompile.verify(tmp_path / "compiled").passed


@pytest.mark.parametrize("table", [spec(DDPMScheduler).sampler, spec(DPMSolverMultistepScheduler).sampler])
def test_the_table_adds_the_sample(table: SamplerTable) -> None:
    """Row by row on numbers, with ``out`` read through x0, directly, and through a memory."""
    moved, (x, out) = table.with_skip(), np.random.default_rng(1).standard_normal((2, 5))
    for k in range(STEPS):
        for to_x0, to_next, given in ((table, table, out), (moved, moved, out - x)):
            x0 = to_x0.sample_to_x0[k] * x + to_x0.out_to_x0[k] * given
            following = to_next.sample_to_next[k] * x + to_next.out_to_next[k] * given
            memory = to_next.to_memory[k][:, 1:3] @ np.stack([x, given])
            results = np.concatenate([x0, following, memory.ravel()])
            if to_x0 is table:
                expected = results
        np.testing.assert_allclose(results, expected, rtol=1e-5, atol=1e-5 * np.abs(table.out_to_x0[k]))


def graph(kind: str) -> Graph:
    b = Builder()
    sample = b.input("sample", *SHAPE)
    inside = b.op("f", "linear.default", SHAPE, sample, b.constant("w", 2, 2))
    if kind == "twice":
        return b.graph(b.op("y", "add.Tensor", SHAPE, sample, sample))
    if kind == "after":
        return b.graph(b.op("z", "gelu.default", SHAPE, b.op("y", "add.Tensor", SHAPE, sample, inside)))
    if kind == "scaled":
        made = b.graph(b.op("y", "add.Tensor", SHAPE, sample, inside))
        return replace(made, nodes=(*made.nodes[:-1], replace(made.nodes[-1], kwargs=(("alpha", 2),))))
    if kind == "broadcast":
        return b.graph(b.op("y", "add.Tensor", SHAPE, sample, b.constant("v", 4, 2)))
    return b.graph(b.op("y", "add.Tensor", SHAPE, *((inside, sample) if kind == "other order" else (sample, inside))))


@pytest.mark.parametrize("kind", ["plain", "other order"])
def test_what_is_added_becomes_the_prediction(kind: str) -> None:
    result = MoveSkip()(Captured(toy_spec(), graph(kind), {"w": np.eye(2, dtype=np.float32)}))
    assert result.program.denoiser.outputs == ("f",)
    assert [node.name for node in result.program.denoiser.nodes] == ["f"]


@pytest.mark.parametrize("kind", ["twice", "after", "scaled", "broadcast"])
def test_near_misses_are_left_alone(kind: str) -> None:
    assert not skips_network(graph(kind), "sample")
    weights = {"w": np.eye(2, dtype=np.float32), "v": np.ones((4, 2), np.float32)}
    made = graph(kind)
    with pytest.raises(PassError, match="MoveSkip: the prediction is not the sample plus something of its type"):
        MoveSkip()(Captured(toy_spec(), made, {name: weights[name] for name in made.constants}))
