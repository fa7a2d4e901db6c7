"""Split a linear layer of concatenated features with different binding times into a sum of linear layers."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

from ttscompile.ir.binding import bindings, input_bindings
from ttscompile.ir.graph import Argument, Node, Ref, TensorType
from ttscompile.ir.program import Cut

from .base import Pass, PassResult

_CAT, _LINEAR = "aten.cat.default", "aten.linear.default"


class SplitFeatures(Pass[Cut, Cut]):
    """Let each part of a feature vector meet its columns of the weight at its own binding time.

    The modulations of adaLN are linear in [timestep, observation]. Before::

        %f = aten.cat.default([%time, %observation], 1)          # step
        %m = aten.linear.default(%f, %w, %b)                     # step: all of it, for every step

    After::

        %m.part0 = aten.linear.default(%time, %w[:, :t], %b)     # a table in the artifact
        %m.part1 = aten.linear.default(%observation, %w[:, t:])  # once a call
        %m       = aten.add.Tensor(%m.part0, %m.part1)           # for every step, an addition

    The result differs from the original by rounding only.
    """

    def call(self, program: Cut) -> PassResult[Cut]:
        """Split in the prologue."""
        prologue, spec = program.prologue, program.spec
        known, producers, types = bindings(prologue, input_bindings(spec)), prologue.producers(), prologue.types()
        nodes: list[Node] = []
        split = 0
        for node in prologue.nodes:
            parts = _parts(node, producers, types) if node.op == _LINEAR else []
            if len({known[part] for part in parts}) < 2:
                nodes.append(node)
                continue
            nodes += _sum(node, parts, types)
            split += 1
        if not split:
            return PassResult(program)
        note = f"{split} linear layers of features with different binding times became sums"
        return PassResult(replace(program, prologue=replace(prologue, nodes=tuple(nodes))), (note,))


def _parts(node: Node, producers: Mapping[str, Node], types: Mapping[str, TensorType]) -> list[str]:
    """The features that a linear layer reads, if they are concatenated along its last axis; else none."""
    source, weight = node.args[0], node.args[1]
    cat = producers.get(source.name) if isinstance(source, Ref) else None
    if cat is None or cat.op != _CAT or not isinstance(weight, Ref) or len(types[weight.name].shape) != 2:
        return []
    axis = cat.args[1] if len(cat.args) > 1 else 0
    if not isinstance(axis, int) or axis % len(cat.type.shape) != len(cat.type.shape) - 1:
        return []
    operands = cat.args[0]
    assert isinstance(operands, tuple)
    parts = [operand.name for operand in operands if isinstance(operand, Ref)]
    # A concatenation may change the dtype of a part.
    fits = all(isinstance(types[p].shape[-1], int) and types[p].dtype == cat.type.dtype for p in parts)
    return parts if fits else []


def _sum(node: Node, parts: list[str], types: Mapping[str, TensorType]) -> list[Node]:
    weight = node.args[1]
    assert isinstance(weight, Ref)
    rows = types[weight.name].shape[0]
    nodes: list[Node] = []

    def emit(name: str, op: str, args: tuple[Argument, ...], type_: TensorType) -> None:
        nodes.append(Node(name, op, args, (), (type_,), node.source))

    start, total = 0, ""
    for index, part in enumerate(parts):
        size = types[part].shape[-1]
        assert isinstance(size, int)
        columns, linear = f"{node.name}.columns{index}", f"{node.name}.part{index}"
        cut = TensorType((rows, size), types[weight.name].dtype)
        emit(columns, "aten.slice.Tensor", (weight, 1, start, start + size), cut)
        bias: tuple[Argument, ...] = node.args[2:] if index == 0 else ()
        made = TensorType((*types[part].shape[:-1], rows), node.type.dtype)
        emit(linear, _LINEAR, (Ref(part), Ref(columns), *bias), made)
        name = node.name if index == len(parts) - 1 else f"{node.name}.sum{index}"
        if index:
            emit(name, "aten.add.Tensor", (Ref(total), Ref(linear)), node.type)
        total = name if index else linear
        start += size
    return nodes
