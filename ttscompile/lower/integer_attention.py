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

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
from onnx import GraphProto, NodeProto, TensorProto, helper, numpy_helper

from .integer_convolution import DOMAIN, DYNAMIC_PRODUCT, INTEGER_PRODUCT

Array = npt.NDArray[Any]

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


def integer_attention(node: NodeProto, of: Attention, keep: Callable[[str, Array], str]) -> list[NodeProto]:
    """The nodes that take the place of ``node``; ``keep`` stores a small constant under a name, and gives the name."""
    own = f"{node.name}."
    sizes = (of.queries, of.channels[0]), (of.keys, of.channels[0]), (of.keys, of.channels[1])
    result = (of.queries, of.channels[1])
    batch, queries = (-1, of.queries) if of.queries else (1, -1)
    nodes: list[NodeProto] = []

    def reshape(x: str, y: str, *shape: int) -> None:
        nodes.append(helper.make_node("Reshape", [x, keep(f"{own}{y}.shape", np.array(shape))], [y], f"{own}{y}"))

    def turn(x: str, y: str) -> None:
        nodes.append(helper.make_node("Transpose", [x], [y], f"{own}{y}", perm=[0, 2, 1, 3]))

    parts = [own + name for name in ("query", "key", "value")]
    for x, part, (tokens, channels) in zip(of.inputs, parts, sizes, strict=True):
        if of.flat:
            reshape(x, f"{part}.tokens", batch, tokens or -1, of.heads, channels)
            turn(f"{part}.tokens", f"{part}.heads")
        reshape(f"{part}.heads" if of.flat else x, part, -1 if of.queries else of.heads, tokens or -1, channels)
    each, heads, rows = own + "each", own + "heads", own + "tokens"
    nodes.append(helper.make_node(HEADS, parts, [each], each, body=_head(own, of, sizes, result), num_scan_inputs=3))
    reshape(each, heads if of.flat else node.output[0], batch, of.heads, queries, of.channels[1])
    if of.flat:
        turn(heads, rows)
        reshape(rows, node.output[0], batch, queries, of.heads * of.channels[1])
    return nodes


def _head(own: str, of: Attention, sizes: Sequence[tuple[int, int]], result: tuple[int, int]) -> GraphProto:
    """One head, ``[tokens, channels]`` each. No name of it is one of the model's, nor that of another attention."""
    nodes: list[NodeProto] = []
    constants: dict[str, Array] = {
        "mean": np.full((1, of.keys), 1 / of.keys, np.float32),
        "channels": np.array([-1]),
        "factor": np.array(1 / LARGEST_FACTOR, np.float32),
        "share": np.array(1 / 255, np.float32),
        "least": np.array(np.finfo(np.float32).tiny, np.float32),
        "scale": np.array(of.scale, np.float32),
        "one": np.array(1, np.float32),
    }

    def add(operation: str, inputs: str, output: str, domain: str = "", **attributes: Any) -> None:
        given, made = ([f"{own}{name}" for name in names.split()] for names in (inputs, output))
        nodes.append(helper.make_node(operation, given, made, made[0], domain=domain, **attributes))

    def centre(x: str, axes: str, **attributes: Any) -> None:
        """``x``, less its mean over tokens, as integers; and their scale or, along ``axes``, scales."""
        add("MatMul", f"mean {x}", f"{x}.mean")
        add("Sub", f"{x} {x}.mean", f"{x}.centred")
        add("Abs", f"{x}.centred", f"{x}.sizes")
        add("ReduceMax", f"{x}.sizes{axes}", f"{x}.largest", keepdims=0)
        add("Mul", f"{x}.largest factor", f"{x}.step")
        add("Max", f"{x}.step least", f"{x}.scale")
        add("QuantizeLinear", f"{x}.centred {x}.scale", f"{x}.s8", output_dtype=TensorProto.INT8, **attributes)

    centre("k", " channels", axis=0)
    centre("v", "")
    add("Transpose", "k.s8", "k.turned", perm=[1, 0])
    add("Mul", "k.scale scale", "k.scaled")
    add(DYNAMIC_PRODUCT, "q k.turned k.scaled", "scores", DOMAIN)
    add("Softmax", "scores", "shares", axis=-1)
    add("ReduceMax", "shares channels", "shares.largest", keepdims=0)
    add("Mul", "shares.largest share", "shares.scale")
    add("QuantizeLinear", "shares shares.scale", "shares.u8", axis=0, output_dtype=TensorProto.UINT8)
    add(INTEGER_PRODUCT, "shares.u8 v.s8 one v.scale", "made", DOMAIN)
    add("Unsqueeze", "shares.scale channels", "rows")
    add("Mul", "made rows", "scaled")
    add("Add", "scaled v.mean", "y")
    inputs = [
        helper.make_tensor_value_info(own + name, TensorProto.FLOAT, [tokens or "T", channels])
        for name, (tokens, channels) in zip("qkv", sizes, strict=True)
    ]
    output = helper.make_tensor_value_info(own + "y", TensorProto.FLOAT, [result[0] or "T", result[1]])
    kept = [numpy_helper.from_array(value, own + name) for name, value in constants.items()]
    return helper.make_graph(nodes, "head", inputs, [output], kept)
