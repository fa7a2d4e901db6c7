"""The denoiser cut along its residual stream."""

import torch

from tests.passes.graphs import B, Builder
from tests.passes.specs import toy_spec
from ttscompile.ir.evaluate import evaluate
from ttscompile.ir.program import Captured
from ttscompile.ir.verify import verify
from ttscompile.passes.find_residual_blocks import find_residual_blocks
from ttscompile.passes.partition import Partition

SHAPE = (B, 4, 2)


def test_pieces_are_named_and_give_what_the_denoiser_gives() -> None:
    b = Builder()
    x, t, obs = b.input("sample", *SHAPE), b.input("timestep", B, dtype="int64"), b.input("obs", B, 3)
    gate = b.op("gate", "mean.dim", (B, 1, 1), b.op("row", "unsqueeze.default", (B, 1, 3), obs, 1), (2,), True)
    f = b.op("f", "mul.Tensor", SHAPE, b.op("tanh", "tanh.default", SHAPE, x), gate)
    b.op("unread", "neg.default", (B,), t)
    y = b.op("y", "add.Tensor", SHAPE, x, f)
    graph = b.graph(y)
    captured = Captured(toy_spec(), graph, {})
    cut = Partition(find_residual_blocks(graph, "sample").blocks)(captured).program
    verify(cut)
    loop = cut.loop
    assert list(loop.loop) == ["stem", "block_00", "tail"]
    assert [(piece.stream, list(piece.contexts)) for piece in loop.loop.values()] == [
        ("sample", []), ("sample", ["gate"]), ("y", []),
    ]  # fmt: skip
    assert loop.contexts == cut.prologue.outputs == ("gate",)
    values = {"sample": torch.randn(2, 4, 2), "timestep": torch.zeros(2, dtype=torch.int64), "obs": torch.randn(2, 3)}
    (expected,) = evaluate(graph, {}, values)
    (gates,) = evaluate(cut.prologue, {}, {name: values[name] for name in cut.prologue.inputs})
    (stream,) = evaluate(loop.stem.graph, {}, {"sample": values["sample"]})
    (residual,) = evaluate(loop.blocks[0].graph, {}, {"sample": stream, "gate": gates})
    (found,) = evaluate(loop.tail.graph, {}, {"y": stream + residual})
    torch.testing.assert_close(found, expected)
