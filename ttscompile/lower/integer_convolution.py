"""Convolutions with constant weights as integer products: each place of the result is a row of the pixels that it sees.

The input becomes uint8 first, with one scale and zero point for the whole tensor, so that gathering the rows moves a
quarter of the bytes; then it is what ``precision`` makes of a matrix product. ``docs/decisions.md`` has the figures.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
from onnx import ModelProto, NodeProto, helper, shape_inference

Array = npt.NDArray[Any]

DOMAIN = "com.microsoft"
INTEGER_PRODUCT = "MatMulIntegerToFloat"
"""uint8 by int8 into int32, scaled by column, with the bias added."""
DYNAMIC_PRODUCT = "DynamicQuantizeMatMul"
"""Reads float32, quantises it to uint8 with one scale and zero point for the whole tensor, multiplies with int8 weights
into int32, scales by column and adds the bias. Fastest of what onnxruntime 1.31 has; see ``docs/decisions.md``."""

_STREAMS = re.compile(r"([1-9][0-9]*\*)?B")
"""A size that depends on the number of streams, as ``onnx_model.value_info`` writes it."""

LEAST = 2048
"""Channels in times channels out from which integers are faster: gathering a tap costs as much for any. How many times
as fast as in fp32 with onnxruntime 1.31, AVX-512 VNNI, one thread: 0.4 for 3 x 64, 1.9 for 3 x 768, 2.0 for 64 x 64,
3.2 for 512 x 512."""


@dataclass(frozen=True, eq=False)
class Convolution:
    """A convolution that can be done in integers.

    Attributes:
        x: name of the float32 input ``[N, C, *sizes]``.
        weight: name of the constant ``[O, C, *kernel]``.
        matrix: its value as float32 ``[kernel * C, O]``.
        bias: name of a constant ``[O]``; empty if there is none.
        pads: before each axis of ``sizes``, and then after each.
        places: which pixels each place of the result sees, of the padded ones, int32 ``[places * kernel]``; None where
            they are all of them in order.
    """

    x: str
    weight: str
    matrix: Array
    bias: str
    pads: tuple[int, ...]
    places: npt.NDArray[np.int32] | None
    sizes: tuple[int, ...]


def shapes_of(model: ModelProto, size: int = 1) -> dict[str, tuple[int, ...]]:
    """Shapes of values where B is ``size``; zero for a size that is not known."""
    alone = ModelProto()
    alone.CopyFrom(model)
    for value in alone.graph.input:
        for axis in value.type.tensor_type.shape.dim:
            if _STREAMS.fullmatch(axis.dim_param):
                axis.dim_value = int(axis.dim_param.partition("*")[0].replace("B", "1")) * size
    for value in alone.graph.output:  # they say the number of streams, too
        value.type.tensor_type.ClearField("shape")
    graph = shape_inference.infer_shapes(alone, data_prop=True).graph
    return {
        value.name: tuple(d.dim_value for d in value.type.tensor_type.shape.dim)
        for value in [*graph.value_info, *graph.input]
    }


def convolution_of(
    node: NodeProto, attributes: Mapping[str, Any], known: Mapping[str, Array], shapes: Mapping[str, Sequence[int]]
) -> Convolution | None:
    """What a node convolves, if integers can do that, and are faster; ``known`` has the values of constants by name."""
    weight = known.get(node.input[1]) if node.op_type == "Conv" else None
    bias = node.input[2] if len(node.input) > 2 else ""
    sizes = tuple(shapes.get(node.input[0], ())[2:]) if node.input else ()
    if weight is None or weight.dtype != np.float32 or (bias and bias not in known) or not sizes or 0 in sizes:
        return None
    out, channels, *kernel = weight.shape
    plain = attributes.get("group", 1) == 1 and attributes.get("auto_pad", b"NOTSET") in (b"NOTSET", "NOTSET")
    if not plain or out * channels < LEAST or len(sizes) != len(kernel):
        return None
    axes, ones = len(sizes), [1] * len(sizes)
    pads = tuple(attributes.get("pads", [0] * 2 * axes))
    strides, dilations = attributes.get("strides", ones), attributes.get("dilations", ones)
    padded = [size + before + after for size, before, after in zip(sizes, pads[:axes], pads[axes:], strict=True)]
    spans = zip(padded, kernel, strides, dilations, strict=True)
    result = tuple((size - spread * (taps - 1) - 1) // step + 1 for size, taps, step, spread in spans)
    seen = _seen(padded, kernel, strides, dilations, result)
    matrix = np.moveaxis(weight, (0, 1), (-1, -2)).reshape(-1, out)
    places = None if np.array_equal(seen, np.arange(np.prod(padded))) else seen
    return Convolution(node.input[0], node.input[1], matrix, bias, pads, places, result)


def integer_convolution(
    node: NodeProto, of: Convolution, integers: str, scales: str, keep: Callable[[str, Array], str]
) -> list[NodeProto]:
    """The nodes that take the place of ``node``.

    Args:
        node: the convolution.
        of: what it convolves.
        integers: name of the constant int8 ``[kernel * C, O]``.
        scales: name of the constant float32 ``[O]``.
        keep: stores a small constant under a name, and gives the name.
    """
    axes, own = len(of.sizes), f"{node.name}."
    kernel = len(of.matrix)
    u8, scale, zero = (own + name for name in ("u8", "scale", "zero"))
    last = own + "last"
    nodes = [
        helper.make_node("DynamicQuantizeLinear", [of.x], [u8, scale, zero], f"{own}0"),
        helper.make_node("Transpose", [u8], [last], f"{own}1", perm=[0, *range(2, 2 + axes), 1]),
    ]
    if any(of.pads):
        edges = np.array([0, *of.pads[:axes], 0, 0, *of.pads[axes:], 0])
        nodes.append(helper.make_node("Pad", [last, keep(own + "edges", edges), zero], [own + "padded"], f"{own}2"))
        last = own + "padded"
    if of.places is not None:
        channels = kernel // (of.places.size // int(np.prod(of.sizes)))
        pixels = keep(own + "pixels", np.array([0, -1, channels]))
        nodes.append(helper.make_node("Reshape", [last, pixels], [own + "all"], f"{own}3"))
        places = keep(own + "places", of.places)
        nodes.append(helper.make_node("Gather", [own + "all", places], [own + "seen"], f"{own}4", axis=1))
        last = own + "seen"
    rows = keep(own + "rows", np.array([0, int(np.prod(of.sizes)), kernel]))
    inputs = [own + "each", integers, scale, scales, zero, *(["", of.bias] if of.bias else [])]
    shape = keep(own + "shape", np.array([0, of.matrix.shape[1], *of.sizes]))
    return [
        *nodes,
        helper.make_node("Reshape", [last, rows], [own + "each"], f"{own}5"),
        helper.make_node(INTEGER_PRODUCT, inputs, [own + "made"], f"{own}6", domain=DOMAIN),
        helper.make_node("Transpose", [own + "made"], [own + "turned"], f"{own}7", perm=[0, 2, 1]),
        helper.make_node("Reshape", [own + "turned", shape], list(node.output), f"{own}8"),
    ]


def _seen(
    sizes: Sequence[int], kernel: Sequence[int], strides: Sequence[int], dilations: Sequence[int], result: Sequence[int]
) -> npt.NDArray[np.int32]:
    """The pixels that each place of the result sees, place by place and tap by tap, as numbers in order."""
    numbers = np.zeros((1, 1), np.int64)  # [places, taps] of the axes so far
    for size, taps, step, spread, count in zip(sizes, kernel, strides, dilations, result, strict=True):
        own = np.arange(count)[:, None] * step + np.arange(taps) * spread
        numbers = (numbers[:, None, :, None] * size + own[None, :, None, :]).reshape(len(numbers) * count, -1)
    return numbers.astype(np.int32).reshape(-1)
