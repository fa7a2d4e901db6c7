"""One block of a network without a residual stream: the same numbers, and a cut that every other pass understands."""

import re

import numpy as np
import pytest
import torch
from torch import nn

from tests.passes.graphs import B, Builder
from tests.passes.modules import explained
from tests.passes.specs import toy_spec
from ttscompile.driver import transform
from ttscompile.errors import PassError
from ttscompile.ir.evaluate import evaluate
from ttscompile.ir.graph import Batch, Graph
from ttscompile.ir.program import Captured
from ttscompile.passes.find_residual_blocks import find_residual_blocks
from ttscompile.passes.one_block import OneBlock

SHAPE = (B, 4, 8)


def captured(graph: Graph) -> Captured:
    rng = np.random.default_rng(0)
    weights = {n: rng.standard_normal(t.at(1)).astype(np.float32) for n, t in graph.constants.items()}
    return Captured(toy_spec(sample=(4, 8)), graph, weights)


def plain(*shape: int | Batch) -> Graph:
    b = Builder()
    h = b.op("first", "linear.default", SHAPE, b.input("sample", *SHAPE), b.constant("w", 8, 8))
    return b.graph(b.op("last", "gelu.default", shape or SHAPE, h))


def test_the_network_becomes_one_block_and_no_number_changes() -> None:
    program = captured(plain())
    result = OneBlock("there is no chain")(program)
    assert result.notes == ("the whole network is one block, whose residual is its prediction: there is no chain",)
    table = find_residual_blocks(result.program.denoiser, "sample")
    (block,) = table.blocks
    assert (block.stream, block.residual, block.result) == ("sample.stream", "sample.residual", "sample.updated")
    assert block.type.shape == (B, 4, 16)
    tensors = {n: torch.from_numpy(w) for n, w in program.weights.items()}
    x = {"sample": torch.randn(3, 4, 8)}
    before, after = (evaluate(each.denoiser, tensors, x)[0] for each in (program, result.program))
    torch.testing.assert_close(after, before, rtol=0, atol=0)


def test_what_is_reused_is_the_prediction() -> None:
    """Sample 1 with the residual of sample 0 gives the prediction of sample 0."""
    program = captured(plain())
    graph = OneBlock("")(program).program.denoiser
    names = ("sample.stream", "sample.residual", "sample.prediction")
    tensors = {n: torch.from_numpy(w) for n, w in program.weights.items()}
    at = [
        evaluate(Graph(graph.inputs, graph.constants, graph.nodes, names), tensors, {"sample": x})
        for x in torch.randn(2, 1, 4, 8)
    ]
    reused = at[1][0] + at[0][1]
    torch.testing.assert_close(reused[..., 8:], at[0][2], rtol=0, atol=0)
    torch.testing.assert_close(reused[..., :8], at[1][0][..., :8], rtol=0, atol=0)


def test_a_prediction_of_another_shape_is_refused() -> None:
    with pytest.raises(PassError, match=r"OneBlock: the prediction is float32\[B, 4, 6\], and the sample"):
        OneBlock("")(captured(plain(B, 4, 6)))


@pytest.mark.slow
def test_a_unet_is_one_block_and_its_films_are_tables() -> None:
    _, program, told = explained("U-Net")
    assert "hold" in told["OneBlock"][0] and "1 block: network" in told["find_residual_blocks"][0]
    (block,) = program.blocks
    assert (block.kind, block.type.shape) == ("network", (B, 4, 4))
    operations = {node.op for node in program.pieces.blocks[0].graph.nodes}
    assert "aten.linear.default" not in operations, "what FiLM computes is known before the loop"
    steps = program.spec.sampler.steps
    assert program.pieces.tables and all(table.shape[0] == steps for table in program.pieces.tables.values())


class NoResidual(nn.Module):
    """A toy without any."""

    def __init__(self) -> None:
        super().__init__()
        self.net = nn.Sequential(nn.Linear(2, 8), nn.GELU(), nn.Linear(8, 2))

    def forward(self, sample: torch.Tensor, timestep: torch.Tensor, obs: torch.Tensor) -> torch.Tensor:
        return self.net(sample) * obs.flatten(1).mean(1)[:, None, None] * timestep[:, None, None]


def test_the_note_says_where_the_search_for_a_chain_ended() -> None:
    told: dict[str, tuple[str, ...]] = {}
    transform(NoResidual(), toy_spec(obs=(3, 7)), explain=told.__setitem__)
    assert re.search(r"ended at %\w+ = aten\.mul\.Tensor \(test_one_block\.py:\d+ in forward\)", told["OneBlock"][0])
