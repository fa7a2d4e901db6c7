"""Add the pruner: a small head on the hoisted condition features that predicts the plan of a whole call."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

from ttscompile.core.spec import COMMITTED, ORIGINAL
from ttscompile.ir.dataflow import dominators, reachable_from, reaching
from ttscompile.ir.flops import graph_flops, node_flops
from ttscompile.ir.graph import Argument, Batch, Enum, Graph, Node, Ref, TensorType
from ttscompile.ir.plan_head import SOURCES, Parameters, first_numbers
from ttscompile.ir.program import Binding, Program

from .base import Pass, PassResult

MAX_SHARE = 0.01
"""The head may cost at most this share of the dense FLOPs."""

MAX_FEATURE = 16384
"""A feature with more numbers is averaged over its longest axes: the keys of a prefix cache are millions."""


@dataclass(frozen=True)
class InsertPruner(Pass[Program, Program]):
    """Put a low-rank plan head on the features of the policy's own condition encoder.

    Before::

        pieces.condition : observations -> condition values

    After::

        features = flatten and normalise the last value that all condition values come from, averaged if it is huge
        code     = tanh(linear(gelu(linear(features))))                          # [B, rank]
        logits   = pruner.base + (code * pruner.step) @ pruner.block + mask       # [B, K, blocks, 4]

    What depends on step and block alone is a constant; only ``code`` depends on the observation. The plan is the
    argmax over the sources. Before calibration it is dense. A loop of another number of steps than the original's has a
    head of its own.
    """

    rank: int = 16
    width: int = 64

    def call(self, program: Program) -> PassResult[Program]:
        condition, features = _features(program)
        read = {f: condition.types()[f] for f in features}
        loops = program.spec.all_loops
        own = [name for name, table in loops.items() if name == ORIGINAL or table.steps != loops[ORIGINAL].steps]
        made = {name: self._fitted(read, program, name) for name in own}
        head, graph, parameters = made.pop(ORIGINAL)
        if taken := sorted(parameters.keys() & program.weights.keys()):
            raise self.fail(
                f"the module has weights of its own called {', '.join(taken)}, as those of the plan head are."
                " Rename the submodule 'pruner'."
            )
        pruners = {name: each for name, (_, each, _) in made.items()}
        pieces = replace(program.pieces, condition=condition, pruner=graph, features=features, loop_pruners=pruners)
        pieces = replace(pieces, bindings={**pieces.bindings, **dict.fromkeys(features, Binding.CONDITION)})
        weights = {name: numbers for name, (_, _, numbers) in made.items()}
        new = replace(program, pieces=pieces, weights={**program.weights, **parameters}, loop_weights=weights)
        where = ", ".join(f"%{f} {type_}" for f, type_ in read.items())
        share = graph_flops(graph) / max(program.dense_flops, 1)
        notes = [f"reads {where}", f"rank {head.rank}, {graph_flops(graph):,} FLOPs, {share:.4%} of a dense call"]
        if share > MAX_SHARE:
            notes.append(f"more than {MAX_SHARE:.0%} even at its smallest: on a policy this small sparsity hardly pays")
        return PassResult(new, tuple(notes))

    def _fitted(
        self, features: dict[str, TensorType], program: Program, loop: str
    ) -> tuple[InsertPruner, Graph, Parameters]:
        """The head of a loop: this one, halved until it costs at most ``MAX_SHARE`` of a dense call or cannot shrink.

        With it come its graph and its first numbers.
        """
        steps, blocks = program.spec.all_loops[loop].steps, len(program.blocks)
        inputs, dense = sum(math.prod(_read(type_)) for type_ in features.values()), program.flops_of(loop)
        head = self
        while head.rank > 1:
            contractions = inputs * head.width + head.width * head.rank + steps * head.rank * blocks * SOURCES
            if 2 * contractions <= MAX_SHARE * dense:
                break
            head = InsertPruner(rank=head.rank // 2, width=max(head.width // 2, 4))
        parameters = first_numbers(inputs, head.width, head.rank, steps, blocks)
        return head, head._head(features, parameters, steps, blocks), parameters

    def _head(self, features: dict[str, TensorType], parameters: Parameters, steps: int, blocks: int) -> Graph:
        nodes: list[Node] = []

        def emit(name: str, op: str, shape: Sequence[int], *args: Argument) -> Ref:
            type_ = TensorType((Batch(), *shape), "float32")
            nodes.append(Node(f"plan.{name}", f"aten.{op}", args, (), (type_,), "plan head"))
            return Ref(nodes[-1].name)

        flat = []
        for i, (name, type_) in enumerate(features.items()):
            value: Ref = Ref(name)
            axis, shape, read = type_.batch_axis, _stream(type_), _read(type_)
            size = math.prod(read)
            if axis:  # the batch first, whatever the layout of the encoder
                order = (axis, *(a for a in range(len(type_.shape)) if a != axis))
                value = emit(f"batch_first{i}", "permute.default", shape, value, order)
            if read != shape:
                gone = tuple(a + 1 for a, (whole, left) in enumerate(zip(shape, read, strict=True)) if whole != left)
                value = emit(f"average{i}", "mean.dim", read, value, gone, True)
            flat.append(emit(f"flat{i}", "reshape.default", (size,), value, (Batch(), size)))
        width = sum(math.prod(_read(t)) for t in features.values())
        joined = flat[0] if len(flat) == 1 else emit("joined", "cat.default", (width,), tuple(flat), 1)
        normed = emit("normed", "layer_norm.default", (width,), joined, (width,))
        hidden = emit("hidden", "linear.default", (self.width,), normed, _p("hidden.weight"), _p("hidden.bias"))
        active = emit("active", "gelu.default", (self.width,), hidden)
        code = emit("pre_code", "linear.default", (self.rank,), active, _p("code.weight"), _p("code.bias"))
        code = emit("code", "tanh.default", (self.rank,), code)
        code = emit("code_row", "unsqueeze.default", (1, self.rank), code, 1)
        by_step = emit("by_step", "mul.Tensor", (steps, self.rank), code, _p("step"))
        product = emit("product", "matmul.default", (steps, blocks * SOURCES), by_step, _p("block"))
        cells = (steps, blocks, SOURCES)
        shaped = emit("shaped", "reshape.default", cells, product, (Batch(), *cells))
        based = emit("based", "add.Tensor", cells, shaped, _p("base"))
        logits = emit("logits", "add.Tensor", cells, based, _p("mask"))
        constants = {name: TensorType(value.shape, "float32") for name, value in parameters.items()}
        return Graph(features, constants, tuple(nodes), (logits.name,))


def _p(name: str) -> Ref:
    return Ref(f"pruner.{name}")


def _stream(type_: TensorType) -> tuple[int, ...]:
    axis = type_.batch_axis
    sizes = type_.at(1)
    return sizes if axis is None else sizes[:axis] + sizes[axis + 1 :]


def _read(type_: TensorType) -> tuple[int, ...]:
    """What the head reads of it: the longest axes averaged, of size 1, until there are at most ``MAX_FEATURE``."""
    sizes = list(_stream(type_))
    while math.prod(sizes) > MAX_FEATURE:
        sizes[sizes.index(max(sizes))] = 1
    return tuple(sizes)


def _features(program: Program) -> tuple[Graph, tuple[str, ...]]:
    """The condition graph and the values of it that the head reads.

    The last value that everything the loop gets from the observation goes through and that some arithmetic has
    produced is the output of the policy's condition encoder; without one the observations themselves are read.
    """
    graph = program.pieces.condition
    types, producers = graph.types(), graph.producers()
    arithmetic = {n.name for n in graph.nodes if node_flops(n, types)}
    observed = [key for key in graph.inputs if key != COMMITTED]  # a plan does not depend on a prefix
    told = reachable_from(graph, [COMMITTED])
    for name in reversed(dominators(graph, observed, [name for name in graph.outputs if name not in told])):
        node = producers.get(name)
        worked = not arithmetic.isdisjoint(reaching(graph, [name]))
        readable = types[name].batch_axis is not None and types[name].dtype == "float32"
        if worked and node is not None and len(node.types) == 1 and readable:
            outputs = graph.outputs if name in graph.outputs else (*graph.outputs, name)
            return replace(graph, outputs=outputs), (name,)
    nodes = list(graph.nodes)
    features: list[str] = []
    for key in observed:
        type_ = graph.inputs[key]
        name, read = f"{key}.feature", replace(type_, dtype="float32")
        feature = Node(name, "aten.clone.default", (Ref(key),), (), (read,), "feature of the plan head")
        if type_ != read:  # tokens, say
            feature = replace(feature, op="aten._to_copy.default", kwargs=(("dtype", Enum("dtype", read.dtype)),))
        nodes.append(feature)
        features.append(name)
    return replace(graph, nodes=tuple(nodes), outputs=(*graph.outputs, *features)), tuple(features)
