"""Attention in eight bits in every model of an artifact: of a block, of all blocks, of a step, of the whole call."""

from pathlib import Path

import numpy as np
import onnx
import pytest
import torch
from torch import nn
from torch.nn import functional

import ttscompile
from tests.lower.whole_call import Episode, inputs
from ttscompile.artifact.load import load_artifact
from ttscompile.artifact.view import view_of
from ttscompile.core.lattice import uniform_plan
from ttscompile.core.spec import ChunkSpec, ObservationSpec, PolicySpec
from ttscompile.lower.integer_attention import FEWEST, HEADS
from ttscompile.samplers.flow import flow_matching_table

ACTIONS, WIDTH, COUNT, BLOCKS, STEPS = 2, 16, 2, 2, 3


class Long(nn.Module):
    """Two blocks of attention among so many tokens that integers are faster.

    Lowered, the first has an axis of heads, and the second has its heads beside each other.
    """

    def __init__(self) -> None:
        super().__init__()
        self.enter, self.leave = nn.Linear(ACTIONS, WIDTH), nn.Linear(WIDTH, ACTIONS)
        self.split = nn.ModuleList(nn.Linear(WIDTH, 3 * WIDTH) for _ in range(BLOCKS))
        self.merge = nn.ModuleList(nn.Linear(WIDTH, WIDTH) for _ in range(BLOCKS))

    def forward(self, sample: torch.Tensor, timestep: torch.Tensor, goal: torch.Tensor) -> torch.Tensor:
        """``[B, FEWEST, 2]``, ``[B]`` and ``[B, 16]`` -> ``[B, FEWEST, 2]``."""
        x = self.enter(sample) + goal[:, None] + timestep[:, None, None]
        for number, (split, merge) in enumerate(zip(self.split, self.merge, strict=True)):
            if number == 0:
                q, k, v = split(3 * x).unflatten(-1, (3, COUNT, -1)).permute(2, 0, 3, 1, 4)
            else:
                q, k, v = (y.unflatten(-1, (COUNT, -1)).transpose(1, 2) for y in split(3 * x).chunk(3, dim=-1))
            x = x + merge(functional.scaled_dot_product_attention(q, k, v).transpose(1, 2).flatten(2))
        return self.leave(x)


@pytest.fixture(scope="module")
def compiled(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The artifact, and ``call.onnx`` beside it."""
    torch.manual_seed(0)
    spec = PolicySpec(
        sample=(FEWEST, ACTIONS),
        observations={"goal": ObservationSpec((WIDTH,), window=False)},
        sampler=flow_matching_table(STEPS),
        chunk=ChunkSpec(ACTIONS, 0, FEWEST),
    )
    path = tmp_path_factory.mktemp("long") / "compiled"
    ttscompile.compile_denoiser(Long().eval(), spec, path, precision="int8", single_file=path.parent / "call.onnx")
    return path


@pytest.mark.slow
def test_blocks_and_dense_steps_have_it(compiled: Path) -> None:
    artifact = view_of(load_artifact(compiled), "full")
    counts = {
        name: sum(
            node.op_type == HEADS
            for node in onnx.load(compiled / artifact.onnx_file(name), load_external_data=False).graph.node
        )
        for name in ("block_00", "block_01", "dense_step", "stem")
    }
    assert counts == {"block_00": 1, "block_01": 1, "dense_step": BLOCKS, "stem": 0}


@pytest.mark.slow
@pytest.mark.parametrize("threads", [1, 2])
def test_a_call_is_near_to_float32_and_the_single_file_computes_it(compiled: Path, threads: int) -> None:
    policies = [ttscompile.load(compiled, plan=name, threads=threads) for name in ("full", "full@fp32")]
    obs, noise = inputs(policies[0], np.random.default_rng(0), 2)
    sparse = uniform_plan(STEPS, BLOCKS, 2)
    for plan in (np.zeros((STEPS, BLOCKS), np.int8), sparse):
        found, exact = (policy.predict_action(obs, noise=noise, plan=plan)["action"] for policy in policies)
        assert 0 < np.abs(found - exact).mean() < 0.02 * np.abs(exact).mean()
        for policy in policies:
            policy.reset()
        whole = Episode((compiled.parent / "call.onnx").read_bytes(), 2).call(obs, noise, plan)["action"]
        np.testing.assert_allclose(whole, found, rtol=1e-4, atol=1e-3 * np.abs(found).max())
