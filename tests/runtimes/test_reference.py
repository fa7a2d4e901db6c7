"""The reference runtime against section 2 executed literally; its gradients against calculus."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings, strategies as st

from tests.rounding import Counted, assert_equal_but_for_rounding
from ttscompile import Noise, Source
from ttscompile.artifact import Artifact
from ttscompile.artifact.view import view_of
from ttscompile.core.lattice import PlanArray
from ttscompile.errors import IllegalPlanError
from ttscompile.ir.program import Program
from ttscompile.runtimes.reference.model import ReferenceModel
from ttscompile.runtimes.reference.reuse import Caches, Cell, reuse

from .literal import Episode
from .plans import random_plan
from .recorded import everything_recorded
from .toys import as_functions, model_of, pencil_program, pruner_weights, toy_program

C, T, R = Source.COMPUTE, Source.TIMESTEP, Source.ROLLOUT
TOY = toy_program()
MODEL = model_of(TOY)


def test_a_rollout_that_was_never_written_is_refused() -> None:
    """By the model itself, which calibration calls; ``test_onnxruntime`` has what the same policy computes."""
    model = model_of(pencil_program())
    contexts, initial = model.prologue({"obs": torch.tensor([[-32.0]])}), torch.full((1, 1, 1), 35.0)
    cache = model.denoise(contexts, initial, None, np.array([[C], [T]], np.int8)).cache
    with pytest.raises(IllegalPlanError, match="step 1, block 0"):
        model.denoise(contexts, initial, None, np.array([[C], [R]], np.int8), cache)


def inputs(rng: np.random.Generator, streams: int, program: Program = TOY) -> tuple[dict[str, torch.Tensor], Noise]:
    shape = (streams, *program.spec.sample)
    initial = rng.standard_normal(shape).astype(np.float32)
    steps = rng.standard_normal((program.spec.sampler.steps, *shape)).astype(np.float32)
    return {"obs": torch.from_numpy(rng.standard_normal((streams, 2)).astype(np.float32))}, Noise(initial, steps)


@pytest.mark.slow
@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), streams=st.integers(1, 3), computed=st.floats(0, 0.6))
def test_every_stream_does_what_section_2_says(seed: int, streams: int, computed: float) -> None:
    rng = np.random.default_rng(seed)
    cache = None
    literal: list[dict[tuple[int, int], np.ndarray]] = [{} for _ in range(streams)]
    for _ in range(3):
        obs, noise = inputs(rng, streams)
        assert noise.steps is not None
        written = MODEL.empty_cache(streams).written if cache is None else cache.written
        plans = np.stack([random_plan(rng, MODEL.steps, MODEL.groups, cells, computed) for cells in written])
        expected = []
        for s in range(streams):
            toy = as_functions(TOY, obs["obs"][s].numpy(), noise.steps[:, s])
            expected.append(Episode(toy, literal[s]).call(noise.initial[s].astype(np.float64), plans[s]))
        with torch.no_grad(), Counted() as counted:
            result = MODEL.denoise(
                MODEL.prologue(obs), torch.from_numpy(noise.initial), torch.from_numpy(noise.steps), plans, cache
            )
        cache = result.cache
        assert_equal_but_for_rounding(result.sample, np.stack(expected), counted.terms)
        assert [set(map(tuple, np.argwhere(w))) for w in cache.written] == [set(one) for one in literal]


def one_hot(plan: PlanArray) -> torch.Tensor:
    return torch.nn.functional.one_hot(torch.from_numpy(plan.astype(np.int64)), 4).float()


def test_gradients_of_gates_are_those_of_the_whole_formula() -> None:
    rng = np.random.default_rng(7)
    obs, noise = inputs(rng, 2)
    assert noise.steps is not None
    contexts = MODEL.prologue(obs)
    dense = np.zeros((2, MODEL.steps, MODEL.blocks), np.int8)
    initial, steps = torch.from_numpy(noise.initial), torch.from_numpy(noise.steps)
    cache = MODEL.denoise(contexts, initial, steps, dense).cache
    assert not any(residual.requires_grad for residual in cache.residuals.values())
    plans = np.stack([random_plan(rng, MODEL.steps, MODEL.groups, cells) for cells in cache.written])
    assert len(set(map(int, plans[:, 1:].reshape(-1)))) == 4

    gates, caches = one_hot(plans).requires_grad_(), Caches(dict(cache.residuals))

    def blocks(k: int, stream: torch.Tensor) -> torch.Tensor:
        for b, group in enumerate(MODEL.groups):
            cell = Cell(k, b, group, plans[:, k, b], gates[:, k, b], TOY.blocks[b].type)
            stream = stream + reuse(cell, MODEL.block(b, k, stream, contexts), caches)
        return stream

    *_, last = MODEL.steps_of(contexts, initial, steps, blocks)
    last.sample.square().sum().backward()
    whole = one_hot(plans).requires_grad_()
    with Counted() as counted:
        sample = everything_recorded(MODEL, contexts, initial, steps, whole, cache.residuals)
        sample.square().sum().backward()

    assert_equal_but_for_rounding(last.sample, sample, counted.terms)
    assert_equal_but_for_rounding(MODEL.denoise(contexts, initial, steps, plans, cache).sample, sample, counted.terms)
    assert gates.grad is not None
    assert whole.grad is not None
    # Before step 0 nothing is cached, and the gates of what is not cached are never asked for.
    assert_equal_but_for_rounding(gates.grad[:, 1:], whole.grad[:, 1:], counted.terms)
    assert gates.grad[:, 1:].abs().min(0).values.max() > 1e-3


def test_only_computed_blocks_are_evaluated(monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(3)
    obs, noise = inputs(rng, 2)
    plans = np.full((2, MODEL.steps, MODEL.blocks), T, np.int8)
    plans[:, 0] = C
    plans[1, 2, 3] = C
    evaluated: list[tuple[int, int, int]] = []
    block = ReferenceModel.block

    def counting(self, b, k, stream, contexts, streams=None):  # type: ignore[no-untyped-def]
        evaluated.append((k, b, len(stream) if streams is None else len(streams)))
        return block(self, b, k, stream, contexts, streams)

    monkeypatch.setattr(ReferenceModel, "block", counting)
    MODEL.denoise(MODEL.prologue(obs), torch.from_numpy(noise.initial), None, plans)
    assert evaluated == [*((0, b, 2) for b in range(MODEL.blocks)), (2, 3, 1)]


def test_the_pruners_logits_are_differentiable_in_given_weights() -> None:
    contexts = MODEL.prologue(inputs(np.random.default_rng(0), 2)[0])
    weights = {name: value.clone().requires_grad_() for name, value in pruner_weights(TOY).items()}
    assert set(weights) == {"pruner.w", "pruner.b", "pruner.mask"}
    logits = MODEL.logits(contexts, weights)
    assert logits.shape == (2, MODEL.steps, MODEL.blocks, 4)
    assert torch.equal(logits.detach(), MODEL.logits(contexts))
    logits[:, 1:].sum().backward()
    assert weights["pruner.b"].grad is not None
    assert torch.equal(weights["pruner.b"].grad, torch.tensor([0.0, 2.0])[(torch.arange(100) >= 20).long()])


def test_a_program_without_pieces_or_pruner_is_refused() -> None:
    program = toy_program(pruner=False)
    model = model_of(program)
    with pytest.raises(IllegalPlanError, match="no pruner"):
        model.logits(model.prologue(inputs(np.random.default_rng(0), 1)[0]))
    with pytest.raises(TypeError, match="'blocks' and 'pieces'"):
        Program(program.spec, program.denoiser, program.weights)  # type: ignore[call-arg]


def test_an_artifact_gives_the_model_of_its_program(toy_artifact: Artifact) -> None:
    obs, noise = inputs(np.random.default_rng(0), 2)
    plan = np.full((MODEL.steps, MODEL.blocks), T, np.int8)
    plan[0] = C
    stored = ReferenceModel.from_view(view_of(toy_artifact))
    samples = [m.denoise(m.prologue(obs), torch.from_numpy(noise.initial), None, plan).sample for m in (stored, MODEL)]
    assert torch.equal(*samples)
    assert torch.equal(stored.logits(stored.prologue(obs)), MODEL.logits(MODEL.prologue(obs)))
