"""Partial evaluation of the denoising loop: what does not depend on the noisy sample leaves it."""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import torch

from ttscompile.core.coercion import Array
from ttscompile.core.spec import ORIGINAL, SamplerTable
from ttscompile.ir.binding import bindings, input_bindings, numbering
from ttscompile.ir.evaluate import evaluator
from ttscompile.ir.flops import graph_flops
from ttscompile.ir.graph import Graph, backward_slice, copied
from ttscompile.ir.program import Binding, Cut, Pieces, Program, mapped
from ttscompile.ir.rows import crossing_inputs, unfold

from .base import Pass, PassResult

_MOVES = ("aten.cat.default", "aten.where.self")


class Hoist(Pass[Cut, Program]):
    """Split the prologue by binding time and evaluate its constant part.

    Before (contexts of the loop pieces come from one graph, run at every step)::

        %k = aten.cat.default([%k.part0, %k.part1], 1)      # step, from SplitTokens
        contexts = prologue(timestep, obs)

    After::

        tables[%k.part0]   [K, ...]                         # evaluated here, once for each timestep of a loop
        %k.part1 = condition(obs)                           # once a call
        block(stream, %k.part0, %k.part1)                   # concatenates: a copy, no arithmetic
        step(...)                                           # what needs both, all K steps in one batch
    """

    def call(self, program: Cut) -> PassResult[Program]:
        spec = program.spec
        inputs = input_bindings(spec)
        prologue, renamed = _name_inputs(program.prologue)
        known = bindings(prologue, inputs)
        loop = mapped(program.loop, lambda graph: _sink(graph.renamed(renamed), prologue, known))
        at = {b: [n for n in loop.contexts if known[n] is b] for b in Binding}
        step, boundary, prologue = _step_graph(prologue, at[Binding.STEP], known)
        types, known = prologue.types(), bindings(prologue, inputs)
        early = {b: [n for n in boundary if known[n] is b] for b in (Binding.CONDITION, Binding.TABLE)}
        conditions = list(dict.fromkeys(at[Binding.CONDITION] + early[Binding.CONDITION]))
        tables = list(dict.fromkeys(at[Binding.TABLE] + at[Binding.CONSTANT] + early[Binding.TABLE]))
        condition = backward_slice(prologue, tuple(conditions), {})
        evaluated = _evaluate_tables(prologue, tables, program)
        pieces = Pieces(
            **vars(loop),
            condition=replace(condition, inputs={k: types[k] for k in spec.inputs}),
            step=step,
            tables=evaluated.pop(ORIGINAL),
            bindings={
                **dict.fromkeys(tables, Binding.TABLE),
                **dict.fromkeys(conditions, Binding.CONDITION),
                **dict.fromkeys(at[Binding.STEP], Binding.STEP),
            },
            loop_tables=evaluated,
        )
        new = Program(**program.carried, blocks=program.blocks, pieces=pieces)
        return PassResult(new, _notes(new))

    def ensures(self, program: Program) -> None:
        """No loop piece reads timestep or observation."""
        raw = {program.spec.timestep_argument, *program.spec.inputs}
        if read := sorted(raw.intersection(program.pieces.contexts)):
            raise self.fail(f"a loop piece still reads %{read[0]}.")


def _sink(piece: Graph, prologue: Graph, known: Mapping[str, Binding]) -> Graph:
    """Move what puts values of different binding times together into a loop piece: it costs a copy, not arithmetic.

    That is concatenation, and choice by a mask. Hoisted they would be a copy for each of the K steps, computed or not,
    and their rows would fill the cache: a mask of tokens, and rows that all tokens share, make a row for each token.
    """
    types = prologue.types()
    moved = [
        node
        for node in prologue.nodes
        if node.name in piece.inputs and node.op in _MOVES and known[node.name] is Binding.STEP
        if any(known[part] is not Binding.STEP for part in node.refs())
    ]
    inputs, made = dict(piece.inputs), {node.name for node in moved}
    for part in (part for node in moved for part in node.refs() if part not in made):
        inputs.setdefault(part, types[part])
    inputs = {name: type_ for name, type_ in inputs.items() if name not in made}
    return replace(piece, inputs=inputs, nodes=(*moved, *piece.nodes)) if moved else piece


def _name_inputs(prologue: Graph) -> tuple[Graph, dict[str, str]]:
    """Read every input through a node of its own, so that whatever the loop needs is the result of some node."""
    renamed = {name: f"{name}.value" for name in prologue.inputs}
    copies = [copied(renamed[name], name, type_) for name, type_ in prologue.inputs.items()]
    reading = prologue.renamed(renamed)
    return replace(reading, inputs=prologue.inputs, nodes=(*copies, *reading.nodes)), renamed


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


def _evaluate_tables(prologue: Graph, names: list[str], program: Cut) -> dict[str, dict[str, Array]]:
    """By loop, rows of every table value, ``[K, *shape at a batch of one]``."""
    loops, timestep = program.spec.all_loops, program.spec.timestep_argument
    if not names:
        return {loop: {} for loop in loops}
    graph = backward_slice(prologue, tuple(names), {})
    graph = replace(graph, inputs={timestep: prologue.inputs[timestep]})  # which says that the batch is one
    run = evaluator(graph, program.weights)

    def rows_of(sampler: SamplerTable) -> dict[str, Array]:
        steps = [run({timestep: t[None]}) for t in torch.from_numpy(sampler.timesteps)]
        by_name = zip(names, zip(*steps, strict=True), strict=True)
        return {name: np.stack([row.contiguous().numpy() for row in rows]) for name, rows in by_name}

    with torch.no_grad():
        return {loop: rows_of(sampler) for loop, sampler in loops.items()}


def _notes(program: Program) -> tuple[str, ...]:
    pieces, steps = program.pieces, program.spec.sampler.steps
    dense = max(program.dense_flops or graph_flops(program.denoiser) * steps, 1)
    loop = sum(graph_flops(piece.graph) for piece in pieces.loop.values()) * steps
    once = graph_flops(pieces.condition)
    batch = graph_flops(pieces.step) * steps if pieces.step is not None else 0
    table_bytes = sum(t.nbytes for t in pieces.tables.values())
    return (
        f"left in the loop: {loop / dense:.1%} of the dense FLOPs",
        f"once a call: {once / dense:.2%} (condition) and {batch / dense:.2%} (all {steps} steps in one batch)",
        f"{len(pieces.tables)} tables of {steps} rows, {table_bytes / 1e6:.2f} MB",
    )
