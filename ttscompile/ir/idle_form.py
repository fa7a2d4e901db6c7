"""What a step without a computed block comes to where stem and tail are simple.

Such an *idle* step adds a known sum of residuals to the residual stream, so that sample and prediction are bound by::

    stream     = stem(sample) + total          affine in the sample, each token for itself
    prediction = head(normalise(stream))       a LayerNorm, then affine, each token for itself

A token of the residual stream has W numbers, but moves in as many directions as a sample has dimensions, D. With an
orthonormal basis E of these directions, u what the total and the stem's constants say of the token, centred, and x its
sample::

    y          = [x R + u E, rest] / sqrt(W)   rest^2 = |u - (u E) E'|^2 + W eps; its squares add up to the variance
    prediction = (x A H + u H) / |y| + h

All but x is known as soon as the total is, which many steps in a row share. So a step is arithmetic on numbers of the
size of the sample, in place of tensors of T x W and of seventeen operations of a session.

Where the tail is affine itself, y is [0, 1] and the rest of the above: prediction = x A H + u H + h. With one block for
the whole network (``passes.one_block``) A H is zero, and the prediction is the total's.
"""

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
import torch

from ..core.coercion import Arrays
from .evaluate import evaluate
from .graph import Batch, Graph, Node, Ref, TensorType, backward_slice
from .operations import Linear, operation
from .program import Pieces

Wide = npt.NDArray[np.float64]
_NORM = "aten.layer_norm.default"


@dataclass(frozen=True, eq=False)
class IdleForm:
    """Stem and tail in this form; the sample has D dimensions, the residual stream W, and there are T tokens.

    Attributes:
        type: of the total, which is that of the residual stream.
        turned: whether its tokens come before the streams of the batch.
        constant: ``[T, W]``, what the stem adds to the total.
        basis: ``[W, D]``, E above; None where the tail is affine.
        eps: of the tail's LayerNorm.
        head: ``[W, D]``, H above.
        product: ``[2 D + 1, D]``, what the sample is multiplied with: rows of y, then those of the numerator.
        shift: ``[D, 1, T]``, what is added to the quotient.
    """

    type: TensorType
    turned: bool
    constant: Wide
    basis: Wide | None
    eps: float
    head: Wide
    product: Wide
    shift: Wide


class _Declined(Exception):
    """Why stem or tail do not have the form."""


@dataclass(frozen=True)
class _Affine:
    """``y[t] = x[t] @ matrix + constant[t]``."""

    matrix: Wide  # [n, m]
    constant: Wide  # [T, m]


def idle_form(pieces: Pieces, weights: Arrays) -> tuple[IdleForm | None, str]:
    """The form of a program with these pieces and values of constants, or None and why it has another."""
    try:
        with torch.inference_mode(False), torch.enable_grad():  # whatever the caller's mode
            return _form(pieces, weights), ""
    except _Declined as reason:
        return None, str(reason)


def _form(pieces: Pieces, weights: Arrays) -> IdleForm:
    if pieces.stem.contexts or pieces.tail.contexts:
        raise _Declined("stem or tail read values of the observation or the step")
    sample, kind = pieces.stem.type, pieces.tail.type
    tokens = sample.shape[1] if len(sample.shape) == 3 else None
    if kind.shape[:2] not in ((Batch(), tokens), (tokens, Batch())) or len(kind.shape) != 3:
        raise _Declined(f"the residual stream is {kind}, and the sample {sample}: not one vector for each token")
    turned = kind.shape[0] != Batch()  # tokens first
    stem = _affine(_wide(pieces.stem.graph), weights, turned_out=turned)
    dimensions, width = stem.matrix.shape
    tail, stream = pieces.tail.graph, pieces.tail.stream
    if all(node.op != _NORM for node in tail.nodes):
        head = _affine(_wide(tail), weights, turned_in=turned)
        product = np.concatenate([np.zeros((dimensions + 1, dimensions)), (stem.matrix @ head.matrix).T])
        return IdleForm(kind, turned, stem.constant, None, 0.0, head.matrix, product, head.constant.T[:, None])
    norm, rest = _split_at_norm(tail, stream)
    head = _affine(_wide(rest), weights, turned_in=turned)
    if dimensions >= width:
        raise _Declined(f"the sample has {dimensions} dimensions, and the residual stream no more than {width}")
    scale, shift, eps = _norm_arguments(norm, weights, width)
    head = _Affine(scale[:, None] * head.matrix, head.constant + shift @ head.matrix)
    centred = stem.matrix - stem.matrix.mean(axis=1, keepdims=True)
    basis, triangle = np.linalg.qr(centred.T)
    product = np.concatenate([triangle / np.sqrt(width), np.zeros((1, dimensions)), (centred @ head.matrix).T])
    return IdleForm(kind, turned, stem.constant, basis, eps, head.matrix, product, head.constant.T[:, None])


def _affine(graph: Graph, weights: Arrays, turned_in: bool = False, turned_out: bool = False) -> _Affine:
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
    users = tail.users()[stream]
    if len(users) != 1 or users[0].op != _NORM or users[0].args[0] != Ref(stream):
        raise _Declined(f"the tail does not begin with a LayerNorm of its input, but with {users[0]}")
    (norm,) = users
    return norm, backward_slice(tail, tail.outputs, {norm.name: norm.type})


def _norm_arguments(norm: Node, weights: Arrays, width: int) -> tuple[Wide, Wide, float]:
    """Scale ``[W]``, shift ``[W]`` and epsilon."""
    eps = norm.argument(4, 1e-5)
    if norm.argument(1) != (width,) or norm.kwargs or not isinstance(eps, float):
        raise _Declined(f"{norm} is not over the {width} numbers of a token")

    def value(position: int, without: float) -> Wide:
        argument = norm.argument(position)
        if isinstance(argument, Ref) and argument.name in weights:
            return np.asarray(weights[argument.name], np.float64)
        if argument is None:
            return np.full(width, without)
        raise _Declined(f"{norm} takes what is no constant")

    return value(2, 1.0), value(3, 0.0), eps


def _wide(graph: Graph) -> Graph:
    def wide(type_: TensorType) -> TensorType:
        return replace(type_, dtype="float64") if type_.dtype == "float32" else type_

    return graph.mapped(lambda leaf: leaf, wide)
