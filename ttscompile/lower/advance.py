"""One graph for everything between the last block of a step and the first block of the next; and steps without blocks.

    stream --tail--> prediction --sampler, correction--> sample_next --stem--> stream_next

The pieces are small; run one by one they cost more in calls than in arithmetic. Inside, the number of operations
counts: samples are ``[D, B, T]``, so that the update is one product (``core.update``) and nothing is turned.
What is carried from a step to the next comes in pairs ``NAME`` and ``NAME_next``; ``memory`` only where there is one.
Steps without a computed block need a model of the sum that they add alone (``ir.idle_form``).
"""

from dataclasses import replace

import numpy as np
from onnx import ModelProto, helper

from ..core.coercion import Arrays
from ..core.correction import HISTORY, groups_of
from ..core.spec import PolicySpec
from ..core.update import clip_of, columns, rows
from ..errors import LoweringError
from ..ir import pieces as names
from ..ir.graph import Argument, Batch, Graph, Node, Ref, TensorType, copied
from ..ir.idle_form import IdleForm, Wide, idle_form
from ..ir.pieces import BASE, IDLE, PRODUCT, SHIFT, TOTAL
from ..ir.program import Pieces, Program
from .graph_writer import GraphWriter, tensor
from .onnx_model import own_model


def advances(program: Program) -> dict[str, Graph]:
    """``advance`` of the original loop, and ``advance@NAME`` of each further loop whose own is another graph."""
    pieces, spec = program.pieces, program.spec
    own = fuse_advance(pieces.tail, pieces.stem, spec)
    others = {n: fuse_advance(pieces.tail, pieces.stem, spec.in_loop(n)) for n in spec.loops}
    return {names.ADVANCE: own, **{names.of_loop(names.ADVANCE, n): one for n, one in others.items() if one != own}}


def fuse_advance(tail: names.LoopPiece, stem: names.LoopPiece, spec: PolicySpec) -> Graph:
    """Concatenate tail, sampler update and stem.

    The update is that of ``core.update``, with what belongs to the step as inputs. A term of the denoised sample
    whose column of the sampler's table is zero at every step is left out.

    Args:
        tail: residual stream and contexts -> prediction ``[B, T, D]``.
        stem: sample ``[B, T, D]`` and contexts -> residual stream.
        spec: gives the shape of the sample, the clip and the columns.

    Returns:
        A graph with the inputs ``stream``, ``sample`` and ``offset`` ``[D, B, T]``, ``history`` ``[D, B, 4 T]``,
        ``update`` ``[G, R, (1 + S) T]``, ``sample_to_x0`` and ``out_to_x0`` ``[1]``, where the sampler has S > 0
        memories ``memory`` ``[D, B, S T]``, the tail's contexts as ``tail.NAME`` (of this step) and the stem's as
        ``stem.NAME`` (of the next); outputs ``sample_next``, ``stream_next``, ``prediction`` and with memories
        ``memory_next``. Samples and prediction are ``[D, B, T]``.

    Raises:
        LoweringError: a constant of the program has the name of one of these inputs.
    """
    inputs = {names.STREAM: tail.type, **_update_types(spec)}
    for name, piece in ((names.TAIL, tail), (names.STEM, stem)):
        inputs |= {names.advance_context(name, context): type_ for context, type_ in piece.contexts.items()}
    constants = {**tail.graph.constants, **stem.graph.constants}
    results = names.advance_outputs(spec.sampler)
    if clash := sorted(constants.keys() & {*inputs, *results}):
        what = f"the module has weights called {clash}, which are names of the compiled loop's own values"
        raise LoweringError(f"{what}. Rename these parameters or buffers in the module.")
    taken = {*inputs, *constants, *results}
    nodes, prediction = _moved(tail, names.TAIL, names.STREAM, taken)
    turned = inputs[names.SAMPLE]
    nodes.append(Node(names.PREDICTION, "aten.permute.default", (Ref(prediction), (2, 0, 1)), (), (turned,)))
    nodes += _update(taken, turned, spec)
    following = _fresh("stem.sample", taken)
    nodes.append(Node(following, "aten.permute.default", (Ref(names.SAMPLE_NEXT), (1, 2, 0)), (), (stem.type,)))
    more, stream = _moved(stem, names.STEM, following, taken)
    nodes += [*more, copied(names.STREAM_NEXT, stream, stem.graph.types()[stem.result])]
    return Graph(inputs, constants, tuple(nodes), results)


def _update_types(spec: PolicySpec) -> dict[str, TensorType]:
    (horizon, dimensions), sampler = spec.sample, spec.sampler
    sample = TensorType((dimensions, Batch(), horizon), "float32")
    update = (groups_of(sampler.steps, spec.sample), rows(sampler, horizon), columns(sampler, horizon))
    types = {
        names.SAMPLE: sample,
        names.OFFSET: sample,
        names.HISTORY: TensorType((dimensions, Batch(), HISTORY * horizon), "float32"),
        names.UPDATE: TensorType(update, "float32"),
        **dict.fromkeys(names.X0_COLUMNS, TensorType((1,), "float32")),
    }
    if sampler.memories:
        types[names.MEMORY] = TensorType((dimensions, Batch(), sampler.memories * horizon), "float32")
    return types


def _moved(piece: names.LoopPiece, prefix: str, stream: str, taken: set[str]) -> tuple[list[Node], str]:
    """The nodes of a piece under new names, reading ``stream``; and the new name of its result."""
    renamed = {name: name for name in piece.graph.constants} | {piece.stream: stream}
    renamed |= {name: names.advance_context(prefix, name) for name in piece.contexts}
    renamed |= {node.name: _fresh(f"{prefix}.{node.name}", taken) for node in piece.graph.nodes}
    return list(piece.graph.renamed(renamed).nodes), renamed[piece.result]


def _update(taken: set[str], turned: TensorType, spec: PolicySpec) -> list[Node]:
    """``sample_next`` and ``memory_next`` of the inputs and the prediction, which is of the type ``turned``."""
    horizon, sampler = spec.sample[0], spec.sampler
    nodes: list[Node] = []

    def of_size(size: int) -> tuple[TensorType]:
        return (replace(turned, shape=(*turned.shape[:2], size)),)

    def write(name: str, op: str, args: tuple[Argument, ...], size: int = horizon) -> str:
        nodes.append(Node(_fresh(name, taken), op, args, (), of_size(size)))
        return nodes[-1].name

    parts = [names.SAMPLE, names.PREDICTION, names.HISTORY]
    if (clip := clip_of(sampler)) is not None:  # what the prediction says of the sample without noise
        terms = [
            write("update.term", "aten.mul.Tensor", (Ref(value), Ref(column)))
            for column, value in zip(names.X0_COLUMNS, (names.SAMPLE, names.PREDICTION), strict=True)
            if getattr(sampler, column).any()
        ]
        total = terms[0] if len(terms) == 1 else write("update.sum", "aten.add.Tensor", tuple(map(Ref, terms)))
        parts.append(write("update.denoised", "aten.clamp.default", (Ref(total), -clip, clip)))
    if sampler.memories:
        parts.append(names.MEMORY)
    read, made = rows(sampler, horizon), columns(sampler, horizon)
    features = write("update.features", "aten.cat.default", (tuple(map(Ref, parts)), 2), read)
    product = write("update.product", "aten.matmul.default", (Ref(features), Ref(names.UPDATE)), made)
    if sampler.memories:
        cut = (Ref(product), 2, horizon, made)
        nodes.append(Node(names.MEMORY_NEXT, "aten.slice.Tensor", cut, (), of_size(made - horizon)))
        product = write("update.sample", "aten.slice.Tensor", (Ref(product), 2, 0, horizon))
    return [*nodes, Node(names.SAMPLE_NEXT, "aten.add.Tensor", (Ref(product), Ref(names.OFFSET)), (), (turned,))]


def _fresh(name: str, taken: set[str]) -> str:
    while name in taken:
        name += "_"
    taken.add(name)
    return name


def lower_idle(pieces: Pieces, weights: Arrays, opset: int) -> tuple[ModelProto | None, str]:
    """The model of a program with these pieces and values of constants, or None and why there is none."""
    form, why = idle_form(pieces, weights)
    return (None if form is None else _write(form, opset)), why


def _write(form: IdleForm, opset: int) -> ModelProto:
    tokens, dimensions = form.constant.shape[0], form.head.shape[1]
    w = GraphWriter()
    total = w.op("Transpose", TOTAL, perm=[1, 0, 2]) if form.turned else TOTAL
    offset = w.op("Add", total, w.constant(form.constant[None], np.float32))
    if form.basis is None:
        numerator = w.op("MatMul", offset, w.constant(form.head, np.float32))
        blank = w.op("Mul", w.op("Slice", offset, *map(w.constant, ([0], [1], [2]))), w.constant(0.0, np.float32))
        one = w.op("Add", blank, w.constant(1.0, np.float32))
        rows = w.op("Concat", *dimensions * [blank], one, numerator, axis=2)
    else:
        rows = _normed(w, form, form.basis, offset)
    w.rename(w.op("Transpose", rows, perm=[2, 0, 1]), BASE)
    w.rename(w.constant(form.product, np.float32), PRODUCT)
    w.rename(w.constant(form.shift, np.float32), SHIFT)
    shapes = {BASE: [len(form.product), "B", tokens], PRODUCT: form.product.shape, SHIFT: [dimensions, 1, tokens]}
    outputs = [tensor(name, np.float32, shape) for name, shape in shapes.items()]
    given = tensor(TOTAL, np.float32, [n if isinstance(n, int) else str(n) for n in form.type.shape])
    return own_model(w.graph(IDLE, outputs, [given]), [helper.make_opsetid("", opset)])


def _normed(w: GraphWriter, form: IdleForm, basis: Wide, offset: str) -> str:
    """``[B, T, 2 D + 1]`` of a stream ``[B, T, W]``."""
    width = len(form.head)
    last = w.constant([-1])
    u = w.op("Sub", offset, w.op("ReduceMean", offset, last))
    projected = w.op("MatMul", u, w.constant(basis, np.float32))
    across = w.op("Sub", u, w.op("MatMul", projected, w.constant(basis.T, np.float32)))
    variance = w.op("Div", w.op("ReduceSumSquare", across, last), w.constant(width, np.float32))
    deviation = w.op("Sqrt", w.op("Add", variance, w.constant(form.eps, np.float32)))
    along = w.op("Div", projected, w.constant(np.sqrt(width), np.float32))
    numerator = w.op("MatMul", u, w.constant(form.head, np.float32))
    return w.op("Concat", along, deviation, numerator, axis=2)
