"""Convolutions with constant weights as integer products: each place of the result is a row of the pixels that it sees.

The input becomes uint8 first, with one scale and zero point for the whole tensor, so that gathering the rows moves a
quarter of the bytes; then it is what ``precision`` makes of a matrix product. ``docs/decisions.md`` has the figures.
"""

import re
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
from onnx import ModelProto, NodeProto, TensorProto, numpy_helper, shape_inference

from ..core.coercion import Array, Arrays
from .graph_writer import GraphWriter
from .onnx_model import replaced

DOMAIN = "com.microsoft"
INTEGER_PRODUCT = "MatMulIntegerToFloat"
"""uint8 by int8 into int32, scaled by column, with the bias added."""
DYNAMIC_PRODUCT = "DynamicQuantizeMatMul"
"""Reads float32, quantises it to uint8 with one scale and zero point for the whole tensor, multiplies with int8 weights
into int32, scales by column and adds the bias. Fastest of what onnxruntime 1.31 has; see ``docs/decisions.md``."""
NO_ZERO = ""
"""In the place of the weights' zero point, which is 0. It has to be named as absent: onnxruntime 1.25 to 1.29 read this
place whether there is one or not, and end the process, where they are told to sum integers exactly."""

_STREAMS = re.compile(r"([1-9][0-9]*\*)?B")
"""A size that depends on the number of streams, as ``onnx_model.value_info`` writes it."""

LEAST = 2048
"""Channels in times channels out from which integers are faster: gathering a tap costs as much for any."""


def shapes_of(model: ModelProto, size: int = 1) -> dict[str, tuple[int, ...]]:
    """Shapes of values where B is ``size``; zero for a size that is not known."""
    alone = replaced(model)
    for value in alone.graph.input:
        for axis in value.type.tensor_type.shape.dim:
            if _STREAMS.fullmatch(axis.dim_param):
                axis.dim_value = int(axis.dim_param.partition("*")[0].replace("B", "1")) * size
    for value in alone.graph.output:  # they say the number of streams, too
        value.type.tensor_type.ClearField("shape")
    _fold_sizes(alone)
    graph = shape_inference.infer_shapes(alone, data_prop=True).graph
    return {
        value.name: tuple(d.dim_value for d in value.type.tensor_type.shape.dim)
        for value in [*graph.value_info, *graph.input]
    }


_FOLDED: Mapping[str, Callable[..., Any]] = {
    "Div": np.floor_divide,
    "Reshape": lambda size, shape: size.reshape(shape),
    "Concat": lambda *sizes: np.concatenate(sizes),
}


def _fold_sizes(model: ModelProto) -> None:
    """Put constants in place of sizes that are divided: inference does not follow B from an input of ``2*B`` rows."""
    inputs = {value.name: [d.dim_value for d in value.type.tensor_type.shape.dim] for value in model.graph.input}
    stored = (t for t in model.graph.initializer if t.data_type == TensorProto.INT64 and (t.raw_data or t.int64_data))
    known = {tensor.name: numpy_helper.to_array(tensor) for tensor in stored}
    for node in list(model.graph.node):
        attributes = {each.name: each.i for each in node.attribute}
        if node.op_type == "Shape" and all(inputs.get(node.input[0], [0])):
            known[node.output[0]] = np.array(inputs[node.input[0]])[attributes.get("start", 0) : attributes.get("end")]
        elif node.op_type == "Squeeze" and node.input[0] in known and known[node.input[0]].size == 1:
            known[node.output[0]] = known[node.input[0]].reshape(())
        elif node.op_type in _FOLDED and all(name in known for name in node.input):
            known[node.output[0]] = np.asarray(_FOLDED[node.op_type](*(known[name] for name in node.input)))
            model.graph.initializer.append(numpy_helper.from_array(known[node.output[0]], node.output[0]))
            model.graph.node.remove(node)


def integer_convolution(
    w: GraphWriter,
    node: NodeProto,
    attributes: Mapping[str, Any],
    known: Arrays,
    shapes: Mapping[str, Sequence[int]],
    store: Callable[[str, Array], tuple[str, str]],
) -> bool:
    """Write what a node convolves with integers, if they can do that, and are faster; whether they are.

    Args:
        node: reads ``[N, C, *sizes]`` in float32, and a constant ``[O, C, *kernel]``.
        known: values of constants, by name.
        shapes: of values, zero for a size that is not known.
        store: keeps a matrix ``[kernel * C, O]`` that was made of a constant as integers, and gives the names of these
            and of their scales ``[O]``.
    """
    weight = known.get(node.input[1]) if node.op_type == "Conv" else None
    bias = node.input[2] if len(node.input) > 2 else ""
    sizes = tuple(shapes.get(node.input[0], ())[2:]) if node.input else ()
    if weight is None or weight.dtype != np.float32 or (bias and bias not in known) or not sizes or 0 in sizes:
        return False
    out, channels, *kernel = weight.shape
    plain = attributes.get("group", 1) == 1 and attributes.get("auto_pad", b"NOTSET") in (b"NOTSET", "NOTSET")
    if not plain or out * channels < LEAST or len(sizes) != len(kernel):
        return False
    axes, ones = len(sizes), [1] * len(sizes)
    pads = tuple(attributes.get("pads", [0] * 2 * axes))
    strides, dilations = attributes.get("strides", ones), attributes.get("dilations", ones)
    padded = [size + before + after for size, before, after in zip(sizes, pads[:axes], pads[axes:], strict=True)]
    spans = zip(padded, kernel, strides, dilations, strict=True)
    result = tuple((size - spread * (taps - 1) - 1) // step + 1 for size, taps, step, spread in spans)
    matrix, places = np.moveaxis(weight, (0, 1), (-1, -2)).reshape(-1, out), int(np.prod(result))
    integers, scales = store(node.input[1], matrix)
    pixels, scale, zero = w.ops("DynamicQuantizeLinear", [node.input[0]], 3)
    pixels = w.op("Transpose", pixels, perm=[0, *range(2, 2 + axes), 1])
    patches = not any(pads) and [*strides, *dilations] == [*kernel, *ones]
    if not patches or sizes != tuple(count * taps for count, taps in zip(result, kernel, strict=True)):
        if any(pads):
            pixels = w.op("Pad", pixels, w.constant([0, *pads[:axes], 0, 0, *pads[axes:], 0]), zero)
        seen = _seen(padded, kernel, strides, dilations, result)
        pixels = w.op("Reshape", pixels, w.constant([0, -1, channels]))
        pixels = w.op("Gather", pixels, w.constant(seen, np.int32), axis=1)
    elif max(kernel) > 1:  # a pixel is in one patch; its number there would be four bytes, in each model that has them
        cut = [n for pair in zip(result, kernel, strict=True) for n in pair]
        pixels = w.op("Reshape", pixels, w.constant([0, *cut[:-1], cut[-1] * channels]))
        pixels = w.op("Transpose", pixels, perm=[0, *range(1, 2 * axes, 2), *range(2, 2 * axes + 1, 2)])
    rows = w.op("Reshape", pixels, w.constant([0, places, len(matrix)]))
    made = w.op(INTEGER_PRODUCT, rows, integers, scale, scales, zero, NO_ZERO, *([bias] if bias else []), domain=DOMAIN)
    turned = w.op("Transpose", made, perm=[0, 2, 1])
    w.ops("Reshape", [turned, w.constant([0, out, *result])], node.output)
    return True


def _seen(
    sizes: Sequence[int], kernel: Sequence[int], strides: Sequence[int], dilations: Sequence[int], result: Sequence[int]
) -> npt.NDArray[np.int32]:
    """The pixels that each place of the result sees, place by place and tap by tap, as numbers in order."""
    numbers = np.zeros((1, 1), np.int64)  # [places, taps] of the axes so far
    for size, taps, step, spread, count in zip(sizes, kernel, strides, dilations, result, strict=True):
        own = np.arange(count)[:, None] * step + np.arange(taps) * spread
        numbers = (numbers[:, None, :, None] * size + own[None, :, None, :]).reshape(len(numbers) * count, -1)
    return numbers.astype(np.int32).reshape(-1)
