"""Operations that torch's ONNX exporter writes in a form that onnxruntime runs slowly, written otherwise.

    group_norm   The exporter writes GroupNormalization, which onnxruntime takes apart into twenty small operations.
                 Here the groups are the channels of an InstanceNormalization, which has a kernel.
    conv1d       onnxruntime multiplies the weights by columns of the input, one a position. With few of them most of
                 its kernel's width is empty. Here few positions are rows, multiplied by the weights.
    transposed   Of conv_transpose1d the exporter knows another name alone, which it finds by tracing all again.
    index_copy   The exporter takes it apart into single numbers. Here whole rows are copied, along the first axis.
    attention    The exporter transposes heads forward and back. Where they are only moved for it they stay here.

``docs/decisions.md`` has the figures.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import torch
from onnxscript import ir, opset23

op: Any = opset23  # its stubs describe tensors, and here values of a graph are given

FEW = 32
"""Up to so many positions a convolution is a product of rows; from 16 on both are as fast, and integers do products."""


def _sizes(value: ir.Value) -> list[int]:
    """Sizes of the axes of an exported value after the first, which is the batch."""
    assert value.shape is not None
    return [int(size) for size in value.shape[1:]]  # type: ignore[arg-type]


def group_norm(
    input: Any, num_groups: int, weight: Any = None, bias: Any = None, eps: float = 1e-5, cudnn_enabled: bool = True
) -> Any:
    """``aten.group_norm`` by InstanceNormalization, of which each group is a channel."""
    channels, *inner = _sizes(input)
    grouped = op.Reshape(input, op.Constant(value_ints=[0, num_groups, -1]))
    ones, zeros = (op.Constant(value_floats=[value] * num_groups) for value in (1.0, 0.0))
    normed = op.InstanceNormalization(grouped, ones, zeros, epsilon=eps)
    result = op.Reshape(normed, op.Constant(value_ints=[-1, channels, *inner]))
    axes = op.Constant(value_ints=list(range(1, 1 + len(inner))))
    if weight is not None:
        result = op.Mul(result, op.Unsqueeze(weight, axes))
    return result if bias is None else op.Add(result, op.Unsqueeze(bias, axes))


def conv1d(
    input: Any,
    weight: Any,
    bias: Any = None,
    stride: Sequence[int] = (1,),
    padding: Sequence[int] = (0,),
    dilation: Sequence[int] = (1,),
    groups: int = 1,
) -> Any:
    """``aten.conv1d``: over few positions as one product, ``[positions, kernel * channels]`` by the weights."""
    (_, positions), (out, size) = _sizes(input), (int(weight.shape[0]), int(weight.shape[2]))
    (step,), (edge,), (spread,) = stride, padding, dilation
    count = (positions + 2 * edge - spread * (size - 1) - 1) // step + 1
    if groups != 1 or count > FEW:
        given = {"strides": [step], "pads": [edge, edge], "dilations": [spread], "group": groups}
        return op.Conv(input, weight, bias, **given)
    rows = op.Transpose(input, perm=[0, 2, 1])
    if edge:
        rows = op.Pad(rows, op.Constant(value_ints=[0, edge, 0, 0, edge, 0]))
    taken = [[first * step + tap * spread for tap in range(size)] for first in range(count)]
    indices = op.Constant(value=ir.tensor(np.array(taken, np.int64)))
    seen = op.Reshape(op.Gather(rows, indices, axis=1), op.Constant(value_ints=[0, count, -1]))
    matrix = op.Reshape(op.Transpose(weight, perm=[2, 1, 0]), op.Constant(value_ints=[-1, out]))
    result = op.MatMul(seen, matrix)
    if bias is not None:
        result = op.Add(result, bias)
    return op.Transpose(result, perm=[0, 2, 1])


def conv_transpose1d(
    input: Any,
    weight: Any,
    bias: Any = None,
    stride: Sequence[int] = (1,),
    padding: Sequence[int] = (0,),
    output_padding: Sequence[int] = (0,),
    groups: int = 1,
    dilation: Sequence[int] = (1,),
) -> Any:
    """``aten.conv_transpose1d``."""
    given = {"strides": list(stride), "pads": [*padding, *padding], "dilations": list(dilation), "group": groups}
    return op.ConvTranspose(input, weight, bias, output_padding=list(output_padding), **given)


def index_copy(self: Any, dim: int, index: Any, source: Any) -> Any:
    """``aten.index_copy``: along the first axis ScatterND, which copies rows; else between transpositions."""
    if dim == 0:
        return op.ScatterND(self, op.Unsqueeze(index, op.Constant(value_ints=[-1])), source)
    order = list(range(len(self.shape)))
    order[0], order[dim] = order[dim], order[0]
    moved, rows = (op.Transpose(value, perm=order) for value in (self, source))
    return op.Transpose(index_copy(moved, 0, index, rows), perm=order)


_HEADS_FORWARD = [0, 2, 1, 3]


def attention(
    query: Any,
    key: Any,
    value: Any,
    attn_mask: Any = None,
    dropout_p: float = 0.0,
    is_causal: bool = False,
    scale: float | None = None,
    enable_gqa: bool = False,
) -> Any:
    """``aten.scaled_dot_product_attention``, of which dropout is off.

    Before, on tensors of four axes::

        q -> Transpose -+
        k -> Transpose -+-> Attention -> Transpose -> y
        v -> Transpose -+

    After, on ``[batch, tokens, heads * channels]``, with the number of heads as an attribute::

        q -> Reshape -+
        k -> Reshape -+-> Attention -> Reshape -> y
        v -> Reshape -+

    Measured with onnxruntime 1.31, 1 thread, self-attention of width 256, 16 tokens, 4 heads: 0.129 ms before, 0.118
    after. What transposes the result is written once more, and the exporter drops both.
    """
    given, options = (query, key, value), {"scale": scale, "is_causal": int(is_causal)}
    before, heads = [_before_heads(each) for each in given], [each.shape[1] for each in given]
    if None in before or not all(isinstance(count, int) for count in heads):
        return op.Attention(*given, attn_mask, **options)[0]
    flat = [op.Reshape(each, op.Constant(value_ints=[0, 0, -1])) for each in before]
    made = op.Attention(*flat, attn_mask, q_num_heads=heads[0], kv_num_heads=heads[1], **options)
    apart = op.Reshape(made[0], op.Constant(value_ints=[0, 0, heads[0], -1]))
    return op.Transpose(apart, perm=_HEADS_FORWARD)


def _before_heads(value: Any) -> Any:
    """What a transposition of heads was made of; None if the value is of something else."""
    made = value.producer()
    moves = made is not None and made.op_type == "Transpose" and list(made.attributes["perm"].value) == _HEADS_FORWARD
    return made.inputs[0] if moves else None


TRANSLATIONS: Mapping[Any, Callable[..., Any]] = {
    torch.ops.aten.group_norm.default: group_norm,
    torch.ops.aten.conv1d.default: conv1d,
    torch.ops.aten.conv_transpose1d.default: conv_transpose1d,
    torch.ops.aten.index_copy.default: index_copy,
    torch.ops.aten.scaled_dot_product_attention.default: attention,
}
"""As ``torch.onnx.export`` takes them."""
