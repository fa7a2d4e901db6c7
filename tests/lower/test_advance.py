"""``ir.advance``: tail, sampler update and stem as one graph."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from tests.lower.modules import TOKENS, WIDTH, spec, table
from tests.passes.graphs import Builder
from ttscompile.config import SamplerTable
from ttscompile.errors import LoweringError
from ttscompile.ir.advance import fuse_advance
from ttscompile.ir.evaluate import evaluate
from ttscompile.ir.graph import Batch, Graph, Ref

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


def update(sampler: SamplerTable, x: torch.Tensor, out: torch.Tensor, noise: torch.Tensor) -> torch.Tensor:
    """The formula of ``SamplerTable``, at step 0."""
    row = {name: float(getattr(sampler, name)[0]) for name in SamplerTable.COLUMNS}
    x0 = row["sample_to_x0"] * x + row["out_to_x0"] * out
    if sampler.clip is not None:
        x0 = x0.clamp(-sampler.clip, sampler.clip)
    rest = row["sample_to_next"] * x + row["out_to_next"] * out + row["noise_to_next"] * noise
    return row["x0_to_next"] * x0 + rest


def correction(inputs: dict[str, torch.Tensor], out: torch.Tensor) -> torch.Tensor:
    """What the correction adds, one number at a time."""
    weights, bias = inputs["correction"], inputs["correction_bias"]
    streams, horizon, dimensions = out.shape
    result = torch.zeros_like(out)
    for s in range(streams):
        for d in range(dimensions):
            features = torch.cat([inputs["sample"][s, :, d], out[s, :, d], inputs["history"][s, :, d]])
            group = min(d, len(weights) - 1)
            for t in range(horizon):
                result[s, t, d] = features @ weights[group, :, t] + bias[group, 0, t]
    return result


@pytest.mark.parametrize(
    ("sampler", "sums"),
    [
        (table(clip=1.0, **DDPM), 3),
        (table(clip=None, **DDPM), 3),
        (table(clip=0.5, **dict.fromkeys(SamplerTable.COLUMNS, 0.3)), 4),
        (table(clip=1.0, sample_to_next=1.0, out_to_next=-0.1), 1),
        (table(clip=1.0, out_to_x0=1.0, x0_to_next=0.5), 0),
        (table(clip=1.0, x0_to_next=1.0), 0),
        (table(clip=None), 0),
    ],
)
def test_equals_the_parts_one_by_one(sampler: SamplerTable, sums: int) -> None:
    tail, stem = pieces()
    fused = fuse_advance(tail, stem, spec(sampler))
    assert list(fused.inputs) == [
        "stream",
        "sample",
        "noise",
        "coefficients",
        "history",
        "correction",
        "correction_bias",
        "tail.time",
        "stem.time",
    ]
    assert fused.outputs == ("sample_next", "stream_next", "prediction")
    assert set(fused.constants) == {"head", "bias", "embed"}
    assert sum(node.name.startswith("sampler.sum") for node in fused.nodes) == sums  # terms of zero are left out
    torch.manual_seed(0)
    weights = {name: torch.randn(type_.at(1)) for name, type_ in fused.constants.items()}
    for streams in (1, 3):
        inputs = {name: torch.randn(type_.at(streams)) for name, type_ in fused.inputs.items()}
        inputs["coefficients"] = torch.tensor([float(getattr(sampler, name)[0]) for name in SamplerTable.COLUMNS])
        inputs["correction"] *= 0.1  # so that float32 is exact to the tolerance
        sample_next, stream_next, prediction = evaluate(fused, weights, inputs)
        (out,) = evaluate(tail, weights, {"a9": inputs["stream"], "time": inputs["tail.time"]})
        torch.testing.assert_close(prediction, out)
        expected = update(sampler, inputs["sample"], out, inputs["noise"]) + correction(inputs, out)
        torch.testing.assert_close(sample_next, expected)
        (expected,) = evaluate(stem, weights, {"sample": expected, "time": inputs["stem.time"]})
        torch.testing.assert_close(stream_next, expected)


def test_a_stem_that_does_nothing() -> None:
    tail, _ = pieces()
    stem = Builder()
    fused = fuse_advance(tail, stem.graph(stem.input("sample", *SHAPE)), spec(table(**DDPM)))
    weights = {name: torch.randn(type_.at(1)) for name, type_ in fused.constants.items()}
    inputs = {name: torch.randn(type_.at(2)) for name, type_ in fused.inputs.items()}
    sample_next, stream_next, _ = evaluate(fused, weights, inputs)
    torch.testing.assert_close(sample_next, stream_next)


def test_weights_whose_names_are_taken_are_refused() -> None:
    tail, stem = pieces()
    for name in ("noise", "tail.time", "sample_next"):
        nodes = tuple(node.renamed(lambda n, name=name: name if n == "head" else n) for node in tail.nodes)
        constants = {name if n == "head" else n: t for n, t in tail.constants.items()}
        with pytest.raises(LoweringError, match=f"'{name}'.*Rename"):
            fuse_advance(replace(tail, nodes=nodes, constants=constants), stem, spec())


def test_inner_names_give_way_to_constants() -> None:
    tail, stem = pieces()
    nodes = tuple(node.renamed(lambda n: "sampler.row" if n == "head" else n) for node in tail.nodes)
    constants = {"sampler.row" if n == "head" else n: t for n, t in tail.constants.items()}
    fused = fuse_advance(replace(tail, nodes=nodes, constants=constants), stem, spec(table(**DDPM)))
    names = [*fused.inputs, *fused.constants, *(node.name for node in fused.nodes)]
    assert len(set(names)) == len(names)
    assert any(Ref("sampler.row") in node.args for node in fused.nodes)
