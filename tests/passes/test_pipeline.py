"""The passes in the driver's order, on real modules: what they compute stays the same, what is hoisted is counted."""

from dataclasses import replace

import pytest
import torch
from torch import nn

from tests.passes.modules import MODULES, STREAMS, compiled, evaluate_pieces, explained
from tests.passes.specs import toy_spec
from tests.quick import first_quick
from tests.rounding import Counted, assert_equal_but_for_rounding
from ttscompile.driver import _run as _pass, transform
from ttscompile.errors import PassError
from ttscompile.ir.program import Captured, Program
from ttscompile.passes.base import PassResult
from ttscompile.passes.hoist import Hoist
from ttscompile.passes.insert_pruner import InsertPruner
from ttscompile.passes.partition import Partition
from ttscompile.passes.split_tokens import SplitFeatures, SplitTokens
from ttscompile.verification.record_golden import record_original


@pytest.mark.parametrize("name", first_quick(MODULES))
def test_the_pieces_compute_what_the_module_computes(name: str) -> None:
    module, program = compiled(name)
    torch.manual_seed(0)  # else what is drawn depends on the tests before
    for k, t in enumerate(program.spec.sampler.timesteps):
        sample, obs = torch.randn(STREAMS, 4, 2), torch.randn(STREAMS, 3, 7)
        with torch.no_grad(), Counted() as counted:
            expected = module(sample, torch.full((STREAMS,), int(t)), obs)
        found = evaluate_pieces(program, sample, obs, k)
        few = 4 if name == "U-Net" else 1  # its norms are over so few numbers that they may double an error
        assert_equal_but_for_rounding(found, expected, few * counted.terms, counted.angle)


class Picks(nn.Module):
    """A row of each stream, by number, of what the step knows and of what the loop knows."""

    def __init__(self) -> None:
        super().__init__()
        self.ff = nn.Linear(2, 2)

    def forward(self, sample: torch.Tensor, timestep: torch.Tensor, obs: torch.Tensor) -> torch.Tensor:
        streams, last = torch.arange(len(obs)), obs[:, :, 0].argmax(1)
        known = (obs[..., :2] * timestep[:, None, None]).flatten(0, 1)[last + 3 * streams]
        x = sample + torch.tanh(self.ff(sample)) * known[:, None]
        return x + self.ff(x) * x[streams, last][:, None]


class Examples(Picks):
    """One timestep for all streams; the sample gives a dtype and a shape to what does not depend on it."""

    def forward(self, sample: torch.Tensor, timestep: torch.Tensor, obs: torch.Tensor) -> torch.Tensor:
        time = timestep[0].float().type_as(sample) * (obs[:, :1, :2] + torch.full_like(sample, 0.5))
        x = sample + self.ff(sample) * time
        return x + self.ff(x) * time * sample.new_ones(len(sample), 1, 1)


@pytest.mark.slow
@pytest.mark.parametrize("module", [Picks, Examples])
def test_what_is_no_function_of_one_stream_and_one_step(module: type[nn.Module]) -> None:
    torch.manual_seed(0)
    original = module().eval()
    program = transform(original, toy_spec(obs=(3, 7)))
    assert len(program.blocks) == 2
    sample, obs = torch.randn(STREAMS, 4, 2), torch.randn(STREAMS, 3, 7)
    for k, t in enumerate(program.spec.sampler.timesteps):
        with torch.no_grad(), Counted() as counted:
            expected = original(sample, torch.full((STREAMS,), int(t)), obs)
        found = evaluate_pieces(program, sample, obs, k)
        assert_equal_but_for_rounding(found, expected, counted.terms, counted.angle)


class Shaped(Picks):
    """Of the observation it takes only the shape."""

    def forward(self, sample: torch.Tensor, timestep: torch.Tensor, obs: torch.Tensor) -> torch.Tensor:
        time = torch.full_like(obs[:, :1, :2], 0.3) * timestep[:, None, None]
        x = sample + self.ff(sample) * time
        return x + self.ff(x) * time


def test_the_record_of_a_network_that_reads_no_observation() -> None:
    program = transform(Shaped(), toy_spec(obs=(3, 7)))
    assert record_original(Shaped(), program).residuals[0].any()


def test_stages_are_explained() -> None:
    told = explained("tokens")[2]
    assert list(told) == [
        "capture", "CleanUp", "CutCopies", "WidenAttention", "SplitStem", "WriteSums", "RegroupSums",
        "find_residual_blocks", "Partition",
        "UnfoldBatch", "SplitTokens", "SplitFeatures", "Hoist", "InsertPruner", "SplitFrames",
        "ReuseTokens",
    ]  # fmt: skip
    assert "6 blocks: self_attention, cross_attention, feed_forward" in told["find_residual_blocks"][0]
    assert any("left in the loop" in note for note in told["Hoist"])


def test_passes_run_in_their_order_only() -> None:
    _, program = compiled("tokens")
    bare = Captured(program.spec, program.denoiser, program.weights)
    for each in (SplitTokens(), Hoist(), InsertPruner()):
        with pytest.raises(PassError, match=f"^{each.name}: takes a program that is (Cut|Program); found Captured"):
            each(bare)  # type: ignore[arg-type]
    with pytest.raises(PassError, match="^SplitFeatures: takes a program that is Cut; found Program"):
        SplitFeatures()(program)  # type: ignore[arg-type]
    with pytest.raises(PassError, match="^Partition: takes a program that is Captured; found Program"):
        Partition(program.blocks)(program)  # type: ignore[arg-type]


def test_a_pass_that_breaks_the_program_is_named() -> None:
    class Breaks(InsertPruner):
        def call(self, program: Program) -> PassResult[Program]:
            return PassResult(replace(program, weights={}))

    _, program = compiled("tokens")
    with pytest.raises(PassError, match=r"^after Breaks: denoiser: constant %\S+ has no value"):
        _pass(Breaks(), program, lambda stage, notes: None)


class Experts(nn.Module):
    """Feed-forward networks of which a router takes two by the noise level, as MoDE's does, and weighs all instead."""

    def __init__(self) -> None:
        super().__init__()
        self.enter, self.leave, self.router = nn.Linear(2, 8), nn.Linear(8, 2), nn.Linear(1, 4)
        self.experts = nn.ModuleList(nn.Linear(8, 8) for _ in range(8))

    def forward(self, sample: torch.Tensor, timestep: torch.Tensor, obs: torch.Tensor) -> torch.Tensor:
        chance = self.router(timestep[:, None] / 5).softmax(-1)
        taken = chance.topk(2)
        weight = torch.zeros_like(chance).scatter(1, taken.indices, taken.values)
        x = self.enter(sample) + obs.mean((1, 2))[:, None, None]
        for layer in (self.experts[:4], self.experts[4:]):
            x = x + sum(weight[:, i, None, None] * expert(x).tanh() for i, expert in enumerate(layer))
        return self.leave(x)


class Guided(Experts):
    """Classifier-free guidance: with the condition and without it, on twice the batch."""

    def forward(self, sample: torch.Tensor, timestep: torch.Tensor, obs: torch.Tensor) -> torch.Tensor:
        given = torch.cat([sample, sample]), torch.cat([timestep, timestep]), torch.cat([obs, 0 * obs])
        with_condition, without = super().forward(*given).chunk(2)
        return without + 2 * (with_condition - without)


@pytest.mark.slow
@pytest.mark.parametrize("kind", [Experts, Guided])
def test_weighed_experts_and_guidance_have_the_blocks_of_the_network(kind: type[Experts]) -> None:
    """``docs/howto/own-denoiser.md`` says how both are written; experts are weighed by tables."""
    torch.manual_seed(0)
    module = kind().eval()
    program = transform(module, toy_spec(obs=(3, 7)))
    assert [block.kind for block in program.blocks] == ["feed_forward"] * 2
    assert not any("topk" in node.op for piece in program.pieces.blocks for node in piece.graph.nodes)
    for k, t in enumerate(program.spec.sampler.timesteps):
        sample, obs = torch.randn(STREAMS, 4, 2), torch.randn(STREAMS, 3, 7)
        with torch.no_grad():
            expected = module(sample, torch.full((STREAMS,), int(t)), obs)
        torch.testing.assert_close(evaluate_pieces(program, sample, obs, k), expected, rtol=1e-5, atol=1e-5)
