"""One graph for everything between the last block of a step and the first block of the next.

    stream --tail--> prediction --sampler, correction--> sample_next --stem--> stream_next

The pieces are small; run one by one they cost more in calls than in arithmetic.
"""

from __future__ import annotations

from collections.abc import Mapping

from ttscompile.config import PolicySpec, SamplerTable
from ttscompile.correction import FEATURES, groups_of
from ttscompile.correction import HISTORY as HISTORY_ENTRIES
from ttscompile.errors import LoweringError

from .graph import Argument, Batch, Graph, Node, Ref, TensorType

STREAM = "stream"
SAMPLE = "sample"
NOISE = "noise"
COEFFICIENTS = "coefficients"
HISTORY = "history"
CORRECTION = "correction"
CORRECTION_BIAS = "correction_bias"
SAMPLE_NEXT = "sample_next"
STREAM_NEXT = "stream_next"
PREDICTION = "prediction"
OUTPUTS = (SAMPLE_NEXT, STREAM_NEXT, PREDICTION)


def fuse_advance(tail: Graph, stem: Graph, spec: PolicySpec) -> Graph:
    """Concatenate tail, sampler update and stem.

    The update is that of ``SamplerTable``, with the row of the step as an input, and that of ``Correction``, whose
    weights of the step are inputs too: zeros where there is none. Terms whose column of the sampler's table is zero at
    every step are left out.

    Args:
        tail: residual stream (its first input) and contexts -> prediction ``[B, T, D]``.
        stem: sample (its first input) and contexts -> residual stream.
        spec: gives the shape of the sample, the clip and the columns.

    Returns:
        A graph with the inputs ``stream``, ``sample`` and ``noise`` ``[B, T, D]``, ``coefficients`` ``[6]`` in the
        order of ``SamplerTable.COLUMNS``, ``history`` ``[B, 4 T, D]``, ``correction`` ``[G, 6 T, T]`` and
        ``correction_bias`` ``[G, 1, T]``, the tail's contexts as ``tail.NAME`` (of this step) and the stem's as
        ``stem.NAME`` (of the next); outputs ``sample_next``, ``stream_next`` and ``prediction`` ``[B, T, D]``.

    Raises:
        LoweringError: a constant of the program has the name of one of these inputs.
    """
    (stream, *tail_contexts), (sample, *stem_contexts) = tail.inputs, stem.inputs
    type_ = TensorType((Batch(), *spec.sample), "float32")
    inputs = {STREAM: tail.inputs[stream], SAMPLE: type_, NOISE: type_, COEFFICIENTS: TensorType((6,), "float32")}
    inputs |= _correction_types(spec)
    inputs |= {f"tail.{name}": tail.inputs[name] for name in tail_contexts}
    inputs |= {f"stem.{name}": stem.inputs[name] for name in stem_contexts}
    constants = {**tail.constants, **stem.constants}
    if clash := sorted((constants.keys() & inputs.keys()) | (constants.keys() & set(OUTPUTS))):
        raise LoweringError(
            f"the module has weights called {clash}, which are names of the compiled loop's own values."
            " Rename these parameters or buffers in the module."
        )
    taken = {*inputs, *constants, *OUTPUTS}
    first = {n: n for n in tail.constants} | {n: f"tail.{n}" for n in tail_contexts} | {stream: STREAM}
    nodes, names = _moved(tail, "tail", first, taken)
    update = _Update(taken, type_)
    nodes.append(Node(PREDICTION, "aten.clone.default", (Ref(names[tail.outputs[0]]),), (), (type_,)))
    nodes += update.nodes_for(spec, inputs)
    second = {n: n for n in stem.constants} | {n: f"stem.{n}" for n in stem_contexts} | {sample: SAMPLE_NEXT}
    more, names = _moved(stem, "stem", second, taken)
    nodes += more
    result = names[stem.outputs[0]]
    stream_type = stem.types()[stem.outputs[0]]
    nodes.append(Node(STREAM_NEXT, "aten.clone.default", (Ref(result),), (), (stream_type,)))
    return Graph(inputs, constants, tuple(nodes), OUTPUTS)


def _correction_types(spec: PolicySpec) -> dict[str, TensorType]:
    (horizon, dimensions), groups = spec.sample, groups_of(spec.sampler.steps, spec.sample)
    return {
        HISTORY: TensorType((Batch(), HISTORY_ENTRIES * horizon, dimensions), "float32"),
        CORRECTION: TensorType((groups, FEATURES * horizon, horizon), "float32"),
        CORRECTION_BIAS: TensorType((groups, 1, horizon), "float32"),
    }


def _moved(graph: Graph, prefix: str, names: Mapping[str, str], taken: set[str]) -> tuple[list[Node], dict[str, str]]:
    """The nodes of a piece under new names, and the new name of each of its values."""
    renamed = dict(names)
    nodes = []
    for node in graph.nodes:
        renamed[node.name] = _fresh(f"{prefix}.{node.name}", taken)
        moved = node.renamed(renamed.__getitem__)
        nodes.append(Node(renamed[node.name], moved.op, moved.args, moved.kwargs, moved.types, moved.source))
    return nodes, renamed


class _Update:
    """Writes the nodes of the sampler's update."""

    def __init__(self, taken: set[str], type_: TensorType) -> None:
        self.taken = taken
        self.type = type_
        self.nodes: list[Node] = []

    def nodes_for(self, spec: PolicySpec, inputs: Mapping[str, TensorType]) -> list[Node]:
        """``sample_next`` of the inputs and the prediction."""
        sampler = spec.sampler
        split = _fresh("sampler.row", self.taken)
        entry = TensorType((1,), "float32")
        self.nodes.append(Node(split, "aten.split_with_sizes.default", (Ref(COEFFICIENTS), (1,) * 6), (), (entry,) * 6))
        columns = dict.fromkeys(SamplerTable.COLUMNS, "")
        for i, column in enumerate(columns):
            if getattr(sampler, column).any():
                columns[column] = self.write(f"sampler.{column}", "getitem", (Ref(split), i), entry)
        denoised = self.sum_of([(columns["sample_to_x0"], SAMPLE), (columns["out_to_x0"], PREDICTION)])
        if sampler.clip is not None and denoised:
            denoised = self.write("sampler.x0", "aten.clamp.default", (Ref(denoised), -sampler.clip, sampler.clip))
        result = self.sum_of(
            [
                (columns["x0_to_next"] if denoised else "", denoised),
                (columns["sample_to_next"], SAMPLE),
                (columns["out_to_next"], PREDICTION),
                (columns["noise_to_next"], NOISE),
            ]
        )
        correction = self.correction(spec, inputs)
        if result:
            self.nodes.append(Node(SAMPLE_NEXT, "aten.add.Tensor", (Ref(result), Ref(correction)), (), (self.type,)))
        else:  # a table of zeros is no sampler, but it is arithmetic
            self.nodes.append(Node(SAMPLE_NEXT, "aten.clone.default", (Ref(correction),), (), (self.type,)))
        return self.nodes

    def correction(self, spec: PolicySpec, inputs: Mapping[str, TensorType]) -> str:
        """What the correction adds: ``[D, B, 6 T] @ [G, 6 T, T] + [G, 1, T]``, turned back to ``[B, T, D]``."""
        horizon, dimensions = spec.sample
        rows, batch = FEATURES * horizon, self.type.shape[0]
        parts = (Ref(SAMPLE), Ref(PREDICTION), Ref(HISTORY))
        features = self.write(
            "correction.features", "aten.cat.default", (parts, 1), TensorType((batch, rows, dimensions), "float32")
        )
        turned = TensorType((dimensions, batch, rows), "float32")
        features = self.write("correction.turned", "aten.permute.default", (Ref(features), (2, 0, 1)), turned)
        product = TensorType((dimensions, batch, horizon), "float32")
        value = self.write("correction.product", "aten.matmul.default", (Ref(features), Ref(CORRECTION)), product)
        value = self.write("correction.sum", "aten.add.Tensor", (Ref(value), Ref(CORRECTION_BIAS)), product)
        return self.write("correction.value", "aten.permute.default", (Ref(value), (1, 2, 0)))

    def sum_of(self, terms: list[tuple[str, str]]) -> str:
        """The sum of coefficient times value, without terms that have no coefficient; empty for no terms."""
        total = ""
        for coefficient, value in terms:
            if coefficient:
                term = self.write("sampler.term", "aten.mul.Tensor", (Ref(value), Ref(coefficient)))
                total = self.write("sampler.sum", "aten.add.Tensor", (Ref(total), Ref(term))) if total else term
        return total

    def write(self, name: str, op: str, args: tuple[Argument, ...], type_: TensorType | None = None) -> str:
        name = _fresh(name, self.taken)
        self.nodes.append(Node(name, op, args, (), (type_ or self.type,)))
        return name


def _fresh(name: str, taken: set[str]) -> str:
    """A name that is not taken; takes it."""
    while name in taken:
        name += "_"
    taken.add(name)
    return name
