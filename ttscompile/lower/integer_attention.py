"""Attention among many tokens as integer products, one head at a time, so that its scores stay in the cache.

Both factors change at each call, so both get their integers there::

    scores = query_u8 @ (key - mean)_s8        one scale for the query, one for each key; the mean shifts all scores of
                                               a query alike, which a softmax does not see
    shares = softmax(scores)                   float32, and then u8 with a scale for each query
    result = shares_u8 @ (value - mean)_s8 + mean     shares sum to one, so those too small for a u8 get the mean value

Keys and values are in -64..64: then no processor's sums saturate, whatever the option says that makes onnxruntime exact
for constants. ``docs/decisions.md`` has the figures.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from onnx import GraphProto, NodeProto
from onnx.numpy_helper import from_array

from .graph_writer import GraphWriter, tensor
from .integer_convolution import DOMAIN, DYNAMIC_PRODUCT, INTEGER_PRODUCT, NO_ZERO

FEWEST = 256
"""Queries, and keys, from which on integers are faster than fp32."""

LARGEST_FACTOR = 64
"""Of keys and values: 2 * 255 * 64 is the most that 16 bits hold of two products, which AVX2 adds there."""

HEADS = "Scan"
"""The operation that goes through the heads."""

_PLAIN = {"is_causal": 0, "qk_matmul_output_mode": 0, "softcap": 0.0}
"""Attributes that change what is computed, and their values where they do not."""


def integer_attention(
    w: GraphWriter,
    node: NodeProto,
    attributes: Mapping[str, Any],
    shapes: Mapping[str, Sequence[int]],
    any_queries: bool = False,
) -> bool:
    """Write what a node attends to with integers, if they can do that, and are faster; whether they are.

    Query ``[B, T, heads * C]``, key and value ``[B, S, heads * C]`` are in float32, or ``[B, heads, tokens, C]``, as is
    the result.

    Args:
        shapes: of values, zero for a size that is not known.
        any_queries: the shapes are of one case of many: a run has one row, and any number of queries.
    """
    if node.op_type != "Attention" or any(node.input[3:]) or len(node.output) != 1:
        return False
    known = {*_PLAIN, "q_num_heads", "kv_num_heads", "scale"}
    plain = all(attributes.get(name, value) == value for name, value in _PLAIN.items()) and known.issuperset(attributes)
    given = [tuple(shapes.get(name, ())) for name in node.input[:3]]
    flat = all(len(shape) == 3 for shape in given)
    if flat:
        counts = (attributes.get("q_num_heads", 0), *[attributes.get("kv_num_heads", 0)] * 2)
        given = [(b, n, t, c // n) if n else () for n, (b, t, c) in zip(counts, given, strict=True)]
    if not plain or any(len(shape) != 4 or 0 in shape[1:] for shape in given):
        return False
    (batch, heads, queries, channels), (_, others, keys, _), (_, _, _, last) = given
    if others != heads or min(queries, keys) < FEWEST or (any_queries and batch != 1):
        return False
    batch, queries = (1, -1) if any_queries else (-1, queries)
    sizes = (queries, channels), (keys, channels), (keys, last)

    def reshaped(x: str, *shape: int) -> str:
        return w.op("Reshape", x, w.constant(shape))

    parts = []
    for x, (tokens, width) in zip(node.input[:3], sizes, strict=True):
        if flat:
            x = w.op("Transpose", reshaped(x, batch, tokens, heads, width), perm=[0, 2, 1, 3])
        parts.append(reshaped(x, heads if any_queries else -1, tokens, width))
    head = _head(w.inner(), sizes, attributes.get("scale", channels**-0.5))
    result, shape = w.op(HEADS, *parts, body=head, num_scan_inputs=3), [batch, heads, queries, last]
    if flat:
        result = w.op("Transpose", reshaped(result, *shape), perm=[0, 2, 1, 3])
        shape = [batch, queries, heads * last]
    w.ops("Reshape", [result, w.constant(shape)], node.output)
    return True


def _head(w: GraphWriter, sizes: Sequence[tuple[int, int]], scale: float) -> GraphProto:
    """One head: query, key and value of these tokens and channels, -1 for tokens that only a run knows."""
    query, key, value = (w.fresh(name) for name in ("query", "key", "value"))
    last, tokens = w.constant([-1]), sizes[1][0]

    def number(value: float) -> str:
        return w.constant(value, np.float32)

    def centred(x: str, *axes: str, **attributes: Any) -> tuple[str, str, str]:
        """``x``, less its mean over tokens, as integers; their scale or, along ``axes``, scales; and the mean."""
        mean = w.op("MatMul", w.constant(np.full((1, tokens), 1 / tokens), np.float32), x)
        rest = w.op("Sub", x, mean)
        step = w.op("Mul", w.op("ReduceMax", w.op("Abs", rest), *axes, keepdims=0), number(1 / LARGEST_FACTOR))
        own = w.op("Max", step, number(float(np.finfo(np.float32).tiny)))
        return integers_of(rest, own, np.int8, **attributes), own, mean

    def integers_of(x: str, scale: str, kind: type[np.generic], **attributes: Any) -> str:
        # ONNX's own operation of this opset is not in onnxruntime 1.23.
        zeros = w.op("ConstantOfShape", w.op("Shape", scale), value=from_array(np.zeros(1, kind)))
        return w.op("QuantizeLinear", x, scale, zeros, domain=DOMAIN, **attributes)

    keys, scales, _ = centred(key, last, axis=0)
    values, one, mean = centred(value)
    turned, factor = w.op("Transpose", keys, perm=[1, 0]), w.op("Mul", scales, number(scale))
    shares = w.op("Softmax", w.op(DYNAMIC_PRODUCT, query, turned, factor, NO_ZERO, domain=DOMAIN), axis=-1)
    step = w.op("Mul", w.op("ReduceMax", shares, last, keepdims=0), number(1 / 255))
    integers = integers_of(shares, step, np.uint8, axis=0)
    made = w.op(INTEGER_PRODUCT, integers, values, number(1), one, NO_ZERO, NO_ZERO, domain=DOMAIN)
    result = w.op("Add", w.op("Mul", made, w.op("Unsqueeze", step, last)), mean)
    shapes = [[count if count > 0 else "T", width] for count, width in (*sizes, (sizes[0][0], sizes[2][1]))]
    inputs = [tensor(name, np.float32, shape) for name, shape in zip((query, key, value), shapes, strict=False)]
    return w.graph("head", [tensor(result, np.float32, shapes[-1])], inputs)
