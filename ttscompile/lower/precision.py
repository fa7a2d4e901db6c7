"""Weights in eight or four bits: products with constant weights, in blocks and prologue, become integer products.

Blocks of a policy stream their weights from memory once a step, which is what they wait for; a quarter of the bytes,
and the processor's integer dot product, make them faster. An image encoder waits for arithmetic, of which the integer
dot product does four times as much. A large table, such as an embedding, has its rows in eight bits, since it is large.
Everything beside these stays in float32: layer norms, softmax, activations, biases, the residual itself, and attention
among few tokens (``integer_attention``).
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
from onnx import AttributeProto, ModelProto, NodeProto, TensorProto, helper, numpy_helper

from ..core.coercion import Array, Arrays
from ..core.four_bits import ATTRIBUTES, BLOCK_PRODUCT, columns_at_once, pack
from ..core.spec import FP32, INT4, INT8, PRECISIONS
from ..errors import LoweringError
from ..ir.flops import graph_flops
from ..ir.pieces import (
    BLOCKS,
    CONDITION,
    OF_ALL_BLOCKS,
    SCENE,
    STEP,
    frame_name,
    is_tokens,
    of_tokens,
    part_of,
    renewed_name,
)
from .graph_writer import GraphWriter
from .integer_attention import HEADS, integer_attention
from .integer_convolution import DOMAIN, DYNAMIC_PRODUCT, INTEGER_PRODUCT, NO_ZERO, integer_convolution, shapes_of
from .onnx_model import live_nodes, replaced

if TYPE_CHECKING:
    from ..ir.program import Program

PROLOGUE = "prologue"
"""All parts but the blocks, where parts are named that stay fp32."""

LEAST_SHARE = 0.2
"""Of the arithmetic of one step's blocks, which every call has: a smaller part would make hardly any call faster."""

LEAST_ROWS = 8
"""Of a product in the prologue. One with fewer takes next to no time there, and its one row is often all that a policy
knows of the world: a position, features and a sentence, whose sizes have nothing to do with each other."""

_DOMAIN_VERSION = 1

LARGEST = 127
"""Weights are in -127..127: symmetric, so that a zero point never enters the product."""

MOST_ROWS = 2**31 // (255 * LARGEST) - 1
"""Terms of a sum of products that an int32 holds whatever their values."""

LEAST_TABLE = 2**20
"""Numbers of a table whose rows are read in eight bits: an embedding of words has some 10**8."""

FOUR_BITS = (BLOCKS, SCENE, CONDITION, STEP)
"""The parts that precision int4 has in four bits, a language model's prefix among them. Image encoders have eight: they
wait for arithmetic, which takes longer in four."""

Matrices = Mapping[str, tuple[str, Array]]
"""Constant float32 matrices ``[rows, columns]`` by the names of their values, each with the name of its constant."""


def parts_to_lower(
    program: Program, keep_fp32: Collection[str] = ()
) -> tuple[tuple[str, ...], tuple[str, ...], tuple[str, ...]]:
    """Which parts of a program (``ir.pieces.part_of``) get another precision.

    Returns:
        Those for which it is worth while, in order; those that stay fp32 because ``keep_fp32`` asks for it, where
        ``prologue`` is all but ``blocks``; and notes.
    """
    flops: dict[str, int] = {}
    rows = {frame_name(i): count for i, count in enumerate(program.pieces.rows)}
    times = {STEP: program.spec.sampler.steps, **rows}
    for piece, graph in program.pieces.graphs().items():
        if (part := part_of(piece)) is not None and not of_tokens(piece):
            flops[part] = flops.get(part, 0) + graph_flops(graph) * times.get(piece, 1)
    if unknown := sorted(set(keep_fp32) - {*flops, PROLOGUE}):
        known = ", ".join(map(repr, (*flops, PROLOGUE)))
        raise LoweringError(f"what stays fp32: {unknown[0]!r} is no part of this policy; expected one of {known}.")
    left = tuple(part for part in flops if part in keep_fp32 or (part != BLOCKS and PROLOGUE in keep_fp32))
    least = LEAST_SHARE * flops[BLOCKS]
    small = [part for part in flops if part not in left and part != BLOCKS and flops[part] < least]
    if CONDITION in small and SCENE in flops and SCENE not in (*left, *small):  # it may have the same weights
        small.remove(CONDITION)
    found = tuple(part for part in flops if part not in {*left, *small})
    if not found:
        raise LoweringError(f"everything stays fp32: {', '.join(flops)}. Keep less, or convert with precision 'fp32'.")
    shares = (f"{part} stays fp32: {flops[part] / flops[BLOCKS]:.1%} of the arithmetic of a step" for part in small)
    return found, left, (*(f"{part} stays fp32, as was asked" for part in left), *shares)


def lower_precision(
    models: Mapping[str, ModelProto], weights: Arrays, precision: str, parts: Collection[str] = (BLOCKS,)
) -> tuple[dict[str, ModelProto], dict[str, Array], tuple[str, ...]]:
    """The models of some parts again, with weights of another precision.

    Args:
        models: from ``lower_program``; those of the parts are taken, but for the models that hold all blocks.
        precision: ``int8`` or ``int4``; the models have ``fp32`` already.
        parts: from ``parts_to_lower``.

    Returns:
        By name, the models in which a product was replaced; the new constants of these models, by name; and notes on
        what was replaced and what was not.
    """
    require_precision(precision)
    made: dict[str, ModelProto] = {}
    constants: dict[str, Array] = {}
    notes: list[str] = []
    for part in dict.fromkeys(parts):
        pieces = [name for name in models if part_of(name) == part and name not in OF_ALL_BLOCKS]
        lowered: dict[str, ModelProto] = {}
        new: dict[str, Array] = {}
        for name in pieces:
            # What some tokens are computed in is what all of them are: decided for all.
            size = 1
            if is_tokens(name):  # as many as rows are kept
                graph = models[name].graph
                renewed = {value.name for value in graph.output}
                kept = next(value for value in graph.input if renewed_name(value.name) in renewed)
                size = int(kept.type.tensor_type.shape.dim[0].dim_value)
            least, bits = 0 if part == BLOCKS else LEAST_ROWS, precision if part in FOUR_BITS else INT8
            model, own = quantize_model(models[name], weights, least, size, bits, constants)
            if own:
                lowered[name] = model
                new.update(own)
        made |= lowered
        constants |= new
        told = [name for name in pieces if not of_tokens(name)]
        notes += _notes(precision, part, told, {name: lowered[name] for name in told if name in lowered}, new)
    if not made:
        raise LoweringError(
            f"precision {precision!r}: no piece of {' or '.join(parts)} multiplies by a constant float32 matrix"
            f" (in the prologue {LEAST_ROWS} rows or more), so there is nothing to store in {precision}. Convert with"
            " precision 'fp32'."
        )
    return made, constants, tuple(notes)


def _notes(
    precision: str, part: str, pieces: list[str], lowered: Mapping[str, ModelProto], constants: Arrays
) -> Iterator[str]:
    kinds = Counter(node.op_type for model in lowered.values() for node in model.graph.node)
    if lowered:
        where = f"{len(lowered)} of {len(pieces)} blocks" if part == BLOCKS else part
        convolved = f", {kinds[INTEGER_PRODUCT]} of convolutions" if kinds[INTEGER_PRODUCT] else ""
        count = kinds[DYNAMIC_PRODUCT] + kinds[INTEGER_PRODUCT] + kinds[BLOCK_PRODUCT]
        megabytes = sum(value.nbytes for value in constants.values()) / 1e6
        attending = f", and {kinds[HEADS]} attentions" if kinds[HEADS] else ""
        yield f"{precision}: {count} matrices of {where}, {megabytes:.1f} MB{convolved}{attending}"
    for name in pieces:
        if name not in lowered:
            yield f"{name} stays fp32: no product with constant weights" + " and many rows" * (part != BLOCKS)
    if whole := kinds["Conv"] + kinds["ConvTranspose"]:
        yield f"convolutions that stay fp32 in {part}, of few channels, in groups, or transposed: {whole}"


def require_precision(precision: str, keep_fp32: Collection[str] = ()) -> None:
    """Raise LoweringError unless weights can be lowered to this precision, and it may have parts that stay fp32."""
    if precision not in PRECISIONS:
        raise LoweringError(f"precision {precision!r}: expected one of {', '.join(map(repr, PRECISIONS))}.")
    if isinstance(keep_fp32, str) or not all(isinstance(part, str) for part in keep_fp32):
        raise LoweringError(f"keep_fp32: expected names of parts, ('prologue',) say; found {keep_fp32!r}.")
    if keep_fp32 and precision == FP32:
        given = ", ".join(map(repr, keep_fp32))
        raise LoweringError(f"{given} stays fp32, as does everything in precision 'fp32'. Give precision 'int8' too.")


def quantize_model(
    model: ModelProto,
    weights: Arrays,
    least_rows: int = 0,
    size: int = 1,
    precision: str = INT8,
    there: Collection[str] = (),
) -> tuple[ModelProto, dict[str, Array]]:
    """One model with its products by constants in integers; inputs and outputs stay as they are.

    Args:
        model: from ``lower``: constants are initializers without data.
        weights: values of constants, by name. Only these are quantised.
        least_rows: that a product has to have; a product whose rows are not known has none.
        size: what B is taken to be where rows are counted: one stream, or in a form for some tokens all of them.
        precision: of matrices; convolutions and tables are in int8 in any.
        there: constants that other models have; a product by these may have fewer rows.

    Returns:
        A new model, and the constants that it has and ``model`` has not, by name: int8 ``[rows, columns]`` and
        float32 ``[columns]``; of a table int8 and float32 ``[rows, 1]``; in four bits what ``four_bits.pack`` gives. No
        constants if there was nothing to replace.
    """
    known = {t.name: np.asarray(weights[t.name]) for t in model.graph.initializer if t.name in weights}
    matrices, shapes = _matrices(model, known), shapes_of(model, size)
    constants: dict[str, Array] = {}
    w, store = GraphWriter(), partial(_integers, constants)

    def enough(constant: str, rows: int) -> bool:
        return rows >= least_rows or f"{constant}.{precision}" in there

    for node in model.graph.node:
        attributes = _attributes(node)
        if not (
            _integer_product(w, node, known, matrices, shapes, enough, store, precision)
            or _integer_rows(w, node, attributes, known, store)
            or integer_convolution(w, node, attributes, known, shapes, store)
            or integer_attention(w, node, attributes, shapes, size > 1)
        ):
            w.nodes.append(node)
    nodes = live_nodes(w.nodes, {value.name for value in model.graph.output})
    if not constants:
        return replaced(model), {}
    read = {name for node in nodes for name in node.input} | {value.name for value in model.graph.output}
    kept = [tensor for tensor in model.graph.initializer if tensor.name in read]
    types = {name: helper.np_dtype_to_tensor_dtype(value.dtype) for name, value in constants.items()}
    added = [TensorProto(name=n, dims=value.shape, data_type=types[n]) for n, value in constants.items()]
    quantized = replaced(model, node=nodes, initializer=[*added, *kept, *w.initializers])
    quantized.opset_import.append(helper.make_opsetid(DOMAIN, _DOMAIN_VERSION))
    return quantized, constants


def quantize_matrix(matrix: Array) -> tuple[npt.NDArray[np.int8], npt.NDArray[np.float32]]:
    """A matrix as int8 ``[rows, columns]`` in -127..127 and float32 ``[columns]``; off by half a scale at most."""
    integers, scale = np.empty_like(matrix, np.int8), np.empty(matrix.shape[1], np.float32)
    for columns in columns_at_once(matrix):
        part = matrix[:, columns]
        largest = np.abs(part).max(axis=0)
        scale[columns] = np.where(largest < LARGEST * np.finfo(np.float32).tiny, 1.0, largest / LARGEST)
        integers[:, columns] = np.clip(np.rint(part / scale[columns]), -LARGEST, LARGEST)
    return integers, scale


def _matrices(model: ModelProto, known: Arrays) -> Matrices:
    """The constants by the names of their values, and what transpositions and reshapes make of them."""
    shapes = {t.name: numpy_helper.to_array(t) for t in model.graph.initializer if t.raw_data or t.int64_data}
    found = {name: (name, value) for name, value in known.items() if value.dtype == np.float32}
    for node in model.graph.node:
        before = found.get(node.input[0]) if node.input else None
        if before is None:
            continue
        constant, value = before
        if node.op_type == "Transpose":
            found[node.output[0]] = constant, value.transpose(_attributes(node).get("perm"))
        elif node.op_type == "Reshape" and node.input[1] in shapes:
            found[node.output[0]] = constant, value.reshape(shapes[node.input[1]])
    return found


def _integer_product(
    w: GraphWriter,
    node: NodeProto,
    known: Arrays,
    matrices: Matrices,
    shapes: Mapping[str, Sequence[int]],
    enough: Callable[[str, int], bool],
    store: Callable[..., tuple[str, str]],
    precision: str,
) -> bool:
    """Write a product by a constant matrix with integers, if it has rows ``enough``; whether it is one."""
    attributes, flip, bias = _attributes(node), False, ""
    if node.op_type == "Gemm":
        if attributes.get("transA", 0) or attributes.get("alpha", 1.0) != 1 or attributes.get("beta", 1.0) != 1:
            return False
        flip, bias = bool(attributes.get("transB", 0)), node.input[2] if len(node.input) > 2 else ""
    if node.op_type not in ("Gemm", "MatMul") or node.input[0] in matrices or node.input[1] not in matrices:
        return False
    x, (constant, value) = node.input[0], matrices[node.input[1]]
    value = value.T if flip else value
    if value.ndim != 2 or not 0 < len(value) <= MOST_ROWS:
        return False
    if bias and (bias not in known or known[bias].shape != value.shape[1:]):
        return False
    shape = shapes.get(x, ())
    if not enough(constant, math.prod(shape[:-1]) if shape else 0):
        return False
    if precision == INT4 and known[constant].ndim == 2:
        inputs = [x, *store(constant, value, INT4), *(["", "", bias] if bias else [])]
        sizes = dict(zip("KN", value.shape, strict=True))
        w.ops(BLOCK_PRODUCT, inputs, node.output, domain=DOMAIN, **sizes, **ATTRIBUTES)
        return True
    w.ops(DYNAMIC_PRODUCT, [x, *store(constant, value), NO_ZERO, *([bias] if bias else [])], node.output, domain=DOMAIN)
    return True


def _integer_rows(
    w: GraphWriter, node: NodeProto, attributes: Mapping[str, Any], known: Arrays, store: Callable[..., tuple[str, str]]
) -> bool:
    """Write the rows that are read of a large constant table, an embedding, with integers; whether it is one."""
    table = known.get(node.input[0]) if node.op_type == "Gather" else None
    if table is None or table.dtype != np.float32 or table.ndim != 2 or table.size < LEAST_TABLE:
        return False
    if attributes.get("axis", 0):
        return False
    rows, scales = (w.op("Gather", name, node.input[1]) for name in store(node.input[0], table.T, by_row=True))
    w.ops("Mul", [w.op("Cast", rows, to=TensorProto.FLOAT), scales], node.output)
    return True


def _integers(
    constants: dict[str, Array], constant: str, matrix: Array, precision: str = INT8, by_row: bool = False
) -> tuple[str, str]:
    """Names of the integers and the scales of a matrix, which go into ``constants``; ``by_row``: turned, as of a table.

    No two products share them: onnxruntime 1.31 cannot load such a model where it has to make the integers unsigned
    ("Attempt to replace the existing tensor"), which is on processors whose sums saturate.
    """
    name = f"{constant}.{precision}"
    while name in constants:
        name += "_"
    values, scales = quantize_matrix(matrix) if precision == INT8 else pack(matrix)
    if by_row:
        values, scales = values.T, scales[:, None]
    constants[name], constants[f"{name}.scale"] = np.ascontiguousarray(values), scales
    return name, f"{name}.scale"


def _attributes(node: NodeProto) -> dict[str, Any]:
    attributes = {}
    for attribute in node.attribute:
        value = helper.get_attribute_value(attribute)
        attributes[attribute.name] = list(value) if attribute.type == AttributeProto.INTS else value
    return attributes
