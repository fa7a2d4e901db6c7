"""``lower.advance``: tail, sampler update and stem as one graph."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from tests.lower.modules import TOKENS, WIDTH, spec, table
from tests.passes.graphs import Builder
from tests.rounding import Counted, assert_equal_but_for_rounding
from ttscompile.core.correction import Correction, no_correction
from ttscompile.core.spec import PolicySpec, SamplerTable
from ttscompile.core.update import matrices
from ttscompile.errors import LoweringError
from ttscompile.ir.evaluate import evaluate
from ttscompile.ir.graph import Batch, Graph, Ref
from ttscompile.ir.pieces import LoopPiece
from ttscompile.lower.advance import fuse_advance

B = Batch()
SHAPE = (B, TOKENS, WIDTH)
STREAM = (B, TOKENS, 8)
DDPM = {"sample_to_x0": 1.5, "out_to_x0": -0.7, "x0_to_next": 0.4, "sample_to_next": 0.6, "noise_to_next": 0.3}


def pieces() -> tuple[Graph, Graph]:
    """A tail and a stem with a context of the same name, values of the same names, and a shared constant."""
    tail = Builder()
    x, t = tail.input("a9", *STREAM), tail.input("time", 1, 8)
    y = tail.op("y", "add.Tensor", STREAM, x, t)
    z = tail.op("z", "linear.default", SHAPE, y, tail.constant("head", WIDTH, 8), tail.constant("bias", WIDTH))
    stem = Builder()
    x, t = stem.input("sample", *SHAPE), stem.input("time", 1, 8)
    y = stem.op("y", "add.Tensor", SHAPE, x, stem.constant("bias", WIDTH))
    y = stem.op("z", "linear.default", STREAM, y, stem.constant("embed", 8, WIDTH))
    return tail.graph(z), stem.graph(stem.op("w", "mul.Tensor", STREAM, y, t))


def fused_of(tail: Graph, stem: Graph, spec: PolicySpec) -> Graph:
    return fuse_advance(LoopPiece(tail, "a9"), LoopPiece(stem, "sample"), spec)


def update(sampler: SamplerTable, x: torch.Tensor, out: torch.Tensor, noise: torch.Tensor) -> torch.Tensor:
    """The formula of ``SamplerTable``, at step 0."""
    row = {name: float(getattr(sampler, name)[0]) for name in SamplerTable.COLUMNS}
    x0 = row["sample_to_x0"] * x + row["out_to_x0"] * out
    if sampler.clip is not None:
        x0 = x0.clamp(-sampler.clip, sampler.clip)
    rest = row["sample_to_next"] * x + row["out_to_next"] * out + row["noise_to_next"] * noise
    return row["x0_to_next"] * x0 + rest


def corrected(weights: torch.Tensor, bias: torch.Tensor, *parts: torch.Tensor) -> torch.Tensor:
    """What the correction adds, one number at a time; parts are ``[B, T', D]``."""
    streams, horizon, dimensions = parts[0].shape
    result = torch.zeros_like(parts[0])
    for s in range(streams):
        for d in range(dimensions):
            features = torch.cat([part[s, :, d] for part in parts])
            group = min(d, len(weights) - 1)
            for t in range(horizon):
                result[s, t, d] = features @ weights[group, :, t] + bias[d, 0, t]
    return result


def random_correction(steps: int, scale: float) -> Correction:
    rng = np.random.default_rng(0)
    nothing = no_correction(steps, (TOKENS, WIDTH))
    weights, bias = (rng.standard_normal(a.shape).astype(np.float32) * scale for a in (nothing.weights, nothing.bias))
    return replace(nothing, weights=weights, bias=bias)


def turned(x: torch.Tensor) -> torch.Tensor:
    return x.permute(2, 0, 1)


@pytest.mark.parametrize(
    ("sampler", "terms"),
    [
        (table(clip=1.0, **DDPM), 2),
        (table(clip=None, **DDPM), 0),
        (table(clip=0.5, **dict.fromkeys(SamplerTable.COLUMNS, 0.3)), 2),
        (table(clip=None, **dict.fromkeys(SamplerTable.COLUMNS, 0.3)), 0),
        (table(clip=1.0, sample_to_next=1.0, out_to_next=-0.1), 0),
        (table(clip=1.0, out_to_x0=1.0, x0_to_next=0.5), 1),
        (table(clip=1.0, x0_to_next=1.0), 0),
        (table(clip=None), 0),
    ],
)
def test_equals_the_parts_one_by_one(sampler: SamplerTable, terms: int) -> None:
    tail, stem = pieces()
    fused = fused_of(tail, stem, spec(sampler))
    assert list(fused.inputs) == [
        "stream",
        "sample",
        "offset",
        "history",
        "update",
        "sample_to_x0",
        "out_to_x0",
        "tail.time",
        "stem.time",
    ]
    assert fused.outputs == ("sample_next", "stream_next", "prediction")
    assert set(fused.constants) == {"head", "bias", "embed"}
    assert sum(node.name.startswith("update.term") for node in fused.nodes) == terms  # terms of zero are left out
    torch.manual_seed(0)
    weights = {name: torch.randn(type_.at(1)) for name, type_ in fused.constants.items()}
    of_plan = random_correction(sampler.steps, 0.1)  # small, so that float32 is exact to the tolerance
    row = {name: torch.tensor([float(getattr(sampler, name)[0])]) for name in SamplerTable.COLUMNS}
    bias = torch.from_numpy(of_plan.bias[0])
    for streams in (1, 3):
        inputs = {name: torch.randn(type_.at(streams)) for name, type_ in fused.inputs.items()}
        sample, noise = torch.randn(2, streams, TOKENS, WIDTH)
        history = torch.randn(streams, 4 * TOKENS, WIDTH)
        inputs |= {"sample": turned(sample), "history": turned(history)}
        inputs |= {"offset": turned(noise) * row["noise_to_next"] + bias}
        inputs |= {"update": torch.from_numpy(matrices(sampler, of_plan)[0])}
        inputs |= {name: row[name] for name in ("sample_to_x0", "out_to_x0")}
        sample_next, stream_next, prediction = evaluate(fused, weights, inputs)
        with Counted() as counted:
            (out,) = evaluate(tail, weights, {"a9": inputs["stream"], "time": inputs["tail.time"]})
        assert_equal_but_for_rounding(prediction, turned(out), counted.terms)
        added = corrected(torch.from_numpy(of_plan.weights[0]), bias, sample, out, history)
        expected = update(sampler, sample, out, noise) + added
        terms = counted.terms + 6 * TOKENS + 4  # six numbers for each token of the chunk, and the sampler's
        assert_equal_but_for_rounding(sample_next, turned(expected), terms)
        with counted:
            (expected,) = evaluate(stem, weights, {"sample": expected, "time": inputs["stem.time"]})
        assert_equal_but_for_rounding(stream_next, expected, counted.terms + 6 * TOKENS + 4)


def test_a_stem_that_does_nothing() -> None:
    tail, _ = pieces()
    stem = Builder()
    fused = fused_of(tail, stem.graph(stem.input("sample", *SHAPE)), spec(table(**DDPM)))
    weights = {name: torch.randn(type_.at(1)) for name, type_ in fused.constants.items()}
    inputs = {name: torch.randn(type_.at(2)) for name, type_ in fused.inputs.items()}
    sample_next, stream_next, _ = evaluate(fused, weights, inputs)
    torch.testing.assert_close(sample_next, turned(stream_next))


def test_weights_whose_names_are_taken_are_refused() -> None:
    tail, stem = pieces()
    for name in ("offset", "tail.time", "sample_next"):
        with pytest.raises(LoweringError, match=f"'{name}'.*Rename"):
            fused_of(tail.renamed({"head": name}), stem, spec())


def test_inner_names_give_way_to_constants() -> None:
    tail, stem = pieces()
    fused = fused_of(tail.renamed({"head": "update.features"}), stem, spec(table(**DDPM)))
    names = [*fused.inputs, *fused.constants, *(node.name for node in fused.nodes)]
    assert len(set(names)) == len(names)
    assert any(Ref("update.features") in node.args for node in fused.nodes)
