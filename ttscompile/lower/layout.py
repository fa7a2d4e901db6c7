"""Move reshapes and transpositions out of the way of arithmetic, so that a small graph is mostly arithmetic.

Attention modules are written with the batch in the middle, heads folded into the batch, and so on: twenty
operations that only move data, around four that compute. Each costs about as much as a normalisation when the tensors
are 16 x 256. Moving operations are not executed where they stand; they are remembered as a description of the value
(which factors of which computed value, in which order), composed, and executed where an operation needs the result.
Token-wise operations do not: a linear layer of transposed tokens is the transposed linear layer.

Before::

    %t : [16, B, 256] = aten.transpose.int(%h, 1, 0)
    %l : [16, B, 64]  = aten.linear.default(%t, %w, %b)
    %y : [B, 16, 64]  = aten.transpose.int(%l, 1, 0)

After (two dimensions, as a matrix product wants them)::

    %r : [16*B, 256]  = aten.reshape.default(%h, [16*B, 256])
    %l : [16*B, 64]   = aten.linear.default(%r, %w, %b)
    %y : [B, 16, 64]  = aten.reshape.default(%l, [B, 16, 64])
"""

from collections import deque
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

from ..ir.graph import Argument, Batch, Graph, Node, Ref, Size, TensorType, copied
from ..ir.operations import Movement, operation, permutation


@dataclass(frozen=True)
class _Atom:
    """A factor of a size; two atoms are the same if they are the same object's number."""

    number: int
    size: Size


@dataclass(frozen=True)
class _View:
    """A value as a rearrangement of a computed one."""

    base: str  # the computed value
    order: tuple[_Atom, ...]  # its factors in memory order; none of size 1
    dims: tuple[tuple[_Atom, ...], ...]  # the factors of each of this value's axes, outermost first
    picks: tuple[tuple[_Atom, int], ...] = ()  # factors of the base at which one index was selected


def sink_layout(graph: Graph) -> Graph:
    """The same function with moving operations composed and delayed; inputs, constants and outputs keep their names.

    Constants that are not read any more are dropped.
    """
    return _Sinker(graph).run()


class _Sinker:
    """State of one rewrite: the new nodes, and what is known of values whose nodes are not written."""

    def __init__(self, graph: Graph) -> None:
        self.graph = graph
        self.types: dict[str, TensorType] = {**graph.inputs, **graph.constants}
        self.taken = set(graph.types())
        self.views: dict[str, _View] = {}
        self.nodes: list[Node] = []
        self.written: dict[tuple[str, str], str] = {}
        self.numbers = 0
        self.source = ""

    def run(self) -> Graph:
        for node in self.graph.nodes:
            self.source = node.source
            view = self.moved(node) or self.sunk(node)
            if view is not None:
                self.views[node.name] = view
            else:
                self.keep(node)
        names = self.named_outputs()
        read = {name for node in self.nodes for name in node.refs()} | set(self.graph.outputs)
        constants = {n: t for n, t in self.graph.constants.items() if n in read}
        return Graph(self.graph.inputs, constants, tuple(self.nodes), self.graph.outputs).renamed(names)

    def moved(self, node: Node) -> _View | None:
        """The view that a moving operation makes; None for another operation or an inexpressible view."""
        if not node.args or not isinstance(node.args[0], Ref) or len(node.types) != 1:
            return None
        name, rank = node.args[0].name, len(self.type_of(node.args[0].name).shape)
        match operation(node.op).movement, node.args:
            case Movement.RESHAPE, _:
                return self.regrouped(self.view(name), node.type.shape)
            case Movement.PERMUTE, _:
                view = self.view(name)
                return replace(view, dims=tuple(view.dims[a] for a in permutation(node, rank)))
            case Movement.PART, (_, int(axis), int(index)) if node.op == "aten.select.int":
                return _selected(self.view(name), axis % rank, index)
        return None

    def sunk(self, node: Node) -> _View | None:
        """The view of an operation that was done before its argument's move; None if it has to be done after."""
        refs = list(node.refs())
        if not refs or not isinstance(node.args[0], Ref) or refs[0] != node.args[0].name or len(node.types) != 1:
            return None
        view = self.view(refs[0])
        row = operation(node.op)
        if row.mixes is not None and len(view.dims) > 1 and refs[0] not in self.graph.constants:
            alone = row.mixes(node, {name: self.type_of(name) for name in refs}) == 1
            worth = row.name == "linear" or not self.is_plain(view)  # a linear layer wants two dimensions in any case
            return self.tokenwise(node, view) if alone and worth else None
        if row.elementwise and not view.picks and not self.is_plain(view):
            views = [self.view(name) for name in refs]
            if any(self.arrangement(v) != self.arrangement(view) for v in views):
                return None
            bases = {name: v.base for name, v in zip(refs, views, strict=True)}
            type_ = TensorType(self.types[view.base].shape, node.type.dtype)
            moved = node.renamed(bases.__getitem__)
            return replace(view, base=self.write(node.op, moved.args, type_, moved.kwargs))
        return None

    def arrangement(self, view: _View) -> tuple[object, ...]:
        """Equal for views that rearrange bases of one shape in the same way."""
        places = {atom: i for i, atom in enumerate(view.order)}
        dims = tuple(tuple(places[a] for a in dim) for dim in view.dims)
        return (self.types[view.base].shape, tuple(a.size for a in view.order), dims, view.picks)

    def tokenwise(self, node: Node, view: _View) -> _View | None:
        """An operation on the last axis alone, done on ``[tokens, channels]``, tokens in the order of the base."""
        channels = view.dims[-1]
        picked = {atom for atom, _ in view.picks}
        tokens = tuple(a for a in view.order if a not in channels and a not in picked)
        if product(a.size for a in tokens) is None:
            return None
        flat = self.compute(view, (tokens, channels))
        rest = tuple(Ref(self.compute_name(a.name)) if isinstance(a, Ref) else a for a in node.args[1:])
        last = self.atoms(node.type.shape[-1:])[0]
        type_ = TensorType((self.types[flat].shape[0], node.type.shape[-1]), node.type.dtype)
        base = self.write(node.op, (Ref(flat), *rest), type_, node.kwargs)
        return _View(base, tokens + last, (*view.dims[:-1], last))

    def keep(self, node: Node) -> None:
        """Write the node as it is, on computed arguments."""
        if len(node.types) == 1:
            self.types[node.name] = node.type
        self.nodes.append(node.renamed(self.compute_name))

    def named_outputs(self) -> dict[str, str]:
        """Compute outputs that were views; their names, by what is to be called so."""
        names: dict[str, str] = {}
        own = {node.name for node in self.graph.nodes} | set(self.graph.inputs) | set(self.graph.constants)
        for output in dict.fromkeys(self.graph.outputs):
            if output not in self.views:
                continue
            computed = self.compute_name(output)
            if computed in names or computed in own:
                self.nodes.append(copied(output, computed, self.types[computed]))
            else:
                names[computed] = output
        return names

    def type_of(self, name: str) -> TensorType:
        if name in self.views:
            view = self.views[name]
            sizes = [product(a.size for a in dim) for dim in view.dims]
            return TensorType(tuple(s for s in sizes if s is not None), self.types[view.base].dtype)
        return self.types.get(name, TensorType((), ""))

    def view(self, name: str) -> _View:
        if name in self.views:
            return self.views[name]
        dims = self.atoms(self.type_of(name).shape)
        return _View(name, tuple(a for dim in dims for a in dim), dims)

    def is_plain(self, view: _View) -> bool:
        """Whether it is the base itself."""
        sizes = tuple(product(a.size for a in dim) for dim in view.dims)
        flat = tuple(a for dim in view.dims for a in dim)
        return flat == view.order and sizes == self.types[view.base].shape

    def atoms(self, shape: Sequence[Size]) -> tuple[tuple[_Atom, ...], ...]:
        """New atoms, one an axis, none for an axis of size 1."""
        dims: list[tuple[_Atom, ...]] = []
        for size in shape:
            self.numbers += 1
            dims.append(() if size == 1 else (_Atom(self.numbers, size),))
        return tuple(dims)

    def regrouped(self, view: _View, shape: Sequence[Size]) -> _View | None:
        """A reshape: the same factors in the same order, split where an axis ends inside one."""
        pending = deque(a for dim in view.dims for a in dim)
        split: dict[_Atom, tuple[_Atom, ...]] = {}
        dims: list[tuple[_Atom, ...]] = []
        for size in shape:
            dim: list[_Atom] = []
            need = size
            while need != 1:
                if not pending:
                    return None
                atom = pending.popleft()
                rest = ratio(need, atom.size)
                if rest is None:
                    inner = ratio(atom.size, need)
                    if inner is None:
                        return None
                    (outer,), (remainder,) = self.atoms((need, inner))
                    split[atom] = (outer, remainder)
                    pending.appendleft(remainder)
                    atom, rest = outer, 1
                dim.append(atom)
                need = rest
            dims.append(tuple(dim))
        return None if pending else _View(view.base, _split(view.order, split), tuple(dims), view.picks)

    def compute_name(self, name: str) -> str:
        """The computed value of this name, written now if it was only described."""
        return self.compute(self.views[name], self.views[name].dims) if name in self.views else name

    def compute(self, view: _View, groups: tuple[tuple[_Atom, ...], ...]) -> str:
        """Write what turns the base into axes of these groups of atoms: reshape, select, permute, reshape."""
        shape = tuple(size for size in (product(a.size for a in g) for g in groups) if size is not None)
        target = [a for g in groups for a in g]
        chunks = _chunks(view.order, target, {a for a, _ in view.picks})
        wanted = sorted((c for c in chunks if c[0] in target), key=lambda c: target.index(c[0]))
        name = view.base
        if chunks != wanted:
            left = [c for c in chunks if c[0] in target]
            axes = tuple(left.index(c) for c in wanted)
            moves = axes != tuple(range(len(axes)))
            ones = max(map(_leading_ones, (self.types[name].shape, shape))) if moves else 0
            name = self.write_reshape(name, (*[1] * ones, *(product(a.size for a in c) or 1 for c in chunks)))
            for atom, index in view.picks:
                place = next(i for i, c in enumerate(chunks) if c[0] == atom)
                chunks.pop(place)
                sizes, axis = self.types[name].shape, ones + place
                type_ = replace(self.types[name], shape=sizes[:axis] + sizes[axis + 1 :])
                name = self.write("aten.select.int", (Ref(name), axis, index), type_)
            if moves:
                order = (*range(ones), *(ones + axis for axis in axes))
                type_ = replace(self.types[name], shape=tuple(self.types[name].shape[a] for a in order))
                name = self.write("aten.permute.default", (Ref(name), order), type_)
        return self.write_reshape(name, shape)

    def write_reshape(self, name: str, shape: tuple[Size, ...]) -> str:
        if self.types[name].shape == shape:
            return name
        return self.write("aten.reshape.default", (Ref(name), shape), replace(self.types[name], shape=shape))

    def write(
        self, op: str, args: tuple[Argument, ...], type_: TensorType, kwargs: tuple[tuple[str, Argument], ...] = ()
    ) -> str:
        """A node, or the one that was written before with the same arguments; its name."""
        key = (op, repr((args, kwargs)))
        if key not in self.written:
            name = f"{op.split('.')[1]}_l{len(self.written)}"
            while name in self.taken:
                name += "_"
            self.taken.add(name)
            self.types[name] = type_
            self.nodes.append(Node(name, op, args, kwargs, (type_,), self.source))
            self.written[key] = name
        return self.written[key]


def _leading_ones(shape: Sequence[Size]) -> int:
    """Axes of size 1 before all others. They stay in a permutation: so a batch of one moves its heads as others do."""
    return next((axis for axis, size in enumerate(shape) if size != 1), len(shape))


def product(sizes: Iterable[Size]) -> Size | None:
    """Product of sizes; None if it is not a number or a multiple of B."""
    number, batches = 1, 0
    for size in sizes:
        number *= size.multiple if isinstance(size, Batch) else size
        batches += isinstance(size, Batch)
    return None if batches > 1 else Batch(number) if batches else number


def ratio(a: Size, b: Size) -> Size | None:
    """``a / b`` if that is a positive number or a multiple of B, whatever B is; else None."""
    numerator, denominator = (s.multiple if isinstance(s, Batch) else s for s in (a, b))
    if denominator < 1 or numerator < 1 or numerator % denominator:
        return None
    if isinstance(a, Batch):
        return numerator // denominator if isinstance(b, Batch) else Batch(numerator // denominator)
    return None if isinstance(b, Batch) else numerator // denominator


def _selected(view: _View, axis: int, index: int) -> _View | None:
    atoms = view.dims[axis]
    dims = view.dims[:axis] + view.dims[axis + 1 :]
    if not atoms:
        return replace(view, dims=dims)
    if len(atoms) > 1 or not isinstance(atoms[0].size, int):
        return None
    return replace(view, dims=dims, picks=(*view.picks, (atoms[0], index % atoms[0].size)))


def _split(atoms: Sequence[_Atom], split: dict[_Atom, tuple[_Atom, ...]]) -> tuple[_Atom, ...]:
    return tuple(b for a in atoms for b in (_split(split[a], split) if a in split else (a,)))


def _chunks(order: Sequence[_Atom], target: Sequence[_Atom], picked: set[_Atom]) -> list[tuple[_Atom, ...]]:
    """The factors of the base, those that stay neighbours in the target merged."""
    chunks: list[tuple[_Atom, ...]] = []
    for atom in order:
        if chunks and atom not in picked and chunks[-1][-1] not in picked:
            follows = target.index(atom) == target.index(chunks[-1][-1]) + 1
            if follows and product(a.size for a in (*chunks[-1], atom)) is not None:
                chunks[-1] = (*chunks[-1], atom)
                continue
        chunks.append((atom,))
    return chunks
