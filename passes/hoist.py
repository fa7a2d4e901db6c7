"""Partial evaluation of the denoising loop: what does not depend on the noisy sample leaves it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt
import torch

from ttscompile.core.spec import SamplerTable
from ttscompile.ir.binding import bindings, input_bindings, numbering
from ttscompile.ir.evaluate import Evaluator
from ttscompile.ir.flops import graph_flops
from ttscompile.ir.graph import Graph, Node, Ref, TensorType, backward_slice
from ttscompile.ir.program import Binding, Pieces, Program
from ttscompile.ir.rows import crossing_inputs, unfold

from .base import Pass, PassResult

_CAT = "aten.cat.default"


class Hoist(Pass):
    """Split the prologue by binding time and evaluate its constant part.

    Before (contexts of the loop pieces come from one graph, run at every step)::

        %k = aten.cat.default([%k.part0, %k.part1], 1)      # step, from SplitTokens
        contexts = prologue(timestep, obs)

    After::

        tables[%k.part0]   [K, ...]                         # evaluated here, once for each timestep
        %k.part1 = condition(obs)                           # once a call
        block(stream, %k.part0, %k.part1)                   # concatenates: a copy, no arithmetic
        step(...)                                           # what needs both, all K steps in one batch
    """

    def requires(self, program: Program) -> None:
        """The program is cut and not hoisted."""
        if program.pieces is None or program.pieces.bindings:
            raise self.fail("runs once, after partition.")

    def call(self, program: Program) -> PassResult:
        """Hoist."""
        assert program.pieces is not None
        spec = program.spec
        inputs = input_bindings(spec)
        prologue, renamed = _name_inputs(program.pieces.condition)
        known = bindings(prologue, inputs)
        pieces = _sink(_rename_contexts(program.pieces, renamed), prologue, known)
        wanted = list(dict.fromkeys(n for g in _loop(pieces) for n in list(g.inputs)[1:]))
        types = prologue.types()
        at = {b: [n for n in wanted if known[n] is b] for b in Binding}
        step, boundary, prologue = _step_graph(prologue, at[Binding.STEP], known)
        types, known = prologue.types(), bindings(prologue, inputs)
        early = {b: [n for n in boundary if known[n] is b] for b in (Binding.CONDITION, Binding.TABLE)}
        conditions = list(dict.fromkeys(at[Binding.CONDITION] + early[Binding.CONDITION]))
        tables = list(dict.fromkeys(at[Binding.TABLE] + at[Binding.CONSTANT] + early[Binding.TABLE]))
        condition = backward_slice(prologue, tuple(conditions), {})
        condition = replace(condition, inputs={k: types[k] for k in spec.observations})
        new = replace(
            pieces,
            condition=condition,
            step=step,
            tables=_evaluate_tables(prologue, tables, program.weights, spec.sampler, spec.timestep_argument),
            bindings={
                **dict.fromkeys(tables, Binding.TABLE),
                **dict.fromkeys(conditions, Binding.CONDITION),
                **dict.fromkeys(at[Binding.STEP], Binding.STEP),
            },
        )
        blocks = tuple(replace(b, flops=graph_flops(g)) for b, g in zip(program.blocks, new.blocks, strict=True))
        return PassResult(replace(program, pieces=new, blocks=blocks), True, _notes(program, new))

    def ensures(self, program: Program) -> None:
        """No loop piece reads timestep or observation; every context has a binding."""
        assert program.pieces is not None
        raw = {program.spec.timestep_argument, *program.spec.observations}
        for graph in _loop(program.pieces):
            for name in list(graph.inputs)[1:]:
                if name in raw or name not in program.pieces.bindings:
                    raise self.fail(f"a loop piece still reads %{name}.")


def _loop(pieces: Pieces) -> list[Graph]:
    return [pieces.stem, *pieces.blocks, pieces.tail]


def _sink(pieces: Pieces, prologue: Graph, known: Mapping[str, Binding]) -> Pieces:
    """Move concatenations of different binding times into the loop pieces: they cost a copy, not arithmetic.

    Hoisted they would be a copy for each of the K steps, computed or not, and their rows would fill the cache.
    """
    producers, types = prologue.producers(), prologue.types()
    movable = {
        n.name
        for n in prologue.nodes
        if n.op == _CAT and known[n.name] is Binding.STEP and any(known[r] is not Binding.STEP for r in n.refs())
    }

    def sink(piece: Graph) -> Graph:
        moved: list[Node] = []
        inputs: dict[str, TensorType] = {}
        for position, (name, type_) in enumerate(piece.inputs.items()):
            if position and name in movable:
                moved.append(producers[name])
                for part in producers[name].refs():
                    inputs.setdefault(part, types[part])
            else:
                inputs[name] = type_
        return replace(piece, inputs=inputs, nodes=(*moved, *piece.nodes)) if moved else piece

    return replace(pieces, stem=sink(pieces.stem), blocks=tuple(map(sink, pieces.blocks)), tail=sink(pieces.tail))


def _name_inputs(prologue: Graph) -> tuple[Graph, dict[str, str]]:
    """Read every input through a node of its own, so that whatever the loop needs is the result of some node."""
    renamed = {name: f"{name}.value" for name in prologue.inputs}
    copies = [
        Node(renamed[name], "aten.clone.default", (Ref(name),), (), (type_,)) for name, type_ in prologue.inputs.items()
    ]
    nodes = [node.renamed(lambda name: renamed.get(name, name)) for node in prologue.nodes]
    outputs = tuple(renamed.get(name, name) for name in prologue.outputs)
    return replace(prologue, nodes=(*copies, *nodes), outputs=outputs), renamed


def _rename_contexts(pieces: Pieces, renamed: Mapping[str, str]) -> Pieces:
    def rename(piece: Graph) -> Graph:
        first = next(iter(piece.inputs))
        mapping = {k: v for k, v in renamed.items() if k != first and k in piece.inputs}
        return replace(
            piece,
            inputs={mapping.get(n, n): t for n, t in piece.inputs.items()},
            nodes=tuple(n.renamed(lambda name: mapping.get(name, name)) for n in piece.nodes),
        )

    return replace(pieces, stem=rename(pieces.stem), blocks=tuple(map(rename, pieces.blocks)), tail=rename(pieces.tail))


def _step_graph(
    prologue: Graph, outputs: list[str], known: Mapping[str, Binding]
) -> tuple[Graph | None, list[str], Graph]:
    """The graph of the step values, the condition values and table rows that it reads, and the prologue that has them.

    What has several rows a stream is read with an axis of streams; see ``ir.rows``.
    """
    if not outputs:
        return None, [], prologue
    types, own = prologue.types(), numbering(prologue)
    early = {
        name: types[name]
        for node in prologue.nodes
        if known[node.name] is Binding.STEP or node.name in own
        for name in node.refs()
        if known[name] in (Binding.TABLE, Binding.CONDITION) and name not in own
    }
    step = backward_slice(prologue, tuple(outputs), early)
    rows = unfold(prologue, step.inputs)
    prologue = replace(prologue, nodes=(*prologue.nodes, *(one.leave() for one in rows.values())))
    step = crossing_inputs(step, rows)
    return step, list(step.inputs), prologue


def _evaluate_tables(
    prologue: Graph, names: list[str], weights: Mapping[str, Any], sampler: SamplerTable, timestep: str
) -> dict[str, npt.NDArray[Any]]:
    """Rows of every table value, ``[K, *shape at a batch of one]``."""
    if not names:
        return {}
    graph = backward_slice(prologue, tuple(names), {})
    graph = replace(graph, inputs={timestep: prologue.inputs[timestep]})  # which says that the batch is one
    run = Evaluator(graph, {n: torch.from_numpy(np.asarray(weights[n])) for n in graph.constants})
    rows: dict[str, list[npt.NDArray[Any]]] = {name: [] for name in names}
    with torch.no_grad():
        for t in torch.from_numpy(sampler.timesteps):
            values = run({timestep: t[None]})
            for name, value in zip(names, values, strict=True):
                rows[name].append(value.contiguous().numpy().copy())
    return {name: np.stack(values) for name, values in rows.items()}


def _notes(program: Program, pieces: Pieces) -> tuple[str, ...]:
    steps = program.spec.sampler.steps
    dense = max(program.dense_flops or graph_flops(program.denoiser) * steps, 1)
    loop = sum(graph_flops(g) for g in _loop(pieces)) * steps
    once = graph_flops(pieces.condition)
    batch = graph_flops(pieces.step) * steps if pieces.step is not None else 0
    table_bytes = sum(t.nbytes for t in pieces.tables.values())
    return (
        f"left in the loop: {loop / dense:.1%} of the dense FLOPs",
        f"once a call: {once / dense:.2%} (condition) and {batch / dense:.2%} (all {steps} steps in one batch)",
        f"{len(pieces.tables)} tables of {steps} rows, {table_bytes / 1e6:.2f} MB",
    )
