"""Convolutions with constant weights as integer products: each place of the result is a row of the pixels that it sees.

The input becomes uint8 first, with one scale and zero point for the whole tensor, so that gathering the rows moves a
quarter of the bytes; then it is what ``precision`` makes of a matrix product. ``docs/decisions.md`` has the figures.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
from onnx import ModelProto, NodeProto, shape_inference

from .graph_writer import GraphWriter

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


def integer_convolution(w: GraphWriter, node: NodeProto, of: Convolution, integers: str, scales: str) -> None:
    """Write the nodes that take the place of ``node``.

    Args:
        node: the convolution.
        of: what it convolves.
        integers: name of the constant int8 ``[kernel * C, O]``.
        scales: name of the constant float32 ``[O]``.
    """
    axes, kernel, places = len(of.sizes), len(of.matrix), int(np.prod(of.sizes))
    pixels, scale, zero = w.ops("DynamicQuantizeLinear", [of.x], 3)
    pixels = w.op("Transpose", pixels, perm=[0, *range(2, 2 + axes), 1])
    if any(of.pads):
        pixels = w.op("Pad", pixels, w.constant([0, *of.pads[:axes], 0, 0, *of.pads[axes:], 0]), zero)
    if of.places is not None:
        channels = kernel // (of.places.size // places)
        pixels = w.op("Reshape", pixels, w.constant([0, -1, channels]))
        pixels = w.op("Gather", pixels, w.constant(of.places, np.int32), axis=1)
    rows = w.op("Reshape", pixels, w.constant([0, places, kernel]))
    bias = ["", of.bias] if of.bias else []
    made = w.op(INTEGER_PRODUCT, rows, integers, scale, scales, zero, *bias, domain=DOMAIN)
    turned = w.op("Transpose", made, perm=[0, 2, 1])
    w.ops("Reshape", [turned, w.constant([0, of.matrix.shape[1], *of.sizes])], node.output)


def _seen(
    sizes: Sequence[int], kernel: Sequence[int], strides: Sequence[int], dilations: Sequence[int], result: Sequence[int]
) -> npt.NDArray[np.int32]:
    """The pixels that each place of the result sees, place by place and tap by tap, as numbers in order."""
    numbers = np.zeros((1, 1), np.int64)  # [places, taps] of the axes so far
    for size, taps, step, spread, count in zip(sizes, kernel, strides, dilations, result, strict=True):
        own = np.arange(count)[:, None] * step + np.arange(taps) * spread
        numbers = (numbers[:, None, :, None] * size + own[None, :, None, :]).reshape(len(numbers) * count, -1)
    return numbers.astype(np.int32).reshape(-1)
