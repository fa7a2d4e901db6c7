"""Attention among many tokens as integer products, one head at a time, so that its scores stay in the cache.

Both factors change at each call, so both get their integers there::

    scores = query_u8 @ (key - mean)_s8        one scale for the query, one for each key; the mean shifts all scores of
                                               a query alike, which a softmax does not see
    shares = softmax(scores)                   float32, and then u8 with a scale for each query
    result = shares_u8 @ (value - mean)_s8 + mean     shares sum to one, so those too small for a u8 get the mean value

Keys and values are in -64..64: then no processor's sums saturate, whatever the option says that makes onnxruntime exact
for constants. ``docs/decisions.md`` has the figures.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from onnx import GraphProto, NodeProto, TensorProto

from .graph_writer import GraphWriter, tensor
from .integer_convolution import DOMAIN, DYNAMIC_PRODUCT, INTEGER_PRODUCT

FEWEST = 256
"""Queries, and keys, from which on integers are faster. How many times as fast as in fp32, 12 heads of 64 channels,
onnxruntime 1.31, AVX-512 VNNI, one thread: 1.0 for 197, 1.2 for 256, 1.6 for 576, 1.9 for 1,024."""

LARGEST_FACTOR = 64
"""Of keys and values: 2 * 255 * 64 is the most that 16 bits hold of two products, which AVX2 adds there."""

HEADS = "Scan"
"""The operation that goes through the heads."""

_PLAIN = {"is_causal": 0, "qk_matmul_output_mode": 0, "softcap": 0.0}
"""Attributes that change what is computed, and their values where they do not."""


@dataclass(frozen=True)
class Attention:
    """An attention that can be done in integers.

    Attributes:
        inputs: names of query ``[B, T, heads * C]``, key and value ``[B, S, heads * C]`` in float32.
        flat: they are as above, as is the result; else ``[B, heads, tokens, C]``.
        queries: T; zero if only a run says it, and then B is one.
        keys: S.
        channels: C of query and key, and of value.
    """

    inputs: tuple[str, str, str]
    flat: bool
    heads: int
    queries: int
    keys: int
    channels: tuple[int, int]
    scale: float


def attention_of(
    node: NodeProto, attributes: Mapping[str, Any], shapes: Mapping[str, Sequence[int]], any_queries: bool = False
) -> Attention | None:
    """What a node attends to, if integers can do that, and are faster.

    Args:
        shapes: of values, zero for a size that is not known.
        any_queries: the shapes are of one case of many: a run has one row, and any number of queries.
    """
    if node.op_type != "Attention" or any(node.input[3:]) or len(node.output) != 1:
        return None
    known = {*_PLAIN, "q_num_heads", "kv_num_heads", "scale"}
    plain = all(attributes.get(name, value) == value for name, value in _PLAIN.items()) and known.issuperset(attributes)
    given = [tuple(shapes.get(name, ())) for name in node.input[:3]]
    flat = all(len(shape) == 3 for shape in given)
    if flat:
        counts = (attributes.get("q_num_heads", 0), *[attributes.get("kv_num_heads", 0)] * 2)
        given = [(b, n, t, c // n) if n else () for n, (b, t, c) in zip(counts, given, strict=True)]
    if not plain or any(len(shape) != 4 or 0 in shape[1:] for shape in given):
        return None
    (batch, heads, queries, channels), (_, others, keys, _), (_, _, _, last) = given
    if others != heads or min(queries, keys) < FEWEST or (any_queries and batch != 1):
        return None
    inputs = (node.input[0], node.input[1], node.input[2])
    scale = attributes.get("scale", channels**-0.5)
    return Attention(inputs, flat, heads, 0 if any_queries else queries, keys, (channels, last), scale)


def integer_attention(w: GraphWriter, node: NodeProto, of: Attention) -> None:
    """Write the nodes that take the place of ``node``."""
    sizes = (of.queries, of.channels[0]), (of.keys, of.channels[0]), (of.keys, of.channels[1])
    batch, queries = (-1, of.queries) if of.queries else (1, -1)

    def reshaped(x: str, *shape: int) -> str:
        return w.op("Reshape", x, w.constant(shape))

    parts = []
    for x, (tokens, channels) in zip(of.inputs, sizes, strict=True):
        if of.flat:
            x = w.op("Transpose", reshaped(x, batch, tokens or -1, of.heads, channels), perm=[0, 2, 1, 3])
        parts.append(reshaped(x, -1 if of.queries else of.heads, tokens or -1, channels))
    result = w.op(HEADS, *parts, body=_head(w.inner(), of, sizes), num_scan_inputs=3)
    shape = [batch, of.heads, queries, of.channels[1]]
    if of.flat:
        result = w.op("Transpose", reshaped(result, *shape), perm=[0, 2, 1, 3])
        shape = [batch, queries, of.heads * of.channels[1]]
    w.ops("Reshape", [result, w.constant(shape)], node.output)


def _head(w: GraphWriter, of: Attention, sizes: Sequence[tuple[int, int]]) -> GraphProto:
    """One head, ``[tokens, channels]`` each."""
    query, key, value = (w.fresh(name) for name in ("query", "key", "value"))
    last = w.constant([-1])

    def number(value: float) -> str:
        return w.constant(value, np.float32)

    def centred(x: str, *axes: str, **attributes: Any) -> tuple[str, str, str]:
        """``x``, less its mean over tokens, as integers; their scale or, along ``axes``, scales; and the mean."""
        mean = w.op("MatMul", w.constant(np.full((1, of.keys), 1 / of.keys), np.float32), x)
        rest = w.op("Sub", x, mean)
        step = w.op("Mul", w.op("ReduceMax", w.op("Abs", rest), *axes, keepdims=0), number(1 / LARGEST_FACTOR))
        scale = w.op("Max", step, number(float(np.finfo(np.float32).tiny)))
        return w.op("QuantizeLinear", rest, scale, output_dtype=TensorProto.INT8, **attributes), scale, mean

    keys, scales, _ = centred(key, last, axis=0)
    values, scale, mean = centred(value)
    turned, factor = w.op("Transpose", keys, perm=[1, 0]), w.op("Mul", scales, number(of.scale))
    shares = w.op("Softmax", w.op(DYNAMIC_PRODUCT, query, turned, factor, domain=DOMAIN), axis=-1)
    step = w.op("Mul", w.op("ReduceMax", shares, last, keepdims=0), number(1 / 255))
    integers = w.op("QuantizeLinear", shares, step, axis=0, output_dtype=TensorProto.UINT8)
    made = w.op(INTEGER_PRODUCT, integers, values, number(1), scale, domain=DOMAIN)
    result = w.op("Add", w.op("Mul", made, w.op("Unsqueeze", step, last)), mean)
    given = zip((query, key, value), sizes, strict=True)
    inputs = [tensor(name, np.float32, [tokens or "T", channels]) for name, (tokens, channels) in given]
    return w.graph("head", [tensor(result, np.float32, [of.queries or "T", of.channels[1]])], inputs)
