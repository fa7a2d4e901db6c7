"""Find the residual blocks of a denoiser by dataflow: no module name, attribute name or hint is read."""

import hashlib
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

from ttscompile.errors import NoResidualBlocksError, PassError
from ttscompile.ir.dataflow import between, dominators, reachable_from, reaching
from ttscompile.ir.flops import node_flops
from ttscompile.ir.graph import Graph, Node, Ref, TensorType
from ttscompile.ir.operations import Linear, operation
from ttscompile.ir.program import Block

_ADD = "aten.add.Tensor"
_SOFTMAX = "aten.softmax.int"
_ATTENTION = "aten.scaled_dot_product_attention.default"
_LEAST_SHARE = 0.5
"""Of the FLOPs of a step that the blocks have to hold; less than that could be saved otherwise."""


@dataclass(frozen=True)
class BlockTable:
    """The residual stream of a denoiser.

    Attributes:
        blocks: in the order of execution.
        declined: additions and other values that were looked at and are no block of their own, each with its reason.
    """

    blocks: tuple[Block, ...]
    declined: tuple[str, ...]

    @property
    def notes(self) -> tuple[str, ...]:
        """What ``--explain`` prints: the blocks, which of them share a FORWARD cache, and what was declined."""
        kinds, groups = dict.fromkeys(b.kind for b in self.blocks), Counter(b.group for b in self.blocks)
        alone = (b.index for b in self.blocks if groups[b.group] == 1)
        return (
            f"{_count(len(self.blocks), 'block')}: {', '.join(kinds)}",
            f"{len(self.blocks)} branches in {len(groups)} FORWARD groups",
            *(f"block {index} is alone in its group: FORWARD is its own TIMESTEP" for index in alone),
            *self.declined,
        )


class _Link(NamedTuple):
    """One addition ``result = stream + residual`` on the chain."""

    stream: str
    residual: str
    result: str


def _count(number: int, what: str) -> str:
    return f"{number} {what}{'s' * (number != 1)}"


def find_residual_blocks(graph: Graph, sample: str) -> BlockTable:
    """The chain of additions ``a_i = a_{i-1} + r_i`` through which everything goes from the sample to the output.

    ``a_{i-1}`` has to be a value that every path from the sample to the output crosses (a dominator), and ``r_i`` has
    to depend on it. Where the chain is broken between two dominators of the residual stream's type (a long skip, an
    added value that does not depend on it, a normalisation of itself), what lies between them is one coarse block,
    whose residual is the difference.

    Raises:
        NoResidualBlocksError: there is no such addition, and names the node at which the search ended; or what is
            outside the blocks and depends on the sample holds most of the work, as with a U-Net.
        PassError: the output does not depend on the sample.
    """
    # A split is no stream, whatever the type of its first part.
    several = {node.name for node in graph.nodes if len(node.types) > 1}
    points = [name for name in dominators(graph, [sample], graph.outputs) if name not in several]
    if sample not in points:
        raise PassError(f"the output does not depend on the sample %{sample}: there is no loop to compile.")
    loop = reachable_from(graph, [sample])
    links, declined = _links(graph, points, loop)
    if not links:
        end = graph.producers().get(points[-2] if len(points) > 1 else points[-1])
        where = f"%{end.name} = {end.op} ({end.place})" if end else f"%{points[-1]}"
        raise NoResidualBlocksError(
            "no residual block found: between the sample and the output no value a is updated as a + f(a)."
            f" The search walked {len(points)} dominators and ended at {where}."
            + "".join(f"\n  declined: {reason}" for reason in declined)
            + "\nIf the output is the sample times something plus more, EDMDenoiser and edm_table give finer blocks."
        )
    links = _main_stream(graph, links, declined)
    blocks = tuple(_chain(graph, points, links, declined, loop))
    share = _share(graph, blocks, loop)
    if share < _LEAST_SHARE:
        raise NoResidualBlocksError(
            f"what was found is a chain of {_count(len(blocks), 'block')}, which holds {share:.0%} of what is computed"
            f" at each step; expected {_LEAST_SHARE:.0%} or more, since the rest could not be reused."
        )
    return BlockTable(blocks, tuple(declined))


def _share(graph: Graph, blocks: Sequence[Block], loop: set[str]) -> float:
    """FLOPs of the blocks, over those of all that depends on the sample; 1 where nothing has any."""
    types = graph.types()
    inside = {n.name for b in blocks for n in between(graph, b.stream, b.residual or b.result)}
    work = {node.name: node_flops(node, types) for node in graph.nodes if node.name in loop}
    total = sum(work.values())
    return sum(work[name] for name in inside) / total if total else 1.0


def _links(graph: Graph, points: Sequence[str], loop: set[str]) -> tuple[list[_Link], list[str]]:
    types, on_path = graph.types(), set(points)
    links, declined = [], []
    for node in graph.nodes:
        if node.op != _ADD or node.name not in loop:
            continue
        operands = [a.name for a in node.args if isinstance(a, Ref)]
        where = f"%{node.name} ({node.place})"
        streams = [o for o in operands if o in on_path and types[o] == node.type]
        if node.name not in on_path:
            if any(types[o] == node.type and o in loop for o in operands) and len(set(operands) & loop) == 2:
                declined.append(f"{where}: another path to the output goes around it")
            continue
        if not streams:
            declined.append(f"{where}: no operand carries the residual stream with the shape of the sum, {node.type}")
            continue
        stream = streams[0]
        others = [o for o in operands if o != stream]
        if len(others) != 1:
            declined.append(f"{where}: it adds a value to itself")
        elif others[0] not in loop:
            declined.append(f"{where}: the added %{others[0]} does not depend on the residual stream")
        elif dict(node.kwargs).get("alpha", 1) != 1:
            declined.append(f"{where}: it adds with a factor alpha")
        elif types[others[0]] != node.type:
            declined.append(f"{where}: the added {types[others[0]]} is broadcast to {node.type}")
        else:
            links.append(_Link(stream, others[0], node.name))
    return links, declined


def _main_stream(graph: Graph, links: list[_Link], declined: list[str]) -> list[_Link]:
    """Keep the links of the type that carries most FLOPs: an embedding may have residuals of its own."""
    types = graph.types()
    work: Counter[TensorType] = Counter()
    for link in links:
        work[types[link.result]] += 1 + sum(node_flops(n, types) for n in between(graph, link.stream, link.residual))
    main = work.most_common(1)[0][0]
    others = [link.result for link in links if types[link.result] != main]
    declined += [f"%{result}: a residual of {types[result]}, beside the main stream of {main}" for result in others]
    return [link for link in links if types[link.result] == main]


def _chain(graph: Graph, points: Sequence[str], links: list[_Link], declined: list[str], loop: set[str]) -> list[Block]:
    """Blocks from links, with coarse blocks over what lies between and around them.

    Blocks of one kind are one FORWARD group. The residual of a coarse block also holds what happens to the residual
    stream before the addition, so it is of another kind.
    """
    types = graph.types()
    stream_type = types[links[0].result]
    of_type = [name for name in points if types[name] == stream_type]
    blocks: list[Block] = []
    groups: dict[tuple[str, bool], int] = {}

    def add(stream: str, result: str, residual: str | None, reason: str = "", hides: bool = False) -> None:
        nodes = between(graph, stream, residual if residual is not None else result)
        kind = _kind(graph, nodes, stream, hides, loop)
        group = groups.setdefault((kind, residual is None), len(groups))
        blocks.append(Block(len(blocks), kind, stream, result, residual, stream_type, group, reason))

    cursor = links[0].stream
    early, late = of_type[0], of_type[-1]
    if early != cursor and _hides_residuals(graph, early, cursor, stream_type):
        add(early, cursor, None, "the chain starts late: a skip connection goes around the additions before it", True)
    for link in links:
        if link.stream == cursor:
            add(cursor, link.result, link.residual)
        else:
            first, *others = between(graph, cursor, link.stream)
            more = f" and {len(others)} more" if others else ""
            what = f"%{first.name} = {first.op} ({first.place}){more}"
            hides = _hides_residuals(graph, cursor, link.stream, stream_type)
            add(cursor, link.result, None, f"the residual stream is changed by {what} before the addition", hides)
            declined.append(f"%{link.result}: merged with what comes before it; {blocks[-1].reason}")
        cursor = link.result
    if late != cursor and _hides_residuals(graph, cursor, late, stream_type):
        add(cursor, late, None, "the chain ends early: a skip connection goes around the additions after it", True)
    return blocks


def _hides_residuals(graph: Graph, start: str, stop: str, stream_type: TensorType) -> bool:
    """Whether two values of the residual stream's type, from ``start`` on, are added or joined before ``stop``."""
    inside = between(graph, start, stop)
    names = {n.name for n in inside} | {start}
    types = graph.types()
    return any(
        node.op in (_ADD, "aten.cat.default")
        and sum(types[o] == stream_type and o in names for o in dict.fromkeys(node.refs())) >= 2
        for node in inside
    )


def _kind(graph: Graph, nodes: Sequence[Node], stream: str, hides: bool, loop: set[str]) -> str:
    """``self_attention``, ``cross_attention``, ``feed_forward``, ``network``, or a signature of the structure.

    ``nodes`` are the block's, into which ``stream`` flows; it may be a coarse one that ``hides`` several residuals. One
    of another structure that holds all that is computed in the ``loop`` is the network.
    """
    types, producers = graph.types(), graph.producers()
    inside = {n.name for n in nodes} | {stream}
    attentions = []
    around: set[str] = set()
    for node in nodes:
        if node.op not in (_ATTENTION, _SOFTMAX):
            continue
        around |= _around(graph, types, node)
        keys = list(node.refs())[1:2] if node.op == _ATTENTION else _key_operands(producers, node)
        attentions.append("self_attention" if any(k in inside for k in keys) else "cross_attention")
    contractions = [n.name for n in nodes if node_flops(n, types) > 0]
    convolves = any(_convolves(n, types) for n in nodes)
    if len(attentions) == 1 and not convolves and not hides:
        # What computes beside the attention, neither before it nor after, is the other branch of a parallel block.
        return attentions[0] if around.issuperset(contractions) else f"{attentions[0]}+feed_forward"
    if not attentions and contractions and not convolves and not hides:
        return "feed_forward"
    if contractions and all(n.name in contractions for n in graph.nodes if n.name in loop and node_flops(n, types) > 0):
        return "network"
    signature = hashlib.sha256("|".join(n.op for n in nodes).encode()).hexdigest()[:8]
    shape = f"{len(attentions)}attention_" if attentions else ""
    return f"{shape}{len(nodes)}ops_{signature}"


def _around(graph: Graph, types: dict[str, TensorType], attention: Node) -> set[str]:
    """What is before or after an attention, of which a softmax alone is followed by the product with the values."""
    after = reachable_from(graph, [attention.name])
    products = [n.name for n in graph.nodes if n.name in after and node_flops(n, types) > 0]
    product = attention.name if attention.op == _ATTENTION or not products else products[0]
    return reaching(graph, [product]) | reachable_from(graph, [product])


def _convolves(node: Node, types: dict[str, TensorType]) -> bool:
    """Whether a node mixes neighbours; a pointwise convolution is a linear layer of the channels."""
    if not operation(node.op).name.startswith("conv"):
        return False
    weight = node.args[1]
    return not isinstance(weight, Ref) or any(size != 1 for size in types[weight.name].shape[2:])


def _key_operands(producers: dict[str, Node], softmax: Node) -> list[str]:
    """Second operand of the product of queries and keys above a softmax, through scaling, masking and views."""
    pending = [a.name for a in softmax.args[:1] if isinstance(a, Ref)]
    while pending:
        node = producers.get(pending.pop())
        if node is None:
            continue
        row = operation(node.op)
        if row.linear is Linear.IN_EACH and row.flops is not None:
            return list(node.refs())[-1:]
        pending.extend(node.refs())
    return []
