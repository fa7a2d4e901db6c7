"""Work that depends on one frame alone, one image of one camera or the instruction; and on all of these together."""

import math
from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace

import numpy as np
import torch

from ttscompile.core.coercion import Arrays
from ttscompile.core.spec import COMMITTED, ObservationSpec
from ttscompile.ir.dataflow import reachable_from
from ttscompile.ir.evaluate import drawn, evaluator
from ttscompile.ir.flops import graph_flops, node_flops, once_flops
from ttscompile.ir.graph import Batch, Graph, Node, Ref, TensorType, backward_slice, copied, reshaped
from ttscompile.ir.operations import Movement, operation
from ttscompile.ir.program import Program

from .base import Pass, PassResult

LEAST_FLOPS = 5_000_000
"""Of a tower, for one row. With less it costs about as much to see whether a row is new as to compute it."""
MOST_BEFORE = 0.25
"""What is computed before the rows are there is computed at every call: this share of the tower's FLOPs at most."""
LEAST_SHARE = 0.1
"""Of the scene, of all that is computed before the loop, but for step values."""
_FRAME = ".frame"
_CLOSE = 1e-3
"""Share of a tower's largest number by which batches of one and of two rows may differ: rounding is below it."""


class SplitFrames(Pass[Program, Program]):
    """Take what depends on one frame alone out of the condition graph, as a piece that runs once a frame.

    Before::

        %rows     : [2*B, 3, H, W] = aten.reshape.default(%camera, ...)     # camera [B, 2, 3, H, W]
        %features : [2*B, 512]     = resnet(%rows)
        %obs      : [B, 1024]      = aten.reshape.default(%features, ...)

    After::

        frames    : %rows = aten.reshape.default(%camera, ...)
        frame_00  : %features.frame : [B, 512] = resnet(%rows : [B, 3, H, W])   # of any number of rows
        condition : %obs = aten.reshape.default(%features.frame : [2*B, 512], ...)

    A graph holds for any batch size and keeps its streams apart. So a part of it that speaks of ``m * B`` rows alone,
    never of B, holds for any number of rows and keeps these apart: it cannot know which of them are of one stream.
    Towers of one form with the same weights, as where one encoder looks at several cameras in turn, are one.

    What no number of the robot's reaches, all cameras and the instruction together, is the *scene*: most of what a
    vision-language model does, where its state is read by the action expert alone::

        scene     : %keys = language_model(%features.frame, %tokens)
        condition : %state.token = linear(%state)

    Args:
        least_flops: of a tower, for one row, or of the scene, for one stream; what costs less stays where it is.
    """

    def __init__(self, least_flops: int = LEAST_FLOPS) -> None:
        self._least = least_flops

    def call(self, program: Program) -> PassResult[Program]:
        graph, found = program.pieces.condition, list[_Tower]()
        if program.pieces.towers or program.pieces.scene:
            return PassResult(program)
        observations, declined = program.spec.observations, dict[str, str]()
        lengths = {key: spec.frames or 1 for key, spec in observations.items()}
        alone = {key for key, spec in observations.items() if _is_frame(spec)}
        while (tower := _largest(graph, found, alone, declined)) is not None:
            if tower.flops < self._least * tower.rows:
                break
            if _one_frame_a_row(graph, tower, lengths, program.weights):
                found.append(tower)
            else:
                declined[tower.entries[0]] = f"%{tower.entries[0]} is left: its rows are made of several frames"
        program, told = self._with_towers(program, found) if found else (program, ())
        program, scene = self._with_scene(program)
        return PassResult(program, (*told, *declined.values(), *scene))

    def _with_towers(self, program: Program, found: "list[_Tower]") -> tuple[Program, tuple[str, ...]]:
        """The program with towers of their own, and notes."""
        graph = program.pieces.condition
        order = {node.name: i for i, node in enumerate(graph.nodes)}
        alike: dict[tuple[int, str], list[_Tower]] = {}  # what does the same with the same weights, together
        for tower in sorted(found, key=lambda one: order[one.entries[0]]):
            own = (*tower.graph.inputs, *tower.graph.producers())  # names of values; weights keep theirs
            form = str(tower.graph.renamed({name: f"%{i}" for i, name in enumerate(own)}))
            alike.setdefault((tower.rows, form), []).append(tower)
        groups = list(alike.values())
        for group in groups:
            _require_apart(self, group[0].graph, program.weights)
        frames, condition = _rows_graph(graph, groups), _rest(graph, groups)
        called = (dict(zip(group[0].entries, _together(group), strict=True)) for group in groups)
        towers = tuple(group[0].graph.renamed(names) for group, names in zip(groups, called, strict=True))
        pieces = replace(program.pieces, frames=frames, condition=condition, towers=towers)
        return replace(program, pieces=pieces), tuple(map(_note, groups))

    def _with_scene(self, program: Program) -> tuple[Program, tuple[str, ...]]:
        """The program with a scene, where it is worth while, and notes."""
        pieces, whole = program.pieces, once_flops(program.pieces)
        late = {key for key, spec in program.spec.observations.items() if spec.numbers}
        changing = [key for key in pieces.condition.inputs if key == COMMITTED or key in late]
        scene, rest = _parted(pieces.condition, changing)
        flops, left, least = graph_flops(scene), graph_flops(rest), max(self._least, LEAST_SHARE * whole)
        told = f"{left / 1e6:.1f} MFLOP in every call, since they read {' and '.join(f'%{key}' for key in changing)}"
        if flops < least:
            return program, (told,) * (left >= least and len(late) < len(program.spec.observations))
        if pieces.frames is not None and (apart := _beside(pieces.frames, program.weights)):
            return program, (f"the scene is left: rows %{apart[0]} are not one stream after the other",)
        told = f"{flops / whole:.0%} of what is known before the loop, {flops / 1e6:.1f} MFLOP, once a scene"
        return replace(program, pieces=replace(pieces, scene=scene, condition=rest)), (told,)

    def ensures(self, program: Program) -> None:
        """A tower reads rows and nothing else, and gives a value a row."""
        for tower in program.pieces.towers:
            types = tower.types()
            for name in (*tower.inputs, *tower.outputs):
                if types[name].shape[:1] != (Batch(),):
                    raise self.fail(f"%{name} : {types[name]} of a tower has no rows.")


@dataclass(frozen=True)
class _Tower:
    """A part of the condition graph.

    Attributes:
        entries: the values whose rows it works on: one, or those of the instruction.
        rows: m, how many rows a stream has.
        taken: names of its nodes, and of those that make the rows.
        exits: values that others read.
        graph: of any number of rows.
        flops: for the m rows of a stream.
    """

    entries: tuple[str, ...]
    rows: int
    taken: frozenset[str]
    exits: tuple[str, ...]
    graph: Graph
    flops: int


def _is_frame(spec: ObservationSpec) -> bool:
    """Whether an observation is one picture, or an instruction: what may well be the same in the next call."""
    return (spec.frames or 1) == 1 and (len(spec.one_frame.shape) >= 3 or not spec.dtype.startswith("float"))


def _parted(graph: Graph, changing: Collection[str]) -> tuple[Graph, Graph]:
    """What none of these inputs reaches, giving values with one axis of streams; and the rest, which reads them.

    Pictures that are handed on as they are stay in the rest: they are no reason to compute a scene again.
    """
    still, types, users = tuple(name for name in graph.inputs if name not in changing), graph.types(), graph.users()
    shown = {name for name in still if len(types[name].shape) > 3 and not name.endswith(_FRAME)}
    copies = {n.name for n in graph.nodes if {*n.refs()} <= shown and operation(n.op).movement and not users[n.name]}
    exits = _following(graph, still, 1, reachable_from(graph, graph.inputs), {*changing, *copies})
    scene = backward_slice(graph, exits, {})
    outputs = tuple(name for name in graph.outputs if name not in exits)
    rest = backward_slice(graph, outputs, {name: types[name] for name in exits})
    left = {name: graph.inputs[name] for name in changing} or graph.inputs  # a piece has an input
    return scene, replace(rest, inputs={**left, **rest.inputs})


def _largest(
    graph: Graph, found: Collection[_Tower], frames: Collection[str], declined: Collection[str]
) -> _Tower | None:
    """The tower with the most FLOPs among what is in no other."""
    taken = {name for tower in found for name in tower.taken}
    observed, starts = reachable_from(graph, graph.inputs), list[tuple[str, ...]]()
    types = graph.types()
    alone = {key: types[key] for key in graph.inputs if key in frames}
    for node in graph.nodes:
        if node.name in observed and node.name not in {*taken, *declined} and _begins(node, types, alone):
            starts.append((node.name,))
    # An instruction is several observations: tokens, and which of them count.
    told = tuple(name for (name,) in starts if not types[name].dtype.startswith("float") and _rows(types, name) == 1)
    towers = [_grow(graph, entries, observed, taken) for entries in (*starts, *[told] * (len(told) > 1))]
    return max((tower for tower in towers if tower is not None), key=lambda one: one.flops, default=None)


def _rows(types: Mapping[str, TensorType], name: str) -> int:
    """How many rows a stream has in a value that a tower begins with."""
    size = types[name].shape[0]
    assert isinstance(size, Batch)
    return size.multiple


def _begins(node: Node, types: Mapping[str, TensorType], alone: Mapping[str, TensorType]) -> bool:
    """Whether a tower may begin with a value.

    It may with an observation itself, if it is among those ``alone``, which are single frames; with such a picture
    without its axis of frames; and with what first has the rows of several frames in one axis.
    """
    size = node.type.shape[0] if len(node.types) == 1 and node.type.shape else None
    if not isinstance(size, Batch) or any(isinstance(n, Batch) for n in node.type.shape[1:]):
        return False
    if size.multiple == 1:
        read = [alone.get(name) for name in node.refs()]
        numbers = [None if one is None else math.prod(one.at(1)) for one in read]
        moves = operation(node.op).movement is not None and node.type.dtype.startswith("float")
        return read == [node.type] or (moves and numbers == [math.prod(node.type.at(1))])
    mixed = any(n.multiple % size.multiple for name in node.refs() for n in types[name].shape if isinstance(n, Batch))
    return mixed and operation(node.op).movement is Movement.RESHAPE


def _grow(graph: Graph, entries: tuple[str, ...], observed: Collection[str], taken: Collection[str]) -> _Tower | None:
    """All that follows from these rows alone; None if that is nothing."""
    types = graph.types()
    rows = _rows(types, entries[0])
    exits = _following(graph, entries, rows, observed, taken)
    own = backward_slice(graph, exits, {name: types[name] for name in entries})
    before = backward_slice(graph, entries, {})
    flops, spent = (sum(node_flops(node, types) for node in part.nodes) for part in (own, before))
    if not exits or set(own.inputs) != set(entries) or spent > MOST_BEFORE * flops:
        return None
    names = frozenset(node.name for node in (*own.nodes, *before.nodes) if node.name in observed)
    return _Tower(entries, rows, names, exits, _of_rows(own, rows, exits), flops)


def _following(
    graph: Graph, entries: tuple[str, ...], rows: int, observed: Collection[str], taken: Collection[str]
) -> tuple[str, ...]:
    """Of all that follows from some values alone, those that others read, which have a row for each of theirs."""
    users, banned = graph.users(), set(taken)
    while True:
        inside, free = set(entries), set(graph.constants)
        for node in graph.nodes:
            sizes = (*node.leaves(), *(size for type_ in node.types for size in type_.shape))
            read, fits = set(node.refs()), all(n.multiple % rows == 0 for n in sizes if isinstance(n, Batch))
            if node.name not in observed and read <= free and fits:
                free.add(node.name)
            elif node.name not in banned and read & inside and read <= inside | free and fits:
                inside.add(node.name)
        inside.difference_update(entries)
        read_outside = {name for name in inside if any(user.name not in inside for user in users[name])}
        leaving = inside & {*read_outside, *graph.outputs}
        exits = tuple(node.name for node in graph.nodes if node.name in leaving)
        bad = [name for name in exits if not _is_exit(graph, name, rows)]
        if not bad:
            return exits
        banned.update(bad)


def _is_exit(graph: Graph, name: str, rows: int) -> bool:
    """Whether a value has a row for each row."""
    node = graph.producers()[name]
    axes = [axis for axis, size in enumerate(node.type.shape) if isinstance(size, Batch)]
    return len(node.types) == 1 and axes == [0] and node.type.shape[0] == Batch(rows)


def _crossing(name: str) -> str:
    return f"{name}{_FRAME}"


def _of_rows(graph: Graph, rows: int, exits: Collection[str]) -> Graph:
    """The graph of one row for each that ``rows * B`` stand for."""

    def size(batch: Batch) -> Batch:
        return Batch(batch.multiple // rows)

    nodes = tuple(node.resized(size) for node in graph.nodes)
    types = {node.name: node.type for node in nodes}
    out = tuple(copied(_crossing(n), n, types[n]) for n in exits)
    inputs = {name: type_.resized(size) for name, type_ in graph.inputs.items()}
    return Graph(inputs, graph.constants, (*nodes, *out), tuple(map(_crossing, exits)))


def _together(group: list[_Tower]) -> tuple[str, ...]:
    """Names of the rows of towers that are alike, one for each entry."""
    return group[0].entries if len(group) == 1 else tuple(f"{entry}.all" for entry in group[0].entries)


def _rows_graph(graph: Graph, groups: list[list[_Tower]]) -> Graph:
    """Observations to the rows of each tower: stream by stream, those of towers that are alike one after the other."""
    entries = tuple(entry for group in groups for tower in group for entry in tower.entries)
    own, types = backward_slice(graph, entries, {}), graph.types()
    nodes = list(own.nodes)
    for group in groups:
        for place, (entry, name) in enumerate(zip(group[0].entries, _together(group), strict=True)):
            if name != entry:
                (_, *row), m, parts = types[entry].shape, group[0].rows, list[Ref]()
                for one in (tower.entries[place] for tower in group):
                    kind, part = replace(types[entry], shape=(Batch(), m, *row)), f"{one}.of_stream"
                    nodes.append(reshaped(part, one, kind))
                    parts.append(Ref(part))
                kind, whole = replace(kind, shape=(Batch(), len(group) * m, *row)), f"{name}.of_stream"
                nodes.append(Node(whole, "aten.cat.default", (tuple(parts), 1), (), (kind,)))
                nodes.append(reshaped(name, whole, replace(kind, shape=(Batch(len(group) * m), *row))))
    observed = {name: kind for name, kind in graph.inputs.items() if name != COMMITTED}
    return Graph(observed, own.constants, tuple(nodes), tuple(name for g in groups for name in _together(g)))


def _rest(graph: Graph, groups: list[list[_Tower]]) -> Graph:
    types, inputs, nodes = graph.types(), dict(graph.inputs), list[Node]()
    for group in groups:
        first, count = group[0], len(group)
        for place, name in enumerate(first.exits):
            kind, crossing = types[name], _crossing(name)
            inputs[crossing] = kind.with_axis(0, Batch(count * first.rows))
            if count == 1:
                nodes.append(copied(name, crossing, kind))
                continue
            apart, own = f"{crossing}.apart", kind.with_axis(0, Batch(), first.rows)
            nodes.append(reshaped(apart, crossing, kind.with_axis(0, Batch(), count, first.rows)))
            for i, name in enumerate(tower.exits[place] for tower in group):
                part = f"{name}.of_stream"
                nodes.append(Node(part, "aten.select.int", (Ref(apart), 1, i), (), (own,)))
                nodes.append(reshaped(name, part, kind))
    made = {node.name for node in nodes}
    whole = replace(graph, inputs=inputs, nodes=(*nodes, *(n for n in graph.nodes if n.name not in made)))
    return replace(backward_slice(whole, graph.outputs, {}), inputs=inputs)


def _one_frame_a_row(graph: Graph, tower: _Tower, lengths: Mapping[str, int], weights: Arrays) -> bool:
    """Whether another frame of an observation changes no row that a third one changes."""
    if tower.rows == 1:
        return True
    before, rng = backward_slice(graph, tower.entries, {}), np.random.default_rng(0)
    run = evaluator(before, weights)
    obs = {name: drawn(type_, 1, rng) for name, type_ in before.inputs.items()}
    with torch.no_grad():
        (rows,) = run(obs)
        changes = torch.zeros(len(rows))
        for key, value in obs.items():
            for frame in range(lengths[key]):
                other = value.clone()
                other[:, frame] = drawn(before.inputs[key], 1, rng)[:, frame]
                changes += (run({**obs, key: other})[0] != rows).flatten(1).any(1)
    return bool((changes <= 1).all())


def _require_apart(each: SplitFrames, tower: Graph, weights: Arrays) -> None:
    """Raise unless a row gives the same beside another and alone."""
    for output in _beside(tower, weights):
        raise each.fail(f"%{output} of a row depends on the other rows.")


def _beside(graph: Graph, weights: Arrays) -> list[str]:
    """The outputs whose second half, for two rows or streams, is not what the second one gives alone."""
    run, rng = evaluator(graph, weights), np.random.default_rng(0)
    rows = {name: drawn(type_, 2, rng) for name, type_ in graph.inputs.items()}
    with torch.no_grad():
        both, alone = run(rows), run({name: value[len(value) // 2 :] for name, value in rows.items()})
    wrong = list[str]()
    for output, one, other in zip(graph.outputs, both, alone, strict=True):
        here, there = one[len(other) :].double(), other.double()
        if not torch.allclose(here, there, rtol=0, atol=_CLOSE * float(there.abs().max()), equal_nan=True):
            wrong.append(output)
    return wrong


def _note(group: list[_Tower]) -> str:
    count, first = len(group) * group[0].rows, group[0]
    names = ", ".join(f"%{entry}" for tower in group for entry in tower.entries)
    return f"of {names}: {count} rows a call, {first.flops / first.rows / 1e6:.1f} MFLOP each, once a frame"
