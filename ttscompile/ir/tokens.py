"""The tokens of a vision transformer, and those of a scene's sequence: which values have a row for each of them."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import torch

from ..core.coercion import Arrays
from .dataflow import reachable_from
from .evaluate import drawn, evaluator
from .flops import graph_flops, node_flops
from .graph import Argument, Graph, Node, Ref, TensorType, backward_slice
from .operations import Movement, axis_after, joined_axis, operation

LEAST_TOKENS = 16
"""Of a tower: with fewer there is hardly a part of them to compute."""
MOST_WHOLE = 0.25
"""Share of a tower's FLOPs that may be spent on what is computed for every new frame, whatever changed in it."""
ATTENTION = "aten.scaled_dot_product_attention.default"
_CONVOLUTION, _CAT = "aten.conv2d.default", "aten.cat.default"
_PRODUCTS = ("aten.matmul.default", "aten.bmm.default")


@dataclass(frozen=True)
class TokenStream:
    """The tokens of a tower, or of a scene.

    Attributes:
        pixels: the value that patches are cut from, ``[B, C, H, W]``; of a scene ``entry``.
        entry: the first value with a row for each token, ``[B, T, D]``.
        tokens: T.
        fixed: how many tokens, the first ones, are of no patch.
        axes: by value that has a row for each token, from ``entry`` on: in which axis.
    """

    pixels: str
    entry: str
    tokens: int
    fixed: int
    axes: Mapping[str, int]


def find_tokens(tower: Graph, weights: Arrays) -> TokenStream | str:
    """The tokens of a tower; or why and where it is none that reads a picture patch by patch."""
    types, observed = tower.types(), reachable_from(tower, tower.inputs)
    patches = [n for n in tower.nodes if n.name in observed and n.op.startswith("aten.conv")]
    if len(tower.inputs) != 1 or not patches:
        return "it cuts no picture into patches"
    first, *others = patches
    if others:
        return f"it is convolutional: %{others[0].name} convolves features"
    if (wrong := _not_patches(first, types)) is not None:
        return f"%{first.name} cuts no patches: {wrong}"
    (pixels, *_) = first.refs()
    if set(backward_slice(tower, tower.outputs, {pixels: types[pixels]}).inputs) != {pixels}:
        return f"what it gives depends on more than the patches of %{pixels}"
    entry = _entry(tower, first.name)
    if entry is None:
        return f"no value holds what the patches of %{first.name} give, and all that follows from them"
    if set(backward_slice(tower, tower.outputs, {entry: types[entry]}).inputs) != {entry}:
        return f"what it gives depends on more than %{entry}"
    placed = _patches_of(tower, pixels, entry, weights)
    shape = types[first.name].shape
    fixed = len(placed) - shape[2] * shape[3] if isinstance(shape[2], int) and isinstance(shape[3], int) else 0
    if fixed < 0 or placed != [-1] * fixed + list(range(len(placed) - fixed)):
        return f"%{entry} has not a row for each patch, in their order"
    if len(placed) < LEAST_TOKENS:
        return f"%{entry} has {len(placed)} tokens, fewer than {LEAST_TOKENS}"
    stream = TokenStream(pixels, entry, len(placed), fixed, _axes(tower, entry, len(placed)))
    return _too_much(tower, stream, "cutting patches up to") or stream


def _too_much(graph: Graph, stream: TokenStream, before: str) -> str | None:
    """Why more than ``MOST_WHOLE`` is computed whatever changed; ``before`` says what comes before the entry."""
    types, total, behind = graph.types(), graph_flops(graph), reachable_from(graph, {stream.entry})
    whole = [node for node in graph.nodes if node.name not in stream.axes]
    entering = sum(node_flops(node, types) for node in whole if node.name not in behind)
    if entering > MOST_WHOLE * total:
        return f"{before} %{stream.entry} is {entering / total:.0%} of its FLOPs"
    if sum(node_flops(node, types) for node in whole) > MOST_WHOLE * total:
        where = next(node for node in whole if stream.axes.keys() & set(node.refs()))
        return f"at %{where.name} ({where.op}) tokens come together otherwise than by attention"
    return None


def find_sequence(scene: Graph) -> TokenStream | str:
    """The tokens that a scene puts one after the other, as a language model reads them; or why there are none."""
    told, types = "nothing puts what towers give, and words, one after the other", scene.types()
    for node in scene.nodes:
        tokens = node.type.shape[1] if len(node.type.shape) == 3 else None
        real = node.op == _CAT and node.type.dtype.startswith("float")
        if not real or joined_axis(node) != 1 or not isinstance(tokens, int):
            continue
        entry = node.name
        stream = TokenStream(entry, entry, tokens, 0, _axes(scene, entry, tokens))
        behind = reachable_from(scene, {entry})
        others = tuple(name for name in scene.outputs if name not in behind)
        cut, own = backward_slice(scene, scene.outputs, {entry: types[entry]}), backward_slice(scene, (entry,), {})
        read = {n: type_ for n, type_ in cut.inputs.items() if n not in {entry, *own.inputs}}
        read |= backward_slice(scene, others, {}).inputs
        beside = [name for name, type_ in read.items() if type_.dtype.startswith("float")]
        if tokens < LEAST_TOKENS:
            told = f"%{entry} has {tokens} tokens, fewer than {LEAST_TOKENS}"
        elif beside:
            told = f"what it gives depends on %{beside[0]} otherwise than by %{entry}"
        elif (much := _too_much(scene, stream, "what makes")) is not None:
            told = much
        else:
            return stream
    return told


def words_of(sequence: Graph, weights: Arrays) -> tuple[int, ...]:
    """The rows of what a graph gives, ``[B, 1, T, D]``, that no picture changes; found on numbers."""
    run, rng = evaluator(sequence, weights), np.random.default_rng(0)
    given = {name: drawn(type_, 1, rng) for name, type_ in sequence.inputs.items()}
    others = {name: drawn(type_, 1, rng) for name, type_ in sequence.inputs.items() if given[name].is_floating_point()}
    with torch.no_grad():
        one, other = run(given)[0], run({**given, **others})[0]
    return tuple((one == other).all(-1).flatten().nonzero().ravel().tolist())


def read_whole(node: Node, axes: Mapping[str, int]) -> tuple[int, ...]:
    """The places of the arguments of a node of which each token reads all rows, as of keys and values."""
    if node.op == ATTENTION:
        return (1, 2)
    second = node.args[1] if node.op in _PRODUCTS else None  # attention may be written out
    return (1,) if isinstance(second, Ref) and second.name in axes else ()


def _not_patches(node: Node, types: Mapping[str, TensorType]) -> str | None:
    """Why a convolution does not see each pixel once at most; None if it does."""
    defaults: tuple[Argument, ...] = (None, (1, 1), (0, 0), (1, 1), 1)
    weight, _, stride, padding, dilation, groups = (*node.args[1:], *defaults[len(node.args) - 2 :])
    if node.op != _CONVOLUTION or not isinstance(weight, Ref) or weight.name not in types:
        return f"it is {node.op}"
    kernel = types[weight.name].shape[2:]
    if (stride, padding, dilation, groups) != (kernel, (0, 0), (1, 1), 1):
        return f"kernel {list(kernel)}, stride {stride}, padding {padding}, dilation {dilation}, groups {groups}"
    return None


def _entry(tower: Graph, patches: str) -> str | None:
    """The one value through which all goes that moving and element-wise work makes of the patches."""
    free, observed = {patches}, reachable_from(tower, {patches})
    for node in tower.nodes:
        read, row = observed & set(node.refs()), operation(node.op)
        joins = row.name in ("pad", "constant_pad_nd", "cat", "stack")
        if read and read <= free and len(node.types) == 1 and (row.movement or row.elementwise or joins):
            free.add(node.name)
    users = tower.users()
    left = [name for name in free if any(user.name not in free for user in users[name])]
    if len(left) > 1:  # it is read both as it is and squared, say: what has one reader leads to where they part
        left = [patches]
        while len(users[left[0]]) == 1 and users[left[0]][0].name in free:
            left = [users[left[0]][0].name]
    return left[0] if len(left) == 1 and not free & set(tower.outputs) else None


def _patches_of(tower: Graph, pixels: str, entry: str, weights: Arrays) -> list[int]:
    """Of each row of ``entry`` the number of the one patch that changes it; -1 of none, -2 of several or half a row."""
    types = tower.types()
    graph = backward_slice(tower, (entry,), {pixels: types[pixels]})
    run, rng = evaluator(graph, weights), np.random.default_rng(0)
    node = next(n for n in graph.nodes if n.op == _CONVOLUTION)
    _, _, rows, columns = node.type.at(1)
    _, weight = list(node.refs())[:2]
    kernel = types[weight].at(1)[2:]
    before = torch.from_numpy(rng.standard_normal(types[pixels].at(1), dtype=np.float32))
    numbers = torch.arange(rows * columns).reshape(rows, columns)
    if len(types[entry].shape) != 3:
        return []

    def changed(which: torch.Tensor) -> torch.Tensor:
        """Which rows change with these patches."""
        after, mask = before.clone(), which.repeat_interleave(kernel[0], 0).repeat_interleave(kernel[1], 1)
        part = after[..., : mask.shape[0], : mask.shape[1]]
        part[..., mask] = part[..., mask] + 1.0 + torch.rand(part[..., mask].shape, generator=random)
        with torch.no_grad():
            return (run({pixels: after})[0] != run({pixels: before})[0]).any(-1)[0]

    random = torch.Generator().manual_seed(0)
    found = torch.zeros(types[entry].at(1)[1], dtype=torch.int64)
    several, ever = torch.zeros_like(found, dtype=torch.bool), changed(torch.ones_like(numbers, dtype=torch.bool))
    for bit in range(max(1, (rows * columns - 1).bit_length())):
        chosen = (numbers >> bit & 1).bool()
        one, other = changed(chosen), changed(~chosen)
        found += one.long() << bit
        several |= ever & ~(one ^ other)
    return torch.where(several, -2, torch.where(ever, found, -1)).tolist()


def _axes(tower: Graph, entry: str, tokens: int) -> dict[str, int]:
    """In which axis each value has a row for each token; those that have not are left out."""
    types, observed, axes = tower.types(), reachable_from(tower, {entry}), {entry: 1}
    for node in tower.nodes:
        read = [name for name in node.refs() if name in observed]
        if node.name == entry or not read or not axes.keys() >= set(read):
            continue
        axis = _axis_after(node, read, axes, types)
        if axis is not None and axis >= 0 and all(type_.shape[axis : axis + 1] == (tokens,) for type_ in node.types):
            axes[node.name] = axis
    return axes


def _axis_after(node: Node, read: list[str], axes: Mapping[str, int], types: Mapping[str, TensorType]) -> int | None:
    """The axis of tokens in what a node gives; None if it brings tokens together, or nobody knows."""
    result = node.type.shape
    if node.op == ATTENTION:
        # A mask does not depend on what tokens hold: nothing that it is made of is read.
        plain = len(read) == 3 and all(value in (None, 0.0, False) for value in node.args[4:])
        inner = all(axes[name] == len(types[name].shape) - 2 for name in read)
        known = {name for name, _ in node.kwargs} <= {"scale"}
        return len(result) - 2 if plain and inner and known else None
    if read_whole(node, axes):  # a row for each row of the first factor, whatever the second one is
        first = next(iter(node.refs()))
        return axes[first] if axes.get(first) == len(types[first].shape) - 2 else None
    behind = {len(types[name].shape) - axes[name] for name in read}
    if operation(node.op).elementwise:
        return len(result) - behind.pop() if len(behind) == 1 else None
    if node.op == _CAT:  # of channels, as where the halves of rotated queries are put beside each other
        axis = axes[read[0]]
        return axis if joined_axis(node) != axis and len(behind) == 1 and read == list(node.refs()) else None
    if operation(node.op).movement is Movement.REPEAT:  # not along the axis: there would be more tokens
        return len(result) - behind.pop()
    # The token's own row is to be the first factor, and nothing else.
    return axis_after(node, axes[read[0]], types) if read == list(node.refs())[:1] else None
