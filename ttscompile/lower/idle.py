"""The ONNX model of what a step without a computed block comes to where stem and tail are simple.

Such an *idle* step adds a known sum of residuals to the stream, so that sample and prediction are bound by::

    stream     = stem(sample) + total          affine in the sample, each token for itself
    prediction = head(normalise(stream))       a LayerNorm, then affine, each token for itself

The stream of a token has W numbers, but moves in as many directions as a sample has dimensions, D. With an orthonormal
basis E of these directions, u what the total and the stem's constants say of the token, centred, and x its sample::

    y          = [x R + u E, rest] / sqrt(W)   rest^2 = |u - (u E) E'|^2 + W eps; its squares add up to the variance
    prediction = (x A H + u H) / |y| + h

All but x is known as soon as the total is, which many steps in a row share. So a step is arithmetic on numbers of the
size of the sample, in place of tensors of T x W and of seventeen operations of a session.

Where the tail is affine itself, y is [0, 1] and the rest of the above: prediction = x A H + u H + h. With one block for
the whole network (``passes.one_block``) A H is zero, and the prediction is the total's.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
import torch
from onnx import ModelProto, helper

from ..ir.evaluate import evaluate
from ..ir.graph import Argument, Batch, Graph, Node, Ref, TensorType
from ..ir.operations import Linear, operation
from ..ir.pieces import BASE, IDLE, PRODUCT, SHIFT, TOTAL
from ..ir.program import Pieces
from .graph_writer import GraphWriter, tensor
from .onnx_model import own_model

Wide = npt.NDArray[np.float64]
Weights = Mapping[str, npt.NDArray[np.generic]]

_NORM = "aten.layer_norm.default"


class _Declined(Exception):
    """Why stem or tail do not have the form."""


@dataclass(frozen=True)
class _Affine:
    """``y[t] = x[t] @ matrix + constant[t]``."""

    matrix: Wide  # [n, m]
    constant: Wide  # [T, m]


def lower_idle(pieces: Pieces, weights: Weights, opset: int) -> tuple[ModelProto | None, str]:
    """The model of a program with these pieces and values of constants, or None and why there is none."""
    try:
        return _lower(pieces, weights, opset), ""
    except _Declined as reason:
        return None, str(reason)


def _lower(pieces: Pieces, weights: Weights, opset: int) -> ModelProto:
    if pieces.stem.contexts or pieces.tail.contexts:
        raise _Declined("stem or tail read values of the observation or the step")
    sample, kind = pieces.stem.type, pieces.tail.type
    tokens = sample.shape[1] if len(sample.shape) == 3 else None
    if kind.shape[:2] not in ((Batch(), tokens), (tokens, Batch())) or len(kind.shape) != 3:
        raise _Declined(f"the residual stream is {kind}, and the sample {sample}: not one vector for each token")
    turned = kind.shape[0] != Batch()  # tokens first
    stem = _affine(_wide(pieces.stem.graph), weights, turned_out=turned)
    tail, stream = pieces.tail.graph, pieces.tail.stream
    if all(node.op != _NORM for node in tail.nodes):
        return _write_affine(kind, turned, stem, _affine(_wide(tail), weights, turned_in=turned), opset)
    norm, rest = _split_at_norm(tail, stream)
    head = _affine(_wide(rest), weights, turned_in=turned)
    dimensions, width = stem.matrix.shape
    if dimensions >= width:
        raise _Declined(f"the sample has {dimensions} dimensions, and the stream no more than {width}")
    scale, shift, eps = _norm_arguments(norm, weights, width)
    head = _Affine(scale[:, None] * head.matrix, head.constant + shift @ head.matrix)
    return _write(kind, turned, stem, head, eps, opset)


def _write(kind: TensorType, turned: bool, stem: _Affine, head: _Affine, eps: float, opset: int) -> ModelProto:
    dimensions, width = stem.matrix.shape
    centred = stem.matrix - stem.matrix.mean(axis=1, keepdims=True)
    basis, triangle = np.linalg.qr(centred.T)
    root = np.sqrt(width)
    w = GraphWriter()
    total = w.op("Transpose", TOTAL, perm=[1, 0, 2]) if turned else TOTAL
    offset = w.op("Add", total, w.constant(stem.constant[None], np.float32))
    last = w.constant([-1])
    u = w.op("Sub", offset, w.op("ReduceMean", offset, last))
    projected = w.op("MatMul", u, w.constant(basis, np.float32))
    across = w.op("Sub", u, w.op("MatMul", projected, w.constant(basis.T, np.float32)))
    variance = w.op("Div", w.op("ReduceSumSquare", across, last), w.constant(width, np.float32))
    deviation = w.op("Sqrt", w.op("Add", variance, w.constant(eps, np.float32)))
    along = w.op("Div", projected, w.constant(root, np.float32))
    numerator = w.op("MatMul", u, w.constant(head.matrix, np.float32))
    rows = w.op("Concat", along, deviation, numerator, axis=2)
    product = np.concatenate([triangle / root, np.zeros((1, dimensions)), (centred @ head.matrix).T])
    return _finish(w, kind, rows, product, head, opset)


def _write_affine(kind: TensorType, turned: bool, stem: _Affine, head: _Affine, opset: int) -> ModelProto:
    dimensions = len(stem.matrix)
    w = GraphWriter()
    total = w.op("Transpose", TOTAL, perm=[1, 0, 2]) if turned else TOTAL
    offset = w.op("Add", total, w.constant(stem.constant[None], np.float32))
    numerator = w.op("MatMul", offset, w.constant(head.matrix, np.float32))
    blank = w.op("Mul", w.op("Slice", offset, *map(w.constant, ([0], [1], [2]))), w.constant(0.0, np.float32))
    rows = w.op("Concat", *dimensions * [blank], w.op("Add", blank, w.constant(1.0, np.float32)), numerator, axis=2)
    product = np.concatenate([np.zeros((dimensions + 1, dimensions)), (stem.matrix @ head.matrix).T])
    return _finish(w, kind, rows, product, head, opset)


def _finish(w: GraphWriter, kind: TensorType, rows: str, product: Wide, head: _Affine, opset: int) -> ModelProto:
    tokens, dimensions = head.constant.shape
    w.rename(w.op("Transpose", rows, perm=[2, 0, 1]), BASE)
    w.rename(w.constant(product, np.float32), PRODUCT)
    w.rename(w.constant(head.constant.T[:, None], np.float32), SHIFT)
    shapes = {BASE: [len(product), "B", tokens], PRODUCT: product.shape, SHIFT: [dimensions, 1, tokens]}
    outputs = [tensor(name, np.float32, shape) for name, shape in shapes.items()]
    given = tensor(TOTAL, np.float32, [n if isinstance(n, int) else str(n) for n in kind.shape])
    return own_model(w.graph(IDLE, outputs, [given]), [helper.make_opsetid("", opset)])


def _affine(graph: Graph, weights: Weights, turned_in: bool = False, turned_out: bool = False) -> _Affine:
    """What an affine graph in float64 does to every token of its one input; what is turned has its tokens first.

    Its operations say that it is affine; that all tokens meet the same matrix, and no token another, is tried on random
    numbers, of which an affine map that is another one agrees with none.
    """
    _require_affine(graph)
    ((name, kind),) = graph.inputs.items()
    if missing := sorted(set(graph.constants) - set(weights)):
        raise _Declined(f"the constants {missing} have no values")
    values = {n: torch.from_numpy(np.asarray(weights[n], np.float64)) for n in graph.constants}

    def call(x: torch.Tensor) -> torch.Tensor:
        y = evaluate(graph, values, {name: x.transpose(0, 1) if turned_in else x})[0]
        return y.transpose(0, 1) if turned_out else y

    one = kind.at(1)
    tokens, inner = (one[0] if turned_in else one[1]), one[2]
    zeros = torch.zeros((1, tokens, inner), dtype=torch.float64, requires_grad=True)
    constant = call(zeros)
    if constant.ndim != 3 or constant.shape[:2] != (1, tokens):
        raise _Declined(f"{graph.outputs[0]} is {list(constant.shape)}, not one vector for each of {tokens} tokens")
    if inner <= constant.shape[2]:
        inputs = torch.eye(inner, dtype=torch.float64)[:, None].expand(inner, tokens, inner)
        matrix = (call(inputs) - constant)[:, 0]
    else:
        outputs = constant[0, 0]
        columns = [torch.autograd.grad(each, zeros, retain_graph=True)[0][0, 0] for each in outputs]
        matrix = torch.stack(columns, dim=1)
    trial = torch.randn((2, tokens, inner), dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    if not torch.allclose(call(trial), trial @ matrix + constant, rtol=1e-9, atol=1e-9):
        raise _Declined(f"{graph.outputs[0]} does not treat every token of {name} alike and for itself")
    return _Affine(matrix.detach().numpy(), constant.detach().numpy()[0])


def _require_affine(graph: Graph) -> None:
    moving = set(graph.inputs)
    for node in graph.nodes:
        moved = [name for name in node.refs() if name in moving]
        if not moved:
            continue
        linear = operation(node.op).linear
        of_first = linear is Linear.IN_FIRST and node.args[0] == Ref(moved[0])
        if linear is not Linear.JOINTLY and (len(moved) > 1 or not (of_first or linear is Linear.IN_EACH)):
            raise _Declined(f"{node} is not known to be affine")
        moving.add(node.name)
    if graph.outputs[0] not in moving:
        raise _Declined(f"{graph.outputs[0]} does not depend on {next(iter(graph.inputs))}")


def _split_at_norm(tail: Graph, stream: str) -> tuple[Node, Graph]:
    """The LayerNorm that the stream enters first, and the tail after it."""
    users = tail.users()[stream]
    if len(users) != 1 or users[0].op != _NORM or users[0].args[0] != Ref(stream):
        raise _Declined(f"the tail does not begin with a LayerNorm of its input, but with {users[0]}")
    norm = users[0]
    rest = tuple(node for node in tail.nodes if node is not norm)
    read = {ref for node in rest for ref in node.refs()}
    constants = {name: type_ for name, type_ in tail.constants.items() if name in read}
    return norm, replace(tail, inputs={norm.name: norm.type}, constants=constants, nodes=rest)


def _norm_arguments(norm: Node, weights: Weights, width: int) -> tuple[Wide, Wide, float]:
    """Scale ``[W]``, shift ``[W]`` and epsilon."""
    shape, scale, shift, eps = (*norm.args[1:5], *(None, None, 1e-5)[len(norm.args) - 2 :])[:4]
    if shape != (width,) or norm.kwargs or not isinstance(eps, float):
        raise _Declined(f"{norm} is not over the {width} numbers of a token")

    def value(argument: Argument, without: float) -> Wide:
        if isinstance(argument, Ref) and argument.name in weights:
            return np.asarray(weights[argument.name], np.float64)
        if argument is None:
            return np.full(width, without)
        raise _Declined(f"{norm} takes what is no constant")

    return value(scale, 1.0), value(shift, 0.0), eps


def _wide(graph: Graph) -> Graph:
    """The graph in float64."""

    def wide(type_: TensorType) -> TensorType:
        return replace(type_, dtype="float64") if type_.dtype == "float32" else type_

    inputs, constants = ({n: wide(t) for n, t in types.items()} for types in (graph.inputs, graph.constants))
    nodes = tuple(replace(node, types=tuple(map(wide, node.types))) for node in graph.nodes)
    return replace(graph, inputs=inputs, constants=constants, nodes=nodes)
