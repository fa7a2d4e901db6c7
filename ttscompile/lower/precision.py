"""Weights of residual blocks in eight bits: each matrix product with constant weights becomes an integer product.

Blocks of a policy stream their weights from memory once a step, which is what they wait for; a quarter of the bytes,
and the processor's integer dot product, make them faster. Everything beside these products stays in float32: layer
norms, attention, activations, biases, and the residual itself.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt
from onnx import AttributeProto, ModelProto, NodeProto, TensorProto, helper, numpy_helper

from ..core.spec import INT8, PRECISIONS
from ..errors import LoweringError
from ..ir.pieces import is_block
from .onnx_model import live_nodes
from .translations import FEW

Array = npt.NDArray[Any]

_DOMAIN, _DOMAIN_VERSION = "com.microsoft", 1
_PRODUCT = "DynamicQuantizeMatMul"
"""Reads float32, quantises it to uint8 with one scale and zero point for the whole tensor, multiplies with int8 weights
into int32, scales by column and adds the bias. Fastest of what onnxruntime 1.31 has; see ``docs/decisions.md``."""

LARGEST = 127
"""Weights are in -127..127: symmetric, so that a zero point never enters the product."""

MOST_ROWS = 2**31 // (255 * LARGEST) - 1
"""Terms of a sum of products that an int32 holds whatever their values."""


@dataclass(frozen=True, eq=False)
class _Matrix:
    """A constant float32 matrix ``[rows, columns]``, and the constant that it was made of."""

    name: str
    value: Array


@dataclass(frozen=True, eq=False)
class _Product:
    """``x @ matrix + bias``."""

    x: str  # name of the float32 input
    matrix: _Matrix
    bias: str  # name of a constant [columns]; empty if there is none


def lower_precision(
    models: Mapping[str, ModelProto], weights: Mapping[str, Array], precision: str
) -> tuple[dict[str, ModelProto], dict[str, Array], tuple[str, ...]]:
    """The models of residual blocks again, with weights of another precision.

    Args:
        models: from ``lower_program``; the blocks among them are taken.
        weights: constants of the program, by name.
        precision: ``int8``; the models have ``fp32`` already.

    Returns:
        By name, the models in which a product was replaced; the new constants of these models, by name; and notes on
        what was replaced and what was not.

    Raises:
        LoweringError: ``precision`` is none of onnxruntime's CPU provider, or no block has a product to replace.
    """
    require_precision(precision)
    made: dict[str, ModelProto] = {}
    constants: dict[str, Array] = {}
    blocks = [name for name in models if is_block(name)]
    for name in blocks:
        model, new = quantize_model(models[name], weights)
        if new:
            made[name] = model
            constants.update(new)
    replaced = sum(node.op_type == _PRODUCT for model in made.values() for node in model.graph.node)
    if not made:
        raise LoweringError(
            f"precision {precision!r}: none of the {len(blocks)} residual blocks multiplies by a constant float32"
            " matrix, so there is nothing to store in eight bits. Convert with precision 'fp32'."
        )
    megabytes = sum(value.nbytes for value in constants.values()) / 1e6
    note = f"{precision}: {replaced} matrices of {len(made)} of {len(blocks)} blocks, {megabytes:.1f} MB"
    left = [f"{name} stays fp32: no product with constant weights" for name in blocks if name not in made]
    whole = sum(node.op_type in ("Conv", "ConvTranspose") for model in made.values() for node in model.graph.node)
    if whole:
        left.append(f"convolutions that stay fp32, over more than {FEW} positions, in groups, or transposed: {whole}")
    return made, constants, (note, *left)


def require_precision(precision: str) -> None:
    """Raise unless weights of blocks can be lowered to this precision.

    Raises:
        LoweringError: says why not.
    """
    if precision not in PRECISIONS:
        raise LoweringError(f"precision {precision!r}: expected one of {', '.join(map(repr, PRECISIONS))}.")


def quantize_model(model: ModelProto, weights: Mapping[str, Array]) -> tuple[ModelProto, dict[str, Array]]:
    """One model with its products by constant matrices in integers; inputs and outputs stay as they are.

    Args:
        model: from ``lower``: constants are initializers without data.
        weights: values of constants, by name. Only these are quantised.

    Returns:
        A new model, and the constants that it has and ``model`` has not, by name: int8 ``[rows, columns]`` and
        float32 ``[columns]``. No constants if there was nothing to replace.
    """
    known = {t.name: weights[t.name] for t in model.graph.initializer if t.name in weights}
    matrices = _matrices(model, known)
    constants: dict[str, Array] = {}
    nodes = []
    for node in model.graph.node:
        product = _product(node, known, matrices)
        nodes.append(node if product is None else _integer_product(node, product, constants))
    nodes = live_nodes(nodes, {value.name for value in model.graph.output})
    quantized = ModelProto()
    quantized.CopyFrom(model)
    if not constants:
        return quantized, {}
    read = {name for node in nodes for name in node.input} | {value.name for value in model.graph.output}
    kept = [tensor for tensor in model.graph.initializer if tensor.name in read]
    types = {name: helper.np_dtype_to_tensor_dtype(value.dtype) for name, value in constants.items()}
    added = [TensorProto(name=n, dims=value.shape, data_type=types[n]) for n, value in constants.items()]
    for field, values in (("node", nodes), ("initializer", [*added, *kept])):
        quantized.graph.ClearField(field)
        getattr(quantized.graph, field).extend(values)
    quantized.opset_import.append(helper.make_opsetid(_DOMAIN, _DOMAIN_VERSION))
    return quantized, constants


def quantize_matrix(matrix: Array) -> tuple[npt.NDArray[np.int8], npt.NDArray[np.float32]]:
    """A matrix as integers times a scale for each column.

    Args:
        matrix: float32 ``[rows, columns]``.

    Returns:
        int8 ``[rows, columns]`` in -127..127, and float32 ``[columns]``; their product is within half a scale of the
        matrix.
    """
    largest = np.abs(matrix).max(axis=0)
    scale = np.where(largest < LARGEST * np.finfo(np.float32).tiny, 1.0, largest / LARGEST).astype(np.float32)
    return np.clip(np.rint(matrix / scale), -LARGEST, LARGEST).astype(np.int8), scale


def _matrices(model: ModelProto, known: Mapping[str, Array]) -> dict[str, _Matrix]:
    """The constants by the names of their values, and what transpositions and reshapes make of them."""
    shapes = {t.name: numpy_helper.to_array(t) for t in model.graph.initializer if t.raw_data or t.int64_data}
    found = {name: _Matrix(name, value) for name, value in known.items() if value.dtype == np.float32}
    for node in model.graph.node:
        before = found.get(node.input[0]) if node.input else None
        if before is None:
            continue
        if node.op_type == "Transpose":
            value = before.value.transpose(_attributes(node).get("perm"))
        elif node.op_type == "Reshape" and node.input[1] in shapes:
            value = before.value.reshape(shapes[node.input[1]])
        else:
            continue
        found[node.output[0]] = _Matrix(before.name, value)
    return found


def _product(node: NodeProto, known: Mapping[str, Array], matrices: Mapping[str, _Matrix]) -> _Product | None:
    """What a node multiplies, if it is a product by a constant matrix that can be done in integers."""
    attributes = _attributes(node)
    if node.op_type == "Gemm":
        if attributes.get("transA", 0) or attributes.get("alpha", 1.0) != 1 or attributes.get("beta", 1.0) != 1:
            return None
        flip, bias = bool(attributes.get("transB", 0)), node.input[2] if len(node.input) > 2 else ""
    elif node.op_type == "MatMul":
        flip, bias = False, ""
    else:
        return None
    x, matrix = node.input[0], matrices.get(node.input[1])
    if x in matrices or matrix is None or matrix.value.ndim != 2:
        return None
    value = matrix.value.T if flip else matrix.value
    rows, columns = value.shape
    if not 0 < rows <= MOST_ROWS or (bias and (bias not in known or known[bias].shape != (columns,))):
        return None
    return _Product(x, replace(matrix, value=value), bias)


def _integer_product(node: NodeProto, product: _Product, constants: dict[str, Array]) -> NodeProto:
    """The node that takes the place of ``node``; its constants go into ``constants``.

    No two products share them: onnxruntime 1.31 cannot load such a model where it has to make the integers unsigned
    ("Attempt to replace the existing tensor"), which is on processors whose sums saturate.
    """
    name = f"{product.matrix.name}.{INT8}"
    while name in constants:
        name += "_"
    scale = f"{name}.scale"
    values, scales = quantize_matrix(product.matrix.value)
    constants[name], constants[scale] = np.ascontiguousarray(values), scales
    inputs = [product.x, name, scale, "", product.bias] if product.bias else [product.x, name, scale]
    return NodeProto(name=node.name, op_type=_PRODUCT, domain=_DOMAIN, input=inputs, output=node.output)


def _attributes(node: NodeProto) -> dict[str, Any]:
    attributes = {}
    for attribute in node.attribute:
        value = helper.get_attribute_value(attribute)
        attributes[attribute.name] = list(value) if attribute.type == AttributeProto.INTS else value
    return attributes
