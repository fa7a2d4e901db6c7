"""What every ATen operation is: the one table that passes, analyses and evaluation ask.

A row stands for all overloads of an operation, ``add`` for ``aten.add.Tensor`` and ``aten.add.Scalar``; where one
overload is something else than the others it has a row of its own, ``max.other``. An operation without a row is
refused at capture, and when an artifact is loaded (``ir.evaluate.resolve_op``).

To add an operation, add its name to the group below that says what it is, or a row with its facts, and an example to
``tests/ir/operation_examples.py``, which the tests evaluate, compare with torch's meta tensors, and lower. There is no
more to do: operations are evaluated by torch under their own names, and lowered by torch's ONNX exporter.
"""

import enum
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TypeAlias

from ..errors import CaptureError
from .graph import GETITEM, Argument, Batch, Node, Ref, Size, TensorType

Types: TypeAlias = Mapping[str, TensorType]


class Movement(enum.Enum):
    """How an operation rearranges the numbers of its first argument, without computing any."""

    RESHAPE = "the same numbers in the same order, with other sizes"
    PERMUTE = "the same axes in another order"
    PART = "some of the numbers"
    REPEAT = "the numbers several times"


class Linear(enum.Enum):
    """Of which arguments the result is a linear (or affine) function."""

    IN_FIRST = "of the first, where no other moves"
    IN_EACH = "of every one, where no other moves"
    JOINTLY = "of all together"


@dataclass(frozen=True)
class Operation:
    """What is known of an operation; a fact that is not given is not known, and nothing is done that needs it.

    Attributes:
        name: without ``aten.``, and without the overload if the row is for all of them.
        movement: set if it moves numbers and computes none.
        elementwise: each number of the result depends on the numbers of its place alone, after broadcasting.
        along: the place among its arguments of the axis, or axes, that it works along; slices across them are treated
            alike and each for itself.
        mixes: the number of last axes of its first argument that it mixes; what lies before them are rows, which are
            treated alike and each for itself. None where that does not hold for this node.
        filled: the one value of every number of the result, whatever the first argument holds.
        dropout: the place and the name of the argument that makes it draw random numbers.
        flops: FLOPs of a node for one stream; None counts as none.
    """

    name: str = ""
    movement: Movement | None = None
    elementwise: bool = False
    linear: Linear | None = None
    along: int | None = None
    mixes: Callable[[Node, Types], int | None] | None = None
    filled: Callable[[Node], Argument] | None = None
    dropout: tuple[int, str] | None = None
    flops: Callable[[Node, Types], int] | None = None


def find_operation(op: str) -> Operation | None:
    """The row of ``aten.NAME.OVERLOAD``, or None."""
    name = op.removeprefix("aten.")
    return OPERATIONS.get(name) or OPERATIONS.get(name.partition(".")[0])


def operation(op: str, where: str = "a graph") -> Operation:
    """The row of ``aten.NAME.OVERLOAD``. Raises CaptureError: there is none; says ``where``."""
    row = find_operation(op)
    if row is None:
        what = f"operation {op!r} of {where} has no row in the table of operations, so nothing is known of it. Write it"
        weights = "where it makes a weight, call torch.nn.utils.parametrize.remove_parametrizations first"
        raise CaptureError(f"{what} with other operations, or add it to ttscompile/ir/operations.py; {weights}.")
    return row


def axes_along(node: Node, rank: int) -> frozenset[int]:
    """The axes that a node works along, of the ``rank`` axes of its first argument; none if that is not known."""
    row = operation(node.op)
    if row.along is None:
        return frozenset()
    missing = 0 if row.movement is Movement.PART else ()
    axes = node.argument(row.along, dict(node.kwargs).get("dim", missing))
    several = axes if isinstance(axes, tuple) else (axes,)
    return frozenset(a % max(rank, 1) for a in several if isinstance(a, int)) or frozenset(range(rank))


def axis_after(node: Node, axis: int, types: Types) -> int | None:
    """Where an axis of its first argument is in the result of a node; None if it is mixed or cut, or nobody knows.

    What lies along the axis is treated alike and each for itself, if no other argument differs along it.
    """
    row, before, after = operation(node.op), types[next(node.refs())].shape, node.type.shape
    if row.movement is Movement.RESHAPE:
        # It survives if the sizes before it, and itself, have the same product.
        same = (a for a, n in enumerate(after) if n == before[axis] and _factors(after[:a]) == _factors(before[:axis]))
        return next(same, None)
    if row.movement is Movement.PERMUTE:
        return permutation(node, len(before)).index(axis)
    if row.mixes is not None:
        mixed = row.mixes(node, types)
        return None if mixed is None or axis >= len(before) - mixed else axis
    if row.along is not None and axis not in (along := axes_along(node, len(before))):
        # Select and mean may take away the axes that they work along.
        return axis - (len(after) < len(before) and sum(a < axis for a in along))
    return axis if node.op == GETITEM else None


def joined_axis(cat: Node) -> int:
    """The axis along which a concatenation joins its parts."""
    axis = cat.argument(1, 0)
    assert isinstance(axis, int)
    return axis % len(cat.type.shape)


def _factors(shape: Sequence[Size]) -> tuple[int, int]:
    """Numbers and batches in a product of sizes."""
    numbers = math.prod(n.multiple if isinstance(n, Batch) else n for n in shape)
    return numbers, sum(isinstance(n, Batch) for n in shape)


def permutation(node: Node, rank: int) -> list[int]:
    """For each axis of what a node with ``Movement.PERMUTE`` gives, its place among the ``rank`` axes before."""
    order = list(range(rank))
    match node.args[1:]:
        case (tuple(axes),):
            return [a % rank for a in axes if isinstance(a, int)]
        case (int(a), int(b)):
            order[a % rank], order[b % rank] = order[b % rank], order[a % rank]
            return order
    return order[::-1]


def _shape(types: Types, argument: Argument) -> tuple[int, ...]:
    assert isinstance(argument, Ref)
    return types[argument.name].at(1)


def _product(left: int) -> Callable[[Node, Types], int]:
    """Each number of the result is a sum over the last axis of the factor in this place."""
    return lambda node, types: 2 * math.prod(node.type.at(1)) * _shape(types, node.args[left])[-1]


def _tensordot(node: Node, types: Types) -> int:
    axes, shape = node.args[2], _shape(types, node.args[0])
    assert isinstance(axes, tuple)
    return 2 * math.prod(node.type.at(1)) * math.prod(shape[a] for a in axes if isinstance(a, int))


def _attention(node: Node, types: Types) -> int:
    query, key, value = (_shape(types, a) for a in node.args[:3])
    return 2 * math.prod(query[:-1]) * key[-2] * (query[-1] + value[-1])


def _gathering(place: int) -> Callable[[Node, Types], int]:
    """Each number of the result gathers a receptive field, or all pairs of both inputs: as much as its weights have."""
    return lambda node, types: 2 * math.prod(node.type.at(1)) * math.prod(_shape(types, node.args[place])[1:])


def _spreading(node: Node, types: Types) -> int:
    """A transposed convolution: each number of the input is spread over one receptive field."""
    return 2 * math.prod(_shape(types, node.args[0])) * math.prod(_shape(types, node.args[1])[1:])


def _einsum(node: Node, types: Types) -> int:
    """The product of all sizes; axes under an ellipsis are called by their place from the right."""
    equation, operands = node.args[:2]
    assert isinstance(equation, str)
    assert isinstance(operands, tuple)
    sizes: dict[str | int, int] = {}
    for term, operand in zip(equation.replace(" ", "").split("->")[0].split(","), operands, strict=True):
        left, _, right = term.partition("...")
        shape = _shape(types, operand)
        names = (*left, *range(len(shape) - len(left) - len(right), 0, -1), *right)
        for name, size in zip(names, shape, strict=True):
            sizes[name] = max(size, sizes.get(name, 1))
    return 2 * math.prod(sizes.values())


def _recurrent(node: Node, types: Types) -> int:
    """Every matrix of every layer meets each frame."""
    parameters = node.args[2]
    assert isinstance(parameters, tuple)
    sizes = [math.prod(shape) for shape in (_shape(types, p) for p in parameters) if len(shape) == 2]
    return 2 * math.prod(_shape(types, node.args[0])[:-1]) * sum(sizes)


def _last_axis_by_matrix(node: Node, types: Types) -> int | None:
    """A product with one matrix for all rows; a batched right side may belong to the rows, as in attention."""
    return 1 if len(_shape(types, node.args[1])) == 2 else None


def _normalized(node: Node, types: Types) -> int | None:
    return len(node.args[1]) if isinstance(node.args[1], tuple) else None


def _value(place: int) -> Callable[[Node], Argument]:
    return lambda node: node.args[place]


_LINEAR_IN_FIRST = Operation(linear=Linear.IN_FIRST)
_RESHAPES = Operation(movement=Movement.RESHAPE, linear=Linear.IN_FIRST)
_PERMUTES = Operation(movement=Movement.PERMUTE, linear=Linear.IN_FIRST)
_PARTS = Operation(movement=Movement.PART, linear=Linear.IN_FIRST)
_REPEATS = Operation(movement=Movement.REPEAT, linear=Linear.IN_FIRST)
_ELEMENTWISE = Operation(elementwise=True)
_PRODUCT = Operation(linear=Linear.IN_EACH, flops=_product(0))
_OF_SUM = Operation(linear=Linear.IN_EACH, flops=_product(1))
_NORM = Operation(mixes=_normalized)
_CONVOLUTION = Operation(flops=_gathering(1))
_RECURRENT = Operation(dropout=(6, "train"), flops=_recurrent)

_GROUPS: tuple[tuple[str, Operation], ...] = (
    # Data movement.
    ("reshape unsqueeze squeeze clone alias detach", _RESHAPES),
    ("permute transpose t", _PERMUTES),
    ("slice select unbind", replace(_PARTS, along=1)),
    ("split split_with_sizes", replace(_PARTS, along=2)),
    ("diagonal", _PARTS),
    ("expand repeat tile repeat_interleave", _REPEATS),
    ("pad constant_pad_nd", _LINEAR_IN_FIRST),
    ("flip", replace(_LINEAR_IN_FIRST, along=1)),
    ("roll", replace(_LINEAR_IN_FIRST, along=2)),
    # Element-wise arithmetic.
    ("add sub subtract rsub", replace(_ELEMENTWISE, linear=Linear.JOINTLY)),
    ("mul multiply", replace(_ELEMENTWISE, linear=Linear.IN_EACH)),
    ("div divide true_divide neg negative", replace(_ELEMENTWISE, linear=Linear.IN_FIRST)),
    ("div.Tensor_mode divide.Tensor_mode floor_divide", _ELEMENTWISE),
    ("gelu relu relu6 silu mish tanh sigmoid softplus elu celu selu leaky_relu log_sigmoid threshold", _ELEMENTWISE),
    ("hardswish hardtanh hardsigmoid erf erfc special_erf special_erfc special_expit sinc logit", _ELEMENTWISE),
    ("exp exp2 expm1 log log2 log10 log1p sqrt rsqrt square reciprocal special_expm1 special_log1p", _ELEMENTWISE),
    ("sin cos tan sinh cosh asin acos atan asinh acosh atanh arcsin arccos arctan deg2rad rad2deg", _ELEMENTWISE),
    ("abs absolute sign sgn ceil floor round trunc fix frac nan_to_num _to_copy", _ELEMENTWISE),
    ("lgamma digamma erfinv i0 special_i0", _ELEMENTWISE),
    ("pow float_power remainder fmod atan2 arctan2 hypot copysign heaviside xlogy logaddexp logaddexp2", _ELEMENTWISE),
    ("maximum minimum max.other min.other fmax fmin clamp clip clamp_min clamp_max", _ELEMENTWISE),
    ("where masked_fill lerp addcmul addcdiv", _ELEMENTWISE),
    ("eq ne lt le gt ge not_equal less less_equal greater greater_equal isclose isnan isinf isfinite", _ELEMENTWISE),
    ("logical_and logical_or logical_xor logical_not __and__ __or__ __xor__", _ELEMENTWISE),
    ("bitwise_and bitwise_or bitwise_xor bitwise_not bitwise_left_shift bitwise_right_shift", _ELEMENTWISE),
    # Products, normalisation, attention.
    ("linear", Operation(linear=Linear.IN_FIRST, flops=_product(0), mixes=lambda node, types: 1)),
    ("matmul", replace(_PRODUCT, mixes=_last_axis_by_matrix)),
    ("mm bmm mv dot inner", _PRODUCT),
    ("addmm baddbmm addmv", _OF_SUM),
    ("einsum", replace(_PRODUCT, flops=_einsum)),
    ("tensordot", replace(_PRODUCT, flops=_tensordot)),
    ("bilinear", Operation(flops=_gathering(2))),
    ("outer ger kron", Operation(linear=Linear.IN_EACH)),
    ("conv1d conv2d conv3d", _CONVOLUTION),
    ("conv_transpose1d conv_transpose2d conv_transpose3d", replace(_CONVOLUTION, flops=_spreading)),
    ("layer_norm rms_norm", _NORM),
    ("scaled_dot_product_attention", Operation(dropout=(4, "dropout_p"), flops=_attention)),
    ("softmax log_softmax cumsum cumprod", Operation(along=1)),
    ("gru.input lstm.input", _RECURRENT),
    # Values that read no number, and what only gives its shape and type.
    ("zeros zeros_like new_zeros zero", Operation(filled=lambda node: 0)),
    ("ones ones_like new_ones", Operation(filled=lambda node: 1)),
    ("full full_like fill", Operation(filled=_value(1))),
    ("new_full", Operation(filled=_value(2))),
    # Nothing that a pass asks about.
    (f"{GETITEM} cat concat stack tril triu", Operation()),
    ("arange linspace logspace eye empty empty_like new_empty scalar_tensor type_as copy meshgrid", Operation()),
    ("sum mean amax amin", Operation(along=1)),
    ("prod max min argmax argmin any all std var std_mean var_mean logsumexp", Operation()),
    ("norm linalg_vector_norm linalg_norm sort argsort topk diff trapezoid", Operation()),
    ("index index_select gather take_along_dim embedding one_hot isin bucketize searchsorted", Operation()),
    ("index_put index_add index_copy index_fill scatter scatter_add select_scatter slice_scatter", Operation()),
    ("group_norm instance_norm _native_batch_norm_legit_no_training cosine_similarity pairwise_distance", Operation()),
    ("avg_pool1d avg_pool2d max_pool1d max_pool2d adaptive_avg_pool1d adaptive_avg_pool2d", Operation()),
    ("upsample_nearest1d upsample_nearest2d upsample_linear1d upsample_bilinear2d upsample_bicubic2d", Operation()),
    ("pixel_shuffle pixel_unshuffle im2col unfold grid_sampler glu prelu cross linalg_cross", Operation()),
    ("broadcast_tensors block_diag diag_embed rot90 cdist _weight_norm linalg_det", Operation()),
    ("cummax cummin median nanmedian quantile kthvalue count_nonzero nansum nanmean", Operation()),
    ("linalg_eigh linalg_inv linalg_solve linalg_qr linalg_cholesky matrix_exp", Operation()),
)

OPERATIONS: Mapping[str, Operation] = {
    name: replace(row, name=name) for names, row in _GROUPS for name in names.split()
}
"""By ``Operation.name``."""
