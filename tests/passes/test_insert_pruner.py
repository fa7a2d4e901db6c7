"""The plan head: what it reads, what it may cost, what it makes of step 0."""

from dataclasses import replace

import pytest
import torch
from torch import nn

from tests.passes.modules import TokenDecoder, compiled, explained, labelled, run_graph, spec
from tests.passes.specs import toy_spec
from tests.rounding import Counted, assert_equal_but_for_rounding
from ttscompile.driver import transform
from ttscompile.errors import PassError
from ttscompile.ir.evaluate import evaluate
from ttscompile.ir.flops import graph_flops
from ttscompile.passes.insert_pruner import InsertPruner


def test_pruner_reads_the_encoded_observation_and_forces_step_zero() -> None:
    _, program = compiled("tokens")
    pieces = program.pieces
    assert pieces.pruner is not None
    (feature,) = pieces.features
    assert pieces.condition.types()[feature].shape[-1] == 16
    features = dict(
        zip(pieces.condition.outputs, run_graph(program, pieces.condition, {"obs": torch.randn(2, 3, 7)}), strict=True)
    )
    (logits,) = run_graph(program, pieces.pruner, {feature: features[feature]})
    assert logits.shape == (2, 5, 6, 4)
    assert (logits[:, 0, :, 1:] < -1e8).all() and (logits.argmax(-1) == 0).all()


@pytest.mark.slow
def test_pruner_shrinks_until_it_costs_one_percent_and_says_when_it_cannot() -> None:
    large = transform(TokenDecoder(width=64).eval(), spec())
    assert large.pieces.pruner is not None
    assert graph_flops(large.pieces.pruner) <= 0.01 * large.dense_flops
    told = explained("bare observation")[2]
    assert any("more than 1% even at its smallest" in note for note in told["InsertPruner"])


class LongObservation(nn.Module):
    """Reads the observation as it is, and there is much of it."""

    def __init__(self) -> None:
        super().__init__()
        self.ff = nn.Linear(2, 2)

    def forward(self, sample: torch.Tensor, timestep: torch.Tensor, obs: torch.Tensor) -> torch.Tensor:
        return sample + self.ff(sample * obs[:, :4, :2] * obs[:, -4:, -2:])


def test_pruner_averages_a_feature_that_is_huge() -> None:
    program = transform(LongObservation().eval(), toy_spec(obs=(600, 40)))
    assert program.pieces.pruner is not None
    assert program.weights["pruner.hidden.weight"].shape[1] == 40
    (feature,) = program.pieces.features
    obs = torch.randn(2, 600, 40)
    (logits,) = run_graph(program, program.pieces.pruner, {feature: obs})
    with Counted() as counted:
        (same,) = run_graph(program, program.pieces.pruner, {feature: obs.mean(1, keepdim=True).expand(-1, 600, -1)})
    free = same.abs() < 1e6  # step 0 has the logits of a plan that is forced
    assert_equal_but_for_rounding(logits, same, counted.terms)
    assert_equal_but_for_rounding(logits[free], same[free], counted.terms)


def test_pruner_reads_whole_numbers_as_floats() -> None:
    program = InsertPruner()(labelled()).program
    pieces = program.pieces
    assert pieces.pruner is not None and pieces.features == ("obs.feature",)
    weights = {name: torch.from_numpy(value) for name, value in program.weights.items()}
    values = evaluate(pieces.condition, weights, {"obs": torch.tensor([[0, 4, 8], [1, 2, 3]])})
    (logits,) = evaluate(pieces.pruner, weights, dict(zip(pieces.condition.outputs, values, strict=True)))
    assert logits.shape == (2, 5, 1, 4) and logits.isfinite().all()


def test_a_weight_with_a_name_of_the_plan_head_is_refused() -> None:
    program = labelled()
    named = replace(program, weights={**program.weights, "pruner.hidden.bias": program.weights["v"]})
    with pytest.raises(PassError, match=r"weights of its own called pruner\.hidden\.bias"):
        InsertPruner()(named)
